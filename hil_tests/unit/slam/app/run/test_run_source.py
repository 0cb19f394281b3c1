"""A whole run in virtual time: clocks that drift, lines that delay, sources that fail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from emulator.scene.scene import Scene, load_scene
from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.slam.app.virtual_rig import (
    Timed,
    VirtualInbox,
    Words,
    delays,
    drifting,
    odometry_events,
    radar_events,
)
from slam.app.errors import AppError
from slam.app.odometry.live import FixedClock, LiveOdometry
from slam.app.records import RadarInfo, Scan, SessionObserver
from slam.app.rig.emulated import RAW_CONFIG, rig_of, wheels_of
from slam.app.rig.sources import sampler_limits
from slam.app.run.live_source import FrameCame, LiveSource, OdometryLine, RadarBack, RadarLost
from slam.app.run.runner import RunRecord, run_slam
from slam.config import load_preset
from slam.evaluation import ate_rmse_m
from slam.pipelines import make_slam
from xethru_protocol.wire.x4 import frame_time_ns

PPM = (80.0, -50.0, 5.0, -120.0)
SKEW_MS = (0.0, 190.0, 100.0, 50.0)
JITTER_MS = 16.0
SEED = 3
NS_PER_S = 1_000_000_000
END_S = 24.0


@dataclass
class Drive:
    """A scene as four radars and wheels told it: events to be changed by a test."""

    scene: Scene
    infos: tuple[RadarInfo, ...]
    events: list[Timed]


@dataclass
class Heard(SessionObserver):
    """What an observer of a run was told."""

    scans: list[Scan] = field(default_factory=list)

    def on_scan(self, scan: Scan) -> None:
        self.scans.append(scan)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    scene = load_scene(write_short_scene(tmp_path_factory.mktemp("scene")))
    scene = drifting(scene, PPM, SKEW_MS)
    end_s = scene.trajectory().duration_ns / NS_PER_S
    infos, events = radar_events(scene, SEED, end_s, delays(1, JITTER_MS))
    return Drive(
        scene=scene, infos=infos, events=events + odometry_events(scene, SEED, delays(2, JITTER_MS))
    )


def source_of(
    drive: Drive, keep: Callable[[Timed], bool] = lambda _: True, also: tuple[Timed, ...] = ()
) -> tuple[LiveSource, LiveOdometry, Words]:
    events = [row for row in drive.events if keep(row)]
    return source_on(drive, VirtualInbox([*events, *also]))


def source_on(
    drive: Drive, inbox: VirtualInbox, clock: FixedClock | None = None
) -> tuple[LiveSource, LiveOdometry, Words]:
    odometry, words = LiveOdometry("the test", clock), Words()
    source = LiveSource(
        drive.infos,
        sampler_limits(RAW_CONFIG),
        odometry,
        inbox,
        words,
        lambda: None,
        clock_ns=inbox.clock_ns,
    )
    return source, odometry, words


def run(drive: Drive, source: LiveSource, odometry: LiveOdometry, heard: Heard) -> RunRecord:
    scene = drive.scene
    slam = make_slam(load_preset("robust"), rig_of(scene), wheels_of(scene))
    return run_slam(source.scans(), odometry, slam, scene.trajectory().poses, [heard])


def test_through_drift_and_jitter_the_map_is_as_good_as_with_perfect_clocks(drive: Drive) -> None:
    """Measured: ATE 0.77 mm (0.79 without jitter) where wheels have 3.0; stamps to 1.7 ms."""
    source, odometry, words = source_of(drive)
    source.settle()
    heard = Heard()
    record = run(drive, source, odometry, heard)
    assert source.ended is not None
    assert not source.ended.failed
    assert words.said[0] == ("odometry", "ended")
    assert [who for who, _ in words.said[1:]] == [info.name for info in drive.infos]
    assert all(text.startswith("clock ") and " ppm against" in text for _, text in words.said[1:])
    assert source.lost_frames == source.n_unused == 0

    errors_ms: list[list[float]] = [[] for _ in PPM]
    for scan in heard.scans:
        for frame in scan.frames:
            clock = drive.scene.radars[frame.radar].clock
            nominal_ns = frame_time_ns(frame.counter, drive.infos[frame.radar].rate_hz)
            errors_ms[frame.radar].append((frame.t_ns - clock.scene_time_ns(nominal_ns)) * 1e-6)
    assert all(len(errors) > 280 for errors in errors_ms)
    assert max(np.abs(errors).max() for errors in errors_ms) < 3.0
    for arrivals, ppm in zip(source.clocks, PPM, strict=True):
        assert abs(arrivals.drift_ppm - ppm) < 3.0 * arrivals.drift_sigma_ppm
        assert arrivals.drift_sigma_ppm < 30.0

    estimate = np.array([result.belief.pose[:2] for result in record.results])
    odometry_xy = np.array([result.odometry_pose[:2] for result in record.results])
    ate_m = ate_rmse_m(estimate, record.truth[:, :2])
    assert ate_m < 1.5e-3
    assert ate_m < 0.5 * ate_rmse_m(odometry_xy, record.truth[:, :2])


def test_a_dead_radar_is_told_and_the_others_go_on(drive: Drive) -> None:
    lost, back = round(10 * NS_PER_S), round(20 * NS_PER_S)

    def keep(row: Timed) -> bool:
        is_theirs = isinstance(row.event, FrameCame) and row.event.radar == 2
        return row.t_ns < END_S * NS_PER_S and not (is_theirs and lost < row.t_ns < back)

    source, odometry, words = source_of(
        drive,
        keep,
        (
            Timed(lost + 3 * NS_PER_S, RadarLost(radar=2, text="no frame for 3 s")),
            Timed(back, RadarBack(radar=2, port="elsewhere")),
        ),
    )
    source.settle()
    heard = Heard()
    run(drive, source, odometry, heard)
    assert words.about("front_right").startswith(
        "no frame for 3 s; the run goes on with 3 of 4 radars | is back, at elsewhere | clock "
    )
    assert source.ended is not None
    assert source.ended.failed  # odometry fell silent at the end
    without = [scan for scan in heard.scans if lost < scan.t_ns < back - NS_PER_S]
    assert len(without) > 40
    assert all({frame.radar for frame in scan.frames} == {0, 1, 3} for scan in without)
    assert all(scan.used for scan in without)
    assert any(frame.radar == 2 for scan in heard.scans[-5:] for frame in scan.frames)


def test_odometry_that_stops_for_a_while_costs_only_that_while(drive: Drive) -> None:
    gap = (round(10 * NS_PER_S), round(14 * NS_PER_S))

    def keep(row: Timed) -> bool:
        is_line = isinstance(row.event, OdometryLine)
        return row.t_ns < END_S * NS_PER_S and not (is_line and gap[0] < row.t_ns < gap[1])

    source, odometry, words = source_of(drive, keep)
    source.settle()
    heard = Heard()
    record = run(drive, source, odometry, heard)
    assert "s of it are missing; no scan of them is used" in words.about("odometry")
    last_ns = odometry.last_ns - NS_PER_S  # at the end of the events it stops again
    unused = [scan for scan in heard.scans if not scan.used and scan.t_ns < last_ns]
    assert all(gap[0] - NS_PER_S // 2 < scan.t_ns < gap[1] for scan in unused)
    assert len(unused) in range(16, 24)  # of 20 in the gap
    assert all(len(scan.frames) == len(PPM) for scan in unused)  # they are recorded
    stamps = [result.t_ns for result in record.results]
    assert not [t for t in stamps if gap[0] < t < gap[1] - NS_PER_S]
    assert [t for t in stamps if t > gap[1]]


def test_odometry_that_falls_silent_ends_the_run_with_all_its_states(drive: Drive) -> None:
    silent_ns = round(10 * NS_PER_S)
    source, odometry, _ = source_of(
        drive,
        lambda row: (
            not (isinstance(row.event, OdometryLine) and row.t_ns > silent_ns)
            and row.t_ns < END_S * NS_PER_S
        ),
    )
    source.settle()
    record = run(drive, source, odometry, Heard())
    assert source.ended is not None
    assert source.ended.failed
    assert source.ended.text == (
        "odometry from the test: no more line for 10 s; is its sender running?"
    )
    assert record.results[-1].t_ns > silent_ns - NS_PER_S


def test_a_rig_without_odometry_does_not_begin(drive: Drive) -> None:
    source, _, _ = source_of(drive, lambda row: isinstance(row.event, FrameCame))
    with pytest.raises(AppError, match="odometry from the test: no line for 10 s"):
        source.settle()


def test_a_radar_that_never_streams_is_named(drive: Drive) -> None:
    source, _, _ = source_of(
        drive, lambda row: not (isinstance(row.event, FrameCame) and row.event.radar == 1)
    )
    with pytest.raises(AppError, match="radar rear_left: no frame in 15 s"):
        source.settle()


def test_a_machine_that_is_too_slow_for_a_while_records_all_and_says_so(drive: Drive) -> None:
    inbox = VirtualInbox([row for row in drive.events if row.t_ns < END_S * NS_PER_S])
    source, _, words = source_on(drive, inbox)
    source.settle()
    scans = []
    for number, scan in enumerate(source.scans()):
        scans.append(scan)
        if number == 20:
            inbox.now_ns += 13 * NS_PER_S  # one step that takes so long
    counters = [scan.counter for scan in scans]
    assert counters == sorted(set(counters))
    assert "behind the radars: this machine is too slow" in words.about("run")
    late = [scan for scan in scans if not scan.used]
    assert late
    assert all(len(scan.frames) == len(PPM) for scan in late[:-1])
    assert source.worst_lag_s > 10.0


def test_a_counter_that_goes_back_by_one_loses_no_frame(drive: Drive) -> None:
    events = []
    for row in drive.events:
        if row.t_ns > 14 * NS_PER_S:
            continue
        event = row.event
        if isinstance(event, FrameCame) and event.radar == 1 and row.t_ns > 10 * NS_PER_S:
            event = replace(event, frame=replace(event.frame, counter=event.frame.counter - 2))
        events.append(replace(row, event=event))
    source, _, _ = source_on(drive, VirtualInbox(events))
    source.settle()
    assert len(list(source.scans())) > 40
    assert [clock.restarts for clock in source.clocks] == [0, 1, 0, 0]
    assert source.lost_frames == 0


def test_odometry_whose_clock_is_set_while_it_is_trusted_is_told(drive: Drive) -> None:
    """With a clock known beforehand no later frame lies between two poses."""
    set_ns = 8 * NS_PER_S
    events = []
    for row in drive.events:
        if row.t_ns > 16 * NS_PER_S:
            continue
        if isinstance(row.event, OdometryLine) and row.t_ns > set_ns:
            stamp, _, rest = row.event.text.partition(" ")
            late = replace(row.event, text=f"{float(stamp) + 3600:.9f} {rest}")
            events.append(replace(row, event=late))
        else:
            events.append(row)
    source, _, words = source_on(drive, VirtualInbox(events), FixedClock(0))
    source.settle()
    assert {scan.used for scan in source.scans()} == {True, False}
    assert "SLAM got no scan for 5 s" in words.about("run")
