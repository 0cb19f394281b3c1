"""Commands and their answers over a transport, among everything else a module sends.

The module answers commands in order and without sequence numbers, and sends frames and SYSTEM
messages whenever it likes (Protocol reference 3). What is read is sorted at once: answers go to
the one outstanding request, everything else to whoever wants the stream, faults are counted.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeVar

from xethru_protocol.codec import describe
from xethru_protocol.codes import SystemCode, error_name
from xethru_protocol.connection import Connection, Role
from xethru_protocol.errors import DeviceError, ResponseTimeout
from xethru_protocol.messages import (
    Ack,
    BasebandIq,
    Command,
    DataFloat,
    Error,
    Message,
    Ping,
    Pong,
    ReplyByte,
    ReplyFloat,
    ReplyInt,
    ReplyString,
    Response,
    System,
)
from xethru_protocol.packets import NEED_DATA, FramingFault
from xethru_protocol.table import ROWS
from xethru_protocol.transport import Transport

_ENDLESS_S = 1e9
_ANSWERS = (Ack, Error, Pong, ReplyByte, ReplyInt, ReplyFloat, ReplyString)
_STALE_READS = 64  # more than any port buffers; a bound, since a fast module never pauses

ReplyT = TypeVar("ReplyT", bound=Response)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProtocolRecord:
    """One line of the protocol log: everything on the wire but frames."""

    t_ns: int
    direction: Literal["tx", "rx", "fault", "warning"]
    summary: str


Observer = Callable[[ProtocolRecord], None]
FrameMessage = DataFloat | BasebandIq


class Dialogue:
    """The conversation with one module.

    Parameters
    ----------
    transport
        An open line.
    clock
        Monotonic time [ns].
    observer
        Called with every command, answer, SYSTEM message, fault and warning; None: nobody.
    take_frame
        Called with every frame message and the time its last byte was read [ns].

    Attributes
    ----------
    fault_count
        Damaged places seen on the line.
    stray_count
        Answers that belong to no request.
    reboots
        SYSTEM BOOTING messages seen.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Callable[[], int],
        observer: Observer | None,
        take_frame: Callable[[FrameMessage, int], None],
    ) -> None:
        self.fault_count = 0
        self.stray_count = 0
        self.reboots = 0
        self._transport = transport
        self._clock = clock
        self._observer = observer
        self._take_frame = take_frame
        self._connection = Connection(Role.HOST)
        self._answers: deque[Response] = deque()
        self._answer_owed = False
        self._winding_down = False
        self._damaged_since = False  # since the last frame or answer
        self._rebooted_since = False

    def request(self, command: Command[ReplyT], timeout_s: float) -> ReplyT:
        """Send a command, return its reply; see `X4M300.request`.

        After a request that was given up its answer may still come. The module answers in
        order, so a PING is sent first and all before its PONG dropped (Protocol reference 13).
        """
        data = self._connection.send(command)
        if self._answer_owed and not isinstance(command, Ping):
            self._exchange(Ping(), self._connection.send(Ping()), timeout_s)
        return self._exchange(command, data, timeout_s)

    def _exchange(self, command: Command[ReplyT], data: bytes, timeout_s: float) -> ReplyT:
        self.take_stale_input()
        row = ROWS[type(command)]
        content_id = row.content_id(command) if row.content_id else None
        self._answer_owed = True  # also if this is left by an interrupt
        self._transport.write(data)
        if self._observer is not None:
            self.tell("tx", summary(command))
        deadline = self.deadline_ns(timeout_s)
        while True:
            while self._answers:
                answer = self._answers.popleft()
                if isinstance(answer, Error) and not isinstance(command, Ping):
                    self._answer_owed = False  # PING has no errors: that one is of another command
                    meaning = error_name(answer.code, row.errors)
                    raise DeviceError(answer.code, summary(command), meaning)
                if isinstance(answer, row.replies) and (
                    content_id is None or getattr(answer, "content_id", None) == content_id
                ):
                    self._answer_owed = False
                    # isinstance checked it: the row's replies are what ReplyT stands for
                    return answer  # type: ignore[return-value]
                self.stray_count += 1
            left_ns = deadline - self._clock()
            if left_ns <= 0:
                raise self.silence(f"answer to {summary(command)}", timeout_s)
            self.pump(left_ns * 1e-9)

    def deadline_ns(self, timeout_s: float) -> int:
        """Time of the clock [ns] at which a timeout is over; an infinite one takes 30 years."""
        return self._clock() + round(min(timeout_s, _ENDLESS_S) * 1e9)

    def wind_down(self) -> None:
        """From now on care for answers only.

        An interrupt may have come while bytes were taken in, so what is half-read is forgotten;
        the rest of a packet that was cut so looks like damage and is not reported.
        """
        self._winding_down = True
        self._connection = Connection(Role.HOST)
        self._answers.clear()

    def pump(self, timeout_s: float) -> bool:
        """Read once and sort what came; False if nothing did in time."""
        data = self._transport.read(timeout_s)
        if not data:
            return False
        arrival_ns = self._clock()
        self._connection.receive_data(data)
        while (event := self._connection.next_event()) is not NEED_DATA:
            if isinstance(event, DataFloat | BasebandIq):
                self._sign_of_life()
                self._take_frame(event, arrival_ns)
            elif isinstance(event, FramingFault):
                if not self._winding_down:
                    self.fault_count += 1
                    self._damaged_since = True
                    self.tell("fault", f"{event.kind.value} at byte {event.offset}")
            elif isinstance(event, Message):
                if isinstance(event, _ANSWERS):
                    self._sign_of_life()
                    self._answers.append(event)
                elif isinstance(event, System) and event.code == SystemCode.XTS_SPRS_BOOTING:
                    self.reboots += 1
                    self._rebooted_since = True
                if self._observer is not None:
                    self.tell("rx", summary(event))
        return True

    def take_stale_input(self) -> None:
        """Sort what arrived before a request: an answer among it belongs to no request."""
        for _ in range(_STALE_READS):
            if not self.pump(0.0):
                break
        self.stray_count += len(self._answers)
        self._answers.clear()

    def silence(
        self,
        what: str,
        timeout_s: float,
        likely: str = "is it an X4M300, powered and not in its bootloader?",
    ) -> ResponseTimeout:
        """Error for something that did not come, with the likeliest reason and remedy.

        Judged by what came since the last frame or answer: what was before that explains nothing.
        ``likely`` is said when nothing came at all.
        """
        missing = f"no {what} from {self._transport.name} within {timeout_s:g} s"
        if self._rebooted_since:
            return ResponseTimeout(f"{missing}: the module restarted meanwhile; start it again")
        if self._damaged_since:
            return ResponseTimeout(
                f"{missing}, but bytes that are no XeThru packets; "
                "is it another device, or another baud rate?"
            )
        return ResponseTimeout(f"{missing}; {likely}")

    def tell(self, direction: Literal["tx", "rx", "fault", "warning"], text: str) -> None:
        """Tell the observer."""
        if self._observer is not None:
            self._observer(ProtocolRecord(t_ns=self._clock(), direction=direction, summary=text))

    def _sign_of_life(self) -> None:
        self._damaged_since = False
        self._rebooted_since = False


def summary(message: Message) -> str:
    """One line about a message, for logs and errors.

    >>> from xethru_protocol.messages import X4DriverSet
    >>> from xethru_protocol.codes import X4Setting
    >>> summary(X4DriverSet(setting=X4Setting.FPS, value=17.0))
    'X4DRIVER_SET id=FPS value=17.0'
    """
    name, shown = describe(message)
    parts = (f"{key}={value}" for key, value in shown.items() if value is not None)
    return " ".join([name, *parts])
