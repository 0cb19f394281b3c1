"""Driver of one X4M300: raw radar mode, profiles, files. Pull-driven, no threads.

What it can do is written once, as procedures; `AsyncX4M300` has the same methods as coroutines.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Self, TypeVar

from xethru_protocol import procedures, raw_mode, reconnection
from xethru_protocol.conversation import Listener, Observer, ProtocolRecord, RawListener
from xethru_protocol.core import RadarCore
from xethru_protocol.driver_facts import DriverFacts
from xethru_protocol.errors import XeThruError
from xethru_protocol.files import Files
from xethru_protocol.frame_queue import DEFAULT_FRAMES
from xethru_protocol.frames import Frame, FrameGeometry
from xethru_protocol.ports import find_ports
from xethru_protocol.presence import Presence
from xethru_protocol.raw_config import ModuleInfo, RawConfig
from xethru_protocol.steps import (
    CloseLine,
    OpenLine,
    Procedure,
    Read,
    SetLineRate,
    Sleep,
    Step,
    Write,
)
from xethru_protocol.transport import SerialTransport, Transport, capacity_bytes_per_s, set_rate
from xethru_protocol.verbs import blocking, blocking_once

__all__ = [
    "X4M300",
    "Frame",
    "FrameGeometry",
    "Listener",
    "ModuleInfo",
    "Observer",
    "ProtocolRecord",
    "RawConfig",
    "RawListener",
    "known_ports",
]

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

    request = blocking(procedures.request)
    ping = blocking(procedures.ping)
    info = blocking(procedures.info)
    x4_settings = blocking(procedures.x4_settings)

    # --- the line -------------------------------------------------------------------------------

    reset = blocking_once(reconnection.reset)
    reconnect = blocking_once(reconnection.reconnect)
    set_baud_rate = blocking_once(procedures.set_baud_rate)

    # --- raw radar mode -------------------------------------------------------------------------

    configure_raw = blocking(raw_mode.configure_raw)
    start = blocking(raw_mode.start)
    stop = blocking(raw_mode.stop_frames)
    _wait_for_frame = blocking(procedures.wait_for_frame)

    def read_frame(self, timeout_s: float = procedures.TIMEOUT_S) -> Frame:
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
        self, count: int | None = None, timeout_s: float = procedures.TIMEOUT_S
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
