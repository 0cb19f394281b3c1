"""One link to a module: what is known of it, and the steps that a procedure asks of it.

A procedure is a generator that yields steps and returns its result. `X4M300` carries steps out on
a line that blocks, `AsyncX4M300` on one that does not; the procedures are the same.

Each procedure is a generator that yields steps for the line and returns its result; the first
argument is the driver's state. In the drivers it is a method of the same name.
"""

import math
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import NamedTuple, TypeAlias, TypeVar

from xethru_protocol.driver.conversation import FRAMES, Conversation, Observer
from xethru_protocol.driver.frames import FrameQueue, Lattice
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import InfoItem, PongCode, SensorMode, X4Setting
from xethru_protocol.wire.errors import (
    DeviceError,
    LocalProtocolError,
    RemoteProtocolError,
    ResponseTimeout,
)
from xethru_protocol.wire.messages import (
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


class Read(NamedTuple):  # several per frame: twice as fast to make as a frozen dataclass
    """Hear what comes, waiting up to ``timeout_s`` for its first byte; answered by whether any."""

    timeout_s: float


@dataclass(frozen=True, slots=True)
class Write:
    """Send bytes."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Sleep:
    """Wait while there is no line to hear from."""

    seconds: float


@dataclass(frozen=True, slots=True)
class CloseLine:
    """Release the line."""


@dataclass(frozen=True, slots=True)
class OpenLine:
    """Open a line in place of one that was closed; raises `PortUnavailable`."""

    path: str
    baudrate: int


@dataclass(frozen=True, slots=True)
class SetLineRate:
    """Change this side's baud rate; no effect on lines that have none."""

    baudrate: int


Step: TypeAlias = Read | Write | Sleep | CloseLine | OpenLine | SetLineRate
T = TypeVar("T")
Procedure: TypeAlias = Generator[Step, bool, T]


@dataclass(frozen=True, slots=True, kw_only=True)
class RawConfig:
    """Settings of raw radar mode; the defaults are the vendor's working point.

    ``frame_area_m`` and ``offset_m`` are module metres. ``dac_step`` 0 ... 3 means steps of
    1, 2, 4, 8 levels; ``prf_div`` divides the 243 MHz clock (16: the one regulators allow).
    Numbers the chip would cut to other ones raise `LocalProtocolError`. Protocol reference 4.9,
    9.3.
    """

    frame_area_m: tuple[float, float] = (0.2, 9.4)
    offset_m: float = x4.DEFAULT_OFFSET_M
    downconversion: bool = False
    iterations: int = 16
    pulses_per_step: int = 300
    dac_min: int = 949
    dac_max: int = 1100
    dac_step: int = 0
    prf_div: int = x4.DEFAULT_PRF_DIV
    tx_power: int = 2
    tx_center_frequency: int = 3

    def __post_init__(self) -> None:
        """Check what the module does not: it keeps the low bits of any number."""
        for name, value, smallest, largest in (
            ("iterations", self.iterations, 1, 255),
            ("pulses_per_step", self.pulses_per_step, 1, 65535),
            ("dac_step", self.dac_step, 0, 3),
            ("prf_div", self.prf_div, 4, 255),
        ):
            if not smallest <= value <= largest:
                raise LocalProtocolError(f"{name} must be {smallest} ... {largest}, not {value}")

    def settings(self) -> tuple[tuple[X4Setting, X4Value], ...]:
        """X4 settings in the order in which the vendor's recipe sends them, and two more."""
        return (
            (X4Setting.DACMIN, self.dac_min),
            (X4Setting.DACMAX, self.dac_max),
            (X4Setting.DACSTEP, self.dac_step),
            (X4Setting.ITERATIONS, self.iterations),
            (X4Setting.PULSESPERSTEP, self.pulses_per_step),
            (X4Setting.PRFDIV, self.prf_div),
            (X4Setting.TXCENTERFREQUENCY, self.tx_center_frequency),
            (X4Setting.TXPOWER, self.tx_power),
            (X4Setting.DOWNCONVERSION, int(self.downconversion)),
            (X4Setting.FRAMEAREAOFFSET, self.offset_m),
            (X4Setting.FRAMEAREA, self.frame_area_m),
        )

    def check_area(self) -> None:
        """Raise `LocalProtocolError` if a module would make no bin of the frame area."""
        area = x4.frame_area(*self.frame_area_m, self.offset_m, self.downconversion)
        if area.n_bins <= 0:
            start_m, end_m = self.frame_area_m
            nearest_m = self.offset_m - x4.COARSE_STEP_M + area.bin_length_m
            longest_m = area.requested_end_m - area.requested_start_m
            cut = (
                f", of which the module keeps {longest_m:.4f} m,"
                if end_m - start_m > longest_m
                else ""
            )
            raise LocalProtocolError(
                f"frame area {start_m:g} ... {end_m:g} m{cut} has no bins; what is kept must be at "
                f"least {area.bin_length_m:.4f} m long and end behind {nearest_m:.4f} m"
            )

    @property
    def fps_max(self) -> float:
        """Highest frame rate [Hz] these settings allow, with the recommended 5 % reserve."""
        return x4.fps_max(
            iterations=self.iterations,
            pulses_per_step=self.pulses_per_step,
            dac_min=self.dac_min,
            dac_max=self.dac_max,
            dac_step=self.dac_step,
            prf_div=self.prf_div,
        )

    @property
    def lattice(self) -> Lattice | None:
        """Samples these settings can give; None where that is not known."""
        try:
            return Lattice.of(
                iterations=self.iterations,
                pulses_per_step=self.pulses_per_step,
                dac_min=self.dac_min,
                dac_max=self.dac_max,
                dac_step=self.dac_step,
                downconversion=self.downconversion,
                tx_center_frequency=self.tx_center_frequency,
            )
        except LocalProtocolError:
            return None


@dataclass(frozen=True, slots=True, kw_only=True)
class ModuleInfo:
    """What a module tells about itself; None where it refuses to. Protocol reference 4.10."""

    item_number: str | None
    order_code: str | None
    firmware_id: str | None
    version: str | None
    build: str | None
    application_id_list: str | None
    serial_number: str | None
    version_list: str | None
    system_core_id: str | None
    bootloader: str | None
    mode: str | None


POWER_UP_BAUD = 115200  # a UART module's rate after every restart (Protocol reference 10)
_WARNINGS = 1000  # kept; a radar may run for months
_MESSAGES = 4096  # of a profile that wait unread: pulse-Doppler sends one per range bin


@dataclass(frozen=True, slots=True, kw_only=True)
class RawPlan:
    """Raw radar mode as the user wants it; ``fps`` None while stopped."""

    config: RawConfig
    fps: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ProfilePlan:
    """A profile as the user wants it.

    ``loaded`` is False if it was found running. ``settings`` holds the last command for each
    setting, by what it sets; ``mode`` is None before the profile was run.
    """

    profile_id: int
    loaded: bool
    settings: Mapping[object, Command[Response]] = field(default_factory=dict)
    mode: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """How a module is told from others; ``serial_number`` None if it refuses to say."""

    serial_number: str | None


class RadarCore:
    """The state of one driver: the conversation, the frames, and what the module was set to.

    Parameters
    ----------
    path
        Of the line, as the user named it.
    clock
        Monotonic time [ns].
    observer
        Called with every command, answer, SYSTEM message, fault and warning; None: nobody.
    queue_frames
        Frames that may wait unread before the oldest is dropped.
    reconnect_s
        How long to look for a module that vanished; 0: not at all.
    candidates
        Finds the ports at which a module that vanished may have come back.

    Attributes
    ----------
    warnings
        What was asked of the module although it is likely to fail, and what went wrong quietly;
        the last 1000.
    messages
        Messages of the running profile that were not taken yet; None: nobody wants them.
    home
        The path the user named; ``path`` is where the module is now.
    plan
        What to restore after a reconnect; None: nothing was configured.
    identity
        Which module this is; None: not asked yet.
    baudrate
        Rate of a UART.
    bytes_per_s
        What the line carries at most; infinite if it has no known limit.
    generation
        Counts the lines: a changed number says that somebody reconnected.
    reconnects
        Times a module that vanished was found again.
    raw_mode
        Whether this driver put the module into raw radar mode.
    closed
        Whether the user closed the driver.
    """

    def __init__(
        self,
        path: str,
        *,
        clock: Callable[[], int],
        observer: Observer | None,
        queue_frames: int,
        reconnect_s: float,
        candidates: Callable[[], Sequence[str]],
    ) -> None:
        self.home = self.path = path
        self.clock = clock
        self.reconnect_s = reconnect_s
        self.candidates = candidates
        self.warnings: list[str] = []
        self.conversation = Conversation(path, clock, observer, self._take)
        self.statistics = self.conversation.statistics
        self.frames = FrameQueue(queue_frames, self.statistics, self.warn)
        self.messages: deque[Response] | None = None
        self.messages_dropped = 0
        self.plan: RawPlan | ProfilePlan | None = None
        self.identity: Identity | None = None
        self.baudrate = POWER_UP_BAUD
        self.bytes_per_s = math.inf
        self.generation = 0
        self.reconnects = 0
        self.raw_mode = False
        self.closed = False

    @property
    def unlimited(self) -> bool:
        """Whether the line has no rate of its own."""
        return math.isinf(self.bytes_per_s)

    def _take(self, message: Response, arrival_ns: int) -> None:
        if isinstance(message, FRAMES):
            self.frames.take(message, arrival_ns)
        elif self.messages is not None:
            if len(self.messages) >= _MESSAGES:
                self.messages.popleft()
                if not self.messages_dropped:
                    self.warn(f"{_MESSAGES} messages wait unread, so the oldest are dropped")
                self.messages_dropped += 1
            self.messages.append(message)

    def warn(self, text: str) -> None:
        """Note what the user should know although nothing failed."""
        if len(self.warnings) >= _WARNINGS:
            del self.warnings[0]
        self.warnings.append(text)
        self.conversation.tell("warning", text)

    def left_s(self, deadline_ns: int) -> float:
        """Time until a deadline [s], negative when it is over."""
        return (deadline_ns - self.clock()) * 1e-9


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
