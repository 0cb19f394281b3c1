"""Driver of one X4M300: raw radar mode, profiles, everything else. Pull-driven, starts no threads.

Several threads may use one driver, for example one that reads frames and one that sends commands:
commands wait for each other, one thread at a time reads the line, and what it reads reaches the
others. `AsyncX4M300` has the same methods as coroutines.
"""

import itertools
import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar, Generic, Literal, Self, TypeVar

from xethru_protocol.driver import profiles, raw_mode, reconnect
from xethru_protocol.driver.board import Diagnostics, Pins
from xethru_protocol.driver.chip import X4, Postprocessing, Registers
from xethru_protocol.driver.files import Files
from xethru_protocol.driver.firmware import Firmware
from xethru_protocol.driver.frames import DEFAULT_FRAMES, Frame, FrameGeometry
from xethru_protocol.driver.link import (
    TIMEOUT_S,
    AwaitGate,
    Blocking,
    CloseLine,
    Gate,
    KindT,
    Link,
    ModuleInfo,
    OpenLine,
    P,
    Part,
    Procedure,
    RawConfig,
    Read,
    ReplyT,
    SetLineRate,
    Sleep,
    Step,
    Steps,
    T,
    Write,
    receives,
    sends,
    sends_once,
)
from xethru_protocol.driver.matching import Listener, Listeners, Observer, RawListener
from xethru_protocol.driver.profiles import MESSAGE_TIMEOUT_S, MessageT
from xethru_protocol.transport import (
    AsyncTransport,
    Transport,
    capacity_bytes_per_s,
    find_ports,
    open_line,
    set_rate,
)
from xethru_protocol.wire.codes import POWER_UP_BAUD, PongCode, SensorMode
from xethru_protocol.wire.errors import Disconnected, LocalProtocolError, XeThruError
from xethru_protocol.wire.framing import LinkStatistics
from xethru_protocol.wire.messages import Command, Response

_LEAVE_S = 1.0  # for a thread to leave a line that was closed


def known_ports() -> Sequence[str]:
    """Ports of this machine at which a module that vanished may come back."""
    return [port.path for port in find_ports()]


def reentry(name: str) -> LocalProtocolError:
    """Error for a driver that is called by what it calls itself."""
    return LocalProtocolError(
        f"the driver of {name} was called from its own listener, observer or other callback (or "
        "from a signal handler) while it is at work; let the callback only store what it gets, "
        "for example in a queue.Queue, and call the driver when it has returned, or from another "
        "thread that the callback does not wait for"
    )


LineT = TypeVar("LineT", bound=Transport | AsyncTransport)


