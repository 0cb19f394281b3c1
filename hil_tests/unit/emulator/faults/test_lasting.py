"""Lasting faults that are due at every opportunity: what one injection does, they do, too."""

from contextlib import ExitStack

import numpy as np
import pytest

from emulator.faults.faulty_device import fault
from emulator.faults.kinds import KINDS
from hil_tests.faulty import FaultyLine, faulty_line
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import InfoItem
from xethru_protocol.wire.connection import Connection, Role

__all__ = ["faulty_line"]  # a fixture

FOR_GOOD = sorted(kind.name for kind in KINDS.values() if kind.lasting and not kind.again)
ASKED: tuple[m.Command[m.Response], ...] = (
    m.Ping(),
    m.GetProfileId(),
    m.SystemGetInfo(item=InfoItem.XTID_SSIC_VERSION),
    m.SystemGetInfo(item=InfoItem.XTID_SSIC_SERIALNUMBER),
)
SECOND = 1_000_000_000


def arrivals(kind: str | None, count: int = 1) -> tuple[int, list[tuple[int, bytes]]]:
    """Return how often a fault was injected into 3 s of a stream and four answers, and all."""
    line, host = FaultyLine(), Connection(Role.HOST)
    line.streaming(10.0)
    begin_ns = line.clock_ns()
    arrived = []
    with ExitStack() as stack:
        wanted = {"profile": 7} if kind == "wrong_profile" else {}  # in raw mode it is 0
        injection = kind and stack.enter_context(fault(line.device, kind, count=count, **wanted))
        line.read(1.0)
        for command in ASKED:
            line.device.receive_data(host.send(command), line.clock_ns())
        while line.clock_ns() < begin_ns + 3 * SECOND:
            arrived.append((line.clock_ns(), line.read(0.5)))
        line.forget()
        return (injection.injected if injection else 0), arrived


@pytest.mark.parametrize("kind", FOR_GOOD)
def test_a_fault_for_good_is_injected_once(kind: str) -> None:
    _, sound = arrivals(None)
    injected, once = arrivals(kind)
    assert once != sound
    assert injected == 1
    for count in (0, 3):
        assert arrivals(kind, count) == (1, once)


@pytest.mark.parametrize("kind", ["stall", "silent"])
def test_one_that_ends_by_itself_is_injected_anew_then(kind: str, faulty_line: FaultyLine) -> None:
    radar = faulty_line.streaming()
    radar.read_frame()
    with fault(faulty_line.device, kind, count=2, seconds=0.5) as injection:
        for _ in range(60):
            faulty_line.read(0.1)
    assert injection.injected == 2


@pytest.mark.parametrize("count", [1, 3])
def test_as_many_frames_are_missing_as_were_injected(count: int, faulty_line: FaultyLine) -> None:
    radar = faulty_line.streaming()
    radar.read_frame()
    with fault(faulty_line.device, "missing_frames", frames=2, count=count) as injection:
        list(radar.frames(20))
    assert injection.injected == count
    assert radar.statistics.frames_lost == 2 * count


def test_a_moment_comes_again_when_frames_come_again(faulty_line: FaultyLine) -> None:
    radar = faulty_line.streaming(reconnect_s=20.0)
    radar.read_frame()
    with fault(faulty_line.device, "unplug", count=3, away_s=0.5) as injection:
        list(radar.frames(20))
    assert (injection.injected, radar.reconnects) == (3, 3)
    times_ns = [one.t_ns for one in faulty_line.truth]
    assert min(np.diff(times_ns)) >= 500_000_000
