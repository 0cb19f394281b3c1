"""Front ends: raw radar frames in, ranges of echoes out."""

from __future__ import annotations

from slam.config import FrontEnd, SlamConfig
from slam.frames import Detector
from slam.front_end.matched_filter import MatchedFilterDetector
from slam.front_end.paper import PaperDetector
from slam.geometry import Rig


def make_detector(config: SlamConfig, rig: Rig | None = None) -> Detector:
    """Return the configured front end; pulses that a rig holds are those it begins with."""
    if config.detection.front_end is FrontEnd.PAPER:
        return PaperDetector(config.detection)
    return MatchedFilterDetector(config, () if rig is None else [m.pulse for m in rig.mounts])
