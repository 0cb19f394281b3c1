"""What a session of somebody else's recording says about itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam.app.session import RadarInfo, SessionInfo
from slam.geometry import Mount


@dataclass(frozen=True, slots=True, kw_only=True)
class SlamSettings:
    """How SLAM is to be set; see the fields of `SessionInfo` of these names."""

    preset: str = "robust"
    config_json: str = ""
    wheels: Mapping[str, float] = field(default_factory=dict)


def imported_info(
    source: Path,
    radars: tuple[RadarInfo, ...],
    settings: SlamSettings,
    *,
    time_base: str,
    has_detections: bool = False,
) -> SessionInfo:
    """Return the head of a session made of a file; it is named after the file."""
    return SessionInfo(
        scene=source.resolve().stem,
        preset=settings.preset,
        seed=None,
        radars=radars,
        true_landmarks_m=np.zeros((0, 2)),
        versions={},
        config_json=settings.config_json,
        wheels=settings.wheels,
        simulated=False,
        time_base=time_base,
        has_detections=has_detections,
    )


def imported_radar(
    mount: Mount, *, range_start_m: float, bin_length_m: float, n_bins: int, rate_hz: float
) -> RadarInfo:
    """Return a radar of whose serial number, port and settings nobody told; module metres."""
    return RadarInfo(
        name=mount.name,
        serial="",
        port="",
        x_m=mount.x_m,
        y_m=mount.y_m,
        yaw_rad=mount.yaw_rad,
        range_offset_m=mount.range_offset_m,
        range_start_m=range_start_m,
        bin_length_m=bin_length_m,
        n_bins=n_bins,
        rate_hz=rate_hz,
        settings={},
        phase_offset_rad=mount.phase_offset_rad,
    )
