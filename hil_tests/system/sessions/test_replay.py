"""Replay of what a demo recorded: the same numbers, also of a file cut or killed half-way."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from hil_tests.system.recorded_session import record_session
from hil_tests.unit.slam.app.sessions import Listener
from hil_tests.unit.slam.live.session.test_state_rows import assert_same_step
from slam.app.cli import main
from slam.app.run import replay
from slam.app.run.replay import recorded_source
from slam.app.run.runner import execute
from slam.app.session.constants import slam_constants
from slam.live.session.reader import open_session
from slam.live.session_records import Snapshot
from slam.robust.parameters import BackEndParameters, InitialisationRule
from xethru_protocol.operating_system import StopFlag

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Recorded:
    folder: Path
    summary: dict[str, object]


OPTIONS = {
    "paper": ("--preset", "paper", "--wire", "--lean"),
    "ranges": ("--set", "robust.patches=false", "--wire"),
}


@pytest.fixture(
    scope="module",
    params=["robust", *(pytest.param(name, marks=pytest.mark.rare) for name in OPTIONS)],
)
def recorded(
    request: pytest.FixtureRequest, demo: Path, tmp_path_factory: pytest.TempPathFactory
) -> Recorded:
    folder = demo / "out"
    if request.param in OPTIONS:  # the scene is long enough for the window of paper to be full
        folder = tmp_path_factory.mktemp("replay") / "out"
        options = [*OPTIONS[request.param], "--out", str(folder)]
        assert main(["demo", "--scene", str(demo / "short.toml"), *options]) == 0
    return Recorded(folder=folder, summary=json.loads((folder / "summary.json").read_text()))


def test_every_number_but_the_speed_comes_again(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = recorded.folder / "session.mcap"
    assert main(["replay", str(session), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().err
    n_states = len((recorded.folder / "estimate.tum").read_text().splitlines())
    names = ["estimate", "truth", "odometry"]
    if recorded.summary["preset"] == "robust":
        names.append("smoothed")
    too = ", and so did the smoothed path" if "smoothed" in names else ""
    assert f"all {n_states} recorded states came again, to the last bit{too}\n" in said
    assert (recorded.summary["smoothed_ate_rmse_m"] is None) is ("smoothed" not in names)
    assert n_states > 50
    again = json.loads((tmp_path / "summary.json").read_text())
    del again["realtime_factor"]
    assert again == {k: v for k, v in recorded.summary.items() if k != "realtime_factor"}
    for name in names:
        assert (tmp_path / f"{name}.tum").read_bytes() == (
            recorded.folder / f"{name}.tum"
        ).read_bytes()
    assert (tmp_path / "map.png").stat().st_size > 10_000
    recorded_bytes = list(open_session(session).wire())
    # from the ping on, which is sent before there is a session to write to
    assert recorded_bytes[0][1:3] == ("tx", bytes.fromhex("7d01aeeaaaee7c7e"))
    assert sum(len(data) for _, way, data, _ in recorded_bytes if way == "rx") > 300_000


def test_a_lean_session_lacks_what_is_only_drawn(recorded: Recorded) -> None:
    path = recorded.folder / "session.mcap"
    with AnyReader([path]) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)
    n_states = counts["/slam/state"]
    drawn = {"/estimate/pose": n_states, "/radar/rear_left/range": n_states}
    once = {"/fields_of_view", "/scene", "/radar/rear_left/bscan/axes"}
    if open_session(path).info.preset == "paper":
        assert not counts.keys() & (drawn.keys() | once)
    else:
        assert {topic: counts.get(topic) for topic in drawn} == drawn
        assert once <= counts.keys()
        # a picture after every 32 frames, and one at the end
        assert counts["/radar/rear_left/bscan"] == -(-counts["/radar/rear_left/frame"] // 32)


def middle_of_scans(session: Path) -> int:
    """Return a byte in the middle of the chunks that have scans.

    On a slow machine the first half of the file holds raw bytes from before the first scan.
    """
    with session.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    (scans,) = (number for number, one in summary.channels.items() if one.topic == "/scan")
    having = [one for one in summary.chunk_indexes if scans in one.message_index_offsets]
    middle = having[len(having) // 2]
    return middle.chunk_start_offset + middle.chunk_length // 2


def test_what_is_left_of_a_cut_file_is_the_beginning_of_the_run(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = recorded.folder / "session.mcap"
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(session.read_bytes()[: middle_of_scans(session)])
    assert main(["replay", str(cut), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().err
    assert "was cut at byte" in said
    assert "recorded states came again, to the last bit" in said
    lines = (tmp_path / "out" / "estimate.tum").read_text().splitlines()
    expected = (recorded.folder / "estimate.tum").read_text().splitlines()
    n_flushed = 14  # of preset paper: states that were in the window when the file ended
    assert len(expected) / 4 < len(lines) < len(expected)
    assert lines[:-n_flushed] == expected[: len(lines) - n_flushed]


def test_what_led_to_every_state_is_recorded(recorded: Recorded) -> None:
    """The replay's own steps against the numbers in the file, taken apart by hand."""
    session = recorded.folder / "session.mcap"
    listener = Listener()
    execute(recorded_source(open_session(session), StopFlag()), [listener])
    with session.open("rb") as stream:
        messages = [m for _, _, m in make_reader(stream).iter_messages(topics=["/slam/step"])]
    assert [m.log_time for m in messages] == [live.t_ns for live in listener.snapshots]
    n_detections, n_lagged = 0, 0
    for message, live in zip(messages, listener.snapshots, strict=True):
        step = live.step
        assert step is not None
        # CDR: 4 bytes of head, then doubles at multiples of 8 from there; the array comes last
        row = np.frombuffer(message.data[4 + (len(message.data) - 4) % 8 :], "<f8")
        report, n_own, n_spans = step.report, len(step.detections), len(live.wall_spans_m)
        size = 14 + 9 * n_own + 6 * len(step.fixes) + 7 * len(step.observations)
        size += sum(2 * len(a.candidate_ids) for a in step.associations) + len(step.rejected)
        size += sum(f in step.fixes for o in step.observations for f in o.fixes) + 4 * n_spans
        if report is not None:
            size += 3 * len(report.continued) + 8 * len(report.predicted) + 13 * len(step.lagged)
            assert row[-size:][10:14].tolist() == [
                report.nis,
                report.dof,
                report.carried,
                report.lost,
            ]
        row = row[-size:]
        assert row[:3].tolist() == [n_own, len(step.fixes), len(step.observations)]
        ranges = row[14 : 14 + 9 * n_own].reshape(-1, 9)
        assert ranges[:, 0].tolist() == [one.radar for one in step.detections]
        assert (live.t_ns + ranges[:, 1].astype(int)).tolist() == [
            one.t_ns for one in step.detections
        ]
        assert ranges[:, 2].tolist() == [one.range_m for one in step.detections]
        assert tuple(ranges[:, 8].tolist()) == (step.range_sigmas_m or (0.0,) * n_own)
        n_detections += n_own
        lagged = row[size - 13 * len(step.lagged) :].reshape(-1, 13)
        n_lagged += len(lagged)
        assert (live.t_ns + lagged[:, 0].astype(int)).tolist() == [one.t_ns for one in step.lagged]
        assert lagged[:, 1:4].tolist() == [one.pose.tolist() for one in step.lagged]
    assert n_detections > 100
    assert (n_lagged > 0) == (recorded.summary["preset"] == "robust")
    states = [r for r in open_session(session).records() if isinstance(r, Snapshot)]
    for found, live in zip(states, listener.snapshots, strict=True):
        assert found.wall_spans_m.tolist() == live.wall_spans_m.tolist()
        assert_same_step(found.step, live.step)


