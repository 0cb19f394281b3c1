"""``xethru record --out FILE.mcap``: several modules and lines of other sensors in one file."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hil_tests.patience import seconds, wait_until
from hil_tests.unit.full_disk import child_on_full_disk
from hil_tests.unit.xethru_protocol.pty_module import PtyModule, Said, silent
from xethru_protocol import load
from xethru_protocol.cli import main
from xethru_protocol.recordings import RadarArrays
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting

Capture = pytest.CaptureFixture[str]
STOP = m.X4DriverSet(setting=X4Setting.FPS, value=0.0)


class SlowModule(PtyModule):
    """Sends less than 200 frames/s, so that the file can be read again and again."""

    def _say(self, said: Said) -> None:
        if isinstance(said, m.DataFloat):
            time.sleep(0.005)
        super()._say(said)


@pytest.fixture
def slow_module() -> Iterator[PtyModule]:
    with SlowModule() as module:
        yield module


def counters(radar: RadarArrays) -> list[int]:
    assert radar.counter is not None
    numbers: list[int] = radar.counter.tolist()
    return numbers


def started(*arguments: str | Path) -> subprocess.Popen[str]:
    """Start it; a path among the arguments is the file to write."""
    words = [
        word
        for each in arguments
        for word in (["--out", each] if isinstance(each, Path) else [each])
    ]
    return subprocess.Popen(
        [sys.executable, "-m", "xethru_protocol.cli", "record", *map(str, words)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_the_summary_has_rate_and_lost_frames_of_each_module(
    module: PtyModule, tmp_path: Path, capsys: Capture
) -> None:
    ports = ["--port", f"left={module.path}"]
    assert main(["record", *ports, "--out", str(tmp_path / "x.mcap"), "--count", "9"]) == 0
    found = re.search(r"left 9 messages, ([\d.]+)/s, 0 lost", capsys.readouterr().out)
    assert found is not None
    assert float(found[1]) > 0


def test_modules_are_recorded_to_the_count_of_each(
    module: PtyModule, tmp_path: Path, capsys: Capture
) -> None:
    out = tmp_path / "two.mcap"
    with PtyModule() as other:
        ports = ["--port", f"left={module.path}", "--port", f"right={other.path}"]
        assert main(["record", *ports, "--out", str(out), "--count", "5", "--json"]) == 0
        for one in (module, other):
            assert STOP in one.received[-3:]
    summary = json.loads(capsys.readouterr().out)
    assert (summary["file"], summary["ended_by"]) == (str(out), "count")
    assert {name: radar["messages"] for name, radar in summary["radars"].items()} == {
        "left": 5,
        "right": 5,
    }
    recording = load(out)
    assert list(recording.radars) == ["left", "right"]
    for radar in recording.radars.values():
        assert counters(radar) == [0, 1, 2, 3, 4]
        assert radar.ranges_m is not None
        assert radar.t_ns is not None
        assert radar.settings["FRAMEAREA"][0] == radar.ranges_m[0]
        assert (np.diff(radar.t_ns) >= 0).all()
        assert abs(radar.t_ns[0] - time.time_ns()) < 60e9


def test_one_module_needs_no_name(module: PtyModule, tmp_path: Path) -> None:
    out = tmp_path / "one.mcap"
    assert main(["record", "--port", module.path, "--out", str(out), "--count", "3"]) == 0
    recording = load(out)
    assert list(recording.radars) == [Path(module.path).name]
    assert counters(recording) == [0, 1, 2]


def has_begun(path: Path) -> bool:
    return path.exists() and path.stat().st_size > 0


def frames_in(path: Path, name: str) -> int:
    """Frames of a radar in a file that is being written."""
    if not has_begun(path):
        return 0
    radars = load(path, lambda fault: None).radars
    return radars[name].n_frames if name in radars else 0


def lines_in(path: Path, name: str) -> int:
    texts = load(path).texts if has_begun(path) else {}
    return len(texts[name].lines) if name in texts else 0


def interrupted(program: subprocess.Popen[str]) -> tuple[str, str]:
    program.send_signal(signal.SIGINT)
    printed, errors = program.communicate(timeout=seconds(10))
    assert program.returncode == 130
    return printed, errors


def test_an_unplugged_module_costs_the_others_nothing(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    with SlowModule() as left, SlowModule() as right:
        program = started("--port", f"left={left.path}", "--port", f"right={right.path}", out)
        wait_until(lambda: frames_in(out, "left") and frames_in(out, "right"), program)
        left.__exit__()
        behind = frames_in(out, "right") + 20
        wait_until(lambda: frames_in(out, "right") > behind, program)
        printed, errors = interrupted(program)
    line, *others = errors.splitlines()
    assert all(each.startswith("xethru: the module was not stopped") for each in others)
    assert line.startswith(f"xethru record: left: {left.path} was disconnected; plug")
    assert line.endswith("kept; the others go on")
    recording = load(out)
    for name in ("left", "right"):
        kept = counters(recording.radars[name])
        assert kept == list(range(len(kept)))
        assert f"{name} {len(kept)} messages" in printed


def test_the_only_module_that_is_unplugged_ends_it(slow_module: PtyModule, tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    program = started("--port", f"left={slow_module.path}", out)
    wait_until(lambda: frames_in(out, "left"), program)
    slow_module.__exit__()
    printed, errors = program.communicate(timeout=seconds(10))
    assert program.returncode == 1
    kept = counters(load(out))
    assert kept == list(range(len(kept)))
    assert f"{len(kept)} messages kept\n" in errors
    assert f"left {len(kept)} messages" in printed


def test_lines_of_standard_input_are_stamped_on_the_clock_of_frames(
    slow_module: PtyModule, tmp_path: Path
) -> None:
    out = tmp_path / "a.mcap"
    program = started("--port", f"left={slow_module.path}", out, "--text", "belt=-")
    wait_until(lambda: frames_in(out, "left"), program)
    before = counters(load(out, lambda fault: None))[-1]
    assert program.stdin is not None
    program.stdin.write("0.5\n0.75\r\n\ncut")
    program.stdin.close()
    program.stdin = None  # communicate would use it
    wait_until(lambda: lines_in(out, "belt") == 3, program)  # the end of input ends no recording
    printed, errors = interrupted(program)
    assert errors == ""
    assert "belt 3 lines" in printed
    recording = load(out)
    belt = recording.texts["belt"]
    assert belt.lines == ("0.5", "0.75", "cut")
    np.testing.assert_array_equal(belt.values, [0.5, 0.75, np.nan])
    assert recording.t_ns is not None
    assert (belt.t_ns >= recording.t_ns[before]).all()
    assert (belt.t_ns <= recording.t_ns[-1]).all()


def test_lines_of_a_serial_port(slow_module: PtyModule, tmp_path: Path) -> None:
    """A pty stands for the port; it is unplugged after two lines and a part of one."""
    out = tmp_path / "a.mcap"
    master, slave = os.openpty()
    port = os.ttyname(slave)
    program = started("--port", f"left={slow_module.path}", out, "--text", f"ecg={port}@9600")
    wait_until(lambda: frames_in(out, "left"), program)
    os.write(master, b"1,2\n3,4\n5")
    wait_until(lambda: lines_in(out, "ecg") == 2, program)
    os.close(slave)
    os.close(master)
    wait_until(lambda: lines_in(out, "ecg") == 3, program)
    _, errors = interrupted(program)
    assert errors.startswith(f"xethru record: ecg: {port} was disconnected")
    assert errors.endswith("; 3 lines kept; the others go on\n")
    values = load(out).texts["ecg"].values
    np.testing.assert_array_equal(values, [[1, 2], [3, 4], [np.nan, np.nan]])


def test_a_full_disk_keeps_what_is_there(tmp_path: Path) -> None:
    """A chunk that does not fit is left out."""
    out = tmp_path / "a.mcap"
    with SlowModule() as left, SlowModule() as right:
        words = ["--port", f"left={left.path}", "--port", f"right={right.path}", "--out", out]
        ran = subprocess.run(
            [sys.executable, "-m", "xethru_protocol.cli", "record", *map(str, words)],
            capture_output=True,
            text=True,
            check=False,
            **child_on_full_disk(6_000),
        )
    assert (ran.returncode, ran.stdout) == (1, "")
    assert f"xethru record: {out} cannot be written: File too large; all but" in ran.stderr
    assert out.stat().st_size <= 6_000
    for radar in load(out, lambda fault: None).radars.values():
        kept = counters(radar)
        assert kept == list(range(len(kept)))


def test_a_module_that_does_not_answer_costs_no_older_file(
    module: PtyModule, tmp_path: Path, capsys: Capture
) -> None:
    out = tmp_path / "a.mcap"
    out.write_bytes(b"older")
    with PtyModule(silent) as dead:
        ports = ["--port", module.path, "--port", f"dead={dead.path}"]
        assert main(["record", *ports, "--out", str(out)]) == 1
        assert main(["record", *ports, "--out", str(out), "--force"]) == 1
    assert "xethru record: dead: " in capsys.readouterr().err
    assert out.read_bytes() == b"older"


def test_a_module_that_falls_silent_is_named(
    module: PtyModule, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("xethru_protocol.cli.record.modes.RawFrames.start", lambda self, radar: 0.2)
    arguments = ["--port", f"mute={module.path}", "--out", str(tmp_path / "a.mcap")]
    assert main(["record", *arguments]) == 1
    errors = capsys.readouterr().err
    assert "mute: the module sent nothing to record for 0.2 s" in errors
    assert "nothing came, so nothing was written" in errors
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--port", "a", "--port", "b", "--out", "dir"], "--out FILE.mcap"),
        (["--port", "a", "--text", "x=-", "--out", "dir"], "--out FILE.mcap"),
        (["--port", "a", "--port", "a", "--out", "x.mcap"], "port a is given twice"),
        (["--port", "/1/a", "--port", "/2/a", "--out", "x.mcap"], "--port NAME=PORT"),
        (["--port", "a", "--text", "x", "--out", "x.mcap"], "NAME=-"),
        (["--port", "a", "--text", "x=-", "--text", "y=-", "--out", "x.mcap"], "only one --text"),
        (["--port", "a", "--text", "x=b", "--text", "x=c", "--out", "x.mcap"], "x is given twice"),
        (["--port", "a", "--out", "x.mcap", "--wire", "w.xtwire"], "--wire is for one module"),
        (["--port", "a", "--out", "x.mcap", "--session-id", "s", "--interval", "2"], "--out DIR"),
        (["--port", "a", "--wire", "x.mcap"], "--out MCAP"),
        ([*(f"--port=n{at}=p{at}" for at in range(9)), "--out", "x.mcap"], "at most 8"),
    ],
)
def test_what_makes_no_sense_is_wrong_usage(
    arguments: list[str], problem: str, capsys: Capture
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["record", *arguments])
    assert problem in capsys.readouterr().err
