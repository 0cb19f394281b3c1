"""Front ends: raw radar frames in, ranges of echoes out."""

from __future__ import annotations

from slam.config import FrontEnd, SlamConfig
from slam.frames import Detector
from slam.front_end.matched_filter import MatchedFilterDetector
from slam.front_end.paper import PaperDetector


def make_detector(config: SlamConfig) -> Detector:
    if config.detection.front_end is FrontEnd.PAPER:
        return PaperDetector(config.detection)
    return MatchedFilterDetector(config)
