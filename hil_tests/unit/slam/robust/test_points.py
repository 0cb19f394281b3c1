"""Scans with ranges and bearings in a small simulated world: the map is found and consistent."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2, multivariate_normal

from slam.config import WheelNoise
from slam.geometry import Mount, Rig, compose, wrap_angle
from slam.library.evaluation import ate_rmse_m
from slam.robust.association import RangeScan, antennas_of, point_view, view
from slam.robust.back_end import RobustBackEnd
from slam.robust.branches import Hypotheses
from slam.robust.initialisation import (
    BodyPoint,
    PointDetection,
    TentativePoint,
    TentativePoints,
)
from slam.robust.parameters import (
    BackEndParameters,
    JumpNoise,
    MapRule,
    RangeNoise,
    RelinearisationRule,
    is_plausible,
)

Array = NDArray[np.float64]

MOUNT = Mount(name="camera", x_m=0.2, y_m=-0.1, yaw_rad=0.4)
WHEELS = WheelNoise(
    along_m_per_sqrt_m=0.02,
    across_m_per_sqrt_m=0.01,
    heading_rad_per_sqrt_m=0.02,
    heading_rad_per_rad=0.02,
    scale_sigma=0.02,
    turn_scale_sigma=0.02,
    curvature_sigma_rad_per_m=0.01,
)
NOISE = RangeNoise(
    sigma_m=0.1,
    bearing_sigma_rad=0.02,
    huber_sigmas=2.0,
    detection_probability=0.8,
    clutter_per_m=0.05,
    field_of_view_rad=2.0,
    min_range_m=0.5,
    max_range_m=8.0,
    unmapped_per_m2=0.05,
)
PARAMETERS = BackEndParameters(
    wheels=WHEELS,
    ranges=NOISE,
    map=MapRule(neighbourhood_m=3.0, view_inset_m=0.3),
    relinearisation=RelinearisationRule(key_m=0.2, shift_m=0.2),
)
LAPS, STEPS = 2, 120


@dataclass(frozen=True, slots=True)
class Step:
    pose: Array
    increment: Array
    scan: RangeScan


def world(seed: int, *, labelled: bool) -> tuple[Array, Iterator[Step]]:
    """Return landmarks (n, 2) and a drive in circles of 4 m among them."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0.0, math.tau, 14, endpoint=False)
    radii = np.where(np.arange(14) % 2, 6.0, 2.2)
    marks = np.column_stack([radii * np.cos(angles), radii * np.sin(angles) + 4.0])
    marks += rng.uniform(-0.3, 0.3, marks.shape)
    s, w = 0.02 * rng.standard_normal(2)
    kappa = 0.01 * rng.standard_normal()

    def drive() -> Iterator[Step]:
        pose, turn = np.zeros(3), math.tau / STEPS
        step = np.array([4.0 * math.sin(turn), 4.0 * (1.0 - math.cos(turn)), turn])
        length = math.hypot(step[0], step[1])
        for _ in range(LAPS * STEPS):
            pose = compose(pose, step)
            noise = rng.standard_normal(3) * np.sqrt(WHEELS.step_variances(length, turn))
            reported = np.append((1.0 + s) * step[:2], (1.0 + w) * turn + kappa * length) + noise
            at = compose(pose, np.array([MOUNT.x_m, MOUNT.y_m, MOUNT.yaw_rad]))
            seen: list[tuple[float, float, int | None]] = []
            for label, mark in enumerate(marks):
                x, y = mark - at[:2]
                r, bearing = math.hypot(x, y), wrap_angle(math.atan2(y, x) - at[2])
                if abs(bearing) < 1.0 and 0.5 < r < 8.0 and rng.random() < 0.8:
                    r, bearing = r + rng.normal(0.0, 0.1), bearing + rng.normal(0.0, 0.02)
                    seen.append((r, bearing, label if labelled else None))
            seen += [
                (rng.uniform(0.5, 8.0), rng.uniform(-1.0, 1.0), None)
                for _ in range(rng.poisson(0.05 * 7.5))
            ]
            yield Step(
                pose,
                reported,
                RangeScan(
                    radar=0,
                    ranges_m=tuple(r for r, _, _ in seen),
                    bearings_rad=tuple(bearing for _, bearing, _ in seen),
                    labels=tuple(label for _, _, label in seen) if labelled else None,
                ),
            )

    return marks, drive()


