"""The pipelines to choose from: preset ``paper`` runs the paper's, preset ``robust`` ours."""

from __future__ import annotations

from slam.config import BackEnd, SlamConfig, WheelNoise
from slam.frames import Detector
from slam.geometry import Rig
from slam.paper.pipeline import UwbRadarSlam
from slam.results import Slam
from slam.robust.pipeline import RobustSlam


def make_slam(
    config: SlamConfig, rig: Rig, wheels: WheelNoise, detector: Detector | None = None
) -> Slam:
    """Return the pipeline that ``config.back_end`` names.

    ``wheels`` is the robot's odometry noise; preset ``paper`` has numbers of its own. ``detector``
    replaces the front end that the configuration names.
    """
    if config.back_end is BackEnd.ROBUST:
        return RobustSlam(config, rig, wheels, detector)
    return UwbRadarSlam(config, rig, detector)
