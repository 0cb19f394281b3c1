"""The conversation with one module, without I/O: what was asked, and what came.

The module answers commands in order and without sequence numbers, and sends frames and SYSTEM
messages whenever it likes (Protocol reference 3). What arrives is sorted at once: answers go to
a `Matcher`, all else to the reader of the stream; faults are counted.
"""

from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Generic, Literal, ParamSpec

from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import describe
from xethru_protocol.wire.codes import BootloaderFraming, BootloaderReply, InfoItem, SystemCode
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.errors import (
    DeviceError,
    RemoteProtocolError,
    ResponseTimeout,
    XeThruError,
)
from xethru_protocol.wire.framing import NEED_DATA, FramingFault, LinkStatistics
from xethru_protocol.wire.table import ROWS, Command, Response, UnknownMessage

FRAMES = (m.DataFloat, m.BasebandIq)  # a tuple is the faster argument of isinstance
_ENDLESS_S = 1e9
_ANSWER_CODES = (b"\x01", b"\x10", b"\x11", b"\x20")  # PONG, ACK, REPLY, ERROR
_SHOWN = 160  # characters of an answer in an error
# The module answers PINGs that waited for it one right after the other; a PONG that does not come
# this long after the last one was probably never sent.
_SETTLED_S = 0.25
# Part of the timeout for which the right answer is waited for after a wrong one.
_AFTER_A_WRONG_ONE = 0.25
# Information that every firmware has; two items, so that no late answer is taken for another.
_TOKENS = (InfoItem.XTID_SSIC_VERSION, InfoItem.XTID_SSIC_BUILD)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProtocolRecord:
    """One line of the protocol log: everything on the wire but frames."""

    t_ns: int
    direction: Literal["tx", "rx", "fault", "warning"]
    summary: str


Observer = Callable[[ProtocolRecord], None]
Listener = Callable[[Response, int], object]
RawListener = Callable[[Literal["rx", "tx"], bytes, int], object]


P = ParamSpec("P")


class Listeners(Generic[P]):
    """Functions that are called with what comes, in the order in which they were added.

    Each is called although one before it raises; that error is raised behind the last. ``all``
    are the functions.
    """

    def __init__(self) -> None:
        self.all: tuple[Callable[P, object], ...] = ()
        self._single: Callable[P, object] | None = None

    @property
    def single(self) -> Callable[P, object] | None:
        """One of the functions: setting it replaces the one set before, None removes it."""
        return self._single

    @single.setter
    def single(self, listener: Callable[P, object] | None) -> None:
        self.remove(self._single)
        self._single = listener
        if listener is not None:
            self.add(listener)

    def add(self, listener: Callable[P, object]) -> None:
        """Call a function from now on; adding it again has no effect."""
        if listener not in self.all:
            self.all = (*self.all, listener)

    def remove(self, listener: Callable[P, object] | None) -> None:
        """Do not call a function any more; no effect if it is not called."""
        self.all = tuple(each for each in self.all if each != listener)

    def __call__(self, *what: P.args, **named: P.kwargs) -> None:
        with ExitStack() as calls:
            for listener in reversed(self.all):
                calls.callback(listener, *what, **named)


