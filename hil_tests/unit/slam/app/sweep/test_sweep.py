"""Sweeps that would mix up runs are refused before the first, and stopped ones go on."""

import json
import math
import os
import signal
from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import pytest

from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.full_disk import full_disk
from hil_tests.unit.slam.app.sweep.sweep_runs import run_of
from slam.app.sweep import sweep
from slam.app.sweep.run import Case, RunKey, SweepRun, finite, make_case
from slam.app.sweep.sweep import PartFile, run_sweep
from slam.live.errors import AppError
from xethru_protocol.operating_system import StopFlag, StopRequestedError


@pytest.mark.parametrize("folder", [".", "new"])
def test_a_worker_that_dies_leaves_nothing(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dying(*_: object) -> NoReturn:
        raise BrokenExecutor

    monkeypatch.setattr(sweep, "worker_results", dying)
    out = tmp_path / folder / "out.json"
    options: dict[str, Any] = dict(scenes=("lab",), presets=("paper",), n_seeds=2, jobs=2, out=out)
    with StopFlag() as stop, pytest.raises(AppError):
        run_sweep(stop, **options)
    assert list(tmp_path.rglob("*")) == []


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


def interrupted_after(count: int, calls: list[RunKey]) -> Callable[..., SweepRun]:
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
        out, calls = tmp_path / name, list[RunKey]()
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
        {"fps": 10},
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


def test_the_file_has_a_line_for_the_command_and_one_per_run(tmp_path: Path) -> None:
    path = tmp_path / "o.part"
    part = part_with(path, 0)
    for count, run in enumerate(runs(), start=1):
        part.add(run)
        command, *lines = path.read_text().splitlines()
        assert json.loads(command) == {"command": COMMAND}
        assert [json.loads(line)["seed"] for line in lines] == list(range(count))
        assert PartFile(path, COMMAND).runs == part.runs == runs()[:count]


@pytest.mark.parametrize("apart", [7, pytest.param(1, marks=pytest.mark.rare)])
def test_cut_at_any_byte_it_loses_the_last_line_only_and_goes_on(
    apart: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda _: None)  # thousands of them take seconds
    part_with(path := tmp_path / "o.part", 2)
    expected, whole = runs()[:2], path.read_bytes()
    ends = [at for at, byte in enumerate(whole) if byte == ord("\n")]
    near = {at + k for at in ends for k in (-1, 0, 1, 2)}
    for size in sorted({*range(0, len(whole), apart), *near} - {len(whole) + 1}):
        path.write_bytes(whole[:size])
        part = PartFile(path, COMMAND)
        n_lines = whole[:size].count(b"\n")
        assert part.runs == expected[: max(n_lines - 1, 0)], size
        for run in expected[len(part.runs) :]:
            part.add(run)
        assert path.read_bytes() == whole, size


@pytest.mark.parametrize("room", [0, 1, 400])
def test_what_a_full_disk_takes_of_a_run_is_taken_away_again(room: int, tmp_path: Path) -> None:
    part = part_with(path := tmp_path / "o.part", 1)
    before = path.read_bytes()
    with full_disk(len(before) + room), pytest.raises(AppError):
        part.add(runs()[1])
    assert path.read_bytes() == before
    part.add(runs()[1])
    assert PartFile(path, COMMAND).runs == runs()[:2]


@pytest.mark.parametrize("room", [0, 5])
def test_a_full_disk_from_the_first_leaves_nothing(
    room: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweep, "run_case", interrupted_after(99, []))
    with full_disk(room), StopFlag() as stop, pytest.raises(AppError):
        run_sweep(stop, **options_of(tmp_path / "out"))
    assert list(tmp_path.iterdir()) == []


def test_a_result_that_does_not_fit_costs_no_run_and_not_the_result_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, part = tmp_path / "out", tmp_path / "out.part"
    with StopFlag() as stop:
        monkeypatch.setattr(sweep, "run_case", interrupted_after(99, []))
        run_sweep(stop, **options_of(out, n_seeds=1))
        before = out.read_bytes()
        monkeypatch.setattr(sweep, "run_case", interrupted_after(11, []))
        with pytest.raises(StopRequestedError):
            run_sweep(stop, **options_of(out))
        monkeypatch.setattr(sweep, "run_case", interrupted_after(1, []))
        # room for the last run, and not for the result, which is longer by its line ends
        with full_disk(part.stat().st_size * 12 // 10), pytest.raises(AppError) as failed:
            run_sweep(stop, **options_of(out))
        assert f"12 of 12 runs are in {part}" in str(failed.value)
        assert out.read_bytes() == before
        assert sorted(tmp_path.iterdir()) == [out, part]
        monkeypatch.setattr(sweep, "run_case", interrupted_after(0, []))
        run_sweep(stop, **options_of(out))
    assert len(json.loads(out.read_text())["runs"]) == 12
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("is_part_left", [False, True])
def test_a_command_whose_result_is_there_shows_it_and_runs_nothing(
    is_part_left: bool,  # by a kill after the result had its name
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out, part = tmp_path / "out", tmp_path / "out.part"
    with StopFlag() as stop:
        monkeypatch.setattr(sweep, "run_case", interrupted_after(3, []))
        with pytest.raises(StopRequestedError):
            run_sweep(stop, **options_of(out))
        kept = part.read_bytes()
        monkeypatch.setattr(sweep, "run_case", interrupted_after(9, []))
        run_sweep(stop, **options_of(out))
        result, shown = out.read_bytes(), capsys.readouterr().out
        if is_part_left:
            part.write_bytes(kept)
        monkeypatch.setattr(sweep, "run_case", interrupted_after(0, []))
        run_sweep(stop, **options_of(out))
    assert list(tmp_path.iterdir()) == [out]
    assert out.read_bytes() == result
    again = capsys.readouterr()
    assert again.out == shown
    assert again.err.startswith(f"uwb-slam: {out}: holds the result of this command")


def test_another_sweeps_result_is_replaced_and_a_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    monkeypatch.setattr(sweep, "run_case", interrupted_after(99, []))
    with StopFlag() as stop:
        run_sweep(stop, **options_of(out))
        capsys.readouterr()
        run_sweep(stop, **options_of(out, n_seeds=1))
    assert capsys.readouterr().err.startswith(f"uwb-slam: {out}: the result of another sweep")
    assert len(json.loads(out.read_text())["runs"]) == 4


@pytest.mark.parametrize("content", ["1.0 0 0 0 0 0 0 1\n", "[]", '{"runs": []}', "\x00"])
def test_a_file_that_is_no_sweeps_result_is_not_replaced(
    content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "drive.tum"
    out.write_text(content)
    monkeypatch.setattr(sweep, "run_case", interrupted_after(0, []))
    with StopFlag() as stop, pytest.raises(AppError):
        run_sweep(stop, **options_of(out))
    assert [(path, path.read_text()) for path in tmp_path.iterdir()] == [(out, content)]


@pytest.mark.parametrize(
    "damage",
    [
        lambda _: b'{"command": {\n "seeds": "3"\n},\n"runs": [\n]}\n',
        lambda whole: whole.replace(b"{", b"", 1),
        lambda whole: whole.replace(b"0.04", b"0,04", 1),
        lambda whole: b"\0" * len(whole),
        lambda whole: whole + b"x\n",
        lambda whole: whole + b"\n",
        lambda whole: whole.replace(b'"ate_rmse_m"', b'"ate"'),
        lambda _: b"[]",
        lambda _: b"[]\n",
        lambda _: b"\n",
        lambda _: b"\xff\xfe",
        lambda _: b'{"command": []}\n',
        lambda _: b'{"command": "seeds"}\n',
        lambda _: b"[" * 100_000 + b"\n",
        lambda whole: whole.replace(b'"duration_s": ', b'"duration_s": 1e999, "was": ', 1),
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


def test_a_run_that_is_there_twice_counts_once(tmp_path: Path) -> None:
    part_with(path := tmp_path / "o.part", 2)
    *lines, last = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines, last, last]))
    assert PartFile(path, COMMAND).runs == runs()[:2]


def test_a_pipe_in_place_of_the_part_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "o.json.part")
    with StopFlag() as stop, pytest.raises(AppError):
        run_sweep(stop, out=tmp_path / "o.json", n_seeds=1)


def test_an_infinite_nees_is_kept_as_a_huge_one_and_a_diverged_run_is_named() -> None:
    run = runs()[1]
    certain_and_wrong = replace(run, nees_pose=((1.0, math.inf), (2.0, 3.0)))
    assert finite(certain_and_wrong).nees_pose == ((1.0, 1e12), (2.0, 3.0))
    assert finite(run) == run
    with pytest.raises(AppError):
        finite(replace(run, ate_rmse_m=math.nan))
