"""The robust back end on a data set: all that these benchmarks know of it."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fclusterdata
from threadpoolctl import threadpool_limits

from slam.app.benchmarks.data_set import Array, LandmarkMeasurement, Run, Sensor
from slam.geometry import Mount, Rig, compose, has_moved
from slam.robust.association import RangeScan
from slam.robust.branches import Hypotheses
from slam.robust.parameters import (
    BackEndParameters,
    InitialisationRule,
    JumpNoise,
    LagRule,
    MapRule,
    NoiseRule,
    RangeNoise,
    RelinearisationRule,
)
from xethru_protocol.operating_system import StopFlag

_SIGMA_M = 0.1  # of ranges without one; all have one here


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BenchmarkRun:
    """What came out of a run."""

    causal: Array  # (n, 3): the pose of each step as it was known then
    smoothed: Array | None  # (n, 3): all poses solved for at once at the end
    landmarks_m: Array  # (k, 2), map frame
    seconds: float  # processor time


def solve(run: Run, sensor: Sensor, stop: StopFlag, *, with_labels: bool) -> BenchmarkRun:
    """Run all steps through the back end; without labels it must find out what is what itself.

    A scan from where the last one was taken has the same errors once more and is not used; between
    two scans that are used the path follows the odometry.
    """
    began = time.process_time()
    rig = Rig(mounts=(Mount(name="sensor", x_m=0.0, y_m=0.0, yaw_rad=0.0),))
    hypotheses = Hypotheses(rig, parameters_of(sensor))
    causal: list[Array] = []
    moved = np.zeros(3)  # since the last scan that was used
    scan_of: list[int] = []
    moves: list[Array] = []
    stamps_ns: list[int] = []
    with threadpool_limits(limits=1):  # the same numbers on every machine, and faster
        for step in run.steps:
            stop.check()
            moved = compose(moved, step.increment)
            if step.observations and (
                not stamps_ns
                or has_moved(np.zeros(3), moved, sensor.least_move_m, sensor.least_turn_rad)
            ):
                hypotheses.predict(moved)
                hypotheses.update([_scan(step.observations, sensor, with_labels=with_labels)])
                moved = np.zeros(3)
                stamps_ns.append(step.t_ns)
            causal.append(compose(hypotheses.pose, moved))
            scan_of.append(len(stamps_ns))
            moves.append(moved)
        stop.check()
        back_end = hypotheses.best
        solved = back_end.smoothed(np.array(stamps_ns, dtype=np.int64))
    smoothed = None
    if solved is not None:
        poses = np.vstack([np.zeros(3), solved.poses])
        smoothed = np.array([compose(poses[i], by) for i, by in zip(scan_of, moves, strict=True)])
    return BenchmarkRun(
        causal=np.array(causal),
        smoothed=smoothed,
        landmarks_m=back_end.state.landmarks_m[back_end.reported_rows()].copy(),
        seconds=time.process_time() - began,
    )


def parameters_of(sensor: Sensor) -> BackEndParameters:
    """Return the rules of the project for a room, with noise and size of this sensor's world."""
    return BackEndParameters(
        wheels=sensor.wheels,
        ranges=RangeNoise(
            sigma_m=_SIGMA_M,
            common_share=sensor.common_share,
            unmapped_per_m2=sensor.unmapped_per_m2,
            huber_sigmas=2.0,
            offset_sigma_m=sensor.range_offset_sigma_m,
            detection_probability=sensor.detection_probability,
            clutter_per_m=sensor.clutter / sensor.max_range_m,
            field_of_view_rad=sensor.field_of_view_rad,
            min_range_m=sensor.min_range_m,
            max_range_m=sensor.max_range_m,
        ),
        initialisation=InitialisationRule(min_share=sensor.new_share),
        map=MapRule(neighbourhood_m=sensor.neighbourhood_m),
        noise=NoiseRule(aspect_rad=0.0) if sensor.is_optical else NoiseRule(),
        relinearisation=RelinearisationRule(key_m=sensor.shift_m, shift_m=sensor.shift_m),
        jumps=JumpNoise(sigma_m=sensor.jump_sigma_m, sigma_rad=sensor.jump_sigma_rad),
        lag=LagRule(most=0),  # no benchmark reports lagged poses
    )


def _scan(seen: Sequence[LandmarkMeasurement], sensor: Sensor, *, with_labels: bool) -> RangeScan:
    """Return a scan whose observations all have bearings, or none has."""
    has_bearings = any(one.bearing_rad is not None for one in seen)
    if has_bearings and not with_labels and sensor.extent_m:
        seen = grouped(seen, sensor.extent_m)
    bearings = tuple([one.bearing_rad or 0.0 for one in seen])
    bearing_sigmas = tuple([one.bearing_sigma_rad or 0.0 for one in seen])
    return RangeScan(
        radar=0,
        ranges_m=tuple([one.range_m for one in seen]),
        sigmas_m=tuple([one.range_sigma_m for one in seen]),
        bearings_rad=bearings if has_bearings else None,
        bearing_sigmas_rad=bearing_sigmas if has_bearings else None,
        labels=tuple([one.label for one in seen]) if with_labels else None,
    )


def grouped(seen: Sequence[LandmarkMeasurement], extent_m: float) -> list[LandmarkMeasurement]:
    """Return one observation, without a label, of each group of those with range and bearing.

    Those nearer to each other than the extent of a landmark are one group; it is at their mean. As
    any part of the landmark may have been seen, the noise of a point in a disc of that diameter,
    D / 4 along each axis, is added in squares.
    """
    ranges_m = np.array([one.range_m for one in seen])
    bearings = np.array([one.bearing_rad for one in seen], dtype=np.float64)
    points = np.column_stack([ranges_m * np.cos(bearings), ranges_m * np.sin(bearings)])
    group_of = np.ones(1)
    if len(seen) > 1:
        group_of = np.asarray(fclusterdata(points, extent_m, "distance", method="single"))
    spread_m, groups = extent_m / 4.0, list[LandmarkMeasurement]()
    for group in np.unique(group_of).tolist():
        members = np.flatnonzero(group_of == group)
        x_m, y_m = points[members].mean(axis=0).tolist()
        first, range_m = seen[int(members[0])], math.hypot(x_m, y_m)
        groups.append(
            LandmarkMeasurement(
                range_m=range_m,
                range_sigma_m=math.hypot(first.range_sigma_m, spread_m),
                bearing_rad=math.atan2(y_m, x_m),
                bearing_sigma_rad=math.hypot(first.bearing_sigma_rad or 0.0, spread_m / range_m),
            )
        )
    return groups
