"""How a demo ends when it does not end well: one line, the right code, nothing left behind."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from mcap.reader import make_reader

from hil_tests.patience import catches, seconds, wait_until
from hil_tests.system.recorded_session import write_shorter_scene
from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.full_disk import child_on_full_disk
from hil_tests.unit.slam.app.sessions import surviving_counters
from slam.app.cli import main
from slam.app.run import result_files
from slam.app.view.rerun_recording import count_rows

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc (Linux)"),
]

WELL_UNDER_WAY_BYTES = 2_000_000


@contextmanager
def running_demo(
    out: Path, temporary: Path, *, progressed: bool = True
) -> Iterator[subprocess.Popen[str]]:
    """Run a demo of the long lab scene; with `progressed`, yield when frames are on disk."""
    temporary.mkdir()
    demo = subprocess.Popen(
        [sys.executable, "-m", "slam.app.cli", "demo", "--preset", "paper", "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"TMPDIR": str(temporary), "XDG_RUNTIME_DIR": str(temporary)},
    )
    try:
        log = out / "session.mcap"
        if progressed:
            wait_until(lambda: log.exists() and log.stat().st_size > WELL_UNDER_WAY_BYTES, demo)
        yield demo
    finally:
        demo.kill()
        demo.communicate()


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_gone(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return True
    return state == "Z"


def leftovers(temporary: Path) -> list[Path]:
    """Return links, sockets, files and port folders that nobody removed.

    The folder by which emulators find each other may stay, and in it the card of one that was
    killed: the next emulator removes it.
    """
    found = [path for path in temporary.rglob("*") if path.name != "xethru"]
    return [path for path in found if path.parent.name != "xethru" or path.suffix != ".json"]


def finished_counters(log: Path) -> list[int]:
    with log.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_summary() is not None
        topics = ["/radar/left_rear/frame"]
        return [message.sequence for _, _, message in reader.iter_messages(topics=topics)]


@pytest.mark.rare
@pytest.mark.parametrize(
    ("which", "times", "code"),
    [
        pytest.param(signal.SIGINT, 1, 130, marks=pytest.mark.thorough),
        (signal.SIGHUP, 2, 129),  # hang-ups of the kernel and the shell
    ],
)
def test_a_signal_half_way(which: signal.Signals, times: int, code: int, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with running_demo(out, tmp_path / "tmp") as demo:
        (emulator,) = children(demo.pid)
        for _ in range(times):
            demo.send_signal(which)
        stdout, stderr = demo.communicate(timeout=seconds(20))
    assert demo.returncode == code
    assert "SLAM ATE" in stdout
    last = stderr.splitlines()[-1]
    assert last == f"uwb-slam: stopped by {which.name}; what was recorded is in {out}"
    assert "Traceback" not in stderr
    assert is_gone(emulator)
    assert leftovers(tmp_path / "tmp") == []
    counters = finished_counters(out / "session.mcap")
    assert counters == list(range(1, len(counters) + 1))
    assert (out / "map.png").exists()
    assert json.loads((out / "summary.json").read_text())["frames"] == 4 * len(counters)
    n_states = len((out / "estimate.tum").read_text().splitlines())
    assert n_states == len((out / "truth.tum").read_text().splitlines()) > 50
    assert abs(count_rows(out / "session.rrd")["/radar/left_rear/frame"] - len(counters)) <= 1


@pytest.mark.rare
def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "slam.app.cli", "demo", "--preset", "paper"]
    command += ["--scene", str(write_short_scene(tmp_path)), "--out", str(tmp_path / "out")]
    limit = 1_000_000  # bytes, of which the session takes several times as many
    run = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        **child_on_full_disk(limit),
    )
    assert (run.returncode, run.stdout) == (1, "")
    *progress, last = run.stderr.splitlines()
    assert last.startswith(f"uwb-slam: {tmp_path / 'out'}/session.")
    assert all(line.startswith("scene time") for line in progress), run.stderr


@pytest.mark.parametrize(
    "step",
    [
        pytest.param("summarise", marks=pytest.mark.thorough),
        pytest.param("write_trajectories", marks=pytest.mark.rare),
        pytest.param("print_result", marks=pytest.mark.thorough),
    ],
)
def test_a_signal_after_the_last_scan_costs_no_result(
    tmp_path: Path,
    step: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    real = getattr(result_files, step)

    def interrupted(*arguments: object, **options: object) -> object:
        os.kill(os.getpid(), signal.SIGTERM)
        return real(*arguments, **options)

    monkeypatch.setattr(result_files, step, interrupted)
    out = tmp_path / "out"
    command = [
        "demo",
        "--preset",
        "paper",
        "--scene",
        str(write_shorter_scene(tmp_path)),
        "--out",
        str(out),
    ]
    assert main(command) == 143
    assert capsys.readouterr().err.splitlines()[-1].startswith("uwb-slam: stopped by SIGTERM")
    # Preset paper has neither lagged poses nor a smoothed path.
    assert {path.name for path in out.iterdir()} == {
        "session.mcap",
        "session.rrd",
        *result_files.RESULTS,
    } - {result_files.LAGGED, result_files.SMOOTHED}


@pytest.mark.parametrize(
    ("has_emulator", "which", "code"),
    [
        (False, signal.SIGINT, 130),
        pytest.param(True, signal.SIGTERM, 143, marks=pytest.mark.rare),
    ],
)
def test_a_signal_while_it_starts(
    tmp_path: Path, has_emulator: bool, which: signal.Signals, code: int
) -> None:
    with running_demo(tmp_path / "out", tmp_path / "tmp", progressed=False) as demo:
        wait_until(lambda: catches(demo.pid, signal.SIGHUP), demo)
        if has_emulator:
            wait_until(lambda: children(demo.pid), demo)
        started = children(demo.pid)
        demo.send_signal(which)
        _, stderr = demo.communicate(timeout=seconds(20))
    assert demo.returncode == code
    assert f"uwb-slam: stopped by {which.name}" in stderr
    assert "Traceback" not in stderr
    assert all(is_gone(child) for child in started)
    assert leftovers(tmp_path / "tmp") == []


@pytest.mark.rare
def test_kill_9_leaves_a_readable_session_and_no_emulator(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with running_demo(out, tmp_path / "tmp") as demo:
        (emulator,) = children(demo.pid)
        demo.kill()
        demo.wait()
        wait_until(lambda: is_gone(emulator))
    assert leftovers(tmp_path / "tmp") == []
    log = out / "session.mcap"
    counters = surviving_counters(log, "/radar/left_rear/frame")
    assert counters == list(range(1, len(counters) + 1))
    # 2 MB on disk hold well over 100 scans; all but the last chunk of 256 KiB must be there
    assert len(counters) > 100


@pytest.mark.rare
@pytest.mark.parametrize("which", [signal.SIGKILL, signal.SIGSTOP])
def test_the_emulator_dies_or_freezes(which: signal.Signals, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with running_demo(out, tmp_path / "tmp") as demo:
        (emulator,) = children(demo.pid)
        os.kill(emulator, which)
        _, stderr = demo.communicate(timeout=seconds(60))
    assert demo.returncode == 1
    assert stderr.splitlines()[-1].endswith(f"; what was recorded is in {out}")
    assert "Traceback" not in stderr
    assert is_gone(emulator)
    assert len(finished_counters(out / "session.mcap")) > 100
    assert json.loads((out / "summary.json").read_text())["frames"] > 400
    assert (out / "map.png").exists()
    assert leftovers(tmp_path / "tmp") == []
