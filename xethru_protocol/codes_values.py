"""Numbers that fields of a message carry.

Source: Protocol reference 4 to 7. Vendor's prefixes: ``XTID_SM_*`` mode, ``XTS_ID_APP_*`` profile,
``XTID_SSIC_*`` info item, ``XTS_SPRS_*`` system state, ``XTS_SPRP_*`` PONG. Members without prefix
bear the reference's own words where it gives no vendor's name.
"""

from enum import IntEnum, IntFlag


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
