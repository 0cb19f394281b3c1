"""New landmarks: detections of nothing known that one point at rest explains.

Where a bearing is known with the range, one detection has a place: a point of a patch, a detection
of a sensor that measures both, or, of radars without images, two ranges that cross. Clutter has a
place, too, and so has a ghost, the crossing of two ranges of different targets, which does not stay
at rest while the robot moves. So a detection waits as a tentative landmark, which is followed along
odometry by a Kalman filter on its two coordinates in the newest body frame, and becomes a landmark
when enough scans hold it and they agree. It is fitted to the single ranges of the last frames that
are of nothing known and near enough to it; a crossing becomes a landmark only if they fit.

The specular echo of a wall comes from wherever the wall is nearest, so its range is *linear* in the
antenna's position a; a point's is a hyperbola::

    point at b:     r = |b - a|
    wall (phi, d):  r = d - n . a,   n = [cos phi, sin phi]

A crossing is no landmark unless its ranges fit a hyperbola better, by BIC; walls are found by
patches (:mod:`slam.robust.walls`). A corner of two walls is a point. Source: Leonard and
Durrant-Whyte, "Directed Sonar Sensing for Mobile Robot Navigation", 1992, chapter 2.

A point b with noise n and known dependence D_b on the unknowns of the radars measures

    y = b - R^T (l - p),   H = [e_p: -R^T, e_l: R^T, e_b: -D_b],   S = H P H^T + C_b,

and a new landmark is l = p + R b with e_l = e_p + R D_b e_b + R n: correlated with all that the
pose is correlated with. (In right-invariant errors the heading enters neither.) The ranges of a few
frames end at the surface: with o the direction away from where they were taken, the axis of a
landmark of radius rho is seen at b + rho o, and H has e_rho: -o.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import chdtri

from slam.geometry import compose, wrap_angles
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
    is_plausible,
)
from slam.robust.state import (
    HEAD_SIZE,
    POSITION,
    Array,
    Indices,
    Layout,
    Motion,
    State,
    quarter_turn,
    rotation,
)

_FORBIDDEN = 1e9
_LEAST_WAY_M = 1e-6
# Stands for what is seen now where it is compared with rows of the map
SEEN = -1
# How often a point is fitted to the ranges nearest to it; what keeps matrices regular
_FITS, _FLOOR = 3, 1e-12
# A range that is of nothing known; every frame of a radar has a NaN, too. Antenna, its yaw and the
# robot's heading then are in the frame of odometry; ``way`` is what was driven until then, in
# metres and radians. For the log there are the pose, the antenna in its body frame were the mount
# where the rig has it, and the turn since then.
_UNASSIGNED = np.dtype(
    [
        ("frame", np.intp),
        ("radar", np.intp),
        ("range_m", np.float64),
        ("sigma_m", np.float64),
        ("antenna_m", "2f8"),
        ("yaw_rad", np.float64),
        ("heading_rad", np.float64),
        ("way", "2f8"),
        ("pose", np.intp),
        ("nominal_m", "2f8"),
        ("turn_rad", np.float64),
    ]
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedRanges:
    """Ranges of one point, and the point as they show it."""

    point: BodyPoint
    rows: NDArray[np.void]  # as `_UNASSIGNED` has them
    at: Indices  # where they are among the unassigned ones
    chi_square: float
    chi_square_of_wall: float  # of the same ranges as those of a wall
    variances: Array  # of the ranges

    @property
    def is_flat(self) -> bool:
        """Return whether they may be a wall's, whose echo is a plane wave.

        A curved one must fit better by what BIC asks for one parameter more.
        """
        return self.chi_square_of_wall <= self.chi_square + math.log(len(self.rows))

    @property
    def n_frames(self) -> int:
        return len(np.unique(self.rows["pose"]))

    def evidence(self, noise: RangeNoise) -> float:
        """Return the nats of the ranges, if each radar has one range in every frame.

        They are counted as in `slam.robust.association.weigh_known`.
        """
        density = max(noise.clutter_per_m, 1.0 / (noise.max_range_m - noise.min_range_m))
        log_n = -0.5 * (self.chi_square + float(np.sum(np.log(math.tau * self.variances))))
        return log_n + len(self.rows) * math.log(noise.detection_probability / density)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Looks:
    """Ranges of nothing known, NaN for each frame of a radar, in one frame of coordinates."""

    rows: NDArray[np.void]  # shape (k,)
    antennas_m: Array  # shape (k, 2)
    yaws_rad: Array  # shape (k,), of the antennas
    headings_rad: Array  # shape (k,), of the robot
    ranges_m: Array  # shape (k,), the offsets of the state removed
    variances: Array  # shape (k,), of noise and of odometry since then
    layout: Layout

    def at_point(self, point_m: Array, errors: Array) -> tuple[Array, Array, Array]:
        """Return residuals, d(range) / d(errors) (k, 2 + q), and angles off the boresight.

        ``errors`` are those of the point and of the q unknowns of the radars.
        """
        distance, u, off = self.toward(point_m + errors[:2])
        J = np.hstack([u, self.layout.ranges_by_radars(u, self.headings_rad, self.rows["radar"])])
        return self.ranges_m - distance - J[:, 2:] @ errors[2:], J, off

    def toward(self, point_m: Array) -> tuple[Array, Array, Array]:
        """Return distances (k,) [m] and directions (k, 2) to a point, and angles off boresight."""
        away = point_m - self.antennas_m
        distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), _LEAST_WAY_M)
        u = away / distance[:, None]
        return distance, u, np.abs(wrap_angles(np.arctan2(u[:, 1], u[:, 0]) - self.yaws_rad))

    def of_axis(self, radius_m: float) -> _Looks:
        """Return them as ranges of the axis of what has a radius."""
        return replace(self, ranges_m=self.ranges_m + radius_m)

    def nearest(self, misses_m: Array) -> Indices:
        """Return the index of the least miss in each frame of each radar, of the finite ones.

        ``misses_m`` has shape (k,).
        """
        order = np.argsort(misses_m, kind="stable")
        order = order[: np.count_nonzero(np.isfinite(misses_m))]
        first = np.unique(self.rows[["frame", "radar"]][order], return_index=True)[1]
        return np.asarray(order[first])

    def share_hit(self, k: Indices, point_m: Array, noise: RangeNoise) -> float:
        """Return which share of the frames with a point in view some ranges hit, from the first."""
        distance, _, off = self.toward(point_m)
        sees = (off <= noise.field_of_view_rad / 2) & (distance >= noise.min_range_m)
        sees &= distance <= noise.max_range_m
        hit, in_view = np.unique(self.rows["frame"][k]), np.unique(self.rows["frame"][sees])
        return len(hit) / len(np.union1d(hit, in_view[in_view >= hit[0]]))

    def chi_square_of_wall(
        self, k: Indices, outward: Array, by_radars: Array, of_radars: Array
    ) -> float:
        """Return the least chi-square of some ranges as those of a wall across a direction.

        It may be at any depth and turned a little. ``of_radars`` (q, q) is the information on the
        unknowns of the radars.
        """
        ahead_m, across_m = (
            self.antennas_m[k] @ np.column_stack([outward, quarter_turn(outward)])
        ).T
        sigmas_m = np.sqrt(self.variances[k])
        rows = np.column_stack([np.ones(len(k)), across_m, by_radars]) / sigmas_m[:, None]
        rows = np.vstack([rows, np.pad(np.linalg.cholesky(of_radars).T, ((0, 0), (2, 0)))])
        depths = np.pad((self.ranges_m[k] + ahead_m) / sigmas_m, (0, len(of_radars)))
        residual = depths - rows @ np.linalg.lstsq(rows, depths)[0]
        return float(residual @ residual)


class UnassignedRanges:
    """The ranges of the last frames that are of nothing known, and the robot's way between them."""

    def __init__(self, parameters: BackEndParameters) -> None:
        rule, wheels = parameters.initialisation, parameters.wheels
        self._parameters = parameters
        drift_per_m = rule.drift_share * wheels.scale_sigma
        # What the standard deviation of a range gains per metre of way back, and per radian
        self._drifts = np.array([drift_per_m, drift_per_m * wheels.walk_lever_m])
        self._pose = np.zeros(3)
        self._way = np.zeros(2)  # metres and radians, always growing
        self._frame = 0
        self._rows = np.empty(0, dtype=_UNASSIGNED)

    def move(self, motion: Motion) -> None:
        step = np.array([motion.step_m[0], motion.step_m[1], motion.turn_rad])
        self._pose = compose(self._pose, step)
        self._way = self._way + np.array([motion.distance_m, abs(motion.turn_rad)])

    def clear(self) -> None:
        """Forget all frames: they were taken at another place."""
        self._rows = self._rows[:0]

    def keep(
        self,
        pose_index: int,
        antennas: Antennas,
        scans: Sequence[RangeScan],
        used: set[tuple[int, int]],
    ) -> None:
        """Store a frame without the ranges used, given as (radar, index)."""
        self._frame += 1
        places = antennas.position_m @ rotation(self._pose[2]).T + self._pose[:2]
        rows = [
            (
                self._frame,
                scan.radar,
                range_m,
                sigma_m,
                places[scan.radar],
                antennas.yaw_rad[scan.radar] + self._pose[2],
                antennas.turns_rad[scan.radar] + self._pose[2],
                self._way,
                pose_index,
                antennas.nominal_m[scan.radar],
                antennas.turns_rad[scan.radar],
            )
            for scan in scans
            for range_m, sigma_m in [
                (math.nan, 0.0),
                *(
                    (range_m, scan.sigma(index, self._parameters.ranges.sigma_m))
                    for index, range_m in enumerate(scan.ranges_m)
                    if (scan.radar, index) not in used and 0.0 < range_m < LONGEST_M
                ),
            ]
        ]
        is_recent = self._rows["frame"] > self._frame - self._parameters.initialisation.long_window
        kept = self._rows[is_recent]
        self._rows = np.concatenate([kept, np.array(rows, dtype=_UNASSIGNED)])

    def newest(self, radar: int) -> list[tuple[int, float, float]]:
        """Return radar, range and standard deviation [m] of its ranges in the newest frame."""
        is_newest = (self._rows["frame"] == self._frame) & (self._rows["radar"] == radar)
        rows = self._rows[is_newest & ~np.isnan(self._rows["range_m"])]
        return [(radar, *one) for one in rows[["range_m", "sigma_m"]].tolist()]

    def fit(
        self,
        point: BodyPoint,
        radars: Sequence[int],
        state: State,
        *,
        radius_m: float = 0.0,
        is_of_ranges: bool = False,
    ) -> FittedRanges | None:
        """Return which ranges of some radars are of a point, and where they put it.

        Point and unknowns of the radars are fitted, some times, to the nearest range of each radar
        in each frame, of those in the gate. With a radius, what is fitted is the axis behind the
        point: ranges end at the surface. A point that is itself of these ranges is where they are
        looked for at first, and no more. None if they are too few, or hit too few of the frames
        with the point in view since the first that they hit, or do not fit.
        """
        rule, noise = self._parameters.initialisation, self._parameters.ranges
        at = np.flatnonzero(np.isin(self._rows["radar"], radars))
        looks = self._looks(at, state)
        of_radars = state.P.block(state.radar_columns)
        of_radars = np.asarray(np.linalg.inv(of_radars + _FLOOR * np.eye(len(of_radars))))
        prior = _prior(point, of_radars)
        known, errors = np.linalg.inv(prior), np.zeros(len(prior))
        axis_m = point.point_m
        if radius_m and point.outward is not None:
            axis_m, looks = axis_m + radius_m * point.outward, looks.of_axis(radius_m)
        if is_of_ranges:
            prior = np.pad(of_radars, ((2, 0), (2, 0)))
            prior[0, 0] = prior[1, 1] = 1.0 / noise.max_range_m**2  # in range, wherever
        for fits in range(_FITS):
            residual, J, off = looks.at_point(axis_m, errors)
            S = looks.variances + np.sum((J @ known) * J, axis=1)
            is_near = np.square(residual) <= rule.gate_sigmas**2 * S  # no NaN is
            is_near &= off <= noise.field_of_view_rad / 2 + rule.edge_rad
            k = looks.nearest(np.where(is_near, np.abs(residual), math.inf))
            weighted = J[k].T / looks.variances[k]
            information = prior + weighted @ J[k]
            change = weighted @ residual[k] - prior @ errors
            errors = errors + np.linalg.solve(information, change)
            if fits == _FITS - 2:  # before the last one
                known = np.linalg.inv(information)
        counts = np.unique(looks.rows["radar"][k], return_counts=True)[1]
        if len(counts) < min(len(radars), 2) or counts.min() < rule.min_hits_per_radar:
            return None
        residual, J, _ = looks.at_point(axis_m, errors)
        if looks.share_hit(k, axis_m + errors[:2], noise) < rule.min_share:
            return None
        chi_square = float(np.sum(np.square(residual[k]) / looks.variances[k]))
        chi_square += float(errors @ prior @ errors)
        if not is_plausible(chi_square, len(k) - 2 * is_of_ranges):
            return None
        # For the unknowns of the radars as they are in the state
        covariance = np.asarray(np.linalg.inv(information[:2, :2]))
        by_offsets = -covariance @ information[:2, 2:]
        axis_m = axis_m + errors[:2] - by_offsets @ errors[2:]
        away = axis_m - looks.antennas_m[k].mean(axis=0)
        outward = away / max(math.hypot(away[0], away[1]), _LEAST_WAY_M)
        return FittedRanges(
            point=BodyPoint(
                point_m=axis_m - radius_m * outward,
                covariance=covariance,
                by_offsets=by_offsets,
                outward=outward,
            ),
            rows=looks.rows[k],
            at=at[k],
            chi_square=chi_square,
            variances=looks.variances[k],
            chi_square_of_wall=looks.chi_square_of_wall(k, outward, J[k, 2:], of_radars),
        )

    def _looks(self, at: Indices, state: State) -> _Looks:
        """Return some rows as they are seen from the newest body frame."""
        rows = self._rows[at]
        drifts = (self._way - rows["way"]) * self._drifts
        return _Looks(
            rows=rows,
            antennas_m=(rows["antenna_m"] - self._pose[:2]) @ rotation(self._pose[2]),
            yaws_rad=rows["yaw_rad"] - self._pose[2],
            headings_rad=rows["heading_rad"] - self._pose[2],
            ranges_m=rows["range_m"] - state.offsets_m[rows["radar"]],
            variances=np.square(rows["sigma_m"]) + np.square(drifts).sum(axis=1) + _FLOOR,
            layout=state.layout,
        )

    def use_up(self, fitted: FittedRanges) -> None:
        """Take out ranges that were fitted last."""
        self._rows = np.delete(self._rows, fitted.at)


