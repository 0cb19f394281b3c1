"""MATLAB files of detections in the layout of the authors' data set."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import savemat

from slam.config import load_preset
from slam.front_end import make_detector
from slam.live.session.reader import RecordedSession
from slam.paper.trilateration import Trilaterator

Array = NDArray[np.float64]


def write_fixes(path: Path, poses: Array, left: Sequence[Array], right: Sequence[Array]) -> None:
    """Write poses (n, 3) [m, rad] and the fixes of both sides, (k, 2) [m], body frame."""
    tables = []
    for states, unwrapped in ((left, False), (right, True)):
        table = np.zeros((len(states), max(5, *map(len, states)), 2))
        for row, points in zip(table, states, strict=True):
            bearing = np.arctan2(points[:, 1], points[:, 0])
            row[: len(points), 0] = 1e3 * np.hypot(points[:, 0], points[:, 1])
            row[: len(points), 1] = bearing % math.tau if unwrapped else bearing
        tables.append(table)
    odometry = poses * [1e3, 1e3, 1.0]
    savemat(path, {"odom": odometry, "obsLHS": tables[0], "obsRHS": tables[1]})


def write_detections(session: RecordedSession, path: Path) -> None:
    """Write what the paper's front end finds in every scan of a session."""
    config, track = load_preset("paper"), session.odometry()
    detector, limits = make_detector(config), config.detection
    ranges_m = limits.min_range_m, limits.max_range_m
    trilaterator = Trilaterator(config.trilateration, session.rig, ranges_m)
    poses: list[Array] = []
    sides: tuple[list[Array], list[Array]] = ([], [])
    for scan in session.scans():
        poses.append(track.pose_at(scan.t_ns))
        found = detector.detect_many(scan.frames, [0.0] * len(scan.frames))
        fixes = trilaterator.locate([one for row in found for one in row], scan.t_ns)
        for side, sign in zip(sides, (1.0, -1.0), strict=True):
            points = [(fix.x_m, fix.y_m) for fix in fixes if sign * fix.y_m > 0.0]
            side.append(np.array(points).reshape(-1, 2))
    write_fixes(path, np.array(poses), *sides)
