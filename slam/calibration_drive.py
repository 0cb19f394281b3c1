"""What goes into a calibration and what comes out of it: drive, priors, result."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slam.batch_terms import WheelModel
from slam.calibration_tracks import PathNodes, RangeSet
from slam.geometry import Rig

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_LEAST_STEP_NS = 100_000_000
"""Samples closer than this are joined into one step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationPriors:
    """What is known before the drive, standard deviations.

    Attributes
    ----------
    offset_m
        Range offset of a module.
    mount_m
        Mount position in x and in y: how well the rig was measured.
    reflector_m
        Survey of known reflectors.
    start_m, start_rad
        Start pose among known reflectors; without any, the start is the origin of the map.
    wheels
        The wheel model.
    """

    offset_m: float = 0.03
    mount_m: float = 0.003
    reflector_m: float = 0.001
    start_m: float = 0.1
    start_rad: float = 0.1
    wheels: WheelModel = field(default_factory=WheelModel)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """A recorded drive, ready for calibration.

    Attributes
    ----------
    rig
        Nominal mounts; their range offsets are not removed from the ranges.
    path
        What the wheels said, odometry frame.
    step_sigmas
        Shape (n_nodes - 1, 3), standard deviation of each step's white noise in the body frame:
        along [m], across [m], turn [rad].
    ranges
        All single ranges.
    """

    rig: Rig
    path: PathNodes
    step_sigmas: Array
    ranges: RangeSet


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """What the drive told.

    Attributes
    ----------
    offsets_m, mount_shifts_m
        Shapes (r,) and (r, 2): offset of each radar, and how far its mount is from nominal, x and
        y, body frame.
    covariance_m2
        Shape (3 r, 3 r), [m2]: for each radar its offset, mount x, mount y.
    landmarks_m
        Shape (k, 2), map frame: the body frame at the start, or the frame of known reflectors.
    path
        The most likely path, map frame.
    wheels
        Shape (3,): scale, turn scale, curvature [rad/m].
    landmark
        Shape (n_ranges,): the landmark each range was used for, or UNASSIGNED.
    sigma_m
        Standard deviation of a used range, as found.
    """

    offsets_m: Array
    mount_shifts_m: Array
    covariance_m2: Array
    landmarks_m: Array
    path: PathNodes
    wheels: Array
    landmark: Indices
    sigma_m: float

    @property
    def offset_sigmas_m(self) -> Array:
        """Return the standard deviation of each offset, shape (r,)."""
        result: Array = np.sqrt(np.diag(self.covariance_m2)[0::3])
        return result

    @property
    def mount_sigmas_m(self) -> Array:
        """Return the standard deviations of each mount's x and y, shape (r, 2)."""
        variances = np.diag(self.covariance_m2).reshape(-1, 3)
        result: Array = np.sqrt(variances[:, 1:])
        return result


def make_drive(
    rig: Rig,
    stamps_ns: NDArray[np.int64],
    poses: Array,
    ranges: RangeSet,
    *,
    wheels: WheelModel | None = None,
) -> Drive:
    """Cut odometry into steps for the batch.

    Parameters
    ----------
    rig
        Nominal mounts.
    stamps_ns, poses
        Shapes (n,) and (n, 3): odometry samples, x [m], y [m], heading [rad] in any turn,
        odometry frame.
    ranges
        All single ranges.
    wheels
        The white noise of each sample's step; it adds up over the samples of a node's step.
    """
    model = wheels or WheelModel()
    poses = poses.copy()
    poses[:, 2] = np.unwrap(poses[:, 2])
    variances = np.vstack([np.zeros(3), model.sigmas(steps_of(poses)) ** 2]).cumsum(axis=0)
    chosen = [0]
    for index in range(1, len(stamps_ns)):
        if stamps_ns[index] - stamps_ns[chosen[-1]] >= _LEAST_STEP_NS:
            chosen.append(index)
    if len(chosen) > 1 and chosen[-1] != len(stamps_ns) - 1:
        chosen[-1] = len(stamps_ns) - 1
    return Drive(
        rig=rig,
        path=PathNodes(t_ns=stamps_ns[chosen], poses=poses[chosen]),
        step_sigmas=np.sqrt(np.diff(variances[chosen], axis=0)),
        ranges=ranges,
    )


def steps_of(poses: Array) -> Array:
    """Return each step in the body frame at its start, shape (n - 1, 3): [m], [m], [rad]."""
    step_x, step_y, turn = np.diff(poses, axis=0).T
    cosine, sine = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    return np.column_stack([cosine * step_x + sine * step_y, cosine * step_y - sine * step_x, turn])
