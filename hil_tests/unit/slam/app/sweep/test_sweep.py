"""Sweeps that would mix up runs are refused before the first, and stopped ones go on."""

import json
import math
import signal
from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import pytest

from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.slam.app.sweep.sweep_runs import run_of
from slam.app.errors import AppError
from slam.app.sweep import sweep
from slam.app.sweep.run import Case, Key, SweepRun, finite, make_case
from slam.app.sweep.sweep import PartFile, run_sweep
from xethru_protocol.system import StopFlag, StopRequestedError


@pytest.mark.parametrize("folder", [".", "new"])
def test_a_worker_that_dies_leaves_nothing_but_the_folder_of_the_results(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dying(*_: object) -> NoReturn:
        raise BrokenExecutor

    monkeypatch.setattr(sweep, "worker_results", dying)
    out = tmp_path / folder / "out.json"
    options: dict[str, Any] = dict(scenes=("lab",), presets=("paper",), n_seeds=2, jobs=2, out=out)
    with StopFlag() as stop, pytest.raises(AppError):
        run_sweep(stop, **options)
    assert list(tmp_path.rglob("*")) == ([out.parent] if folder == "new" else [])


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
    def run(case: Case, *, stop: StopFlag) -> SweepRun:
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
                with pytest.raises(StopRequestedError):
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
    "changes",
    [
        {"n_seeds": 4},
        {"stresses": ()},
        {"settings": (("association.gate", ("0.6", "9.3")),)},
        {"presets": ("robust",)},
    ],
)
def test_a_changed_command_does_not_go_on(
    changes: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweep, "run_case", interrupted_after(2, []))
    part = tmp_path / "out.part"
    with StopFlag() as stop:
        with pytest.raises(StopRequestedError):
            run_sweep(stop, **options_of(tmp_path / "out"))
        before = part.read_bytes()
        with pytest.raises(AppError):
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
        with pytest.raises(AppError):
            run_sweep(stop, **options)


COMMAND = {"seeds": "3", "scene file lab": "12ab"}


def runs() -> list[SweepRun]:
    return [run_of(make_case("lab", "paper", seed, stress="skew")) for seed in range(3)]


def part_with(path: Path, count: int) -> PartFile:
    path.touch()
    part = PartFile(path, COMMAND)
    for run in runs()[:count]:
        part.add(run)
    return part


def test_the_file_is_whole_after_every_run_and_reads_back_the_same(tmp_path: Path) -> None:
    path = tmp_path / "o.part"
    path.touch()
    part = PartFile(path, COMMAND)
    assert json.loads(path.read_text()) == {"command": COMMAND, "runs": []}
    for count, run in enumerate(runs(), start=1):
        part.add(run)
        assert len(json.loads(path.read_text())["runs"]) == count
        assert PartFile(path, COMMAND).runs == part.runs == runs()[:count]


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: whole[:-40],
        lambda whole: b"\0" * len(whole),
        lambda whole: whole + b"x",
        lambda whole: whole + b" ",
        lambda whole: whole.replace(b'"ate_rmse_m"', b'"ate"'),
        lambda whole: b"[]",
        lambda whole: b"\xff\xfe",
    ],
)
def test_a_damaged_file_is_one_line_and_stays_as_it_is(
    damage: Callable[[bytes], bytes], tmp_path: Path
) -> None:
    part_with(path := tmp_path / "o.part", 2)
    path.write_bytes(damage(path.read_bytes()))
    before = path.read_bytes()
    with pytest.raises(AppError):
        PartFile(path, COMMAND)
    assert path.read_bytes() == before


def test_an_infinite_nees_is_kept_as_a_huge_one_and_a_diverged_run_is_named() -> None:
    run = runs()[1]
    certain_and_wrong = replace(run, nees_pose=((1.0, math.inf), (2.0, 3.0)))
    assert finite(certain_and_wrong).nees_pose == ((1.0, 1e12), (2.0, 3.0))
    assert finite(run) == run
    with pytest.raises(AppError):
        finite(replace(run, ate_rmse_m=math.nan))
