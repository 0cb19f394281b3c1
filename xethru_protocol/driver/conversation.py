"""The conversation with one module, without I/O: bytes and times in, bytes and answers out.

The module answers commands in order and without sequence numbers, and sends frames and SYSTEM
messages whenever it likes (Protocol reference 3). What arrives is sorted at once: answers go to
the one outstanding request, all else to the reader of the stream; faults are counted.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import describe
from xethru_protocol.wire.codes import SystemCode, error_name
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.errors import DeviceError, ResponseTimeout
from xethru_protocol.wire.framing import NEED_DATA, FramingFault, LinkStatistics
from xethru_protocol.wire.table import ROWS, Command, Message, Response, Row

FRAMES = (m.DataFloat, m.BasebandIq)  # a tuple is the faster argument of isinstance
_ENDLESS_S = 1e9
_ANSWERS = (m.Ack, m.Error, m.Pong, m.ReplyByte, m.ReplyInt, m.ReplyFloat, m.ReplyString)
# The module answers PINGs that waited for it one right after the other; a PONG that stays out
# this long after the last one was never sent.
_SETTLED_NS = 250_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class ProtocolRecord:
    """One line of the protocol log: everything on the wire but frames."""

    t_ns: int
    direction: Literal["tx", "rx", "fault", "warning"]
    summary: str


Observer = Callable[[ProtocolRecord], None]
Listener = Callable[[Response, int], None]
RawListener = Callable[[Literal["rx", "tx"], bytes, int], None]


@dataclass(slots=True, kw_only=True)
class _Request:
    """What was asked last and is not answered yet."""

    command: Command[Response]
    row: Row
    content_id: int | None
    timeout_s: float
    deadline_ns: int
    pong: m.Pong | None = None
    settled_ns: int = 0  # when that PONG is taken for the last one


class Conversation:
    """Commands to one module and what comes from it.

    ``name`` is what messages to people call the line. ``take_data`` is called with every message
    that is no answer, and the time its last byte was read [ns]. ``clock`` and ``observer`` as of
    `X4M300`; its properties describe the listener and the counters.
    """

    def __init__(
        self,
        name: str,
        clock: Callable[[], int],
        observer: Observer | None,
        take_data: Listener,
    ) -> None:
        self.name = name
        self.listener: Listener | None = None
        self.statistics = LinkStatistics()
        self.fault_count = 0
        self.stray_count = 0
        self.reboots = 0
        self.readies = 0
        self._clock = clock
        self._observer = observer
        self._take_data = take_data
        self._connection = Connection(Role.HOST, self.statistics)
        self._answers: deque[Response] = deque()
        self._request: _Request | None = None
        self._answer_owed = False
        self._pongs_owed = 0
        self._winding_down = False
        self._damaged_since = False  # since the last frame or answer
        self._rebooted_since = False

    # --- asking ---------------------------------------------------------------------------------

    @property
    def out_of_step(self) -> bool:
        """Whether the answer of a request that was given up may still come.

        The module answers in order, so a PING brings both sides into step again: all before its
        PONG belongs to nothing any more (Protocol reference 13).
        """
        return self._answer_owed

    def ask(self, command: Command[Response], timeout_s: float) -> bytes:
        """Make ``command`` the outstanding request; returns the bytes to write.

        An answer that arrived before belongs to no request and is dropped.

        Raises
        ------
        LocalProtocolError
            If the protocol cannot express it; nothing is outstanding then.
        """
        data = self._connection.send(command)
        self.stray_count += len(self._answers)
        self._answers.clear()
        row = ROWS[type(command)]
        self._request = _Request(
            command=command,
            row=row,
            content_id=row.content_id(command) if row.content_id else None,
            timeout_s=timeout_s,
            deadline_ns=self.deadline_ns(timeout_s),
        )
        if isinstance(command, m.Ping):
            self._pongs_owed += 1
        else:
            self._answer_owed = True  # also if this is left by an interrupt
        if self._observer is not None:
            self.report("tx", summary(command))
        return data

    def answer(self) -> Response | None:
        """Return the answer to the outstanding request; None while it may still come.

        Raises
        ------
        DeviceError
            If the module refuses.
        ResponseTimeout
            If the time for it is over.
        """
        request = self._request
        if request is None:
            return None
        ping = isinstance(request.command, m.Ping)
        found = self._find_pong(request) if ping else self._find_answer(request)
        if found is None and request.deadline_ns <= self._clock():
            found = request.pong
            if found is None:
                self._request = None
                raise self.silence(f"answer to {summary(request.command)}", request.timeout_s)
        if found is None:
            return None
        self._request = None
        self._answer_owed = False
        if ping:
            self._pongs_owed = 0
        elif isinstance(found, m.Error):
            meaning = error_name(found.code, request.row.errors)
            raise DeviceError(found.code, summary(request.command), meaning)
        return found

    def give_up(self) -> None:
        """Drop the outstanding request; its answer may still come and is dropped then."""
        self._request = None

    def wait_s(self) -> float:
        """How long the answer to the outstanding request should be waited for now [s]."""
        if self._request is None:
            return 0.0
        until_ns = self._request.deadline_ns
        if self._request.pong is not None:
            until_ns = min(until_ns, self._request.settled_ns)
        return max(until_ns - self._clock(), 0) * 1e-9

    def _find_answer(self, request: _Request) -> Response | None:
        while self._answers:
            answer = self._answers.popleft()
            if isinstance(answer, m.Error):
                return answer
            if isinstance(answer, request.row.replies) and (
                request.content_id is None
                or getattr(answer, "content_id", None) == request.content_id
            ):
                return answer
            self.stray_count += 1
        return None

    def _find_pong(self, request: _Request) -> Response | None:
        """Return the last PONG that is due: a late one describes an earlier state.

        PONGs do not echo the seed. So the PONGs due are counted, and one is taken for the last
        if no other follows soon, since a module that was off does not answer PINGs of that time.
        """
        while self._answers:
            answer = self._answers.popleft()
            if isinstance(answer, m.Pong):
                self.stray_count += request.pong is not None
                request.pong = answer
                request.settled_ns = self._clock() + _SETTLED_NS
            else:  # PING has no errors: those are of another command, too
                self.stray_count += 1
        last = request.pong is not None and (
            self._pongs_owed == 0 or self._clock() >= request.settled_ns
        )
        return request.pong if last else None

    # --- receiving --------------------------------------------------------------------------------

    def receive(self, data: bytes, arrival_ns: int) -> None:
        connection = self._connection
        try:
            connection.receive_data(data)
            while (event := connection.next_event()) is not NEED_DATA:
                if isinstance(event, Response):
                    self._sort(event, arrival_ns)
                elif isinstance(event, FramingFault) and not self._winding_down:
                    self.fault_count += 1
                    self._damaged_since = True
                    self.report("fault", f"{event.kind.value} at byte {event.offset}")
        except Exception:  # of a listener or an observer
            raise
        except BaseException:  # an interrupt, perhaps while the receiver moved its bytes
            self._connection = Connection(Role.HOST, self.statistics)
            raise

    def _sort(self, message: Response, arrival_ns: int) -> None:
        if self.listener is not None:
            self.listener(message, arrival_ns)
        if isinstance(message, FRAMES):
            self._damaged_since = self._rebooted_since = False
            self._take_data(message, arrival_ns)
            return
        if self._is_answer(message):
            self._damaged_since = self._rebooted_since = False
            if self._request is None:
                self.stray_count += 1  # not kept: a faulty module may never stop sending them
            else:
                self._answers.append(message)
            if isinstance(message, m.Pong):
                self._pongs_owed = max(self._pongs_owed - 1, 0)
        elif isinstance(message, m.System):
            self.readies += message.code == SystemCode.XTS_SPRS_READY
            if message.code == SystemCode.XTS_SPRS_BOOTING:
                self.reboots += 1
                self._rebooted_since = True
        else:
            self._take_data(message, arrival_ns)
        if self._observer is not None and not _is_bulk(message):
            self.report("rx", summary(message))

    def _is_answer(self, message: Response) -> bool:
        # some firmware answers with a message that other firmware sends unasked
        request = self._request
        return isinstance(message, _ANSWERS) or (
            request is not None and isinstance(message, request.row.replies)
        )

    # --- the line -------------------------------------------------------------------------------

    def new_line(self, name: str) -> None:
        """Begin anew on a line that was just opened: no answer is due and no packet half-read."""
        self.name = name
        self.statistics.junk_bytes += self._connection.buffered  # the rest of them never came
        self._connection = Connection(Role.HOST, self.statistics)
        self._answers.clear()
        self._request = None
        self._answer_owed = False
        self._pongs_owed = 0
        self._damaged_since = self._rebooted_since = False

    def wind_down(self) -> None:
        """Read answers only from now on.

        An interrupt may have come while bytes were taken in, so what is half-read is forgotten;
        the rest of a packet that was cut so looks like damage and is neither reported nor counted.
        """
        self._winding_down = True
        self._connection = Connection(Role.HOST)
        self._answers.clear()

    # --- reporting --------------------------------------------------------------------------------

    def deadline_ns(self, timeout_s: float) -> int:
        """Time of the clock [ns] at which a timeout is over; an infinite one takes 30 years."""
        return self._clock() + round(min(timeout_s, _ENDLESS_S) * 1e9)

    def silence(
        self,
        what: str,
        timeout_s: float,
        likely: str = "is it an X4M300, powered and not in its bootloader?",
    ) -> ResponseTimeout:
        """Error for something that did not come, with the likeliest reason and remedy.

        Judged by what came since the last frame or answer: what was before that explains nothing.
        ``likely`` is the reason given when nothing came at all.
        """
        missing = f"no {what} from {self.name} within {timeout_s:g} s"
        if self._rebooted_since:
            return ResponseTimeout(
                f"{missing}: the module restarted meanwhile and forgot its settings; begin again"
            )
        if self._damaged_since:
            return ResponseTimeout(
                f"{missing}, but bytes that are no XeThru packets; "
                "is it another device, or another baud rate?"
            )
        return ResponseTimeout(f"{missing}; {likely}")

    def report(self, direction: Literal["tx", "rx", "fault", "warning"], text: str) -> None:
        if self._observer is not None:
            self._observer(ProtocolRecord(t_ns=self._clock(), direction=direction, summary=text))


def _is_bulk(message: Response) -> bool:
    row = ROWS.get(type(message))
    return row is not None and row.bulk


def summary(message: Message) -> str:
    """One line about a message, for logs and errors.

    >>> from xethru_protocol.wire.messages import X4DriverSet
    >>> from xethru_protocol.wire.codes import X4Setting
    >>> summary(X4DriverSet(setting=X4Setting.FPS, value=17.0))
    'X4DRIVER_SET id=FPS value=17.0'
    """
    name, shown = describe(message)
    parts = (f"{key}={value}" for key, value in shown.items() if value is not None)
    return " ".join([name, *parts])
