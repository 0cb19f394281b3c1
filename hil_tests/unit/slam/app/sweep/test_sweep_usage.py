"""Sweeps that would mix up runs are refused before the first, and stopped ones go on."""

import json
import os
import signal
from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Any, NoReturn

import pytest

from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.slam.app.sweep_runs import run_of
from slam.app.cli import main
from slam.app.errors import AppError, StopFlag, StopRequestedError, UsageError
from slam.app.sweep import sweep
from slam.app.sweep.run import Case, Key, SweepRun
from slam.app.sweep.sweep import run_sweep


def test_two_scenes_of_one_name_are_refused(tmp_path: Path) -> None:
    scene = write_short_scene(tmp_path)
    options: dict[str, Any] = dict(
        scenes=(str(scene), str(scene)),
        presets=("paper",),
        n_seeds=1,
        jobs=1,
        out=tmp_path / "out.json",
    )
    with StopFlag() as stop, pytest.raises(UsageError, match="same name"):
        run_sweep(stop, **options)
    assert not (tmp_path / "out.json").exists()


def test_a_worker_that_dies_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dying(*_: object) -> NoReturn:
        raise BrokenExecutor

    monkeypatch.setattr(sweep, "worker_results", dying)
    options: dict[str, Any] = dict(
        scenes=("lab",), presets=("paper",), n_seeds=2, jobs=2, out=tmp_path / "out.json"
    )
    with StopFlag() as stop, pytest.raises(AppError, match=r"^a worker process died; did memory"):
        run_sweep(stop, **options)
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_regular_file_is_never_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    options: dict[str, Any] = dict(scenes=("lab",), presets=("paper",), n_seeds=1, jobs=1, out=pipe)
    with StopFlag() as stop, pytest.raises(AppError, match="no regular file"):
        run_sweep(stop, **options)
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


def test_the_folder_of_the_results_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def dying(*_: object) -> NoReturn:
        raise BrokenExecutor

    monkeypatch.setattr(sweep, "worker_results", dying)
    out = tmp_path / "new" / "out.json"
    options: dict[str, Any] = dict(scenes=("lab",), presets=("paper",), n_seeds=2, jobs=2, out=out)
    with StopFlag() as stop, pytest.raises(AppError, match="worker process died"):
        run_sweep(stop, **options)
    assert out.parent.is_dir()


def options_of(out: Path, **changes: Any) -> dict[str, Any]:  # noqa: ANN401 - any option
    """Return a sweep of two presets' worth of settings, a stress and three seeds: 12 runs."""
    options = {
        "scenes": ("lab",),
        "presets": ("paper",),
        "n_seeds": 3,
        "jobs": 1,
        "out": out,
        "settings": (("association.gate", ("0.6", "9.2")),),
        "stresses": ("skew",),
    }
    return options | changes


def interrupted_after(count: int, calls: list[Key]) -> Callable[..., SweepRun]:
    def run(case: Case, *, check: Callable[[], None]) -> SweepRun:
        if len(calls) == count:
            raise StopRequestedError(signal.SIGINT)
        calls.append(case.key)
        return run_of(case)

    return run


def test_a_stopped_sweep_goes_on_with_the_missing_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    results = []
    for name, first in (("at_once", 99), ("in_two", 5)):
        out, calls = tmp_path / name, list[Key]()
        with StopFlag() as stop:
            if first < 12:
                monkeypatch.setattr(sweep, "run_case", interrupted_after(first, calls))
                with pytest.raises(StopRequestedError, match="5 of 12 runs are in"):
                    run_sweep(stop, **options_of(out))
                assert not out.exists()
            monkeypatch.setattr(sweep, "run_case", interrupted_after(99, calls))
            run_sweep(stop, **options_of(out))
        assert len(calls) == len(set(calls)) == 12
        assert list(tmp_path.glob("*.part")) == []
        results.append(json.loads(out.read_text()))
    assert results[0] == results[1]
    said = capsys.readouterr().err
    assert "5 of 12 runs are done, going on" in said
    assert said.splitlines()[-1].endswith("0:00:00 remaining")
    groups = [(group["settings"], group["stress"]) for group in results[0]["groups"]]
    assert groups == [
        ({"association.gate": gate}, stress)
        for gate in ("0.6", "9.2")
        for stress in ("clean", "skew")
    ]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"n_seeds": 4}, "other: seeds"),
        ({"stresses": ()}, "other: stresses"),
        ({"settings": (("association.gate", ("0.6", "9.3")),)}, "other: settings, preset file"),
    ],
)
def test_a_changed_command_does_not_go_on(
    changes: dict[str, Any], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweep, "run_case", interrupted_after(2, []))
    part = tmp_path / "out.part"
    with StopFlag() as stop:
        with pytest.raises(StopRequestedError):
            run_sweep(stop, **options_of(tmp_path / "out"))
        before = part.read_bytes()
        with pytest.raises(AppError, match=said):
            run_sweep(stop, **options_of(tmp_path / "out", **changes))
    assert part.read_bytes() == before


def test_another_version_of_a_scene_file_does_not_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = write_short_scene(tmp_path)
    options = options_of(tmp_path / "out", scenes=(str(scene),))
    monkeypatch.setattr(sweep, "run_case", interrupted_after(2, []))
    with StopFlag() as stop:
        with pytest.raises(StopRequestedError):
            run_sweep(stop, **options)
        scene.write_text(scene.read_text().replace("0.05", "0.06"))
        with pytest.raises(AppError, match="other: scene file short"):
            run_sweep(stop, **options)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--set association.gte=1", "unknown key association.gte; allowed: gate_rule"),
        ("--set association.gate=1,x", "association.gate"),
        ("--set gate=1", "write it as part.key"),
        ("--set association.gate=1,1", "given twice"),
        ("--preset paper paper", "given twice"),
    ],
)
def test_a_wrong_setting_is_2_and_one_line_before_any_run(
    arguments: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["sweep", "--json", str(tmp_path / "o"), *arguments.split()]
    assert main(command) == 2
    text = capsys.readouterr()
    assert said in text.err
    assert (text.out, text.err.count("\n")) == ("", 1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("wrong", ["--set gate", "--stress mud", "--jobs 2 --dask tcp://x:1"])
def test_what_the_parser_refuses_is_2(wrong: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["sweep", "--json", "o", *wrong.split()])
    assert caught.value.code == 2
    assert "Traceback" not in capsys.readouterr().err
