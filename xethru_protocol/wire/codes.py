"""Numbers of the wire under the vendor's own names.

First the numbers that identify messages, then the values of their fields, then error codes.

Source: Protocol reference 2, 4 to 7, 16. Vendor's prefixes: ``XTS_SPC_*`` command, ``XTS_SPCA_*``
profile sub-command, ``XTS_SPCX_*`` X4 driver sub-command, ``XTS_SDC_*`` system command,
``XTS_SPR_*`` response, ``XTS_SPRD_*`` element type, ``XTS_ID_*`` content, ``XTID_SM_*`` mode,
``XTS_ID_APP_*`` profile, ``XTID_SSIC_*`` info item, ``XTS_SPRS_*`` system state, ``XTS_SPRP_*``
PONG. Members without prefix have the reference's own words where it gives no vendor's name.
"""

from enum import IntEnum, IntFlag

BAUD_RATES = (
    *(9600, 19200, 38400, 115200, 230400, 460800, 500000, 576000, 921600),
    *(1000000, 2000000, 3000000, 4000000),
)
"""Rates of a UART. Protocol reference 10."""
POWER_UP_BAUD = 115200
"""A UART module's rate after every restart, as none is saved; without meaning on USB and ptys."""


class CommandCode(IntEnum):
    """First payload byte host to module. Protocol reference 2."""

    XTS_SPC_PING = 0x01
    XTS_SPC_START_BOOTLOADER = 0x02
    XTS_SPC_APPCOMMAND = 0x10
    XTS_SPC_MOD_SETMODE = 0x20
    XTS_SPC_MOD_LOADAPP = 0x21
    XTS_SPC_MOD_RESET = 0x22
    XTS_SPC_MOD_SETCOM = 0x23  # defined, handled by no firmware
    XTS_SPC_MOD_SETLEDCONTROL = 0x24
    XTS_SPC_MOD_NOISEMAP = 0x25
    XTS_SPC_MOD_GETMODE = 0x26
    XTS_SPC_IOPIN = 0x40
    XTS_SPC_OUTPUT = 0x41
    XTS_SPC_DEBUG_OUTPUT = 0x42
    XTS_SPC_X4DRIVER = 0x50
    XTS_SPC_FRAME_POSTPROCESSING = 0x52  # newer sensor firmware
    XTS_SPC_DIR_COMMAND = 0x90
    XTS_SPC_HIL = 0xA0  # always answered ERROR 1
    XTS_SPC_DEBUG_LEVEL = 0xB0
    XTS_SPC_BOOTLOADER = 0xC0  # bootloader only


class AppCommandCode(IntEnum):
    """Second byte of APPCOMMAND. Protocol reference 4.4."""

    XTS_SPCA_SET = 0x10
    XTS_SPCA_GET = 0x11
    XTS_SPCA_FACTORY_PRESET = 0x12
    XTS_SPCA_STORE_NOISEMAP = 0x13
    XTS_SPCA_LOAD_NOISEMAP = 0x14
    XTS_SPCA_GET_PARAMETER_FILE = 0x15  # never parsed; the document prints it for delete noise map
    XTS_SPCA_DELETE_NOISEMAP = 0x16
    XTS_SPCA_POLL = 0x20  # never parsed


class AppObject(IntEnum):
    """Object id of APPCOMMAND SET and GET. Protocol reference 4.4."""

    DETECTION_ZONE = 0x96A10A1C
    DETECTION_ZONE_LIMITS = 0x96A10A1D
    SENSITIVITY = 0x10A5112B
    TX_CENTER_FREQ = 0x71AF2A2B
    LED_CONTROL = 0x71AF2A2C
    PROFILE_PARAMETERFILE = 0x32BA7623


class NoiseMapCode(IntEnum):
    """Second byte of MOD_NOISEMAP. Protocol reference 4.6, 16."""

    XTS_SPCN_SETCONTROL = 0x10
    XTS_SPCN_GETCONTROL = 0x11
    SET_PERIODIC_STORE = 0x12
    GET_PERIODIC_STORE = 0x13


