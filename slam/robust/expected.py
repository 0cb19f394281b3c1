"""What the filter expected of every range that could continue a track."""

from __future__ import annotations

import numpy as np

from slam.robust.continuation import SureLandmarks
from slam.robust.ranges import Antennas
from slam.robust.reports import ExpectedRange
from slam.robust.state import State, rotation
from slam.robust.symmetric import Array


def expected_ranges(
    state: State, sure: SureLandmarks, antennas: Antennas, feet_m: Array
) -> list[ExpectedRange]:
    """Return the ranges that could continue a track, before any is looked at.

    ``feet_m`` has shape (r, w, 2), map frame: where each radar's echo of each wall comes from.
    """
    rows, ids = sure.rows, state.feature_ids
    places = antennas.position_m[rows.radars].tolist()
    points_m = np.tile(state.landmarks_m, (len(antennas.yaw_rad), 1, 1))
    features = np.concatenate([points_m, feet_m], axis=1)
    points = features[rows.radars, rows.landmarks] - state.position_m
    return [
        ExpectedRange(
            radar=radar,
            landmark_id=ids[row],
            range_m=range_m,
            variance=variance,
            antenna_m=(place[0], place[1]),
            point_m=(point[0], point[1]),
        )
        for radar, row, range_m, variance, place, point in zip(
            rows.radars.tolist(),
            rows.landmarks.tolist(),
            rows.predicted_m.tolist(),
            sure.prior.diagonal().tolist(),
            places,
            (points @ rotation(state.heading_rad)).tolist(),
            strict=True,
        )
    ]
