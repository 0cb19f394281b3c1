"""Bags of ROS 1 and ROS 2: sessions there and back, and the authors' layout as we generate it."""

import math
import signal
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from hil_tests.patience import seconds
from hil_tests.unit.slam.app.convert.authors_bag import (
    N_SCANS,
    START_NS,
    AuthorsBag,
    authors_bag,
    jittered_ns,
    samples,
)
from hil_tests.unit.slam.app.sessions import (
    FRAME_NS,
    feed,
    run,
    scan,
    session_info,
    snapshot,
    write_scans,
)
from slam.app.convert.convert import run_convert
from slam.app.session.writer import SessionLog
from slam.live.odometry_track import OdometryTrack, format_tum_line
from slam.live.session.reader import RecordedSession, open_session
from xethru_protocol.operating_system import StopFlag, StopRequestedError

KINDS = ("bag.bag", "bag")


def facts(session: RecordedSession) -> list[tuple[object, ...]]:
    return [
        (
            one.counter,
            one.t_ns,
            one.used,
            [(f.radar, f.counter, f.t_ns, f.samples.tobytes()) for f in one.frames],
        )
        for one in session.scans()
    ]


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    lines = [format_tum_line(k * 150_000_000, np.array([k / 3, k / 7, k / 11])) for k in range(30)]
    path = tmp_path / "session.mcap"
    log = SessionLog(
        path,
        replace(session_info(), config_json='{"a": 1}', wheels={"scale_sigma": 0.1}),
        OdometryTrack.from_lines(lines),
        truth_at=lambda t_ns: np.array([snapshot(int(t) // FRAME_NS).truth for t in t_ns]),
    )
    feed(log, N_SCANS)
    log.close()
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_a_session_comes_back_from_a_bag(
    kind: str, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, again = tmp_path / kind, tmp_path / "again.mcap"
    code, out, err = run(capsys, "convert", recorded, bag)
    assert (code, err) == (0, "")
    assert f"{2 * N_SCANS} frames" in out
    assert run(capsys, "convert", bag, again)[::2] == (0, "")
    first, second = open_session(recorded), open_session(again)
    assert facts(second) == facts(first)
    assert list(second.odometry()) == list(first.odometry())
    for one, other in zip(first.scans(), second.scans(), strict=True):
        assert one.truth is not None
        assert other.truth is not None
        np.testing.assert_allclose(other.truth, one.truth, rtol=0, atol=1e-12)
    assert second.info.radars == first.info.radars
    assert second.info.seed == 7
    assert second.info.config_json == '{"a": 1}'
    assert second.info.wheels == {"scale_sigma": 0.1}
    np.testing.assert_array_equal(second.info.true_landmarks_m, first.info.true_landmarks_m)


@pytest.mark.parametrize("kind", KINDS)
def test_the_bag_has_the_topics_and_types_of_the_data_set(
    kind: str, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, "convert", recorded, tmp_path / kind)
    with AnyReader([tmp_path / kind]) as reader:
        types = {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}
        connection = next(c for c in reader.connections if c.topic == "/UWBradar2/readings")
        (_, t_ns, raw), *_ = list(reader.messages([connection]))[3:]
        message: Any = reader.deserialize(raw, connection.msgtype)
    assert types["/UWBradar1/readings"] == ("std_msgs/msg/Float32MultiArray", N_SCANS)
    assert types["/UWBradar2/readings"] == ("std_msgs/msg/Float32MultiArray", N_SCANS)
    assert types["/odom"][0] == "nav_msgs/msg/Odometry"
    assert types["/slam_out_pose"] == ("geometry_msgs/msg/PoseStamped", N_SCANS)
    assert t_ns == 3 * FRAME_NS
    np.testing.assert_array_equal(message.data, scan(3).frames[1].samples)


@pytest.mark.parametrize("topics", ["/UWBradar{}/readings", "/UWBradar{}"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_authors_layout_becomes_a_session(
    kind: str, topics: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = authors_bag(tmp_path / kind, topics=topics)
    code, out, err = run(capsys, "convert", bag, tmp_path / "s.mcap")
    assert (code, err) == (0, "")
    assert f"{4 * N_SCANS} frames of 4 radars in {N_SCANS} scans" in out
    session = open_session(tmp_path / "s.mcap")
    assert session.info.started_unix_ns == 0  # stamps are the time of day
    assert [(m.name, m.x_m, m.y_m, round(math.degrees(m.yaw_rad))) for m in session.rig.mounts] == [
        ("UWBradar1", 0.1, -0.2, -90),
        ("UWBradar2", -0.1, 0.2, 90),
        ("UWBradar3", -0.1, -0.2, -90),
        ("UWBradar4", 0.1, 0.2, 90),
    ]
    radar = session.info.radars[0]
    # the module's own answer to 0.2 .. 9.4 m: protocol reference 9.4
    assert radar.range_start_m == pytest.approx(0.19929012656, abs=1e-9)
    assert radar.range_start_m + 1431 * radar.bin_length_m == pytest.approx(9.40067863, abs=1e-6)
    assert radar.rate_hz == pytest.approx(5.0, rel=0.1)
    assert (session.info.seed, session.info.simulated) == (None, False)
    for number, one in enumerate(session.scans()):
        assert [(f.radar, f.counter, f.t_ns) for f in one.frames] == [
            (radar, number, jittered_ns(radar, number)) for radar in range(4)
        ]
        for frame in one.frames:
            np.testing.assert_array_equal(frame.samples, samples(frame.radar, number))
        assert one.used
        assert one.truth is not None
        passed_s = (one.t_ns - START_NS + 300_000_000) / 1e9
        np.testing.assert_allclose(one.truth, [2.0 + passed_s / 4, -0.5, 0.2], atol=1e-9)
    # stamps are those of the headers, not of the recording 3 ms later
    assert session.odometry().first_ns == START_NS - 300_000_000


def problem(capsys: pytest.CaptureFixture[str], bag: Path, *options: object, code: int = 1) -> str:
    out = bag.parent / "s.mcap"
    found, said, err = run(capsys, "convert", bag, out, *options)
    assert (found, said) == (code, "")
    assert len(err.splitlines()) == 1
    assert not out.exists()
    return err


@pytest.mark.parametrize(
    ("source", "out", "used"),
    [
        ("s.mcap", "a.xtwire", {"--radar"}),
        ("s.mcap", "a.bag", set()),
        ("s.mcap", "a", set()),
        ("a.mat", "b.mcap", {"--preset", "--rig", "--rate"}),
        ("a.bag", "b.mcap", {"--preset", "--rig", "--frame-area", "--truth"}),
    ],
)
def test_an_option_that_a_conversion_does_not_use_is_refused(
    source: str, out: str, used: set[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    SessionLog(tmp_path / "s.mcap", session_info(), None).close()  # nothing else is there
    for words in (
        ("--preset", "paper"),
        ("--rig", "lab"),
        ("--rate", 5),
        ("--radar", "radar0"),
        ("--frame-area", 0.2, 9.4),
        ("--truth", "/slam_out_pose"),
    ):
        code, _, err = run(capsys, "convert", tmp_path / source, tmp_path / out, *words)
        assert code == (1 if words[0] in used else 2)
        assert (words[0] in err) == (words[0] not in used)


def test_another_frame_area(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = authors_bag(tmp_path / "short.bag", n_bins=500)
    assert run(capsys, "convert", short, tmp_path / "s.mcap", "--frame-area", 0.2, 3.41)[0] == 0
    (radar, *_) = open_session(tmp_path / "s.mcap").info.radars
    assert (radar.n_bins, round(radar.range_start_m, 2)) == (500, 0.2)
    for area_m in ((9.4, 0.2), ("nan", 9.4)):
        (tmp_path / "s.mcap").unlink(missing_ok=True)
        said = problem(capsys, short, "--frame-area", *area_m)
        assert said.startswith("uwb-slam: --frame-area: ")


def test_what_is_odd_is_said_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = authors_bag(tmp_path / "odd.bag", jump_back=True, truth=False)
    code, _, err = run(capsys, "convert", bag, tmp_path / "s.mcap")
    assert code == 0
    assert err.splitlines() == [
        f"uwb-slam: {bag}: poses that went back in time and are left out: 1",
        f"uwb-slam: {bag}: no truth on /slam_out_pose: numbers that need it will be null",
    ]
    assert [one.truth for one in open_session(tmp_path / "s.mcap").scans()] == [None] * N_SCANS


def test_scans_that_odometry_does_not_reach_are_not_used(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = [format_tum_line(k * FRAME_NS + 5, np.zeros(3)) for k in range(1, 5)]
    short = tmp_path / "short.mcap"
    write_scans(short, map(scan, range(8)), OdometryTrack.from_lines(poses))
    run(capsys, "convert", short, tmp_path / "bag")
    code, _, err = run(capsys, "convert", tmp_path / "bag", tmp_path / "again.mcap")
    assert code == 0
    assert "5 scans lie outside the odometry" in err
    used = [one.used for one in open_session(tmp_path / "again.mcap").scans()]
    assert used == [False, False, True, True, True, False, False, False]


def test_scans_in_a_hole_of_odometry_are_kept_and_not_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Frames every 200 ms, radar by radar 30 ms later; no pose between 4 s and 7 s."""
    bag = AuthorsBag(tmp_path / "bag")
    second = 1_000_000_000
    for number in range(50):
        for radar in range(4):
            t_ns = START_NS + number * second // 5 + radar * 30_000_000
            bag.add_frame(t_ns, radar + 1, samples(radar, number))
    for k in range(260):
        if not 100 < k < 175:
            t_ns = START_NS + k * second // 25
            bag.add_odometry(t_ns, t_ns, (0.01 * k, 0.0, 0.0))
    bag.write()
    out = tmp_path / "s.mcap"
    code, _, err = run(capsys, "convert", bag.path, out)
    assert code == 0
    assert "15 scans lie outside the odometry, or in a hole of it longer than 1 s" in err
    used = [one.used for one in open_session(out).scans()]
    # scan 20 begins at 4.0 s, where the last pose is, and ends at 4.09 s; scan 35 begins at 7.0 s
    assert [number for number, is_used in enumerate(used) if not is_used] == list(range(20, 35))
    assert len(used) == 50
    assert run(capsys, "replay", out, "--out", tmp_path / "replay")[0] == 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_cut_bag_is_one_line(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = authors_bag(tmp_path / kind)
    file = bag if bag.is_file() else bag / "bag.db3"
    content = file.read_bytes()
    for share in (0.0, 0.01, 0.5, 0.98):
        file.write_bytes(content[: round(share * len(content))])
        assert f"uwb-slam: {bag}: no bag of ROS 1 or 2, or a damaged one" in problem(capsys, bag)


def test_a_topic_of_another_type_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = AuthorsBag(tmp_path / "a.bag", topics="/odom{}")
    bag.add_truth(START_NS, START_NS, (0.0, 0.0, 0.0))
    bag.add_frame(START_NS, 1, samples(0, 0))
    bag.write()
    said = problem(capsys, bag.path, "--truth", "/odom1")
    assert "/odom1 is std_msgs/msg/Float32MultiArray, must be geometry_msgs/msg/PoseSta" in said
    plain = authors_bag(tmp_path / "b.bag", topics="/slam_out_pose{}")
    assert "holds no frames" in problem(capsys, plain)


def test_a_signal_stops_a_conversion_and_leaves_nothing(recorded: Path, tmp_path: Path) -> None:
    bag = authors_bag(tmp_path / "a.bag")

    stop = StopFlag()
    stop.received = signal.SIGINT
    for source, out in ((bag, tmp_path / "s.mcap"), (recorded, tmp_path / "out")):
        with pytest.raises(StopRequestedError):
            run_convert(
                stop,
                source=source,
                out=out,
                rig=None,
                frame_area_m=None,
                truth_topic=None,
                rate_hz=None,
                preset=None,
                radar=None,
            )
        assert not out.exists()


@pytest.mark.parametrize(
    ("name", "at_check"), [("s.mcap", 220), pytest.param("folder", 20, marks=pytest.mark.thorough)]
)
def test_a_killed_conversion_leaves_nothing_under_its_name(
    name: str, at_check: int, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = recorded if name == "folder" else authors_bag(tmp_path / "a.bag")
    before, out = sorted(tmp_path.iterdir()), tmp_path / name
    code = (
        "import os, sys\n"
        "from slam.app import cli\n"
        "class Killer(cli.StopFlag):\n"
        "    calls = 0\n"
        "    def check(self):\n"
        "        Killer.calls += 1\n"
        f"        if Killer.calls == {at_check}: os.kill(os.getpid(), 9)\n"
        "cli.StopFlag = Killer\n"
        "cli.main(['convert', *sys.argv[1:]])\n"
    )
    command = [sys.executable, "-c", code, str(source), str(out)]
    assert subprocess.run(command, timeout=seconds(30)).returncode == -signal.SIGKILL
    assert not out.exists()
    assert len(list(tmp_path.iterdir())) == len(before) + 1, "it was at it"
    assert run(capsys, "convert", source, out)[0] == 0
    assert sorted(tmp_path.iterdir()) == sorted([*before, out])


@pytest.mark.parametrize(
    "error",
    [OSError(28, "No space left on device"), sqlite3.OperationalError("disk is full")],
    ids=["OSError", "SQLite"],
)
def test_a_disk_that_fills_up_is_one_line_and_leaves_nothing(
    error: Exception,
    recorded: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_: object) -> None:
        raise error

    monkeypatch.setattr("slam.app.convert.rosbag._fill", full)
    for out in (tmp_path / kind for kind in KINDS):
        code, said, err = run(capsys, "convert", recorded, out)
        assert (code, said) == (1, "")
        (line,) = err.splitlines()
        assert line.startswith(f"uwb-slam: {out}: cannot be written: ")
        assert not out.exists()


def test_frames_of_one_period_are_one_scan_even_if_one_is_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "s.mcap"
    poses = [format_tum_line(k * FRAME_NS, np.zeros(3)) for k in range(12)]
    scans = [scan(counter) for counter in range(8)]
    scans[3] = replace(scans[3], frames=scans[3].frames[1:])
    write_scans(path, scans, OdometryTrack.from_lines(poses))
    run(capsys, "convert", path, tmp_path / "bag")
    run(capsys, "convert", tmp_path / "bag", tmp_path / "again.mcap")
    taken = [one for one in open_session(tmp_path / "again.mcap").scans()]
    assert [[f.radar for f in one.frames] for one in taken] == [
        [1] if counter == 3 else [0, 1] for counter in range(8)
    ]
