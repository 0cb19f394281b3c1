"""New landmarks: ranges of the last frames that one target at rest explains.

A target is guessed from ranges of the newest frame and followed back through the frames along
odometry by a small Kalman filter on its two coordinates in the newest body frame; each frame gives
the unused range nearest to the prediction, if it passes the gate. The guess is accepted if enough
frames hold it and its residuals are as small as those of a target at rest: clutter has no past, and
a ghost, the fix of two ranges of different targets, does not stay at rest while the robot moves.

The specular echo of a wall comes from wherever the wall is nearest, so its range is *linear* in the
antenna's position a; a point's is a hyperbola::

    point at b:     r = |b - a|
    wall (phi, d):  r = d - n . a,   n = [cos phi, sin phi]

What fits the law of a wall better is no landmark; walls are found by patches
(:mod:`slam.robust.walls`). For ranges, a corner of two walls is a point. Both laws have two
unknowns, so the difference of their chi-squares is twice the logarithm of the likelihood ratio (and
that of their BIC). Over a short displacement, or at a great distance, it is near zero. Source:
Leonard and Durrant-Whyte, "Directed Sonar Sensing for Mobile Robot Navigation", 1992, chapter 2.

A point b with noise n and known dependence D_b on the unknowns of the radars measures

    y = b - R^T (l - p),   H = [e_p: -R^T, e_l: R^T, e_b: -D_b],   S = H P H^T + C_b,

and a new landmark is l = p + R b with e_l = e_p + R D_b e_b + R n: correlated with all that the
pose is correlated with. (In right-invariant errors the heading enters neither.) The ranges of a few
frames end at the surface: with o the direction away from where they were taken, the axis of a
landmark of radius rho is seen at b + rho o, and H has e_rho: -o.

Where a bearing is measured with the range, one detection has a place. As clutter has one, too, it
waits as a tentative landmark, and becomes one when enough scans hold it and they agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import chdtri

from slam.geometry import compose
from slam.robust import kernels
from slam.robust.association import (
    LONGEST_M,
    Antennas,
    MirrorWay,
    RangeScan,
    certain,
    correspondence,
    crossings,
    density_per_m2,
    point_variances,
)
from slam.robust.parameters import (
    MOST_RADII,
    NEIGHBOURHOOD_M,
    SIGMA_PER_MEDIAN,
    TAIL_PROBABILITY,
    THICK_SIGMAS,
    VAGUE_RADIUS,
    BackEndParameters,
    RangeNoise,
    TrackletRule,
    is_plausible,
)
from slam.robust.state import (
    HEAD_SIZE,
    POSITION,
    Array,
    Indices,
    Motion,
    State,
    quarter_turn,
    rotation,
)

_FORBIDDEN = 1e9
_LEAST_WAY_M = 1e-6
# Unknowns of the radars surer than this share of a range's standard deviation are taken for known.
_KNOWN_SHARE = 0.1
# Stands for what is seen now where it is compared with rows of the map
SEEN = -1
# Room for ranges of one radar in one frame, at first
_FEWEST_SLOTS = 8
# Gauss-Newton steps of a fit of a law, its damping, the smallest share of a step that is tried, and
# the decrease of chi-square that ends a fit; what keeps matrices regular
_STEPS, _DAMPING, _LEAST_SHARE, _LEAST_DECREASE, _FLOOR = 8, 1e-6, 1e-3, 1e-4, 1e-12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings:
    """k ranges of one target at rest, newest first."""

    antennas_m: Array  # shape (k, 2), in one frame
    headings_rad: Array  # shape (k,), of the body in that frame
    ranges_m: Array  # shape (k,), the offsets of the state removed
    # shape (k,): variances [m^2] of noise and of odometry since then
    variances: Array
    radars: Indices  # shape (k,)
    # As measured, for the log: the pose of each (k,), its antenna in the body frame of that pose
    # were its mount where the rig has it (k, 2), the robot's turn from the pose to the sample,
    # range [m] and standard deviation (k,)
    poses: Indices
    nominal_m: Array
    turns_rad: Array
    measured_m: Array
    sigmas_m: Array
    n_radars: int  # of the rig

    @property
    def n_frames(self) -> int:
        return len(set(self.poses.tolist()))


class UnassignedRanges:
    """The ranges of the last frames that are of nothing known, and the robot's way between them.

    ``sigma_m`` is for ranges whose scan has none; ``drift_per_m`` and ``drift_per_rad_m`` are what
    the standard deviation of a range gains per metre of way back, and per radian of turn. The
    frames are rows of a ring; a range that is used is NaN.
    """

    def __init__(
        self,
        capacity: int,
        n_radars: int,
        sigma_m: float,
        drift_per_m: float,
        drift_per_rad_m: float,
    ) -> None:
        self._sigma_m = sigma_m
        self._drifts = (drift_per_m, drift_per_rad_m)
        self._pose = np.zeros(3)
        self._way = np.zeros(2)  # metres and radians, always growing
        self._newest, self._count = -1, 0
        self._places = np.zeros((capacity, n_radars, 3))
        self._mounts_m, self._nominal_m = np.zeros((2, capacity, n_radars, 2))
        self._turns_rad = np.zeros((capacity, n_radars))
        self._poses, self._ways = np.zeros((capacity, 3)), np.zeros((capacity, 2))
        self._pose_indices = np.zeros(capacity, dtype=np.intp)
        self._has_frame = np.zeros((capacity, n_radars), dtype=np.bool_)
        self._reserve(_FEWEST_SLOTS)

    def _reserve(self, most: int) -> None:
        """Make room for so many ranges of a radar in a frame."""
        shape = (*self._has_frame.shape, most)
        ranges_m, sigmas_m = np.full(shape, np.nan), np.zeros(shape)
        if self._count:
            k = self._ranges_m.shape[2]
            ranges_m[..., :k], sigmas_m[..., :k] = self._ranges_m, self._sigmas_m
        self._ranges_m: Array = ranges_m
        self._sigmas_m: Array = sigmas_m

    def move(self, motion: Motion) -> None:
        step = np.array([motion.step_m[0], motion.step_m[1], motion.turn_rad])
        self._pose = compose(self._pose, step)
        self._way = self._way + np.array([motion.distance_m, abs(motion.turn_rad)])

    def clear(self) -> None:
        """Forget all frames: they were taken at another place."""
        self._count = 0

    def keep(
        self,
        pose_index: int,
        antennas: Antennas,
        scans: Sequence[RangeScan],
        used: set[tuple[int, int]],
    ) -> None:
        """Store a frame without the ranges used, given as (radar, index)."""
        most = max((len(scan.ranges_m) for scan in scans), default=0)
        if most > self._ranges_m.shape[2]:
            self._reserve(2 * most)
        self._newest = f = (self._newest + 1) % len(self._poses)
        self._count = min(self._count + 1, len(self._poses))
        turn = rotation(self._pose[2])
        self._places[f, :, :2] = antennas.position_m @ turn.T + self._pose[:2]
        self._places[f, :, 2] = antennas.yaw_rad + self._pose[2]
        self._mounts_m[f], self._has_frame[f] = antennas.position_m, antennas.has_frame
        self._nominal_m[f], self._turns_rad[f] = antennas.nominal_m, antennas.turns_rad
        self._poses[f], self._ways[f], self._pose_indices[f] = self._pose, self._way, pose_index
        self._ranges_m[f] = np.nan
        for scan in scans:
            for index, range_m in enumerate(scan.ranges_m):
                if (scan.radar, index) in used or not 0.0 < range_m < LONGEST_M:
                    continue
                at = f, scan.radar, index
                self._ranges_m[at] = range_m
                self._sigmas_m[at] = scan.sigma(index, self._sigma_m)

    def newest(self, radar: int) -> list[float]:
        """Return the ranges of a radar in the newest frame."""
        ranges_m = self._ranges_m[self._newest, radar].tolist()
        return [range_m for range_m in ranges_m if not math.isnan(range_m)]

    def antenna(self, radar: int) -> tuple[float, float, float]:
        """Return place and yaw of an antenna at the newest frame, in its body frame."""
        x, y = self._mounts_m[self._newest, radar].tolist()
        return x, y, float(self._places[self._newest, radar, 2] - self._pose[2])

    def n_frames_with_ranges(self, radar: int, window: int) -> int:
        """Return how many of the last frames hold any range of a radar."""
        backs = np.arange(min(window, self._count))
        some = ~np.isnan(self._ranges_m[self._newest - backs, radar]).all(axis=1)
        return int(np.count_nonzero(some))

    def follow(
        self,
        guess: Guess,
        search: Search,
        offsets_m: Array,
        radar_covariance: Array,
        limits: Sequence[float],
    ) -> tuple[Array, Array, Indices, Indices]:
        """Return what `slam.robust.kernels.follow` does; ``limits`` are its without the drift."""
        (xx, xy), (_, yy) = guess.covariance.tolist()
        return kernels.follow(
            np.array([*guess.target, xx, xy, yy]),
            self._places,
            self._poses,
            self._ways,
            self._has_frame,
            self._ranges_m,
            self._sigmas_m,
            self._newest,
            min(search.window, self._count),
            np.array(search.radars, dtype=np.intp),
            offsets_m,
            radar_covariance,
            np.array([*limits, *self._drifts]),
        )

    def sightings(self, members: Indices, offsets_m: Array) -> Sightings:
        """Return ranges given as (back, radar, index), shape (k, 3), in the newest body frame."""
        back, radars, index = members.T
        f = (self._newest - back) % len(self._poses)
        at = f, radars, index
        way_m, turn_rad = (self._ways[self._newest] - self._ways[f]).T
        drift = np.square(self._drifts[0] * way_m) + np.square(self._drifts[1] * turn_rad)
        places = self._places[f, radars, :2] - self._pose[:2]
        return Sightings(
            antennas_m=places @ rotation(self._pose[2]),
            headings_rad=self._poses[f, 2] - self._pose[2],
            ranges_m=self._ranges_m[at] - offsets_m[radars],
            variances=np.square(self._sigmas_m[at]) + drift,
            radars=radars,
            poses=self._pose_indices[f],
            nominal_m=self._nominal_m[f, radars],
            turns_rad=self._turns_rad[f, radars],
            measured_m=self._ranges_m[at],
            sigmas_m=self._sigmas_m[at],
            n_radars=self._has_frame.shape[1],
        )

    def use_up(self, members: Indices) -> None:
        """Take out ranges given as (back, radar, index), shape (k, 3)."""
        back, radars, index = members.T
        self._ranges_m[(self._newest - back) % len(self._poses), radars, index] = np.nan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyTarget:
    """How well a point or a wall is known in the newest body frame."""

    covariance: Array  # shape (2, 2)
    by_offsets: Array  # shape (2, q), d(target) / d(unknowns of the radars)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyPoint(BodyTarget):
    """A point in the newest body frame."""

    point_m: Array  # shape (2,)
    # shape (2,): away from where it was seen from, where the axis of a round target lies
    outward: Array | None = None


def median_radius(radii_m: Array, sigmas_m: Array) -> tuple[float, float]:
    """Return the median of the radii of one landmark [m] and its standard deviation [m].

    Radii and their standard deviations have shape (k,). Some are of something else, and those that
    are vague beside the best do not count. They err as they scatter about the median, or as is
    stated if that is more; a part of the errors is alike.
    """
    radii_m, sigmas_m = np.array([radii_m, sigmas_m])[:, sigmas_m <= VAGUE_RADIUS * sigmas_m.min()]
    middle_m = float(np.median(radii_m))
    scatter_m = SIGMA_PER_MEDIAN * float(np.median(np.abs(radii_m - middle_m)))
    sigma_m = max(scatter_m, float(np.median(sigmas_m)))
    return middle_m, sigma_m * math.sqrt(1.0 / len(radii_m) + 1.0 / MOST_RADII)


def is_thick(radius_m: float | Array, sigma_m: float | Array) -> bool | NDArray[np.bool_]:
    """Return whether radii [m] with standard deviations [m], of one shape, are of thick things.

    The prior of radii takes others for thin: that is likelier then.
    """
    return radius_m > THICK_SIGMAS * sigma_m


def fused(
    before: BodyTarget, new: BodyTarget, residual: Array
) -> tuple[Array, Array, Array, float]:
    """Return what a target known before becomes by one that is the same, and errs independently.

    ``residual`` (2,) is the new one less the other. Returns by how much the latter moves (2,), its
    covariance (2, 2) and by_offsets (2, q) then, and the chi-square of the residual.
    """
    S = before.covariance + new.covariance
    K = np.linalg.solve(S, before.covariance).T
    covariance = before.covariance - K @ before.covariance
    return (
        np.asarray(K @ residual),
        (covariance + covariance.T) / 2,
        before.by_offsets + K @ (new.by_offsets - before.by_offsets),
        float(residual @ np.linalg.solve(S, residual)),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureRows:
    """A measured feature against a mapped one: residual (2,), H (2, c) on columns ``at``, S."""

    residual: Array
    at: Indices
    H: Array
    S: Array

    @property
    def mahalanobis_sq(self) -> float:
        return float(self.residual @ np.linalg.solve(self.S, self.residual))


def point_rows(state: State, row: int, point: BodyPoint) -> FeatureRows:
    R, layout = rotation(state.heading_rad), state.layout
    at = np.concatenate([np.array([1, 2]), state.radar_columns, layout.columns(np.array([row]))])
    seen_m, by_radius = point.point_m, np.zeros((2, 0))
    if layout.has_radii:
        outward = np.zeros(2) if point.outward is None else point.outward
        seen_m, by_radius = seen_m + state.radii_m[row] * outward, -outward[:, None]
    H = np.hstack([-R.T, -point.by_offsets, R.T, by_radius])
    S = H @ state.P.block(at) @ H.T + point.covariance
    return FeatureRows(
        residual=seen_m - R.T @ (state.landmarks_m[row] - state.position_m),
        at=at,
        H=H,
        S=(S + S.T) / 2,
    )


def near_rows(state: State, point: BodyPoint, reach_m: float) -> NDArray[np.intp]:
    """Return the rows of landmarks within reach of a point; O(n)."""
    place = state.position_m + rotation(state.heading_rad) @ point.point_m
    away = state.landmarks_m - place
    return np.flatnonzero(np.hypot(away[:, 0], away[:, 1]) <= reach_m)


def match(state: State, point: BodyPoint) -> int | None:
    """Return the row of the landmark that a point certainly is, or None."""
    near = near_rows(state, point, NEIGHBOURHOOD_M).tolist()
    density = density_per_m2(state.landmarks_m, NEIGHBOURHOOD_M)
    return certain_row({row: point_rows(state, row, point) for row in near}, density)


def certain_row(found: Mapping[int, FeatureRows], density: float) -> int | None:
    """Return the row of the feature that what is seen certainly is, or None.

    ``found`` has the candidates by row, and ``density`` is that of all features of the kind, per
    unit of the residuals' plane (1/m^2 of points, 1/(m rad) of walls).
    """
    best = certain(
        [correspondence((SEEN, row), rows.residual, rows.S, density) for row, rows in found.items()]
    )
    return None if best is None else best.pair[1]


def possible_rows(
    state: State, point: BodyPoint, others: Collection[int], parameters: BackEndParameters
) -> dict[int, FeatureRows]:
    """Return the landmarks whose gate a point passes, by row; the rows ``others`` are not it."""
    near = near_rows(state, point, parameters.map.neighbourhood_m).tolist()
    found = {row: point_rows(state, row, point) for row in near if row not in others}
    return {row: rows for row, rows in found.items() if is_plausible(rows.mahalanobis_sq, 2)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """What a tentative landmark may be."""

    evidence: float  # nats, against that it is new
    row: int | None = None  # the landmark of the map that it is; None: a new one
    # The robot moved before the landmark was first seen, and the wheels did not report it; the
    # question is asked again after that
    is_jump: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Question:
    """Which of several options a tentative landmark is."""

    tentative: TentativePoint
    point: BodyPoint
    options: tuple[Option, ...]  # likeliest first


def options_of(
    state: State, point: BodyPoint, found: Mapping[int, FeatureRows], density: float
) -> list[Option]:
    """Return which of the landmarks ``found`` a point may be, likeliest first.

    Of those that the sensor cannot tell apart from where it is, only the likeliest is returned: a
    wrong one among them costs little, and the run may still choose another. ``density`` is that of
    landmarks that are not in the map [1/m^2].
    """
    judged = {
        row: correspondence((SEEN, row), rows.residual, rows.S, density).evidence
        for row, rows in found.items()
    }
    limit = float(chdtri(2, TAIL_PROBABILITY))
    R = rotation(state.heading_rad)
    information = R @ np.linalg.inv(point.covariance) @ R.T
    distinct: dict[int, Option] = {}
    for row in sorted(judged, key=lambda row: -judged[row]):
        away = state.landmarks_m[list(distinct)] - state.landmarks_m[row]
        if np.all(np.einsum("ki,ij,kj->k", away, information, away) > limit):
            distinct[row] = Option(row=row, evidence=judged[row])
    return list(distinct.values())


def update_with_point(state: State, row: int, point: BodyPoint) -> float:
    """Correct the state with a point that is the landmark in ``row``; return the NIS."""
    rows = point_rows(state, row, point)
    return state.update(rows.at, rows.H, rows.residual, point.covariance)


def initialise_landmark(
    state: State, point: BodyPoint, radius: tuple[float, float] | None = None
) -> int:
    """Add a landmark that is seen at a point; return its id.

    ``radius`` is its radius [m] and the standard deviation of that; None: as the state's prior has
    it.
    """
    R = rotation(state.heading_rad)
    at = np.arange(state.n_fixed)
    columns = state.P.columns(at)
    G = np.zeros((2, len(at)))
    G[:, POSITION] = np.eye(2)
    G[:, HEAD_SIZE:] = R @ point.by_offsets
    cross = columns @ G.T
    corner = G @ cross[at] + R @ point.covariance @ R.T
    place_m, radius_m = state.position_m + R @ point.point_m, 0.0
    if state.radius_sigma_m:
        # A point whose range and bearing were measured is where it was seen.
        outward, sigma_m = np.zeros(2), 0.0
        if point.outward is not None:
            outward = R @ point.outward
            radius_m, sigma_m = radius or (0.0, state.radius_sigma_m)
        place_m = place_m + radius_m * outward
        along = np.append(outward, 1.0)
        cross = np.column_stack([cross, np.zeros(len(cross))])
        corner = np.pad(corner, (0, 1)) + sigma_m**2 * np.outer(along, along)
    return state.augment(place_m, cross, (corner + corner.T) / 2, radius_m)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Guess:
    """Where a target may be, in the newest body frame: mean (2,) and covariance (2, 2)."""

    target: Array
    covariance: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracklet:
    """A target at rest in the newest body frame, and the ranges that it explains."""

    target: Array  # shape (2,) [m]
    covariance: Array  # shape (2, 2), for the unknowns of the radars as in the state
    by_offsets: Array  # shape (2, q), d(target) / d(unknowns of the radars)
    members: Indices  # shape (k, 3): (back, radar, index), newest first
    seen: Sightings  # of the members
    # Of the residuals
    chi_square: float
    dof: int

    def body_point(self) -> BodyPoint:
        away = self.target - self.seen.antennas_m.mean(axis=0)
        return BodyPoint(
            point_m=self.target,
            covariance=self.covariance,
            by_offsets=self.by_offsets,
            outward=away / max(math.hypot(away[0], away[1]), _LEAST_WAY_M),
        )

    def evidence(self, noise: RangeNoise) -> float:
        """Return the nats of its ranges, if each radar has one range in every frame.

        They are counted as in `slam.robust.association.weigh_known`.
        """
        density = max(noise.clutter_per_m, 1.0 / (noise.max_range_m - noise.min_range_m))
        log_n = -0.5 * (self.chi_square + float(np.sum(np.log(math.tau * self.seen.variances))))
        return log_n + len(self.members) * math.log(noise.detection_probability / density)


def point_guesses(
    unassigned: UnassignedRanges, radars: Sequence[int], noise: RangeNoise, rule: TrackletRule
) -> list[Guess]:
    """Return the fixes of all pairs of new ranges."""
    guesses = []
    spread = rule.prior_sigma_m**2 * np.eye(2)
    limit = noise.field_of_view_rad / 2 + rule.edge_rad
    for one, two in combinations(radars, 2):
        first, second = unassigned.antenna(one), unassigned.antenna(two)
        for a, b in product(unassigned.newest(one), unassigned.newest(two)):
            for x, y in crossings(first, second, a, b) or ():
                if all(
                    abs(math.remainder(math.atan2(y - at[1], x - at[0]) - at[2], math.tau)) <= limit
                    for at in (first, second)
                ):
                    guesses.append(Guess(target=np.array([x, y]), covariance=spread))
    return guesses


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """Where tracklets are looked for, and what they must hold."""

    radars: Sequence[int]  # those of one side
    window: int  # frames looked back
    min_frames: int  # distinct ones


class Tracker:
    """Follows guesses of points back in time.

    ``offsets_m`` (r,) and ``radar_covariance`` (q, q) are of the unknowns of the radars in the
    state: r offsets and, where they are unknown, r places of antennas.
    """

    def __init__(
        self, parameters: BackEndParameters, offsets_m: Array, radar_covariance: Array
    ) -> None:
        self._noise, self._rule = parameters.ranges, parameters.tracklets
        self._offsets_m, self._radar_covariance = offsets_m, np.ascontiguousarray(radar_covariance)
        half_view = self._noise.field_of_view_rad / 2
        self._limits = (
            half_view,
            half_view + self._rule.edge_rad,
            self._noise.min_range_m,
            self._noise.max_range_m,
            self._rule.gate_sigmas**2,
        )
        least = (_KNOWN_SHARE * self._noise.sigma_m) ** 2
        # None where the unknowns of the radars are as good as known
        self._free_covariance: Array | None = self._radar_covariance
        if float(radar_covariance.diagonal().max(initial=0.0)) <= least:
            self._free_covariance = None

    def find(
        self,
        guesses: Sequence[Guess],
        unassigned: UnassignedRanges,
        search: Search,
        accepts: Callable[[Tracklet], bool] | None = None,
    ) -> list[Tracklet]:
        """Return the tracklets of some guesses, best first; their ranges are used up.

        ``accepts`` is the last test of each. They compete by what their ranges are worth less
        chi-square.
        """
        rule = self._rule
        held = [unassigned.n_frames_with_ranges(radar, search.window) for radar in search.radars]
        if min(held) < rule.min_hits_per_radar:
            return []
        found: list[Tracklet] = []
        waiting = list(guesses)
        while waiting:
            followed = []
            for guess in waiting:
                tracklet = self.follow(guess, unassigned, search)
                if tracklet is not None and (accepts is None or accepts(tracklet)):
                    followed.append((tracklet, guess))
            if not followed:
                break
            best, chosen = max(
                followed, key=lambda pair: rule.dof_worth * pair[0].dof - pair[0].chi_square
            )
            unassigned.use_up(best.members)
            found.append(best)
            # What is left may have lost its ranges: follow it again.
            waiting = [guess for _, guess in followed if guess is not chosen]
        return found

    def follow(self, guess: Guess, unassigned: UnassignedRanges, search: Search) -> Tracklet | None:
        """Return the ranges that follow a guess, or None if they do not suffice."""
        found, by_offsets, members, hits = unassigned.follow(
            guess, search, self._offsets_m, self._radar_covariance, self._limits
        )
        x, y, xx, xy, yy, chi_square, in_view, hit = found.tolist()
        counts = [n for n in hits.tolist() if n]
        if hit < search.min_frames or len(counts) < min(len(search.radars), 2):
            return None
        if min(counts) < self._rule.min_hits_per_radar:
            return None
        if hit < self._rule.min_share * in_view:
            return None
        tracklet = Tracklet(
            target=np.array([x, y]),
            covariance=np.array([[xx, xy], [xy, yy]]),
            by_offsets=by_offsets,
            members=members,
            seen=unassigned.sightings(members, self._offsets_m),
            chi_square=chi_square,
            dof=len(members) - 2,
        )
        if self._free_covariance is not None:
            tracklet = self._with_free_radars(tracklet, guess.covariance)
        if not is_plausible(tracklet.chi_square, tracklet.dof):
            return None
        return tracklet

    def _with_free_radars(self, tracklet: Tracklet, spread: Array) -> Tracklet:
        """Judge the members by a target *and* the radars' common unknowns, which are uncertain.

        For the filter, the uncertainty of an offset is noise of each range. It is one number: a
        target may miss all ranges alike. The target is returned for the unknowns of the state,
        moved along d(target) / d(unknowns) from the least-squares solution.
        """
        fit = fit_law(tracklet.seen, tracklet.target, point_law, self._free_covariance)
        weighted = fit.by_law.T / tracklet.seen.variances
        covariance = np.asarray(np.linalg.inv(weighted @ fit.by_law + np.linalg.inv(spread)))
        by_offsets = np.zeros((2, len(self._radar_covariance)))
        by_offsets[:, fit.columns] = -covariance @ weighted @ fit.extra
        return replace(
            tracklet,
            target=fit.target - by_offsets[:, fit.columns] @ fit.unknowns,
            covariance=covariance,
            by_offsets=by_offsets,
            chi_square=fit.chi_square,
        )

    def excess_of_wall(self, tracklet: Tracklet) -> float:
        """Return by how much chi-square is larger under the law of a wall than under a point's."""
        x, y = tracklet.target - tracklet.seen.antennas_m.mean(axis=0)
        point, wall = compare(tracklet.seen, math.atan2(y, x), self._free_covariance)
        return wall - point


