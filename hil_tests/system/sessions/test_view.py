"""`uwb-slam view`: sessions as files, pictures and pages; what cannot be shown is one line."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hil_tests.patience import seconds, wait_until
from hil_tests.system.recorded_session import (
    FAULT,
    record_session,
    write_shorter_scene,
)
from slam.app.cli import main
from slam.app.run.replay import is_finished, recorded_source, session_file
from slam.app.run.runner import execute
from slam.app.view import rerun_recording
from slam.app.view.rerun_recording import RrdReader, count_rows, rr
from slam.app.view.viewer import LiveView, SlamViewerProcess
from slam.live.errors import AppError
from slam.live.session.reader import open_session
from xethru_protocol.operating_system import StopFlag

pytestmark = pytest.mark.slow

RADARS = ("front_left", "rear_left", "front_right", "rear_right")
DRIVERS = (Path("/usr/share/vulkan/icd.d"), Path("/usr/local/share/vulkan/icd.d"))
HAS_LAVAPIPE = any(True for folder in DRIVERS for _ in folder.glob("lvp_icd*.json"))


@dataclass(frozen=True)
class Viewed:
    session: Path
    rrd: Path
    n_states: int


@pytest.fixture(scope="module")
def viewed(tmp_path_factory: pytest.TempPathFactory) -> Viewed:
    session = tmp_path_factory.mktemp("view") / "session.mcap"
    record = record_session(session, "paper")
    rrd = session.with_name("made.rrd")
    assert main(["view", str(session), "--out", str(rrd)]) == 0
    return Viewed(session=session, rrd=rrd, n_states=len(record.states))


def texts(path: Path, entity: str, component: str) -> list[str]:
    return [
        text
        for chunk in RrdReader(path).stream()
        if str(chunk.entity_path) == entity
        for batch in [chunk.to_record_batch()]
        if component in batch.schema.names
        for row in batch[component].to_pylist()
        for text in row or ()
    ]


def test_the_file_holds_every_frame_and_state(viewed: Viewed) -> None:
    rows = count_rows(viewed.rrd)
    n_frames = sum(len(scan.frames) for scan in open_session(viewed.session).scans())
    assert sum(rows[f"/radar/{name}/frame"] for name in RADARS) == n_frames
    assert rows["/radar/rear_left/frame"] == rows["/radar/front_left/frame"] - 1
    assert rows["/map/robot"] == rows["/error/slam"] == viewed.n_states
    for entity in ("fixes/found", "clusters/kept", "robot/front_left/arcs_used"):
        assert rows[f"/map/{entity}"] == viewed.n_states
    # that of the beginning, and that which shows the whole map
    assert len(RrdReader(viewed.rrd).blueprints()) == 2


def test_every_view_has_something_to_show_and_everything_a_view(viewed: Viewed) -> None:
    reader = RrdReader(viewed.rrd)
    *_, blueprint = reader.blueprints()
    origins = {
        origin
        for chunk in reader.stream(store=blueprint)
        for batch in [chunk.to_record_batch()]
        if "ViewBlueprint:space_origin" in batch.schema.names
        for row in batch["ViewBlueprint:space_origin"].to_pylist()
        for origin in row
    }
    shown = {name for name in count_rows(viewed.rrd) if not name.endswith(" (static)")}
    static = {"/about", "/radars"}
    for origin in origins - static:
        assert any(f"{name}/".startswith(f"{origin}/") for name in shown), origin
    for name in shown - {"/__properties"}:
        assert any(f"{name}/".startswith(f"{origin}/") for origin in origins), name


def test_the_lost_frame_and_the_fault_are_in_lane_and_log(viewed: Viewed) -> None:
    states = texts(viewed.rrd, "/link/state/rear_left", "StateChange:state")
    assert states[:4] == ["streaming", "fault", "silent", "frames lost"]
    assert states[4:] == ["streaming", "ended"]
    assert FAULT in texts(viewed.rrd, "/link/log/rear_left", "TextLog:text")
    assert texts(viewed.rrd, "/link/state/front_left", "StateChange:state") == [
        "streaming",
        "ended",
    ]


@pytest.mark.skipif(not HAS_LAVAPIPE, reason="Mesa's lavapipe (mesa-vulkan-drivers) is missing")
def test_a_picture_needs_no_window(viewed: Viewed, tmp_path: Path) -> None:
    picture = tmp_path / "view.png"
    assert main(["view", str(viewed.rrd), "--screenshot", str(picture), "--at", "12"]) == 0
    with Image.open(picture) as shown:
        assert shown.width == 1360
        brightness = np.asarray(shown.convert("RGB")).max(axis=2)
    # a dark page with a map, echoes, curves and text on it; of a session without any 2 %
    assert np.mean(brightness > 100) > 0.05


@pytest.mark.skipif(not HAS_LAVAPIPE, reason="Mesa's lavapipe (mesa-vulkan-drivers) is missing")
def test_a_recording_of_another_program_gives_no_picture_but_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.rrd"
    stream = rr.RecordingStream("somebody_elses")
    stream.save(other)
    stream.set_time("step", sequence=1)
    stream.log("value", rr.Scalars([1.0]))
    stream.disconnect()
    assert main(["view", str(other), "--screenshot", str(tmp_path / "view.png")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"uwb-slam: {other}: ")
    assert not (tmp_path / "view.png").exists()


def test_a_page_is_served_here_until_a_signal(viewed: Viewed) -> None:
    command = [sys.executable, "-m", "slam.app.cli", "view", str(viewed.rrd), "--web"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        url = process.stderr.readline().split()[-1]
        assert "stays at" in process.stderr.readline()
        assert url.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(url, timeout=seconds(10)) as page:
            assert b"wasm" in page.read()
        port = int(url.split(":")[2].split("/")[0])
        process.send_signal(signal.SIGINT)
        assert "stopped by SIGINT" in process.stderr.read()
        assert process.wait(timeout=seconds(10)) == 128 + signal.SIGINT
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0  # the viewer has ended with it


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc (Linux)")
def test_a_run_goes_on_when_its_viewer_is_killed(
    viewed: Viewed, capsys: pytest.CaptureFixture[str]
) -> None:
    session = open_session(viewed.session)
    with LiveView("serve-web", StopFlag()) as live:
        watcher = live.observer(session.info)
        for number, scan in enumerate(session.scans()):
            if number == 20:
                kill_viewer()
            watcher.take(scan)
        watcher.close()
    said = capsys.readouterr().err
    assert said.count("the viewer was closed; the run goes on without it") == 1


def test_an_address_without_a_listener_is_named() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))  # bound and not listening: nobody else gets it meanwhile
        url = f"rerun+http://127.0.0.1:{probe.getsockname()[1]}/proxy"
        with pytest.raises(AppError, match=f"^{re.escape(url)}: no viewer listens there"):
            LiveView(url, StopFlag()).__enter__()
    with pytest.raises(SystemExit) as usage:
        main(["demo", "--rerun", "http://127.0.0.1:9876"])
    assert usage.value.code == 2


@contextmanager
def saving_viewer(saved: Path) -> Iterator[str]:
    """Give the address of a viewer of Rerun's own that saves what it is sent."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [
        str(SlamViewerProcess.executable()),
        "--save",
        str(saved),
        "--bind",
        "127.0.0.1",
        "--port",
        str(port),
    ]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            wait_until(lambda: connects(port), process)
            yield f"rerun+http://127.0.0.1:{port}/proxy"
        finally:
            process.terminate()


