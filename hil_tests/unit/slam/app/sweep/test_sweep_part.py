"""The file of an unfinished sweep: whole after every run, and never lost to a mistake."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from hil_tests.unit.slam.app.sweep_runs import run_of
from slam.app.errors import AppError
from slam.app.sweep.run import SweepRun, finite, make_case
from slam.app.sweep.sweep import PartFile

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


def test_a_file_goes_on_where_it_ended(tmp_path: Path) -> None:
    part_with(at_once := tmp_path / "at_once", 3)
    part_with(in_two := tmp_path / "in_two", 1)
    again = PartFile(in_two, COMMAND)
    for run in runs()[1:]:
        again.add(run)
    assert in_two.read_bytes() == at_once.read_bytes()


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (COMMAND | {"seeds": "4"}, "holds 2 runs of another sweep (other: seeds)"),
        (COMMAND | {"scene file lab": "34cd"}, "other: scene file lab"),
        (COMMAND | {"preset file paper": "1"}, "other: preset file paper"),
        ({"seeds": "3"}, "other: scene file lab"),
    ],
)
def test_another_command_is_told_what_differs_and_nothing_is_lost(
    command: dict[str, str], said: str, tmp_path: Path
) -> None:
    part_with(path := tmp_path / "o.part", 2)
    before = path.read_bytes()
    with pytest.raises(AppError) as caught:
        PartFile(path, command)
    assert said in str(caught.value)
    assert "choose another --json" in str(caught.value)
    assert path.read_bytes() == before


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
    with pytest.raises(AppError, match="move this file away") as caught:
        PartFile(path, COMMAND)
    assert "\n" not in str(caught.value)
    assert path.read_bytes() == before


def test_an_infinite_nees_is_kept_as_a_huge_one_and_a_diverged_run_is_named() -> None:
    run = runs()[1]
    certain_and_wrong = replace(run, nees_pose=((1.0, math.inf), (2.0, 3.0)))
    assert finite(certain_and_wrong).nees_pose == ((1.0, 1e12), (2.0, 3.0))
    assert finite(run) == run
    with pytest.raises(AppError, match=r"lab, paper, stress skew, seed 1: .* finite: ate_rmse_m"):
        finite(replace(run, ate_rmse_m=math.nan))
