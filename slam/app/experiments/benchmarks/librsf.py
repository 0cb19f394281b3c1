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
from pathlib import Path as FilePath

import numpy as np

from slam.app.errors import AppError
from slam.app.experiments.benchmarks.data_set import (
    DataSet,
    Observation,
    Path,
    Run,
    Sensor,
    Step,
    increments_of,
    nanoseconds,
    positions_of,
)
from slam.app.experiments.benchmarks.tables import REMEDY, bad_line, found, number_of, rows_of
from slam.config import WheelNoise

_INPUT, _TRUTH = "_Input.txt", "_GT.txt"
_NUMBERS = {"range2": 7, "odom2diff": 8, "point2": 7}

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


def read_data_set(folder: FilePath) -> DataSet:
    """Read all runs of a folder, by the names of their input files."""
    runs = tuple(read_run(path) for path in found(folder, f"*{_INPUT}"))
    title = "Indoor UWB: a small robot among four modules"
    return DataSet(name="uwb-indoor", title=title, sensor=SENSOR, runs=runs)


def read_run(path: FilePath) -> Run:
    """Read NAME_Input.txt and NAME_GT.txt beside it."""
    ranges: list[tuple[float, Observation]] = []
    odometry: list[list[float]] = []
    for number, kind, values in _measurements(path, ("range2", "odom2diff")):
        if kind == "odom2diff":
            if values[4] <= 0.0:
                raise bad_line(path, number, "half the track must be positive")
            if odometry and values[0] < odometry[-1][0]:
                raise bad_line(path, number, "its time is before that of the odometry before")
            odometry.append(values)
            continue
        time_s, range_m, variance, _, _, module, _ = values
        if variance <= 0.0 or range_m <= 0.0:
            raise bad_line(path, number, "range and variance must be positive")
        label = int(module)
        seen = Observation(range_m=range_m, range_sigma_m=math.sqrt(variance), label=label)
        ranges.append((time_s, seen))
    if len(odometry) < 2:
        raise AppError(f"{path}: holds {len(odometry)} lines of odom2diff, at least 2 are needed")
    truth_path = path.with_name(path.name.removesuffix(_INPUT) + _TRUTH)
    points = [values for _, _, values in _measurements(truth_path, ("point2",))]
    truth = np.array(points)[np.argsort([values[0] for values in points], kind="stable")]
    wheels = np.array(odometry)
    # A velocity is of the time up to its stamp: it holds from the stamp before.
    t_s = np.concatenate([wheels[:1, 0], wheels[:-1, 0]])
    left, right, sideways, half_m = wheels[:, 1], wheels[:, 2], wheels[:, 3], wheels[:, 4]
    at_s = np.unique([*wheels[:, 0].tolist(), *(t for t, _ in ranges)])
    at_s = at_s[(at_s >= wheels[0, 0]) & (at_s <= wheels[-1, 0])]
    poses = positions_of(t_s, (right + left) / 2, sideways, (right - left) / (2.0 * half_m), at_s)
    steps = [
        Step(
            t_ns=t_ns,
            increment=increment,
            observations=tuple(seen for time, seen in ranges if time == time_s),
        )
        for time_s, t_ns, increment in zip(
            at_s.tolist(), nanoseconds(at_s).tolist(), increments_of(poses), strict=True
        )
    ]
    return Run(
        name=path.name.removesuffix(_INPUT),
        steps=tuple(steps),
        truth=Path(t_ns=nanoseconds(truth[:, 0]), xy_m=truth[:, 1:3]),
        left_out=len(ranges) - sum(len(step.observations) for step in steps),
    )


def _measurements(path: FilePath, kinds: tuple[str, ...]) -> list[tuple[int, str, list[float]]]:
    what = f"libRSF text with lines of {' and '.join(kinds)}"
    found_lines = []
    for number, (kind, *words) in rows_of(path, what):
        if kind not in kinds:
            raise bad_line(path, number, f"a line begins with {' or '.join(kinds)}")
        if len(words) != _NUMBERS[kind]:
            raise bad_line(path, number, f"{len(words)} numbers, {kind} has {_NUMBERS[kind]}")
        try:
            found_lines.append((number, kind, [number_of(word) for word in words]))
        except ValueError as error:
            raise bad_line(path, number, error) from None
    if not found_lines:
        raise AppError(f"{path}: holds no measurement; it must be {what}; {REMEDY}")
    return found_lines
