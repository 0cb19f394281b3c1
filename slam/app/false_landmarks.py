"""A map that is wrong and does not know it: landmarks claimed where nothing stands."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from emulator.scene import Scene
from slam.app.outlines import outlines_m
from slam.app.runner import RunRecord
from slam.geometry import transform
from slam.metrics import LANDMARK_MATCH_M

CONFIDENT_M = 0.05
"""Largest standard deviation, in any direction, of a landmark that claims to be known."""


def false_landmarks(record: RunRecord, scene: Scene) -> tuple[int, int]:
    """Count the landmarks of the last map that have nothing within 15 cm; in all, and confident.

    Judged in the start frame and not aligned, since that is the frame of the claim: a map turned
    by an error of heading that it does not know of is false, too. Something is a target's surface,
    a wall, or the side of a box. None are false where there is no state.
    """
    if not record.results:
        return 0, 0
    belief = record.results[-1].belief
    false = confident = 0
    for row, place in enumerate(belief.landmarks):
        if distance_m(scene, transform(record.world_from_map, place)) > LANDMARK_MATCH_M:
            false += 1
            variance = float(np.linalg.eigvalsh(belief.landmark_covariance(row))[-1])
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
