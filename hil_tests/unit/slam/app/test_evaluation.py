"""Numbers of a run whose errors are known: perfect, offset, and without any landmark."""

import numpy as np
import pytest

from slam.app.evaluation import NEES_AT, summarise
from slam.app.runner import RunRecord
from slam.app.summary import Summary
from slam.config import load_preset
from slam.ekf_slam import Belief
from slam.geometry import Mount, Rig
from slam.pipeline import StepResult

N = 201
PERIOD_NS = 200_000_000
LANDMARKS = np.array([[1.0, 1.0], [2.0, 1.1], [50.0, 50.0]])
RIG = Rig(
    mounts=(
        Mount(name="rear", x_m=-0.1, y_m=0.2, yaw_rad=np.pi / 2),
        Mount(name="front", x_m=0.1, y_m=0.2, yaw_rad=np.pi / 2),
    )
)


def run(offset_m: float, drift: float, variance: float) -> Summary:
    """Drive 3 m along x; the estimate is off by a constant and a share of the way in y."""
    truth = np.zeros((N, 3))
    truth[:, 0] = np.linspace(0, 3, N)
    found = LANDMARKS[:2] + np.array([0.0, 0.03])
    results = []
    for k in range(N):
        pose = truth[k] + np.array([0.0, offset_m, 0.0])
        mean = np.concatenate([pose, found.ravel()])
        results.append(
            StepResult(
                t_ns=k * PERIOD_NS,
                odometry_pose=truth[k] + np.array([0.0, drift * (k % 2 - 0.5), 0.0]),
                belief=Belief(
                    mean=mean,
                    covariance=np.eye(len(mean)) * variance,
                    landmark_ids=(0, 1),
                    next_id=2,
                ),
                detections=(),
                fixes=(),
                observations=(),
                associations=(),
                rejected=(),
            )
        )
    record = RunRecord(
        results=tuple(results),
        truth=truth,
        world_from_map=np.zeros(3),
        n_frames=2 * N,
        duration_ns=(N - 1) * PERIOD_NS,
        wall_s=0.5,
    )
    summary = summarise(
        record,
        scene="made_up",
        preset="paper",
        seed=0,
        rig=RIG,
        config=load_preset("paper", "lab"),
        true_landmarks_m=LANDMARKS,
    )
    assert summary is not None
    return summary


def test_a_constant_offset_is_aligned_away_in_the_ate_and_counts_in_nees_and_final_error() -> None:
    summary = run(offset_m=0.05, drift=0.02, variance=0.01)
    assert summary.ate_rmse_m == pytest.approx(0.0, abs=1e-9)
    assert summary.odometry_ate_rmse_m == pytest.approx(0.01, rel=1e-2)
    assert summary.final_error_m == pytest.approx(0.05)
    # 0.05^2 / 0.01, at ten parts of 40 s
    expected = [(40.0 * part, 0.25) for part in NEES_AT]
    np.testing.assert_allclose(summary.nees_pose, expected)
    assert summary.realtime_factor == pytest.approx(80.0)
    assert summary.nis_mean is None


def test_landmarks_are_judged_after_the_trajectorys_alignment_and_only_if_seen() -> None:
    # the map is 30 mm off in y, the path 30 mm too: aligned, nothing is left
    score = run(offset_m=0.03, drift=0.0, variance=0.01).landmarks
    assert (score.true, score.estimated, score.precision, score.recall) == (2, 2, 1.0, 1.0)
    assert score.rmse_m == pytest.approx(0.0, abs=1e-9)
    # the path is right, the map is 30 mm off
    assert run(offset_m=0.0, drift=0.0, variance=0.01).landmarks.rmse_m == pytest.approx(0.03)


def test_a_run_without_a_state_has_no_summary() -> None:
    record = RunRecord(
        results=(),
        truth=np.zeros((0, 3)),
        world_from_map=np.zeros(3),
        n_frames=4,
        duration_ns=0,
        wall_s=1.0,
    )
    config = load_preset("paper", "lab")
    nothing = summarise(
        record,
        scene="s",
        preset="paper",
        seed=0,
        rig=RIG,
        config=config,
        true_landmarks_m=LANDMARKS,
    )
    assert nothing is None
