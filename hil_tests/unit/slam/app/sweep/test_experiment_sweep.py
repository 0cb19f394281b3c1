"""Pictures and tables of a sweep's result file: what they count, and what they refuse."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from hil_tests.unit.slam.app.sweep_runs import run_of
from slam.app.cli import main
from slam.app.sweep.run import SweepRun, make_case
from slam.app.sweep.statistics import summarise_groups

TIMES_S = tuple(float(second) for second in range(1, 11))


def made_up(preset: str, stress: str, seed: int, nees: tuple[float, ...], ate_m: float) -> SweepRun:
    """Return a run with these ten NEES; NIS 2.0 of 2 dof, but 20.0 at the first time."""
    run = run_of(make_case("lab", preset, seed, stress=stress))
    return replace(
        run,
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


def test_consistency_counts_the_times_in_their_bands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["experiment", "consistency", "--sweep", written(tmp_path, runs())]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    numbers = json.loads((tmp_path / "out" / "consistency.json").read_text())
    assert numbers["simulated"] is True
    # the stressed runs are not in it
    assert [
        (row["name"], row["runs"], row["anees_in_band"], row["nis_in_band"])
        for row in numbers["groups"]
    ] == [("lab, preset paper", 4, 8, 9), ("lab, preset robust", 4, 10, 9)]
    assert (tmp_path / "out" / "consistency.png").read_bytes().startswith(b"\x89PNG")
    assert "lab, preset robust" in capsys.readouterr().out


def test_stress_compares_with_clean_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["experiment", "stress", "--sweep", written(tmp_path, runs())]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    numbers = json.loads((tmp_path / "out" / "stress.json").read_text())
    times = {row["name"]: row["times_clean"]["median"] for row in numbers["groups"]}
    assert times == {
        "lab, preset paper": 1.0,
        "lab, preset paper, stress skew": pytest.approx(3.0),
        "lab, preset robust": 1.0,
        "lab, preset robust, stress skew": pytest.approx(1.5),
    }
    assert (tmp_path / "out" / "stress.png").read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out.count("x clean") == 4


def test_scenes_has_a_row_per_clean_group(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["experiment", "scenes", "--sweep", written(tmp_path, runs())]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    numbers = json.loads((tmp_path / "out" / "scenes.json").read_text())
    # 10 and 2 mm, where the wheels have 40
    assert [
        (row["name"], row["ratio"], row["anees_mean"], row["anees_in_band"])
        for row in numbers["groups"]
    ] == [
        ("lab, preset paper", pytest.approx(0.25), pytest.approx(3.35), 8),
        ("lab, preset robust", pytest.approx(0.05), pytest.approx(3.0), 10),
    ]
    assert (tmp_path / "out" / "scenes.png").read_bytes().startswith(b"\x89PNG")
    assert "0.250" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "cannot be read"),
        ("{", "is not a result"),
        ("[]", "is not a result"),
        ('{"runs": [], "groups": []}', "is not a result"),
        ('{"groups": [{"scene": "lab"}]}', "is not a result"),
    ],
)
@pytest.mark.parametrize("name", ["consistency", "stress", "scenes"])
def test_what_no_sweep_wrote_is_1_and_one_line(
    name: str,
    content: str | None,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "o.json"
    if content is not None:
        path.write_text(content)
    assert main(["experiment", name, "--sweep", str(path), "--out", str(tmp_path / "out")]) == 1
    text = capsys.readouterr()
    assert str(path) in text.err
    assert said in text.err
    assert (text.out, text.err.count("\n")) == ("", 1)


@pytest.mark.parametrize("name", ["consistency", "stress", "scenes"])
def test_a_result_never_replaces_its_sweep(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"{name}.json"
    Path(written(tmp_path, runs())).rename(path)
    before = path.read_bytes()
    assert main(["experiment", name, "--sweep", str(path), "--out", str(tmp_path)]) == 1
    assert "choose another --out" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_a_sweep_without_stresses_has_no_stress_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, [run for run in runs() if run.stress == "clean"])
    assert main(["experiment", "stress", "--sweep", path, "--out", str(tmp_path / "out")]) == 1
    assert "has no stressed runs" in capsys.readouterr().err
