"""The link to one module, without I/O: its state, and what the driver asks of the module.

Whatever needs the line is a generator: it yields steps and returns its result. `X4M300` carries
the steps out on a line that blocks, `AsyncX4M300` on one that is awaited. `raw_mode`, `profiles`,
`files` and `reconnect` hold more such generators.
"""

import functools
import inspect
import math
from collections import defaultdict, deque
from collections.abc import Callable, Coroutine, Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from types import NoneType
from typing import (
    Any,
    Concatenate,
    Generic,
    NamedTuple,
    ParamSpec,
    Protocol,
    SupportsFloat,
    TypeAlias,
    TypeVar,
    get_args,
    overload,
)

from xethru_protocol.driver.frames import Frame, FrameQueue, Lattice
from xethru_protocol.driver.matching import (
    FRAMES,
    Conversation,
    Observer,
    bootloader_error,
    summary,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import (
    BAUD_RATES,
    POWER_UP_BAUD,
    ErrorCode,
    InfoItem,
    PongCode,
    SensorMode,
    SystemCode,
    X4Setting,
    error_name,
)
from xethru_protocol.wire.errors import (
    DeviceError,
    Disconnected,
    LocalProtocolError,
    OldFirmwareError,
    RemoteProtocolError,
    ResponseTimeout,
)
from xethru_protocol.wire.sharing import SETTINGS_CHANGE
from xethru_protocol.wire.table import ROWS, Command, Response
from xethru_protocol.wire.versions import STOP_WITHOUT_PROFILE, FirmwareVersions, needed_by


class Read(NamedTuple):  # several per frame: twice as fast to make as a frozen dataclass
    """Receive, waiting up to ``timeout_s`` for the first byte; the answer is whether any came."""

    timeout_s: float


@dataclass(frozen=True, slots=True)
class Write:
    """Send bytes."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Sleep:
    """Wait while the line is closed."""

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


class Gate(Protocol):
    """`threading.Event` or `asyncio.Event`."""

    def set(self) -> None: ...


@dataclass(frozen=True, slots=True)
class AwaitGate:
    """Wait up to ``timeout_s`` until a gate is set."""

    gate: Any
    timeout_s: float


Step: TypeAlias = Read | Write | Sleep | CloseLine | OpenLine | SetLineRate | AwaitGate
P = ParamSpec("P")
T = TypeVar("T")
Steps: TypeAlias = Generator[Step, bool, T]
ReplyT = TypeVar("ReplyT", bound=Response)


TIMEOUT_S = 2.0
SLOW_TIMEOUT_S = 10.0  # mode changes and chip restarts

_STALE_READS = 64  # more than any port buffers; a bound, since a fast module never pauses
# The module changes its rate 500 ms after its ACK and hears nothing until then (Protocol
# reference 3); the vendor's host waits 100 ms before its own change and 400 ms behind it.
_BAUD_SETTLE_S = (0.1, 0.45)
_BAUD_PROBE_S = 0.3  # one PING at a rate that may not be the module's
_BAUD_PROBES_NEW, _BAUD_PROBES_OLD = 7, 3
_LIKELIEST_RATES = (
    *(115200, 921600, 460800, 230400, 1000000, 2000000, 3000000, 4000000),
    *(500000, 576000, 38400, 19200, 9600),
)
_WARNINGS = 1000  # kept; a radar may run for months
_MESSAGES = 4096  # of a profile that wait unread: pulse-Doppler sends one per range bin


CONFIG_SETTINGS = {
    "dac_min": X4Setting.DACMIN,
    "dac_max": X4Setting.DACMAX,
    "dac_step": X4Setting.DACSTEP,
    "iterations": X4Setting.ITERATIONS,
    "pulses_per_step": X4Setting.PULSESPERSTEP,
    "prf_div": X4Setting.PRFDIV,
    "tx_center_frequency": X4Setting.TXCENTERFREQUENCY,
    "tx_power": X4Setting.TXPOWER,
    "downconversion": X4Setting.DOWNCONVERSION,
    "offset_m": X4Setting.FRAMEAREAOFFSET,
    "frame_area_m": X4Setting.FRAMEAREA,
}
"""Fields of `RawConfig`, in the order of the vendor's recipe, which lacks two of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RawConfig:
    """Settings of raw radar mode; the defaults are those of the vendor's example.

    ``frame_area_m`` and ``offset_m`` are module metres. ``offset_m`` None keeps the calibration
    of the module's own antenna; another value moves every range. ``dac_step`` 0 ... 3 means steps
    of 1, 2, 4, 8 levels; ``prf_div`` divides the 243 MHz clock (16: the one regulators allow).
    Numbers outside `x4.LIMITS`, and ``dac_min`` above ``dac_max``, raise `LocalProtocolError`.
    Protocol reference 4.9, 9.3.
    """

    frame_area_m: tuple[float, float] = (0.2, 9.4)
    offset_m: float | None = None
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
        for name, setting in CONFIG_SETTINGS.items():
            if setting in x4.LIMITS:
                x4.check_setting(setting, name, getattr(self, name))
        if self.dac_min > self.dac_max:
            raise LocalProtocolError(
                f"dac_min {self.dac_min} is above dac_max {self.dac_max}, so no threshold lies "
                "between them; to move both up, set dac_max first"
            )

    def check_rate(self, fps: float) -> None:
        """Raise `LocalProtocolError` if a sweep takes longer than a frame at this rate [Hz]."""
        highest: float = self.fps_max / x4.SWEEP_SHARE
        if x4.real_frame_rate(fps) > highest:
            thresholds = (self.dac_max - self.dac_min + 1) / 2**self.dac_step
            raise LocalProtocolError(
                f"{fps:g} frames/s cannot be: a sweep of {self.iterations} iterations x "
                f"{self.pulses_per_step} pulses x {thresholds:g} thresholds takes "
                f"{1e3 / highest:.1f} ms, so there are at most {highest:.1f}/s"
            )

    def settings(self) -> tuple[tuple[X4Setting, m.X4Value], ...]:
        """X4 settings in the order in which they are sent; None keeps what the module has."""
        values = ((setting, getattr(self, name)) for name, setting in CONFIG_SETTINGS.items())
        return tuple(
            (setting, int(value) if isinstance(value, bool) else value)
            for setting, value in values
            if value is not None
        )

    def area(self, offset_m: float) -> x4.FrameArea:
        """Return the frame area as a module with this offset [module metres] quantises it.

        Raises `LocalProtocolError` if it would make no bin of it, or lies too far away.
        """
        farthest_m = offset_m + x4.MOST_COARSE_STEPS * x4.COARSE_STEP_M
        if self.frame_area_m[0] >= farthest_m:
            raise LocalProtocolError(
                f"frame area {self.frame_area_m[0]:g} ... {self.frame_area_m[1]:g} m begins behind "
                f"{farthest_m:.1f} m, where the chip's delay begins at 0 again"
            )
        area = x4.frame_area(*self.frame_area_m, offset_m, self.downconversion)
        if area.n_bins <= 0:
            start_m, end_m = self.frame_area_m
            nearest_m = offset_m - x4.COARSE_STEP_M + area.bin_length_m
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
        return area

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


class Turn:
    """A place among those who wait for the same thing: first come, first served.

    ``line`` are their gates; that of the first may be None, since it need not wait.
    """

    def __init__(self, line: deque[Gate | None], make_gate: Callable[[], Gate]) -> None:
        self.line = line
        self.gate = make_gate() if line else None

    def __enter__(self) -> "Turn":
        self.line.append(self.gate)
        return self

    def __exit__(self, *error: object) -> None:
        self.line.remove(self.gate)
        if self.line and (first := self.line[0]) is not None:
            first.set()

    def come(self, left_s: Callable[[], float]) -> Steps[None]:
        """Wait until it is this one's turn, or no time is left."""
        while self.line[0] is not self.gate and (timeout_s := left_s()) > 0:
            yield AwaitGate(self.gate, timeout_s)


_BOOTLOADER_REPLIES = ((m.BootloaderSuccess,), (m.BootloaderEchoed,))


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
    make_gate
        Makes what a thread or task of the driver waits for.

    Attributes
    ----------
    messages
        Messages that were not taken yet: those of the running profile, if they are read,
        and texts (DATA STRING) always.
    keeps_messages
        Whether a profile's messages are read.
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
    attached
        Whether its frames come for another program, which may change their geometry.
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
        make_gate: Callable[[], Gate],
    ) -> None:
        self.home = self.path = path
        self.clock = clock
        self.reconnect_s = reconnect_s
        self.candidates = candidates
        self.warnings: list[str] = []
        self.conversation = Conversation(path, clock, observer, self._take)
        self.statistics = self.conversation.statistics
        self.frames = FrameQueue(queue_frames, self.statistics, self.warn)
        self.messages: deque[Response] = deque()
        self.keeps_messages = False
        self.messages_dropped = 0
        self.plan: Plan | None = None
        self.identified = False
        self.serial_number: str | None = None
        self.baudrate = POWER_UP_BAUD
        self.bytes_per_s = math.inf
        self.reconnects = 0
        self.raw_mode = False
        self.attached = False
        self.closed = False
        self._make_gate = make_gate
        self._lines: defaultdict[type, deque[Gate | None]] = defaultdict(deque)
        self._version_list: tuple[tuple[int, int], str | None] | None = None  # and of which start
        self._warned = False  # of frames whose geometry is not known

    def receive(self, data: bytes, arrival_ns: int) -> None:
        """Sort what the line gave."""
        try:
            self.conversation.receive(data, arrival_ns)
        finally:
            self.frames.judge()

    def _take(self, message: Response, arrival_ns: int) -> None:
        if isinstance(message, FRAMES):
            self.frames.take(message, arrival_ns)
            return
        if isinstance(message, m.System) and message.code == SystemCode.XTS_SPRS_BOOTING:
            self.frames.restart()
            self._lose_geometry("the module restarted")
        if isinstance(message, m.DataString) and message.text == SETTINGS_CHANGE:
            self._lose_geometry(message.text)
        if self.keeps_messages or isinstance(message, m.DataString):
            if len(self.messages) >= _MESSAGES:
                self.messages.popleft()
                if not self.messages_dropped:
                    self.warn(f"{_MESSAGES} messages wait unread, so the oldest are dropped")
                self.messages_dropped += 1
            self.messages.append(message)
        elif isinstance(message, m.RadarMessage):
            name = ROWS[type(message)].name
            self.frames.discard(f"{name} comes, which read_message() and messages() return")

    def _lose_geometry(self, why: str) -> None:
        if self.attached:
            self.attached = False
            self.frames.geometry = self.plan = None
            self.warn(f"{why}, so where the bins of later frames lie is not known; attach again")

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
        if self.conversation.matcher.answer_owed and not isinstance(command, m.Ping):
            yield from self._catch_up(command, timeout_s)
        yield from self._check_version(command)
        reply = yield from self._exchange(command, timeout_s)
        # the conversation checked it: the row's replies are what ReplyT stands for
        return reply  # type: ignore[return-value]  # matched by the kind that is asked for

    def _catch_up(self, command: Command[Response], timeout_s: float) -> Steps[None]:
        """Receive until answers to an abandoned request can no longer come."""
        matcher = self.conversation.matcher
        if ROWS[type(command)].replies in _BOOTLOADER_REPLIES:  # the bootloader does not have PING
            echo = m.BootloaderEcho(data=self.clock().to_bytes(8, "little"))
            with suppress(DeviceError):  # it is the application that answers
                yield from self._exchange(echo, timeout_s)
        elif matcher.pongs_possible:
            yield from self._exchange(matcher.token(), timeout_s, as_token=True)
        else:
            yield from self._exchange(m.Ping(), timeout_s)

    def _exchange(
        self, command: Command[Response], timeout_s: float, *, as_token: bool = False
    ) -> Steps[Response]:
        yield from self.take_stale_input()
        conversation, matcher = self.conversation, self.conversation.matcher
        try:
            yield Write(conversation.ask(command, timeout_s, as_token=as_token))
            deadline_ns = until_ns = conversation.deadline_ns(timeout_s)
            while True:
                patience_s = matcher.match()
                if patience_s is not None:
                    until_ns = min(deadline_ns, conversation.deadline_ns(patience_s))
                left_s = self.left_s(until_ns)
                if left_s <= 0:
                    break
                yield Read(left_s)
        finally:  # also after a cancellation or an interrupt
            matcher.expected = ()
        answer = matcher.answer
        if answer is None:
            raise conversation.unanswered(command, timeout_s)
        matcher.settle()
        if isinstance(answer, m.Error):
            meaning = error_name(answer.code, ROWS[type(command)].errors)
            # the reason, where the module gives one (Protocol reference 4.1)
            meaning = ": ".join(filter(None, (meaning, conversation.text)))
            raise DeviceError(answer.code, summary(command), meaning)
        if isinstance(answer, m.BOOTLOADER_ERRORS):
            raise bootloader_error(answer, command)
        self._follow(command)
        return answer

    def _follow(self, command: Command[Response]) -> None:
        """Note what a command that was carried out does to the frames. Protocol reference 6.1."""
        match command:
            case m.X4DriverInit() | m.ModReset() | m.X4DriverSet(setting=X4Setting.ENABLE):
                self.frames.rate_hz = 0.0
                self.frames.restart()
                if isinstance(command, m.ModReset):
                    self.conversation.begin()
            case m.LoadApp():
                self.frames.rate_hz = None
                self.frames.restart()
            case m.X4DriverSet(setting=X4Setting.FPS, value=SupportsFloat() as value):
                rate = float(value)  # also of whole numbers and numpy's
                self.frames.rate_hz = x4.real_frame_rate(rate) if rate > 0 else 0.0

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

    def mode(self) -> Steps[SensorMode]:
        values = (yield from self.request(m.GetMode())).values
        if len(values) != 1 or values[0] not in set(SensorMode):
            raise RemoteProtocolError(f"{self.name} reports mode {values.hex() or 'nothing'}")
        return SensorMode(values[0])

    def info_text(self, item: InfoItem) -> Steps[str | None]:
        try:
            text = (yield from self.request(m.SystemGetInfo(item=item))).text
        except (DeviceError, OldFirmwareError):
            text = None
        if item is InfoItem.XTID_SSIC_VERSIONLIST:
            self._version_list = self._start, text
        return text

    @property
    def _start(self) -> tuple[int, int]:
        """What changes when the module restarts, perhaps with other firmware."""
        return self.conversation.reboots, self.reconnects

    def firmware(self) -> Steps[FirmwareVersions]:
        """Return the versions of what runs on the module; asked for once, empty if it refuses."""
        if self._version_list is None or self._version_list[0] != self._start:
            try:
                yield from self.info_text(InfoItem.XTID_SSIC_VERSIONLIST)
            except RemoteProtocolError:  # what is wrong will show where it matters
                self._version_list = self._start, None
        text = None if self._version_list is None else self._version_list[1]
        return FirmwareVersions() if text is None else FirmwareVersions.of_list(text)

    def _check_version(self, command: Command[Response]) -> Steps[None]:
        """Raise `OldFirmwareError` for a command that the module's firmware does not know.

        Firmware between two releases may have it already: it answers for itself.
        """
        needed = needed_by(command)
        if not needed:
            return
        firmware = yield from self.firmware()
        if not firmware.is_released:
            return
        for row in needed:
            if not row.is_in(firmware):
                raise OldFirmwareError(
                    f"{summary(command)} needs {row.since} or newer ({row.topic}); "
                    f"{self.name} has {firmware.name}: update it"
                )

    def x4_get(self, setting: X4Setting) -> Steps[m.X4Value]:
        """Read one X4 setting: a number, or the two ends of the frame area."""
        reply = yield from self.request(m.X4DriverGet(setting=setting))
        values = reply.values
        if not values:
            raise RemoteProtocolError(f"{self.name} reads back {setting.name} as nothing")
        if len(values) == 2 and isinstance(reply, m.ReplyFloat):
            return reply.values[0], reply.values[1]
        return values[0]

    def numbers(self, command: Command[Any], count: int) -> Steps[Any]:
        """Ask for so many values; `RemoteProtocolError` if there are more or fewer."""
        values = (yield from self.request(command)).values
        if len(values) != count:
            raise RemoteProtocolError(
                f"{self.name} answers {summary(command)} with {values}, where {count} numbers were "
                "expected"
            )
        return values

    def set_mode_if_known(self, mode: SensorMode) -> Steps[None]:
        """Change the mode; firmware without modes is always as in MANUAL."""
        try:
            if mode is SensorMode.XTID_SM_STOP:
                yield from self.stop_profile()
            else:
                yield from self.request(m.SetMode(mode=mode), SLOW_TIMEOUT_S)
        except DeviceError as error:
            if error.code != ErrorCode.XTS_SPRE_NOT_RECOGNIZED:  # bare XEP, Protocol reference 8.3
                self.conversation.report("warning", str(error))

    def stop_profile(self) -> Steps[None]:
        """Change to mode STOP, which old firmware without a profile does not answer."""
        try:
            yield from self.request(m.SetMode(mode=SensorMode.XTID_SM_STOP), SLOW_TIMEOUT_S)
        except ResponseTimeout:
            if STOP_WITHOUT_PROFILE.is_in((yield from self.firmware())):
                raise

    def set_baud_rate(self, baudrate: int, *, force: bool = False) -> Steps[None]:
        if baudrate not in BAUD_RATES and not force:
            raise LocalProtocolError(
                f"{baudrate} baud is not a rate of a module; it has "
                f"{', '.join(map(str, BAUD_RATES))}"
            )
        old = self.baudrate
        yield from self.request(m.SetBaudRate(baudrate=baudrate))
        before_s, after_s = _BAUD_SETTLE_S
        yield from self.listen(lambda: False, before_s)
        yield SetLineRate(baudrate)
        self.baudrate = baudrate
        yield from self.listen(lambda: False, after_s)
        if (yield from self._probe(_BAUD_PROBES_NEW)):
            return
        yield SetLineRate(old)
        if (yield from self._probe(_BAUD_PROBES_OLD)):
            self.baudrate = old
            raise ResponseTimeout(
                f"{self.name} acknowledged {baudrate} baud and still answers at {old}; "
                f"this side is back at {old}"
            )
        yield SetLineRate(baudrate)
        raise ResponseTimeout(
            f"{self.name} answers neither at {baudrate} nor at {old} baud; this side stays at "
            f"{baudrate}. Can line and adapter carry that? A module that is switched off and on "
            f"answers at {POWER_UP_BAUD}"
        )

    def find_baud_rate(self) -> Steps[int | None]:
        for baudrate in _LIKELIEST_RATES:
            try:
                yield SetLineRate(baudrate)
            except Disconnected:  # the adapter does not have this rate
                continue
            self.conversation.new_line(self.path)  # what came at a wrong rate means nothing
            self.baudrate = baudrate
            if (yield from self._probe(1)):
                return baudrate
        yield SetLineRate(POWER_UP_BAUD)
        self.baudrate = POWER_UP_BAUD
        return None

    def _probe(self, times: int) -> Steps[bool]:
        """Whether the module answers one of some PINGs, of which it may not hear the first."""
        for _ in range(times):
            try:
                yield from self.ping(_BAUD_PROBE_S)
            except ResponseTimeout:
                continue
            return True
        return False

    # --- frames -----------------------------------------------------------------------------------

    def next_frame(self, timeout_s: float) -> Steps[Frame]:
        frames = self.frames
        if frames and not self._lines[Frame]:
            return frames.pop()
        began_ns, discarded = self.clock(), frames.discarded
        with self.turn(Frame) as turn:
            if turn.gate is None:
                yield Read(timeout_s)
            if not frames or turn.gate is not None:
                # a frame takes two reads at most, unless the line is slow
                yield from self._await_frame(turn, timeout_s, began_ns, discarded)
            return frames.pop()

    def turn(self, kind: type) -> Turn:
        """Return the last place among those who wait for a kind of message."""
        return Turn(self._lines[kind], self._make_gate)

    def _await_frame(
        self, turn: Turn, timeout_s: float, began_ns: int, discarded: int
    ) -> Steps[None]:
        frames = self.frames
        conversation = self.conversation
        deadline_ns = conversation.deadline_ns(timeout_s, began_ns)
        yield from turn.come(lambda: self.left_s(deadline_ns))
        left_s = self.left_s(deadline_ns)
        while not frames:
            if left_s > 0:
                yield Read(left_s)
            if frames.discarded > discarded and frames.geometry is None and not self._warned:
                self._warned = True
                self.warn(frames.misfit)
            left_s = self.left_s(deadline_ns)
            if left_s <= 0 and not frames:
                if frames.discarded > discarded:
                    raise conversation.silence("frame", timeout_s, frames.misfit)
                if not frames.rate_hz and frames.last_counter is None:
                    raise conversation.silence(
                        "frame",
                        timeout_s,
                        "was the radar started, by start(fps) or by a profile that sends "
                        "BASEBAND_IQ?",
                    )
                if frames.last_counter is None:
                    raise conversation.silence("frame", timeout_s)
                raise conversation.silence(
                    f"frame after frame {frames.last_counter}",
                    timeout_s,
                    "did the module stop, or its recording end?",
                )