class OutputCode(IntEnum):
    """Second byte of OUTPUT and of DEBUG_OUTPUT. Protocol reference 4.7, 16."""

    XTS_SPCO_SETCONTROL = 0x10
    XTS_SPCO_GETCONTROL = 0x11


class IoPinCode(IntEnum):
    """Second byte of IOPIN. Protocol reference 4.8."""

    XTS_SPCIOP_SETCONTROL = 0x10
    XTS_SPCIOP_GETCONTROL = 0x11
    XTS_SPCIOP_SETVALUE = 0x20
    XTS_SPCIOP_GETVALUE = 0x21


class X4DriverCode(IntEnum):
    """Second byte of X4DRIVER. Protocol reference 4.9, 16."""

    XTS_SPCX_SET = 0x10
    XTS_SPCX_GET = 0x11
    XTS_SPCX_WRITE = 0x12
    XTS_SPCX_READ = 0x13
    WRITE_I2C = 0x14
    READ_I2C = 0x15
    XTS_SPCX_INIT = 0x20


I2C_REGISTER = 0x27  # setting id of X4DRIVER's two I2C sub-commands, of no others (16)


class X4Setting(IntEnum):
    """Setting id of X4DRIVER SET and GET (vendor: ``XTS_SPCXI_*``). Protocol reference 4.9."""

    FPS = 0x10
    PULSESPERSTEP = 0x11
    ITERATIONS = 0x12
    DOWNCONVERSION = 0x13
    FRAMEAREA = 0x14
    DACSTEP = 0x15
    DACMIN = 0x16
    DACMAX = 0x17
    FRAMEAREAOFFSET = 0x18
    ENABLE = 0x19
    TXCENTERFREQUENCY = 0x20
    TXPOWER = 0x21
    SPIREGISTER = 0x22
    PIFREGISTER = 0x23
    XIFREGISTER = 0x24
    PRFDIV = 0x25
    FRAMEBINCOUNT = 0x26


class FramePostprocessingCode(IntEnum):
    """Second byte of the frame post-processing command. Protocol reference 16."""

    GET = 0x10
    SET = 0x11


class FramePostprocessing(IntEnum):
    """Setting id of the frame post-processing command. Protocol reference 16."""

    NORMALISATION = 0x10
    PHASE_NOISE_CORRECTION = 0x11
    DECIMATION_FACTOR = 0x12
    NUMBER_FORMAT = 0x13
    LEGACY_OUTPUT = 0x14


class DirCode(IntEnum):
    """Second byte of DIR_COMMAND. Protocol reference 4.10, 4.11."""

    XTS_SDC_RADLIB_GETVARINT = 0x12  # X2 legacy
    XTS_SDC_SYSTEM_TEST = 0x50
    XTS_SDC_SYSTEM_GET_VERSION = 0x55  # X2 legacy
    XTS_SDC_SYSTEM_GET_INFO = 0x58
    XTS_SDC_SYSTEM_GET_DEBUG_DATA = 0x59
    XTS_SDC_GET_CRASH_DUMP_LENGTH = 0x61
    XTS_SDC_CLEAR_CRASH_DUMP = 0x62
    XTS_SDC_GET_CRASH_DUMP = 0x63
    XTS_SDC_SEARCH_FILE_TYPE = 0x64
    XTS_SDC_FIND_ALL_FILES = 0x65
    XTS_SDC_CREATE_NEW_FILE = 0x66
    XTS_SDC_SET_FILE_DATA = 0x67
    XTS_SDC_CLOSE_FILE = 0x68
    XTS_SDC_GET_FILE_LENGTH = 0x69
    XTS_SDC_DELETE_FILE = 0x70
    XTS_SDC_GET_FILE_DATA = 0x71
    XTS_SDC_OPEN_FILE = 0x72
    XTS_SDC_FORMAT_FILESYSTEM = 0x73
    XTS_SDC_GET_PROFILEID = 0x74
    XTS_SDC_INJECT_FRAME = 0x75
    XTS_SDC_PREPARE_INJECT_FRAME = 0x76
    XTS_SDC_COMM_SETBAUDRATE = 0x80


