"""Frames of radars out of step, drifting, lost: each in one scan, scans in order of time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.app.odometry.live import FixedClock, LiveOdometry
from slam.app.records import Scan
from slam.app.run.live_source import GRACE_NS, ReceivedFrame, TickAssembler
from slam.frames import RadarFrame

NS_PER_S = 1_000_000_000
PERIOD_NS = NS_PER_S // 5
SAMPLES = np.zeros(4, dtype=np.float32)
START_NS = 3 * NS_PER_S


def frame(radar: int, t_ns: int, counter: int = 0) -> ReceivedFrame:
    made = RadarFrame(
        radar=radar,
        t_ns=t_ns,
        counter=counter,
        samples=SAMPLES,
        range_start_m=0.2,
        bin_length_m=0.0064,
    )
    return ReceivedFrame(frame=made, host_ns=t_ns)


def odometry_until(end_s: float) -> LiveOdometry:
    odometry = LiveOdometry("a test", FixedClock(0))
    for number in range(int(end_s * 10) + 1):
        odometry.take(f"{number / 10:.9f} 0 0 0 0 0 0 1", 0)
    return odometry


def scans_until(assembler: TickAssembler, now_ns: int) -> list[Scan]:
    scans = []
    while (scan := assembler.next_scan(now_ns)) is not None:
        scans.append(scan)
    return scans


@st.composite
def streams(draw: st.DrawFn) -> list[list[int]]:
    """Stamps of 1 to 4 radars over six seconds: skewed, drifting, some frames lost."""
    made = []
    for _ in range(draw(st.integers(1, 4))):
        skew_ns = draw(st.integers(0, PERIOD_NS - 1))
        ppm = draw(st.floats(-200, 200))
        lost = draw(st.sets(st.integers(0, 29), max_size=20))
        jitter_ns = draw(st.lists(st.integers(-2_000_000, 2_000_000), min_size=30, max_size=30))
        made.append(
            [
                START_NS + skew_ns + round(n * PERIOD_NS * (1 + ppm * 1e-6)) + jitter_ns[n]
                for n in range(30)
                if n not in lost
            ]
        )
    return made


@settings(max_examples=60, deadline=None)
@given(streams(), st.integers(0, 400_000_000))
def test_every_frame_is_in_one_scan_and_scans_are_in_order(
    stamps: list[list[int]], latency_ns: int
) -> None:
    assembler = TickAssembler(len(stamps), PERIOD_NS, odometry_until(12.0))
    assembler.begin(START_NS)
    arrivals = sorted(
        (t_ns + latency_ns, radar, t_ns) for radar, row in enumerate(stamps) for t_ns in row
    )
    scans = []
    for now_ns, radar, t_ns in arrivals:
        assembler.take(frame(radar, t_ns))
        scans += scans_until(assembler, now_ns)
    scans += scans_until(assembler, START_NS + 8 * NS_PER_S)

    counters = [scan.counter for scan in scans]
    assert counters == sorted(set(counters))
    assert all(scan.t_ns == START_NS + scan.counter * PERIOD_NS for scan in scans)
    assert all(scan.used for scan in scans)
    for radar, row in enumerate(stamps):
        got = [f.t_ns for scan in scans for f in scan.frames if f.radar == radar]
        assert got == row  # none lost, none twice, in order
    for scan in scans:
        assert len({f.radar for f in scan.frames}) == len(scan.frames)
        for f in scan.frames:  # jitter may put two into one tick: the second waits for the next
            assert -PERIOD_NS <= f.t_ns - scan.t_ns < PERIOD_NS


def test_a_tick_waits_for_a_radar_as_long_as_it_may_come_and_no_longer() -> None:
    assembler = TickAssembler(2, PERIOD_NS, odometry_until(12.0))
    assembler.begin(START_NS)
    assembler.take(frame(0, START_NS + 1))
    end_ns = START_NS + PERIOD_NS
    assert assembler.next_scan(end_ns + GRACE_NS - 1) is None
    scan = assembler.next_scan(end_ns + GRACE_NS)
    assert scan is not None
    assert [f.radar for f in scan.frames] == [0]


def test_a_lost_radar_is_not_waited_for_until_it_is_back() -> None:
    assembler = TickAssembler(2, PERIOD_NS, odometry_until(12.0))
    assembler.begin(START_NS)
    assembler.lost(1)
    for tick in range(3):
        assembler.take(frame(0, START_NS + tick * PERIOD_NS + 1))
    assert len(scans_until(assembler, START_NS + PERIOD_NS)) == 3
    assembler.back(1)
    assembler.take(frame(0, START_NS + 3 * PERIOD_NS + 1))
    assert assembler.next_scan(START_NS + 4 * PERIOD_NS) is None


def test_of_too_many_frames_the_oldest_are_recorded_and_not_used() -> None:
    assembler = TickAssembler(1, PERIOD_NS, odometry_until(12.0))
    assembler.begin(START_NS)
    for number in range(12):  # twice as many as ticks
        assembler.take(frame(0, START_NS + number * PERIOD_NS // 2, counter=number))
    scans = scans_until(assembler, START_NS + 6 * PERIOD_NS)
    assert [scan.frames[0].counter for scan in scans] == list(range(12))  # all, in order
    used = [scan for scan in scans if scan.used]
    assert all(0 <= scan.t_ns - scan.frames[0].t_ns <= PERIOD_NS for scan in used)
    counters = [scan.counter for scan in used]
    assert counters == sorted(set(counters))
    assert assembler.n_left_out == assembler.n_unused == 12 - len(used)


def test_slam_that_is_too_late_uses_nothing_until_it_has_caught_up() -> None:
    """Late from more than 10 s on; in time again from 1 s on."""
    assembler = TickAssembler(1, PERIOD_NS, odometry_until(20.0))
    assembler.begin(START_NS)
    rows = []
    for tick, lag_s in enumerate((10.0, 10.1, 5.0, 1.1, 1.0, 10.0)):
        assembler.take(frame(0, START_NS + tick * PERIOD_NS))
        lag_ns = round(lag_s * NS_PER_S)
        scan = assembler.next_scan(START_NS + (tick + 1) * PERIOD_NS + lag_ns)
        assert scan is not None
        assert assembler.lag_ns == lag_ns
        rows.append(scan.used)
    assert rows == [True, False, False, False, True, True]
    assert (assembler.n_late, assembler.n_unused) == (3, 3)


@pytest.mark.parametrize(
    ("ages_ns", "left_out"),
    [
        ((PERIOD_NS,), 0),
        ((PERIOD_NS + 1,), 1),
        ((PERIOD_NS // 4, -1), 0),
        ((PERIOD_NS // 4 + 1, -1), 1),
        ((PERIOD_NS // 4 + 1, -PERIOD_NS), 0),  # the newer one is of the next tick
    ],
)
def test_a_frame_is_too_late_for_a_tick_by_a_period_or_a_quarter_where_a_newer_one_is_there(
    ages_ns: tuple[int, ...], left_out: int
) -> None:
    assembler = TickAssembler(1, PERIOD_NS, odometry_until(12.0))
    assembler.begin(START_NS)
    begin_ns = START_NS + 2 * PERIOD_NS
    assert assembler.next_scan(begin_ns + GRACE_NS) is None  # two empty ticks are over
    for age_ns in ages_ns:
        assembler.take(frame(0, begin_ns - age_ns))
    scans = scans_until(assembler, begin_ns + GRACE_NS)
    assert scans[0].t_ns == begin_ns
    assert assembler.n_left_out == left_out


def test_a_burst_after_a_stall_is_recorded_and_the_run_is_not_held_up() -> None:
    assembler = TickAssembler(2, PERIOD_NS, odometry_until(12.0))
    assembler.begin(START_NS)
    scans: list[Scan] = []
    for tick in range(20):
        now_ns = START_NS + (tick + 1) * PERIOD_NS
        assembler.take(frame(0, now_ns - 1, counter=tick))
        if tick == 15:  # everything at once
            for missed in range(16):
                assembler.take(frame(1, START_NS + missed * PERIOD_NS + 1, counter=missed))
        elif tick > 15:
            assembler.take(frame(1, now_ns - 1, counter=tick))
        scans += scans_until(assembler, now_ns)
    got = [f.counter for scan in scans for f in scan.frames if f.radar == 1]
    assert got == list(range(20))
    assert assembler.n_left_out in range(12, 16)
    assert all(scan.t_ns <= scan.frames[1].t_ns for scan in scans[-4:])  # in step again
    assert [scan.counter for scan in scans if scan.used] == list(range(20))


def test_where_odometry_is_missing_frames_come_without_being_used() -> None:
    odometry = odometry_until(4.0)
    assembler = TickAssembler(1, PERIOD_NS, odometry)
    assembler.begin(START_NS)
    for number in range(15):
        assembler.take(frame(0, START_NS + number * PERIOD_NS + 1))
    scans = scans_until(assembler, START_NS + 3 * NS_PER_S)
    assert [scan.used for scan in scans] == [True] * 5 + [False] * len(scans[5:])
    assert scans[5:]
    assert assembler.n_unused == len(scans[5:])


def test_it_ends_where_odometry_ended() -> None:
    odometry = odometry_until(4.0)
    odometry.end("")
    assembler = TickAssembler(1, PERIOD_NS, odometry)
    assembler.begin(START_NS)
    for number in range(15):
        assembler.take(frame(0, START_NS + number * PERIOD_NS + 1))
    assert len(scans_until(assembler, START_NS + 3 * NS_PER_S)) == 6  # the last one unused
    assert assembler.ended


def test_a_clock_set_from_1970_costs_no_time() -> None:
    """Five billion ticks without a frame are passed over at once, and the next frame is found."""
    odometry = odometry_until(4.0)
    assembler = TickAssembler(1, PERIOD_NS, odometry)
    assembler.begin(START_NS)
    today_ns = 1_700_000_000 * NS_PER_S
    odometry.take(f"{today_ns // NS_PER_S} 0 0 0 0 0 0 1", 0)
    assert scans_until(assembler, today_ns) == []
    assembler.take(frame(0, today_ns))
    (scan,) = scans_until(assembler, today_ns + NS_PER_S)
    assert 0 <= today_ns - scan.t_ns < PERIOD_NS
    assert scan.frames[0].t_ns == today_ns