def test_what_damage_took_is_named_and_not_held_against_the_processor(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = recorded.folder / "session.mcap"
    content = bytearray(session.read_bytes())
    content[middle_of_scans(session)] ^= 0x55
    (path := tmp_path / "session.mcap").write_bytes(content)
    assert main(["replay", str(path), "--out", str(tmp_path / "refused")]) == 1
    assert "repair" in capsys.readouterr().err
    assert main(["repair", str(path)]) == 0
    assert "lost: " in capsys.readouterr().out
    assert main(["replay", str(path), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().err
    (n_before,) = map(int, re.findall(r"all (\d+) recorded states before the first gap", said))
    lines = (tmp_path / "out" / "estimate.tum").read_text().splitlines()
    expected = (recorded.folder / "estimate.tum").read_text().splitlines()
    assert 10 < n_before < len(expected)
    assert lines[:n_before] == expected[:n_before]
    assert re.search(r"\b[1-9]\d* frames? of ", said)
    assert "processor" not in said


@pytest.mark.thorough
def test_a_run_with_other_rules_is_replayed_with_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a session of another version is, whose rules are not those of this one."""
    name = "slam.robust.parameters.InitialisationRule.window"
    constants = slam_constants() | {name: 21, "slam.robust.map.MERGE_SIGMA_M": 9.0}
    rules = BackEndParameters(initialisation=InitialisationRule(window=21))
    session = tmp_path / "session.mcap"
    record_session(session, "robust", rules=rules, constants=constants)
    assert main(["replay", str(session), "--out", str(tmp_path / "out")]) == 0
    assert "recorded states came again, to the last bit" in capsys.readouterr().err
    monkeypatch.setattr(replay, "recorded_rules", lambda constants: BackEndParameters())
    assert main(["replay", str(session), "--out", str(tmp_path / "again")]) == 0
    said = capsys.readouterr().err
    assert "only " in said
    assert "slam.robust.map.MERGE_SIGMA_M 9.0, here 1e-05" in said
    assert "processor" not in said
