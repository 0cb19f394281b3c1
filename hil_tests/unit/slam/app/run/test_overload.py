"""A run in real time whose SLAM is slower than the frames come, in virtual time."""

import signal
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from emulator.scene.scene import load_scene
from hil_tests.patience import seconds
from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.slam.app.run.virtual_rig import (
    NS_PER_S,
    Drive,
    Timed,
    VirtualInbox,
    drive_through,
)
from hil_tests.unit.slam.app.sessions import Listener
from slam import Slam
from slam.app.odometry.live import LiveOdometry
from slam.app.rig.emulated import RAW_CONFIG, rig_of, wheels_of
from slam.app.run.live_source import LiveLog, LiveSource
from slam.app.run.replay import Comparison, recorded_source
from slam.app.run.runner import RunRecord, RunSource, Step, execute
from slam.app.session.writer import SessionLog
from slam.config import load_preset
from slam.frames import RadarFrame
from slam.library.slam import make_slam
from slam.live.arrival_clock import ClockLine
from slam.live.frame_sources import sampler_limits
from slam.live.odometry_track import TumSample
from slam.live.session.description import settings_text
from slam.live.session.reader import open_session
from slam.live.session_records import LogLine, Scan, SessionInfo
from slam.live.ticks import Inbox, SourceEvent
from slam.results import Pipeline, PoseAt, StepResult
from xethru_protocol.operating_system import StopFlag, StopRequestedError

RARE = partial(pytest.param, marks=pytest.mark.rare)
MOST_WAIT_S = 2.0
PERIOD_S = 0.2


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return drive_through(load_scene(write_short_scene(tmp_path_factory.mktemp("scene"))))


def slow_step(slam: Pipeline, inbox: VirtualInbox, more_s: float) -> Step:
    """Return the step of SLAM, which takes so much longer, of virtual time."""

    def step(frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int) -> tuple[StepResult, ...]:
        inbox.now_ns += round(more_s * NS_PER_S)
        return slam.step(frames, pose_at, t_ns)

    return step


class SignalAt(StopFlag):
    """A signal that comes when virtual time does; None: it never comes."""

    def __init__(self, inbox: VirtualInbox, at_s: float | None) -> None:
        super().__init__()
        self._inbox, self._at_s = inbox, at_s

    def check(self) -> None:
        if self._at_s is not None and self._inbox.now_ns >= self._at_s * NS_PER_S:
            raise StopRequestedError(signal.SIGINT)


class Given:
    """When each scan was given out, virtual time, and how many frames waited then at most."""

    def __init__(self, inbox: VirtualInbox) -> None:
        self._inbox = inbox
        self.scans: list[tuple[int, Scan]] = []
        self.most_waiting = 0
        self._n_waiting = -inbox.n_frames  # those from before the first tick are dropped

    def noted(self, scans: Iterator[Scan]) -> Iterator[Scan]:
        for scan in scans:
            self.scans.append((self._inbox.now_ns, scan))
            self._n_waiting -= len(scan.frames)
            self.most_waiting = max(self.most_waiting, self._inbox.n_frames + self._n_waiting)
            yield scan


