"""Driver of one X4M300: raw radar mode, profiles, files. Pull-driven, no threads.

What it can do is written once, as procedures; `AsyncX4M300` has the same methods as coroutines.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Self, TypeVar

from xethru_protocol.driver import link, raw_mode, reconnect
from xethru_protocol.driver.conversation import Listener, Observer, RawListener
from xethru_protocol.driver.files import Files, Presence
from xethru_protocol.driver.frames import DEFAULT_FRAMES, Frame, FrameGeometry
from xethru_protocol.driver.link import (
    CloseLine,
    OpenLine,
    Procedure,
    RadarCore,
    Read,
    SetLineRate,
    Sleep,
    Step,
    Write,
)
from xethru_protocol.driver.reconnect import blocking, blocking_once
from xethru_protocol.transport import (
    SerialTransport,
    Transport,
    capacity_bytes_per_s,
    find_ports,
    set_rate,
)
from xethru_protocol.wire.errors import XeThruError
from xethru_protocol.wire.framing import LinkStatistics


class DriverFacts:
    """Counters and settings of one driver.

    Attributes
    ----------
    raw_listener
        Called with ``"rx"`` or ``"tx"``, the bytes as they went over the line, and the driver's
        time [ns]; None: nobody.
    """

    def __init__(self, core: RadarCore) -> None:
        self.raw_listener: RawListener | None = None
        self._core = core

    @property
    def port(self) -> str:
        """Where the module is; after a reconnect perhaps not where it was."""
        return self._core.path

    @property
    def warnings(self) -> list[str]:
        """What was asked of the module although it is likely to fail, or went wrong quietly.

        The last 1000, oldest first; whoever has shown them may clear the list.
        """
        return self._core.warnings

    @property
    def listener(self) -> Listener | None:
        """Called with every message from the module, frames included, and its arrival [ns]."""
        return self._core.conversation.listener

    @listener.setter
    def listener(self, listener: Listener | None) -> None:
        self._core.conversation.listener = listener

    @property
    def geometry(self) -> FrameGeometry | None:
        """Where the bins of the radar frames lie; None before `configure_raw`."""
        return self._core.frames.geometry

    @geometry.setter
    def geometry(self, geometry: FrameGeometry | None) -> None:
        self._core.frames.geometry = geometry

    @property
    def statistics(self) -> LinkStatistics:
        """What came over the line and what was wrong with it, since the driver was opened."""
        return self._core.statistics

    @property
    def frames_lost(self) -> int:
        """Frames missing by the counters of those that came."""
        return self._core.statistics.frames_lost

    @property
    def frames_dropped(self) -> int:
        """Frames that came, but left a full queue unread."""
        return self._core.frames.dropped

    @property
    def frames_discarded(self) -> int:
        """Data that are no frame of the geometry, such as frames of older settings."""
        return self._core.frames.discarded

    @property
    def messages_dropped(self) -> int:
        """Profile messages that came, but left a full queue unread."""
        return self._core.messages_dropped

    @property
    def fault_count(self) -> int:
        """Damaged places seen on the line."""
        return self._core.conversation.fault_count

    @property
    def stray_count(self) -> int:
        """Answers seen that belong to no request."""
        return self._core.conversation.stray_count

    @property
    def reboots(self) -> int:
        """SYSTEM BOOTING messages seen."""
        return self._core.conversation.reboots

    @property
    def reconnects(self) -> int:
        """Times the module vanished and was found again."""
        return self._core.reconnects


_BAUD = 115200

T = TypeVar("T")


def known_ports() -> Sequence[str]:
    """Ports of this machine at which a module that vanished may come back."""
    return [port.path for port in find_ports()]


class X4M300(DriverFacts):
    """One module at the other end of a transport.

    Parameters
    ----------
    transport
        An open line.
    clock
        Monotonic time [ns].
    observer
        Called with every command, answer, SYSTEM message, fault and warning.
    queue_frames
        Frames that may wait unread; then the oldest is dropped, counted and warned of.
    reconnect_s
        How long to look for a module that vanished, on this port and others, before a call
        fails; what was configured is restored. 0: a vanished module is `Disconnected` at once.
    open_port
        Opens a line after a reconnect, from its path and baud rate.
    candidates
        Ports at which a module that vanished may come back.
    sleep
        Waits [s] while there is no line.

    Attributes
    ----------
    presence
        Profiles: load, set up, run, hear.
    files
        Files in the module's flash, and its crash dump.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        observer: Observer | None = None,
        queue_frames: int = DEFAULT_FRAMES,
        reconnect_s: float = 0.0,
        open_port: Callable[[str, int], Transport] = SerialTransport,
        candidates: Callable[[], Sequence[str]] = known_ports,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(
            RadarCore(
                transport.name,
                clock=clock,
                observer=observer,
                queue_frames=queue_frames,
                reconnect_s=reconnect_s,
                candidates=candidates,
            )
        )
        self._core.bytes_per_s = capacity_bytes_per_s(transport)
        self._transport = transport
        self._open_port = open_port
        self._sleep = sleep
        self.presence = Presence(self._core, self._run)
        self.files = Files(self._core, self._run)

    @classmethod
    def open(
        cls,
        path: str,
        *,
        baudrate: int = _BAUD,
        clock: Callable[[], int] = time.monotonic_ns,
        observer: Observer | None = None,
        queue_frames: int = DEFAULT_FRAMES,
        reconnect_s: float = 0.0,
    ) -> Self:
        """Driver on a serial port; `PortUnavailable` if it cannot be opened.

        ``baudrate`` is the rate at which a UART module talks now; USB and ptys have none.
        """
        transport = SerialTransport(path, baudrate)
        try:
            radar = cls(
                transport,
                clock=clock,
                observer=observer,
                queue_frames=queue_frames,
                reconnect_s=reconnect_s,
            )
        except BaseException:
            transport.close()
            raise
        radar._core.baudrate = baudrate
        return radar

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
        """Stop the radar if this driver configured it, and release the line.

        A profile is left running, as the module itself would after power-up.
        """
        self._core.closed = True
        try:
            self._run(raw_mode.leave(self._core))
        except XeThruError as error:
            self._core.warn(f"the module was not stopped: {error}")
        finally:
            self._transport.close()

    # --- any command ----------------------------------------------------------------------------

    request = blocking(link.request)
    ping = blocking(link.ping)
    info = blocking(link.info)
    x4_settings = blocking(link.x4_settings)

    # --- the line -------------------------------------------------------------------------------

    reset = blocking_once(reconnect.reset)
    reconnect = blocking_once(reconnect.reconnect)
    set_baud_rate = blocking_once(link.set_baud_rate)

    # --- raw radar mode -------------------------------------------------------------------------

    configure_raw = blocking(raw_mode.configure_raw)
    start = blocking(raw_mode.start)
    stop = blocking(raw_mode.stop_frames)
    _wait_for_frame = blocking(link.wait_for_frame)

    def read_frame(self, timeout_s: float = link.TIMEOUT_S) -> Frame:
        """Next frame, in order of arrival.

        Raises
        ------
        ResponseTimeout
            If none comes in time.
        Disconnected
            If the line is gone.
        """
        frames = self._core.frames
        if not frames:
            self._wait_for_frame(timeout_s)
        return frames.pop()

    def frames(
        self, count: int | None = None, timeout_s: float = link.TIMEOUT_S
    ) -> Iterator[Frame]:
        """Iterate over frames; ``count`` of them, or without end.

        The line is read only when no frame waits, so a slow reader holds a lossless line back.
        """
        while count is None or count > 0:
            yield self.read_frame(timeout_s)
            if count is not None:
                count -= 1

    # --- carrying out steps ---------------------------------------------------------------------

    def _run(self, procedure: Procedure[T]) -> T:
        try:
            step = next(procedure)
            while True:
                try:
                    came = self._carry_out(step)
                except BaseException as error:  # the procedure decides
                    step = procedure.throw(error)
                else:
                    step = procedure.send(came)
        except StopIteration as end:
            result: T = end.value
            return result

    def _carry_out(self, step: Step) -> bool:
        if isinstance(step, Read):  # the most frequent one, so without a match
            return self._pump(step.timeout_s)
        match step:
            case Write(data):
                if self.raw_listener is not None:
                    self.raw_listener("tx", data, self._core.clock())
                self._transport.write(data)
            case Sleep(seconds):
                self._sleep(seconds)
            case CloseLine():
                self._transport.close()
            case OpenLine(path, baudrate):
                self._transport = self._open_port(path, baudrate)
                self._core.bytes_per_s = capacity_bytes_per_s(self._transport)
            case SetLineRate(baudrate):
                set_rate(self._transport, baudrate)
                self._core.bytes_per_s = capacity_bytes_per_s(self._transport)
        return False

    def _pump(self, timeout_s: float) -> bool:
        """Read once and sort what came; False if nothing did in time."""
        data = self._transport.read(timeout_s)
        if not data:
            return False
        arrival_ns = self._core.clock()
        if self.raw_listener is not None:
            self.raw_listener("rx", data, arrival_ns)
        self._core.conversation.receive(data, arrival_ns)
        return True
