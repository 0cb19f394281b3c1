"""What a run came to: lost or found again after a carry, confidently wrong, false landmarks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from emulator.scene.scene import Scene
from slam.app.rig.emulated import outlines_m
from slam.app.run.runner import RunRecord
from slam.geometry import Rig, between, transform, wrap_angles
from slam.library.evaluation import LANDMARK_MATCH_M
from slam.live.odometry_track import NS_PER_S
from slam.live.session_records import SessionInfo, Snapshot

LANDMARKS_TO_FIND = 3
"""Landmarks in view that determine a pose on a map of points: two leave its mirror image."""
FOUND_WITHIN_S = 20.0
"""Longest time from then until the pose is right [s]."""
FOUND_M, FOUND_RAD = 0.3, 0.2
"""Largest errors of a right pose [m, rad]; a carry is longer."""
FOUND_FOR_S = 5.0
"""How long a pose must stay right [s], so that chance does not count."""
WRONG_M, WRONG_TAIL = 0.15, 1e-3
"""A position is confidently wrong when it is further off than this [m], and than all but this share
of errors under its own covariance."""

CONFIDENT_M = 0.05
"""Largest standard deviation, in any direction, of a landmark that claims to be known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CarryOutcome:
    """What became of a robot that was set down elsewhere; times are from then on.

    ``three_seen_s`` is when a third landmark had come into view, ``found_s`` when the estimate was
    right again; None where that did not happen until the end of the run.
    """

    three_seen_s: float | None
    found_s: float | None

    @property
    def in_time(self) -> bool | None:
        """Whether it was found in time; None where fewer than three landmarks came into view."""
        if self.three_seen_s is None:
            return None
        return self.found_s is not None and self.found_s - self.three_seen_s <= FOUND_WITHIN_S


def carry_of(
    record: RunRecord,
    down_ns: int,
    info: SessionInfo,
    rig: Rig,
) -> CarryOutcome | None:
    """Return what became of a robot set down at a session time; None if no state follows."""
    states = record.states
    after = np.flatnonzero(states.t_ns >= down_ns)
    if not len(after):
        return None
    since_s = (states.t_ns[after] - down_ns) / NS_PER_S
    truth = states.truth[after]
    landmarks_m, field = info.true_landmarks_m, info.field_of_view
    seen = np.zeros(len(landmarks_m), dtype=bool)
    three_seen_s = None
    for at_s, pose in zip(since_s.tolist(), truth, strict=True):
        body_xy = transform(between(pose, np.zeros(3)), landmarks_m)
        for mount in rig.mounts:
            seen |= field.contains(mount, body_xy)
        if seen.sum() >= LANDMARKS_TO_FIND:
            three_seen_s = at_s
            break
    errors = states.estimate[after] - np.array(
        [between(record.world_from_map, pose) for pose in truth]
    )
    right = (
        ~states.lost[after]
        & (np.hypot(errors[:, 0], errors[:, 1]) <= FOUND_M)
        & (np.abs(wrap_angles(errors[:, 2])) <= FOUND_RAD)
    )
    return CarryOutcome(three_seen_s=three_seen_s, found_s=_begin_s(since_s, right))


def confidently_wrong(
    record: RunRecord,
    carried_ns: tuple[int, int] | None,
    carry: CarryOutcome | None,
) -> float:
    """Return for which share of the states the position was confidently wrong and not lost.

    States from a carry on do not count until `FOUND_WITHIN_S` after a third landmark has come into
    view.
    """
    states = record.states
    truth = np.array([between(record.world_from_map, pose) for pose in states.truth])
    errors = states.estimate[:, :2] - truth[:, :2]
    covariances = states.pose_covariances[:, :2, :2]
    # A pose of no uncertainty, as before the first motion, is right or infinitely far off.
    information = np.linalg.pinv(covariances, hermitian=True)
    squares = np.einsum("ni,nij,nj->n", errors, information, errors)
    counted = np.ones(len(states), dtype=np.bool_)
    if carried_ns is not None:
        begin_ns, down_ns = carried_ns
        seen_s = None if carry is None else carry.three_seen_s
        from_ns = np.inf if seen_s is None else down_ns + (seen_s + FOUND_WITHIN_S) * NS_PER_S
        counted = (states.t_ns < begin_ns) | (states.t_ns >= from_ns)
    is_wrong = (np.hypot(errors[:, 0], errors[:, 1]) > WRONG_M) & (squares > chdtri(2, WRONG_TAIL))
    return float((is_wrong & ~states.lost & counted).mean())


def _begin_s(since_s: NDArray[np.float64], right: NDArray[np.bool_]) -> float | None:
    """Return when the first stretch begins that is right for long enough, or to the end."""
    begin: float | None = None
    for at_s, is_right in zip(since_s.tolist(), right.tolist(), strict=True):
        if not is_right:
            begin = None
        elif begin is None:
            begin = at_s
        elif at_s - begin >= FOUND_FOR_S:
            break
    return begin


def false_landmarks(last: Snapshot, scene: Scene) -> tuple[int, int]:
    """Count the landmarks of the last state that have nothing within 15 cm; in all, and confident.

    Judged in the start frame and not aligned, since that is the frame of the claim: a map turned
    by an error of heading that it does not know of is false, too. Something is a target's surface,
    a wall, or the side of a box.
    """
    false = confident = 0
    for place, covariance in zip(last.landmarks_m, last.landmark_covariances_m2, strict=True):
        if distance_m(scene, transform(last.world_from_map, place)) > LANDMARK_MATCH_M:
            false += 1
            variance = float(np.linalg.eigvalsh(covariance)[-1])
            confident += variance < CONFIDENT_M**2
    return false, confident


def distance_m(scene: Scene, point: NDArray[np.float64]) -> float:
    """Return the distance from a point, shape (2,) [m], world frame, to what reflects."""
    x, y = float(point[0]), float(point[1])
    distances = [
        abs(math.hypot(target.x_m - x, target.y_m - y) - target.radius_m)
        for target in scene.targets
    ]
    for line in outlines_m(scene):
        starts, ways = line[:-1], np.diff(line, axis=0)
        shares = ((point - starts) * ways).sum(axis=1) / (ways**2).sum(axis=1)
        feet = starts + np.clip(shares, 0.0, 1.0)[:, np.newaxis] * ways
        distances.append(float(np.linalg.norm(feet - point, axis=1).min()))
    return min(distances, default=math.inf)
