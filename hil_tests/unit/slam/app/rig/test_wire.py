"""Raw bytes of the ports: into a session as they pass, and out of it to whoever plays them."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.slam.app.sessions import feed, session_info
from slam.app.cli import main
from slam.app.commands.demo import WireTap
from slam.app.records import Scan, SessionInfo
from slam.app.rig.emulated import FRAME_RATE_HZ, RAW_CONFIG, open_loopback, scene_and_config
from slam.app.session.log import SessionLog
from slam.app.session.reader import open_session
from xethru_protocol.recordings import read_chunks, read_note, read_recording
from xethru_protocol.wire.messages import DataFloat

N_SCANS = 4


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Scan]]:
    """Record a short drive in this process, raw bytes and all."""
    folder = tmp_path_factory.mktemp("wire")
    scene, _ = scene_and_config(str(write_short_scene(folder)), "paper")
    path = folder / "session.mcap"
    with open_loopback(scene, 3) as source:
        tap = WireTap(source)
        source.start(RAW_CONFIG, FRAME_RATE_HZ)
        info = SessionInfo(
            scene="short",
            preset="paper",
            seed=3,
            radars=source.radars,
            true_landmarks_m=session_info().true_landmarks_m,
            versions={},
        )
        log = SessionLog(path, info)
        tap.attach(log)
        scans = []
        for scan in source.scans(N_SCANS, lambda: None):
            log.on_scan(scan)
            scans.append(scan)
    log.close()
    return path, scans


def test_the_bytes_of_every_port_hold_its_frames(
    recorded: tuple[Path, list[Scan]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, scans = recorded
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
            assert frames[scan.counter] == scan.frames[index].samples.tobytes()
        ways = [chunk.way for chunk in read_chunks(out)]
        # the host spoke first: what was said before the log began is there, too
        assert ways[0] == "tx"
        assert read_note(out)["radar"] == radar.name


def problem(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main(["convert", *map(str, arguments)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_what_is_not_there_is_named(
    recorded: tuple[Path, list[Scan]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, _ = recorded
    out = tmp_path / "x.xtwire"
    assert "several radars (front_left, rear_left, front_right, rear_right); choose one" in problem(
        capsys, path, out
    )
    assert "holds no radar 'left'; it holds front_left" in problem(
        capsys, path, out, "--radar", "left"
    )
    bare = tmp_path / "bare.mcap"
    log = SessionLog(bare, session_info())
    feed(log, 2)
    log.close()
    said = problem(capsys, bare, out, "--radar", "radar0")
    assert "holds no raw bytes; record with --wire" in said
    assert not out.exists()
