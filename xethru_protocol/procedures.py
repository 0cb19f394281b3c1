"""What a driver does with a module, step by step, written once for both drivers.

Each procedure is a generator that yields steps for the line and returns its result; the first
argument is the driver's state. In the drivers it is a method of the same name.
"""

import math
from collections.abc import Callable
from dataclasses import fields
from typing import TypeVar

from xethru_protocol import x4
from xethru_protocol.codes import InfoItem, PongCode, SensorMode, X4Setting
from xethru_protocol.core import RadarCore
from xethru_protocol.errors import (
    DeviceError,
    LocalProtocolError,
    RemoteProtocolError,
    ResponseTimeout,
)
from xethru_protocol.messages import (
    Command,
    GetMode,
    Ping,
    ReplyFloat,
    Response,
    SetBaudRate,
    SetMode,
    SystemGetInfo,
    X4DriverGet,
    X4DriverSet,
    X4Value,
)
from xethru_protocol.raw_config import ModuleInfo
from xethru_protocol.steps import Procedure, Read, SetLineRate, Write

TIMEOUT_S = 2.0
SLOW_TIMEOUT_S = 10.0  # mode changes and chip restarts
BAUD_RATES = (
    *(9600, 19200, 38400, 115200, 230400, 460800, 500000, 576000, 921600),
    *(1000000, 2000000, 3000000, 4000000),
)

_STALE_READS = 64  # more than any port buffers; a bound, since a fast module never pauses
_BAUD_SETTLE_S = (0.1, 0.4)  # before and after the change, as the vendor's host waits

ReplyT = TypeVar("ReplyT", bound=Response)


# --- commands -----------------------------------------------------------------------------------


def request(
    core: RadarCore, command: Command[ReplyT], timeout_s: float = TIMEOUT_S
) -> Procedure[ReplyT]:
    """Send a command and return the reply that its row in the message table names.

    After a request that was given up its answer may still come; a PING is sent first then, and
    all before its PONG dropped.

    Parameters
    ----------
    command
        Any command of the table.
    timeout_s
        How long to wait for the reply.

    Raises
    ------
    DeviceError
        If the module refuses.
    ResponseTimeout
        If no fitting reply comes in time.
    Disconnected
        If the line is gone.
    """
    if core.conversation.out_of_step and not isinstance(command, Ping):
        yield from _exchange(core, Ping(), timeout_s)
    reply = yield from _exchange(core, command, timeout_s)
    # the conversation checked it: the row's replies are what ReplyT stands for
    return reply  # type: ignore[return-value]


def _exchange(core: RadarCore, command: Command[Response], timeout_s: float) -> Procedure[Response]:
    yield from take_stale_input()
    conversation = core.conversation
    try:
        yield Write(conversation.ask(command, timeout_s))
        while (answer := conversation.answer()) is None:
            yield Read(conversation.wait_s())
    finally:  # also after a cancellation or an interrupt
        conversation.give_up()
    return answer


def take_stale_input() -> Procedure[None]:
    """Hear what arrived before a request."""
    for _ in range(_STALE_READS):
        if not (yield Read(0.0)):
            return


def listen(core: RadarCore, done: Callable[[], bool], timeout_s: float) -> Procedure[bool]:
    """Hear what comes until ``done()``; False if that did not happen in time.

    What has come already is heard whatever the timeout.
    """
    deadline_ns = core.conversation.deadline_ns(timeout_s)
    left_s = timeout_s
    while not done():
        yield Read(left_s)
        left_s = core.left_s(deadline_ns)
        if left_s <= 0:
            return done()
    return True


def ping(core: RadarCore, timeout_s: float = TIMEOUT_S) -> Procedure[PongCode]:
    """Whether the module is ready, not ready, or in safe mode.

    Raises
    ------
    ResponseTimeout
        If nothing answers: probably no radar.
    RemoteProtocolError
        If the answer is none a XeThru module gives.
    """
    value = (yield from request(core, Ping(), timeout_s)).value
    try:
        return PongCode(value)
    except ValueError:
        raise RemoteProtocolError(
            f"{core.conversation.name} answered PING with 0x{value:08X}; no XeThru module does that"
        ) from None


def wait_until_ready(core: RadarCore, timeout_s: float = SLOW_TIMEOUT_S) -> Procedure[PongCode]:
    """Wait while the module says that it is not ready; return what it says then.

    Raises
    ------
    ResponseTimeout
        If it does not get ready in time, or says nothing.
    """
    deadline_ns = core.conversation.deadline_ns(timeout_s)
    while (state := (yield from ping(core))) is PongCode.XTS_SPRP_NOTREADY:
        if core.left_s(deadline_ns) <= 0:
            raise ResponseTimeout(
                f"{core.conversation.name} says it is not ready for {timeout_s:g} s; "
                "reset the module"
            )
        yield Read(0.1)
    return state


