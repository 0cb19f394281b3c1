"""The conversation with one module, without I/O: what was asked, and what came.

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
from xethru_protocol.wire.codes import BootloaderFraming, BootloaderReply, SystemCode
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.errors import (
    DeviceError,
    RemoteProtocolError,
    ResponseTimeout,
    XeThruError,
)
from xethru_protocol.wire.framing import NEED_DATA, FramingFault, LinkStatistics
from xethru_protocol.wire.rows import ROWS, Command, Response, UnknownMessage

FRAMES = (m.DataFloat, m.BasebandIq)  # a tuple is the faster argument of isinstance
_ENDLESS_S = 1e9
BOOTLOADER_ERRORS = (m.BootloaderError, m.BootloaderFramingError)
_ANSWERS = (
    *(m.Ack, m.Error, m.Pong, m.ReplyByte, m.ReplyInt, m.ReplyFloat, m.ReplyString),
    *(m.BootloaderSuccess, m.BootloaderEchoed, *BOOTLOADER_ERRORS),
)
_ANSWER_CODES = (b"\x01", b"\x10", b"\x11", b"\x20")  # PONG, ACK, REPLY, ERROR
_SHOWN = 160  # characters of an answer in an error


@dataclass(frozen=True, slots=True, kw_only=True)
class ProtocolRecord:
    """One line of the protocol log: everything on the wire but frames."""

    t_ns: int
    direction: Literal["tx", "rx", "fault", "warning"]
    summary: str


Observer = Callable[[ProtocolRecord], None]
Listener = Callable[[Response, int], None]
RawListener = Callable[[Literal["rx", "tx"], bytes, int], None]


class Conversation:
    """Commands to one module and what comes from it.

    ``name`` is what messages to people call the line. ``take_data`` is called with every message
    but answers, and the time its last byte was read [ns]. ``clock`` and ``observer`` as of
    `X4M300`; its properties describe the listener and the counters.

    Attributes
    ----------
    answers
        Those that came since the last question.
    expected
        What would answer it besides ERROR; empty if no command waits for an answer.
    answer_owed
        Whether the answer of a request that was given up may still come. The module answers in
        order, so a PING brings both sides into step again: answers before its PONG are dropped
        (Protocol reference 13). That holds only if no other PONG may come.
    pings
        PINGs that were sent.
    pongs_owed
        PONGs that are due, but for those that are taken for never sent.
    pongs_possible
        PONGs that may still come, at most.
    unexpected
        First answer since the last question that does not fit it.
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
        self.answers: deque[Response] = deque()
        self.expected: tuple[type[Response], ...] = ()
        self.answer_owed = False
        self.pings = self.pongs_owed = self.pongs_possible = 0
        self.unexpected: Response | None = None
        self._winding_down = False
        self._frames_since = False  # the last question
        self._damaged_since = False  # since the last frame or answer
        self._rebooted_since = False

    def ask(self, command: Command[Response]) -> bytes:
        """Return the bytes that ask ``command``, whose answer is kept from now on.

        An answer that arrived before belongs to no request and is dropped. Raises
        `LocalProtocolError` if the protocol cannot express the command; nothing is asked then.
        """
        data = self._connection.send(command)
        self.stray_count += len(self.answers)
        self.answers.clear()
        self.unexpected = None
        self._frames_since = False
        self.expected = ROWS[type(command)].replies
        if isinstance(command, m.Ping):
            self.pings += 1
            self.pongs_owed += 1
            self.pongs_possible += 1
        else:
            self.answer_owed = True  # also if this is left by an interrupt
        if self._observer is not None:
            self.report("tx", summary(command))
        return data

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
            self._frames_since = True
            self._take_data(message, arrival_ns)
            return
        # some firmware answers with a message that other firmware sends unasked
        if isinstance(message, (_ANSWERS, self.expected)):
            self._damaged_since = self._rebooted_since = False
            if not self.expected:
                self.stray_count += 1  # not kept: a faulty module may never stop sending them
            else:
                self.answers.append(message)
            if isinstance(message, m.Pong):
                self.pongs_owed = max(self.pongs_owed - 1, 0)
                self.pongs_possible = max(self.pongs_possible - 1, 0)
        elif isinstance(message, m.System):
            self._take_data(message, arrival_ns)
            self.readies += message.code == SystemCode.XTS_SPRS_READY
            if message.code == SystemCode.XTS_SPRS_BOOTING:
                self.reboots += 1
                self._rebooted_since = True
        else:
            self._take_data(message, arrival_ns)
            if self.expected and isinstance(message, UnknownMessage):
                self._look_at(message)
        if self._observer is not None:
            row = ROWS.get(type(message))
            if row is None or not row.bulk:
                self.report("rx", summary(message))

    def _look_at(self, message: UnknownMessage) -> None:
        """Keep an answer that makes no sense, for the error that there will be."""
        if message.payload[:1] in _ANSWER_CODES and self.unexpected is None:
            self.unexpected = message

    def new_line(self, name: str) -> None:
        """Begin anew on a line that was just opened: no answer is due and no packet half-read."""
        self.name = name
        self.statistics.junk_bytes += self._connection.buffered  # the rest of them never came
        self._connection = Connection(Role.HOST, self.statistics)
        self.answers.clear()
        self.expected = ()
        self.answer_owed = False
        self.pongs_owed = self.pongs_possible = 0
        self.unexpected = None
        self._damaged_since = self._rebooted_since = False

    def wind_down(self) -> None:
        """Read answers only from now on.

        An interrupt may have come while bytes were taken in, so what is half-read is forgotten;
        the rest of a packet that was cut so looks like damage and is neither reported nor counted,
        and the frames after it would show a gap.
        """
        self._winding_down = True
        self._take_data = lambda message, arrival_ns: None
        self._connection = Connection(Role.HOST)
        self.answers.clear()

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
                f"{missing}, but bytes that are no XeThru packets; "
                "is it another device, or another baud rate?"
            )
        return ResponseTimeout(f"{missing}; {likely}")

    def unanswered(self, command: Command[Response], timeout_s: float) -> XeThruError:
        """Error for a command that got no answer, or only one that does not fit."""
        if self.unexpected is None:
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
        came = summary(self.unexpected)
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
