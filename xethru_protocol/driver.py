"""Driver of one X4M300: commands with their replies, and frames. Pull-driven, no threads.

The module answers commands in order and without sequence numbers, and sends frames and SYSTEM
messages whenever it likes (Protocol reference 3). Everything read is sorted at once: frames are
queued, answers go to the one outstanding request, the rest is counted and told to the observer.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from types import TracebackType
from typing import Literal, Self, TypeVar

from xethru_protocol import x4
from xethru_protocol.codec import describe
from xethru_protocol.codes import InfoItem, PongCode, SensorMode, SystemCode, X4Setting, error_name
from xethru_protocol.connection import Connection, Role
from xethru_protocol.errors import (
    DeviceError,
    LocalProtocolError,
    RemoteProtocolError,
    ResponseTimeout,
    XeThruError,
)
from xethru_protocol.frames import Frame, FrameGeometry, Samples, baseband, rf_or_baseband
from xethru_protocol.messages import (
    Ack,
    BasebandIq,
    Command,
    DataFloat,
    Error,
    GetMode,
    Message,
    ModReset,
    Ping,
    Pong,
    ReplyByte,
    ReplyFloat,
    ReplyInt,
    ReplyString,
    Response,
    SetMode,
    System,
    SystemGetInfo,
    X4DriverGet,
    X4DriverInit,
    X4DriverSet,
    X4Value,
)
from xethru_protocol.packets import NEED_DATA, FramingFault
from xethru_protocol.table import ROWS
from xethru_protocol.transport import SerialTransport, Transport

__all__ = [
    "X4M300",
    "Frame",
    "FrameGeometry",
    "ModuleInfo",
    "ProtocolRecord",
    "RawConfig",
]

_ANSWERS = (Ack, Error, Pong, ReplyByte, ReplyInt, ReplyFloat, ReplyString)
_TIMEOUT_S = 2.0
_SLOW_TIMEOUT_S = 10.0  # mode changes and chip restarts
_STALE_READS = 64  # more than any port buffers; a bound, since a fast module never pauses
_COUNTER_WRAP = 1 << 32

ReplyT = TypeVar("ReplyT", bound=Response)


@dataclass(frozen=True, slots=True, kw_only=True)
class RawConfig:
    """Settings of raw radar mode; the defaults are the vendor's working point.

    ``frame_area_m`` and ``offset_m`` are module metres. Protocol reference 4.9, 9.3.
    """

    frame_area_m: tuple[float, float] = (0.2, 9.4)
    offset_m: float = x4.DEFAULT_OFFSET_M
    downconversion: bool = False
    iterations: int = 16
    pulses_per_step: int = 300
    dac_min: int = 949
    dac_max: int = 1100
    tx_power: int = 2
    tx_center_frequency: int = 3

    def settings(self) -> tuple[tuple[X4Setting, X4Value], ...]:
        """X4 settings in the order in which the vendor's recipe sends them."""
        return (
            (X4Setting.DACMIN, self.dac_min),
            (X4Setting.DACMAX, self.dac_max),
            (X4Setting.ITERATIONS, self.iterations),
            (X4Setting.PULSESPERSTEP, self.pulses_per_step),
            (X4Setting.TXCENTERFREQUENCY, self.tx_center_frequency),
            (X4Setting.TXPOWER, self.tx_power),
            (X4Setting.DOWNCONVERSION, int(self.downconversion)),
            (X4Setting.FRAMEAREAOFFSET, self.offset_m),
            (X4Setting.FRAMEAREA, self.frame_area_m),
        )

    @property
    def fps_max(self) -> float:
        """Highest frame rate [Hz] these settings allow, with the recommended 5 % reserve."""
        return x4.fps_max(
            iterations=self.iterations,
            pulses_per_step=self.pulses_per_step,
            dac_min=self.dac_min,
            dac_max=self.dac_max,
        )


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


@dataclass(frozen=True, slots=True, kw_only=True)
class ProtocolRecord:
    """One line of the protocol log: everything on the wire but frames."""

    t_ns: int
    direction: Literal["tx", "rx", "fault", "warning"]
    summary: str


Observer = Callable[[ProtocolRecord], None]


