"""The map as it is told to others: landmarks with their kinds, and walls."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from slam.robust.classification import kinds
from slam.robust.reports import MapLandmark
from slam.robust.state import State


def report_landmarks(
    state: State, rows: Sequence[int], hits: Callable[[int], int]
) -> tuple[MapLandmark, ...]:
    """Return the landmarks in some rows of a state; ``hits`` counts frames by landmark id."""
    points_m = state.landmarks_m[rows]
    covariances = [state.landmark_covariance(row) for row in rows]
    found = kinds(points_m, covariances, state.walls)
    return tuple(
        MapLandmark(
            landmark_id=state.landmark_ids[row],
            position_m=point_m,
            covariance=covariance,
            hits=hits(state.landmark_ids[row]),
            kind=kind,
        )
        for row, point_m, covariance, kind in zip(rows, points_m, covariances, found, strict=True)
    )
