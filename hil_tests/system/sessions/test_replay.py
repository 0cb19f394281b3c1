"""Replay of what a demo recorded: the same numbers, also of a file cut or killed half-way."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from hil_tests.system.recorded_session import write_shorter_scene
from slam.app.cli import main
from slam.app.session.reader import open_session

pytestmark = pytest.mark.slow

SEED = 5


@dataclass(frozen=True)
class Recorded:
    folder: Path
    summary: dict[str, object]


@pytest.fixture(scope="module", params=["robust", "paper"])
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("replay")
    # a third of the short scene: enough for landmarks, and for the paper's window to be full
    scene = write_shorter_scene(folder)
    options = ["--scene", str(scene), "--seed", str(SEED), "--preset", request.param, "--wire"]
    assert main(["demo", *options, "--out", str(folder / "demo")]) == 0
    return Recorded(
        folder=folder / "demo", summary=json.loads((folder / "demo/summary.json").read_text())
    )


def test_every_number_but_the_speed_comes_again(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = recorded.folder / "session.mcap"
    assert main(["replay", str(session), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().err
    n_states = len((recorded.folder / "estimate.tum").read_text().splitlines())
    assert f"all {n_states} recorded states came again, to the last bit" in said
    assert n_states > 50
    again = json.loads((tmp_path / "summary.json").read_text())
    del again["realtime_factor"]
    assert again == {k: v for k, v in recorded.summary.items() if k != "realtime_factor"}
    for name in ("estimate", "truth", "odometry"):
        assert (tmp_path / f"{name}.tum").read_bytes() == (
            recorded.folder / f"{name}.tum"
        ).read_bytes()
    assert (tmp_path / "map.png").stat().st_size > 10_000
    recorded_bytes = list(open_session(session).wire())
    # from the ping on, which is sent before there is a session to write to
    assert recorded_bytes[0][1:3] == ("tx", bytes.fromhex("7d01aeeaaaee7c7e"))
    assert sum(len(data) for _, way, data, _ in recorded_bytes if way == "rx") > 300_000


def test_what_is_left_of_a_cut_file_is_the_beginning_of_the_run(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (recorded.folder / "session.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) // 2])
    assert main(["replay", str(cut), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().err
    assert "was cut at byte" in said
    assert "recorded states came again, to the last bit" in said
    lines = (tmp_path / "out" / "estimate.tum").read_text().splitlines()
    expected = (recorded.folder / "estimate.tum").read_text().splitlines()
    n_flushed = 14  # of preset paper: states that were in the window when the file ended
    assert len(expected) / 4 < len(lines) < len(expected)
    assert lines[:-n_flushed] == expected[: len(lines) - n_flushed]
