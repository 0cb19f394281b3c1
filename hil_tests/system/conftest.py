"""A demo that the tests of replays and of maps begin with."""

from pathlib import Path

import pytest

from hil_tests.system.recorded_session import write_shorter_scene
from slam.app.cli import main


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a demo in ``out``, its scene ``short.toml`` and its map ``map.json``."""
    folder = tmp_path_factory.mktemp("demo")
    # a third of the short scene: enough for landmarks
    options = ["--scene", str(write_shorter_scene(folder)), "--seed", "5", "--wire"]
    options += ["--save-map", str(folder / "map.json"), "--out", str(folder / "out")]
    assert main(["demo", *options]) == 0
    return folder