Law: TypeAlias = Callable[[Array, Array], tuple[Array, Array, Array]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """A law of least chi-square."""

    target: Array  # shape (2,)
    unknowns: Array  # shape (p,), errors of those of the radars that took part
    columns: Indices  # shape (p,): which these are
    chi_square: float  # of the residuals and of the unknowns
    # d(range) / d(target), shape (k, 2), and d(range) / d(unknowns), shape (k, p)
    by_law: Array
    extra: Array


def point_law(target: Array, antennas_m: Array) -> tuple[Array, Array, Array]:
    """Return ranges (k,), their derivatives by the point (k, 2), and directions (k, 2)."""
    away = target - antennas_m
    distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), _LEAST_WAY_M)
    u = away / distance[:, None]
    return distance, u, u


def wall_law(target: Array, antennas_m: Array) -> tuple[Array, Array, Array]:
    """Return ranges (k,), their derivatives by phi and d (k, 2), and directions (k, 2)."""
    c, s = math.cos(float(target[0])), math.sin(float(target[0]))
    by_angle = s * antennas_m[:, 0] - c * antennas_m[:, 1]
    distance = float(target[1]) - c * antennas_m[:, 0] - s * antennas_m[:, 1]
    directions = np.broadcast_to(np.array([c, s]), antennas_m.shape)
    return distance, np.column_stack([by_angle, np.ones(len(antennas_m))]), directions


