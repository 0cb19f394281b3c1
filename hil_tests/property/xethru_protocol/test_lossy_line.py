"""A host and a module over lines that drop, flip, insert, repeat and cut bytes."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NEED_DATA, Direction, FramingFault, Packet, PacketReader

LONGEST_PACKET = 9 + 65535
SILENCE = bytes(LONGEST_PACKET)  # after so many bytes without a start every doubt is settled

_SPECIALS = np.frombuffer(bytes.fromhex("7C7C7C7C 7D7E7F7D 7F7F7E7D 12000000"), "<f4")
RESPONSES: list[m.Message] = [
    m.Ack(),
    m.Pong(value=0xAAEEAEEA),
    m.Error(code=0x7D7E7F7C),
    m.ReplyString(content_id=0, info=0, text="a name"),
    m.ReplyInt(content_id=16, info=0x7E7E7E7E, values=(1, 0x7F7F7F7F)),
    m.DataFloat(info=7, values=_SPECIALS),
    m.DataFloat(info=8, values=np.zeros(60, np.float32)),
    m.DataString(content_id=0, info=0, text="}~\x7f||||"),
]
COMMANDS: list[m.Message] = [
    m.Ping(),
    m.ModReset(),
    m.X4DriverSet(setting=X4Setting.FRAMEAREA, value=(0.25, 9.5)),
    m.X4DriverGet(setting=X4Setting.FPS),
]
PAYLOADS = st.lists(st.sampled_from([0x51, 0x7C, 0x7D, 0x7E, 0x7F, 0x00]), max_size=12).map(
    lambda rest: bytes((0xB7, *rest))
)
UNKNOWN = PAYLOADS.map(lambda payload: m.UnknownMessage(code=0xB7, payload=payload))


@dataclass(slots=True, kw_only=True)
class Sent:
    """A packet on its way."""

    message: Any
    payload: bytes
    touched: bool = False
    begin: int = -1  # offset of its first byte among the bytes delivered


class Line:
    """One direction: what is in flight, what was damaged, what must arrive."""

    def __init__(self, sender: Connection, receiver: Connection) -> None:
        self._sender = sender
        self._receiver = receiver
        is_host = receiver.role is Role.HOST
        # the same receiver once more, which tells where packets were found
        self._places = PacketReader(Direction.FROM_MODULE if is_host else Direction.FROM_HOST)
        self._flight: list[tuple[Sent | None, int]] = []
        self._delivered = 0
        self._untouched: dict[int, Sent] = {}
        self._messages = 0
        self._faults = 0
        self.clean = True

    def send(self, message: Any) -> None:  # noqa: ANN401 - any message
        wire = self._sender.send(message)
        payload = wire[9:] if wire.startswith(b"\x7c" * 4) else _unescaped(wire)
        packet = Sent(message=message, payload=payload)
        self._flight += [(packet, byte) for byte in wire]

    def damage(self, kind: str, where: float, byte: int, count: int) -> None:
        """Do one thing to the bytes in flight at the part ``where`` of them."""
        self.clean = False
        at = int(where * len(self._flight))
        hit = self._flight[at : at + count]
        match kind:
            case "drop":
                del self._flight[at : at + count]
            case "flip" if hit:
                hit = hit[:1]
                self._flight[at] = (hit[0][0], hit[0][1] ^ (byte or 1))
            case "insert":
                hit = self._torn_at(at)
                self._flight[at:at] = [(None, byte)] * count
            case "repeat":
                again = [(None, value) for _, value in hit]
                hit = self._torn_at(at)
                self._flight[at:at] = again
        for packet, _ in hit:
            if packet is not None:
                packet.touched = True

    def _torn_at(self, at: int) -> list[tuple[Sent | None, int]]:
        """Bytes of the packet that something put in at ``at`` would tear apart."""
        if 0 < at < len(self._flight) and self._flight[at - 1][0] is self._flight[at][0]:
            return [self._flight[at]]
        return []

    def deliver(self, count: int) -> None:
        """Hand over the next bytes and judge what the receiver makes of them."""
        chunk, self._flight = self._flight[:count], self._flight[count:]
        complete = []
        following = [packet for packet, _ in [*chunk[1:], *self._flight[:1]]] + [None]
        for index, ((packet, _), next_packet) in enumerate(zip(chunk, following, strict=False)):
            if packet is None:
                continue
            if packet.begin < 0:
                packet.begin = self._delivered + index
            if next_packet is not packet:
                complete.append(packet)
                if not packet.touched:
                    self._untouched[packet.begin] = packet
        self._delivered += len(chunk)
        found, faults = self._hear(bytes(byte for _, byte in chunk))
        if self.clean:
            assert found == [packet.message for packet in complete]
            assert not faults

    def silence(self) -> None:
        """Deliver what is in flight, then bytes without a start until nothing is in doubt."""
        self.deliver(len(self._flight))
        self._delivered += len(SILENCE)
        self._hear(SILENCE)
        assert self._receiver.buffered == 0
        self.clean = True

    def _hear(self, data: bytes) -> tuple[list[Any], int]:
        self._receiver.receive_data(data)
        self._places.receive_data(data)
        found: list[Any] = []
        faults = 0
        while (event := self._receiver.next_event()) is not NEED_DATA:
            place = self._places.next_packet()
            if isinstance(event, FramingFault):
                assert place == event
                faults += 1
                continue
            assert isinstance(place, Packet)
            found.append(event)
            sent = self._untouched.get(place.offset)
            if sent is not None:
                assert place.payload == sent.payload
                assert event == sent.message
        assert self._places.next_packet() is NEED_DATA
        self._messages += len(found)
        self._faults += faults
        return found, faults

    def check_books(self) -> None:
        """Compare the receiver's totals with what was delivered and heard."""
        statistics = self._receiver.statistics
        assert self._receiver.buffered <= LONGEST_PACKET
        assert statistics.bytes == self._delivered
        assert statistics.packets == self._messages
        assert statistics.faults.total() == self._faults
        # the shortest packet has four bytes
        judged = statistics.bytes - self._receiver.buffered
        assert statistics.junk_bytes + 4 * statistics.packets <= judged
        assert statistics.packets or statistics.junk_bytes == judged