class X4M300:
    """One module at the other end of a transport.

    Parameters
    ----------
    transport
        An open line.
    clock
        Monotonic time [ns].
    observer
        Called with every command, answer, SYSTEM message, fault and warning.

    Attributes
    ----------
    geometry
        Where the bins of the frames lie; None before `configure_raw`.
    fault_count
        Damaged places seen on the line.
    frames_lost
        Frames missing by the counters of those that came.
    frames_discarded
        Frames of a length that does not fit the geometry (left over from older settings).
    stray_count
        Answers that belong to no request.
    reboots
        SYSTEM BOOTING messages seen.
    warnings
        What was asked of the module although it is likely to fail.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        observer: Observer | None = None,
    ) -> None:
        self.geometry: FrameGeometry | None = None
        self.fault_count = 0
        self.frames_lost = 0
        self.frames_discarded = 0
        self.stray_count = 0
        self.reboots = 0
        self.warnings: list[str] = []
        self._transport = transport
        self._clock = clock
        self._observer = observer
        self._connection = Connection(Role.HOST)
        self._frames: deque[Frame] = deque()
        self._answers: deque[Response] = deque()
        self._config: RawConfig | None = None
        self._last_counter: int | None = None
        self._baseband_geometry: FrameGeometry | None = None
        self._raw_mode = False

    @classmethod
    def open(
        cls,
        path: str,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        observer: Observer | None = None,
    ) -> Self:
        """Driver on a serial port; `PortUnavailable` if it cannot be opened."""
        return cls(SerialTransport(path), clock=clock, observer=observer)

    def __enter__(self) -> Self:
        """Return self; `close` is called at the end."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close, also after an error."""
        self.close()

    def close(self) -> None:
        """Stop the radar if this driver configured it, and release the line."""
        try:
            if self._raw_mode:
                self._raw_mode = False
                self.stop()
                self.request(SetMode(mode=SensorMode.XTID_SM_STOP))
        except XeThruError as error:
            self._tell("warning", f"the module was not stopped: {error}")
        finally:
            self._transport.close()

    # --- commands -------------------------------------------------------------------------------

    def request(self, command: Command[ReplyT], timeout_s: float = _TIMEOUT_S) -> ReplyT:
        """Send a command and return the reply that its row in the message table names.

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
        self._take_stale_input()
        row = ROWS[type(command)]
        content_id = row.content_id(command) if row.content_id else None
        self._transport.write(self._connection.send(command))
        self._tell_message("tx", command)
        deadline = self._clock() + round(timeout_s * 1e9)
        while True:
            while self._answers:
                answer = self._answers.popleft()
                if isinstance(answer, Error):
                    is_x4 = row.name.startswith("X4")
                    meaning = error_name(answer.code, x4_command=is_x4)
                    raise DeviceError(answer.code, _summary(command), meaning)
                if isinstance(answer, row.replies) and (
                    content_id is None or getattr(answer, "content_id", None) == content_id
                ):
                    # isinstance checked it: the row's replies are what ReplyT stands for
                    return answer  # type: ignore[return-value]
                self.stray_count += 1
            left_ns = deadline - self._clock()
            if left_ns <= 0:
                raise ResponseTimeout(self._silence(f"answer to {_summary(command)}", timeout_s))
            self._pump(left_ns * 1e-9)

    def ping(self) -> PongCode:
        """Whether the module is ready, not ready, or in safe mode.

        Raises
        ------
        ResponseTimeout
            If nothing answers: probably no radar.
        RemoteProtocolError
            If the answer is none a XeThru module gives.
        """
        value = self.request(Ping()).value
        try:
            return PongCode(value)
        except ValueError:
            raise RemoteProtocolError(
                f"{self._transport.name} answered PING with 0x{value:08X}; "
                "no XeThru module does that"
            ) from None

    def info(self) -> ModuleInfo:
        """Ask for everything the module tells about itself."""
        texts = [self._info_text(item) for item in InfoItem]
        try:
            reply = self.request(GetMode()).values
            mode = next((m.label for m in SensorMode if reply and m == reply[0]), reply.hex())
        except DeviceError:  # bare XEP firmware has no modes
            mode = None
        names = [field.name for field in fields(ModuleInfo)]
        return ModuleInfo(**dict(zip(names, [*texts, mode], strict=True)))

    def x4_settings(self) -> dict[X4Setting, X4Value | None]:
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
                    values[setting] = self._get(setting)
                except DeviceError:
                    values[setting] = None
        return values

    def reset(self) -> None:
        """Restart the module; returns at its ACK. A USB port vanishes 0.5 s later."""
        self.request(ModReset())
        self._raw_mode = False

    def configure_raw(self, config: RawConfig | None = None) -> FrameGeometry:
        """Bring the module from any state to raw radar mode, stopped.

        Protocol reference 13. Returns the geometry as the module quantised it.

        Raises
        ------
        LocalProtocolError
            If the settings make no sense.
        DeviceError
            If the module refuses one.
        ResponseTimeout
            If the port is no radar.
        """
        config = config or RawConfig()
        x4.frame_area(*config.frame_area_m, config.offset_m, config.downconversion)  # may raise
        self._wait_until_ready()
        self._raw_mode = True
        self._set_mode_if_known(SensorMode.XTID_SM_STOP)
        self._set_mode_if_known(SensorMode.XTID_SM_MANUAL)
        self.request(X4DriverInit(), _SLOW_TIMEOUT_S)
        for setting, value in config.settings():
            self.request(X4DriverSet(setting=setting, value=value))
        area = self._get(X4Setting.FRAMEAREA)
        n_bins = self._get(X4Setting.FRAMEBINCOUNT)
        if not isinstance(area, tuple) or not isinstance(n_bins, int) or n_bins <= 0:
            raise RemoteProtocolError(
                f"{self._transport.name} reads back frame area {area} with {n_bins} bins"
            )
        self._config = config
        self.geometry = FrameGeometry.from_read_back(
            area_m=(area[0], area[1]), n_bins=n_bins, downconversion=config.downconversion
        )
        self._frames.clear()  # of older settings
        self._last_counter = None
        return self.geometry

    def start(self, fps: float) -> float:
        """Start frames at ``fps`` [Hz]; returns the rate the chip really runs at.

        A rate above what the settings allow is tried, with a warning: the firmware does not
        refuse it (Protocol reference 9.6).
        """
        if not fps > 0:
            raise LocalProtocolError(f"a frame rate must be positive, not {fps}; stop() stops")
        if self._config is not None and fps > self._config.fps_max:
            self._warn(
                f"{fps:g} frames/s exceed the {self._config.fps_max:.1f} that these settings "
                "allow; lower the rate, iterations or pulses per step"
            )
        self._last_counter = None
        self._raw_mode = True
        self.request(X4DriverSet(setting=X4Setting.FPS, value=fps))
        rate = self._get(X4Setting.FPS)
        if not isinstance(rate, float):
            raise RemoteProtocolError(f"{self._transport.name} reads back frame rate {rate}")
        return rate

    def stop(self) -> None:
        """Stop frames. One that was already on its way may still come."""
        self.request(X4DriverSet(setting=X4Setting.FPS, value=0.0))

    # --- frames ---------------------------------------------------------------------------------

    def read_frame(self, timeout_s: float = _TIMEOUT_S) -> Frame:
        """Next frame, in order of arrival.

        Raises
        ------
        ResponseTimeout
            If none comes in time.
        Disconnected
            If the line is gone.
        """
        if not self._frames:
            deadline = self._clock() + round(timeout_s * 1e9)
            while not self._frames:
                left_ns = deadline - self._clock()
                if left_ns <= 0:
                    raise ResponseTimeout(self._silence("frame", timeout_s))
                self._pump(left_ns * 1e-9)
        return self._frames.popleft()

    def frames(self, count: int | None = None, timeout_s: float = _TIMEOUT_S) -> Iterator[Frame]:
        """Iterate over frames; ``count`` of them, or without end."""
        while count is None or count > 0:
            yield self.read_frame(timeout_s)
            if count is not None:
                count -= 1

    # --- inside ---------------------------------------------------------------------------------

    def _pump(self, timeout_s: float) -> bool:
        """Read once and sort what came; False if nothing did."""
        data = self._transport.read(timeout_s)
        if not data:
            return False
        arrival_ns = self._clock()
        connection = self._connection
        connection.receive_data(data)
        while (event := connection.next_event()) is not NEED_DATA:
            if isinstance(event, DataFloat):
                self._take_radar_frame(event, arrival_ns)
            elif isinstance(event, BasebandIq):
                self._take_baseband(event, arrival_ns)
            elif isinstance(event, FramingFault):
                self.fault_count += 1
                self._tell("fault", f"{event.kind.value} at byte {event.offset}")
            elif isinstance(event, Message):
                if isinstance(event, _ANSWERS):
                    self._answers.append(event)
                elif isinstance(event, System) and event.code == SystemCode.XTS_SPRS_BOOTING:
                    self.reboots += 1
                self._tell_message("rx", event)
        return True

    def _take_radar_frame(self, message: DataFloat, arrival_ns: int) -> None:
        geometry = self.geometry
        samples = None if geometry is None else rf_or_baseband(message, geometry)
        if geometry is None or samples is None:
            self.frames_discarded += 1
            return
        self._queue_frame(message.info, samples, geometry, arrival_ns)

    def _take_baseband(self, message: BasebandIq, arrival_ns: int) -> None:
        geometry = FrameGeometry(
            range_start_m=message.range_offset_m,
            bin_length_m=message.bin_length_m,
            n_bins=message.num_bins,
            downconversion=True,
        )
        if geometry != self._baseband_geometry:
            self._baseband_geometry = geometry
        self._queue_frame(message.counter, baseband(message), self._baseband_geometry, arrival_ns)

    def _queue_frame(
        self, counter: int, samples: Samples, geometry: FrameGeometry, arrival_ns: int
    ) -> None:
        if self._last_counter is not None:
            missing = (counter - self._last_counter - 1) % _COUNTER_WRAP
            if missing < _COUNTER_WRAP // 2:  # else it went back: the chip was restarted
                self.frames_lost += missing
        self._last_counter = counter
        self._frames.append(
            Frame(counter=counter, samples=samples, geometry=geometry, arrival_ns=arrival_ns)
        )

    def _take_stale_input(self) -> None:
        """Sort what arrived before a request: an answer among it belongs to no request."""
        for _ in range(_STALE_READS):
            if not self._pump(0.0):
                break
        self.stray_count += len(self._answers)
        self._answers.clear()

    def _wait_until_ready(self) -> None:
        deadline = self._clock() + round(_SLOW_TIMEOUT_S * 1e9)
        while self.ping() is PongCode.XTS_SPRP_NOTREADY:
            if self._clock() >= deadline:
                raise ResponseTimeout(
                    f"{self._transport.name} says it is not ready for {_SLOW_TIMEOUT_S:g} s; "
                    "reset the module"
                )
            self._pump(0.1)

    def _set_mode_if_known(self, mode: SensorMode) -> None:
        try:
            self.request(SetMode(mode=mode), _SLOW_TIMEOUT_S)
        except DeviceError:  # bare XEP firmware has no modes and is always as in MANUAL
            self._tell("warning", f"the module does not know mode {mode.label}")

    def _get(self, setting: X4Setting) -> X4Value:
        reply = self.request(X4DriverGet(setting=setting))
        values = reply.values
        if not values:
            raise RemoteProtocolError(
                f"{self._transport.name} reads back {setting.name} as nothing"
            )
        if len(values) == 2 and isinstance(reply, ReplyFloat):
            return reply.values[0], reply.values[1]
        return values[0]

    def _info_text(self, item: InfoItem) -> str | None:
        try:
            return self.request(SystemGetInfo(item=item)).text
        except DeviceError:
            return None

    def _silence(self, what: str, timeout_s: float) -> str:
        name = self._transport.name
        if self.reboots:
            return f"no {what} from {name} within {timeout_s:g} s: the module restarted meanwhile"
        if self.fault_count:
            return (
                f"no {what} from {name} within {timeout_s:g} s, but {self.fault_count} times bytes "
                "that are no XeThru packet; is it another device, or another baud rate?"
            )
        return (
            f"no {what} from {name} within {timeout_s:g} s; "
            "is it an X4M300, powered and not in its bootloader?"
        )

    def _warn(self, text: str) -> None:
        self.warnings.append(text)
        self._tell("warning", text)

    def _tell_message(self, direction: Literal["tx", "rx"], message: Message) -> None:
        if self._observer is not None:
            self._tell(direction, _summary(message))

    def _tell(self, direction: Literal["tx", "rx", "fault", "warning"], summary: str) -> None:
        if self._observer is not None:
            self._observer(ProtocolRecord(t_ns=self._clock(), direction=direction, summary=summary))


def _summary(message: Message) -> str:
    name, shown = describe(message)
    return " ".join(
        [name, *(f"{key}={value}" for key, value in shown.items() if value is not None)]
    )