def fit_law(seen: Sightings, start: Array, law: Law, radar_covariance: Array | None = None) -> Fit:
    """Return a law at its least chi-square: Gauss-Newton, steps halved until it falls.

    ``radar_covariance`` is of the unknowns of the radars; None where they are known.
    """
    target = start
    by_target, directions = law(target, seen.antennas_m)[1:]
    columns, extra, prior = _radar_part(seen, directions, radar_covariance)
    unknowns = np.zeros(len(columns))

    def chi_square(target: Array, unknowns: Array) -> float:
        residual = seen.ranges_m - law(target, seen.antennas_m)[0] - extra @ unknowns
        return float(residual @ (residual / seen.variances) + unknowns @ prior @ unknowns)

    best = chi_square(target, unknowns)
    for _ in range(_STEPS):
        distance, by_target, _ = law(target, seen.antennas_m)
        residual = seen.ranges_m - distance - extra @ unknowns
        J = np.hstack([by_target, extra])
        weighted = J.T / seen.variances
        information, gradient = weighted @ J, weighted @ residual
        information[2:, 2:] += prior
        gradient[2:] -= prior @ unknowns
        information += _DAMPING * np.diag(information.diagonal() + 1.0)
        change = np.linalg.solve(information, gradient)
        share = 1.0
        while share > _LEAST_SHARE:
            moved = target + share * change[:2], unknowns + share * change[2:]
            value = chi_square(*moved)
            if value <= best:
                break
            share *= 0.5
        else:
            break
        decrease, best = best - value, value
        target, unknowns = moved
        if decrease < _LEAST_DECREASE:
            break
    return Fit(
        target=target,
        unknowns=unknowns,
        columns=columns,
        chi_square=best,
        by_law=law(target, seen.antennas_m)[1],
        extra=extra,
    )


