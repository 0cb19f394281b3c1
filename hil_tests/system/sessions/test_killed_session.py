"""kill -9 while a session is written: all but its last chunk is there, and opens again."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from hil_tests.patience import wait_until
from hil_tests.system.short_scene import write_short_scene
from slam.app.cli import main
from slam.app.session.reader import open_session

pytestmark = pytest.mark.slow


def test_repair_and_replay_of_what_a_killed_demo_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, again = tmp_path / "out", tmp_path / "again"
    session = out / "session.mcap"
    command = [sys.executable, "-m", "slam.app.cli", "demo", "--wire", "--out", str(out)]
    command += ["--scene", str(write_short_scene(tmp_path)), "--preset", "paper"]
    demo = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_until(lambda: session.exists() and session.stat().st_size >= 1_000_000, demo)
    demo.kill()
    demo.wait()
    left = open_session(session)
    before = [(scan.counter, scan.t_ns) for scan, _ in left.scans()]
    assert left.cut_at_byte is not None
    assert before
    assert main(["repair", str(session)]) == 0
    assert capsys.readouterr().err == ""
    repaired = open_session(session)
    assert [(scan.counter, scan.t_ns) for scan, _ in repaired.scans()] == before
    assert repaired.cut_at_byte is None
    assert sum(len(row.data) for row in repaired.wire()) > 300_000
    with AnyReader([session]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    assert counts["/scan"] == len(before)
    assert main(["replay", str(session), "--out", str(again)]) == 0
    summary = json.loads((again / "summary.json").read_text())
    assert summary["frames"] == 4 * len(before)
    assert summary["duration_s"] == before[-1][1] / 1e9
