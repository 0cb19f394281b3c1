"""Whether the filter is as sure as it may be: normalised innovations of true associations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.geometry import transform
from slam.metrics import LANDMARK_MATCH_M
from slam.pipeline import StepResult

Array = NDArray[np.float64]


class TrueAssociationNis:
    """Collects the NIS of every observation against the landmark it is truly of, before gating.

    Ground truth decides what an observation is of: the true landmark nearest to where the true
    pose puts it, within 0.15 m. The map's landmark for it is the one first born from it. What the
    filter itself associated plays no part, so a tight gate cannot make the numbers look good.

    Parameters
    ----------
    true_xy
        shape (m, 2) [m], all true landmarks, world frame.
    """

    def __init__(self, true_xy: Array) -> None:
        self._true_xy = true_xy
        self._landmark_of: dict[int, int] = {}

    def add(self, result: StepResult, true_pose: Array) -> tuple[float, ...]:
        """Return the NIS (2 dof) of this state's observations of landmarks already in the map.

        ``true_pose`` has shape (3,), world frame, at ``result.t_ns``. Call it for every result, in
        order: births are learned on the way.
        """
        values = []
        for observation, association in zip(result.observations, result.associations, strict=True):
            origin = self._origin(true_pose, np.array([observation.x_m, observation.y_m]))
            if origin is None:
                continue
            landmark_id = self._landmark_of.get(origin)
            if landmark_id is None:
                if association.is_new:
                    self._landmark_of[origin] = association.landmark_id
            elif landmark_id in association.candidate_ids:
                row = association.candidate_ids.index(landmark_id)
                values.append(float(association.mahalanobis_sq[row]))
        return tuple(values)

    def _origin(self, true_pose: Array, body_xy: Array) -> int | None:
        if len(self._true_xy) == 0:
            return None
        distances = np.linalg.norm(self._true_xy - transform(true_pose, body_xy), axis=1)
        nearest = int(np.argmin(distances))
        return nearest if distances[nearest] <= LANDMARK_MATCH_M else None
