"""kill -9 while a session is written: all but its last chunk is there, and opens again."""

from __future__ import annotations

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

_CHUNK_BYTES = 256 * 1024
# A scan of two radars: frames of 1431 floats, and a state of a kilobyte or so.
_SCAN_BYTES = 2 * 1431 * 4

RECORDER = """
import sys
from pathlib import Path
from hil_tests.unit.slam.app.sessions import feed, scan, session_info, snapshot
from slam.app.session.log import SessionLog

log = SessionLog(Path(sys.argv[1]), session_info())
counter = 0
while True:
    log.on_scan(scan(counter))
    log.on_snapshot(snapshot(counter))
    print(counter, flush=True)
    counter += 1
"""


@pytest.mark.parametrize("kill_at", [3, 57])
def test_what_a_killed_recorder_was_given_is_there_but_for_one_chunk(
    tmp_path: Path, kill_at: int
) -> None:
    path = tmp_path / "session.mcap"
    recorder = subprocess.Popen(
        [sys.executable, "-c", RECORDER, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert recorder.stdout is not None
    for line in recorder.stdout:
        if int(line) >= kill_at:
            break
    recorder.kill()
    given = [kill_at, *map(int, recorder.stdout.read().split())][-1] + 1
    recorder.wait()
    recorder.stdout.close()
    recorded = [scan.counter for scan, _ in open_session(path).scans()]
    assert recorded == list(range(len(recorded)))
    # one more may have been taken than it could tell of
    assert given - _CHUNK_BYTES // _SCAN_BYTES - 1 <= len(recorded) <= given + 1


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
