"""`uwb-slam demo` as a user runs it, on a short scene: files, numbers, and sameness of paths."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from PIL import Image
from rerun.chunk import RrdReader
from rosbags.highlevel import AnyReader

from slam.app.commands.demo import name_the_next
from slam.app.commands.evaluate import evaluate
from slam.app.run.runner import execute
from slam.app.run.summary import summarise
from slam.app.sweep.run import make_case, source_of
from slam.app.view.rerun_recording import count_rows
from slam.live.odometry_track import read_tum
from slam.live.session import cdr as ros

pytestmark = pytest.mark.slow

SEED = 5
RADARS = ("front_left", "rear_left", "front_right", "rear_right")


@dataclass(frozen=True)
class Finished:
    scene: Path
    out: Path
    stdout: str
    stderr: str


@pytest.fixture(scope="module")
def finished(demo: Path) -> Finished:
    said, progress = ((demo / name).read_text() for name in ("stdout", "stderr"))
    return Finished(scene=demo / "short.toml", out=demo / "out", stdout=said, stderr=progress)


def test_stdout_is_one_table_of_simulated_numbers_and_stderr_is_progress(
    finished: Finished,
) -> None:
    lines = finished.stdout.splitlines()
    assert lines[0] == f"short, preset robust, seed {SEED}: simulated numbers"
    assert [line.split("  ")[0] for line in lines[2:-1]] == [
        "odometry ATE",
        "SLAM ATE",
        "lagged ATE",
        "smoothed ATE",
        "SLAM ATE, ICP",
        "final error",
        "landmarks",
        "observable",
        "speed",
    ]
    assert "0 lost" in lines[-2]
    said = finished.stderr.splitlines()
    progress = [line for line in said if line.startswith("scene time")]
    assert progress
    saved, report, viewer = (line for line in said if line not in progress)
    assert saved.startswith(f"uwb-slam: {finished.scene.with_name('map.json')} has ")
    assert (report, viewer) == (
        f"report: uwb-slam report {finished.out}",
        f"viewer: uwb-slam view {finished.out}",
    )


def test_exactly_the_promised_files(finished: Finished) -> None:
    assert {path.name for path in finished.out.iterdir()} == {
        "session.mcap",
        "session.rrd",
        "map.png",
        "image.png",
        "summary.json",
        "estimate.tum",
        "lagged.tum",
        "smoothed.tum",
        "truth.tum",
        "odometry.tum",
    }


def test_the_session_has_the_time_of_day(finished: Finished) -> None:
    with (finished.out / "session.mcap").open("rb") as stream:
        (table, *_) = [found.metadata for found in make_reader(stream).iter_metadata()]
    scene = finished.scene.stat()
    assert scene.st_mtime_ns <= int(table["started_unix_ns"]) < finished.out.stat().st_mtime_ns


def test_summary_agrees_with_the_trajectory_files(finished: Finished) -> None:
    summary = json.loads((finished.out / "summary.json").read_text())
    assert summary["landmarks"]["true"] > 0
    assert len(summary["nees_pose"]) == len(summary["smoothed_nees_pose"]) == 10
    assert summary["smoothed_ate_rmse_m"] < summary["ate_rmse_m"]
    truth = finished.out / "truth.tum"
    for name, field in (
        ("estimate", "ate_rmse_m"),
        ("smoothed", "smoothed_ate_rmse_m"),
        ("odometry", "odometry_ate_rmse_m"),
    ):
        result = evaluate(read_tum(finished.out / f"{name}.tum"), read_tum(truth))
        assert result["ate_rmse_m"] == pytest.approx(summary[field], rel=1e-9)
        assert result["pairs"] == result["reference_poses"]


def test_rosbags_reads_every_frame_without_a_gap(finished: Finished) -> None:
    summary = json.loads((finished.out / "summary.json").read_text())
    with AnyReader([finished.out / "session.mcap"]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    frames = [counts[f"/radar/{name}/frame"] for name in RADARS]
    assert sum(frames) == summary["frames"]
    with (finished.out / "session.mcap").open("rb") as stream:
        topic = f"/radar/{RADARS[0]}/frame"
        counters = [m.sequence for _, _, m in make_reader(stream).iter_messages(topics=[topic])]
    assert counters == list(range(1, frames[0] + 1))


def test_the_rrd_holds_every_frame_and_a_blueprint(finished: Finished) -> None:
    summary = json.loads((finished.out / "summary.json").read_text())
    rows = count_rows(finished.out / "session.rrd")
    assert sum(rows[f"/radar/{name}/frame"] for name in RADARS) == summary["frames"]
    assert rows["/link/log/front_left"] > 10
    assert rows["/map/image/cells"] == rows["/map/image"] >= 2
    # that of the beginning, and that which shows the whole map
    assert len(RrdReader(finished.out / "session.rrd").blueprints()) == 2


def test_the_map_is_a_picture_with_all_its_colours(finished: Finished) -> None:
    with Image.open(finished.out / "map.png") as picture:
        assert min(picture.size) >= 800
        colours = picture.convert("RGB").getcolors(maxcolors=1 << 24)
    assert colours is not None
    found = {colour for _, colour in colours}
    for line_colour in ((31, 111, 208), (194, 37, 92)):  # estimate, landmarks
        assert line_colour in found


def test_the_image_is_a_picture_of_the_room(finished: Finished) -> None:
    with Image.open(finished.out / "image.png") as picture:
        assert min(picture.size) >= 800
        greys = np.asarray(picture.convert("L"))
    # rods are bright on a dark ground, beside what no radar saw
    assert (greys > 225).mean() > 1e-3
    assert (greys < 30).mean() > 0.2


def test_the_link_log_tells_how_the_radars_were_set_up(finished: Finished) -> None:
    with (finished.out / "session.mcap").open("rb") as stream:
        lines = [
            ros.deserialise(message.data, ros.LOG)
            for _, _, message in make_reader(stream).iter_messages(topics=["/log"])
        ]
    for name in RADARS:
        said = [line.msg for line in lines if line.name == name]
        assert any("PING" in text.upper() for text in said)
        assert any("FRAMEAREA" in text for text in said)


def test_ports_and_in_process_give_the_same_belief_bit_for_bit(finished: Finished) -> None:
    source = source_of(make_case(str(finished.scene), "robust", SEED))
    record = execute(source)
    estimate = read_tum(finished.out / "estimate.tum")
    np.testing.assert_array_equal(estimate.stamps_ns, record.states.t_ns)
    positions = record.states.estimate[:, :2]
    assert estimate.poses[:, :2].tobytes() == positions.tobytes()
    summary = json.loads((finished.out / "summary.json").read_text())
    in_process = summarise(record, source.info, source.rig)
    assert in_process is not None
    again = json.loads(json.dumps(in_process.numbers()))
    # covariances, landmarks and innovations all enter here
    for numbers in (summary, again):
        del numbers["realtime_factor"]
    assert summary == again


def test_the_last_lines_are_commands_that_work_where_the_demo_ran(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (folder := tmp_path / ".venv" / "bin").mkdir(parents=True)
    (program := folder / "uwb-slam").touch(mode=0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [".venv/bin/uwb-slam", "demo"])
    monkeypatch.setenv("PATH", "/nowhere")
    name_the_next(Path("my out"), has_view=False)
    monkeypatch.setenv("PATH", str(program.parent))
    name_the_next(Path("out"), has_view=False)
    assert capfd.readouterr().err.splitlines() == [
        "report: .venv/bin/uwb-slam report 'my out'",
        "report: uwb-slam report out",
    ]
