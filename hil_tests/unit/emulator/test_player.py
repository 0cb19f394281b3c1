"""When a recording starts, waits, loops and ends."""

from __future__ import annotations

import pytest

from emulator.chip.chip import Chip
from emulator.device import Device
from emulator.module.module import LosslessOutbox, Module
from emulator.playback import PlayStream, schedule
from hil_tests.unit.emulator.doubles import IDENTITY, BareHost, RampSource
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting

SECOND = 1_000_000_000
RECORDS = [m.Pong(value=value) for value in range(5)]


def player(rate: float = 1.0, gap_ns: int | None = None) -> BareHost:
    stamps = [10 * SECOND + index * SECOND for index in range(5)]
    timed = tuple(schedule(zip(RECORDS, stamps, strict=True)))
    stream = PlayStream(timed, loop_gap_ns=gap_ns, rate=rate)
    module = Module(IDENTITY, Chip(RampSource()))
    return BareHost(Device(module, stream, LosslessOutbox()))


def heard_at(host: BareHost, now_ns: int) -> list[m.Message]:
    host.now_ns = now_ns
    host.device.advance(now_ns)
    return host.hear()


def test_a_listening_host_hears_everything_half_a_second_after_opening() -> None:
    host = player()
    assert heard_at(host, SECOND) == []
    host.device.port_opened(SECOND)
    assert heard_at(host, SECOND * 3 // 2 - 1) == []
    assert host.device.wake_ns(host.now_ns) == SECOND * 3 // 2
    heard = [heard_at(host, SECOND * 3 // 2 + index * SECOND) for index in range(5)]
    assert heard == [[record] for record in RECORDS]
    assert host.device.wake_ns(host.now_ns) is None


def test_rate_0_plays_as_fast_as_the_port_takes() -> None:
    host = player(rate=0)
    host.device.port_opened(0)
    assert heard_at(host, SECOND // 2) == RECORDS


@pytest.mark.parametrize(
    "start",
    [
        m.X4DriverSet(setting=X4Setting.FPS, value=17.0),
        m.SetMode(mode=SensorMode.XTID_SM_RUN),
    ],
)
def test_a_host_that_starts_the_radar_hears_it_at_once(start: m.Command[m.Response]) -> None:
    host = player()
    host.device.port_opened(0)
    host.send(start)
    assert host.hear() == [m.Ack(), RECORDS[0]]


def test_commands_postpone_and_never_stop_it() -> None:
    host = player()
    host.device.port_opened(0)
    host.now_ns = SECOND * 4 // 10
    host.ask(m.Ping())
    assert heard_at(host, SECOND * 8 // 10) == []
    assert heard_at(host, SECOND * 9 // 10) == [RECORDS[0]]
    assert host.ask(m.X4DriverSet(setting=X4Setting.FPS, value=0.0)) == m.Ack()
    assert heard_at(host, SECOND * 19 // 10) == [RECORDS[1]]


def test_every_host_hears_it_from_the_beginning() -> None:
    host = player(rate=0)
    for opening_ns in (0, 5 * SECOND):
        host.device.port_opened(opening_ns)
        assert heard_at(host, opening_ns + SECOND) == RECORDS
        host.device.port_closed(opening_ns + SECOND)
        assert heard_at(host, opening_ns + 2 * SECOND) == []


def test_a_quick_visitor_does_not_start_it() -> None:
    host = player()
    host.device.port_opened(0)
    host.ask(m.GetMode())
    host.device.port_closed(SECOND // 10)
    assert heard_at(host, 10 * SECOND) == []


def test_a_slow_reader_makes_it_wait() -> None:
    host = player()
    host.device.port_opened(0)
    host.now_ns = 100 * SECOND
    assert host.hear(2) == RECORDS[:2]
    assert host.ask(m.Ping()) == m.Pong(value=0xAAEEAEEA), "no queue of records to wait behind"
    assert host.hear() == RECORDS[2:]


def test_a_loop_goes_on() -> None:
    host = player(gap_ns=SECOND)
    host.device.port_opened(0)
    assert heard_at(host, SECOND // 2 + 4 * SECOND) == RECORDS
    assert heard_at(host, SECOND // 2 + 5 * SECOND - 1) == []
    assert heard_at(host, SECOND // 2 + 9 * SECOND) == RECORDS


def test_records_without_time_come_at_the_nominal_rate() -> None:
    times = [item.time_ns for item in schedule([(record, None) for record in RECORDS])]
    assert times == pytest.approx([index * SECOND / 17 for index in range(5)], abs=2)


def test_time_that_runs_backwards_is_not_waited_for() -> None:
    stamps = [5, 9, 3, 4, None]
    times = [item.time_ns for item in schedule(zip(RECORDS, stamps, strict=True))]
    assert times == [0, 4, 4, 5, 5 + SECOND // 17]