def compare(
    seen: Sightings, toward_rad: float, radar_covariance: Array | None = None
) -> tuple[float, float]:
    """Return the least chi-square of the same ranges under the law of a point, and of a wall.

    ``toward_rad`` is roughly the direction of the target, in the frame of the antennas.
    """
    middle, range_m = seen.antennas_m.mean(axis=0), float(seen.ranges_m.mean())
    n = np.array([math.cos(toward_rad), math.sin(toward_rad)])
    point = fit_law(seen, middle + range_m * n, point_law, radar_covariance)
    start = np.array([toward_rad, range_m + float(n @ middle)])
    return point.chi_square, fit_law(seen, start, wall_law, radar_covariance).chi_square


def _radar_part(
    seen: Sightings, directions: Array, covariance: Array | None
) -> tuple[Indices, Array, Array]:
    """Return columns (p,), d(range) / d(unknowns) (k, p) and information (p, p) of the radars.

    Directions from antenna to target, (k, 2), are those of the first guess: over a few frames they
    hardly change.
    """
    k = len(seen.ranges_m)
    if covariance is None:
        return np.zeros(0, dtype=np.intp), np.zeros((k, 0)), np.zeros((0, 0))
    used = np.unique(seen.radars)
    is_of = (seen.radars[:, None] == used).astype(np.float64)
    columns, extra, n_radars = used, is_of, seen.n_radars
    if len(covariance) > n_radars:
        c, s = np.cos(seen.headings_rad), np.sin(seen.headings_rad)
        x, y = directions.T
        by_x, by_y = is_of * -(x * c + y * s)[:, None], is_of * (x * s - y * c)[:, None]
        columns = np.concatenate([used, n_radars + 2 * used, n_radars + 2 * used + 1])
        extra = np.hstack([is_of, by_x, by_y])
    known = covariance[np.ix_(columns, columns)] + _FLOOR * np.eye(len(columns))
    return columns, extra, np.asarray(np.linalg.inv(known))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointDetection:
    """A detection with range and bearing, as measured."""

    radar: int
    label: int | None
    pose: int  # index in the log
    nominal_m: tuple[
        float, float
    ]  # antenna in the body frame, its mount being where the rig has it
    turn_rad: float  # of the robot from the pose to the sample
    range_m: float
    sigma_m: float
    bearing_rad: float  # in the body frame of the sample
    bearing_sigma_rad: float
    is_of_patch: bool = False
    # Radius [m] by the curvature of the wavefront, and its standard deviation
    radius_m: float = 0.0
    radius_sigma_m: float = math.inf
    # Bearing of its mirror image, where that is a detection of the scan, too
    mirrored_rad: float | None = None

    def way_to_mirror(self, heading_rad: float, heading_variance: float) -> MirrorWay | None:
        """Return the way from here to the mirror image, if there is one.

        The heading is that of the robot at the pose, in the map.
        """
        if self.mirrored_rad is None:
            return None
        turn_rad = heading_rad + self.turn_rad
        here, there = (
            self.range_m * rotation(turn_rad + bearing)[:, 0]
            for bearing in (self.bearing_rad, self.mirrored_rad)
        )
        x_m, y_m = (there - here).tolist()
        of_bearing = (2.0 * self.range_m * self.bearing_sigma_rad) ** 2
        variance = of_bearing + heading_variance * (x_m**2 + y_m**2)
        return MirrorWay(x_m=x_m, y_m=y_m, variance=variance)