class RadarState(Part[KindT], Generic[KindT, LineT]):
    """What both drivers have: methods, counters and settings.

    A listener, observer or other callback must not call the driver: `LocalProtocolError`.
    """

    _is_awaited: ClassVar[bool] = False
    _make_gate: ClassVar[type[Gate]]
    _port_type: Callable[[str, int], LineT]
    _usual_sleep: Callable[[float], Any]

    def __init__(
        self,
        transport: LineT,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        observer: Observer | None = None,
        queue_frames: int = DEFAULT_FRAMES,
        reconnect_s: float = 0.0,
        open_port: Callable[[str, int], LineT] | None = None,
        candidates: Callable[[], Sequence[str]] = known_ports,
        sleep: Callable[[float], Any] | None = None,
    ) -> None:
        if not hasattr(transport, "write"):
            name = type(self).__name__
            raise TypeError(f"{name} needs an open line; {name}.open({transport!r}) opens a port")
        self._open_port = open_port or self._port_type
        self._sleep = sleep or self._usual_sleep
        self._make_locks()
        self._link = Link(
            transport.name,
            clock=clock,
            observer=observer,
            queue_frames=queue_frames,
            reconnect_s=reconnect_s,
            candidates=candidates,
            make_gate=self._make_gate,
        )
        super().__init__(self)
        self.x4: X4[KindT] = X4(self)
        self.profile: profiles.Profile[KindT] = profiles.Profile(self)
        self.pins: Pins[KindT] = Pins(self)
        self.files: Files[KindT] = Files(self)
        self.firmware: Firmware[KindT] = Firmware(self)
        self.registers: Registers[KindT] = Registers(self)
        self.postprocessing: Postprocessing[KindT] = Postprocessing(self)
        self.diagnostics: Diagnostics[KindT] = Diagnostics(self)
        self._use(transport)

    def _make_locks(self) -> None:
        """Make what keeps callers of this driver apart."""
        raise NotImplementedError

    def __del__(self) -> None:
        link = getattr(self, "_link", None)  # missing if the driver could not be made
        if link is None or link.closed or link.attached:
            return
        if link.frames.rate_hz:
            warnings.warn(
                f"a driver of {link.path} was dropped while its radar transmits, which it still "
                f"does; write 'with {type(self).__name__}.open(...) as radar', or call close()",
                ResourceWarning,
                stacklevel=2,
                source=self,
            )

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        baudrate: int = POWER_UP_BAUD,
        clock: Callable[[], int] = time.monotonic_ns,
        observer: Observer | None = None,
        queue_frames: int = DEFAULT_FRAMES,
        reconnect_s: float = 0.0,
    ) -> Self:
        """Driver on a port; `PortUnavailable` if it cannot be opened.

        ``path`` is a serial port, ``tcp://HOST:PORT`` or ``rfc2217://HOST:PORT``. ``baudrate`` is
        the rate at which a UART module talks now; USB, ptys and ``tcp://`` have none.
        """
        transport = cls._port_type(os.fspath(path), baudrate)
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
        radar._link.baudrate = baudrate
        return radar

    @property
    def port(self) -> str:
        """Where the module is; after a reconnect perhaps not where it was."""
        return self._link.path

    @property
    def bytes_per_s(self) -> float:
        """What the line carries at most; infinite if it has no known limit."""
        return self._link.bytes_per_s

    @property
    def warnings(self) -> list[str]:
        """What probably fails although the module accepts it, and what failed without an error.

        The last 1000, oldest first; a caller that has shown them may clear the list.
        """
        return self._link.warnings

    @property
    def listeners(self) -> Listeners[Response, int]:
        """Called with every message from the module, frames included, and its arrival [ns].

        ``listeners.add(function)`` adds one, ``listeners.remove(function)`` takes it away.
        """
        return self._link.conversation.listeners

    @property
    def raw_listeners(self) -> Listeners[Literal["rx", "tx"], bytes, int]:
        """Called with ``"rx"`` or ``"tx"``, the bytes as they went over the line, and the time.

        It is that of the driver's clock [ns]. ``add`` and ``remove`` as of `listeners`.
        """
        return self._link.conversation.raw_listeners

    @property
    def listener(self) -> Listener | None:
        """One of `listeners`: setting it replaces the one that was set before, None removes it."""
        return self.listeners.single

    @listener.setter
    def listener(self, listener: Listener | None) -> None:
        self.listeners.single = listener

    @property
    def raw_listener(self) -> RawListener | None:
        """One of `raw_listeners`; as `listener`."""
        return self.raw_listeners.single

    @raw_listener.setter
    def raw_listener(self, listener: RawListener | None) -> None:
        self.raw_listeners.single = listener

    @property
    def geometry(self) -> FrameGeometry | None:
        """Where the bins of the radar frames lie; None before `configure_raw`."""
        return self._link.frames.geometry

    @geometry.setter
    def geometry(self, geometry: FrameGeometry | None) -> None:
        self._link.frames.geometry = geometry

    @property
    def description(self) -> dict[str, Any]:
        """What is known of raw frames, by the names in the info of an MCAP file; empty if nothing.

        Lengths are module metres.
        """
        return raw_mode.description(self._link)

    @property
    def statistics(self) -> LinkStatistics:
        """What came over the line and what was wrong with it, since the driver was opened."""
        return self._link.statistics

    @property
    def frames_lost(self) -> int:
        """Frames missing by the counters of those that came.

        Over a reconnect, by the frame rate and the time without frames.
        """
        return self._link.statistics.frames_lost

    @property
    def frames_dropped(self) -> int:
        """Frames that came, but left a full queue unread."""
        return self._link.frames.dropped

    @property
    def frames_discarded(self) -> int:
        """Data that are not frames of the geometry, such as frames of older settings."""
        return self._link.frames.discarded

    @property
    def messages_dropped(self) -> int:
        """Profile messages that came, but left a full queue unread."""
        return self._link.messages_dropped

    @property
    def fault_count(self) -> int:
        """Damaged places seen on the line."""
        return self._link.conversation.fault_count

    @property
    def stray_count(self) -> int:
        """Answers seen that belong to no request."""
        return self._link.conversation.matcher.stray_count

    @property
    def reboots(self) -> int:
        """SYSTEM BOOTING messages seen."""
        return self._link.conversation.reboots

    @property
    def reconnects(self) -> int:
        """Times the module vanished and was found again."""
        return self._link.reconnects

    # --- the module and its line ---

    @sends
    def ping(link: Link, timeout_s: float = TIMEOUT_S) -> Steps[PongCode]:
        """Whether the module is ready, not ready, or in safe mode.

        Raises
        ------
        ResponseTimeout
            If nothing answers: probably no radar.
        RemoteProtocolError
            If no XeThru module gives this answer.
        """
        return link.ping(timeout_s)

    @sends
    def info(link: Link) -> Steps[ModuleInfo]:
        """Read what the module reports about itself."""
        return link.info()

    @sends
    def mode(link: Link) -> Steps[SensorMode]:
        """Ask for the module's mode; `DeviceError` if its firmware has none (bare XEP)."""
        return link.mode()

    @sends
    def set_mode(link: Link, mode: SensorMode, parameter: int | None = None) -> Steps[None]:
        """Change the module's mode. Protocol reference 4.2, 8.3.

        `configure_raw` and the methods of `profile` do so by themselves.

        Parameters
        ----------
        parameter
            Only of the modes NORMAL (`NormalModeParam`) and REG (`RegModeParam`, certification).
        """
        return profiles.set_mode(link, mode, parameter)

    @sends_once
    def reset(
        link: Link, *, wait: bool = False, timeout_s: float = reconnect.RESTART_S
    ) -> Steps[None]:
        """Restart the module; what was configured is gone. Protocol reference 8.1.

        Parameters
        ----------
        wait
            False: return at its ACK; a USB port vanishes 0.5 s later. True: return when it is
            ready again, on a port of the same or another name.

        Raises
        ------
        ResponseTimeout
            If it keeps its port and does not get ready in time.
        Disconnected
            If its port vanishes and it does not come back in time.
        """
        return reconnect.reset(link, wait=wait, timeout_s=timeout_s)

    @sends_once
    def reconnect(link: Link, timeout_s: float = reconnect.RESTART_S) -> Steps[str]:
        """Find the module again at the same port or another, and restore what was configured.

        Frames that were read before it vanished stay in the queue. Those that come begin a new
        `Frame.stream`, and `frames_lost` includes those of the time between. Returns the port it
        was found at.

        Raises
        ------
        Disconnected
            If it does not come back in time.
        DeviceError
            If it came back and refuses its settings.
        """
        return reconnect.reconnect(link, timeout_s)

    @sends_once
    def set_baud_rate(link: Link, baudrate: int, *, force: bool = False) -> Steps[None]:
        """Change the rate of a UART on both sides; lines without a rate accept it without effect.

        The module answers at the old rate and forgets the new one at a restart. Protocol reference
        4.10, 10, 16.

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
            If the module does not answer at the new rate. This side is back at the old rate then
            if the module answers there, and at the new one if it answers at neither.
        """
        return link.set_baud_rate(baudrate, force=force)

    @sends_once
    def find_baud_rate(link: Link) -> Steps[int | None]:
        """Find the rate at which a module on a UART answers, and change this side to it.

        None if it answers at none; this side is at 115200 then. Lines without a rate accept every
        one without effect.
        """
        return link.find_baud_rate()

    # --- raw radar mode ---

    @sends
    def configure_raw(link: Link, config: RawConfig | None = None) -> Steps[FrameGeometry]:
        """Bring the module from any state to raw radar mode, stopped.

        Every setting is read back. Returns the geometry as the module quantised it. Protocol
        reference 13.

        Raises
        ------
        LocalProtocolError
            If the settings make no sense.
        DeviceError
            If the module refuses one.
        RemoteProtocolError
            If it reads back another value than was set; names the setting.
        ResponseTimeout
            If the port is not a radar.
        """
        return raw_mode.configure_raw(link, config)

    @sends
    def attach(link: Link) -> Steps[FrameGeometry]:
        """Take the frames that the module sends already; nothing is changed, also by `close`.

        For frames that another program started, as beside ``xethru share``. If that program changes
        the settings, later frames are discarded with a warning. `description` has the rate.

        Raises
        ------
        LocalProtocolError
            If the module sends none.
        """
        return raw_mode.attach(link)

    @sends
    def start(link: Link, fps: float) -> Steps[float]:
        """Start frames at ``fps`` [Hz]; returns the rate at which the chip really runs.

        Frames of an earlier stream that were not read yet are dropped. Without `configure_raw`, the
        settings that a module in mode MANUAL has are taken for those that are wanted.

        A rate with less than the recommended 5 % reserve, or above what the line carries, is tried
        with a warning (Protocol reference 9.6, 10).

        Raises
        ------
        LocalProtocolError
            If a sweep of these settings takes longer than a frame.
        """
        return raw_mode.start(link, fps)

    @sends
    def stop(link: Link) -> Steps[None]:
        """Stop frames. One that was already on its way may still come."""
        return raw_mode.stop(link)

    @receives
    def read_frame(link: Link, timeout_s: float = TIMEOUT_S) -> Steps[Frame]:
        """Next frame, in order of arrival.

        Raises
        ------
        ResponseTimeout
            If none comes in time.
        Disconnected
            If the line is gone.
        """
        return link.next_frame(timeout_s)

    @receives
    def frames_waiting(link: Link) -> Steps[int]:
        """Receive what the line has, without waiting, and count the frames not taken yet."""
        yield from link.take_stale_input()
        return len(link.frames)

    # --- other messages ---

    @receives
    def messages_waiting(link: Link, kind: type[Response] = Response) -> Steps[int]:
        """Receive what the line has, without waiting, and count the messages not taken yet."""
        return profiles.messages_waiting(link, kind)

    # --- carrying out steps ---

    def _use(self, transport: LineT) -> None:
        self._transport = transport
        self._link.bytes_per_s = capacity_bytes_per_s(transport)


