"""The world of ranges as frames of detections with odometry, for whole pipelines."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil_tests.unit.slam.robust import range_world
from slam.frames import Detection
from slam.results import PoseAt

Array = NDArray[np.float64]

FRAME_NS = 200_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """One simulated run: truth and odometry poses (n, 3), landmarks (m, 2), ranges per frame."""

    truth: Array
    odometry: Array
    landmarks: Array
    detections: list[tuple[Detection, ...]]

    def stamps(self) -> list[int]:
        return [k * FRAME_NS for k in range(len(self.truth))]

    def cut(self, n: int) -> "World":
        return World(
            truth=self.truth[:n],
            odometry=self.odometry[:n],
            landmarks=self.landmarks,
            detections=self.detections[:n],
        )


def simulate(room: range_world.Room, seed: int, *, laps: int = range_world.LAPS) -> World:
    run = range_world.simulate(room, seed, 7.4e-3, laps=laps)
    detections: list[tuple[Detection, ...]] = [()]
    for k, scans in enumerate(run.scans, start=1):
        detections.append(
            tuple(
                Detection(radar=scan.radar, t_ns=k * FRAME_NS, range_m=range_m, amplitude=0.01)
                for scan in scans
                for range_m in sorted(scan.ranges_m)
            )
        )
    return World(
        truth=run.poses,
        odometry=range_world.odometry_path(run.increments),
        landmarks=run.landmarks,
        detections=detections,
    )


def at_rest(pose: Array) -> PoseAt:
    """Return odometry that gives one pose, whatever the time: all radars sample at once."""
    return lambda t_ns: pose