def detections_of(
    scan: RangeScan, indices: Sequence[int], pose: int, antennas: Antennas, noise: RangeNoise
) -> list[PointDetection]:
    """Return some detections of a scan with bearings."""
    assert scan.bearings_rad is not None
    radar, variances = scan.radar, point_variances(scan, indices, noise)
    x_m, y_m = antennas.nominal_m[radar].tolist()
    turn_rad = float(antennas.turns_rad[radar])
    yaw_rad = float(antennas.yaw_rad[radar]) - turn_rad
    return [
        PointDetection(
            radar=radar,
            label=None if scan.labels is None else scan.labels[index],
            pose=pose,
            nominal_m=(x_m, y_m),
            turn_rad=turn_rad,
            range_m=scan.ranges_m[index],
            sigma_m=sigma_m,
            bearing_rad=yaw_rad + scan.bearings_rad[index],
            bearing_sigma_rad=bearing_sigma_rad,
            is_of_patch=scan.is_patch,
            radius_m=0.0 if scan.radii_m is None else scan.radii_m[index],
            radius_sigma_m=(
                math.inf if scan.radius_sigmas_m is None else scan.radius_sigmas_m[index]
            ),
            mirrored_rad=None if mirror is None else yaw_rad + scan.bearings_rad[mirror],
        )
        for index, mirror, (sigma_m, bearing_sigma_rad) in zip(
            indices, scan.mirrors_of(indices), np.sqrt(variances).tolist(), strict=True
        )
    ]