@pytest.mark.parametrize(
    ("labelled", "n_runs"),
    [
        (True, 2),
        pytest.param(True, 4, marks=pytest.mark.rare),
        pytest.param(False, 4, marks=pytest.mark.rare),
    ],
)
def test_the_map_is_found_and_the_pose_is_as_sure_as_it_says(
    n_runs: int, *, labelled: bool
) -> None:
    """Of the mean NEES of several runs, the band holds 99.9 %."""
    nees: list[float] = []
    for seed in range(n_runs):
        marks, steps = world(seed, labelled=labelled)
        back_end = RobustBackEnd(Rig(mounts=(MOUNT,)), PARAMETERS)
        path, truth, wheels = [], [], [np.zeros(3)]
        for step in steps:
            back_end.predict(step.increment)
            back_end.update([step.scan])
            path.append(back_end.pose)
            truth.append(step.pose)
            wheels.append(compose(wheels[-1], step.increment))
        true = np.array(truth)
        apart = back_end.pose - true[-1]
        apart[2] = wrap_angle(float(apart[2]))
        nees.append(float(apart @ np.linalg.solve(back_end.pose_covariance, apart)))
        error_m = ate_rmse_m(np.array(path)[:, :2], true[:, :2])
        assert error_m < 0.15
        smoothed = back_end.smoothed(np.arange(len(true), dtype=np.int64))
        assert smoothed is not None
        assert ate_rmse_m(smoothed.poses[:, :2], true[:, :2]) < 0.1
        found = smoothed.landmarks_m
        gaps = np.linalg.norm(found[:, None] - marks[None], axis=2)
        assert len(found) == len(marks)
        assert gaps.min(axis=0).max() < 0.4
    total = sum(nees)
    assert chi2.ppf(0.0005, 3 * len(nees)) < total < chi2.ppf(0.9995, 3 * len(nees))


def test_a_detection_is_worth_its_density_over_that_of_false_ones() -> None:
    """In logarithms: N(0; 0, S) of range and bearing where it was expected, and Pd / lambda."""
    rig = Rig(mounts=(MOUNT,))
    back_end = RobustBackEnd(rig, PARAMETERS)
    _, steps = world(1, labelled=False)
    for _, step in zip(range(STEPS), steps, strict=False):
        back_end.predict(step.increment)
        back_end.update([step.scan])
    back_end.predict(np.zeros(3))
    state = back_end.state
    seen = view(state, antennas_of(rig, (), state.calibration, state.mounts_m))
    (row, *_) = np.flatnonzero(seen.inside(NOISE, -0.2, -0.5)[0])
    of = point_view(state, seen, 0, np.array([row]))
    S = of.H[0] @ state.P.block(of.at) @ of.H[0].T
    S += np.diag([NOISE.sigma_m**2, NOISE.bearing_sigma_rad**2])
    range_m, bearing = of.predicted[0].tolist()
    report = back_end.update([RangeScan(radar=0, ranges_m=(range_m,), bearings_rad=(bearing,))])
    ((_, _, landmark_id),) = report.continued
    assert landmark_id == state.landmark_ids[row]
    area = (NOISE.max_range_m - NOISE.min_range_m) * NOISE.field_of_view_rad
    false = max(NOISE.clutter_per_m / NOISE.field_of_view_rad, 1.0 / area)
    expected = float(multivariate_normal.logpdf(np.zeros(2), np.zeros(2), S))
    expected += math.log(NOISE.detection_probability / false)
    assert dict(report.evidence)[landmark_id] == pytest.approx(expected, abs=1e-6)


def drive(
    hypotheses: Hypotheses, seed: int, *, jump_at: int | None = None, jump_rad: float = 0.0
) -> tuple[Array, Array]:
    """Return the path and the true one; in one step the wheels miss a part of the turn."""
    _, steps = world(seed, labelled=False)
    path, truth = [], []
    for number, step in enumerate(steps):
        increment = step.increment
        if number == jump_at:
            increment = increment - np.array([0.0, 0.0, jump_rad])
        hypotheses.predict(increment)
        hypotheses.update([step.scan])
        path.append(hypotheses.pose)
        truth.append(step.pose)
    return np.array(path), np.array(truth)


def test_hypotheses_find_the_map_too() -> None:
    path, truth = drive(Hypotheses(Rig(mounts=(MOUNT,)), PARAMETERS), seed=1)
    assert ate_rmse_m(path[:, :2], truth[:, :2]) < 0.15