@dataclass
class Overloaded:
    """A run of a drive with SLAM slowed down, through its end."""

    drive: Drive
    more_s: float
    signal_s: float | None = None
    duration_s: float | None = None
    odometry_s: float | None = None
    epoch_s: int = 0  # what odometry's clock shows at virtual time 0
    session: Path | None = None
    triangle: str = ""  # behind each line of odometry: the covariance of its velocity
    record: RunRecord = field(init=False)

    def run(self) -> "Overloaded":
        drive = self.drive
        self.inbox = VirtualInbox(list(self._events()))
        clock = ClockLine(origin_ns=-self.epoch_s * NS_PER_S)
        odometry = LiveOdometry("the test", clock, has_covariance=bool(self.triangle))
        noise_at = odometry.noise_at if self.triangle else None
        config, wheels = load_preset("robust"), wheels_of(drive.scene)
        log, self.heard = LiveLog(), Listener()
        self.live = LiveSource(
            drive.infos,
            sampler_limits(RAW_CONFIG),
            odometry,
            self.inbox,
            log,
            SignalAt(self.inbox, self.signal_s),
            duration_s=self.duration_s,
            clock_ns=self.inbox.clock_ns,
        )
        log.log("run", "a line of the set-up", warning=False)
        self.start_ns = self.live.settle()
        self.given = Given(self.inbox)
        slam = make_slam(config, rig_of(drive.scene), wheels, noise_at=noise_at)
        info = SessionInfo(
            scene="short",
            preset="robust",
            seed=None,
            radars=drive.infos,
            true_landmarks_m=np.empty((0, 2)),
            versions={},
            config_json=settings_text(config),
            wheels={name: getattr(wheels, name) for name in type(wheels).__dataclass_fields__},
            time_base="arrival",
            started_unix_ns=self.live.started_unix_ns(),
            odometry_covariance=bool(self.triangle),
        )
        if self.session is not None:
            log.begin(SessionLog(self.session, info, start_ns=self.start_ns), self.start_ns)
        source = RunSource(
            info=info,
            rig=rig_of(drive.scene),
            slam=slam,
            step=slow_step(slam, self.inbox, self.more_s),
            scans=self.given.noted(self.live.scans()),
            odometry=odometry,
            link_log=log,
        )
        self.record = execute(source, [self.heard])
        return self

    def _events(self) -> Iterator[Timed]:
        end_ns = None if self.odometry_s is None else round(self.odometry_s * NS_PER_S)
        for row in self.drive.events:
            event = row.event
            if event[0] in {"odometry line", "odometry end"} and end_ns and row.t_ns > end_ns:
                continue
            if event[0] == "odometry line":
                whole, _, rest = event[1].partition(".")
                text = f"{int(whole) + self.epoch_s}.{rest}{self.triangle}"
                event = (event[0], text, event[2])
            yield Timed(row.t_ns, event)
        if end_ns:
            yield Timed(end_ns, ("odometry end", ""))

    @property
    def end_s(self) -> float:
        return self.inbox.now_ns / NS_PER_S

    def waited_s(self) -> list[tuple[float, bool]]:
        """How long each scan waited, by the stamps and arrivals of the drive; and if it was used.

        Session time is virtual host time here. Scans given out after the end are left out.
        """
        came_ns = self.drive.arrivals_ns()
        rows = []
        for given_ns, scan in self.given.scans:
            end_ns = scan.t_ns + round(NS_PER_S / self.drive.infos[0].rate_hz)
            last_ns = max([end_ns, *(came_ns[f.radar, f.counter] for f in scan.frames)])
            rows.append(((given_ns - last_ns) / NS_PER_S, scan.used))
        n_rest = sum(given_ns == self.inbox.now_ns for given_ns, _ in self.given.scans)
        return rows[: len(rows) - n_rest]


@pytest.mark.parametrize("more_s", [RARE(0.21), RARE(0.5), 1.0])
def test_a_signal_ends_a_run_whose_slam_is_too_slow_within_a_second(
    more_s: float, drive: Drive
) -> None:
    run = Overloaded(drive, more_s, signal_s=12.0).run()
    assert isinstance(run.live.ended, StopRequestedError)
    assert 12.0 <= run.end_s <= 13.0
    assert len(run.record.states) > 0
    # all that had come is recorded, to the last whole period
    newest_ns = max(scan.t_ns for _, scan in run.given.scans)
    assert newest_ns > (run.end_s - 2 * PERIOD_S) * NS_PER_S
    counters = [scan.counter for _, scan in run.given.scans]
    assert counters == [*range(counters[0], counters[-1] + 1)]


@pytest.mark.parametrize("more_s", [RARE(0.21), 0.5])
@pytest.mark.parametrize("what", ["duration", "odometry"])
def test_its_duration_and_the_end_of_odometry_end_it_within_a_second(
    what: str, more_s: float, drive: Drive
) -> None:
    if what == "duration":
        run = Overloaded(drive, more_s, duration_s=10.0).run()
        over_s, said = run.start_ns / NS_PER_S + 10.0, "the 10 s asked for are over"
    else:
        run = Overloaded(drive, more_s, odometry_s=13.0).run()
        over_s, said = 13.0, "odometry ended"
    assert run.live.ended == said
    assert over_s - PERIOD_S <= run.end_s <= over_s + 1.0
    stamps_s = [scan.t_ns / NS_PER_S for _, scan in run.given.scans]
    assert over_s - 3 * PERIOD_S <= stamps_s[-1] < over_s  # the last pose may be a period older


@pytest.mark.parametrize("more_s", [RARE(0.21), 0.5, RARE(2.0)])
def test_a_scan_is_dropped_exactly_if_it_waited_more_than_two_seconds(
    more_s: float, drive: Drive
) -> None:
    """Time is known to 1 ns or so, from the line of a module's clock."""
    run = Overloaded(drive, more_s).run()
    rows = run.waited_s()
    assert all(used == (waited_s <= MOST_WAIT_S + 1e-6) for waited_s, used in rows)
    dropped = sum(not used for _, used in rows)
    assert run.live.ticks.n_dropped == dropped > 0
    assert max(waited_s for waited_s, _ in rows) <= MOST_WAIT_S + more_s + 0.05  # no lag grows
    n_used = sum(used for _, used in rows)
    took_s = run.end_s - run.start_ns / NS_PER_S
    assert n_used == pytest.approx(took_s / more_s, abs=4)  # SLAM has always something to do
    _, first, *_ = [line.text for line in run.heard.lines if line.radar == "run"]
    assert first.startswith("SLAM cannot keep up with the radars: this machine is too slow")
    assert "1 scan waited longer than 2 s: recorded, not used" in first
    assert run.given.most_waiting <= 4 * (MOST_WAIT_S + more_s + 2 * PERIOD_S) / PERIOD_S


