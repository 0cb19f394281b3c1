"""What the numbers mean: trajectory, landmark and consistency metrics.

Every trajectory error states its alignment. ``ate_rmse_m`` is the one to quote; the ICP numbers
of the paper answer a different question.

From how many poses a landmark must be in view to be observable is part of the metric, not of the
design under test, so these numbers are constants here; field of view and range limits are the
preset's.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from slam.geometry import (
    FieldOfView,
    Rig,
    align_se2,
    between,
    compose,
    has_moved,
    transform,
    wrap_angle,
    wrap_angles,
)
from slam.results import Association, StepResult

Array = NDArray[np.float64]

LANDMARK_MATCH_M = 0.15
_ICP_GATE_M = 0.5
_ICP_ITERATIONS = 100
# A share of a variance (of a unit one) that is rounding, and an error [m, rad] that is.
_ROUNDING_VARIANCE = 1e-12
_ROUNDING_ERROR = 1e-9
# Half of a pulse's width at half height: what lies farther from a target is not an echo of it.
ECHO_LENGTH_M = 0.06
# As many poses as the paper wants observations of a landmark (min_opc) ...
MIN_POSES = 9
# ... and two poses are distinct if the paper would collect both (min_disp).
DISTINCT_M = 5e-3
DISTINCT_RAD = 0.1


def associate_times(
    estimate_ns: NDArray[np.int64], reference_ns: NDArray[np.int64], tolerance_ns: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return index pairs of stamps that belong together, each stamp used at most once.

    Stamps are strictly increasing [ns], those of a pair no farther apart than the tolerance.
    """
    if len(estimate_ns) == 0 or len(reference_ns) == 0:
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    after = np.searchsorted(reference_ns, estimate_ns)
    left, right = np.maximum(after - 1, 0), np.minimum(after, len(reference_ns) - 1)
    to_left = np.abs(estimate_ns - reference_ns[left])
    to_right = np.abs(estimate_ns - reference_ns[right])
    nearest = np.where(to_left <= to_right, left, right)
    difference = np.minimum(to_left, to_right)
    # The closest estimate keeps a reference that two of them claim.
    order = np.lexsort((difference, nearest))
    rows = order[difference[order] <= tolerance_ns]
    _, firsts = np.unique(nearest[rows], return_index=True)
    estimate_rows = np.sort(rows[firsts])
    return estimate_rows, nearest[estimate_rows]


def rmse_m(estimate_xy: Array, reference_xy: Array) -> float:
    """Return the root mean square distance of rows that belong together, not aligned."""
    _check_rows(estimate_xy, reference_xy)
    return math.sqrt(float(np.mean(np.sum((estimate_xy - reference_xy) ** 2, axis=1))))


def ate_rmse_m(estimate_xy: Array, reference_xy: Array) -> float:
    """Return the absolute trajectory error: RMS distance after SE(2) alignment without scale.

    Both have shape (n, 2) [m]; rows belong together by time.
    """
    _check_rows(estimate_xy, reference_xy)
    return rmse_m(transform(align_se2(estimate_xy, reference_xy), estimate_xy), reference_xy)


def ate_rotation_rmse_rad(estimate: Array, reference: Array) -> float:
    """Return the RMS error of heading after the alignment of ``ate_rmse_m``; shapes (n, 3)."""
    turn_rad = align_se2(estimate[:, :2], reference[:, :2])[2]
    errors_rad = wrap_angles(estimate[:, 2] + turn_rad - reference[:, 2])
    return math.sqrt(float(np.mean(errors_rad**2)))


def relative_pose_errors(estimate: Array, reference: Array, delta_m: float) -> Array:
    """Return the error of each motion over ``delta_m`` of the reference's way, shape (k, 3).

    Poses (n, 3) belong together by time. A motion begins where the one before ends, as in evo
    (``evo_rpe --delta_unit m --pairs_from_reference``). Of the motions Q of the reference and P of
    the estimate the error is Q^-1 P (Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM
    Systems", IROS 2012): dx, dy [m] and turn [rad].
    """
    ends, way_m = [0], 0.0
    for row, step_m in enumerate(np.hypot(*np.diff(reference[:, :2], axis=0).T).tolist(), start=1):
        way_m += step_m
        if way_m >= delta_m:
            ends.append(row)
            way_m = 0.0
    errors = [
        between(between(reference[i], reference[j]), between(estimate[i], estimate[j]))
        for i, j in pairwise(ends)
    ]
    return np.array(errors).reshape(-1, 3)


