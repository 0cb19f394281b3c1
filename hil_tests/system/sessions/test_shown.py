"""What `view` and `report` share: they show what was recorded, and leave no half file."""

import io
import signal
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from PIL import Image

from hil_tests.patience import seconds
from hil_tests.system.recorded_session import record_session
from hil_tests.unit.full_disk import child_on_full_disk, full_disk
from hil_tests.unit.slam.app.session.mcap_files import rewrite
from slam.app.cli import main
from slam.app.commands import report, view
from slam.app.run import output
from slam.app.view.rerun_recording import count_rows
from slam.paper.pipeline import UwbRadarSlam
from slam.robust.pipeline import RobustSlam
from xethru_protocol.operating_system import StopFlag, StopRequestedError

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("shown") / "session.mcap"
    record_session(path, "robust")
    return path


@pytest.fixture
def no_slam(monkeypatch: pytest.MonkeyPatch) -> None:
    def step(*_: object) -> None:
        pytest.fail("SLAM ran again")

    for kind in (UwbRadarSlam, RobustSlam):
        for name in ("step", "step_detections"):
            monkeypatch.setattr(kind, name, step)


def without(session: Path, folder: Path, *topics: str) -> Path:
    path = folder / "session.mcap"
    rewrite(session, path, lambda topic, data: None if topic in topics else data)
    return path


def n_messages(session: Path, topic: str) -> int:
    with session.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    ids = [channel.id for channel in summary.channels.values() if channel.topic == topic]
    return sum(summary.statistics.channel_message_counts[number] for number in ids)


@pytest.mark.usefixtures("no_slam")
def test_what_was_recorded_is_shown_without_slam(session: Path, tmp_path: Path) -> None:
    """By `view`; so is the page of `report` in its own tests."""
    rrd = tmp_path / "view.rrd"
    assert main(["view", str(session), "--out", str(rrd)]) == 0
    rows = count_rows(rrd)
    n_states = n_messages(session, "/slam/state")
    assert rows["/map/robot"] == rows["/map/robot/front_left/arcs_used"] == n_states > 100
    assert rows["/radar/front_left/detections"] == n_states


@pytest.mark.rare
@pytest.mark.usefixtures("no_slam")
def test_a_session_of_an_older_version_shows_what_it_has(session: Path, tmp_path: Path) -> None:
    older = without(session, tmp_path, "/slam/step")
    assert main(["report", str(older)]) == 0
    page = older.with_name("report.html").read_text(encoding="utf-8")
    assert "<td>SLAM ATE</td>" in page
    assert "what led to the states" in page
    assert main(["view", str(older), "--out", str(tmp_path / "view.rrd")]) == 0
    rows = count_rows(tmp_path / "view.rrd")
    assert rows["/map/robot"] == rows["/error/slam"] == n_messages(older, "/slam/state")
    assert "/radar/front_left/detections" not in rows
    assert "/consistency/nis/band" not in rows


@pytest.mark.thorough  # a whole run of SLAM
def test_frames_without_states_go_through_slam(session: Path, tmp_path: Path) -> None:
    """Those of an imported session."""
    frames = without(session, tmp_path, "/slam/step", "/slam/state")
    for path, name in ((session, "run.html"), (frames, "frames.html")):
        assert main(["report", str(path), "--out", str(tmp_path / name)]) == 0
    assert (tmp_path / "run.html").read_bytes() == (tmp_path / "frames.html").read_bytes()


