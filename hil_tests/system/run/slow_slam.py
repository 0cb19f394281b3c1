"""`uwb-slam` with SLAM slowed down: each step sleeps as long as `SLOW_SLAM_S` says, in seconds."""

import os
import sys
import time
from collections.abc import Sequence
from typing import Any
from unittest.mock import patch

from slam.app.cli import main
from slam.app.commands import run
from slam.app.run.runner import WrappedSlam
from slam.frames import RadarFrame
from slam.library.slam import make_slam
from slam.results import Pipeline, PoseAt, StepResult


class SlowSlam(WrappedSlam):
    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        time.sleep(float(os.environ["SLOW_SLAM_S"]))
        return self._slam.step(frames, pose_at, t_ns)


def make_slow_slam(*of_slam: Any) -> Pipeline:  # noqa: ANN401 - passed on
    return SlowSlam(make_slam(*of_slam))


if __name__ == "__main__":
    with patch.object(run, "make_slam", make_slow_slam):
        sys.exit(main())
