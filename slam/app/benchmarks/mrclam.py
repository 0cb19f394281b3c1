"""MRCLAM: five robots with cameras among 15 cylinders with barcodes.

A folder holds, each with comment lines (#) and columns::

    Barcodes.dat              subject  barcode
    Landmark_Groundtruth.dat  subject  x  y  sigma_x  sigma_y       [m]
    RobotN_Odometry.dat       time [s]  forward [m/s]  turn [rad/s]
    RobotN_Measurement.dat    time [s]  barcode  range [m]  bearing [rad]
    RobotN_Groundtruth.dat    time [s]  x [m]  y [m]  heading [rad]

Subjects with a place in Landmark_Groundtruth.dat are landmarks, others are robots. The robot starts
to drive with its first line of odometry; a velocity holds until the next line. Format: K. Y. K.
Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu, "The UTIAS Multi-Robot Cooperative Localization and
Mapping Dataset", International Journal of Robotics Research 30(8), 2011.
"""

from __future__ import annotations

import math
from collections import defaultdict
from pathlib import Path

import numpy as np

from slam.app.benchmarks.data_set import (
    DataSet,
    LandmarkMeasurement,
    Positions,
    Run,
    Sensor,
    nanoseconds,
    positions_of,
    step_times,
    steps_at,
)
from slam.app.benchmarks.text_columns import REMEDY, folder_at, read_table
from slam.config import WheelNoise
from slam.live.errors import AppError

_BARCODES = "Barcodes.dat"
_LANDMARKS = "Landmark_Groundtruth.dat"
_MOST_GAP_S = 0.25
"""Longest motion of a step."""
_RANGE_SHARE, _BEARING_SIGMA_RAD = 0.04, 0.02
_LEAST_RANGE_SIGMA_M = 0.05

SENSOR = Sensor(
    is_optical=True,
    wheels=WheelNoise(
        along_m_per_sqrt_m=0.05,
        across_m_per_sqrt_m=0.02,
        heading_rad_per_sqrt_m=0.1,
        heading_rad_per_rad=0.1,
        scale_sigma=0.1,
        turn_scale_sigma=0.05,
        curvature_sigma_rad_per_m=0.05,
        floor_m=1e-3,
        floor_rad=1e-3,
    ),
    min_range_m=0.5,
    max_range_m=8.0,
    field_of_view_rad=math.radians(60.0),
    detection_probability=0.3,
    clutter=0.24,
    least_move_m=0.02,
    least_turn_rad=0.03,
    shift_m=0.15,
    common_share=0.95,
    unmapped_per_m2=0.02,
    extent_m=0.5,
    new_share=0.25,
    jump_sigma_m=0.1,
    jump_sigma_rad=0.7,
    neighbourhood_m=3.0,
    source="velocities are commands, not counts of the wheels: a tenth of a way or turn; the "
    "range is from the height of a barcode in a picture: 4 %; a bearing, with the mount of the "
    "camera: 0.02 rad; most of both errors stays as it is while a cylinder is in view; of the "
    "cylinders in view three in ten are read; they stand in groups, 18 cm apart, and without ids "
    "a group is one landmark of half a metre; six of them on 15 m by 8 m, a part of them not "
    "seen yet; no barcode is read where there is none; robots bump into each other: 10 cm and "
    "0.7 rad",
)


def read_data_set(folder: Path) -> DataSet:
    """Read a folder MRCLAM_DatasetN, or all such folders in one."""
    folder_at(folder)
    sets = [folder] if (folder / _BARCODES).is_file() else []
    sets += sorted(each.parent for each in folder.glob(f"*/{_BARCODES}"))
    runs: list[Run] = []
    for each in sets:
        odometry = sorted(each.glob("Robot*_Odometry.dat"))
        runs += [read_run(each, path.name.removesuffix("_Odometry.dat")) for path in odometry]
    if not runs:
        raise AppError(
            f"{folder}: holds no {_BARCODES} with a Robot1_Odometry.dat beside it, nor do its "
            f"folders; {REMEDY}"
        )
    title = "MRCLAM: robots among cylinders"
    return DataSet(title=title, sensor=SENSOR, runs=tuple(runs))


def read_run(folder: Path, robot: str) -> Run:
    """Read the drive of one robot, such as ``Robot1``, without what it saw of other robots."""
    subject_of = {
        int(barcode): int(subject)
        for subject, barcode in read_table(folder / _BARCODES, "subject barcode").tolist()
    }
    places = read_table(folder / _LANDMARKS, "subject x y sigma_x sigma_y")
    landmarks = {int(subject) for subject, *_ in places.tolist()}
    odometry, seen, truth = (
        read_table(folder / f"{robot}_{name}.dat", f"time {columns}", ascending=True)
        for name, columns in (
            ("Odometry", "forward turn_rate"),
            ("Measurement", "barcode range bearing"),
            ("Groundtruth", "x y heading"),
        )
    )
    t_s, first_s, last_s = odometry[:, 0], float(odometry[0, 0]), float(odometry[-1, 0])
    by_time: dict[float, list[LandmarkMeasurement]] = defaultdict(list)
    left_out = 0
    for time_s, barcode, range_m, bearing_rad in seen.tolist():
        subject = subject_of.get(int(barcode))
        if subject not in landmarks or not first_s <= time_s <= last_s or range_m <= 0.0:
            left_out += 1
            continue
        by_time[time_s].append(
            LandmarkMeasurement(
                range_m=range_m,
                range_sigma_m=max(_RANGE_SHARE * range_m, _LEAST_RANGE_SIGMA_M),
                bearing_rad=bearing_rad,
                bearing_sigma_rad=_BEARING_SIGMA_RAD,
                label=subject,
            )
        )
    at_s = step_times(np.array(sorted(by_time)), first_s, last_s, _MOST_GAP_S)
    poses = positions_of(t_s, odometry[:, 1], np.zeros(len(t_s)), odometry[:, 2], at_s)
    return Run(
        name=f"{folder.resolve().name}-{robot}",
        steps=steps_at(at_s, poses, by_time),
        truth=Positions(t_ns=nanoseconds(truth[:, 0]), xy_m=truth[:, 1:3]),
        left_out=left_out,
    )