def body_point(
    state: State, antennas: Antennas, detection: PointDetection, share: float = 1.0
) -> BodyPoint:
    """Return where a detection lies: at its range and bearing, the offset of the radar removed.

    Of its variance a share is taken.
    """
    radar, layout = detection.radar, state.layout
    angle = detection.bearing_rad + detection.turn_rad
    distance_m = detection.range_m - float(state.offsets_m[radar])
    turn = rotation(angle)
    spread = np.diag([detection.sigma_m**2, (distance_m * detection.bearing_sigma_rad) ** 2])
    by_radar = np.zeros((2, state.n_fixed - HEAD_SIZE))
    by_radar[:, radar] = -turn[:, 0]
    if layout.has_mounts:
        mount = layout.n_radars + 2 * radar
        by_radar[:, mount : mount + 2] = rotation(detection.turn_rad)
    return BodyPoint(
        point_m=antennas.position_m[radar] + distance_m * turn[:, 0],
        covariance=share * turn @ spread @ turn.T,
        by_offsets=by_radar,
        outward=turn[:, 0],
    )


@dataclass(slots=True, kw_only=True, eq=False)
class TentativePoint:
    """What may be a landmark: a point in the newest body frame, and the detections of it."""

    point: BodyPoint
    seen: list[PointDetection]
    chi_square: float = 0.0
    misses: int = 0  # scans since the last one that held it

    @property
    def label(self) -> int | None:
        return self.seen[0].label

    def radius(self, prior_sigma_m: float) -> tuple[float, float]:
        """Return its radius [m] and the standard deviation of that.

        Most things are thin, as the prior has it; what is seen to be thick has any radius.
        """
        radius_m, sigma_m = median_radius(
            np.array([one.radius_m for one in self.seen]),
            np.array([one.radius_sigma_m for one in self.seen]),
        )
        if is_thick(radius_m, sigma_m):
            return radius_m, sigma_m
        share = prior_sigma_m**2 / (prior_sigma_m**2 + sigma_m**2)
        return max(share * radius_m, 0.0), prior_sigma_m * math.sqrt(1.0 - share)

    @property
    def is_of_patches(self) -> bool:
        return all(one.is_of_patch for one in self.seen)

    @property
    def looks_with_mirrors(self) -> set[tuple[int, int, float]]:
        """Return pose, radar and range of its detections that have mirror images.

        Of the point at the mirror image they are the same.
        """
        return {
            (one.pose, one.radar, one.range_m) for one in self.seen if one.mirrored_rad is not None
        }


