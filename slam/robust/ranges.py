"""Ranges: where the radars were when they sampled, and what they should have measured.

    z = |l - p - R m| + b + v,   H = [e_th: 0, e_p: -u, e_l: u, b: 1],

u the unit vector from antenna to landmark in the map frame. The heading has no entry: a turn of
robot and map together changes no range. Of a wall (phi, d) the mirror image answers, along its
normal n, from wherever the antenna q = p + R m is:

    z = d - n . q + b + v,     H = [e_th: 0, e_p: -n, e_phi: -(J n) . q, e_d: 1, b: 1].

A radar that sampled a fraction f of a step after the
pose was at ``m' = f d + Rot(f a) m``, boresight ``yaw' = yaw + f a`` (f < 0: before it).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.geometry import Rig, wrap_angles
from slam.robust.parameters import RangeNoise
from slam.robust.state import Array, Indices, Motion, State, quarter_turn, rotation

# No radar ranges as far; keeps squares finite whatever a front end says.
LONGEST_M = 1e6
# Two pulses closer than this in range are hard to tell apart: the width of one at half height.
BLUR_M = 0.12


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeScan:
    """Detections of one radar in one frame; an empty scan means that nothing was seen."""

    radar: int  # index of the mount in the rig
    ranges_m: tuple[float, ...]  # ranges in true metres
    # When it sampled, in steps after the pose: 0 with it, -0.5 half a step before it
    sampled_after: float = 0.0
    # Which target each range is of, where that is known; it replaces association
    labels: tuple[int, ...] | None = None
    # Standard deviation of each range, where the front end predicts it
    sigmas_m: tuple[float, ...] | None = None
    # Reported motion from the pose to the sample, (dx, dy) [m] and turn [rad] in the body frame of
    # the pose. It replaces ``sampled_after``, which is limited to one step.
    moved: tuple[float, float, float] | None = None
    # Ranges of echoes that several targets may share: no evidence of where anything is, nor that
    # nothing is there
    blurred_m: tuple[float, ...] = ()

    def label(self, index: int) -> int | None:
        return None if self.labels is None else self.labels[index]

    def sigma(self, index: int, otherwise_m: float) -> float:
        """Return the standard deviation [m] of one range; ``otherwise_m`` if there is none."""
        return otherwise_m if self.sigmas_m is None else self.sigmas_m[index]

    def with_added_sigma(self, sigma_m: float) -> RangeScan:
        """Return the scan with a standard deviation added to each range's."""
        if self.sigmas_m is None or not sigma_m:
            return self
        return replace(self, sigmas_m=tuple(math.hypot(s, sigma_m) for s in self.sigmas_m))

    def is_alone(self, index: int) -> bool:
        """Tell whether no other echo overlaps that of a range."""
        others = (*self.ranges_m[:index], *self.ranges_m[index + 1 :], *self.blurred_m)
        return all(abs(other_m - self.ranges_m[index]) > BLUR_M for other_m in others)

    def may_hide(self, range_m: float) -> bool:
        """Tell whether an echo at a range may be part of a blurred one."""
        return any(abs(blurred_m - range_m) <= BLUR_M for blurred_m in self.blurred_m)

    def answers(self, range_m: float, reach_m: float) -> bool:
        """Tell whether any echo, blurred or not, may be that of a target at a range."""
        return any(abs(detected_m - range_m) <= reach_m for detected_m in self.ranges_m) or any(
            abs(blurred_m - range_m) <= BLUR_M + reach_m for blurred_m in self.blurred_m
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Antennas:
    """Where the radars were when they sampled, in the body frame of the pose.

    ``position_m`` has shape (r, 2), ``yaw_rad`` (r,), ``has_frame`` (r,).
    """

    position_m: Array
    yaw_rad: Array
    has_frame: NDArray[np.bool_]


def antennas_of(
    rig: Rig, scans: Sequence[RangeScan], motion: Motion, calibration: Array | None = None
) -> Antennas:
    """Return where the antennas were; a radar without a scan stays at its mount.

    ``calibration`` (3,), s, w and kappa, corrects reported motions; over less than a step the
    curvature has no effect.
    """
    s, w = (0.0, 0.0) if calibration is None else calibration[:2].tolist()
    mounts = rig.mounts
    position = np.array([[mount.x_m, mount.y_m] for mount in mounts])
    yaw = np.array([mount.yaw_rad for mount in mounts])
    has_frame = np.zeros(len(mounts), dtype=bool)
    for scan in scans:
        has_frame[scan.radar] = True
        f = scan.sampled_after
        if scan.moved is not None:
            turn = scan.moved[2] / (1.0 + w)
            way = np.array(scan.moved[:2]) / (1.0 + s)
            position[scan.radar] = way + rotation(turn) @ position[scan.radar]
            yaw[scan.radar] += turn
        elif f != 0.0:
            # The part of the step before a pose ends there: go back along it from its end.
            turn = f * motion.turn_rad
            forward = motion.step_m if f > 0 else rotation(-motion.turn_rad) @ motion.step_m
            position[scan.radar] = f * forward + rotation(turn) @ position[scan.radar]
            yaw[scan.radar] += turn
    return Antennas(position_m=position, yaw_rad=yaw, has_frame=has_frame)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """All n landmarks and behind them all w walls as all radars should see them."""

    ranges_m: Array  # shape (r, n + w), offsets included; negative behind a wall
    off_boresight_rad: Array  # shape (r, n + w), in [-pi, pi)
    directions: Array  # shape (r, n + w, 2), unit vectors u or n in the map frame
    by_feature: Array  # shape (r, n + w, 2), d(range) / d(error of the landmark or wall)

    def inside(
        self, noise: RangeNoise, widen_rad: float = 0.0, widen_m: float = 0.0
    ) -> NDArray[np.bool_]:
        """Return whether each radar has each landmark in view, shape (r, n)."""
        return (
            (np.abs(self.off_boresight_rad) <= noise.field_of_view_rad / 2 + widen_rad)
            & (self.ranges_m >= noise.min_range_m - widen_m)
            & (self.ranges_m <= noise.max_range_m + widen_m)
        )

    def without(self, rows: Sequence[int]) -> View:
        """Return a view in which the landmarks in some rows are out of reach."""
        if not rows:
            return self
        ranges = self.ranges_m.copy()
        ranges[:, rows] = math.inf
        return replace(self, ranges_m=ranges)


def view(state: State, antennas: Antennas) -> View:
    """Return the view of everything mapped; O(n + w), the covariance is not touched."""
    R = rotation(state.heading_rad)
    body = (state.landmarks_m - state.position_m) @ R
    offsets = body[None, :, :] - antennas.position_m[:, None, :]
    ranges = np.hypot(offsets[..., 0], offsets[..., 1])
    bearings = np.arctan2(offsets[..., 1], offsets[..., 0])
    directions = (offsets / np.maximum(ranges, 1e-9)[..., None]) @ R.T
    by_feature = directions
    if len(state.walls):
        places = state.position_m + antennas.position_m @ R.T
        phi, d = state.walls.T
        normals = np.column_stack([np.cos(phi), np.sin(phi)])
        turned = quarter_turn(normals)
        ranges = np.hstack([ranges, d - places @ normals.T])
        bearings = np.hstack([bearings, np.tile(phi - state.heading_rad, (len(places), 1))])
        walls = np.broadcast_to(normals, (len(places), *normals.shape))
        by_wall = np.stack([-places @ turned.T, np.ones((len(places), len(phi)))], axis=-1)
        by_feature = np.concatenate([directions, by_wall], axis=1)
        directions = np.concatenate([directions, walls], axis=1)
    if state.radii_m:
        ranges = ranges - state.feature_radii_m
    return View(
        ranges_m=ranges + state.offsets_m[:, None],
        off_boresight_rad=wrap_angles(bearings - antennas.yaw_rad[:, None]),
        directions=directions,
        by_feature=by_feature,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """Range measurements that could be made: row i is of radar ``radars[i]``, one landmark each."""

    # shape (k,): index of the radar, row of the landmark; walls are the rows from n on
    radars: Indices
    landmarks: Indices
    at: Indices  # columns of the error that H has entries for, shape (c,)
    H: Array  # shape (k, c)
    predicted_m: Array  # shape (k,)


def rows_of(state: State, seen: View, radars: Indices, landmarks: Indices) -> Rows:
    """Return the rows of some (radar, landmark) pairs, shapes (k,) and (k,)."""
    known, place = np.unique(landmarks, return_inverse=True)
    n_offsets = len(state.offsets_m)
    at = np.concatenate(
        [
            np.array([1, 2]),
            np.arange(state.offsets.start, state.offsets.stop),
            state.landmark_columns(known),
        ]
    )
    k = np.arange(len(radars))
    u = seen.directions[radars, landmarks]
    H = np.zeros((len(radars), len(at)))
    H[:, :2] = -u
    H[k, 2 + radars] = 1.0
    first = 2 + n_offsets + 2 * place
    by_feature = seen.by_feature[radars, landmarks]
    H[k, first] = by_feature[:, 0]
    H[k, first + 1] = by_feature[:, 1]
    return Rows(
        radars=radars,
        landmarks=landmarks,
        at=at,
        H=H,
        predicted_m=seen.ranges_m[radars, landmarks],
    )


def sides_of(rig: Rig) -> tuple[tuple[int, ...], ...]:
    """Return the groups of radars that look the same way; a radar without partner is its own."""
    group = list(range(len(rig.mounts)))
    for pair in rig.pairs():
        old, new = group[pair.second], group[pair.first]
        group = [new if g == old else g for g in group]
    return tuple(
        tuple(i for i, g in enumerate(group) if g == leader) for leader in dict.fromkeys(group)
    )


def fix_of_pair(
    first_m: Array, second_m: Array, range_first_m: float, range_second_m: float, ahead: Array
) -> Array | None:
    """Return where two circles about the antennas meet on the side ``ahead``, or None.

    Body frame, shapes (2,); paper eq. 1 with the arcs' angles as arccos.
    """
    if not (0.0 < range_first_m < LONGEST_M and 0.0 < range_second_m < LONGEST_M):
        return None
    base = second_m - first_m
    length = math.hypot(base[0], base[1])
    if length == 0.0:
        return None
    along = base / length
    x = (range_first_m**2 - range_second_m**2 + length**2) / (2.0 * length)
    square = range_first_m**2 - x**2
    if square <= 0.0:
        return None
    across = np.array([-along[1], along[0]])
    if across @ ahead < 0.0:
        across = -across
    return np.asarray(first_m + x * along + math.sqrt(square) * across)
