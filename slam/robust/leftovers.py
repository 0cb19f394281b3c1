"""Ranges that continued nothing, kept for a while: what tracklets are made of.

A range is evidence once. What continues a track never comes here, and what a tracklet takes is
gone for every later one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.geometry import compose
from slam.robust.motion import Motion
from slam.robust.ranges import LONGEST_M, Antennas, RangeScan
from slam.robust.state import rotation
from slam.robust.symmetric import Array


@dataclass(frozen=True, slots=True)
class Leftover:
    """One unused range: as measured, its target's label where known, its standard deviation.

    ``alone`` tells whether no other echo overlaps its own.
    """

    range_m: float
    label: int | None
    sigma_m: float
    alone: bool = True


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenFrame:
    """One frame: where the antennas were in the odometry frame, and the ranges still unused.

    Attributes
    ----------
    pose_index
        Which pose of the run it belongs to.
    pose
        shape (3,), odometry frame.
    path_m, turned_rad
        Way and turn so far, always growing.
    antennas
        In the odometry frame.
    unused
        One list per radar; what is taken is removed.
    """

    pose_index: int
    pose: Array
    path_m: float
    turned_rad: float
    antennas: Antennas
    unused: tuple[list[Leftover], ...]


@dataclass(frozen=True, slots=True)
class Slot:
    """One radar's share of one earlier frame, in the body frame of now.

    ``x_m, y_m, yaw_rad`` is the antenna then, ``drift`` the variance [m^2] that the way back
    adds to a range, ``back`` how many frames ago, ``radar`` the radar's index.
    """

    back: int
    radar: int
    x_m: float
    y_m: float
    yaw_rad: float
    drift: float
    unused: list[Leftover]
    antenna_then: tuple[float, float]


class Leftovers:
    """The unused ranges of the last frames, and the way the robot went between them.

    Parameters
    ----------
    capacity
        Number of frames kept.
    sigma_m
        Standard deviation of a range whose scan tells none.
    drift_per_m, drift_per_rad_m
        Standard deviation a range gains per metre of way back, and per radian of turn.
    """

    def __init__(
        self, capacity: int, sigma_m: float, drift_per_m: float, drift_per_rad_m: float
    ) -> None:
        self._sigma_m = sigma_m
        self._frames: deque[SeenFrame] = deque(maxlen=capacity)
        self._bodies: deque[Antennas] = deque(maxlen=capacity)
        self._drift_per_m = drift_per_m
        self._drift_per_rad_m = drift_per_rad_m
        self._pose = np.zeros(3)
        self._path_m = 0.0
        self._turned_rad = 0.0

    def move(self, motion: Motion) -> None:
        """Go on by one step of odometry."""
        step = np.array([motion.step_m[0], motion.step_m[1], motion.turn_rad])
        self._pose = compose(self._pose, step)
        self._path_m += motion.distance_m
        self._turned_rad += abs(motion.turn_rad)

    def clear(self) -> None:
        """Forget all frames: what they held was seen from another place."""
        self._frames.clear()
        self._bodies.clear()

    def keep(
        self,
        pose_index: int,
        antennas: Antennas,
        scans: Sequence[RangeScan],
        used: set[tuple[int, int]],
    ) -> None:
        """Store a frame without the ranges used, given as (radar, index)."""
        unused: tuple[list[Leftover], ...] = tuple([] for _ in antennas.yaw_rad)
        for scan in scans:
            unused[scan.radar].extend(
                Leftover(
                    range_m,
                    scan.label(index),
                    scan.sigma(index, self._sigma_m),
                    scan.is_alone(index),
                )
                for index, range_m in enumerate(scan.ranges_m)
                if (scan.radar, index) not in used and 0.0 < range_m < LONGEST_M
            )
        turn = rotation(self._pose[2])
        self._bodies.append(antennas)
        self._frames.append(
            SeenFrame(
                pose_index=pose_index,
                pose=self._pose,
                path_m=self._path_m,
                turned_rad=self._turned_rad,
                antennas=Antennas(
                    position_m=antennas.position_m @ turn.T + self._pose[:2],
                    yaw_rad=antennas.yaw_rad + self._pose[2],
                    heard=antennas.heard,
                ),
                unused=unused,
            )
        )

    def newest(self) -> SeenFrame:
        """Return the last frame stored."""
        return self._frames[-1]

    def pose_index(self, back: int) -> int:
        """Return the pose that the frame ``back`` frames ago belongs to."""
        return self._frames[-1 - back].pose_index

    def slots(self, radars: Sequence[int], window: int) -> list[list[Slot]]:
        """Return the last frames, newest first, as some radars saw them."""
        now = self._frames[-1]
        R = rotation(now.pose[2])
        frames: list[list[Slot]] = []
        for back in range(min(window, len(self._frames))):
            frame, body = self._frames[-1 - back], self._bodies[-1 - back]
            way, turn = now.path_m - frame.path_m, now.turned_rad - frame.turned_rad
            drift = (self._drift_per_m * way) ** 2 + (self._drift_per_rad_m * turn) ** 2
            places = ((frame.antennas.position_m - now.pose[:2]) @ R).tolist()
            yaws = (frame.antennas.yaw_rad - now.pose[2]).tolist()
            then = body.position_m.tolist()
            frames.append(
                [
                    Slot(
                        back,
                        radar,
                        places[radar][0],
                        places[radar][1],
                        math.remainder(yaws[radar], math.tau),
                        drift,
                        frame.unused[radar],
                        (then[radar][0], then[radar][1]),
                    )
                    for radar in radars
                    if frame.antennas.heard[radar]
                ]
            )
        return frames
