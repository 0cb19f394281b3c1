"""The emulator process, every way it can fail to start, and the bytes of its ports."""

import os
import stat
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from hil_tests.patience import wait_until
from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.slam.app.sessions import session_info
from slam.app.cli import main
from slam.app.errors import EmulatorError, UsageError
from slam.app.rig import emulated as emulator_process
from slam.app.rig.emulated import (
    FRAME_RATE_HZ,
    RAW_CONFIG,
    EmulatorProcess,
    open_loopback,
    scene_and_config,
)
from slam.app.session.writer import SessionLog
from slam.live.session.reader import open_session
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.recordings import read_chunks, read_note, read_recording
from xethru_protocol.wire.messages import DataFloat


@pytest.fixture
def fake_emulator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    script = tmp_path / "fake"
    script.touch(mode=stat.S_IRWXU)
    monkeypatch.setattr(sys, "executable", str(script))
    return script


@pytest.mark.parametrize(
    "does",
    [
        "echo 'xethru-emulator: no ptys left' >&2; exit 1",
        "kill -9 $$",
        "echo hello; sleep 5",
        'echo "{}"; sleep 5',
    ],
)
def test_a_bad_start_is_one_line(fake_emulator: Path, does: str) -> None:
    fake_emulator.write_text(f"#!/bin/sh\n{does}\n")
    with EmulatorProcess("lab", 0) as emulator, pytest.raises(EmulatorError) as caught:
        emulator.wait_until_ready(StopFlag())
    assert "\n" not in str(caught.value)


def test_no_ready_line_in_time(fake_emulator: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(emulator_process, "READY_LIMIT_S", 0.3)
    fake_emulator.write_text("#!/bin/sh\nexec sleep 20\n")
    with (
        EmulatorProcess("lab", 0) as emulator,
        pytest.raises(EmulatorError, match=r"not ready after 0\.3 s"),
    ):
        emulator.wait_until_ready(StopFlag())


def test_one_that_ignores_sigterm_is_killed(
    fake_emulator: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(emulator_process, "END_LIMIT_S", 0.3)
    pid_file = tmp_path / "pid"
    fake_emulator.write_text(
        f"#!/bin/sh\ntrap '' TERM\necho $$ > '{pid_file}.new'; mv '{pid_file}.new' '{pid_file}'\n"
        "while :; do sleep 0.05; done\n"
    )
    with EmulatorProcess("lab", 0):
        wait_until(pid_file.exists)
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid_file.read_text()), 0)


def test_the_arguments_are_those_of_the_emulators_command_line(
    fake_emulator: Path, tmp_path: Path
) -> None:
    said = tmp_path / "arguments"
    fake_emulator.write_text(f'#!/bin/sh\necho "$@" > "{said}"\n')
    with EmulatorProcess("scene.toml", 42) as emulator, pytest.raises(EmulatorError):
        emulator.wait_until_ready(StopFlag())
    assert said.read_text() == "-P -m emulator.cli serve scene.toml --pace asap --seed 42\n"


def test_the_bytes_of_every_port_hold_its_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A short drive in this process, raw bytes and all."""
    scene, _ = scene_and_config(str(write_short_scene(tmp_path)), "paper")
    path = tmp_path / "session.mcap"
    with open_loopback(scene, 3) as source:
        early = []
        source.listen(lambda *row: early.append(row))
        source.start(RAW_CONFIG, FRAME_RATE_HZ)
        log = SessionLog(path, replace(session_info(), radars=source.radars))
        for row in early:
            log.on_wire(*row)
        source.listen(log.on_wire)
        scans = list(source.scans(4, StopFlag()))
        for scan in scans:
            log.on_scan(scan)
    log.close()
    for index, radar in enumerate(open_session(path).info.radars):
        out = tmp_path / f"{radar.name}.xtwire"
        assert main(["convert", str(path), str(out), "--radar", radar.name]) == 0
        said = capsys.readouterr().out
        assert "bytes from the module" in said
        frames = {
            message.info: message.values.tobytes()
            for message, _ in read_recording(out)
            if isinstance(message, DataFloat) and message.content_id == 0
        }
        for scan in scans:
            assert frames[scan.counter + 1] == scan.frames[index].samples.tobytes()
        ways = [chunk.way for chunk in read_chunks(out)]
        # the host spoke first: what was said before the log began is there, too
        assert ways[0] == "tx"
        assert read_note(out)["radar"] == radar.name


@pytest.mark.parametrize("name", ["visitor", "sleeper", "desk", "two_people"])
def test_a_scene_whose_robot_stands_is_not_for_slam(name: str) -> None:
    """It would be recorded for minutes, and no state would come of it."""
    with pytest.raises(UsageError, match=name):
        scene_and_config(name, "robust")