class TentativePoints:
    """Detections with bearings that are of nothing known, as points at rest.

    Each is followed along odometry by a Kalman filter on its two coordinates in the newest body
    frame. Detections are assigned to them as to landmarks, those with labels to those of the label.
    """

    def __init__(self, parameters: BackEndParameters) -> None:
        self._parameters = parameters
        self._points: list[TentativePoint] = []

    def move(self, motion: Motion) -> None:
        """Move the body frame: b' = R^T (b - d), and the noise of (d, a) turns and shifts it."""
        R = rotation(motion.turn_rad)
        for one in self._points:
            moved = R.T @ (one.point.point_m - motion.step_m)
            by_motion = np.column_stack([-R.T, -quarter_turn(moved)])
            noise = by_motion @ motion.covariance @ by_motion.T
            one.point = replace(
                one.point,
                point_m=moved,
                covariance=R.T @ one.point.covariance @ R + noise,
                by_offsets=R.T @ one.point.by_offsets,
                outward=None if one.point.outward is None else R.T @ one.point.outward,
            )

    def clear(self) -> None:
        self._points = []

    def keep(self, one: TentativePoint) -> None:
        """Take back what may be a landmark that is in the map."""
        self._points.append(one)

    def remove(self, one: TentativePoint) -> None:
        self._points = self._without([one])

    def forget_before(self, pose: int) -> None:
        """Forget those that were seen before a pose, by index in the log."""
        self._points = [one for one in self._points if one.seen[0].pose >= pose]

    def unclear(self) -> list[TentativePoint]:
        """Return those that the newest scan held and that are landmarks, but not yet which."""
        held = [one for one in self._points if one.label is None and not one.misses]
        return [one for one in held if self._is_landmark(one)]

    def take_out(self) -> list[TentativePoint]:
        """Return those that are landmarks, of the map or new, and forget them."""
        found = [one for one in self._points if self._is_landmark(one)]
        labels = {one.label for one in found if one.label is not None}
        kept = [one for one in self._without(found) if one.label not in labels]
        self._points = kept
        # Of one label there is one landmark, and of a point and its mirror image the older one.
        return [
            one
            for k, one in enumerate(found)
            if one.label is None or one.label not in {other.label for other in found[:k]}
            if not any(one.looks_with_mirrors & other.looks_with_mirrors for other in found[:k])
        ]

    def take(self, seen: Sequence[PointDetection], points: Sequence[BodyPoint]) -> None:
        """Take in the detections of a scan, with their points."""
        rule, waiting = self._parameters.tracklets, self._points
        chosen = self._assigned(seen, points)
        hit = set(chosen.values())
        for k, (detection, point) in enumerate(zip(seen, points, strict=True)):
            if k in chosen:
                self._fuse(waiting[chosen[k]], detection, point)
        for at, one in enumerate(waiting):
            one.misses = 0 if at in hit else one.misses + 1
        new = [
            TentativePoint(point=point, seen=[detection])
            for k, (detection, point) in enumerate(zip(seen, points, strict=True))
            if k not in chosen
        ]
        self._points = [one for one in [*waiting, *new] if one.misses <= rule.window]

    def _is_landmark(self, one: TentativePoint) -> bool:
        """Return whether enough detections hit a point, and lie as one at rest lets them."""
        hits, rule = len(one.seen), self._parameters.bearings(of_patches=one.is_of_patches)
        return hits >= rule.fewest and is_plausible(one.chi_square, 2 * (hits - 1))

    def _without(self, found: Sequence[TentativePoint]) -> list[TentativePoint]:
        """Return the points but for some, and their mirror images."""
        looks = set[tuple[int, int, float]]().union(*(one.looks_with_mirrors for one in found))
        return [
            one for one in self._points if one not in found and not one.looks_with_mirrors & looks
        ]

    def _assigned(
        self, seen: Sequence[PointDetection], points: Sequence[BodyPoint]
    ) -> dict[int, int]:
        """Return which tentative point each detection is of, by index."""
        noise, n = self._parameters.ranges, len(self._points)
        if not n or not seen:
            return {}
        odds = noise.detection_probability / (1.0 - noise.detection_probability)
        clutter = noise.clutter_per_m / noise.field_of_view_rad
        limit = float(chdtri(2, TAIL_PROBABILITY))
        cost = np.zeros((len(seen), n + len(seen)))
        for k, (detection, point) in enumerate(zip(seen, points, strict=True)):
            for at, one in enumerate(self._points):
                S = one.point.covariance + point.covariance
                nu = point.point_m - one.point.point_m
                distance = float(nu @ np.linalg.solve(S, nu))
                # Per square metre, clutter is the denser the nearer.
                log_n = -0.5 * (distance + float(np.linalg.slogdet(math.tau * S)[1]))
                evidence = log_n + math.log(odds * detection.range_m / clutter)
                is_named = detection.label is not None
                is_same = detection.label == one.label and distance <= limit
                if is_same and (is_named or evidence > 0.0):
                    # A label is better than to begin anew, which costs 0.
                    cost[k, at] = min(-evidence, -1.0) if is_named else -evidence
                else:
                    cost[k, at] = _FORBIDDEN
        columns = linear_sum_assignment(cost)[1].tolist()
        return {k: at for k, at in enumerate(columns) if at < n}

    def _fuse(self, one: TentativePoint, detection: PointDetection, point: BodyPoint) -> None:
        before = one.point
        change, covariance, by_offsets, chi_square = fused(
            before, point, point.point_m - before.point_m
        )
        one.point = BodyPoint(
            point_m=before.point_m + change,
            covariance=covariance,
            by_offsets=by_offsets,
            outward=point.outward,
        )
        one.chi_square += chi_square
        one.seen.append(detection)