def _prior(point: BodyPoint, of_radars: Array) -> Array:
    """Return the information on the errors of a point and of the radars' unknowns."""
    difference = np.hstack([np.eye(2), -point.by_offsets])
    information = difference.T @ np.linalg.inv(point.covariance) @ difference
    information[2:, 2:] += of_radars
    return np.asarray(information)


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


def crossing(
    state: State,
    antennas: Antennas,
    ranges: Sequence[tuple[int, float, float]],
    parameters: BackEndParameters,
    pose: int,
) -> list[tuple[PointDetection, BodyPoint]]:
    """Return the points in view at which two ranges cross, as detections of the first one's radar.

    ``ranges`` are given as radar, range and standard deviation [m]; ``pose`` is that of their
    scans. It is what the paper calls trilateration, with the covariance of its linearisation.
    """
    (first, range_m, sigma_m), (second, _, other_sigma_m) = ranges
    radars = np.array([first, second])
    true_m = np.array([one[1] for one in ranges]) - state.offsets_m[radars]
    places, yaws_rad = antennas.position_m[radars], antennas.yaw_rad[radars]
    turns_rad = antennas.turns_rad[radars]
    limit = parameters.ranges.field_of_view_rad / 2 + parameters.initialisation.edge_rad
    found = []
    for x_y in crossings(*places.tolist(), *true_m.tolist()) or ():
        away = np.array(x_y) - places
        bearings = np.arctan2(away[:, 1], away[:, 0])
        u = away / np.hypot(away[:, 0], away[:, 1])[:, None]
        if np.abs(wrap_angles(bearings - yaws_rad)).max() > limit or not np.linalg.det(u):
            continue
        J = np.linalg.inv(u)
        by_radars = -J @ state.layout.ranges_by_radars(u, turns_rad, radars)
        # As if the unknowns of the radars were noise: a point that errs with them is not at rest.
        unknown = by_radars @ state.P.block(state.radar_columns) @ by_radars.T
        covariance = (J * (np.square([sigma_m, other_sigma_m]) + _FLOOR)) @ J.T + unknown
        across = np.array([-u[0, 1], u[0, 0]])
        x_m, y_m = antennas.nominal_m[first].tolist()
        detection = PointDetection(
            radar=first,
            label=None,
            pose=pose,
            nominal_m=(x_m, y_m),
            turn_rad=float(turns_rad[0]),
            range_m=range_m,
            sigma_m=sigma_m,
            bearing_rad=float(bearings[0] - turns_rad[0]),
            bearing_sigma_rad=math.sqrt(float(across @ covariance @ across)) / range_m,
        )
        point = BodyPoint(
            point_m=np.array(x_y), covariance=covariance, by_offsets=by_radars, outward=u[0]
        )
        found.append((detection, point))
    return found


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
        rule, waiting = self._parameters.initialisation, self._points
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
        before = [one.point for one in self._points]
        S = np.add([[point.covariance] for point in points], [[one.covariance for one in before]])
        nu = np.subtract([[point.point_m] for point in points], [[one.point_m for one in before]])
        distance = np.einsum("kni,kni->kn", nu, np.linalg.solve(S, nu[..., None])[..., 0])
        # Per square metre, clutter is the denser the nearer.
        ranges_m = np.array([[detection.range_m] for detection in seen])
        log_n = -0.5 * (distance + np.linalg.slogdet(math.tau * S)[1])
        evidence = log_n + np.log(odds * ranges_m / clutter)
        labels = [one.label for one in self._points]
        is_named = np.array([[detection.label is not None] for detection in seen])
        is_same = np.array([[detection.label == label for label in labels] for detection in seen])
        is_same &= distance <= float(chdtri(2, TAIL_PROBABILITY))
        # A label is better than to begin anew, which costs 0.
        of_pairs = np.where(is_named, np.minimum(-evidence, -1.0), -evidence)
        cost = np.zeros((len(seen), n + len(seen)))
        cost[:, :n] = np.where(is_same & (is_named | (evidence > 0.0)), of_pairs, _FORBIDDEN)
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
