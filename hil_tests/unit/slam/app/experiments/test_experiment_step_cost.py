"""The step-cost experiment: what it times is a whole step, and its numbers are told as they are."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from slam.app.cli import main
from slam.app.experiments.step_cost import StepCost, mapped_state, slope_of, stepper
from slam.geometry import paper_rig
from slam.robust.matching import sure_landmarks
from slam.robust.parameters import ContinuationRule, RangeNoise
from slam.robust.ranges import antennas_of, sides_of, view
from slam.robust.state import Motion


def test_a_step_predicts_and_learns_from_a_landmark_on_each_side() -> None:
    """The covariance is that of a dense filter: every landmark is surer after what two told."""
    state = mapped_state(40)
    before = state.P.full()
    assert np.count_nonzero(before) == before.size, "the covariance is dense"
    step = stepper(state)
    step()
    assert state.position_m[0] == pytest.approx(0.01, abs=1e-4)
    after = state.P.full()
    seen = slice(state.offsets.stop, state.offsets.stop + 4)
    assert (np.diag(after)[seen] < np.diag(before)[seen]).any()
    step()
    assert np.abs(state.position_m).max() < 1e-3, "to and fro"


def test_the_gate_of_a_step_has_something_to_weigh() -> None:
    state, rig = mapped_state(40), paper_rig()
    still = Motion(step_m=np.zeros(2), turn_rad=0.0, covariance=np.zeros((3, 3)), walk_variance=0.0)
    seen = view(state, antennas_of(rig, (), still))
    for side in sides_of(rig):
        sure = sure_landmarks(state, seen, side, RangeNoise(), ContinuationRule())
        assert sure is not None
        assert {0, 1} & set(sure.landmarks.tolist())


def test_the_slope_is_that_of_a_power_law() -> None:
    costs = [
        StepCost(
            n_landmarks=n,
            size=10 + 2 * n,
            step_ms=3e-6 * n**1.7 if n >= 200 else 5.0,
            slowest_ms=1.0,
            at_once_ms=1.0,
            triangle_ms=1.0,
            triangle_gb_per_s=1.0,
        )
        for n in (10, 200, 600, 2000)
    ]
    assert slope_of(costs) == pytest.approx(1.7)
    assert slope_of(costs[:2]) is None


def test_the_experiment_tells_measured_from_quoted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--landmarks", "30", "5", "--repetitions", "1"]
    assert main(["experiment", "step-cost", "--out", str(tmp_path), *arguments]) == 0
    numbers = json.loads((tmp_path / "step-cost.json").read_text())
    assert [row["n_landmarks"] for row in numbers["steps"]] == [5, 30]
    for row in numbers["steps"]:
        assert 0.0 < row["step_ms"] <= row["slowest_ms"]
    assert {row["low_ms"] for row in numbers["quoted"]} == {1604.0, 29.0, 0.4}
    assert numbers["slope"] is None
    assert (tmp_path / "step-cost.png").read_bytes().startswith(b"\x89PNG")
    assert "slowest step" in capsys.readouterr().out


def test_a_map_of_one_landmark_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["experiment", "step-cost", "--out", str(tmp_path), "--landmarks", "1"])
    assert code == 2
    assert "--landmarks 1" in capsys.readouterr().err
