"""Victoria Park: a car with a laser scanner among trees, and GPS.

A folder holds tables without header::

    inputs.dat        time [s]  speed of the left rear wheel [m/s]  steering angle [rad]
    measurements.dat  time [s]  range [m]  bearing [rad]  diameter [m]     of trunks in one scan
    gps.dat           time [s]  x [m]  y [m]                               where there was reception
    victoria_park.txt the drive with ids of trees, as an example of GTSAM; may be absent

The bearing is counted from the right of the car, so that straight ahead is pi/2. With the speed v
of the left rear wheel, the steering angle a, the wheelbase L and the distance H of that wheel from
the middle of the axle, the axle moves with u = v / (1 - tan(a) H / L) and turns with w = u tan(a) /
L. The body frame here is the laser's, at (A, B) from the middle of the axle: it moves with (u - B
w, A w). Car and model: J. E. Guivant, E. M. Nebot, "Optimization of the Simultaneous Localization
and Map-Building Algorithm for Real-Time Implementation", IEEE Transactions on Robotics and
Automation 17(3), 2001.

The trees of measurements.dat have no ids. Those of victoria_park.txt, the same drive, have. It has
an item per line; ids are whole numbers that poses and trees share::

    ODOMETRY  pose  next pose  dx  dy [m]  turn [rad]   covariance (6)
    LANDMARK  pose  tree       x   y [m]                covariance (3)

Each ODOMETRY goes on from the pose where the last one ended; covariances are not used. The poses
are of the middle of the axle, and have no times. As the odometry is that of inputs.dat, the way
until a pose gives its time. The file becomes a run of its own, with a tenth of the observations.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.app.benchmarks.data_set import (
    Array,
    DataSet,
    LandmarkMeasurement,
    Positions,
    Run,
    Sensor,
    nanoseconds,
    positions_of,
    step_times,
    steps_at,
    steps_of,
)
from slam.app.benchmarks.text_columns import (
    REMEDY,
    TableRow,
    check_ascending,
    folder_at,
    read_rows,
    read_table,
)
from slam.config import WheelNoise
from slam.geometry import between, compose
from slam.live.errors import AppError
from xethru_protocol.validation import shown

_GRAPH = "victoria_park.txt"
_GRAPH_COLUMNS = {
    "ODOMETRY": "[pose] [next_pose] dx dy turn c11 c12 c13 c22 c23 c33",
    "LANDMARK": "[pose] [tree] x y c11 c12 c22",
}
_ID = re.compile(r"[0-9]{1,18}")
_L_M, _H_M, _A_M, _B_M = 2.83, 0.76, 3.78, 0.50
_MOST_GAP_S = 0.5
_RANGE_SIGMA_M, _BEARING_SIGMA_RAD = 0.2, math.radians(0.5)
_MOST_APART = 0.01
"""Share by which two ways of one drive may differ in length."""
_MOST_STEERING_RAD = 1.2
"""At `atan(L / H)`, 1.31 rad, the left wheel would be the centre of the turn."""
_MOST_MPS = 25.0
"""The wheels never report more than 7 m/s; the noise of two fixes adds up to 18 m/s to that."""

SENSOR = Sensor(
    is_optical=True,
    wheels=WheelNoise(
        along_m_per_sqrt_m=0.1,
        across_m_per_sqrt_m=0.1,
        heading_rad_per_sqrt_m=math.radians(0.5),
        heading_rad_per_rad=0.05,
        scale_sigma=0.1,
        turn_scale_sigma=0.1,
        curvature_sigma_rad_per_m=0.01,
        floor_m=1e-3,
        floor_rad=1e-4,
    ),
    min_range_m=1.0,
    max_range_m=40.0,
    field_of_view_rad=math.pi,
    detection_probability=0.4,
    clutter=1.0,
    least_move_m=1.0,
    least_turn_rad=0.05,
    shift_m=2.0,
    unmapped_per_m2=0.005,
    neighbourhood_m=5.0,
    source="a tenth in distance and turn, half a degree and 10 cm per square root of a metre; the "
    "centre of a trunk is uncertain by a part of its width: 20 cm; a step of the laser: half a "
    "degree, which a trunk of 30 cm is narrower than beyond 34 m: at 40 m four in ten are seen; "
    "a tree that is not in the map on 14 m by 14 m",
)


def read_data_set(folder: Path) -> DataSet:
    """Read the folder: one run, and one with ids if its file is there."""
    folder_at(folder)
    rows = read_rows(folder / "inputs.dat", {"": "time speed steering_angle"})
    check_ascending(rows)
    for row in rows:
        if abs(row.values[2]) > _MOST_STEERING_RAD:
            raise row.error("no car steers by more than 1.2 rad")
    inputs = np.array([row.values for row in rows])
    seen = read_table(folder / "measurements.dat", "time range bearing diameter", ascending=True)
    gps = read_table(folder / "gps.dat", "time x y", ascending=True)
    t_s, first_s, last_s = inputs[:, 0], float(inputs[0, 0]), float(inputs[-1, 0])
    by_time: dict[float, list[LandmarkMeasurement]] = defaultdict(list)
    left_out = 0
    for time_s, range_m, bearing_rad, _ in seen.tolist():
        if not first_s <= time_s <= last_s or not 0.0 < range_m <= SENSOR.max_range_m:
            left_out += 1
            continue
        by_time[time_s].append(
            LandmarkMeasurement(
                range_m=range_m,
                range_sigma_m=_RANGE_SIGMA_M,
                bearing_rad=bearing_rad - math.pi / 2,
                bearing_sigma_rad=_BEARING_SIGMA_RAD,
            )
        )
    tangent = np.tan(inputs[:, 2])
    axle_mps = inputs[:, 1] / (1.0 - tangent * _H_M / _L_M)
    turn_radps = axle_mps * tangent / _L_M
    at_s = step_times(np.array(sorted(by_time)), first_s, last_s, _MOST_GAP_S)
    forward_mps, left_mps = axle_mps - _B_M * turn_radps, _A_M * turn_radps
    poses = positions_of(t_s, forward_mps, left_mps, turn_radps, at_s)
    truth = truth_of(gps)
    steps = steps_at(at_s, poses, by_time)
    runs = [Run(name="victoria-park", steps=steps, truth=truth, left_out=left_out)]
    if (folder / _GRAPH).exists():
        way_m = np.concatenate([[0.0], np.cumsum(np.abs(axle_mps[:-1]) * np.diff(t_s))])
        runs.append(_read_graph(folder / _GRAPH, t_s, way_m, truth))
    return DataSet(
        title="Victoria Park: a car among trees",
        sensor=SENSOR,
        runs=tuple(runs),
    )


def truth_of(gps: Array) -> Positions:
    """Return the path of fixes, rows of time [s], x and y [m], without impossible ones.

    One is left out if the car would have to be faster than 25 m/s both to get there and to get
    away. (Of the 4466 fixes of the set that is one, 140 m from where the car is.)
    """
    away_m, passed_s = np.hypot(*np.diff(gps[:, 1:3], axis=0).T), np.diff(gps[:, 0])
    fast = np.concatenate([[False], away_m > _MOST_MPS * passed_s, [False]])
    kept = gps[~(fast[:-1] & fast[1:])]
    return Positions(t_ns=nanoseconds(kept[:, 0]), xy_m=kept[:, 1:3])


def _read_graph(path: Path, t_s: Array, way_m: Array, truth: Positions) -> Run:
    """Return the run with ids; ``way_m`` is that of the axle until the times ``t_s``, (n,) each.

    Raises AppError that names a line of another form, or one that does not continue the chain of
    poses.
    """
    increments: list[tuple[float, ...]] = []
    seen: dict[int, list[LandmarkMeasurement]] = defaultdict(list)
    place_of: dict[int, int] = {}  # of a pose along the drive, by its id
    last = -1
    for row in read_rows(path, _GRAPH_COLUMNS):
        first, second = (_id(row, name) for name in row.names)
        if row.kind == "LANDMARK":
            if first not in place_of:
                raise row.error(f"no ODOMETRY before it leads to pose {first}")
            seen[place_of[first]].append(_tree(row, second))
            continue
        if not place_of:
            place_of[first] = 0
        elif first != last:
            raise row.error(f"it begins at pose {first}, the last one ended at {last}")
        if second in place_of:
            raise row.error(f"pose {second} has been there before")
        place_of[second], last = len(place_of), second
        increments.append(row.values[:3])
    if not increments:
        raise AppError(f"{path}: holds no ODOMETRY; {REMEDY}")
    stamps = _stamps_ns(np.array(increments), t_s, way_m, path)
    laser = np.array([_A_M, _B_M, 0.0])
    moved = [np.zeros(3), *(between(laser, compose(np.array(by), laser)) for by in increments)]
    steps = steps_of(range(len(moved)), stamps.tolist(), moved, seen)
    return Run(name="victoria-park-gtsam", steps=steps, truth=truth, is_dense=False)


def _id(row: TableRow, word: str) -> int:
    if not _ID.fullmatch(word):
        raise row.error(f"{shown(word)} must be a whole number")
    return int(word)


def _tree(row: TableRow, label: int) -> LandmarkMeasurement:
    """Return a tree as the laser sees it, from its place in the frame of the axle."""
    x_m, y_m, *_ = row.values
    if x_m == 0.0 and y_m == 0.0:
        raise row.error(f"pose {row.names[0]} sees landmark {label} where it is itself")
    x_m, y_m = x_m - _A_M, y_m - _B_M
    return LandmarkMeasurement(
        range_m=math.hypot(x_m, y_m),
        range_sigma_m=_RANGE_SIGMA_M,
        bearing_rad=math.atan2(y_m, x_m),
        bearing_sigma_rad=_BEARING_SIGMA_RAD,
        label=label,
    )


def _stamps_ns(increments: Array, t_s: Array, way_m: Array, path: Path) -> NDArray[np.int64]:
    """Return when the axle had driven as far as at each pose, (n + 1,), ascending.

    Raises AppError if both ways are not equally long.
    """
    chords_m = np.hypot(increments[:, 0], increments[:, 1])
    arcs_m = chords_m / np.sinc(increments[:, 2] / math.tau)
    driven_m = np.concatenate([[0.0], np.cumsum(arcs_m)])
    if abs(driven_m[-1] - way_m[-1]) > _MOST_APART * way_m[-1]:
        raise AppError(
            f"{path}: its way is {driven_m[-1]:.0f} m, that of inputs.dat {way_m[-1]:.0f} m; both "
            f"must be of the same drive; {REMEDY}"
        )
    # Where the car stands, the last of all times with the same way
    is_last = np.append(np.diff(way_m) > 0.0, True)
    stamps = nanoseconds(np.interp(driven_m, way_m[is_last], t_s[is_last]))
    order = np.arange(len(stamps))
    return np.asarray(np.maximum.accumulate(stamps - order) + order)