@pytest.mark.parametrize(
    ("jumps", "least_m", "most_m"),
    [
        (JumpNoise(sigma_m=0.1, sigma_rad=0.7), 0.0, 0.3),
        pytest.param(JumpNoise(), 1.0, math.inf, marks=pytest.mark.rare),
    ],
    ids=["with", "without"],
)
def test_a_motion_that_the_wheels_do_not_report_is_found(
    jumps: JumpNoise, least_m: float, most_m: float
) -> None:
    """A turn of half a radian in the second lap: the next steps find it, or it stays.

    With hypotheses of a jump the end is where the truth is; without them it is not.
    """
    hypotheses = Hypotheses(Rig(mounts=(MOUNT,)), replace(PARAMETERS, jumps=jumps))
    path, truth = drive(hypotheses, seed=1, jump_at=LAPS * STEPS * 2 // 3, jump_rad=0.5)
    assert least_m < math.hypot(*(path[-1, :2] - truth[-1, :2])) < most_m


def test_the_answers_to_a_question_are_back_ends_of_their_own() -> None:
    """One says that it is new, the other that it is known; neither changes the other."""
    rig = Rig(mounts=(MOUNT,))
    # Far worse wheels: after a gap nothing is certain any more
    wheels = replace(WHEELS, heading_rad_per_sqrt_m=0.2)
    back_end = RobustBackEnd(rig, replace(PARAMETERS, wheels=wheels))
    _, steps = world(1, labelled=False)
    question = None
    for number, step in enumerate(steps):
        back_end.predict(step.increment)
        is_gap = 80 <= number < 110
        back_end.update(
            [replace(step.scan, ranges_m=(), bearings_rad=()) if is_gap else step.scan],
            decide=False,
        )
        question = back_end.question()
        if question is not None and len(question.options) > 1:
            break
        if question is not None:
            back_end.answer(question, question.options[0])
    assert question is not None
    assert len(question.options) > 1
    new = next(one for one in question.options if one.row is None)
    other = back_end.copy()
    asked = other.question()
    assert asked is not None
    assert asked.options == question.options
    before = back_end.pose, list(back_end.state.landmark_ids), back_end.evidence
    assert other.answer(asked, next(one for one in asked.options if one.row is None))
    assert np.array_equal(back_end.pose, before[0])
    assert back_end.state.landmark_ids == before[1]
    assert back_end.evidence == before[2]
    known = next(one for one in question.options if one.row is not None)
    assert back_end.answer(question, known)
    assert len(other.state.landmark_ids) == len(back_end.state.landmark_ids) + 1
    assert other.evidence == before[2] + new.evidence
    assert not np.array_equal(back_end.pose, before[0])


@pytest.mark.parametrize("dof", [1, 2, 7, 40])
def test_one_sum_of_squares_in_a_thousand_is_not_plausible(dof: int) -> None:
    limit = float(chi2.isf(1e-3, dof))
    assert is_plausible(limit - 1e-6, dof)
    assert not is_plausible(limit + 1e-6, dof)
    assert is_plausible(0.0, 0)
    assert not is_plausible(limit + 100.0, 0)


@pytest.mark.parametrize(("probability", "n_found"), [(0.9985, 1), (0.9995, 0)])
def test_detections_that_one_in_a_thousand_points_would_give_are_of_none(
    probability: float, n_found: int
) -> None:
    """Of n detections, a point at rest leaves chi-square of 2 (n - 1) degrees of freedom."""
    n = PARAMETERS.initialisation.min_hits_per_radar
    seen = [
        PointDetection(
            radar=0,
            label=None,
            pose=pose,
            nominal_m=(0.0, 0.0),
            turn_rad=0.0,
            range_m=2.0,
            sigma_m=0.1,
            bearing_rad=0.0,
            bearing_sigma_rad=0.02,
        )
        for pose in range(n)
    ]
    point = BodyPoint(
        point_m=np.array([2.0, 0.0]), covariance=1e-4 * np.eye(2), by_offsets=np.zeros((2, 1))
    )
    points = TentativePoints(PARAMETERS)
    points.keep(
        TentativePoint(point=point, seen=seen, chi_square=float(chi2.ppf(probability, 2 * (n - 1))))
    )
    assert len(points.take_out()) == n_found