def icp_ate_rmse_m(estimate_xy: Array, reference_xy: Array) -> float:
    """Return the RMS distance of the ICP-aligned points to the nearest reference points [m].

    One reading of the paper's "RMS ATE after ICP". Time plays no part, so drift along the path
    costs nothing. Both have shape (n, 2) [m], rows together by time, *both in their start frames*:
    ICP begins with the two start poses on each other.
    """
    _check_rows(estimate_xy, reference_xy)
    aligned = transform(icp_align_se2(estimate_xy, reference_xy), estimate_xy)
    distances, _ = _nearest(KDTree(reference_xy), aligned)
    return math.sqrt(float(np.mean(distances**2)))


def icp_align_se2(estimate_xy: Array, reference_xy: Array) -> Array:
    """Return the rigid motion, shape (3,), found by point-to-point ICP from the identity.

    Points farther than 0.5 m from any reference point do not pull. Shapes (n, 2) and (m, 2) [m].
    """
    tree = KDTree(reference_xy)
    pose, previous = np.zeros(3), math.inf
    for _ in range(_ICP_ITERATIONS):
        moved = transform(pose, estimate_xy)
        distances, neighbours = _nearest(tree, moved)
        close = distances <= _ICP_GATE_M
        if not close.any():
            break
        residual = float(np.mean(distances[close] ** 2))
        if previous - residual <= 1e-9 * residual:
            break
        previous = residual
        pose = compose(align_se2(moved[close], reference_xy[neighbours[close]]), pose)
    return pose


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkScore:
    """How a map compares with the landmarks that were there to be found.

    Field names are those of summary.json.
    """

    # Numbers of true landmarks, and of those that the radars could range often enough; None if
    # unknown
    true: int | None
    observable: int | None
    estimated: int
    # Share of the estimates that match a true landmark or a corner one to one within 0.15 m, and
    # share of the observable landmarks that are matched; None where the denominator is 0
    precision: float | None
    recall: float | None
    duplicates: int  # further estimates within 0.15 m of a matched true landmark or corner
    rmse_m: float | None  # RMS distance of the matches; None without any


def landmark_metrics(
    estimated_xy: Array,
    true_xy: Array,
    alignment: Array,
    observable: NDArray[np.bool_],
    corners_xy: Array | None = None,
) -> LandmarkScore:
    """Return how well estimated landmarks (n, 2), map frame, match true ones (m, 2), world frame.

    ``alignment`` (3,) is the *trajectory's* (``align_se2`` of its positions): the map is not fitted
    to the landmarks it is judged by. Every true landmark may be matched; ``observable`` (m,) marks
    those that must be (``observable_landmarks``): only they count in recall. ``corners_xy`` (k, 2)
    are ends and corners of walls and boxes, which echo like points: what matches no landmark may
    match one of those that are further than 0.15 m from every landmark.
    """
    n, m = len(estimated_xy), len(true_xy)
    placed = transform(alignment, estimated_xy) if n else np.empty((0, 2))
    distances = _distances(placed, true_xy)
    rows, columns = _one_to_one(distances)
    others = np.setdiff1d(np.arange(n), rows)
    errors_m = distances[rows, columns]
    beside = distances[others][:, columns] <= LANDMARK_MATCH_M
    if corners_xy is not None:
        apart = (_distances(corners_xy, true_xy) > LANDMARK_MATCH_M).all(axis=1)
        to_corners = _distances(placed[others], corners_xy[apart])
        corner_rows, corners = _one_to_one(to_corners)
        errors_m = np.concatenate([errors_m, to_corners[corner_rows, corners]])
        beside = np.hstack([beside, to_corners[:, corners] <= LANDMARK_MATCH_M])
        beside = np.delete(beside, corner_rows, axis=0)
    expected = int(observable.sum())
    return LandmarkScore(
        true=m,
        observable=expected,
        estimated=n,
        precision=len(errors_m) / n if n else None,
        recall=int(observable[columns].sum()) / expected if expected else None,
        duplicates=int(beside.any(axis=1).sum()),
        rmse_m=math.sqrt(float(np.mean(errors_m**2))) if len(errors_m) else None,
    )


