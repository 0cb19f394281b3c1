"""A UART bit by bit: what another rate hears, how fast bytes go, what overflows."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.chip import Pace
from emulator.module.settings import received_bytes
from emulator.ports.event_loop import Port
from emulator.ports.uart import UartLine
from emulator.x4m300 import Device
from hil_tests.unit.emulator.doubles import ramp_device
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NeedData

SECOND = 1_000_000_000


# Worked out on paper: a 0 is a start bit, bits come least significant first, 1 is idle and stop.
@pytest.mark.parametrize(
    ("sent", "sent_baud", "read_baud", "heard"),
    [
        # half the rate: the middles of the receiver's bits lie at the sender's bits 1, 3, 5, ... 19
        ("00", 115200, 57600, "f8"),  # bits 3 5 7 are data 0; 9 is the stop bit, then idle
        ("00 00", 115200, 57600, "08"),  # bit 9 is the first stop bit; 11 ... 17 the second's zeros
        ("ff", 115200, 57600, ""),  # one low bit: in the middle of the start bit it is gone
        ("55", 115200, 57600, ""),  # so is each of its five
        # twice the rate: every bit sent is heard twice
        ("ff", 57600, 115200, "fe"),  # the second half of the start bit is data bit 0
        ("00", 57600, 115200, "00"),  # low for 18 bits: a character without stop bit, then high
        ("55", 57600, 115200, "66 e6"),  # 0 01100110 0, high, 0 0110011 and idle
        # eight times the rate: a start bit alone fills a character
        ("ff", 115200, 921600, "80"),  # 8 low bits: the start bit and seven data bits
        # so close that the middles stay within the bits
        ("7d 01 ff 00 7e", 115200, 117000, "7d 01 ff 00 7e"),
        ("7d 01", 115200, 0, ""),
    ],
)
def test_another_rate_hears_what_the_bits_say(
    sent: str, sent_baud: int, read_baud: int, heard: str
) -> None:
    assert received_bytes(bytes.fromhex(sent), sent_baud, read_baud) == bytes.fromhex(heard)


@given(st.binary(max_size=60), st.sampled_from([9600, 115200, 921600, 4_000_000]))
def test_the_same_rate_hears_every_byte(data: bytes, baud: int) -> None:
    assert received_bytes(data, baud, baud) == data
    # 1 % off is half a bit in fifty: every middle stays in its bit
    assert received_bytes(data, baud, baud * 101 // 100) == data


@given(st.binary(max_size=60), st.integers(600, 10_000_000), st.integers(600, 10_000_000))
def test_no_receiver_hears_more_than_one_byte_per_falling_edge(
    data: bytes, sent_baud: int, read_baud: int
) -> None:
    heard = received_bytes(data, sent_baud, read_baud)
    assert len(heard) <= 5 * len(data), "a character has at most five falling edges"


class Descriptor:
    """The host's end of a line: takes everything, gives what the test put there."""

    def __init__(self) -> None:
        self.heard = bytearray()
        self.to_send = b""
        self.room = 1 << 30

    def fileno(self) -> int:
        return 99

    def read(self) -> bytes:
        data, self.to_send = self.to_send, b""
        return data

    def write(self, data: memoryview) -> int:
        taken = data[: self.room]
        self.room -= len(taken)
        self.heard += taken
        return len(taken)


