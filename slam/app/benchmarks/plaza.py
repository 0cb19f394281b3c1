"""Factor graphs in two dimensions as PyFactorGraph writes them (.pyfg).

One item per line; times in seconds, metres, radians, covariances as upper triangles row by row::

    VERTEX_SE2   time pose x y heading            true pose
    VERTEX_XY    landmark x y                     true place
    EDGE_SE2     time pose pose dx dy turn  c11 c12 c13 c22 c23 c33
    EDGE_RANGE   time pose landmark range variance

Names are a letter and a number; those of landmarks begin with L. Lines of other kinds are refused.
Format: the files of PyFactorGraph and CORA, Marine Robotics Group.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Sequence
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

import numpy as np

from slam.app.benchmarks.data_set import (
    DataSet,
    LandmarkMeasurement,
    Positions,
    Run,
    Sensor,
    steps_of,
)
from slam.app.benchmarks.text_columns import TableRow, found, number_of, read_rows
from slam.config import WheelNoise
from slam.live.errors import AppError
from slam.live.odometry_track import NS_PER_S
from xethru_protocol.validation import shown

_NAME = re.compile(r"[A-Za-z][0-9]{1,18}")
_COLUMNS = {
    "VERTEX_SE2": "[time] [pose] x y heading",
    "VERTEX_XY": "[landmark] x y",
    "EDGE_SE2": "[time] [pose] [pose] dx dy turn c11 c12 c13 c22 c23 c33",
    "EDGE_RANGE": "[time] [pose] [landmark] range variance",
}

SENSOR = Sensor(
    wheels=WheelNoise(
        along_m_per_sqrt_m=0.05,
        across_m_per_sqrt_m=0.02,
        heading_rad_per_sqrt_m=0.01,
        heading_rad_per_rad=0.02,
        scale_sigma=0.02,
        turn_scale_sigma=0.02,
        curvature_sigma_rad_per_m=0.005,
        floor_m=1e-4,
        floor_rad=1e-4,
    ),
    min_range_m=0.0,
    max_range_m=150.0,
    field_of_view_rad=2.0 * math.pi,
    detection_probability=0.9,
    clutter=0.01,
    least_move_m=0.0,
    least_turn_rad=0.0,
    shift_m=0.5,
    neighbourhood_m=10.0,
    source="ranges as the file says, about 0.5 m; wheel encoders and a fibre-optic gyro: two "
    "hundredths in distance and turn. Covariances of EDGE_SE2 are not used: they are the same for "
    "every step, also where the robot stands",
)


def read_data_set(folder: Path) -> DataSet:
    """Read all drives of a folder, one per .pyfg file."""
    runs = tuple(read_run(path) for path in found(folder, "*.pyfg"))
    title = "Plaza: a mower among four radio beacons"
    return DataSet(title=title, sensor=SENSOR, runs=runs)


def read_run(path: Path) -> Run:
    """Return the drive that a graph holds.

    A range belongs to its pose; the time of the edge is not used. Raises AppError that names a
    damaged line, or a name that no line defines, or if the poses do not form a single chain.
    """
    rows = read_rows(path, _COLUMNS)
    poses, landmarks = _defined(rows, "VERTEX_SE2"), _defined(rows, "VERTEX_XY")
    odometry: list[TableRow] = []
    seen: dict[str, list[LandmarkMeasurement]] = defaultdict(list)
    for row in rows:
        if not row.kind.startswith("EDGE"):
            continue
        time, first, second = row.names
        _stamp_ns(row, time)
        ends = poses if row.kind == "EDGE_SE2" else landmarks
        for name, known in ((first, poses), (second, ends)):
            if name not in known:
                other = "pose" if name in poses else "landmark"
                is_there = name in poses or name in landmarks
                raise row.error(
                    f"{name} is a {other}, which no {row.kind} is used of"
                    if is_there
                    else f"no line defines {shown(name)}"
                )
        if row.kind == "EDGE_SE2":
            odometry.append(row)
            continue
        range_m, variance = row.values
        if variance <= 0.0:
            raise row.error("its covariance is not positive")
        label, sigma_m = int(second[1:]), math.sqrt(variance)
        seen[first].append(LandmarkMeasurement(range_m=range_m, range_sigma_m=sigma_m, label=label))
    if not odometry:
        raise AppError(f"{path}: holds no EDGE_SE2; a drive has odometry")
    names = [odometry[0].names[1], *(row.names[2] for row in odometry)]
    if [row.names[1] for row in odometry] != names[:-1] or len(set(names)) != len(poses):
        raise AppError(f"{path}: its EDGE_SE2 must be a chain through all poses of one robot")
    stamps = [_stamp_ns(poses[name], poses[name].names[0]) for name in names]
    if any(b <= a for a, b in pairwise(stamps)):
        raise AppError(f"{path}: the times of its poses do not increase along EDGE_SE2")
    increments = [np.zeros(3), *(np.array(row.values[:3]) for row in odometry)]
    return Run(
        name=path.stem,
        steps=steps_of(names, stamps, increments, seen),
        truth=Positions(
            t_ns=np.array(stamps, dtype=np.int64),
            xy_m=np.array([poses[name].values[:2] for name in names]),
        ),
    )


def _defined(rows: Sequence[TableRow], kind: str) -> dict[str, TableRow]:
    """Return the rows of a kind of vertex by their names."""
    of_names: dict[str, TableRow] = {}
    for row in rows:
        if row.kind == kind:
            name = row.names[-1]
            if not _NAME.fullmatch(name):
                raise row.error("a name must be a letter and a number, such as A0")
            if name in of_names:
                raise row.error(f"{name} is defined twice")
            of_names[name] = row
    return of_names


def _stamp_ns(row: TableRow, word: str) -> int:
    try:
        if abs(number_of(word)) >= 2**63 / NS_PER_S:
            raise ValueError(f"{shown(word)} must be a time in seconds")
    except ValueError as error:
        raise row.error(error) from None
    return round(Decimal(word) * NS_PER_S)