class Matcher:
    """Finds the answer to the last question among what a module answers.

    The module answers in order and without sequence numbers, so an answer fits by its kind and by
    what it repeats of the question. The answer to a question that was given up may still come:
    until that is settled, a PING or a `token` is asked before the next question (Protocol
    reference 13).

    Attributes
    ----------
    expected
        What would answer the question besides ERROR; empty if no question waits for an answer.
    answer
        The answer; of several PONGs, the last that came.
    unexpected
        The first answer since the question that does not fit it.
    answer_owed
        Whether the answer to a question that was given up may still come.
    pongs_possible
        PONGs that may still come, at most.
    stray_count
        Answers that belong to no question.
    """

    def __init__(self) -> None:
        self.stray_count = 0
        self._pings = 0  # that were asked
        self._tokens = deque(_TOKENS)
        self._tokens_out = 0  # asked and not answered, or answered too late
        self._token_at: int | None = None  # PINGs before the first token that is out
        self._came: deque[Response] = deque()
        self._command: Command[Response] | None = None
        self._timeout_s = 0.0
        self._as_token = False
        self._repeated: dict[str, object] = {}  # fields of the answer by what they must be
        self._late_pongs = 0  # of earlier questions, that may come before the answer
        self.forget()

    def forget(self) -> None:
        """Begin anew on a line that was just opened: no answer is due."""
        self._came.clear()
        self.expected: tuple[type[Response], ...] = ()
        self.answer: Response | None = None
        self.unexpected: Response | None = None
        self.answer_owed = False
        self.pongs_possible = 0
        self._pongs_owed = 0  # PONGs that are due, but for those that are taken for never sent

    def token(self) -> m.SystemGetInfo:
        """Return a question whose answer names it, so that all asked before is settled.

        PONGs do not say which PING they answer: if one may still come, a PING proves nothing.
        """
        return m.SystemGetInfo(item=self._tokens[0])

    def ask(self, command: Command[Response], timeout_s: float, *, as_token: bool = False) -> None:
        """Look for the answer to ``command`` from now on; what came before belongs to no question.

        ``as_token``: it is a `token`, and other answers are those of earlier questions.
        """
        self.stray_count += len(self._came)
        self._came.clear()
        row = ROWS[type(command)]
        self.expected = row.replies
        self.answer = self.unexpected = None
        self._command, self._timeout_s, self._as_token = command, timeout_s, as_token
        self._late_pongs = self.pongs_possible
        self._repeated = {}
        if row.content_id is not None:
            self._repeated["content_id"] = row.content_id(command)
        if isinstance(command, m.SystemGetInfo):
            self._repeated["info"] = command.item
        if isinstance(command, m.BootloaderEcho):
            self._repeated["data"] = command.data
        if isinstance(command, m.Ping):
            self._pings += 1
            self._pongs_owed += 1
            self.pongs_possible += 1
            return
        self.answer_owed = True  # also if an interrupt ends the waiting
        if as_token:
            self._tokens_out += 1
            if self._token_at is None:
                self._token_at = self._pings

    def take(self, message: Response) -> bool:
        """Take a message that came, if it is an answer; return whether it is."""
        # some firmware answers with a message that other firmware sends unasked
        if not isinstance(message, (m.ANSWERS, self.expected)):
            makes_no_sense = (
                isinstance(message, UnknownMessage) and message.payload[:1] in _ANSWER_CODES
            )
            if self.expected and makes_no_sense and self.unexpected is None:
                self.unexpected = message
            return False
        if self.expected:
            self._came.append(message)
        else:
            self.stray_count += 1  # not kept: a faulty module may never stop sending them
        if isinstance(message, m.Pong):
            self._pongs_owed = max(self._pongs_owed - 1, 0)
            self.pongs_possible = max(self.pongs_possible - 1, 0)
        return True

    def match(self) -> float | None:
        """Look for the answer in what came; return how long to wait for another from now on [s].

        None: as long as before; 0: `answer` is certain.
        """
        patience_s = None
        while self._came:
            answer = self._came.popleft()
            if isinstance(self._command, m.Ping):
                patience_s = self._match_pong(answer, patience_s)
            elif self._fits(answer):
                self.answer = answer
                return 0.0
            else:
                self.stray_count += 1
                if isinstance(answer, m.Pong) and self._late_pongs:
                    self._late_pongs -= 1
                elif isinstance(answer, m.ReplyString) and self._tokens_out:
                    self._tokens_out -= 1
                elif not (
                    self._as_token or self.unexpected or isinstance(answer, m.BOOTLOADER_ERRORS)
                ):
                    self.unexpected = answer
                    patience_s = self._timeout_s * _AFTER_A_WRONG_ONE
        return patience_s

    def _fits(self, answer: Response) -> bool:
        if isinstance(answer, m.Error):
            return not self._as_token
        if isinstance(answer, m.BOOTLOADER_ERRORS):  # an ECHO has no errors: they are of another
            return not isinstance(self._command, m.BootloaderEcho)
        return isinstance(answer, self.expected) and all(
            getattr(answer, name, None) == value for name, value in self._repeated.items()
        )

    def _match_pong(self, answer: Response, patience_s: float | None) -> float | None:
        """Take the last PONG that is due: a late one describes an earlier state.

        PONGs do not echo the seed. So the PONGs due are counted, and one is taken for the last
        if no other follows soon, since a module that was off does not answer PINGs of that time.
        """
        if isinstance(answer, m.Pong):
            self.stray_count += self.answer is not None
            self.answer = answer
            return _SETTLED_S if self._pongs_owed else 0.0
        self.stray_count += 1  # PING has no errors: those are of another command, too
        if not self.answer_owed and self.unexpected is None:
            self.unexpected = answer
        return patience_s

    def settle(self) -> None:
        """Take note that `answer` is the answer, and of what is not due any more."""
        if isinstance(self._command, m.Ping):
            self._pongs_owed = 0
            if self.pongs_possible:  # it may be the answer to an earlier PING
                return
        self.answer_owed = False
        if self._as_token:
            assert self._token_at is not None
            self._tokens_out -= 1
            # it may be the answer to an earlier one: PINGs behind that one are not answered yet
            behind = self._pings - self._token_at
            self.pongs_possible = min(self.pongs_possible, behind)
            self._pongs_owed = min(self._pongs_owed, behind)
            self._token_at = None
            self._tokens.rotate()


