"""SLAM on ranges that were recorded instead of frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from slam.detector import Detection
from slam.frames import RadarFrame
from slam.pipeline import PoseAt, Slam, StepResult


class RecordedSlam:
    """Steps a pipeline with recorded detections; frames, if any came along, are for the eye.

    Parameters
    ----------
    slam
        The pipeline.
    detections
        By the time of the scan [ns]; a scan without entry heard nothing.
    """

    def __init__(self, slam: Slam, detections: Mapping[int, Sequence[Detection]]) -> None:
        self._slam = slam
        self._detections = detections
        self.config = slam.config

    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Take in what was detected at a time; return the states that became ready."""
        return self._slam.step_detections(self._detections.get(t_ns, ()), pose_at, t_ns)

    def step_detections(
        self, detections: Sequence[Detection], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Do what the pipeline does."""
        return self._slam.step_detections(detections, pose_at, t_ns)

    def flush(self) -> tuple[StepResult, ...]:
        """Return the states still held back at the end of a run."""
        return self._slam.flush()

    def wall_spans_m(self) -> NDArray[np.float64]:
        """Return the pipeline's stretches of wall, shape (k, 2, 2) [m], map frame."""
        return self._slam.wall_spans_m()