# X2-era codes of DIR_COMMAND, without known names; every X4 answers ERROR 1 (4.10).
LEGACY_DIR_CODES: frozenset[int] = frozenset(
    {*range(0x10, 0x41), *range(0x51, 0x58), 0x60}
) - frozenset(DirCode)


class BootloaderCode(IntEnum):
    """Second byte of BOOTLOADER. Protocol reference 4.12."""

    GET_DEVICE_INFO = 0x00
    PAGE_SIZE = 0x01
    PAGE_CNT = 0x02
    WRITE_PAGE = 0x10
    START_APP = 0x20
    ECHO = 0xEF


class BootloaderReply(IntEnum):
    """First payload byte of what a bootloader answers. Protocol reference 4.12."""

    SUCCESS = 0xE0
    FRAMING_ERROR = 0xE1
    UNKNOWN_COMMAND = 0xE2  # from then on writing is refused
    WRITING_REFUSED = 0xE3
    WRONG_CHECKSUM = 0xE4
    PAGE_OUT_OF_BOUNDS = 0xE5
    ECHO = 0xEF


class BootloaderFraming(IntEnum):
    """What a bootloader's framing error is about. Protocol reference 4.12, 1.2."""

    CRC = 1
    LOST_BYTES = 2
    INCOMPLETE_PACKET = 3
    OUT_OF_BUFFER = 4


class ResponseCode(IntEnum):
    """First payload byte module to host. Protocol reference 2."""

    XTS_SPR_PONG = 0x01
    XTS_SPR_ACK = 0x10
    XTS_SPR_REPLY = 0x11
    XTS_SPR_HIL = 0x12
    XTS_SPR_ERROR = 0x20
    XTS_SPR_SYSTEM = 0x30
    XTS_SPR_APPDATA = 0x50
    XTS_SPR_DATA = 0xA0


class ElementType(IntEnum):
    """Second byte of REPLY, DATA and HIL. Protocol reference 5.2, 5.4, 6."""

    XTS_SPRD_NONE = 0x00
    XTS_SPRD_BYTE = 0x10
    XTS_SPRD_INT = 0x11
    XTS_SPRD_FLOAT = 0x12
    XTS_SPRD_STRING = 0x13
    XTS_SPRD_USER = 0x50


class AppDataId(IntEnum):
    """Message id of APPDATA. Protocol reference 7."""

    XTS_ID_BASEBAND_IQ = 0x0C
    XTS_ID_BASEBAND_AMPLITUDE_PHASE = 0x0D
    XTS_ID_PULSEDOPPLER_FLOAT = 0x10
    XTS_ID_PULSEDOPPLER_BYTE = 0x11
    XTS_ID_NOISEMAP_FLOAT = 0x12
    XTS_ID_NOISEMAP_BYTE = 0x13
    XTS_ID_PRESENCE_SINGLE = 0x723BFA1E
    XTS_ID_PRESENCE_MOVINGLIST = 0x723BFA1F
    XTS_ID_RESP_STATUS = 0x2375FE26
    XTS_ID_RESP_STATUS_EXT = 0x2375A16B
    XTS_ID_SLEEP_STATUS = 0x2375A16C
    XTS_ID_VITAL_SIGNS = 0x20020102
    XTS_ID_SLEEPSTAGE = 0x41083A02
    XTS_ID_RESPIRATION_MOVINGLIST = 0x610A3B00
    XTS_ID_RESPIRATION_DETECTIONLIST = 0x610A3B02
    XTS_ID_RESPIRATION_NORMALIZEDMOVEMENTLIST = 0xC3A331CF
    XTS_ID_PROFILE_PARAMETERFILE = 0x32BA7623
    XTS_ID_RADAR_RF = 0xC1A3117E
    XTS_ID_RADAR_RF_NORMALIZED = 0xB13B8F12
    XTS_ID_RADAR_BASEBAND_FLOAT = 0x026F1379
    XTS_ID_RADAR_BASEBAND_Q15 = 0xEC8D0AA5
    XTS_ID_PRESENCE_STATUS = 0x991A52BE  # legacy
    XTS_ID_DECIM_STATUS = 0x327645AA  # legacy


