"""Whether the filter is as sure as it may be: normalised innovations of true associations."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from slam.association import Association
from slam.geometry import transform
from slam.metrics import LANDMARK_MATCH_M
from slam.pipeline import StepResult

Array = NDArray[np.float64]

ECHO_LENGTH_M = 0.06
"""Half of a pulse's width at half height: what lies farther from a target is no echo of it."""


def true_range_nis(result: StepResult, true_pose: Array, true_xy: Array) -> tuple[float, ...]:
    """Return the NIS (1 dof) of every range of the robust pipeline that is truly of a landmark.

    The back end tells which ranges it expected, before it looked at any. Ground truth tells the
    rest: a landmark of the map belongs to the true one nearest to it as seen from the robot,
    within 0.15 m; of the detections the one nearest to that target's true range is of it, if no
    farther than half a pulse, and if no other expected target is nearer to it. Gates play no part.
    Ranges that the front end itself called unfit for the back end are not judged.

    Parameters
    ----------
    result
        With a report.
    true_pose
        shape (3,), world frame, at ``result.t_ns``.
    true_xy
        shape (m, 2) [m], all true landmarks, world frame.
    """
    if result.report is None or not result.report.expected or not len(true_xy):
        return ()
    expected = result.report.expected
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

    Ground truth decides what an observation is of, its *origin*: the true landmark nearest to
    where the true pose puts it, within 0.15 m, or clutter. A landmark of the map belongs to the
    origin that more than half of its observations so far, its birth included, came from; so one
    that wrong associations dragged from one true landmark to another changes its owner, and in
    between has none. Of several that belong to one true landmark, the one with most observations
    of it counts.

    The observation itself is judged before it is counted and whatever the filter made of it, so a
    tight gate cannot make the numbers look good. An observation of clutter, or of a true landmark
    that no landmark of the map belongs to at that moment, is not counted: there is nothing it
    could be compared with.

    Parameters
    ----------
    true_xy
        shape (m, 2) [m], all true landmarks, world frame.
    """

    def __init__(self, true_xy: Array) -> None:
        self._true_xy = true_xy
        # By landmark id: how many of its observations came from each origin, None for clutter.
        self._origins: dict[int, Counter[int | None]] = {}

    def add(self, result: StepResult, true_pose: Array) -> tuple[float, ...]:
        """Return the NIS (2 dof) of this state's observations of landmarks already in the map.

        ``true_pose`` has shape (3,), world frame, at ``result.t_ns``. Call it for every result, in
        order: who belongs to whom is learned on the way.
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
        """Return the candidate that is the true landmark's own, the older one of two equals."""
        best, most = None, 0
        for row, landmark_id in enumerate(association.candidate_ids):
            origins = self._origins.get(landmark_id)
            if origins is None:
                continue
            own = origins[origin]
            if own > most and 2 * own > origins.total():
                best, most = row, own
        return best