def test_slam_that_keeps_up_drops_nothing(drive: Drive) -> None:
    run = Overloaded(drive, 0.15).run()
    assert run.live.ticks.n_dropped == 0
    assert all(
        line.text == "a line of the set-up" for line in run.heard.lines if line.radar == "run"
    )


def test_the_session_of_an_overloaded_run_replays_to_the_last_bit(
    drive: Drive, tmp_path: Path
) -> None:
    path = tmp_path / "session.mcap"
    run = Overloaded(drive, 0.5, signal_s=20.0, session=path).run()
    session = open_session(path)
    recorded = [(scan.counter, scan.used) for scan in session.scans()]
    assert recorded == [(scan.counter, scan.used) for _, scan in run.given.scans]
    assert {used for _, used in recorded} == {True, False}
    # an independent reader: marks by topic
    with path.open("rb") as stream:
        topics = [c.topic for _, c, _ in make_reader(stream).iter_messages(log_time_order=False)]
    assert topics.count("/scan_unused") == sum(not used for _, used in recorded)

    comparison = Comparison()
    again = execute(recorded_source(session, StopFlag(), comparison), [comparison])
    n_states = len(run.record.states)
    same = f"all {n_states} recorded states came again, to the last bit"
    assert comparison.verdict() == f"{same}, and so did the smoothed path"
    assert again.states.estimate.tobytes() == run.record.states.estimate.tobytes()


def test_a_session_with_unix_stamps_lasts_as_long_as_its_run(drive: Drive, tmp_path: Path) -> None:
    """By an independent reader: no message is of 1970, the lines from before the first scan too."""
    path = tmp_path / "session.mcap"
    epoch_s = 1_790_000_000
    run = Overloaded(drive, 0.0, duration_s=6.0, epoch_s=epoch_s, session=path).run()
    assert len(run.record.states) > 10
    with path.open("rb") as stream:
        rows = [(c.topic, m.log_time) for _, c, m in make_reader(stream).iter_messages()]
    times_ns = [t_ns for _, t_ns in rows]
    assert min(times_ns) / NS_PER_S >= epoch_s
    assert (max(times_ns) - min(times_ns)) / NS_PER_S < 6.0 + 4.0  # two seconds to settle
    (line, *_) = [one for one in open_session(path).records() if isinstance(one, LogLine)]
    assert (line.text, line.t_ns) == ("a line of the set-up", run.start_ns)


def test_a_full_queue_holds_the_readers_back_and_refuses_lines_about_links() -> None:
    inbox, stopped = Inbox(2), threading.Event()
    event: SourceEvent = ("odometry line", "text", 0)
    inbox.hand_over(event, stopped)
    inbox.offer(("lost", 0, "why"))
    inbox.offer(("lost", 1, "why"))
    assert (inbox.qsize(), inbox.n_refused) == (2, 1)
    waiting = threading.Thread(target=inbox.hand_over, args=(("lost", 2, ""), stopped))
    waiting.start()
    assert inbox.get() == event
    waiting.join(seconds(5))
    assert [inbox.get(), inbox.get()] == [("lost", 0, "why"), ("lost", 2, "")]
    for _ in range(2):
        inbox.put(event)
    stopped.set()
    inbox.hand_over(event, stopped)  # returns at once
    assert inbox.qsize() == 2


def test_the_covariance_of_odometry_is_used_and_replayed_bit_for_bit(
    drive: Drive, tmp_path: Path
) -> None:
    """A doubted heading makes a larger covariance of the pose; the recorded floats are the same."""
    path = tmp_path / "session.mcap"
    numbers = (1e-4 / 3, 2e-6, 1e-5, 2e-5 / 7, -1e-6, 0.01 / 3)
    triangle = "".join(f" {one!r}" for one in numbers)
    run = Overloaded(drive, 0.0, duration_s=8.0, session=path, triangle=triangle).run()
    plain = Overloaded(drive, 0.0, duration_s=8.0).run()
    turns = [one.record.states.pose_covariances[3, 2, 2] for one in (run, plain)]
    assert turns[0] > 4.0 * turns[1]
    session = open_session(path)
    samples = [record for record in session.records() if isinstance(record, TumSample)]
    assert {sample.velocity_covariance for sample in samples} == {numbers}
    comparison = Comparison()
    execute(recorded_source(session, StopFlag(), comparison), [comparison])
    n_states = len(run.record.states)
    assert f"all {n_states} recorded states came again" in comparison.verdict()
    noise = session.odometry_noise
    slam = Slam(session.rig, session.config, wheels=session.wheels, odometry_noise=noise)
    states = [slam.step(scan.t_ns, scan.odometry, frames=scan) for scan in session]
    poses = [result.belief.pose for state in states for result in state.results]
    assert np.array_equal(poses, run.record.states.estimate)
