"""Factor graphs in two dimensions as PyFactorGraph writes them (.pyfg).

One item per line; times in seconds, metres, radians, covariances as upper triangles row by row::

    VERTEX_SE2   time pose x y heading            true pose
    VERTEX_XY    landmark x y                     true place
    EDGE_SE2     time pose pose dx dy turn  c11 c12 c13 c22 c23 c33
    EDGE_SE2_XY  time pose landmark x y  c11 c12 c22
    EDGE_RANGE   time pose landmark range variance

Names are a letter and a number; those of landmarks begin with L. Graphs in three dimensions and
priors do not occur on a floor and are an error. Format: the files of PyFactorGraph and
CORA, Marine Robotics Group.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
from pathlib import Path as FilePath

import numpy as np

from slam.app.errors import AppError
from slam.app.experiments.benchmarks.data_set import (
    Array,
    DataSet,
    Observation,
    Path,
    Run,
    Sensor,
    Step,
)
from slam.app.experiments.benchmarks.tables import bad_line, found, number_of, rows_of
from slam.config import WheelNoise

_NAME = re.compile(r"[A-Za-z][0-9]{1,18}")
_NS_PER_S = 10**9
_WHAT = "a factor graph in two dimensions, .pyfg"
_NUMBERS = {"VERTEX_SE2": 3, "VERTEX_XY": 2, "EDGE_SE2": 9, "EDGE_SE2_XY": 5, "EDGE_RANGE": 2}

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """The true place of a pose."""

    t_ns: int
    name: str
    x_m: float
    y_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Edge:
    """A measurement: (dx, dy, turn) of a pose, (x, y) of a landmark, or a range."""

    first: str
    second: str
    values: tuple[float, ...]
    covariance: tuple[float, ...]  # upper triangle, row by row


@dataclass(frozen=True, slots=True, kw_only=True)
class FactorGraph:
    """Poses and edges of a file, each kind in its order."""

    poses: tuple[Pose, ...]
    edges: Mapping[str, tuple[Edge, ...]]  # by kind, such as EDGE_RANGE


def read_pyfg(path: FilePath) -> FactorGraph:
    """Read a graph; AppError names a line that is not part of it, or what is not defined."""
    poses: dict[str, Pose] = {}
    landmarks: set[str] = set()
    edges: dict[str, list[Edge]] = defaultdict(list)
    line_of: dict[str, list[int]] = defaultdict(list)
    for number, (kind, *words) in rows_of(path, _WHAT):
        if kind not in _NUMBERS:
            raise bad_line(path, number, f"{kind[:40]} is not one of {', '.join(_NUMBERS)}")
        try:
            if kind == "VERTEX_XY":
                name, values = words[0] if words else "", words[1:]
                _numbers(kind, values)
                _must_be_new(name, landmarks)
                landmarks.add(name)
                continue
            t_ns = _stamp_ns(words[0] if words else "")
            if kind == "VERTEX_SE2":
                name, values = words[1] if len(words) > 1 else "", words[2:]
                x, y, _ = _numbers(kind, values)
                _must_be_new(name, poses)
                poses[name] = Pose(t_ns=t_ns, name=name, x_m=x, y_m=y)
                continue
            numbers = _numbers(kind, words[3:])
            size = {"EDGE_SE2": 3, "EDGE_SE2_XY": 2, "EDGE_RANGE": 1}[kind]
            edge = Edge(
                first=words[1],
                second=words[2],
                values=numbers[:size],
                covariance=numbers[size:],
            )
            if np.linalg.eigvalsh(matrix_of(edge.covariance)).min() <= 0.0:
                raise ValueError("its covariance is not positive")
            edges[kind].append(edge)
            line_of[kind].append(number)
        except ValueError as error:
            raise bad_line(path, number, error) from None
    for kind, some in edges.items():
        seconds: Container[str] = poses if kind == "EDGE_SE2" else landmarks
        for edge, number in zip(some, line_of[kind], strict=True):
            for name, known in ((edge.first, poses), (edge.second, seconds)):
                if name not in known:
                    raise bad_line(path, number, f"no line defines {name[:40]}")
    return FactorGraph(
        poses=tuple(poses.values()),
        edges={kind: tuple(some) for kind, some in edges.items()},
    )


def _must_be_new(name: str, known: Container[str]) -> None:
    if not _NAME.fullmatch(name):
        raise ValueError("a name must be a letter and a number, such as A0")
    if name in known:
        raise ValueError(f"{name} is defined twice")


def _numbers(kind: str, words: Sequence[str]) -> tuple[float, ...]:
    if len(words) != _NUMBERS[kind]:
        raise ValueError(f"{len(words)} numbers behind the names, {kind} has {_NUMBERS[kind]}")
    return tuple([number_of(word) for word in words])


def _stamp_ns(word: str) -> int:
    if abs(number_of(word)) >= 2**63 / _NS_PER_S:
        raise ValueError(f"{word[:40]} is no time in seconds")
    return round(Decimal(word) * _NS_PER_S)


def matrix_of(triangle: Sequence[float]) -> Array:
    """Return the symmetric matrix of an upper triangle of 1, 3 or 6 numbers, row by row."""
    size = {1: 1, 3: 2, 6: 3}[len(triangle)]
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = triangle
    return np.asarray(matrix + np.triu(matrix, 1).T)


def read_data_set(folder: FilePath) -> DataSet:
    """Read all drives of a folder, one per .pyfg file."""
    runs = tuple(run_of(path, read_pyfg(path)) for path in found(folder, "*.pyfg"))
    title = "Plaza: a mower among four radio beacons"
    return DataSet(name="plaza", title=title, sensor=SENSOR, runs=runs)


def run_of(path: FilePath, graph: FactorGraph) -> Run:
    """Return the drive that a graph holds; AppError if its poses are not one chain.

    A range belongs to its pose; the time of the edge is not used.
    """
    edges = graph.edges.get("EDGE_SE2", ())
    if not edges:
        raise AppError(f"{path}: holds no EDGE_SE2; a drive has odometry")
    names = [edges[0].first, *(edge.second for edge in edges)]
    if [edge.first for edge in edges] != names[:-1] or len(set(names)) != len(graph.poses):
        raise AppError(f"{path}: its EDGE_SE2 are no chain through all poses of one robot")
    pose_of = {pose.name: pose for pose in graph.poses}
    chain = [pose_of[name] for name in names]
    if any(b.t_ns <= a.t_ns for a, b in pairwise(chain)):
        raise AppError(f"{path}: the times of its poses do not increase along EDGE_SE2")
    seen: dict[str, list[Observation]] = defaultdict(list)
    for edge in graph.edges.get("EDGE_RANGE", ()):
        seen[edge.first].append(
            Observation(
                range_m=edge.values[0],
                range_sigma_m=math.sqrt(edge.covariance[0]),
                label=int(edge.second[1:]),
            )
        )
    for edge in graph.edges.get("EDGE_SE2_XY", ()):
        x, y = edge.values
        r = math.hypot(x, y)
        if r == 0.0:
            raise AppError(f"{path}: {edge.first} sees {edge.second} where it is itself")
        G = np.array([[x / r, y / r], [-y / r**2, x / r**2]])
        range_variance, bearing_variance = np.diag(G @ matrix_of(edge.covariance) @ G.T).tolist()
        seen[edge.first].append(
            Observation(
                range_m=r,
                range_sigma_m=math.sqrt(range_variance),
                bearing_rad=math.atan2(y, x),
                bearing_sigma_rad=math.sqrt(bearing_variance),
                label=int(edge.second[1:]),
            )
        )
    increments = [np.zeros(3), *(np.array(edge.values) for edge in edges)]
    return Run(
        name=path.stem,
        steps=tuple(
            Step(t_ns=pose.t_ns, increment=increment, observations=tuple(seen[pose.name]))
            for pose, increment in zip(chain, increments, strict=True)
        ),
        truth=Path(
            t_ns=np.array([pose.t_ns for pose in chain], dtype=np.int64),
            xy_m=np.array([[pose.x_m, pose.y_m] for pose in chain]),
        ),
    )
