"""Text files of libRSF: a small robot among UWB modules.

``NAME_Input.txt`` and ``NAME_GT.txt`` hold one measurement per line::

    range2     time [s]  range [m]  variance [m^2]  x  y [m] of the module  its id  SNR
    odom2diff  time [s]  left  right  sideways [m/s]  half the track [m]  variances (3)
    point2     time [s]  x  y [m]  covariance (4)                    in NAME_GT.txt

The odometry of a time is the velocity up to then: the robot moves with (left + right) / 2 and turns
with (right - left) / (2 h). The readme of the data set calls the wheels right and left, and h their
distance; libRSF itself reads it as above, and so it agrees with the truth. Format: the data set
Indoor_UWB in libRSF, TU Chemnitz. Lines of other kinds are an error.
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
    steps_at,
)
from slam.app.benchmarks.text_columns import check_ascending, found, read_rows
from slam.config import WheelNoise
from slam.live.errors import AppError

_INPUT, _TRUTH = "_Input.txt", "_GT.txt"
_RANGES = {
    "range2": "time range variance x y module SNR",
    "odom2diff": "time left right sideways half_track v11 v22 v33",
}
_POINTS = {"point2": "time x y c11 c12 c21 c22"}

SENSOR = Sensor(
    # 1 cm/s of each wheel, 15.7 cm apart, every 0.128 s
    wheels=WheelNoise(
        along_m_per_sqrt_m=0.0,
        across_m_per_sqrt_m=0.0,
        heading_rad_per_sqrt_m=0.0,
        heading_rad_per_rad=0.0,
        scale_sigma=0.0,
        turn_scale_sigma=0.0,
        curvature_sigma_rad_per_m=0.0,
        floor_m=9e-4,
        floor_rad=1.15e-2,
    ),
    min_range_m=0.0,
    max_range_m=10.0,
    field_of_view_rad=2.0 * math.pi,
    detection_probability=0.9,
    clutter=0.01,
    least_move_m=0.0,
    least_turn_rad=0.0,
    shift_m=0.1,
    range_offset_sigma_m=0.1,
    neighbourhood_m=1.5,
    source="variances of the file; two-way ranging has an offset of about its standard deviation",
)


def read_data_set(folder: Path) -> DataSet:
    """Read all runs of a folder, by the names of their input files."""
    runs = tuple(read_run(path) for path in found(folder, f"*{_INPUT}"))
    title = "Indoor UWB: a small robot among four modules"
    return DataSet(title=title, sensor=SENSOR, runs=runs)


def read_run(path: Path) -> Run:
    """Read NAME_Input.txt and NAME_GT.txt beside it."""
    rows = read_rows(path, _RANGES)
    odometry = [row for row in rows if row.kind == "odom2diff"]
    seen: dict[float, list[LandmarkMeasurement]] = defaultdict(list)
    for row in rows:
        if row.kind == "odom2diff":
            if row.values[4] <= 0.0:
                raise row.error("half the track must be positive")
            continue
        time_s, range_m, variance, _, _, module, _ = row.values
        if variance <= 0.0 or range_m <= 0.0:
            raise row.error("range and variance must be positive")
        label, sigma_m = int(module), math.sqrt(variance)
        seen[time_s].append(
            LandmarkMeasurement(range_m=range_m, range_sigma_m=sigma_m, label=label)
        )
    check_ascending(odometry)
    if len(odometry) < 2:
        raise AppError(f"{path}: holds {len(odometry)} lines of odom2diff, at least 2 are needed")
    truth_path = path.with_name(path.name.removesuffix(_INPUT) + _TRUTH)
    points = np.array([row.values for row in read_rows(truth_path, _POINTS)])
    truth = points[np.argsort(points[:, 0], kind="stable")]
    wheels = np.array([row.values for row in odometry])
    # A velocity is of the time up to its stamp: it holds from the stamp before.
    t_s = np.concatenate([wheels[:1, 0], wheels[:-1, 0]])
    left, right, sideways, half_m = wheels[:, 1], wheels[:, 2], wheels[:, 3], wheels[:, 4]
    at_s = np.unique([*wheels[:, 0].tolist(), *seen])
    at_s = at_s[(at_s >= wheels[0, 0]) & (at_s <= wheels[-1, 0])]
    poses = positions_of(t_s, (right + left) / 2, sideways, (right - left) / (2.0 * half_m), at_s)
    steps = steps_at(at_s, poses, seen)
    n_ranges = sum(map(len, seen.values()))
    return Run(
        name=path.name.removesuffix(_INPUT),
        steps=steps,
        truth=Positions(t_ns=nanoseconds(truth[:, 0]), xy_m=truth[:, 1:3]),
        left_out=n_ranges - sum(len(step.observations) for step in steps),
    )
