"""The link to one module, without I/O: its state, and what the driver asks of the module.

Whatever needs the line is a generator: it yields steps and returns its result. `X4M300` carries
the steps out on a line that blocks, `AsyncX4M300` on one that is awaited. `raw_mode`, `profiles`,
`files` and `reconnect` hold more such generators.
"""

import math
from collections import deque
from collections.abc import Awaitable, Callable, Generator, Sequence
from dataclasses import dataclass, fields
from typing import Concatenate, NamedTuple, ParamSpec, Protocol, TypeAlias, TypeVar

from xethru_protocol.driver.conversation import FRAMES, Conversation, Observer
from xethru_protocol.driver.frames import FrameQueue, Lattice
from xethru_protocol.wire import messages as m
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import InfoItem, PongCode, SensorMode, X4Setting
from xethru_protocol.wire.errors import (
    DeviceError,
    LocalProtocolError,
    RemoteProtocolError,
    ResponseTimeout,
)
from xethru_protocol.wire.table import Command, Response


class Read(NamedTuple):  # several per frame: twice as fast to make as a frozen dataclass
    """Receive, waiting up to ``timeout_s`` for the first byte; the answer is whether any came."""

    timeout_s: float


@dataclass(frozen=True, slots=True)
class Write:
    """Send bytes."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Sleep:
    """Wait while there is no line."""

    seconds: float


@dataclass(frozen=True, slots=True)
class CloseLine:
    """Release the line."""


@dataclass(frozen=True, slots=True)
class OpenLine:
    """Close the line and open another; raises `PortUnavailable`."""

    path: str
    baudrate: int


@dataclass(frozen=True, slots=True)
class SetLineRate:
    """Change this side's baud rate; no effect on lines that have none."""

    baudrate: int


Step: TypeAlias = Read | Write | Sleep | CloseLine | OpenLine | SetLineRate
P = ParamSpec("P")
T = TypeVar("T")
Steps: TypeAlias = Generator[Step, bool, T]
ReplyT = TypeVar("ReplyT", bound=Response)


TIMEOUT_S = 2.0
SLOW_TIMEOUT_S = 10.0  # mode changes and chip restarts
BAUD_RATES = (
    *(9600, 19200, 38400, 115200, 230400, 460800, 500000, 576000, 921600),
    *(1000000, 2000000, 3000000, 4000000),
)

_STALE_READS = 64  # more than any port buffers; a bound, since a fast module never pauses
_BAUD_SETTLE_S = (0.1, 0.4)  # before and after the change, as the vendor's host waits
POWER_UP_BAUD = 115200  # a UART module's rate after every restart (Protocol reference 10)
_WARNINGS = 1000  # kept; a radar may run for months
_MESSAGES = 4096  # of a profile that wait unread: pulse-Doppler sends one per range bin