class SensorMode(IntEnum):
    """Argument of SETMODE, answer of GETMODE. Protocol reference 4.2."""

    XTID_SM_RUN = 0x01
    XTID_SM_NORMAL = 0x10  # X2 legacy
    XTID_SM_IDLE = 0x11
    XTID_SM_MANUAL = 0x12
    XTID_SM_STOP = 0x13
    XTID_SM_REG = 0x50  # certification

    @property
    def label(self) -> str:
        """The mode's short name, for example ``"STOP"``."""
        return self.name.removeprefix("XTID_SM_")


class NormalModeParam(IntEnum):
    """Parameter of SETMODE NORMAL. Protocol reference 4.2."""

    EMBEDDED = 0
    HIL_UP = 1
    HIL_DOWN = 2
    DEFAULT = 0xFF


class RegModeParam(IntEnum):
    """Parameter of SETMODE REG, for certification. Protocol reference 4.2."""

    IDLE = 0
    TX_ONLY = 1
    TX_ONLY_TX_OFF = 2
    STREAM_TX_OFF = 3
    TX_ONLY_EXT_CLOCK = 4
    STREAM = 5
    TX_ONLY_CLOCK_OUT = 6
    RX_FAILURE_EMULATION = 7


class ProfileId(IntEnum):
    """Argument of LOADAPP. Protocol reference 4.3."""

    XTS_ID_APP_NONE = 0x00000000
    XTS_ID_APP_PRESENCE_2 = 0x014D4AB8  # the X4M300's
    XTS_ID_APP_PRESENCE_3 = 0x114D4AB8
    XTS_ID_APP_PRESENCE_3_DEBUG = 0x114D4AB9
    XTS_ID_APP_RESPIRATION_2 = 0x064E57AD
    XTS_ID_APP_RESPIRATION_3 = 0x47FABEBA
    XTS_ID_APP_RESPIRATION_4 = 0x4AC5D074
    XTS_ID_APP_RESPIRATION_5 = 0xA9E03260
    XTS_ID_APP_HEARTRATE = 0x6B5C1609
    XTS_ID_APP_RESP = 0x1423A2D6  # X2M200, and the next two
    XTS_ID_APP_SLEEP = 0x00F17B17
    XTS_ID_APP_PRESENCE = 0x00288912
    XTS_ID_APP_DECIM = 0x9BB3A2C6
    XTS_ID_APP_HIGHBAY_1 = 0xD0F2862D
    XTS_ID_APP_HIGHBAY_1_DEBUG = 0xD0F2862E
    XTS_ID_APP_RADAR = 0x57DABF09


class BootloaderKey(IntEnum):
    """Key of START_BOOTLOADER. Protocol reference 4.1, 11 row 19."""

    CURRENT = 0xA2B96EF1
    OLD = 0xA2B95EF0  # firmware 1.0.7; refused with ERROR 1 since


FORMAT_KEY = 0x427F00C9  # of FORMAT_FILESYSTEM (4.11)


class LedMode(IntEnum):
    """What the module's LED shows. Protocol reference 4.5."""

    OFF = 0
    SIMPLE = 1
    FULL = 2


class TraceLevel(IntEnum):
    """Argument of DEBUG_LEVEL; a header allows up to 9. Protocol reference 4.5."""

    NONE = 0
    ERROR = 1
    WARNING = 2
    INFO = 3
    DEBUG = 4


class NoiseMapControl(IntFlag):
    """Bits of noise map control; an X4M300's default is all three. Protocol reference 4.6, 11."""

    NO_DEFAULT = 1  # do not start from the built-in map
    ADAPTIVE = 2  # always on, whatever is set
    IGNORE_STORED = 4  # initialise on reset


