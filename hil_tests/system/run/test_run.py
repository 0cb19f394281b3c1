"""`uwb-slam run` as a user runs it: an emulator in real time, four ports, odometry beside them."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from mcap.reader import make_reader

from emulator.scene.scene import load_scene
from hil_tests.device.emulator_process import emulator
from hil_tests.paths import REPOSITORY
from hil_tests.patience import seconds, wait_until
from hil_tests.system.short_scene import write_short_scene
from slam.app.cli import main
from slam.app.rig.rig_files import write_rig
from slam.library.rig_files import RigFile, RigRadar
from slam.live.session.reader import open_session
from slam.results import SmoothedRun

pytestmark = pytest.mark.slow

COMMAND = [sys.executable, "-m", "slam.app.cli"]


@dataclass(frozen=True)
class Robot:
    """A running emulator and the rig file of its radars."""

    rig: Path
    odometry: str
    ports: list[str]


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    folder = tmp_path_factory.mktemp("robot")
    scene_path = write_short_scene(folder, repeats=20)  # it drives on in all tests of this file
    scene = load_scene(scene_path)
    rig = folder / "robot.toml"
    write_rig(
        rig,
        RigFile(
            radars=tuple(
                RigRadar(
                    name=spec.name,
                    serial=spec.serial,
                    x_m=spec.x_m,
                    y_m=spec.y_m,
                    yaw_deg=spec.yaw_deg,
                )
                for spec in scene.radars
            )
        ),
    )
    pace = ("--pace", "realtime", "--link-dir", folder / "ports")
    with emulator("serve", scene_path, *pace) as served:
        assert served.odometry is not None
        yield Robot(rig=rig, odometry=served.odometry, ports=[*reversed(served.paths)])
        served.end()


def run_command(robot: Robot, out: Path, *more: str) -> list[str]:
    options = ["--rig", str(robot.rig), "--ports", *robot.ports, "--out", str(out)]
    return [*COMMAND, "run", *options, *more]


@contextmanager
def running(robot: Robot, out: Path, n_scans: int) -> Iterator[subprocess.Popen[str]]:
    """Start a run; yield its process when the session has ``n_scans`` scans or more."""
    with subprocess.Popen(
        run_command(robot, out, "--odometry", robot.odometry),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        session = out / "session.mcap"
        # The file has its settings and scans; how many go into a kilobyte depends on lost frames.
        wait_until(lambda: session.exists() and session.stat().st_size >= 200_000, process)
        wait_until(lambda: len(list(open_session(session).scans())) >= n_scans, process)
        yield process


def replayed(out: Path, again: Path, said: pytest.CaptureFixture[str]) -> str:
    """Replay a session in this process; return what was said."""
    said.readouterr()
    assert main(["replay", str(out / "session.mcap"), "--out", str(again)]) == 0
    return said.readouterr().err


def test_a_run_from_stdin_ends_when_it_is_told_to_and_replays_to_the_last_bit(
    robot: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Odometry comes through a pipe, as from `ros2 topic echo` and a filter."""
    out = tmp_path / "out"
    cat = (
        "import socket, sys; s = socket.socket(socket.AF_UNIX); s.connect(sys.argv[1])\n"
        "while d := s.recv(4096): sys.stdout.buffer.write(d); sys.stdout.flush()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", cat, robot.odometry], stdout=subprocess.PIPE
    ) as wheels:
        process = subprocess.run(
            [
                *run_command(robot, out, "--odometry", "-", "--duration", "3", "--wire", "--lean"),
                *("--publish", f"jsonl:{tmp_path}/lines", "--publish", "udp://127.0.0.1:9"),
            ],
            stdin=wheels.stdout,
            capture_output=True,
            text=True,
            check=False,
        )
        wheels.terminate()
    assert process.returncode == 0, process.stderr
    assert "front_left: serial number 000000000100, at" in process.stderr
    assert "the 3 s asked for are over" in process.stderr
    rows = {line.split("  ")[0]: line for line in process.stdout.splitlines()}
    assert {"time", "driven", "landmarks", "load", "rear_left", "front_right"} <= set(rows)
    assert "ppm" in rows["rear_left"]
    lines = [json.loads(line) for line in (tmp_path / "lines").read_text().splitlines()]
    poses = [line["pose"][:2] for line in lines if line["kind"] == "state"]
    tum = [line.split()[1:3] for line in (out / "estimate.tum").read_text().splitlines()]
    assert poses == [[float(value) for value in row] for row in tum]
    assert f"{len(lines)}  events sent, 0 dropped, 0 failed" in rows["to jsonl"]
    assert "to udp" in rows
    summary = json.loads((out / "summary.json").read_text())
    assert summary["ate_rmse_m"] is None
    assert summary["seed"] is None
    assert (out / "map.png").stat().st_size > 10_000

    replayed(out, tmp_path / "again", capsys)
    again = json.loads((tmp_path / "again" / "summary.json").read_text())
    assert again | {"realtime_factor": 0} == summary | {"realtime_factor": 0}
    for name in ("estimate", "odometry"):
        assert (tmp_path / "again" / f"{name}.tum").read_bytes() == (
            out / f"{name}.tum"
        ).read_bytes()
    session = open_session(out / "session.mcap")
    used = [scan for scan in session.scans() if scan.used]
    assert summary["frames"] == sum(len(scan.frames) for scan in used) > 0
    assert session.info.time_base == "arrival"
    assert session.info.odometry_clock == "arrival"
    assert session.info.started_unix_ns is not None
    arrived_ns, stamp_ns = used[0].host_ns[0], used[0].frames[0].t_ns
    assert abs(arrived_ns - stamp_ns - session.info.started_unix_ns) < seconds(1) * 1e9
    assert {row[0] for row in session.wire()} == {m.name for m in session.rig.mounts}
    with session.path.open("rb") as stream:
        found = make_reader(stream).get_summary()
    assert found is not None
    topics = {channel.topic for channel in found.channels.values()}
    assert "/landmarks" in topics
    assert not topics & {"/estimate/path", "/landmarks/markers", "/radar/front_left/bscan"}


