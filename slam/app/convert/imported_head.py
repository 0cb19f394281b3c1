"""What describes a session that is made of somebody else's file."""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from slam.app.session.constants import slam_constants
from slam.config import WheelNoise, load_preset
from slam.geometry import Mount
from slam.live.session.description import settings_text
from slam.live.session_records import RadarInfo, SessionInfo


def imported_info(
    source: Path,
    radars: tuple[RadarInfo, ...],
    preset: str,
    *,
    time_base: str,
    has_detections: bool = False,
) -> SessionInfo:
    """Return the head of a session made of a file; it is named after the file."""
    return SessionInfo(
        scene=source.resolve().stem,
        preset=preset,
        seed=None,
        radars=radars,
        true_landmarks_m=np.zeros((0, 2)),
        versions={},
        config_json=settings_text(load_preset(preset)),
        constants=slam_constants(),
        wheels=asdict(WheelNoise()),
        simulated=False,
        time_base=time_base,
        has_detections=has_detections,
    )


def imported_radar(
    mount: Mount, *, range_start_m: float, bin_length_m: float, n_bins: int, rate_hz: float
) -> RadarInfo:
    """Return a radar with unknown serial number, port and settings; module metres."""
    return RadarInfo(
        **{each.name: getattr(mount, each.name) for each in fields(mount)},
        serial="",
        port="",
        range_start_m=range_start_m,
        bin_length_m=bin_length_m,
        n_bins=n_bins,
        rate_hz=rate_hz,
        settings={},
    )