@dataclass(frozen=True, slots=True, kw_only=True)
class RawConfig:
    """Settings of raw radar mode; the defaults are those of the vendor's example.

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
        # the module does not check: it keeps the low bits of any number
        for name, value, smallest, largest in (
            ("iterations", self.iterations, 1, 255),
            ("pulses_per_step", self.pulses_per_step, 1, 65535),
            ("dac_step", self.dac_step, 0, 3),
            ("prf_div", self.prf_div, 4, 255),
        ):
            if not smallest <= value <= largest:
                raise LocalProtocolError(f"{name} must be {smallest} ... {largest}, not {value}")

    def settings(self) -> tuple[tuple[X4Setting, m.X4Value], ...]:
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
    """Answers to SYSTEM GET_INFO and GETMODE; None where it refuses. Protocol reference 4.10."""

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


class Plan(Protocol):
    """What the user configured."""

    def restore(self, link: "Link") -> Steps[None]:
        """Configure the module so again, after a reconnect."""


class Link:
    """The state of one driver: the conversation, the frames, and what the module was set to.

    Parameters
    ----------
    path, clock, observer, queue_frames, reconnect_s, candidates
        As of `X4M300`.

    Attributes
    ----------
    messages
        Messages of the running profile that were not taken yet; None: nobody reads them.
    home
        The path the user named; ``path`` is where the module is now.
    plan
        What to restore after a reconnect; None: nothing was configured.
    serial_number
        Of the module, None if it refuses to report it; known once ``identified``.
    baudrate
        Rate of a UART.
    bytes_per_s
        What the line carries at most; infinite if it has no known limit.
    raw_mode
        Whether this driver put the module into raw radar mode.
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
        self.plan: Plan | None = None
        self.identified = False
        self.serial_number: str | None = None
        self.baudrate = POWER_UP_BAUD
        self.bytes_per_s = math.inf
        self.reconnects = 0
        self.raw_mode = False
        self.closed = False

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

    @property
    def name(self) -> str:
        """What messages call the line."""
        return self.conversation.name

    def warn(self, text: str) -> None:
        if len(self.warnings) >= _WARNINGS:
            del self.warnings[0]
        self.warnings.append(text)
        self.conversation.report("warning", text)

    def left_s(self, deadline_ns: int) -> float:
        """Time until a deadline [s], negative when it is over."""
        return (deadline_ns - self.clock()) * 1e-9

    # --- commands ---------------------------------------------------------------------------------

    def request(self, command: Command[ReplyT], timeout_s: float = TIMEOUT_S) -> Steps[ReplyT]:
        if self.conversation.out_of_step and not isinstance(command, m.Ping):
            # the answer to an abandoned request may still come: all before this PONG is dropped
            yield from self._exchange(m.Ping(), timeout_s)
        reply = yield from self._exchange(command, timeout_s)
        # the conversation checked it: the row's replies are what ReplyT stands for
        return reply  # type: ignore[return-value]

    def _exchange(self, command: Command[Response], timeout_s: float) -> Steps[Response]:
        yield from self.take_stale_input()
        conversation = self.conversation
        try:
            yield Write(conversation.ask(command, timeout_s))
            while (answer := conversation.answer()) is None:
                yield Read(conversation.wait_s())
        finally:  # also after a cancellation or an interrupt
            conversation.give_up()
        return answer

    def take_stale_input(self) -> Steps[None]:
        for _ in range(_STALE_READS):
            if not (yield Read(0.0)):
                return

    def listen(self, done: Callable[[], bool], timeout_s: float) -> Steps[bool]:
        """Receive until ``done()``; False if that did not happen in time.

        What has come already is received whatever the timeout.
        """
        deadline_ns = self.conversation.deadline_ns(timeout_s)
        left_s = timeout_s
        while not done():
            yield Read(left_s)
            left_s = self.left_s(deadline_ns)
            if left_s <= 0:
                return done()
        return True

    def ping(self, timeout_s: float = TIMEOUT_S) -> Steps[PongCode]:
        value = (yield from self.request(m.Ping(), timeout_s)).value
        try:
            return PongCode(value)
        except ValueError:
            raise RemoteProtocolError(
                f"{self.name} answered PING with 0x{value:08X}; no XeThru module does that"
            ) from None

    def wait_until_ready(self, timeout_s: float = SLOW_TIMEOUT_S) -> Steps[PongCode]:
        """Wait until the module is ready or in safe mode; returns which.

        Raises
        ------
        ResponseTimeout
            If it is still not ready then, or does not answer.
        """
        deadline_ns = self.conversation.deadline_ns(timeout_s)
        while (state := (yield from self.ping())) is PongCode.XTS_SPRP_NOTREADY:
            if self.left_s(deadline_ns) <= 0:
                raise ResponseTimeout(
                    f"{self.name} has not been ready for {timeout_s:g} s; reset the module"
                )
            yield Read(0.1)
        return state

    def info(self) -> Steps[ModuleInfo]:
        texts = []
        for item in InfoItem:
            texts.append((yield from self.info_text(item)))  # noqa: PERF401 - comprehensions cannot yield
        try:
            values = (yield from self.request(m.GetMode())).values
            mode = next(
                (mode.label for mode in SensorMode if values and mode == values[0]), values.hex()
            )
        except DeviceError:  # bare XEP firmware has no modes
            mode = None
        names = [field.name for field in fields(ModuleInfo)]
        return ModuleInfo(**dict(zip(names, [*texts, mode], strict=True)))

    def info_text(self, item: InfoItem) -> Steps[str | None]:
        try:
            return (yield from self.request(m.SystemGetInfo(item=item))).text
        except DeviceError:
            return None

    def x4_settings(self) -> Steps[dict[X4Setting, m.X4Value | None]]:
        without_getter = {
            X4Setting.ENABLE,
            X4Setting.SPIREGISTER,
            X4Setting.PIFREGISTER,
            X4Setting.XIFREGISTER,
        }
        values: dict[X4Setting, m.X4Value | None] = {}
        for setting in X4Setting:
            if setting not in without_getter:
                try:
                    values[setting] = yield from self.x4_get(setting)
                except DeviceError:
                    values[setting] = None
        return values

    def x4_get(self, setting: X4Setting) -> Steps[m.X4Value]:
        """Read one X4 setting: a number, or the two ends of the frame area."""
        reply = yield from self.request(m.X4DriverGet(setting=setting))
        values = reply.values
        if not values:
            raise RemoteProtocolError(f"{self.name} reads back {setting.name} as nothing")
        if len(values) == 2 and isinstance(reply, m.ReplyFloat):
            return reply.values[0], reply.values[1]
        return values[0]

    def set_mode_if_known(self, mode: SensorMode) -> Steps[None]:
        """Change the mode; firmware without modes is always as in MANUAL."""
        try:
            yield from self.request(m.SetMode(mode=mode), SLOW_TIMEOUT_S)
        except DeviceError:
            self.conversation.report("warning", f"the module does not know mode {mode.label}")

    def set_baud_rate(self, baudrate: int, *, force: bool = False) -> Steps[None]:
        if baudrate not in BAUD_RATES and not force:
            raise LocalProtocolError(
                f"{baudrate} baud is no rate of a module; it has {', '.join(map(str, BAUD_RATES))}"
            )
        yield from self.request(m.SetBaudRate(baudrate=baudrate))
        before_s, after_s = _BAUD_SETTLE_S
        yield from self.listen(lambda: False, before_s)
        yield SetLineRate(baudrate)
        yield from self.listen(lambda: False, after_s)
        try:
            yield from self.ping()
        except ResponseTimeout:
            yield SetLineRate(self.baudrate)
            raise ResponseTimeout(
                f"{self.name} does not answer at {baudrate} baud; "
                f"this side is back at {self.baudrate}"
            ) from None
        self.baudrate = baudrate

    # --- frames -----------------------------------------------------------------------------------

    def wait_for_frame(self, timeout_s: float) -> Steps[None]:
        frames = self.frames
        conversation = self.conversation
        deadline_ns = conversation.deadline_ns(timeout_s)
        left_s = timeout_s
        while not frames:
            yield Read(left_s)
            left_s = self.left_s(deadline_ns)
            if left_s <= 0 and not frames:
                if frames.last_counter is None:
                    raise conversation.silence("frame", timeout_s)
                raise conversation.silence(
                    f"frame after frame {frames.last_counter}",
                    timeout_s,
                    "did the module stop, or its recording end?",
                )


Procedure: TypeAlias = Callable[Concatenate[Link, P], Steps[T]]


class Call(Protocol):
    """Carries a procedure of the link out and returns its result."""

    def __call__(self, procedure: Procedure[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T: ...


class AsyncCall(Protocol):
    """Carries a procedure of the link out; its result is awaited."""

    def __call__(
        self, procedure: Procedure[P, T], /, *args: P.args, **kwargs: P.kwargs
    ) -> Awaitable[T]: ...
