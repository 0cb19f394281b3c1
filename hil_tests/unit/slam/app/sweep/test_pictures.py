"""The command `experiment`: what it shows of a sweep, and how it ends."""

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from hil_tests.unit.slam.app.sweep.sweep_runs import run_of
from slam.app.cli import main
from slam.app.sweep.pictures import experiment_of
from slam.app.sweep.run import SweepRun, make_case
from slam.app.sweep.statistics import summarise_groups
from slam.live.errors import AppError

TIMES_S = tuple(float(second) for second in range(1, 11))


@cache
def lab_run(preset: str) -> SweepRun:
    return run_of(make_case("lab", preset, 0))


def made_up(preset: str, stress: str, seed: int, nees: tuple[float, ...], ate_m: float) -> SweepRun:
    """Return a run with these ten NEES; NIS 2.0 of 2 dof, but 20.0 at the first time."""
    return replace(
        lab_run(preset),
        stress=stress,
        seed=seed,
        ate_rmse_m=ate_m,
        nees_pose=tuple(zip(TIMES_S, nees, strict=True)),
        nis_times=tuple((t_s, 20.0 if t_s == 1.0 else 2.0, 2) for t_s in TIMES_S),
        bound=None,
    )


def written(folder: Path, runs: list[SweepRun]) -> str:
    path = folder / "sweep.json"
    result = {"runs": [asdict(run) for run in runs], "groups": summarise_groups(runs)}
    path.write_text(json.dumps(result))
    return str(path)


# For 4 seeds the band is [1.10, 5.83] (chi-square of 12 dof: 4.404 and 23.337).
HONEST = (3.0,) * 10
TWICE_OUT = (9.0, 0.5, *(3.0,) * 8)


def runs() -> list[SweepRun]:
    rows = (
        ("paper", "clean", TWICE_OUT, 0.010),
        ("paper", "skew", TWICE_OUT, 0.030),
        ("robust", "clean", HONEST, 0.002),
        ("robust", "skew", HONEST, 0.003),
    )
    return [
        made_up(preset, stress, seed, nees, ate_m)
        for preset, stress, nees, ate_m in rows
        for seed in range(4)
    ]


def numbers_of(name: str, folder: Path) -> dict[str, Any]:
    command = ["experiment", name, "--sweep", written(folder, runs()), "--out", str(folder / "out")]
    assert main(command) == 0
    assert (folder / "out" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    numbers: dict[str, Any] = json.loads((folder / "out" / f"{name}.json").read_text())
    return numbers


def test_consistency_counts_the_times_in_their_bands(tmp_path: Path) -> None:
    numbers = numbers_of("consistency", tmp_path)
    assert numbers["simulated"] is True
    # the stressed runs are not in it
    assert [
        (row["name"], row["runs"], row["anees_in_band"], row["nis_in_band"])
        for row in numbers["groups"]
    ] == [("lab, preset paper", 4, 8, 9), ("lab, preset robust", 4, 10, 9)]


def test_stress_compares_with_clean_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    groups = numbers_of("stress", tmp_path)["groups"]
    assert {row["name"]: row["times_clean"]["median"] for row in groups} == {
        "lab, preset paper": 1.0,
        "lab, preset paper, stress skew": pytest.approx(3.0),
        "lab, preset robust": 1.0,
        "lab, preset robust, stress skew": pytest.approx(1.5),
    }
    assert capsys.readouterr().out.count("x clean") == 2


def test_scenes_has_a_row_per_clean_group(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # 10 and 2 mm, where the wheels have 40
    assert [
        (row["name"], row["ratio"]["median"], row["anees_mean"], row["anees_in_band"])
        for row in numbers_of("scenes", tmp_path)["groups"]
    ] == [
        ("lab, preset paper", pytest.approx(0.25), pytest.approx(3.35), 8),
        ("lab, preset robust", pytest.approx(0.05), pytest.approx(3.0), 10),
    ]
    assert "0.250" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["consistency", "stress", "scenes"])
def test_a_result_never_replaces_its_sweep(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"{name}.json"
    Path(written(tmp_path, runs())).rename(path)
    before = path.read_bytes()
    assert main(["experiment", name, "--sweep", str(path), "--out", str(tmp_path)]) == 1
    assert path.read_bytes() == before


def test_a_sweep_without_stresses_has_no_stress_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, [run for run in runs() if run.stress == "clean"])
    assert main(["experiment", "stress", "--sweep", path, "--out", str(tmp_path / "out")]) == 1
    assert "has no stressed runs" in capsys.readouterr().err


def damaged(value: Any) -> Iterator[Any]:  # noqa: ANN401 - JSON
    """Yield copies of a document with one part of it gone or replaced."""
    yield from (None, "x", -1, [], {}, math.nan, math.inf, 0)
    if isinstance(value, dict):
        for key, part in value.items():
            yield {name: each for name, each in value.items() if name != key}
            yield from ({**value, key: wrong} for wrong in damaged(part))
    elif isinstance(value, list) and value:
        yield value[:-1]
        yield from ([*value[:-1], wrong] for wrong in damaged(value[-1]))


@pytest.mark.parametrize(
    "name",
    ["stress", *(pytest.param(name, marks=pytest.mark.rare) for name in ("consistency", "scenes"))],
)
def test_a_file_that_is_no_whole_sweep_is_refused_or_shown(name: str, tmp_path: Path) -> None:
    """Whatever is missing or null in it; what is drawn goes by what is let through."""
    sweep = Path(written(tmp_path, runs()))
    whole = json.loads(sweep.read_text())
    # of two groups that differ by their stress; the groups in the file are not read
    whole["runs"], whole["groups"] = whole["runs"][2:6], []
    refused = shown = 0
    for content in damaged(whole):
        sweep.write_text(json.dumps(content))
        try:
            numbers = experiment_of(name, sweep, tmp_path).numbers
        except AppError:
            refused += 1
        else:
            shown += 1
            json.dumps(numbers, allow_nan=False)
    assert refused > 100
    assert shown > 10


@pytest.mark.parametrize("name", ["consistency", "stress", "scenes"])
def test_a_sweep_without_any_error_is_drawn(name: str, tmp_path: Path) -> None:
    """Ideal wheels give no ratio, and a logarithmic axis has no place for zero."""
    perfect = [replace(run, ate_rmse_m=0.0, odometry_ate_rmse_m=0.0) for run in runs()]
    command = ["experiment", name, "--sweep", written(tmp_path, perfect), "--out", str(tmp_path)]
    assert main(command) == 0
    assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("content", ["", '{"command": {}}\n{}\n', "[", "[" * 100_000, "\x00"])
def test_an_unfinished_sweep_is_one_line(
    content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "o.part").write_text(content)
    command = ["experiment", "scenes", "--sweep", str(tmp_path / "o.part"), "--out", str(tmp_path)]
    assert main(command) == 1
    assert capsys.readouterr().err.count("\n") == 1