@pytest.mark.parametrize(
    ("which", "code"),
    [(signal.SIGINT, 130), (signal.SIGKILL, -9)],
)
@pytest.mark.rare  # a run that ends by itself is replayed above
def test_a_signal_leaves_a_session_that_replays(
    which: signal.Signals,
    code: int,
    robot: Robot,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """After SIGINT with map and numbers; after kill -9 all but the last second."""
    out = tmp_path / "out"
    with running(robot, out, n_scans=11) as process:
        process.send_signal(which)
        said = process.communicate(timeout=seconds(30))[1]
    assert process.returncode == code
    if which is not signal.SIGKILL:
        last = said.splitlines()[-1]
        assert last == f"uwb-slam: stopped by {which.name}; what was recorded is in {out}"
        assert (out / "summary.json").exists()
        assert (out / "map.png").exists()
    again = replayed(out, tmp_path / "again", capsys)
    assert ("was cut at byte" in again) == (which is signal.SIGKILL)
    assert "recorded states came again, to the last bit" in again
    if which is signal.SIGKILL:
        assert main(["repair", str(out / "session.mcap")]) == 0
        repaired = replayed(out, tmp_path / "repaired", capsys)
        assert "was cut" not in repaired
        assert (tmp_path / "repaired" / "estimate.tum").read_bytes() == (
            tmp_path / "again" / "estimate.tum"
        ).read_bytes()
    n_again = len((tmp_path / "again" / "estimate.tum").read_text().splitlines())
    assert n_again > 5


@pytest.mark.rare  # half a minute in real time; a unit test has the signal
def test_sigusr1_writes_the_smoothed_path_while_it_runs(robot: Robot, tmp_path: Path) -> None:
    out = tmp_path / "out"
    session = out / "session.mcap"
    with running(robot, out, n_scans=26) as process:
        process.send_signal(signal.SIGUSR1)
        wait_until((out / "smoothed.tum").exists, process)
        n_early = len((out / "smoothed.tum").read_text().splitlines())
        wait_until(lambda: len(list(open_session(session).scans())) > n_early + 15, process)
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=seconds(30))[1]
    assert f"smoothed.tum has {n_early} states, solved for in" in said
    stamps = {
        name: [line.split()[0] for line in (out / f"{name}.tum").read_text().splitlines()]
        for name in ("estimate", "smoothed")
    }
    assert stamps["smoothed"] == stamps["estimate"]
    assert len(stamps["smoothed"]) > n_early > 0
    found = [r for r in open_session(session).records() if isinstance(r, SmoothedRun)]
    assert [len(one.t_ns) for one in found] == [n_early, len(stamps["estimate"])]