class Bench:
    """One port in virtual time, which jumps from deadline to deadline as the loop would."""

    def __init__(self, device: Device, line: UartLine) -> None:
        self.device = device
        self.now_ns = 0
        self.end = Descriptor()
        self.port = Port(self.end, device, line)
        self.host = Connection(Role.HOST)

    def run(self, until_ns: int) -> None:
        while True:
            self.port.advance(self.now_ns)
            while self.port.send(self.now_ns):
                pass
            wake_ns = self.port.wake_ns(self.now_ns)
            if wake_ns is None or wake_ns > until_ns:
                self.now_ns = until_ns
                return
            self.now_ns = max(wake_ns, self.now_ns)

    def say(self, data: bytes) -> None:
        self.end.to_send = data
        self.port.receive(self.now_ns)

    def heard(self) -> list[m.Message]:
        self.host.receive_data(bytes(self.end.heard))
        self.end.heard.clear()
        messages: list[m.Message] = []
        while not isinstance(event := self.host.next_event(), NeedData):
            if isinstance(event, m.Message):
                messages.append(event)
        return messages

    def ask(self, command: m.Command[m.Response], limit_ns: int = SECOND // 10) -> list[m.Message]:
        self.say(self.host.send(command))
        self.run(self.now_ns + limit_ns)
        return self.heard()

    def stream(self, fps: float) -> None:
        for command in (
            m.SetMode(mode=SensorMode.XTID_SM_STOP),
            m.SetMode(mode=SensorMode.XTID_SM_MANUAL),
            m.X4DriverInit(),
            m.X4DriverSet(setting=X4Setting.FRAMEAREA, value=(0.2, 9.4)),
            m.X4DriverSet(setting=X4Setting.FPS, value=fps),
        ):
            assert m.Ack() in self.ask(command)


class UartBench(Bench):
    def __init__(self, host_baud: int, pace: Pace = Pace.REALTIME) -> None:
        device = ramp_device(pace)
        self.host_baud = host_baud
        self.line = UartLine(lambda: device.module.uart_baudrate, lambda: self.host_baud)
        super().__init__(device, self.line)


def test_a_byte_takes_ten_bits_in_either_direction() -> None:
    bench = UartBench(115200)
    ping = bench.host.send(m.Ping())
    assert len(ping) == 8
    bench.say(ping)
    # 8 bytes there and 8 back (PONG): 160 bits
    both_ns = 160 * SECOND // 115200
    bench.run(both_ns - SECOND // 10_000)
    assert bench.heard() == []
    bench.run(both_ns + 2)
    assert bench.heard() == [m.Pong(value=0xAAEEAEEA)]


def test_a_host_at_another_rate_is_not_understood_and_understands_nothing() -> None:
    bench = UartBench(57600)
    assert bench.ask(m.Ping()) == []
    assert not bench.end.heard
    assert UartBench(115200).ask(m.Ping()) == [m.Pong(value=0xAAEEAEEA)]


def test_setbaudrate_is_acknowledged_at_the_old_rate_and_counts_half_a_second_later() -> None:
    bench = UartBench(115200)
    assert bench.ask(m.SetBaudRate(baudrate=921600)) == [m.Ack()]
    assert bench.ask(m.Ping()) == [], "3: the command task sleeps for half a second"
    bench.host_baud = 921600
    bench.run(bench.now_ns + SECOND // 2)
    assert bench.heard() == [m.Pong(value=0xAAEEAEEA)], "what was sent meanwhile"
    bench.host_baud = 115200
    assert bench.ask(m.Ping()) == []
    bench.host_baud = 921600
    assert bench.ask(m.Ping()) == [m.Pong(value=0xAAEEAEEA)]


def test_921600_baud_cannot_carry_17_frames_of_1431_bins() -> None:
    bench = UartBench(115200)
    assert bench.ask(m.SetBaudRate(baudrate=921600)) == [m.Ack()]
    bench.run(bench.now_ns + SECOND // 2)
    bench.host_baud = 921600
    bench.stream(17.0)
    begin_ns = bench.now_ns
    seconds = 120
    bench.run(begin_ns + seconds * SECOND)
    counters = [message.info for message in bench.heard() if isinstance(message, m.DataFloat)]
    # Protocol reference 9.5, 9.6, 10: 5747 bytes of 10 bits; 17.049379 frames/s are made
    carried = seconds * 921600 / 57470
    made = seconds * 17.049379
    assert len(counters) == pytest.approx(carried, abs=3)
    gaps = sum(later - earlier - 1 for earlier, later in itertools.pairwise(counters))
    # what was made is carried, waits in the 50 slots (8.4), or is missing among the counters
    assert gaps == pytest.approx(made - carried - 50, abs=4)
    assert gaps > 60
    assert counters[:100] == list(range(counters[0], counters[0] + 100)), "the queue fills first"


def test_nothing_is_lost_when_the_clock_waits_for_the_line() -> None:
    bench = UartBench(115200, Pace.ASAP)
    bench.stream(17.0)
    bench.run(bench.now_ns + 10 * SECOND)
    counters = [message.info for message in bench.heard() if isinstance(message, m.DataFloat)]
    assert counters == list(range(1, len(counters) + 1))
    assert len(counters) == pytest.approx(20, abs=1)  # Protocol reference 10: 2.0 per second


def test_a_uart_sends_on_without_a_reader() -> None:
    bench = UartBench(115200)
    bench.stream(17.0)
    bench.run(bench.now_ns + 5 * SECOND)
    bench.end.room = 0  # the host has gone, or reads no more
    bench.say(bench.host.send(m.X4DriverSet(setting=X4Setting.FPS, value=0.0)))
    # Protocol reference 10: 50 frames of 5747 bytes take 25 s at 2.0 frames/s
    bench.run(bench.now_ns + 27 * SECOND)
    bench.end.room = 1 << 30
    bench.end.heard.clear()
    bench.host = Connection(Role.HOST)
    assert bench.ask(m.Ping()) == [m.Pong(value=0xAAEEAEEA)]


def test_a_flush_loses_what_was_not_sent_yet() -> None:
    bench = UartBench(600)
    bench.host_baud = 115200
    bench.say(bench.host.send(m.Ping()) * 100)
    bench.line.flush_output()
    bench.run(SECOND // 2)
    assert bench.heard() == []
    assert bench.ask(m.Ping()) == [m.Pong(value=0xAAEEAEEA)]
