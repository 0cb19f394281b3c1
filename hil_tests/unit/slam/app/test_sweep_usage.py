"""Sweeps that would mix up two scenes are refused before the first run."""

from pathlib import Path

import pytest

from hil_tests.system.short_scene import write_short_scene
from slam.app.errors import UsageError
from slam.app.stop import StopFlag
from slam.app.sweep import SweepOptions, run_sweep


def test_two_scenes_of_one_name_are_refused(tmp_path: Path) -> None:
    scene = write_short_scene(tmp_path)
    options = SweepOptions(
        scenes=(str(scene), str(scene)),
        presets=("paper",),
        n_seeds=1,
        jobs=1,
        out=tmp_path / "out.json",
    )
    with StopFlag() as stop, pytest.raises(UsageError, match="same name"):
        run_sweep(options, stop)
    assert not (tmp_path / "out.json").exists()