def test_a_viewer_gets_every_row_that_a_file_gets(
    viewed: Viewed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rerun_recording, "_VIEWER_CLOSE_LIMIT_S", seconds(5))
    expected = without_pictures(viewed.rrd)
    with saving_viewer(saved := tmp_path / "saved.rrd") as url:
        session = open_session(viewed.session)
        with LiveView(url, StopFlag(), is_replay=True) as live:
            execute(recorded_source(session, StopFlag()), [live.observer(session.info)])
        wait_until(lambda: without_pictures(saved) == expected)
    assert without_pictures(saved) == expected
    assert sum(expected.values()) > 1000


@pytest.mark.rare
@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # of one that is still written
def test_a_demo_is_watched_while_it_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_recording, "_VIEWER_CLOSE_LIMIT_S", seconds(5))
    scene, out = str(write_shorter_scene(tmp_path)), tmp_path / "out"
    out.mkdir()
    (out / "report.html").write_text("of an earlier run")
    with saving_viewer(saved := tmp_path / "saved.rrd") as url:
        options = ["--scene", scene, "--preset", "paper", "--out", str(out), "--rerun", url]
        assert main(["demo", *options]) == 0
        expected = without_pictures(out / "session.rrd")
        wait_until(lambda: without_pictures(saved) == expected)
    assert without_pictures(saved) == expected
    hosts = {
        "host_time" in chunk.timeline_names
        for chunk in RrdReader(saved).stream()
        if str(chunk.entity_path) == "/radar/front_left/frame" and not chunk.is_static
    }
    assert hosts == {True}  # a live view knows when frames arrived
    assert not (out / "report.html").exists()


def test_a_demo_that_cannot_be_watched_leaves_an_earlier_run_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    (tmp_path / "session.mcap").write_text("of an earlier run")
    assert main(["demo", "--out", str(tmp_path), "--rerun", "spawn"]) == 1
    assert (tmp_path / "session.mcap").read_text() == "of an earlier run"


def without_pictures(path: Path) -> dict[str, int]:
    """Count rows of all but B-scans: a live view sends those more often, as they fill."""
    try:
        rows = count_rows(path)
    except (OSError, RuntimeError):  # the file is being written
        return {}
    return {name: n for name, n in rows.items() if not name.endswith("/bscan")}


def connects(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def kill_viewer() -> None:
    """Kill the one viewer that this process has started, and see it gone."""
    own = os.getpid()
    (viewer,) = (
        pid
        for pid in map(int, Path(f"/proc/{own}/task/{own}/children").read_text().split())
        if "rerun" in Path(f"/proc/{pid}/cmdline").read_text().split("\0")[0]
    )
    os.kill(viewer, signal.SIGKILL)
    os.waitid(os.P_PID, viewer, os.WEXITED | os.WNOWAIT)


def test_of_a_killed_run_the_session_is_shown_not_its_unfinished_view(
    viewed: Viewed, tmp_path: Path
) -> None:
    shutil.copy(viewed.session, tmp_path / "session.mcap")
    shutil.copy(viewed.rrd, tmp_path / "session.rrd")
    assert session_file(tmp_path, allow_view=True).name == "session.rrd"
    (tmp_path / "session.rrd").write_bytes(viewed.rrd.read_bytes()[:-1000])
    assert session_file(tmp_path, allow_view=True).name == "session.mcap"
    (tmp_path / "session.mcap").unlink()
    assert session_file(tmp_path, allow_view=True).name == "session.rrd"  # better than nothing
    (tmp_path / "session.rrd").write_bytes(b"")
    assert not is_finished(tmp_path / "session.rrd")
    assert is_finished(viewed.rrd)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full (Linux)")
@pytest.mark.parametrize("command", ["view", pytest.param("report", marks=pytest.mark.rare)])
def test_a_full_disk_is_one_line(
    viewed: Viewed, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, str(viewed.session), "--out", "/dev/full"]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("uwb-slam: /dev/full: cannot be written: No space left on device")