class OutputFeature(IntEnum):
    """Message that OUTPUT control switches; the id is the message's own. Protocol reference 4.7."""

    PRESENCE_SINGLE = 0x723BFA1E
    PRESENCE_MOVINGLIST = 0x723BFA1F
    RESP_STATUS = 0x2375FE26
    SLEEP_STATUS = 0x2375A16C
    VITAL_SIGNS = 0x20020102
    RESPIRATION_MOVINGLIST = 0x610A3B00
    RESPIRATION_DETECTIONLIST = 0x610A3B02
    RESPIRATION_NORMALIZEDMOVEMENTLIST = 0xC3A331CF
    BASEBAND_IQ = 0x0C
    BASEBAND_AMPLITUDE_PHASE = 0x0D
    PULSEDOPPLER_FLOAT = 0x10
    PULSEDOPPLER_BYTE = 0x11
    NOISEMAP_FLOAT = 0x12
    NOISEMAP_BYTE = 0x13


class OutputControl(IntFlag):
    """Control of a message that is on or off. Protocol reference 4.7."""

    ON = 1
    DEBUG_ROUTING = 1 << 31


class MatrixControl(IntFlag):
    """Control of pulse-Doppler and noise map messages, a bit per matrix. Protocol reference 4.7.

    Bit 2 is fast too: the document's numbering, which receivers tolerate (11 row 5).
    """

    SLOW = 1
    FAST = 2
    FAST_AS_DOCUMENTED = 4
    DEBUG_ROUTING = 1 << 31

    @property
    def fast(self) -> bool:
        """Whether the fast matrix is on, by either numbering."""
        return bool(self & (MatrixControl.FAST | MatrixControl.FAST_AS_DOCUMENTED))


class IoPin(IntEnum):
    """Id of a pin; those from 7 on are known to the base firmware only. 4.8."""

    ALL = 0
    IO1 = 1
    IO2 = 2
    IO3 = 3
    IO4 = 4
    IO5 = 5
    IO6 = 6
    PIN_7 = 7
    PIN_8 = 8
    PIN_9 = 9
    X4_IO1 = 41
    X4_IO2 = 42
    X4_IO3 = 43
    X4_IO4 = 44
    X4_ENABLE = 49
    MODE_SELECT_70 = 70
    MODE_SELECT_71 = 71
    SERIAL_80 = 80
    SERIAL_81 = 81
    SERIAL_82 = 82
    SERIAL_83 = 83
    SERIAL_84 = 84
    SERIAL_85 = 85
    SERIAL_86 = 86
    VBUS = 90


class IoPinSetup(IntFlag):
    """Setup bits of an IO pin. Protocol reference 4.8."""

    OUTPUT = 1  # else input
    PUSH_PULL = 2
    ACTIVE_LOW = 4
    PULL_UP = 8


class IoPinFeature(IntEnum):
    """What drives an IO pin. Protocol reference 4.8."""

    DISABLE = 0
    DEFAULT = 1  # the datasheet's function of that pin; overrides the setup
    PASSIVE = 2
    PRESENCE = 3
    MOVEMENT = 4
    BREATHING = 5
    NO_PRESENCE = 6


class TxCenterFrequency(IntEnum):
    """Value of X4 setting TXCENTERFREQUENCY and of a profile's band. Protocol reference 9.2."""

    LOW_BAND = 3  # 7.290 GHz
    HIGH_BAND = 4  # 8.748 GHz


class TxPower(IntEnum):
    """Value of X4 setting TXPOWER. Protocol reference 4.9."""

    OFF = 0
    LOW = 1
    MEDIUM = 2
    HIGH = 3


class InfoItem(IntEnum):
    """Argument of SYSTEM_GET_INFO. Protocol reference 4.10."""

    XTID_SSIC_ITEMNUMBER = 0x00
    XTID_SSIC_ORDERCODE = 0x01
    XTID_SSIC_FIRMWAREID = 0x02
    XTID_SSIC_VERSION = 0x03
    XTID_SSIC_BUILD = 0x04
    XTID_SSIC_APPLICATIONIDLIST = 0x05
    XTID_SSIC_SERIALNUMBER = 0x06
    XTID_SSIC_VERSIONLIST = 0x07
    XTID_SSIC_SYSTEMCOREID = 0x08
    XTID_SSIC_BOOTLOADER = 0x09


