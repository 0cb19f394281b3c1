"""A run as the known-association bound sees it: increments, and ranges with their true landmarks.

Each range goes to the true landmark that it fits: nearest in range, in front of the antenna, no
landmark twice in a frame, and within ``gate_sigmas`` standard deviations of the true range. What
fits none is clutter to the bound. Nothing else of the truth gets in.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from slam.app.runner import RunRecord
from slam.detection import Detection
from slam.geometry import Mount, Rig, between, mount_at, wrap_angle, wrap_angles

Array = NDArray[np.float64]

GATE_SIGMAS = 4.0
VIEW_HALF_ANGLE_RAD = 0.82
"""Half of the field of view, 32.5 deg, and 0.25 rad where echoes are weak."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownRange:
    """One range of one true landmark.

    ``motion`` (3,) leads from the pose to where the body was when the radar sampled, as odometry
    tells it; ``sigma_m`` is the standard deviation of ``range_m``.
    """

    radar: int
    landmark: int
    range_m: float
    sigma_m: float
    motion: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownRun:
    """Reported increments, shape (n, 3), each followed by the ranges measured at its end."""

    increments: Array
    ranges: tuple[tuple[KnownRange, ...], ...]


def known_run(
    record: RunRecord,
    rig: Rig,
    true_landmarks_m: Array,
    *,
    range_sigma_m: float,
    offset_sigma_m: float = 0.0,
    gate_sigmas: float = GATE_SIGMAS,
) -> KnownRun:
    """Return the same data that SLAM had, with the ids it had not.

    Parameters
    ----------
    record
        The run; one increment per result, from odometry's zero on.
    rig
        The mounts as SLAM was told of them.
    true_landmarks_m
        Shape (n, 2), world frame.
    range_sigma_m
        Standard deviation of a range in results that do not tell it (``range_sigmas_m``).
    offset_sigma_m
        Standard deviation of each radar's unknown range offset; widens the gate.
    gate_sigmas
        See the module's text.
    """
    stamps_ns = np.array([result.t_ns for result in record.results], dtype=np.float64)
    odometry = _Track(stamps_ns, np.array([result.odometry_pose for result in record.results]))
    truth = _Track(stamps_ns, record.truth)
    increments, ranges = [], []
    last = np.zeros(3)
    for row, result in enumerate(record.results):
        pose = result.odometry_pose
        increments.append(between(last, pose))
        last = pose
        told = result.range_sigmas_m or (range_sigma_m,) * len(result.detections)
        by_frame: dict[tuple[int, int], list[tuple[Detection, float]]] = {}
        for detection, sigma in zip(result.detections, told, strict=True):
            if sigma < math.inf:  # else SLAM was not given it
                frame = by_frame.setdefault((detection.radar, detection.t_ns), [])
                frame.append((detection, sigma))
        of_state: list[KnownRange] = []
        for (radar, t_ns), frame in by_frame.items():
            motion = between(odometry.poses[row], odometry.at(t_ns))
            sigmas = np.array([sigma for _, sigma in frame])
            ids = true_ids(
                np.array([detection.range_m for detection, _ in frame]),
                gate_sigmas * np.hypot(sigmas, offset_sigma_m),
                rig.mounts[radar],
                truth.at(t_ns),
                true_landmarks_m,
            )
            of_state += [
                KnownRange(
                    radar=radar,
                    landmark=id_,
                    range_m=detection.range_m,
                    sigma_m=sigma,
                    motion=motion,
                )
                for (detection, sigma), id_ in zip(frame, ids, strict=True)
                if id_ is not None
            ]
        ranges.append(tuple(of_state))
    return KnownRun(increments=np.array(increments).reshape(-1, 3), ranges=tuple(ranges))


def true_ids(
    ranges_m: Array, gate_m: Array | float, mount: Mount, true_pose: Array, landmarks_m: Array
) -> Sequence[int | None]:
    """Return for each range of one frame the row of its true landmark, None for clutter.

    Parameters
    ----------
    ranges_m
        Shape (m,): what was measured.
    gate_m
        How far from the true range it may lie, shape (m,) or one for all.
    mount
        Where the radar sits on the robot.
    true_pose
        Shape (3,): the robot when the radar sampled.
    landmarks_m
        Shape (n, 2), the frame of ``true_pose``.
    """
    if not len(landmarks_m):
        return [None] * len(ranges_m)
    antenna = mount_at(mount, true_pose)
    away = landmarks_m - np.array([antenna.x_m, antenna.y_m])
    off = wrap_angles(np.arctan2(away[:, 1], away[:, 0]) - antenna.yaw_rad)
    errors = np.abs(ranges_m[:, None] - np.hypot(away[:, 0], away[:, 1]))
    allowed = (errors <= np.broadcast_to(gate_m, len(ranges_m))[:, None]) & (
        np.abs(off) <= VIEW_HALF_ANGLE_RAD
    )
    ids: list[int | None] = [None] * len(ranges_m)
    for i, landmark in zip(*linear_sum_assignment(np.where(allowed, errors, 1e3)), strict=True):
        if allowed[i, landmark]:
            ids[i] = int(landmark)
    return ids


class _Track:
    """Poses at the states, linear in between; a turn goes the short way round."""

    def __init__(self, stamps_ns: Array, poses: Array) -> None:
        self.poses = poses
        self._stamps_ns = stamps_ns
        self._heading = np.unwrap(poses[:, 2])

    def at(self, t_ns: int) -> Array:
        x, y, heading = (
            float(np.interp(t_ns, self._stamps_ns, values))
            for values in (self.poses[:, 0], self.poses[:, 1], self._heading)
        )
        return np.array([x, y, wrap_angle(heading)])
