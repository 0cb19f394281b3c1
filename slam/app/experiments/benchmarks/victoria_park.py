"""Victoria Park: a car with a laser scanner among trees, and GPS.

A folder holds tables without header::

    inputs.dat        time [s]  speed of the left rear wheel [m/s]  steering angle [rad]
    measurements.dat  time [s]  range [m]  bearing [rad]  diameter [m]     of trunks in one scan
    gps.dat           time [s]  x [m]  y [m]                               where there was reception

The bearing is counted from the right of the car, so that straight ahead is pi/2. With the speed v
of the left rear wheel, the steering angle a, the wheelbase L and the distance H of that wheel from
the middle of the axle, the axle moves with u = v / (1 - tan(a) H / L) and turns with w = u tan(a) /
L. The body frame here is the laser's, at (A, B) from the middle of the axle: it moves with (u - B
w, A w). Car and model: J. E. Guivant, E. M. Nebot, "Optimization of the Simultaneous Localization
and Map-Building Algorithm for Real-Time Implementation", IEEE Transactions on Robotics and
Automation 17(3), 2001. Trees have no ids.
"""

from __future__ import annotations

import math
from collections import defaultdict
from pathlib import Path as FilePath

import numpy as np

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
    step_times,
)
from slam.app.experiments.benchmarks.tables import bad_line, folder_at, read_table, rows_of
from slam.config import WheelNoise

_L_M, _H_M, _A_M, _B_M = 2.83, 0.76, 3.78, 0.50
_MOST_GAP_S = 0.5
_RANGE_SIGMA_M, _BEARING_SIGMA_RAD = 0.2, math.radians(0.5)
_MOST_STEERING_RAD = 1.2
"""At `atan(L / H)`, 1.31 rad, the left wheel would be the centre of the turn."""

SENSOR = Sensor(
    wheels=WheelNoise(
        along_m_per_sqrt_m=0.05,
        across_m_per_sqrt_m=0.05,
        heading_rad_per_sqrt_m=math.radians(1.0),
        heading_rad_per_rad=0.02,
        scale_sigma=0.1,
        turn_scale_sigma=0.1,
        curvature_sigma_rad_per_m=0.01,
        floor_m=1e-3,
        floor_rad=1e-4,
    ),
    min_range_m=1.0,
    max_range_m=80.0,
    field_of_view_rad=math.pi,
    detection_probability=0.7,
    clutter=1.0,
    least_move_m=1.0,
    least_turn_rad=0.05,
    shift_m=1.0,
    unmapped_per_m2=0.005,
    neighbourhood_m=5.0,
    source="a tenth in distance and turn, a degree per square root of a metre; the centre of a "
    "trunk is uncertain by a part of its width: 20 cm; a step of the laser: half a degree; a tree "
    "that is not in the map on 14 m by 14 m",
)


def read_data_set(folder: FilePath) -> DataSet:
    """Read the folder: one run."""
    folder_at(folder)
    inputs = read_table(folder / "inputs.dat", ("time", "speed", "steering angle"), ascending=True)
    seen = read_table(
        folder / "measurements.dat", ("time", "range", "bearing", "diameter"), ascending=True
    )
    gps = read_table(folder / "gps.dat", ("time", "x", "y"), ascending=True)
    steep = np.flatnonzero(np.abs(inputs[:, 2]) > _MOST_STEERING_RAD)
    if len(steep):
        path = folder / "inputs.dat"
        numbers = [number for number, _ in rows_of(path, "")]
        raise bad_line(path, numbers[int(steep[0])], "no car steers by more than 1.2 rad")
    t_s, first_s, last_s = inputs[:, 0], float(inputs[0, 0]), float(inputs[-1, 0])
    by_time: dict[float, list[Observation]] = defaultdict(list)
    left_out = 0
    for time_s, range_m, bearing_rad, _ in seen.tolist():
        if not first_s <= time_s <= last_s or not 0.0 < range_m <= SENSOR.max_range_m:
            left_out += 1
            continue
        by_time[time_s].append(
            Observation(
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
    steps = [
        Step(t_ns=t_ns, increment=increment, observations=tuple(by_time.get(time_s, ())))
        for time_s, t_ns, increment in zip(
            at_s.tolist(), nanoseconds(at_s).tolist(), increments_of(poses), strict=True
        )
    ]
    run = Run(
        name="victoria-park",
        steps=tuple(steps),
        truth=Path(t_ns=nanoseconds(gps[:, 0]), xy_m=gps[:, 1:3]),
        left_out=left_out,
    )
    return DataSet(
        name="victoria-park",
        title="Victoria Park: a car among trees",
        sensor=SENSOR,
        runs=(run,),
    )