def _distances(some_xy: Array, others_xy: Array) -> Array:
    """Return the distances between points (n, 2) and others (m, 2), shape (n, m)."""
    return np.asarray(np.linalg.norm(some_xy[:, None, :] - others_xy[None, :, :], axis=2))


def _one_to_one(distances: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns matched within 0.15 m: as many as can be, at the least distance."""
    close = distances <= LANDMARK_MATCH_M
    rows, columns = linear_sum_assignment(np.where(close, distances, 1e6))
    kept = close[rows, columns]
    return rows[kept], columns[kept]


def nees_pose(estimate: Array, covariance: Array, truth: Array) -> float:
    """Return the normalised estimation error squared of a pose (3 dof), not aligned.

    ``e^T P^-1 e``, both poses in the start frame. A direction without variance adds nothing if the
    error in it is rounding, and makes the result inf if not.
    """
    error = np.array(
        [estimate[0] - truth[0], estimate[1] - truth[1], wrap_angle(estimate[2] - truth[2])]
    )
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    varies = sigma > 0.0
    if np.any(np.abs(error[~varies]) > _ROUNDING_ERROR):
        return math.inf
    # In units of sigma, so that metres and radians do not decide what is small.
    sigma = sigma[varies]
    correlation = covariance[varies][:, varies] / np.outer(sigma, sigma)
    variances, axes = np.linalg.eigh(correlation)
    squared = (axes.T @ (error[varies] / sigma)) ** 2
    certain = variances <= _ROUNDING_VARIANCE
    if np.any(squared[certain] > _ROUNDING_VARIANCE):
        return math.inf
    return float(np.sum(squared[~certain] / variances[~certain]))


def _nearest(tree: KDTree, points: Array) -> tuple[Array, NDArray[np.intp]]:
    distances, rows = tree.query(points)
    return np.asarray(distances, dtype=np.float64), np.asarray(rows, dtype=np.intp)


def _check_rows(estimate_xy: Array, reference_xy: Array) -> None:
    if estimate_xy.shape != reference_xy.shape or estimate_xy.shape[1:] != (2,):
        raise ValueError(
            f"trajectories must both have shape (n, 2), got {estimate_xy.shape} and "
            f"{reference_xy.shape}; associate them by time first"
        )
    if len(estimate_xy) == 0:
        raise ValueError("trajectories have no common stamps")


def true_range_nis(result: StepResult, true_pose: Array, true_xy: Array) -> tuple[float, ...]:
    """Return the NIS (1 dof) of every range of the robust pipeline that is truly of a landmark.

    The back end reports its predicted ranges, made before it looked at any. Ground truth decides
    the rest: a landmark of the map belongs to the true one nearest to it as seen from the robot,
    within 0.15 m; of the detections the one nearest to that target's true range is of it, if no
    farther than half a pulse, and if no other predicted target is nearer to it. Ranges that were
    left out as unfit are not judged.

    ``true_pose`` (3,) is that at ``result.t_ns``, ``true_xy`` (m, 2) all true landmarks, world
    frame.
    """
    if result.report is None or not result.report.predicted or not len(true_xy):
        return ()
    expected = result.report.predicted
    points = transform(true_pose, np.array([each.point_m for each in expected]))
    antennas = transform(true_pose, np.array([each.antenna_m for each in expected]))
    gaps = np.linalg.norm(points[:, None] - true_xy[None], axis=2)
    origins = np.argmin(gaps, axis=1)
    known = gaps[np.arange(len(expected)), origins] <= LANDMARK_MATCH_M
    true_ranges = np.linalg.norm(true_xy[origins] - antennas, axis=1)
    # By radar and detection: how far it is from the nearest target, and that target's row.
    owners: dict[int, tuple[float, int]] = {}
    detections = result.detections
    for row in np.flatnonzero(known).tolist():
        radar, range_m = expected[row].radar, float(true_ranges[row])
        found = min(
            (
                (abs(detection.range_m - range_m), index)
                for index, detection in enumerate(detections)
                if detection.radar == radar
            ),
            default=None,
        )
        if found is not None and found[0] <= ECHO_LENGTH_M:
            owners[found[1]] = min(owners.get(found[1], (np.inf, -1)), (found[0], row))
    values = []
    for index, (_, row) in owners.items():
        sigma_m = result.range_sigmas_m[index]
        if np.isfinite(sigma_m):
            innovation = detections[index].range_m - expected[row].range_m
            values.append(innovation**2 / (expected[row].variance + sigma_m**2))
    return tuple(values)


class TrueAssociationNis:
    """Collects the NIS of every observation against the landmark it is truly of, before gating.

    Ground truth decides the *origin* of an observation: the true landmark nearest to where the true
    pose puts it, within 0.15 m, or clutter. A landmark of the map belongs to the origin that more
    than half of its observations so far, its first included, came from. Of several that belong to
    one true landmark, the one with most observations of it counts.

    An observation is judged before it is counted and whatever the filter made of it, so a tight
    gate cannot improve the numbers. One of clutter, or of a true landmark that no landmark of the
    map belongs to at that moment, is not counted, since it has no innovation.

    ``true_xy`` has shape (m, 2) [m], all true landmarks, world frame.
    """

    def __init__(self, true_xy: Array) -> None:
        self._true_xy = true_xy
        # By landmark id: how many of its observations came from each origin, None for clutter.
        self._origins: dict[int, Counter[int | None]] = {}

    def add(self, result: StepResult, true_pose: Array) -> tuple[float, ...]:
        """Return the NIS (2 dof) of this state's observations of landmarks already in the map.

        ``true_pose`` has shape (3,), world frame, at ``result.t_ns``. Call it for every result, in
        order.
        """
        values = []
        for observation, association in zip(result.observations, result.associations, strict=True):
            origin = self._origin(true_pose, np.array([observation.x_m, observation.y_m]))
            if origin is not None:
                row = self._row_of(origin, association)
                if row is not None:
                    values.append(float(association.mahalanobis_sq[row]))
            self._origins.setdefault(association.landmark_id, Counter())[origin] += 1
        return tuple(values)

    def _origin(self, true_pose: Array, body_xy: Array) -> int | None:
        if len(self._true_xy) == 0:
            return None
        distances = np.linalg.norm(self._true_xy - transform(true_pose, body_xy), axis=1)
        nearest = int(np.argmin(distances))
        return nearest if distances[nearest] <= LANDMARK_MATCH_M else None

    def _row_of(self, origin: int, association: Association) -> int | None:
        """Return the candidate that is the true landmark's own, the older of two."""
        best, most = None, 0
        for row, landmark_id in enumerate(association.candidate_ids):
            origins = self._origins.get(landmark_id)
            if origins is None:
                continue
            own = origins[origin]
            if own > most and 2 * own > origins.total():
                best, most = row, own
        return best


def observable_landmarks(
    rig: Rig, poses: Array, landmarks_xy: Array, field: FieldOfView
) -> NDArray[np.bool_]:
    """Return which landmarks some radar could range at nine or more poses, shape (m,).

    It need not be the same radar at all of them. Poses less than 5 mm and 0.1 rad from the last
    distinct one count with it, so standing still adds nothing. ``poses`` (n, 3) are true poses in
    time order, frame of the landmarks, (m, 2) [m]; ``field`` is that of every radar.
    """
    kept: list[Array] = []
    for pose in poses:
        if not kept or has_moved(kept[-1], pose, DISTINCT_M, DISTINCT_RAD):
            kept.append(pose)
    looks = np.zeros(len(landmarks_xy), dtype=np.intp)
    for pose in kept:
        body_xy = transform(between(pose, np.zeros(3)), landmarks_xy)
        looks += np.any([field.contains(mount, body_xy) for mount in rig.mounts], axis=0)
    return np.asarray(looks >= MIN_POSES)