@pytest.mark.rare
def test_progress_comes_to_the_end_that_it_names(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines: list[output.RunProgress] = []
    close = output.RunProgress.close

    def closed(line: output.RunProgress) -> None:
        lines.append(line)
        close(line)

    monkeypatch.setattr(output.RunProgress, "close", closed)
    assert main(["report", str(session), "--out", str(tmp_path / "report.html")]) == 0
    with session.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    end_s = summary.statistics.message_end_time / 1e9  # the first scan is at 0
    (line,) = lines
    assert f" of {end_s:.1f} s " in line.line()
    shown_s = float(line.line().split()[2])
    assert end_s - 1.0 < shown_s <= end_s + 0.05


class StopsSoon(StopFlag):
    """A signal comes at the hundredth time that somebody looks."""

    def __init__(self) -> None:
        super().__init__()
        self._left = 100

    def check(self) -> None:
        self._left -= 1
        if self._left < 0:
            raise StopRequestedError(signal.SIGTERM)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("earlier", [None, b"of an earlier run"])
def test_a_signal_leaves_what_was_there(
    session: Path, tmp_path: Path, earlier: bytes | None
) -> None:
    out = tmp_path / "shown"
    if earlier is not None:
        out.write_bytes(earlier)
    before = contents(tmp_path)
    with pytest.raises(StopRequestedError):
        view.run_view(StopsSoon(), session=session, web=False, out=out, screenshot=None, at_s=None)
    assert contents(tmp_path) == before
    with pytest.raises(StopRequestedError):
        report.run_report(StopsSoon(), session=session, out=out)
    assert contents(tmp_path) == before


@pytest.mark.rare
@pytest.mark.parametrize("command", ["view", pytest.param("report", marks=pytest.mark.thorough)])
def test_a_full_disk_leaves_what_was_there(session: Path, tmp_path: Path, command: str) -> None:
    out = tmp_path / "shown"
    out.write_bytes(b"of an earlier run")
    before = contents(tmp_path)
    # in a process of its own: Rerun's threads may wait for the disk without end
    ended = subprocess.run(
        [sys.executable, "-m", "slam.app.cli", command, str(session), "--out", str(out)],
        stderr=subprocess.PIPE,
        text=True,
        timeout=seconds(30),
        check=False,
        **child_on_full_disk(20_000),
    )
    assert ended.returncode == 1
    assert contents(tmp_path) == before
    assert ended.stderr.splitlines()[-1].startswith(f"uwb-slam: {out}: ")


def test_a_full_disk_leaves_the_earlier_picture(
    session: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    rrd, out = tmp_path / "made.rrd", tmp_path / "shown.png"
    assert main(["view", str(session), "--out", str(rrd)]) == 0
    out.write_bytes(b"of an earlier run")
    before = contents(tmp_path)
    # a viewer that needs no driver
    noise = np.random.default_rng(1).integers(0, 255, (300, 300, 3), dtype=np.uint8)
    Image.fromarray(noise).save(png := io.BytesIO(), format="png")
    monkeypatch.setattr(view, "SlamViewerProcess", lambda _: nullcontext(_Ready()))
    monkeypatch.setattr(view, "_settled", lambda *_: png.getvalue())
    with full_disk(20_000):
        assert main(["view", str(rrd), "--screenshot", str(out)]) == 1
    assert contents(tmp_path) == before
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"uwb-slam: {out}: ")


class _Ready:
    def wait_until_ready(self, _: StopFlag) -> None: ...


# A shell starts it: the path after #! may have no blanks.
_ENDS_SOON = """\
#!/bin/sh
'''exec' "{python}" "$0" "$@" # '''
import socket, sys, time
listener = socket.create_server(("127.0.0.1", int(sys.argv[sys.argv.index("--port") + 1])))
listener.settimeout(0.1)
end = time.monotonic() + 1.5
while time.monotonic() < end:
    try:
        listener.accept()[0].close()
    except TimeoutError:
        pass
"""


def test_a_viewer_that_ends_late_for_want_of_a_driver_is_named(
    session: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It listens at first, and drops its connections as it ends: a transport error."""
    fake = tmp_path / "rerun"
    fake.write_text(_ENDS_SOON.format(python=sys.executable))
    fake.chmod(0o755)
    monkeypatch.setattr("slam.app.view.viewer.SlamViewerProcess.executable", lambda self: fake)
    picture = tmp_path / "view.png"
    assert main(["view", str(session), "--screenshot", str(picture)]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert "a Vulkan driver is missing" in last
    assert "mesa-vulkan-drivers" in last
    assert not picture.exists()