def info(core: RadarCore) -> Procedure[ModuleInfo]:
    """Ask for everything the module tells about itself."""
    texts = []
    for item in InfoItem:
        texts.append((yield from info_text(core, item)))  # noqa: PERF401 - comprehensions cannot yield
    try:
        values = (yield from request(core, GetMode())).values
        mode = next((m.label for m in SensorMode if values and m == values[0]), values.hex())
    except DeviceError:  # bare XEP firmware has no modes
        mode = None
    names = [field.name for field in fields(ModuleInfo)]
    return ModuleInfo(**dict(zip(names, [*texts, mode], strict=True)))


def info_text(core: RadarCore, item: InfoItem) -> Procedure[str | None]:
    """Ask for one item about the module; None if it refuses."""
    try:
        return (yield from request(core, SystemGetInfo(item=item))).text
    except DeviceError:
        return None


def x4_settings(core: RadarCore) -> Procedure[dict[X4Setting, X4Value | None]]:
    """Read every X4 setting that has a getter; None where the module refuses."""
    without_getter = {
        X4Setting.ENABLE,
        X4Setting.SPIREGISTER,
        X4Setting.PIFREGISTER,
        X4Setting.XIFREGISTER,
    }
    values: dict[X4Setting, X4Value | None] = {}
    for setting in X4Setting:
        if setting not in without_getter:
            try:
                values[setting] = yield from x4_get(core, setting)
            except DeviceError:
                values[setting] = None
    return values


def x4_get(core: RadarCore, setting: X4Setting) -> Procedure[X4Value]:
    """Read one X4 setting: a number, or the two ends of the frame area."""
    reply = yield from request(core, X4DriverGet(setting=setting))
    values = reply.values
    if not values:
        raise RemoteProtocolError(f"{core.conversation.name} reads back {setting.name} as nothing")
    if len(values) == 2 and isinstance(reply, ReplyFloat):
        return reply.values[0], reply.values[1]
    return values[0]


def set_mode_if_known(core: RadarCore, mode: SensorMode) -> Procedure[None]:
    """Change the mode; firmware without modes is always as in MANUAL."""
    try:
        yield from request(core, SetMode(mode=mode), SLOW_TIMEOUT_S)
    except DeviceError:
        core.conversation.tell("warning", f"the module does not know mode {mode.label}")


def set_baud_rate(core: RadarCore, baudrate: int, *, force: bool = False) -> Procedure[None]:
    """Change the rate of a UART on both sides; lines without a rate take it and change nothing.

    The module answers at the old rate and forgets the new one at a restart.

    Parameters
    ----------
    baudrate
        One of `BAUD_RATES`; any other only with ``force``, since a module acknowledges rates
        that it does not have.

    Raises
    ------
    LocalProtocolError
        If the module does not list the rate.
    ResponseTimeout
        If the module is silent at the new rate; this side is back at the old one then.

    Notes
    -----
    Protocol reference 4.10, 10, 16.
    """
    if baudrate not in BAUD_RATES and not force:
        raise LocalProtocolError(
            f"{baudrate} baud is no rate of a module; it has {', '.join(map(str, BAUD_RATES))}"
        )
    yield from request(core, SetBaudRate(baudrate=baudrate))
    before_s, after_s = _BAUD_SETTLE_S
    yield from listen(core, lambda: False, before_s)
    yield SetLineRate(baudrate)
    yield from listen(core, lambda: False, after_s)
    try:
        yield from ping(core)
    except ResponseTimeout:
        yield SetLineRate(core.baudrate)
        raise ResponseTimeout(
            f"{core.conversation.name} does not answer at {baudrate} baud; "
            f"this side is back at {core.baudrate}"
        ) from None
    core.baudrate = baudrate


# --- frames -------------------------------------------------------------------------------------


def wait_for_frame(core: RadarCore, timeout_s: float) -> Procedure[None]:
    """Wait until a frame can be taken from the queue.

    Raises
    ------
    ResponseTimeout
        If none comes in time.
    """
    frames = core.frames
    conversation = core.conversation
    deadline_ns = conversation.deadline_ns(timeout_s)
    left_s = timeout_s
    while not frames:
        yield Read(left_s)
        left_s = core.left_s(deadline_ns)
        if left_s <= 0 and not frames:
            if frames.last_counter is None:
                raise conversation.silence("frame", timeout_s)
            raise conversation.silence(
                f"frame after frame {frames.last_counter}",
                timeout_s,
                "did the module stop, or its recording end?",
            )


def stop(core: RadarCore) -> Procedure[None]:
    """Stop frames. One that was already on its way may still come."""
    yield from request(core, X4DriverSet(setting=X4Setting.FPS, value=0.0))


def real_rate(core: RadarCore, fps: float) -> Procedure[float]:
    """Start frames and return the rate the chip really runs at [Hz]."""
    yield from request(core, X4DriverSet(setting=X4Setting.FPS, value=fps))
    rate = yield from x4_get(core, X4Setting.FPS)
    if not isinstance(rate, float) or not 0 < rate < math.inf:
        raise RemoteProtocolError(
            f"{core.conversation.name} reads back frame rate {rate} after {fps:g} was set"
        )
    return x4.real_frame_rate(rate)
