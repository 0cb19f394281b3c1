"""`uwb-slam replay` of what a demo recorded: the same numbers, also of a file cut half-way."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from hil_tests.system.short_scene import write_short_scene

pytestmark = pytest.mark.slow

SEED = 5
# A third of the short scene: enough for landmarks, and for the paper's window to be full.
_SHORTER = ("waypoints_m = [[0.0, 0.0], [0.5, 0.0]]", "waypoints_m = [[0.0, 0.0], [0.2, 0.0]]")


@dataclass(frozen=True)
class Recorded:
    folder: Path
    summary: dict[str, object]


def uwb_slam(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "slam.app.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


@pytest.fixture(scope="module", params=["robust", "paper"])
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("replay")
    scene = write_short_scene(folder)
    scene.write_text(scene.read_text().replace(*_SHORTER))
    options = ["--scene", str(scene), "--seed", str(SEED), "--preset", request.param]
    process = uwb_slam("demo", *options, "--out", str(folder / "demo"))
    assert process.returncode == 0, process.stderr
    return Recorded(
        folder=folder / "demo", summary=json.loads((folder / "demo/summary.json").read_text())
    )


def test_every_number_but_the_speed_comes_again(recorded: Recorded, tmp_path: Path) -> None:
    process = uwb_slam("replay", str(recorded.folder / "session.mcap"), "--out", str(tmp_path))
    assert process.returncode == 0, process.stderr
    assert "recorded states came again, to the last bit" in process.stderr
    assert "all 0 recorded" not in process.stderr
    again = json.loads((tmp_path / "summary.json").read_text())
    del again["realtime_factor"]
    assert again == {k: v for k, v in recorded.summary.items() if k != "realtime_factor"}
    for name in ("estimate", "truth", "odometry"):
        assert (tmp_path / f"{name}.tum").read_bytes() == (
            recorded.folder / f"{name}.tum"
        ).read_bytes()
    assert (tmp_path / "map.png").stat().st_size > 10_000


def test_what_is_left_of_a_cut_file_is_the_beginning_of_the_run(
    recorded: Recorded, tmp_path: Path
) -> None:
    whole = (recorded.folder / "session.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) // 2])
    process = uwb_slam("replay", str(cut), "--out", str(tmp_path / "out"))
    assert process.returncode == 0, process.stderr
    assert "was cut at byte" in process.stderr
    assert "recorded states came again, to the last bit" in process.stderr
    lines = (tmp_path / "out" / "estimate.tum").read_text().splitlines()
    expected = (recorded.folder / "estimate.tum").read_text().splitlines()
    n_flushed = 14  # of preset paper: states that were in the window when the file ended
    assert len(expected) / 4 < len(lines) < len(expected)
    assert lines[:-n_flushed] == expected[: len(lines) - n_flushed]


def test_a_file_that_is_none_is_named(tmp_path: Path) -> None:
    (foreign := tmp_path / "notes.mcap").write_text("a list of things to buy")
    process = uwb_slam("replay", str(foreign), "--out", str(tmp_path / "out"))
    assert process.returncode == 1
    assert process.stderr.startswith(f"uwb-slam: {foreign}: is no MCAP file")
    assert len(process.stderr.splitlines()) == 1