class X4M300(RadarState[Blocking, Transport]):
    """One radar module on a port: X4M300, X4M200, or any other with XeThru's X4 firmware.

    Raw frames, a sample per range bin::

        with X4M300.open("/dev/ttyACM0") as radar:     # `xethru list` shows the ports
            radar.configure_raw(RawConfig(frame_area_m=(0.2, 9.4)))
            radar.start(17)
            for frame in radar.frames(100):
                print(frame.counter, frame.ranges_m, frame.samples)

    What the module computes itself, presence here, respiration on an X4M200::

        with X4M300.open("/dev/ttyACM0") as radar:
            radar.profile.load()
            radar.profile.set_zone(0.4, 5.0)
            radar.profile.set_output(OutputFeature.PRESENCE_SINGLE)
            radar.profile.run()
            for message in radar.messages():
                print(message)

    The methods, by task:

    - begin and end: `open`, `ping`, `info`, `close`
    - raw frames: `configure_raw`, `start`, `read_frame`, `frames`, `frames_waiting`, `stop`;
      `attach` for those that another program started
    - all other messages: `messages`, `read_message`, `messages_waiting`; `listeners` are called
      with every one, `raw_listeners` with the bytes of both directions
    - the module and its line: `mode`, `set_mode`, `reset`, `reconnect`, `set_baud_rate`,
      `find_baud_rate`
    - any command of the protocol: `request`

    The parts, each with a help of its own, such as ``help(radar.x4)``:

    - ``x4``: settings of the radar chip, an attribute each: ``radar.x4.iterations = 8``.
    - ``profile``: what the module computes itself: load, set up, run; its noise maps and parameter
      file.
    - ``pins``: IO pins.
    - ``files``: files in the module's flash, and its crash dump.
    - ``firmware``: the bootloader; writing an image of the firmware.
    - ``registers``: registers of the radar chip.
    - ``postprocessing``: what newer firmware does to frames before it sends them.
    - ``diagnostics``: system tests, trace output, injected frames.

    Ranges are metres as the module counts them, with 3.0e8 m/s. What goes wrong raises an
    `XeThruError`: `DeviceError` if the module refuses, `ResponseTimeout` if it is silent,
    `Disconnected` if it is gone, `LocalProtocolError` if a value makes no sense. `warnings`
    holds what will probably fail although the module accepted it.

    Parameters
    ----------
    transport
        An open line; `open` makes one from the name of a port.
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
        Opens a line after a reconnect, from its path and baud rate; None: as `open` does.
    candidates
        Ports at which a module that vanished may come back.
    sleep
        Waits [s] while the line is closed; None: by the clock of this machine.
    """

    _make_gate = threading.Event
    _port_type = staticmethod(open_line)
    _usual_sleep = staticmethod(time.sleep)

    def _make_locks(self) -> None:
        self._one_at_a_time = threading.Lock()
        # Held while the driver's state is used, not while a thread waits for the line.
        self._lock = threading.Lock()
        self._came = threading.Condition(self._lock)
        self._reading = False
        self._waiting = 0  # threads that wait for the one that reads
        self._inside: set[int] = set()  # threads in a call of the driver

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the radar if this driver configured it, and release the line.

        A profile is left running, as the module itself would after power-up.
        """
        self._refuse_reentry()
        self._link.closed = True
        try:
            self._call_once(raw_mode.leave)
        except XeThruError as error:
            self._link.warn(f"the module was not stopped: {error}")
        finally:
            self._transport.close()

    # --- any command, iterators ---

    def request(self, command: Command[ReplyT], timeout_s: float = TIMEOUT_S) -> ReplyT:
        """Send a command and return the reply that its row in the message table names.

        Raises
        ------
        DeviceError
            If the module refuses.
        ResponseTimeout
            If no fitting reply comes in time.
        Disconnected
            If the line is gone.
        """
        return self._call(Link.request, command, timeout_s)

    def frames(self, count: int | None = None, timeout_s: float = TIMEOUT_S) -> Iterator[Frame]:
        """Iterate over frames; ``count`` of them, or without end.

        The line is read only when no frame waits, so a slow reader holds a lossless line back.
        """
        for _ in itertools.count() if count is None else range(count):
            yield self._listen(Link.next_frame, timeout_s)

    def read_message(self, kind: type[MessageT], timeout_s: float = MESSAGE_TIMEOUT_S) -> MessageT:
        """Next message of a class of `xethru_protocol.wire.messages`, such as `DataString`.

        Those of other classes stay.

        Raises
        ------
        ResponseTimeout
            If none comes in time.
        """
        return self._listen(profiles.wait_for_message, kind, timeout_s)

    def messages(
        self, count: int | None = None, timeout_s: float = MESSAGE_TIMEOUT_S
    ) -> Iterator[Response]:
        """Iterate over what comes besides frames and answers: messages of a profile, debug text.

        ``count`` of them, or without end; raises `ResponseTimeout` if none comes in time.
        """
        for _ in itertools.count() if count is None else range(count):
            yield self.read_message(Response, timeout_s)

    # --- carrying out steps ---

    def _call(self, procedure: Procedure[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Carry out a procedure that sends commands; again after a reconnect, if that is on."""
        link = self._link
        return self._run(reconnect.resilient(link, lambda: procedure(link, *args, **kwargs)))

    def _call_once(self, procedure: Procedure[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Carry out a procedure that sends commands; a broken line raises `Disconnected`."""
        return self._run(procedure(self._link, *args, **kwargs))

    def _listen(self, procedure: Procedure[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Carry out a procedure that only receives, beside one that sends; also repeated."""
        link = self._link
        if link.reconnect_s <= 0:
            return self._carry(procedure(link, *args, **kwargs))
        if not link.identified:
            self._run(reconnect.identify(link))
        for _ in range(reconnect.RECONNECTS_PER_CALL):
            reconnects = link.reconnects
            try:
                return self._carry(procedure(link, *args, **kwargs))
            except Disconnected as error:
                self._run(reconnect.recover(link, reconnects, error))
        return self._carry(procedure(link, *args, **kwargs))

    def _run(self, procedure: Steps[T]) -> T:
        """Carry out a procedure that sends commands: no other may send before it is done."""
        self._refuse_reentry()
        with self._one_at_a_time:
            return self._carry(procedure)

    def _refuse_reentry(self) -> None:
        if threading.get_ident() in self._inside:
            raise reentry(self._link.name)

    def _carry(self, procedure: Steps[T]) -> T:
        self._refuse_reentry()
        thread = threading.get_ident()
        self._inside.add(thread)
        try:
            with self._lock:
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
        finally:
            self._inside.discard(thread)

    def _carry_out(self, step: Step) -> bool:
        if isinstance(step, Read):  # the most frequent one, so without a match
            return self._pump(step.timeout_s)
        match step:
            case Write(data):
                self._link.conversation.hear("tx", data, self._link.clock())
                self._unlocked(self._transport.write, data)
            case Sleep(seconds):
                self._unlocked(self._sleep, seconds)
            case AwaitGate(gate, timeout_s):
                self._unlocked(gate.wait, min(timeout_s, threading.TIMEOUT_MAX))
            case SetLineRate(baudrate):
                set_rate(self._transport, baudrate)
                self._use(self._transport)
            case CloseLine() | OpenLine():
                self._transport.close()
                if self._reading:  # the thread that reads leaves it
                    self._await_reader(_LEAVE_S)
                if isinstance(step, OpenLine):
                    self._use(self._open_port(step.path, step.baudrate))
        return False

    def _await_reader(self, timeout_s: float) -> bool:
        """Wait until the thread that reads has done so; False if it has not in time."""
        self._waiting += 1
        try:
            return self._came.wait(min(max(timeout_s, 0.0), threading.TIMEOUT_MAX))
        finally:
            self._waiting -= 1

    def _unlocked(self, wait: Callable[[T], None], argument: T) -> None:
        try:
            self._lock.release()
            wait(argument)
        finally:
            self._lock.acquire()

    def _pump(self, timeout_s: float) -> bool:
        """Read once and sort what came, or wait for the thread that does; False if nothing came."""
        if self._reading:
            return self._await_reader(timeout_s)
        data = b""
        self._reading = True
        try:
            self._lock.release()
            data = self._transport.read(timeout_s)
        finally:
            self._lock.acquire()
            self._reading = False
            if self._waiting:  # they go on when this thread waits again, or returns
                self._came.notify_all()
        if not data:
            return False
        arrival_ns = self._link.clock()
        self._link.receive(data, arrival_ns)
        return True
