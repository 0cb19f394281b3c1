"""Sweeps that would mix up two scenes are refused before the first run."""

import os
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import NoReturn

import pytest

from hil_tests.system.short_scene import write_short_scene
from slam.app import sweep
from slam.app.errors import AppError, UsageError
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


def test_a_worker_that_dies_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dying(*_: object) -> NoReturn:
        raise BrokenExecutor

    monkeypatch.setattr(sweep, "worker_results", dying)
    options = SweepOptions(
        scenes=("lab",), presets=("paper",), n_seeds=2, jobs=2, out=tmp_path / "out.json"
    )
    with StopFlag() as stop, pytest.raises(AppError, match=r"^a worker process died; did memory"):
        run_sweep(options, stop)
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_regular_file_is_never_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    options = SweepOptions(scenes=("lab",), presets=("paper",), n_seeds=1, jobs=1, out=pipe)
    with StopFlag() as stop, pytest.raises(AppError, match="no regular file"):
        run_sweep(options, stop)
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


def test_the_folder_of_the_results_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def dying(*_: object) -> NoReturn:
        raise BrokenExecutor

    monkeypatch.setattr(sweep, "worker_results", dying)
    out = tmp_path / "new" / "out.json"
    options = SweepOptions(scenes=("lab",), presets=("paper",), n_seeds=2, jobs=2, out=out)
    with StopFlag() as stop, pytest.raises(AppError, match="worker process died"):
        run_sweep(options, stop)
    assert out.parent.is_dir()