Procedure: TypeAlias = Callable[Concatenate[Link, P], Steps[T]]
"""What carries a procedure out is a driver, from its arguments but for the link."""


class Blocking:
    """Marks a driver, and its parts, whose methods return when they are done."""


class Awaited:
    """Marks a driver, and its parts, whose methods are coroutines."""


KindT = TypeVar("KindT")


class Part(Generic[KindT]):
    """A driver, or something that it consists of."""

    __slots__ = ("_driver",)

    def __init__(self, driver: "Part[KindT]") -> None:
        self._driver: Any = driver
        """Has `_call`, `_call_once` and `_listen`, which carry procedures out."""


class Method(Generic[P, T]):
    """A procedure as a method of both drivers or of a part of both, with its docstring.

    ``carry_out`` is the driver's method that carries it out.
    """

    def __init__(self, procedure: Procedure[P, T], carry_out: str) -> None:
        def blocking(self: Part[Blocking], *args: P.args, **kwargs: P.kwargs) -> T:
            result: T = getattr(self._driver, carry_out)(procedure, *args, **kwargs)
            return result

        async def awaited(self: Part[Awaited], *args: P.args, **kwargs: P.kwargs) -> T:
            result: T = await getattr(self._driver, carry_out)(procedure, *args, **kwargs)
            return result

        signature = inspect.signature(procedure)
        link, *others = signature.parameters.values()
        parameters = [link.replace(name="self", annotation=link.empty), *others]
        *_, result = get_args(signature.return_annotation)  # of its steps
        result = None if result is NoneType else result
        signature = signature.replace(parameters=parameters, return_annotation=result)
        functions: list[Any] = [blocking, awaited]
        for function in functions:
            functools.update_wrapper(function, procedure)
            function.__signature__ = signature
            function.__annotations__ = {one.name: one.annotation for one in others}
            function.__annotations__["return"] = result
        self._blocking, self._awaited = blocking, awaited

    @overload
    def __get__(self, part: None, owner: type) -> Callable[Concatenate[Any, P], Any]: ...
    @overload
    def __get__(self, part: Part[Blocking], owner: type) -> Callable[P, T]: ...
    @overload
    def __get__(self, part: Part[Awaited], owner: type) -> Callable[P, Coroutine[Any, Any, T]]: ...
    def __get__(self, part: Part[Any] | None, owner: type) -> Any:
        is_awaited = getattr(owner if part is None else part._driver, "_is_awaited", False)
        return (self._awaited if is_awaited else self._blocking).__get__(part, owner)


def sends(procedure: Procedure[P, T]) -> Method[P, T]:
    """Make a method of a procedure that sends commands; it is repeated after a reconnect."""
    return Method(procedure, "_call")


def sends_once(procedure: Procedure[P, T]) -> Method[P, T]:
    """Make a method of a procedure that sends commands; a broken line raises `Disconnected`."""
    return Method(procedure, "_call_once")


def receives(procedure: Procedure[P, T]) -> Method[P, T]:
    """Make a method of a procedure that only receives, perhaps beside one that sends."""
    return Method(procedure, "_listen")
