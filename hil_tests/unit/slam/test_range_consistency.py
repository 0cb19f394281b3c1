"""The NIS of single ranges: what is truly of what is decided by truth, never by the filter."""

import math
from dataclasses import replace

import numpy as np
import pytest

from slam.evaluation import ECHO_LENGTH_M, true_range_nis
from slam.frames import Detection
from slam.paper.ekf import start
from slam.results import PredictedRange, StepResult, UpdateReport

POSE = np.array([1.0, 2.0, math.pi / 2])
"""Body x is world y."""


def expected(landmark_id: int, x_m: float, y_m: float, *, radar: int = 0) -> PredictedRange:
    """Return a landmark believed at (x, y) in the body, seen by an antenna at the body's origin."""
    return PredictedRange(
        radar=radar,
        landmark_id=landmark_id,
        range_m=math.hypot(x_m, y_m),
        variance=9e-6,
        antenna_m=(0.0, 0.0),
        point_m=(x_m, y_m),
    )


def result(ranges: list[tuple[int, float]], *told: PredictedRange) -> StepResult:
    report = UpdateReport(
        continued=(),
        initialised=(),
        seen_again=(),
        merged=(),
        deleted=(),
        nis=0.0,
        dof=0,
        relinearised=False,
        predicted=told,
    )
    seen = [Detection(radar=r, t_ns=0, range_m=z, amplitude=0.01) for r, z in ranges]
    return StepResult(
        t_ns=0,
        odometry_pose=POSE,
        belief=start(),
        detections=tuple(seen),
        report=report,
        range_sigmas_m=(4e-3,) * len(seen),
    )


def world(x_m: float, y_m: float) -> list[float]:
    """Return a point of the body in the world."""
    return [1.0 - y_m, 2.0 + x_m]


def test_the_innovation_is_against_the_prediction_with_both_variances() -> None:
    # Truth at 1.000 m, believed at 1.010 m, measured at 1.004 m: nu = -6 mm, S = (5 mm)^2.
    true_xy = np.array([world(0.0, 1.0)])
    values = true_range_nis(result([(0, 1.004)], expected(7, 0.0, 1.01)), POSE, true_xy)
    assert values == pytest.approx([(6 / 5) ** 2])


def test_a_surprising_range_of_the_landmark_counts_however_far_outside_any_gate() -> None:
    true_xy = np.array([world(0.0, 1.0)])
    far = 1.0 + 0.9 * ECHO_LENGTH_M
    values = true_range_nis(result([(0, far)], expected(7, 0.0, 1.0)), POSE, true_xy)
    assert values == pytest.approx([(0.9 * ECHO_LENGTH_M / 5e-3) ** 2])


@pytest.mark.parametrize(
    ("ranges", "told"),
    [
        ([(0, 1.0 + 1.1 * ECHO_LENGTH_M)], expected(7, 0.0, 1.0)),  # no echo of it
        ([(1, 1.0)], expected(7, 0.0, 1.0)),  # another radar's
        ([(0, 1.0)], expected(7, 0.5, 1.0)),  # a false landmark: no true one within 0.15 m
        ([], expected(7, 0.0, 1.0)),
    ],
)
def test_what_is_no_true_association_is_not_counted(
    ranges: list[tuple[int, float]], told: PredictedRange
) -> None:
    assert true_range_nis(result(ranges, told), POSE, np.array([world(0.0, 1.0)])) == ()


def test_one_echo_between_two_targets_is_of_the_nearer_one_only() -> None:
    true_xy = np.array([world(0.0, 1.0), world(0.3, 1.0)])
    told = expected(7, 0.0, 1.0), expected(8, 0.3, 1.0)
    values = true_range_nis(result([(0, 1.01)], *told), POSE, true_xy)
    assert values == pytest.approx([(10 / 5) ** 2])


def test_ranges_that_the_back_end_was_not_given_are_not_judged() -> None:
    seen = result([(0, 1.02)], expected(7, 0.0, 1.0))
    true_xy = np.array([world(0.0, 1.0)])
    assert true_range_nis(replace(seen, range_sigmas_m=(math.inf,)), POSE, true_xy) == ()


def test_an_empty_world_or_a_result_of_the_paper_has_none() -> None:
    seen = result([(0, 1.0)], expected(7, 0.0, 1.0))
    assert true_range_nis(seen, POSE, np.empty((0, 2))) == ()
    assert true_range_nis(replace(seen, report=None), POSE, np.array([world(0.0, 1.0)])) == ()
