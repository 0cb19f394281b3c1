"""Numbers of the wire under the vendor's own names.

Source: Protocol reference 2, 4, 5. Prefixes: ``XTS_SPC_*`` command, ``XTS_SPCX_*`` X4 driver
sub-command, ``XTS_SPCXI_*`` X4 setting (here the members of `X4Setting`), ``XTS_SDC_*`` system
command, ``XTS_SPR_*`` response, ``XTS_SPRD_*`` element type, ``XTS_SPRE_*`` error,
``XTS_SPRS_*`` system state, ``XTS_ID_*`` content, ``XTID_SM_*`` mode, ``XTID_SSIC_*`` info item.
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


class X4DriverCode(IntEnum):
    """Second byte of X4DRIVER. Protocol reference 4.9."""

    XTS_SPCX_SET = 0x10
    XTS_SPCX_GET = 0x11
    XTS_SPCX_WRITE = 0x12
    XTS_SPCX_READ = 0x13
    XTS_SPCX_INIT = 0x20


class NoiseMapCode(IntEnum):
    """Second byte of MOD_NOISEMAP. Protocol reference 4.6."""

    XTS_SPCN_SETCONTROL = 0x10


class OutputCode(IntEnum):
    """Second byte of OUTPUT. Protocol reference 4.7."""

    XTS_SPCO_SETCONTROL = 0x10


class IoPinCode(IntEnum):
    """Second byte of IOPIN. Protocol reference 4.8."""

    XTS_SPCIOP_SETCONTROL = 0x10
    XTS_SPCIOP_SETVALUE = 0x20


class DirCode(IntEnum):
    """Second byte of DIR_COMMAND. Protocol reference 4.10, 4.11."""

    XTS_SDC_SYSTEM_GET_INFO = 0x58
    XTS_SDC_GET_PROFILEID = 0x74
    XTS_SDC_COMM_SETBAUDRATE = 0x80


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
    """Second byte of REPLY and DATA. Protocol reference 5.2, 6."""

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


class SystemCode(IntEnum):
    """Payload of SYSTEM. Protocol reference 5."""

    XTS_SPRS_BOOTING = 0x10
    XTS_SPRS_READY = 0x11


class PongCode(IntEnum):
    """Payload of PONG. Protocol reference 5."""

    XTS_SPRP_READY = 0xAAEEAEEA
    XTS_SPRP_NOTREADY = 0xAEEAEEAA
    XTS_SPRP_SAFEMODE = 0xFFEEFEEF


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


class ProfileId(IntEnum):
    """Argument of LOADAPP. Protocol reference 4.3."""

    XTS_ID_APP_NONE = 0x00000000
    XTS_ID_APP_PRESENCE_2 = 0x014D4AB8  # the X4M300's
    XTS_ID_APP_RESPIRATION_2 = 0x064E57AD
    XTS_ID_APP_RESPIRATION_3 = 0x47FABEBA
    XTS_ID_APP_RESPIRATION_4 = 0x4AC5D074
    XTS_ID_APP_RESPIRATION_5 = 0xA9E03260
    XTS_ID_APP_HEARTRATE = 0x6B5C1609


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
    BUFFER_TOO_SMALL = 11
    INVALID_DAC_STEP = 12
    TIMER_CHANGE_FAILED = 13
    COUNTER_TOO_LARGE = 14
    DOWNCONVERSION_REGION_UNSUPPORTED = 15
    FRAME_AREA_TOO_LARGE = 16
    FRAME_AREA_END_OUT_OF_SCOPE = 17
    PRF_DIV_TOO_SMALL = 18
    MAILBOX_ERROR = 19
    INVALID_TX_CENTER_FREQUENCY = 20
    INVALID_TX_POWER = 21
    COMMON_PLL_LOCK_FAILED = 27
    TX_PLL_LOCK_FAILED = 28
    RX_PLL_LOCK_FAILED = 29
    UNINITIALIZED = 0xFFFFFFFF  # -1


def error_name(code: int, *, x4_command: bool = False) -> str:
    """Name of an ERROR code; empty if unknown.

    An ERROR does not say which command failed. Without that knowledge the protocol's own
    names win and the rest is read as the X4 driver's.

    >>> error_name(1), error_name(17), error_name(1, x4_command=True)
    ('NOT_RECOGNIZED', 'X4 FRAME_AREA_END_OUT_OF_SCOPE', 'X4 GENERAL_FAILURE')
    """
    protocol = _name(ErrorCode, code).removeprefix("XTS_SPRE_")
    x4 = _name(X4Error, code)
    if code == X4Error.UNINITIALIZED:
        x4 += " (-1)"
    x4 = f"X4 {x4}" if x4 else ""
    return (x4 or protocol) if x4_command else (protocol or x4)


def _name(enum: type[IntEnum], code: int) -> str:
    return next((member.name for member in enum if member == code), "")
