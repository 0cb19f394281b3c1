"""`uwb-slam demo` as a user runs it, on a short scene: files, numbers, and sameness of paths."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from PIL import Image
from rerun.chunk import RrdReader
from rosbags.highlevel import AnyReader

from hil_tests.system.short_scene import write_short_scene
from slam.app.commands.demo import name_the_next
from slam.app.commands.evaluate import evaluate
from slam.app.run.runner import execute
from slam.app.run.summary import summarise
from slam.app.sweep.run import make_case, source_of
from slam.app.view.rerun_recording import count_rows
from slam.live.odometry_track import read_tum
from slam.live.session import cdr as ros

pytestmark = pytest.mark.slow

SEED = 11
RADARS = ("front_left", "rear_left", "front_right", "rear_right")


@dataclass(frozen=True)
class Finished:
    scene: Path
    out: Path
    process: subprocess.CompletedProcess[str]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    folder = tmp_path_factory.mktemp("demo")
    scene = write_short_scene(folder)
    out = folder / "out"
    command = [sys.executable, "-m", "slam.app.cli", "demo", "--scene", str(scene)]
    command += ["--seed", str(SEED), "--out", str(out)]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    return Finished(scene=scene, out=out, process=process)


def test_stdout_is_one_table_of_simulated_numbers_and_stderr_is_progress(demo: Finished) -> None:
    lines = demo.process.stdout.splitlines()
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
    *progress, report, viewer = demo.process.stderr.splitlines()
    assert progress
    assert (report, viewer) == (
        f"report: uwb-slam report {demo.out}",
        f"viewer: uwb-slam view {demo.out}",
    )
    assert all(line.startswith("scene time") for line in progress)


def test_exactly_the_promised_files(demo: Finished) -> None:
    assert {path.name for path in demo.out.iterdir()} == {
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


def test_the_session_has_the_time_of_day(demo: Finished) -> None:
    with (demo.out / "session.mcap").open("rb") as stream:
        (table, *_) = [found.metadata for found in make_reader(stream).iter_metadata()]
    folder = demo.out.parent.stat()
    assert folder.st_mtime_ns <= int(table["started_unix_ns"]) < demo.out.stat().st_mtime_ns


def test_summary_agrees_with_the_trajectory_files(demo: Finished) -> None:
    summary = json.loads((demo.out / "summary.json").read_text())
    assert summary["landmarks"]["true"] > 0
    assert len(summary["nees_pose"]) == len(summary["smoothed_nees_pose"]) == 10
    assert summary["smoothed_ate_rmse_m"] < summary["ate_rmse_m"]
    truth = demo.out / "truth.tum"
    for name, field in (
        ("estimate", "ate_rmse_m"),
        ("smoothed", "smoothed_ate_rmse_m"),
        ("odometry", "odometry_ate_rmse_m"),
    ):
        result = evaluate(read_tum(demo.out / f"{name}.tum"), read_tum(truth))
        assert result["ate_rmse_m"] == pytest.approx(summary[field], rel=1e-9)
        assert result["pairs"] == result["reference_poses"]


def test_rosbags_reads_every_frame_without_a_gap(demo: Finished) -> None:
    summary = json.loads((demo.out / "summary.json").read_text())
    with AnyReader([demo.out / "session.mcap"]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    frames = [counts[f"/radar/{name}/frame"] for name in RADARS]
    assert sum(frames) == summary["frames"]
    with (demo.out / "session.mcap").open("rb") as stream:
        topic = f"/radar/{RADARS[0]}/frame"
        counters = [m.sequence for _, _, m in make_reader(stream).iter_messages(topics=[topic])]
    assert counters == list(range(1, frames[0] + 1))


def test_the_rrd_holds_every_frame_and_a_blueprint(demo: Finished) -> None:
    summary = json.loads((demo.out / "summary.json").read_text())
    rows = count_rows(demo.out / "session.rrd")
    assert sum(rows[f"/radar/{name}/frame"] for name in RADARS) == summary["frames"]
    assert rows["/link/log/front_left"] > 10
    assert rows["/map/image/cells"] == rows["/map/image"] >= 2
    # that of the beginning, and that which shows the whole map
    assert len(RrdReader(demo.out / "session.rrd").blueprints()) == 2


def test_the_map_is_a_picture_with_all_its_colours(demo: Finished) -> None:
    with Image.open(demo.out / "map.png") as picture:
        assert min(picture.size) >= 800
        colours = picture.convert("RGB").getcolors(maxcolors=1 << 24)
    assert colours is not None
    found = {colour for _, colour in colours}
    for line_colour in ((31, 111, 208), (194, 37, 92)):  # estimate, landmarks
        assert line_colour in found


def test_the_image_is_a_picture_of_the_room(demo: Finished) -> None:
    with Image.open(demo.out / "image.png") as picture:
        assert min(picture.size) >= 800
        greys = np.asarray(picture.convert("L"))
    # rods are bright on a dark ground, beside what no radar saw
    assert (greys > 225).mean() > 1e-3
    assert (greys < 30).mean() > 0.2


def test_the_link_log_tells_how_the_radars_were_set_up(demo: Finished) -> None:
    with (demo.out / "session.mcap").open("rb") as stream:
        lines = [
            ros.deserialise(message.data, ros.LOG)
            for _, _, message in make_reader(stream).iter_messages(topics=["/log"])
        ]
    for name in RADARS:
        said = [line.msg for line in lines if line.name == name]
        assert any("PING" in text.upper() for text in said)
        assert any("FRAMEAREA" in text for text in said)


def test_ports_and_in_process_give_the_same_belief_bit_for_bit(demo: Finished) -> None:
    source = source_of(make_case(str(demo.scene), "robust", SEED))
    record = execute(source)
    estimate = read_tum(demo.out / "estimate.tum")
    np.testing.assert_array_equal(estimate.stamps_ns, record.states.t_ns)
    positions = record.states.estimate[:, :2]
    assert estimate.poses[:, :2].tobytes() == positions.tobytes()
    summary = json.loads((demo.out / "summary.json").read_text())
    in_process = summarise(record, source.info, source.rig)
    assert in_process is not None
    again = json.loads(in_process.to_json())
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
