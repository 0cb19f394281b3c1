"""Laws of both drivers: against a model of the module, and on lines that lose bytes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from hil_tests.property.device_model import (
    IDLE,
    MANUAL,
    OK,
    PRESENCE_2,
    REG,
    RUN,
    SILENCE,
    STOP,
    VOLATILE,
    ModuleModel,
    Verdict,
)
from hil_tests.property.examples import examples
from hil_tests.property.wire_streams import oracle
from hil_tests.unit.emulator.doubles import BareHost, ramp_device
from hil_tests.unit.xethru_protocol.scripted import READY, ScriptedTransport
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import encode
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.errors import DeviceError, LocalProtocolError, ResponseTimeout
from xethru_protocol.wire.framing import (
    NEED_DATA,
    Direction,
    FramingFault,
    Packet,
    PacketReader,
    is_misread,
)

SECOND = 1_000_000_000
_WORK_NS = 20_000_000
TAG = 1000  # above all codes that have a meaning


class StallingModule:
    """Answers in order, one per 20 ms, and after a stall all that waited; some answers are lost.

    A SET is refused with the number that was to be set, so that each answer names its command.
    """

    def __init__(self, stalls: Sequence[tuple[int, int]], losses: set[int]) -> None:
        self._stalls = stalls
        self._losses = losses
        self._count = 0
        self._busy_until_ns = 0
        self.line = ScriptedTransport(self)

    def __call__(self, command: m.Message) -> Sequence[m.Message | bytes]:
        self._count += 1
        now_ns = self.line.now_ns
        end_ns = max((end for begin, end in self._stalls if begin <= now_ns < end), default=now_ns)
        self._busy_until_ns = end_ns = max(end_ns, self._busy_until_ns + _WORK_NS)
        if self._count in self._losses:
            return []
        answer: m.Message = READY
        if isinstance(command, m.X4DriverSet):
            assert isinstance(command.value, int)
            answer = m.Error(code=command.value)
        elif isinstance(command, m.SystemGetInfo):
            answer = m.ReplyString(content_id=0x58, info=command.item, text="1.6.8")
        self.line.say_later((end_ns - now_ns) * 1e-9, answer)
        return []


@st.composite
def stalls(draw: st.DrawFn) -> list[tuple[int, int]]:
    begins = draw(st.lists(st.integers(0, 60), max_size=5, unique=True).map(sorted))
    lengths = draw(st.lists(st.floats(0.5, 12.0), min_size=5, max_size=5))
    return [
        (begin * SECOND, begin * SECOND + round(length * SECOND))
        for begin, length in zip(begins, lengths, strict=False)
    ]


@settings(deadline=None, max_examples=examples(60, 150))
# the module stalls a second time with PONGs still due
@example([(0, 4 * SECOND), (3 * SECOND, 12 * SECOND)], set(), ["ping"] * 6 + ["set"] * 2)
@given(
    stalls(),
    st.sets(st.integers(1, 30), max_size=8),
    st.lists(st.sampled_from(["ping", "set", "wait"]), min_size=1, max_size=25),
)
def test_no_command_gets_the_answer_of_another(
    stalled: list[tuple[int, int]], losses: set[int], actions: list[str]
) -> None:
    module = StallingModule(stalled, losses)
    radar = X4M300(module.line, clock=module.line.clock)
    for number, action in enumerate(actions, start=TAG):
        if action == "wait":
            module.line.now_ns += SECOND // 2
            continue
        command = m.X4DriverSet(setting=X4Setting.PULSESPERSTEP, value=number)
        code = number
        try:
            radar.request(m.Ping() if action == "ping" else command)
        except ResponseTimeout:
            continue
        except DeviceError as error:
            code = error.code
        assert code == number


REPLIES = (m.Ack, m.Error, m.Pong, m.ReplyByte, m.ReplyInt, m.ReplyFloat, m.System)
FEATURES = (*VOLATILE, 0x723BFA1E, 0x723BFA1F)


MODES = st.sampled_from([RUN, RUN, RUN, IDLE, IDLE, MANUAL, STOP, REG, 0x10])


class DeviceMachine(RuleBasedStateMachine):
    @initialize()
    def power_up(self) -> None:
        self.host = BareHost(ramp_device())
        self.model = ModuleModel()

    def expect(self, command: m.Command[m.Response], verdict: Verdict, reply: m.Response) -> None:
        self.host.send(command)
        heard = [message for message in self.host.hear(5) if isinstance(message, REPLIES)]
        if verdict == OK:
            assert heard == [reply]
        elif verdict == SILENCE:
            assert heard == []
        else:
            assert heard == [m.Error(code=int(verdict))]

    def restarted(self) -> None:
        self.host.now_ns += 3 * SECOND
        self.host.device.advance(self.host.now_ns)
        heard = self.host.hear(2)
        if self.model.bootloader:
            assert heard == []
        else:
            assert heard == [m.System(code=0x10), m.System(code=0x11)]

    @precondition(lambda self: not self.model.bootloader)
    @rule(mode=MODES)
    def set_mode(self, mode: int) -> None:
        self.expect(m.SetMode(mode=mode), self.model.set_mode(mode), m.Ack())

    @precondition(lambda self: not self.model.bootloader)
    @rule(profile_id=st.sampled_from([PRESENCE_2, PRESENCE_2, 0x064E57AD, 0]))
    def load(self, profile_id: int) -> None:
        self.expect(m.LoadApp(profile_id=profile_id), self.model.load(profile_id), m.Ack())

    @precondition(lambda self: not self.model.bootloader)
    @rule(value=st.integers(0, 12))
    def set_sensitivity(self, value: int) -> None:
        verdict = self.model.may_set()
        if verdict == OK and value > 9:
            verdict = 0x21
        self.expect(m.SetSensitivity(sensitivity=value), verdict, m.Ack())
        if verdict == OK:
            self.model.now.sensitivity = value

    @precondition(lambda self: not self.model.bootloader)
    @rule(value=st.integers(2, 5))
    def set_band(self, value: int) -> None:
        verdict = self.model.may_set()
        if verdict == OK and value not in (3, 4):
            verdict = 0x21
        self.expect(m.SetTxCenterFrequency(tx_center_frequency=value), verdict, m.Ack())
        if verdict == OK:
            self.model.now.band = value

    @precondition(lambda self: not self.model.bootloader)
    @rule(feature=st.sampled_from(FEATURES), bits=st.integers(0, 3))
    def set_output(self, feature: int, bits: int) -> None:
        verdict = self.model.may_output(feature)
        self.expect(m.OutputSetControl(feature=feature, control=bits), verdict, m.Ack())
        if verdict == OK:
            self.model.set_output(feature, bits)

    @precondition(lambda self: not self.model.bootloader)
    @rule()
    def load_and_run(self) -> None:
        self.load(PRESENCE_2)
        self.set_mode(RUN)

    @precondition(lambda self: not self.model.bootloader)
    @rule(fps=st.sampled_from([0.0, 17.0]))
    def stream(self, fps: float) -> None:
        """8.3: X4DRIVER works in every mode; 8.4: only MANUAL, or no modes, sends frames."""
        setting = X4Setting.FPS
        self.expect(m.X4DriverSet(setting=setting, value=fps), OK, m.Ack())
        frames = [heard for heard in self.host.hear(3) if isinstance(heard, m.DataFloat)]
        raw = self.model.mode == MANUAL
        assert bool(frames) == (raw and fps > 0)
        self.expect(m.X4DriverSet(setting=setting, value=0.0), OK, m.Ack())

    @precondition(lambda self: not self.model.bootloader)
    @rule()
    def reset(self) -> None:
        self.expect(m.ModReset(), OK, m.Ack())
        self.model.host_reset()
        self.restarted()

    @rule(times=st.sampled_from([1, 1, 1, 9, 6]))
    def crash(self, times: int) -> None:
        for _ in range(times):
            if self.model.bootloader:
                return
            self.host.device.module.crash("watchdog", self.host.now_ns)
            self.model.fault()
            self.restarted()

    @precondition(lambda self: self.model.bootloader)
    @rule()
    def leave_the_bootloader(self) -> None:
        self.host.device.power_cycle(self.host.now_ns)
        self.model.host_reset()
        self.restarted()

    @invariant()
    def tells_its_mode(self) -> None:
        if self.model.bootloader:
            self.expect(m.Ping(), SILENCE, m.Ack())
            return
        pong = 0xFFEEFEEF if self.model.safe else 0xAAEEAEEA
        self.expect(m.Ping(), OK, m.Pong(value=pong))
        verdict = 1 if self.model.safe else OK
        self.expect(m.GetMode(), verdict, m.ReplyByte(values=bytes([self.model.mode])))
        profile_id = PRESENCE_2 if self.model.loaded else 0
        self.expect(m.GetProfileId(), verdict, m.ReplyInt(values=(profile_id,)))

    @invariant()
    def tells_its_settings(self) -> None:
        if self.model.bootloader:
            return
        verdict = self.model.may_get(observed_silent=False)
        sensitivity = m.ReplyInt(content_id=0x10A5112B, values=(self.model.now.sensitivity,))
        self.expect(m.GetSensitivity(), verdict, sensitivity)
        band = m.ReplyInt(content_id=0x71AF2A2B, values=(self.model.now.band,))
        self.expect(m.GetTxCenterFrequency(), verdict, band)
        verdict = self.model.may_get(observed_silent=True)
        for feature in FEATURES:
            bits = self.model.now.outputs.get(feature, 0)
            self.expect(m.OutputGetControl(feature=feature), verdict, m.ReplyInt(values=(bits,)))


DeviceMachine.TestCase.settings = hypothesis_settings(
    max_examples=examples(12, 25), stateful_step_count=40
)
TestDeviceMachine = DeviceMachine.TestCase


LONGEST_PACKET = 9 + 65535
QUIET_BYTES = bytes(LONGEST_PACKET)  # after so many bytes without a start every doubt is settled

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
        ((_, payload),) = oracle(wire)
        packet = Sent(message=message, payload=payload)
        self._flight += [(packet, byte) for byte in wire]

    def damage(self, kind: str, where: float, byte: int, count: int) -> None:
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
        packet = self._flight[at][0] if at < len(self._flight) else None
        if packet is None:
            return []
        is_within = self._flight[at - 1][0] is packet if at else packet.begin >= 0
        return [self._flight[at]] if is_within else []

    def deliver(self, count: int) -> None:
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
        self._delivered += len(QUIET_BYTES)
        self._hear(QUIET_BYTES)
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
        statistics = self._receiver.statistics
        assert self._receiver.buffered <= LONGEST_PACKET
        assert statistics.bytes == self._delivered
        assert statistics.packets == self._messages
        assert statistics.faults.total() == self._faults
        # the shortest packet has four bytes
        judged = statistics.bytes - self._receiver.buffered
        assert statistics.junk_bytes + 4 * statistics.packets <= judged
        assert statistics.packets or statistics.junk_bytes == judged


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
        if is_misread(encode(message)):
            with pytest.raises(LocalProtocolError):
                self.lines["to module"].send(message)
        else:
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
        for line, messages in zip(self.lines.values(), (RESPONSES, COMMANDS), strict=True):
            line.silence()
            for message in messages:
                line.send(message)
            for _ in range(80):
                line.deliver(23)
            line.check_books()


def test_bytes_that_come_behind_the_first_of_a_packet_tear_it() -> None:
    state = LossyLine()
    state.module_speaks(message=m.Ack())
    state.bytes_arrive(line="to host", count=1)
    state.bytes_are_damaged(line="to host", kind="insert", where=0.0, byte=0x7C, count=2)
    state.line_falls_silent(line="to host")
    state.teardown()


TestLossyLine = LossyLine.TestCase
TestLossyLine.settings = settings(
    max_examples=examples(25, 60), stateful_step_count=30, deadline=None
)
