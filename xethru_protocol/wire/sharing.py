"""Several hosts at one module, without I/O: what it sends goes to all, changes come from one.

A module takes one command at a time and answers in order without saying whom (Protocol reference
3), so a question waits until those of other hosts are answered. Everybody may ask; settings are
changed by the host that did so first, until it leaves. Others are refused as a module refuses: a
DATA STRING with the reason, then ERROR (4.1).
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import decode_command, decode_response, encode
from xethru_protocol.wire.codes import ErrorCode, SystemCode
from xethru_protocol.wire.framing import (
    Direction,
    Framing,
    FramingFault,
    NeedData,
    Packet,
    PacketReader,
    encode_no_escape,
    encode_normal,
    is_misread,
)
from xethru_protocol.wire.table import ROWS, Command, Response

SETTINGS_CHANGE = "another program changes the settings"
"""Text for the other hosts, before frames of other settings can come."""
MOST_UNSENT = 1 << 20
"""Bytes that wait for one host; messages that would make it more are lost for that host."""
# How long others wait for an answer: longer than a mode change or a restart of the chip takes, and
# for a mere question, which a module may leave unanswered (4.4), shorter than hosts have patience.
_COMMAND_NS, _QUESTION_NS = 10_000_000_000, 1_000_000_000
# Of one host: asked one after the other while others wait, and not asked yet.
_MOST_IN_A_ROW, _MOST_WAITING = 64, 1024
_READINGS = {m.Pong, m.ReplyByte, m.ReplyInt, m.ReplyFloat, m.ReplyString, m.ParameterFile}
_NOT_FOR_ALL = (m.X4DriverRead, m.X4DriverReadI2c)  # reading a FIFO empties it
_CHANGES = (
    *(m.X4DriverInit, m.X4DriverSet, m.X4DriverWrite, m.FramePostprocessingSet),
    *(m.SetMode, m.LoadApp, m.FactoryPreset, m.ModReset, m.StartBootloader, m.UnknownMessage),
)
"""After these, frames may be others than before."""


class Host:
    """One of those who share a module.

    Attributes
    ----------
    send
        Called with every message for it, as bytes.
    unsent
        Returns how many bytes of them wait.
    messages, lost
        Messages that it was given, and those that it was too slow for.
    """

    def __init__(
        self, name: str, send: Callable[[bytes], object], unsent: Callable[[], int]
    ) -> None:
        self.name, self.send, self.unsent = name, send, unsent
        self.messages = 0
        self.lost = 0
        self.reader = PacketReader(Direction.FROM_HOST)
        self.knows_of_change = False  # since it asked, or got a frame
        self.n_waiting = 0  # questions


@dataclass(frozen=True, slots=True, eq=False)
class _Question:
    host: Host
    command: Command[Response]
    payload: bytes
    replies: tuple[type[Response], ...]  # that answer it besides ERROR; empty: any
    limit_ns: int


class SharedModule:
    """A module and its hosts; damaged bytes are not passed on.

    Parameters
    ----------
    write
        Called with what the module should get.

    Attributes
    ----------
    hosts
        Those that have not left.
    commander
        Whose changes are carried out; None: of the first that asks for one.
    """

    def __init__(self, write: Callable[[bytes], object]) -> None:
        self._write = write
        self.hosts: list[Host] = []
        self.commander: Host | None = None
        self.line_lost()

    def line_lost(self) -> None:
        """Begin anew with a line that was just opened; the hosts are left to the caller."""
        self._reader = PacketReader(Direction.FROM_MODULE)
        self._asked: deque[_Question] = deque()  # all by one host
        self._asking: Host | None = None  # that host
        self._in_a_row = 0  # by it
        self._waiting: deque[_Question] = deque()
        self._answer_by_ns = 0
        for host in self.hosts:
            host.n_waiting = 0

    def join(self, name: str, send: Callable[[bytes], object], unsent: Callable[[], int]) -> Host:
        """Add a host; arguments as of its attributes."""
        self.hosts.append(Host(name, send, unsent))
        return self.hosts[-1]

    def leave(self, host: Host) -> None:
        """Forget a host; answers to what it asked are dropped, and others may command."""
        self.hosts.remove(host)
        for question in [one for one in self._waiting if one.host is host]:
            self._waiting.remove(question)
        if self.commander is host:
            self.commander = None

    def receive_from_host(self, host: Host, data: bytes, now_ns: int) -> None:
        host.reader.receive_data(data)
        while isinstance(found := host.reader.next_packet(), Packet | FramingFault):
            if isinstance(found, Packet):
                self._take_command(host, found.payload)
        self.advance(now_ns)

    def receive_from_module(self, data: bytes, now_ns: int) -> None:
        self._reader.receive_data(data)
        while not isinstance(found := self._reader.next_packet(), NeedData):
            if isinstance(found, Packet):
                self._pass_on(found)
        self.advance(now_ns)

    def advance(self, now_ns: int) -> None:
        """Ask the module what waits, as far as it can be asked now; to be called now and then."""
        if self._waiting and now_ns >= self._answer_by_ns:
            self._asked.clear()  # the answers do not come any more
        while True:
            if not self._asked:  # another host's comes first, lest one holds up the others
                self._in_a_row = 0
                waiting = sorted(self._waiting, key=lambda one: one.host is self._asking)
            elif self._in_a_row < _MOST_IN_A_ROW:
                waiting = [one for one in self._waiting if one.host is self._asking]
            else:
                return
            if not waiting:
                return
            question = waiting[0]
            self._waiting.remove(question)
            self._asked.append(question)
            self._asking = question.host
            question.host.n_waiting -= 1
            self._in_a_row += 1
            self._answer_by_ns = now_ns + question.limit_ns
            if isinstance(question.command, _CHANGES):
                self._announce_change(question.host)
            self._write(encode_normal(question.payload))

    def _take_command(self, host: Host, payload: bytes) -> None:
        command = decode_command(payload)
        row = ROWS.get(type(command))
        host.knows_of_change = False
        is_question = (
            row is not None
            and _READINGS.issuperset(row.replies)
            and not isinstance(command, _NOT_FOR_ALL)
            and not is_misread(payload)
        )
        reason = ""
        if host.n_waiting >= _MOST_WAITING:
            reason = f"{_MOST_WAITING} commands of this program wait for the module already"
        elif isinstance(command, m.SetBaudRate):
            reason = "xethru share keeps the rate of its line; start it with another --baudrate"
        elif not is_question:
            self.commander = self.commander or host
            if self.commander is not host:
                reason = (
                    f"{self.commander.name} commands this shared module; --attach takes its frames"
                )
        if reason:
            code = getattr(row and row.errors, "BUSY", ErrorCode.XTS_SPRE_BUSY)
            self._give(host, m.DataString(text=reason))
            self._give(host, m.Error(code=code))
            return
        replies = () if row is None or Response in row.replies else row.replies
        limit_ns = _QUESTION_NS if is_question else _COMMAND_NS
        host.n_waiting += 1
        self._waiting.append(_Question(host, command, payload, replies, limit_ns))

    def _pass_on(self, packet: Packet) -> None:
        message = decode_response(packet.payload)
        is_bulk = packet.framing is Framing.NO_ESCAPE
        data = encode_no_escape(packet.payload) if is_bulk else encode_normal(packet.payload)
        expected = self._asked[0].replies if self._asked else ()
        if isinstance(message, (*m.ANSWERS, *expected)):
            host = self._whose(message)
            if host in self.hosts:
                self._add(host, data)
            return
        if message == _BOOTING:  # what was asked before will not be answered
            self._asked.clear()
        for host in self.hosts:
            if host.unsent() + len(data) > MOST_UNSENT:
                host.lost += 1
            else:
                self._add(host, data)
                host.knows_of_change &= not is_bulk

    def _whose(self, answer: Response) -> Host | None:
        """Return who asked for an answer; where it answers nothing, who may have given up."""
        for index, question in enumerate(self._asked):
            if not question.replies or isinstance(
                answer, (m.Error, *m.BOOTLOADER_ERRORS, *question.replies)
            ):
                for _ in range(index + 1):  # the module answers in order
                    self._asked.popleft()
                return question.host
        return self._asked[0].host if self._asked else self.commander

    def _announce_change(self, by: Host) -> None:
        for host in self.hosts:
            if host is not by and not host.knows_of_change:
                host.knows_of_change = True
                self._give(host, m.DataString(text=SETTINGS_CHANGE))

    def _give(self, host: Host, message: Response) -> None:
        self._add(host, encode_normal(encode(message, bulk=False)))

    @staticmethod
    def _add(host: Host, data: bytes) -> None:
        host.send(data)
        host.messages += 1


_BOOTING = m.System(code=SystemCode.XTS_SPRS_BOOTING)