class Conversation:
    """Commands to one module and what comes from it.

    ``name`` is what messages to people call the line. ``take_data`` is called with every message
    but answers, and the time its last byte was read [ns]. ``clock`` and ``observer`` as of
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
        self.listeners = Listeners[Response, int]()
        self.raw_listeners = Listeners[Literal["rx", "tx"], bytes, int]()
        self.statistics = LinkStatistics()
        self.matcher = Matcher()
        self.fault_count = 0
        self.reboots = 0
        self.readies = 0
        self.text = ""  # the last DATA STRING since the last question
        self.is_known = True  # whether it is the module that is meant; see `new_line`
        self._clock = clock
        self._observer = observer
        self._take_data = take_data
        self._connection = Connection(Role.HOST, self.statistics)
        self._winding_down = False
        self.begin()
        self._frames_since = False  # the last question
        self._damaged_since = False  # since the last frame or answer
        self._rebooted_since = False

    def ask(self, command: Command[Response], timeout_s: float, *, as_token: bool = False) -> bytes:
        """Return the bytes that ask ``command``; see `Matcher.ask`.

        Raises `LocalProtocolError` if the protocol cannot express the command; nothing is asked
        then.
        """
        data = self._connection.send(command)
        self.matcher.ask(command, timeout_s, as_token=as_token)
        self._frames_since = False
        self.text = ""
        if self._observer is not None:
            self.report("tx", summary(command))
        return data

    def hear(self, direction: Literal["rx", "tx"], data: bytes, t_ns: int) -> None:
        """Hand bytes of the line to the raw listeners, unless another module may have sent them."""
        if self.raw_listeners.all and self.is_known:
            self.raw_listeners(direction, data, t_ns)

    def begin(self) -> None:
        """Count no damage before the next message, or the answer to a question that is asked.

        Of what a module sent before, to another program or until a reset, the rest may still come.
        """
        seen = self.statistics
        self._before = seen.junk_bytes, seen.resyncs, seen.faults.copy(), self.fault_count
        self._has_begun = False

    def _leave_out_damage(self) -> None:
        seen, (junk_bytes, resyncs, faults, self.fault_count) = self.statistics, self._before
        seen.bytes -= seen.junk_bytes - junk_bytes
        seen.junk_bytes, seen.resyncs, seen.faults = junk_bytes, resyncs, faults.copy()

    def receive(self, data: bytes, arrival_ns: int) -> None:
        self.hear("rx", data, arrival_ns)
        connection = self._connection
        try:
            connection.receive_data(data)
            while (event := connection.next_event()) is not NEED_DATA:
                if isinstance(event, Response):
                    self._sort(event, arrival_ns)
                elif isinstance(event, FramingFault) and not self._winding_down:
                    self._damaged_since = True
                    if self.is_known:
                        self.fault_count += 1
                        self.report("fault", f"{event.kind.value} at byte {event.offset}")
        except Exception:  # of a listener or an observer
            raise
        except BaseException:  # an interrupt, perhaps while the receiver moved its bytes
            self._connection = Connection(Role.HOST, self.statistics if self.is_known else None)
            raise

    def _sort(self, message: Response, arrival_ns: int) -> None:
        if not self._has_begun:
            self._leave_out_damage()
            self._has_begun = not self.matcher.expected or isinstance(message, m.ANSWERS)
        if not self.is_known and not isinstance(message, m.ANSWERS):
            self._frames_since |= isinstance(message, FRAMES)
            return
        if self.listeners.all and self.is_known:
            self.listeners(message, arrival_ns)
        if isinstance(message, FRAMES):
            self._damaged_since = self._rebooted_since = False
            self._frames_since = True
            self._take_data(message, arrival_ns)
            return
        if self.matcher.take(message):
            self._damaged_since = self._rebooted_since = False
        else:
            self._take_data(message, arrival_ns)
            if isinstance(message, m.DataString):
                self.text = message.text
            if isinstance(message, m.System):
                self.readies += message.code == SystemCode.XTS_SPRS_READY
                if message.code == SystemCode.XTS_SPRS_BOOTING:
                    self.reboots += 1
                    self._rebooted_since = True
        if self._observer is not None:
            row = ROWS.get(type(message))
            if row is None or not row.bulk:
                self.report("rx", summary(message))

    def new_line(self, name: str, *, is_known: bool = True) -> None:
        """Begin anew on a line that was just opened: no answer is due and no packet half-read.

        ``is_known`` False: another module may answer there. Until `recognise` is called, all but
        answers is ignored, and nothing of it is counted.
        """
        self.name = name
        if self.is_known:
            self.statistics.junk_bytes += self._connection.buffered  # the rest of them never came
        self._connection = Connection(Role.HOST, self.statistics if is_known else None)
        self.is_known = is_known
        self.matcher.forget()
        self._damaged_since = self._rebooted_since = False

    def recognise(self) -> None:
        """Take what comes from now on for what the module sends."""
        self._connection.count_in(self.statistics)
        self.is_known = True

    def wind_down(self) -> None:
        """Read answers only from now on.

        An interrupt may have come while bytes were taken in, so what is half-read is forgotten;
        the rest of a packet that was cut so looks like damage and is neither reported nor counted,
        and the frames after it would show a gap.
        """
        self._winding_down = True
        self._take_data = lambda message, arrival_ns: None
        self._connection = Connection(Role.HOST)

    def deadline_ns(self, timeout_s: float, began_ns: int | None = None) -> int:
        """Time of the clock [ns] at which a timeout is over; an infinite one takes 30 years.

        It began at ``began_ns``, by default now.
        """
        if began_ns is None:
            began_ns = self._clock()
        return began_ns + round(min(timeout_s, _ENDLESS_S) * 1e9)

    def silence(
        self,
        what: str,
        timeout_s: float,
        likely: str = "is it an X4M300, powered and not in its bootloader?",
    ) -> ResponseTimeout:
        """Error for something that did not come, with the likeliest reason and remedy.

        Only bytes since the last frame or answer count: earlier ones are not the reason.
        ``likely`` is the reason given when nothing came at all.
        """
        missing = f"no {what} from {self.name} within {timeout_s:g} s"
        if self._rebooted_since:
            return ResponseTimeout(
                f"{missing}: the module restarted meanwhile and forgot its settings; begin again"
            )
        if self._damaged_since:
            return ResponseTimeout(
                f"{missing}, but bytes that are not XeThru packets; "
                "is it another device, or another baud rate?"
            )
        return ResponseTimeout(f"{missing}; {likely}")

    def unanswered(self, command: Command[Response], timeout_s: float) -> XeThruError:
        """Error for a command that got no answer, or only one that does not fit."""
        unexpected = self.matcher.unexpected
        if unexpected is None:
            what = f"answer to {summary(command)}"
            if self._frames_since:
                likely = (
                    "it sends frames meanwhile: do they fill the line (a UART of 115200 baud "
                    "carries 2 a second of 1431 bins), or does it not know this command in its "
                    "mode?"
                )
                return self.silence(what, timeout_s, likely)
            return self.silence(what, timeout_s)
        row = ROWS[type(command)]
        wanted = " or ".join(ROWS[reply].name for reply in row.replies)
        if row.content_id is not None:
            wanted += f" with content id 0x{row.content_id(command):X}"
        if isinstance(command, m.SystemGetInfo):
            wanted += f" and info {command.item}"
        came = summary(unexpected)
        if len(came) > _SHOWN:
            came = f"{came[:_SHOWN]}..."
        text = (
            f"{self.name} answered {summary(command)} with {came}, where {wanted} was expected; "
            "is its firmware another one, or does another program use the port, too?"
        )
        # without PONG it is a timeout, after which callers ask a module that starts again
        return ResponseTimeout(text) if isinstance(command, m.Ping) else RemoteProtocolError(text)

    def report(self, direction: Literal["tx", "rx", "fault", "warning"], text: str) -> None:
        if self._observer is not None:
            self._observer(ProtocolRecord(t_ns=self._clock(), direction=direction, summary=text))


def bootloader_error(
    answer: m.BootloaderError | m.BootloaderFramingError, command: Command[Response]
) -> DeviceError:
    code, meaning = BootloaderReply.FRAMING_ERROR, ""
    if isinstance(answer, m.BootloaderError):
        code = BootloaderReply(answer.code)
    elif answer.code in set(BootloaderFraming):
        meaning = f" {BootloaderFraming(answer.code).name}"
    return DeviceError(code, summary(command), code.name + meaning)


def summary(message: m.Message) -> str:
    """One line about a message, for logs and errors.

    >>> from xethru_protocol.wire.messages import X4DriverSet
    >>> from xethru_protocol.wire.codes import X4Setting
    >>> summary(X4DriverSet(setting=X4Setting.FPS, value=17.0))
    'X4DRIVER_SET id=FPS value=17.0'
    """
    name, shown = describe(message)
    parts = (f"{key}={value}" for key, value in shown.items() if value is not None)
    return " ".join([name, *parts])
