"""Whatever is done to a playback, its messages stay themselves, in order, each once.

The model is independent: it moves in steps of device time small enough to see every message pass
and holds the recording's position as an exact fraction.
"""

from dataclasses import dataclass, field
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.chip.chip import Chip
from emulator.loopback import LoopbackTransport
from emulator.module.outbox import LosslessOutbox
from emulator.module.state import Module
from emulator.playback import QUIET_NS, PlayClock, PlayStream, TimedMessage
from emulator.x4m300 import Device
from hil_tests.unit.emulator.doubles import IDENTITY, RampSource
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.connection import Connection, Role

MS = 1_000_000
RATES = st.sampled_from([0.0, 0.25, 0.5, 1.0, 2.0, 8.0])


def recording(gaps_ms: list[int]) -> list[TimedMessage]:
    """Every third message is a text; all are told apart by their number."""
    items, time_ns = [], 0
    for number, gap_ms in enumerate(gaps_ms):
        time_ns += gap_ms * MS if number else 0
        text = m.DataString(content_id=0, info=number, text="x")
        presence = m.PresenceSingle(
            counter=number, state=0, distance_m=1.0, direction=0, signal_quality=0
        )
        items.append(TimedMessage(time_ns=time_ns, message=text if number % 3 == 2 else presence))
    return items


def number_of(message: m.Message) -> int:
    if isinstance(message, m.DataString):
        return message.info
    assert isinstance(message, m.PresenceSingle)
    return message.counter


@dataclass
class Line:
    """A reader of a stream through the queue that a player has."""

    stream: PlayStream
    now_ns: int = 0
    outbox: LosslessOutbox = field(default_factory=LosslessOutbox)

    def drain(self) -> list[m.Response]:
        taken: list[m.Response] = []
        while True:
            self.outbox.refill_on_demand(self.stream, self.now_ns)
            message = self.outbox.take(self.now_ns)
            if message is None:
                return taken
            taken.append(message)


GAPS = st.lists(st.integers(0, 40), min_size=1, max_size=25)
CONTROLS = st.one_of(
    st.tuples(st.just("pause"), st.none()),
    st.tuples(st.just("resume"), st.none()),
    st.tuples(st.just("rate"), RATES),
    st.tuples(st.just("wait"), st.integers(0, 120)),
    st.tuples(st.just("stall"), st.integers(0, 120)),
)


def control(stream: PlayStream, verb: str, value: object, now_ns: int) -> None:
    match verb, value:
        case "pause", _:
            stream.pause(now_ns)
        case "resume", _:
            stream.resume(now_ns)
        case "rate", float(rate):
            stream.set_rate(rate, now_ns)
        case "seek", int(position_ms):
            stream.seek(position_ms * MS, now_ns)


@given(gaps=GAPS, steps=st.lists(CONTROLS, max_size=20))
def test_pause_rate_and_a_slow_reader_change_nothing_but_times(
    gaps: list[int], steps: list[tuple[str, object]]
) -> None:
    items = recording(gaps)
    line = Line(PlayStream(items))
    line.stream.port_opened(0)
    line.now_ns = QUIET_NS
    heard: list[m.Response] = []
    rate, paused, position = Fraction(1), False, Fraction(0)
    for verb, value in steps:
        control(line.stream, verb, value, line.now_ns)
        if verb in {"wait", "stall"}:
            assert isinstance(value, int)
            line.now_ns += value * MS
            if not paused:
                position += value * MS * rate
        elif verb == "rate":
            assert isinstance(value, float)
            rate = Fraction(value)
        elif verb in {"pause", "resume"}:
            paused = verb == "pause"
        if verb == "stall":
            continue
        heard += line.drain()
        if rate == 0 and not paused:
            assert len(heard) == len(items)
        # every rate is a power of two, so only the rounding of each piece is left: 1 ns each
        due = sum(item.time_ns < position - 100 for item in items)
        if not paused:
            assert len(heard) >= due
        if rate and len(heard) < len(items) and not paused:
            assert items[len(heard)].time_ns >= position - 100
    line.stream.resume(line.now_ns)
    line.stream.set_rate(0.0, line.now_ns)
    heard += line.drain()
    assert heard == [item.message for item in items]


@given(
    gaps=GAPS,
    steps=st.lists(CONTROLS | st.tuples(st.just("seek"), st.integers(0, 1000)), max_size=25),
)
def test_no_message_comes_twice_or_out_of_order_but_after_a_seek(
    gaps: list[int], steps: list[tuple[str, object]]
) -> None:
    items = recording(gaps)
    line = Line(PlayStream(items))
    line.stream.port_opened(-QUIET_NS)
    last = -1
    for verb, value in steps:
        control(line.stream, verb, value, line.now_ns)
        if verb == "seek":
            assert isinstance(value, int)
            last = sum(item.time_ns < value * MS for item in items) - 1
        if verb in {"wait", "stall"}:
            assert isinstance(value, int)
            line.now_ns += value * MS
        if verb != "stall":
            for message in line.drain():
                assert number_of(message) > last
                last = number_of(message)


@given(gaps=GAPS, rate=st.sampled_from([0.5, 1.0, 4.0]), rounds=st.integers(2, 4))
def test_a_loop_repeats_the_whole_and_keeps_its_time(
    gaps: list[int], rate: float, rounds: int
) -> None:
    items = recording(gaps)
    stream = PlayStream(items, loop_gap_ns=10 * MS, rate=rate)
    stream.port_opened(-QUIET_NS)
    heard = []
    for _ in range(rounds * len(items)):
        due_ns = stream.next_due_ns()
        assert due_ns is not None
        heard.append((due_ns, stream.take()))
    round_ns = items[-1].time_ns + 10 * MS
    for place, (due_ns, message) in enumerate(heard):
        turn, index = divmod(place, len(items))
        assert message == items[index].message
        assert due_ns == pytest.approx((turn * round_ns + items[index].time_ns) / rate, abs=1)


@given(
    position=st.integers(-(10**15), 10**15),
    at=st.integers(0, 10**15),
    rate=st.floats(0.01, 100),
    ahead=st.integers(0, 10**13),
)
def test_a_clock_is_its_own_inverse(position: int, at: int, rate: float, ahead: int) -> None:
    clock = PlayClock(rate)
    clock.start(position, at)
    due_ns = clock.due_ns(position + ahead)
    assert due_ns is not None
    assert abs(clock.position_ns(due_ns) - position - ahead) <= 2 + rate + ahead * 2**-50


def test_bytes_are_those_of_the_recording_under_any_control() -> None:
    """At the device's own line, not only in the stream."""
    items = recording([7] * 20)
    stream = PlayStream(items)
    device = player(stream)
    line = LoopbackTransport(device)
    module = Connection(Role.MODULE)
    sent = b""
    for step in range(40):
        now_ns = line.clock_ns()
        control(stream, "pause" if step % 2 else "resume", None, now_ns)
        stream.set_rate([1.0, 0.5, 3.0][step % 3], now_ns)
        while packet := line.read(0.04 if step % 2 else 0.013):
            sent += packet
    stream.resume(line.clock_ns())
    while packet := line.read(100.0):
        sent += packet
    assert sent == b"".join(module.send(item.message) for item in items)


def player(stream: PlayStream) -> Device:
    return Device(Module(IDENTITY, Chip(RampSource())), stream, LosslessOutbox())
