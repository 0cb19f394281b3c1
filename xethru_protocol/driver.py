"""Driver of one X4M300: raw radar mode, frames, what the module tells. Pull-driven, no threads."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import fields
from types import TracebackType
from typing import Self, TypeVar

from xethru_protocol import x4
from xethru_protocol.codes import InfoItem, PongCode, SensorMode, X4Setting
from xethru_protocol.dialogue import Dialogue, Observer, ProtocolRecord
from xethru_protocol.errors import (
    DeviceError,
    LocalProtocolError,
    RemoteProtocolError,
    ResponseTimeout,
    XeThruError,
)
from xethru_protocol.frame_queue import FrameQueue
from xethru_protocol.frames import Frame, FrameGeometry
from xethru_protocol.messages import (
    Command,
    GetMode,
    ModReset,
    Ping,
    ReplyFloat,
    Response,
    SetMode,
    SystemGetInfo,
    X4DriverGet,
    X4DriverInit,
    X4DriverSet,
    X4Value,
)
from xethru_protocol.raw_config import ModuleInfo, RawConfig
from xethru_protocol.transport import SerialTransport, Transport

__all__ = [
    "X4M300",
    "Frame",
    "FrameGeometry",
    "ModuleInfo",
    "Observer",
    "ProtocolRecord",
    "RawConfig",
]

_TIMEOUT_S = 2.0
_SLOW_TIMEOUT_S = 10.0  # mode changes and chip restarts

ReplyT = TypeVar("ReplyT", bound=Response)


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
        self.warnings: list[str] = []
        self._transport = transport
        self._clock = clock
        self._frames = FrameQueue()
        self._dialogue = Dialogue(transport, clock, observer, self._frames.take)
        self._config: RawConfig | None = None
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
                self._dialogue.wind_down()
                self.stop()
                self.request(SetMode(mode=SensorMode.XTID_SM_STOP))
        except XeThruError as error:
            self._warn(f"the module was not stopped: {error}")
        finally:
            self._transport.close()

    @property
    def geometry(self) -> FrameGeometry | None:
        """Where the bins of the radar frames lie; None before `configure_raw`."""
        return self._frames.geometry

    @geometry.setter
    def geometry(self, geometry: FrameGeometry | None) -> None:
        self._frames.geometry = geometry

    @property
    def frames_lost(self) -> int:
        """Frames missing by the counters of those that came."""
        return self._frames.lost

    @property
    def frames_discarded(self) -> int:
        """Data that are no frame of the geometry, such as frames of older settings."""
        return self._frames.discarded

    @property
    def fault_count(self) -> int:
        """Damaged places seen on the line."""
        return self._dialogue.fault_count

    @property
    def stray_count(self) -> int:
        """Answers seen that belong to no request."""
        return self._dialogue.stray_count

    @property
    def reboots(self) -> int:
        """SYSTEM BOOTING messages seen."""
        return self._dialogue.reboots

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
        return self._dialogue.request(command, timeout_s)

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
        config.check_area()
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
        geometry = FrameGeometry.from_read_back(
            area_m=(area[0], area[1]), n_bins=n_bins, downconversion=config.downconversion
        )
        self._frames.new_stream()  # those that wait are of older settings
        self._frames.geometry = geometry
        return geometry

    def start(self, fps: float) -> float:
        """Start frames at ``fps`` [Hz]; returns the rate the chip really runs at.

        Frames of an earlier stream that were not read yet are dropped.

        A rate above what the settings allow is tried, with a warning: the firmware does not
        refuse it (Protocol reference 9.6).
        """
        if not fps > 0:
            raise LocalProtocolError(f"a frame rate must be positive, not {fps}; stop() stops")
        if self._config is not None and fps > self._config.fps_max:
            self._warn(
                f"{fps:g} frames/s are more than the {self._config.fps_max:.1f} that "
                f"{self._config.iterations} iterations x {self._config.pulses_per_step} pulses "
                "leave time for; a real module may not keep up"
            )
        self._dialogue.take_stale_input()
        self._frames.new_stream()  # a late frame of the last stream would make a false gap
        self._raw_mode = True
        self.request(X4DriverSet(setting=X4Setting.FPS, value=fps))
        rate = self._get(X4Setting.FPS)
        if not isinstance(rate, float) or not 0 < rate < math.inf:
            raise RemoteProtocolError(
                f"{self._transport.name} reads back frame rate {rate} after {fps:g} was set"
            )
        return x4.real_frame_rate(rate)

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
            deadline = self._dialogue.deadline_ns(timeout_s)
            while not self._frames:
                left_ns = deadline - self._clock()
                if left_ns <= 0:
                    raise self._no_frame(timeout_s)
                self._dialogue.pump(left_ns * 1e-9)
        return self._frames.pop()

    def frames(self, count: int | None = None, timeout_s: float = _TIMEOUT_S) -> Iterator[Frame]:
        """Iterate over frames; ``count`` of them, or without end."""
        while count is None or count > 0:
            yield self.read_frame(timeout_s)
            if count is not None:
                count -= 1

    # --- inside ---------------------------------------------------------------------------------

    def _no_frame(self, timeout_s: float) -> ResponseTimeout:
        last = self._frames.last_counter
        if last is None:
            return self._dialogue.silence("frame", timeout_s)
        return self._dialogue.silence(
            f"frame after frame {last}", timeout_s, "did the module stop, or its recording end?"
        )

    def _wait_until_ready(self) -> None:
        deadline = self._clock() + round(_SLOW_TIMEOUT_S * 1e9)
        while self.ping() is PongCode.XTS_SPRP_NOTREADY:
            if self._clock() >= deadline:
                raise ResponseTimeout(
                    f"{self._transport.name} says it is not ready for {_SLOW_TIMEOUT_S:g} s; "
                    "reset the module"
                )
            self._dialogue.pump(0.1)

    def _set_mode_if_known(self, mode: SensorMode) -> None:
        try:
            self.request(SetMode(mode=mode), _SLOW_TIMEOUT_S)
        except DeviceError:  # bare XEP firmware has no modes and is always as in MANUAL
            self._dialogue.tell("warning", f"the module does not know mode {mode.label}")

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

    def _warn(self, text: str) -> None:
        self.warnings.append(text)
        self._dialogue.tell("warning", text)
