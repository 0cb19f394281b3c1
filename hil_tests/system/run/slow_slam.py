"""`uwb-slam` with SLAM slowed down: each step sleeps as long as `SLOW_SLAM_S` says, in seconds."""

import os
import sys
import time
from collections.abc import Sequence
from unittest.mock import patch

from slam.app.cli import main
from slam.frames import RadarFrame
from slam.results import PoseAt, StepResult
from slam.robust.pipeline import RobustSlam


class SlowSteps(RobustSlam):
    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        time.sleep(float(os.environ["SLOW_SLAM_S"]))
        return super().step(frames, pose_at, t_ns)


if __name__ == "__main__":
    with patch("slam.library.slam.RobustSlam", SlowSteps):
        sys.exit(main())