class TestCode(IntEnum):
    """Argument of SYSTEM_TEST. Protocol reference 4.10."""

    __test__ = False  # nothing for pytest

    EXTERNAL_RAM = 0x11
    READ_IO_PINS = 0x18
    X4_CONNECTION = 0x19
    CERTIFICATION_ON = 0x1A
    CERTIFICATION_OFF = 0x1B
    HARDWARE_CONFIG = 0x1C
    TX_ONLY = 0x1D
    TX_ONLY_TX_OFF = 0x1E
    STREAM_TX_OFF = 0x1F


class InjectMode(IntEnum):
    """How injected frames are played. Protocol reference 4.10."""

    LOOP = 1
    SEQUENTIAL = 2
    SINGLE = 3


class FileType(IntEnum):
    """Type of a file in the module; USER_DEFINED is the first of its range. 4.11."""

    CRASH_DUMP = 0x04554D50
    PARAMETER_FILE = 0x037DD98C
    NOISEMAP_SLOW = 0x05F09BCA
    NOISEMAP_FAST = 0x05F09BCB
    USER_DEFINED = 0x80000000


class SystemCode(IntEnum):
    """Payload of SYSTEM. Protocol reference 5."""

    XTS_SPRS_BOOTING = 0x10
    XTS_SPRS_READY = 0x11


class PongCode(IntEnum):
    """Payload of PONG. Protocol reference 5."""

    XTS_SPRP_READY = 0xAAEEAEEA
    XTS_SPRP_NOTREADY = 0xAEEAEEAA
    XTS_SPRP_SAFEMODE = 0xFFEEFEEF


class HilCommand(IntEnum):
    """What a HIL response is about. Protocol reference 5.4."""

    CONTINUE = 0x10
    SEND_FLOAT = 0x20


class DataContent(IntEnum):
    """Content id of DATA messages, a legacy list; a radar frame has 0. Protocol reference 6.1."""

    RAW_FRAME = 0
    I = 1  # noqa: E741 - the in-phase part
    Q = 2
    LEGACY_IQ = 3
    ENVELOPE = 4
    FFT_IN = 5
    FFT_OUT = 6
    PULSEDOPPLER_MATRIX = 7
    NOISE_MAP = 8
    STORAGE_I = 9
    STORAGE_Q = 10
    FLASH_FRAME = 11
    IQ = 12
    AP = 13
    BYTE_STREAM = 14


class MatrixInstance(IntEnum):
    """Which pulse-Doppler matrix a message is of. Protocol reference 7.2."""

    SLOW = 0
    FAST = 1


class PresenceState(IntEnum):
    """State of the presence messages. Protocol reference 7.3."""

    NO_PRESENCE = 0
    PRESENCE = 1
    INITIALIZING = 2
    UNKNOWN = 3  # or error


class PresenceDirection(IntEnum):
    """Which way the one detected person moves. Protocol reference 7.3."""

    STILL = 0
    TOWARDS = 1
    AWAY = 2


class RespirationState(IntEnum):
    """State of the respiration, sleep and vital sign messages. Protocol reference 7.4."""

    BREATHING = 0
    MOVEMENT = 1
    MOVEMENT_TRACKING = 2
    NO_MOVEMENT = 3
    INITIALIZING = 4
    ERROR = 5
    UNKNOWN = 6
    HEART_RATE_AND_BREATHING = 7


class ErrorCode(IntEnum):
    """ERROR codes of the protocol itself. Protocol reference 5.1."""

    XTS_SPRE_NOT_RECOGNIZED = 1
    XTS_SPRE_CRC_FAILED = 2  # defined, never sent
    XTS_SPRE_BUSY = 3
    XTS_SPRE_APP_INVALID = 0x20
    XTS_SPRE_COMMAND_FAILED = 0x21
    XTS_SPRE_RESTARTING = 0x22
    XTS_SPRE_USER = 0xA0