@pytest.mark.thorough
def test_a_run_whose_slam_is_too_slow_ends_at_once_with_all_results(
    robot: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each step takes 0.8 s, so four of five scans have to be dropped; Ctrl-C before ten steps."""
    out = tmp_path / "out"
    command = run_command(robot, out, "--odometry", robot.odometry)
    command[command.index("slam.app.cli")] = "hil_tests.system.run.slow_slam"
    with subprocess.Popen(
        command,
        env=os.environ | {"SLOW_SLAM_S": "0.8"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        session = out / "session.mcap"
        wait_until(lambda: session.exists() and session.stat().st_size >= 200_000, process)
        wait_until(lambda: not all(s.used for s in open_session(session).scans()), process)
        began_s = time.monotonic()
        process.send_signal(signal.SIGINT)
        printed, said = process.communicate(timeout=seconds(30))
        took_s = time.monotonic() - began_s
    assert process.returncode == 130
    assert took_s < seconds(2)
    assert "SLAM cannot keep up with the radars" in said
    names = {"session.mcap", "map.png", "summary.json", "estimate.tum", "odometry.tum"}
    # no smoothed path where the last step was given up
    assert {path.name for path in out.iterdir()} - {"smoothed.tum"} == names
    rows = {line.split("  ")[0]: line.split() for line in printed.splitlines()}
    scans = [scan for scan in open_session(session).scans()]
    unused = sum(not scan.used for scan in scans)
    assert int(rows["dropped"][1]) + int(rows["left out"][2]) == unused > 0
    assert "recorded states came again, to the last bit" in replayed(
        out, tmp_path / "again", capsys
    )


def test_what_cannot_begin_says_why_in_one_line(
    robot: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (kept := tmp_path / "kept").mkdir()
    (kept / "session.mcap").write_bytes(b"of an earlier drive")
    options = ["--rig", str(robot.rig), "--odometry", robot.odometry, "--out", str(kept)]
    assert main(["run", *options]) == 1
    assert (kept / "session.mcap").read_bytes() == b"of an earlier drive"
    capsys.readouterr()

    rig = tmp_path / "other.toml"
    rig.write_text(robot.rig.read_text().replace("000000000102", "000000000777"))
    (drive := tmp_path / "drive.tum").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    cases = [
        (robot.rig, robot.ports[:3], robot.odometry, 1, "radar front_left (serial number"),
        (rig, robot.ports, robot.odometry, 1, "if a module was replaced, write its serial"),
        (tmp_path / "none.toml", robot.ports, robot.odometry, 1, "cannot read the rig file"),
        (robot.rig, robot.ports, "nowhere", 2, "odometry nowhere: No such file"),
        (robot.rig, robot.ports, str(drive), 2, "say what its stamps are with --odometry-clock"),
    ]
    for rig_path, ports, odometry, code, words in cases:
        options = ["--rig", str(rig_path), "--odometry", odometry, "--out", str(tmp_path / "out")]
        assert main(["run", *options, "--ports", *ports]) == code
        said = capsys.readouterr()
        assert said.out == ""
        assert words in said.err.splitlines()[-1]


@pytest.mark.thorough
def test_the_run_of_the_documents_works_in_a_clean_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both commands as printed, but for an end after a second; no other emulator is seen."""
    (runtime := tmp_path / "runtime").mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    (clean := tmp_path / "clean").mkdir()
    monkeypatch.chdir(clean)
    printed = (REPOSITORY / "docs" / "robot.md").read_text()
    serve, run = re.search(
        r"^\$ xethru-emulator (serve .*)\n\$ uwb-slam (run .*?) *(?:#.*)?$", printed, re.MULTILINE
    ).groups()  # type: ignore[union-attr]  # None fails the test
    with emulator(*shlex.split(serve)) as served:
        process = subprocess.run(
            [*COMMAND, *shlex.split(run), "--duration", "1"],
            capture_output=True,
            text=True,
            check=False,
        )
        served.end()
    assert process.returncode == 0, process.stderr
    names = {"session.mcap", "map.png", "summary.json", "estimate.tum", "odometry.tum"}
    assert {path.name for path in (clean / "out" / "run").iterdir()} == names
