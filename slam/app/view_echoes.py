"""What a radar sees, as lines of the body frame: its beam, an arc per range, and which counted."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.app.session import RadarInfo
from slam.pipeline import StepResult

_PAPERS_FIELD_OF_VIEW_DEG = 65.0
_PAPERS_REACH_M = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Beams:
    """How wide and how far radars look.

    Attributes
    ----------
    field_of_view_rad
        Opening angle.
    reach_m
        Longest range that the front end looks at.
    n_points
        Points of an arc.
    """

    field_of_view_rad: float
    reach_m: float
    n_points: int = 17

    def arcs(self, radar: RadarInfo, ranges_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where echoes of these ranges (n,) may come from: (n, n_points, 2), body frame."""
        half = self.field_of_view_rad / 2
        angles_rad = radar.yaw_rad + np.linspace(-half, half, self.n_points)
        ray = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)
        antenna = np.array([radar.x_m, radar.y_m])
        arcs: NDArray[np.float64] = antenna + ranges_m[:, None, None] * ray
        return arcs

    def wedge(self, radar: RadarInfo) -> NDArray[np.float64]:
        """Return the closed outline of the beam, shape (n_points + 2, 2), body frame."""
        antenna = np.array([[radar.x_m, radar.y_m]])
        (rim,) = self.arcs(radar, np.array([self.reach_m]))
        return np.concatenate([antenna, rim, antenna])


def beams_of(config_json: str) -> Beams:
    """Return how SLAM was told the radars look; as in the paper where it is not recorded."""
    settings = json.loads(config_json) if config_json else {}
    table = settings.get("robust" if settings.get("back_end") == "robust" else "trilateration", {})
    opening_deg = float(table.get("field_of_view_deg", _PAPERS_FIELD_OF_VIEW_DEG))
    reach_m = float(settings.get("detection", {}).get("max_range_m", _PAPERS_REACH_M))
    return Beams(field_of_view_rad=math.radians(opening_deg), reach_m=reach_m)


def used_detections(step: StepResult) -> tuple[bool, ...]:
    """Return for each detection of a state whether it moved the estimate.

    Under the robust back end: it continued the track of a landmark. Under the paper's: it is part
    of a fix of an observation that the outlier filter let through.
    """
    if step.report is None:
        inside = {
            id(detection)
            for observation in step.observations
            for fix in observation.fixes
            for detection in fix.detections
        }
        return tuple(id(detection) in inside for detection in step.detections)
    continued = {(radar, index) for radar, index, _ in step.report.continued}
    given = dict.fromkeys((detection.radar for detection in step.detections), 0)
    flags = []
    for detection, sigma_m in zip(step.detections, step.range_sigmas_m, strict=True):
        if not math.isfinite(sigma_m):  # the back end was not given this one, so does not count it
            flags.append(False)
            continue
        flags.append((detection.radar, given[detection.radar]) in continued)
        given[detection.radar] += 1
    return tuple(flags)