def _unescaped(wire: bytes) -> bytes:
    content, escaped = bytearray(), False
    for byte in wire[1:-1]:
        if byte != 0x7F or escaped:
            content.append(byte)
            escaped = False
        else:
            escaped = True
    return bytes(content[:-1])


LINES = st.sampled_from(["to host", "to module"])


class LossyLine(RuleBasedStateMachine):
    """Whatever happens to the bytes, what nothing happened to gets through."""

    def __init__(self) -> None:
        super().__init__()
        host, module = Connection(Role.HOST), Connection(Role.MODULE)
        self.lines = {"to host": Line(module, host), "to module": Line(host, module)}

    @rule(message=st.sampled_from(RESPONSES) | UNKNOWN)
    def module_speaks(self, message: Any) -> None:  # noqa: ANN401 - any message
        self.lines["to host"].send(message)

    @rule(message=st.sampled_from(COMMANDS) | UNKNOWN)
    def host_speaks(self, message: Any) -> None:  # noqa: ANN401 - any message
        self.lines["to module"].send(message)

    @rule(line=LINES, count=st.integers(1, 400))
    def bytes_arrive(self, line: str, count: int) -> None:
        self.lines[line].deliver(count)

    @rule(
        line=LINES,
        kind=st.sampled_from(["drop", "flip", "insert", "repeat"]),
        where=st.floats(0, 0.999),
        byte=st.sampled_from([0x7C, 0x7D, 0x7E, 0x7F, 0x01]) | st.integers(0, 255),
        count=st.integers(1, 30),
    )
    def bytes_are_damaged(self, line: str, kind: str, where: float, byte: int, count: int) -> None:
        self.lines[line].damage(kind, where, byte, count)

    @precondition(lambda self: not all(line.clean for line in self.lines.values()))
    @rule(line=LINES)
    def line_falls_silent(self, line: str) -> None:
        self.lines[line].silence()

    @invariant()
    def books_balance(self) -> None:
        for line in self.lines.values():
            line.check_books()

    def teardown(self) -> None:
        """In the end both lines carry every message again."""
        for line, messages in zip(self.lines.values(), (RESPONSES, COMMANDS), strict=True):
            line.silence()
            for message in messages:
                line.send(message)
            for _ in range(80):
                line.deliver(23)
            line.check_books()


TestLossyLine = LossyLine.TestCase
TestLossyLine.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
