"""Codes of ERROR responses, whose meaning depends on the command that failed.

Source: Protocol reference 5.1.
"""

from enum import Enum, IntEnum


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
    NOT_FOUND = 5  # also what DELETE_FILE says after its timeout
    NOT_OPEN = 6
    OUT_OF_MEMORY = 7
    NOT_INITIALIZED = 8
    FULL = 9
    SYSTEM_BUSY = 10
    TOO_MANY_OPEN = 11
    UNKNOWN_FAILURE = 12
    LOCK_TIMEOUT = 13
    NOT_SUPPORTED = 14
    OUT_OF_RANGE = 0x21


class IoPinError(IntEnum):
    """ERROR codes of IO pin commands. Protocol reference 5.1."""

    WRONG_PIN = 1
    FUNCTION_NOT_AVAILABLE = 2
    INTERRUPT_NOT_AVAILABLE = 3
    MODE_NOT_SUPPORTED = 4


class ErrorSpace(Enum):
    """Which meanings the codes of a command's ERROR have; a command's row names it."""

    PROTOCOL = "protocol"
    X4_DRIVER = "X4 driver"
    FILES = "files"
    IO_PINS = "IO pins"


_OWN: dict[ErrorSpace, tuple[str, type[IntEnum]]] = {
    ErrorSpace.X4_DRIVER: ("X4 ", X4Error),
    ErrorSpace.FILES: ("FILE ", FileError),
    ErrorSpace.IO_PINS: ("IOPIN ", IoPinError),
}


def error_name(code: int, space: ErrorSpace = ErrorSpace.PROTOCOL) -> str:
    """Name of an ERROR code; empty if unknown. Protocol reference 5.1.

    Parameters
    ----------
    code
        0 ... 2**32 - 1.
    space
        The failed command's ``Row.errors``. An ERROR does not say which command failed: without
        that knowledge the protocol's own names win and the rest is read as the X4 driver's.

    >>> error_name(1), error_name(17), error_name(1, ErrorSpace.X4_DRIVER)
    ('NOT_RECOGNIZED', 'X4 FRAME_AREA_END_OUT_OF_SCOPE', 'X4 GENERAL_FAILURE')
    >>> error_name(6, ErrorSpace.FILES), error_name(0x22, ErrorSpace.FILES)
    ('FILE NOT_OPEN', 'RESTARTING')
    """
    own = _name(space, code)
    protocol = next((error.name for error in ErrorCode if error == code), "")
    return own or protocol.removeprefix("XTS_SPRE_") or _x4_guess(space, code)


def _x4_guess(space: ErrorSpace, code: int) -> str:
    return _name(ErrorSpace.X4_DRIVER, code) if space is ErrorSpace.PROTOCOL else ""


def _name(space: ErrorSpace, code: int) -> str:
    if space not in _OWN:
        return ""
    prefix, errors = _OWN[space]
    name = next((error.name for error in errors if error == code), "")
    if name and code == X4Error.UNINITIALIZED:
        name += " (-1)"
    return name and prefix + name
