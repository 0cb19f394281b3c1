"""Numbers that say what a message is: opcodes, sub-codes, element types, content ids.

Source: Protocol reference 2, 4, 5, 7, 16. Vendor's prefixes: ``XTS_SPC_*`` command, ``XTS_SPCA_*``
profile sub-command, ``XTS_SPCX_*`` X4 driver sub-command, ``XTS_SDC_*`` system command,
``XTS_SPR_*`` response, ``XTS_SPRD_*`` element type, ``XTS_ID_*`` content. Members without prefix
bear the reference's own words where it gives no vendor's name.
"""

from enum import IntEnum


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

    NORMALIZATION = 0x10
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
    WRITE_PAGE = 0x10
    START_APP = 0x20


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