class X4Error(IntEnum):
    """ERROR codes of the X4 driver; the number space overlaps. Protocol reference 5.1."""

    GENERAL_FAILURE = 1
    NOT_SUPPORTED = 2
    BUSY = 3
    REGISTER_TIMEOUT = 4
    OSCILLATOR_LOCK_FAILED = 5
    LDO_FAILED = 6
    FIRMWARE_VERIFY_FAILED = 7
    SRAM_FIFO_TIMEOUT = 8
    FRAME_READY_TIMEOUT = 9
    FRAME_LENGTH_TOO_LOW = 10
    BUFFER_TO_SMALL = 11  # an SPI burst
    INVALID_DACSTEP_INPUT = 12
    TIMER_CHANGE_FAILED = 13
    COUNTER_TOO_LARGE = 14
    DOWNCONVERSION_REGION_UNSUPPORTED = 15
    FRAME_AREA_TOO_LARGE = 16  # never returned
    FRAME_AREA_END_OUT_OF_SCOPE = 17
    PRF_DIV_TOO_SMALL = 18
    MAILBOX_ERROR = 19
    INVALID_TX_CENTER_FREQUENCY = 20
    INVALID_TX_POWER = 21
    INVALID_ITERATIONS_ORDER = 22  # computed after INIT but not reported, and the next four
    INVALID_COARSE_FRAMES = 23
    INVALID_MAX_COUNTER = 24
    INVALID_BIT_DROP = 25
    INVALID_BACK_END_CLOCK = 26
    COMMON_PLL_LOCK_FAILED = 27
    TX_PLL_LOCK_FAILED = 28
    RX_PLL_LOCK_FAILED = 29
    HAL_NOT_IMPLEMENTED = 900
    HAL_ERROR = 999
    UNINITIALIZED = 0xFFFFFFFF  # -1


class FileError(IntEnum):
    """ERROR codes of file commands. Protocol reference 5.1."""

    INVALID_PARAMETER = 1  # a wrong key
    ALREADY_OPEN = 2
    ALREADY_EXISTS = 3
    BUSY = 4
    NOT_FOUND = 5  # also the answer to DELETE_FILE after its timeout
    NOT_OPEN = 6
    OUT_OF_MEMORY = 7
    NOT_INITIALIZED = 8
    FULL = 9
    SYSTEM_BUSY = 10
    TOO_MANY_FILES_OPEN = 11
    UNKNOWN_FAILURE = 12  # CREATE with length 0
    LOCK_TIMEOUT = 13
    NOT_SUPPORTED = 14
    OUT_OF_RANGE = 0x21


class IoPinError(IntEnum):
    """ERROR codes of IO pin commands. Protocol reference 5.1."""

    WRONG_PIN = 1
    FUNCTION_NOT_AVAILABLE = 2
    INTERRUPT_NOT_AVAILABLE = 3
    MODE_NOT_SUPPORTED = 4


_ERROR_PREFIXES: dict[type[IntEnum], str] = {
    X4Error: "X4 ",
    FileError: "file ",
    IoPinError: "IOPIN ",
}


def error_name(code: int, errors: type[IntEnum] = ErrorCode) -> str:
    """Name of an ERROR code; empty if unknown. Protocol reference 5.1.

    Parameters
    ----------
    code
        0 ... 2**32 - 1.
    errors
        The failed command's ``Row.errors``. An ERROR does not name the command that failed: without
        that knowledge the protocol's own names win, and the rest has the names of the X4 driver's
        and of the files' codes.

    >>> error_name(1), error_name(17), error_name(1, X4Error)
    ('NOT_RECOGNIZED', 'X4 FRAME_AREA_END_OUT_OF_SCOPE', 'X4 GENERAL_FAILURE')
    >>> error_name(6, FileError), error_name(0x22, FileError)
    ('file NOT_OPEN', 'RESTARTING')
    >>> error_name(6)
    'X4 LDO_FAILED or file NOT_OPEN'
    """
    if errors is not ErrorCode:
        return _name_in(errors, code) or _name_in(ErrorCode, code)
    others = (_name_in(space, code) for space in (X4Error, FileError))
    return _name_in(ErrorCode, code) or " or ".join(name for name in others if name)


def _name_in(space: type[IntEnum], code: int) -> str:
    name = next((error.name for error in space if error == code), "")
    signed = " (-1)" if code == X4Error.UNINITIALIZED else ""
    return name and _ERROR_PREFIXES.get(space, "") + name.removeprefix("XTS_SPRE_") + signed
