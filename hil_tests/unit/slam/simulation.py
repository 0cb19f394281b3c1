"""The world of ranges as frames of detections with odometry, for whole pipelines."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil_tests.unit.slam.robust import range_world
from slam.frames import Detection, RadarFrame
from slam.results import PoseAt

Array = NDArray[np.float64]

FRAME_NS = 200_000_000
BIN_LENGTH_M = 299_792_458 / (2 * 23.328e9)


def frame_of(samples: NDArray[Any], **given: Any) -> RadarFrame:  # noqa: ANN401 - its fields
    """Return a frame of RF bins from 0.2 m, of radar 0 at time 0, but for what is given."""
    blank = {
        "radar": 0,
        "t_ns": 0,
        "counter": 0,
        "range_start_m": 0.2,
        "bin_length_m": BIN_LENGTH_M,
    }
    return RadarFrame(samples=samples, **(blank | given))


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
