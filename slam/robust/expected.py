"""What the filter expected of every range that could continue a track."""

from __future__ import annotations

import numpy as np

from slam.robust.continuation import SureLandmarks
from slam.robust.ranges import Antennas
from slam.robust.reports import ExpectedRange
from slam.robust.state import State, rotation


def expected_ranges(state: State, sure: SureLandmarks, antennas: Antennas) -> list[ExpectedRange]:
    """Return the ranges of landmarks that could continue a track, before any is looked at.

    Those of walls are left out: where their echoes come from is no place that could be compared
    with a true landmark's.
    """
    rows = sure.rows
    of_point = np.flatnonzero(rows.landmarks < len(state.landmark_ids))
    landmarks, radars = rows.landmarks[of_point], rows.radars[of_point]
    places = antennas.position_m[radars].tolist()
    points = state.landmarks_m[landmarks] - state.position_m
    return [
        ExpectedRange(
            radar=radar,
            landmark_id=state.landmark_ids[row],
            range_m=range_m,
            variance=variance,
            antenna_m=(place[0], place[1]),
            point_m=(point[0], point[1]),
        )
        for radar, row, range_m, variance, place, point in zip(
            radars.tolist(),
            landmarks.tolist(),
            rows.predicted_m[of_point].tolist(),
            sure.prior.diagonal()[of_point].tolist(),
            places,
            (points @ rotation(state.heading_rad)).tolist(),
            strict=True,
        )
    ]
