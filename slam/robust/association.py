"""Predicted ranges, and which measured range is of which landmark.

A range is predicted from where the radar was when it sampled, antenna m in the body frame,

    z = |l - p - R m| - rho + b + v,   H = [e_th: 0, e_p: -u, e_l: u, e_rho: -1, b: 1, e_m: -R^T u],

u the unit vector from antenna to the landmark's axis in the map frame, rho its radius. The heading
has no entry: a turn of robot and map together changes no range. Of a wall (phi, d) the mirror image
answers, along its normal n, from wherever the antenna q = p + R m is:

    z = d - n . q + b + v,     H = [e_th: 0, e_p: -n, e_phi: -(J n) . q, e_d: 1, b: 1].

Known landmarks come first, one to one. A landmark takes part if it may be in view and if the prior
alone, without the noise of a range, predicts its ranges more surely than a range measures them;
else what its ranges show is a new point at first, which may turn out to be the landmark. For each
landmark one option is chosen, a range of some of the radars of the side, or of none, at the cost

    nu^T S^-1 nu + ln det(2 pi S) + 2 m ln(clutter density) - 2 m ln(Pd / (1 - Pd))

for m ranges with joint innovation covariance S; none costs nothing. No range is used twice. The
least sum is found by branch and bound, as joint compatibility is (Neira and Tardos, IEEE TRA
17(6), 2001), with likelihoods for counts.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.special import chdtri

from slam.geometry import Rig, wrap_angles
from slam.results import PredictedRange
from slam.robust import kernels
from slam.robust.parameters import (
    MARGIN_NATS,
    TAIL_PROBABILITY,
    BackEndParameters,
    RangeNoise,
    is_plausible,
)
from slam.robust.state import Array, Indices, State, quarter_turn, rotation

# No radar ranges as far; keeps squares finite whatever a front end reports.
LONGEST_M = 1e6
# What a scan has one of for each range, if it has it
_OF_EACH_RANGE = (
    "sigmas_m",
    "labels",
    "bearings_rad",
    "bearing_sigmas_rad",
    "faces_m",
    "radii_m",
    "radius_sigmas_m",
    "mirrors",
)
# Keeps the direction to what stands at an antenna finite.
_LEAST_RANGE_M = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeScan:
    """Detections of one radar in one frame; an empty scan means that nothing was seen."""

    radar: int  # index of the mount in the rig
    ranges_m: tuple[float, ...]  # ranges in true metres
    # Standard deviation of each range, where the front end predicts it
    sigmas_m: tuple[float, ...] | None = None
    # Reported motion from the pose to the sample, (dx, dy) [m] and turn [rad] in the body frame of
    # the pose; None: sampled at the pose
    moved: tuple[float, float, float] | None = None
    # Ranges of echoes that several targets may share: no evidence of where anything is, nor that
    # nothing is there
    blurred_m: tuple[float, ...] = ()
    # Of each range the id of the beacon that it is of, None where that is not known
    labels: tuple[int | None, ...] | None = None
    # Bearing of each range from the boresight, counter-clockwise, where the sensor measures it, and
    # its standard deviation, where that is known better than `RangeNoise.bearing_sigma_rad`
    bearings_rad: tuple[float, ...] | None = None
    bearing_sigmas_rad: tuple[float, ...] | None = None
    # Points or walls of a patch (`slam.imaging.patches`), beside the radar's single ranges. What is
    # not among them may be there all the same.
    is_patch: bool = False
    # Of flat faces in a patch: the stretch (from, to) along each that gave the echo, counted to the
    # left from the foot of the perpendicular, whose range and bearing are given. None: of points
    faces_m: tuple[tuple[float, float], ...] | None = None
    # Of points of a patch the radius, as the curvature of the wavefront shows it, and the standard
    # deviation of that
    radii_m: tuple[float, ...] | None = None
    radius_sigmas_m: tuple[float, ...] | None = None
    # Of each point of a patch the index of its mirror image, which may be itself; only one of the
    # two is there
    mirrors: tuple[int | None, ...] | None = None
    # Whether points and walls of patches of the radar come beside these single ranges
    is_imaged: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError if a number is not finite, or missing for one of the ranges."""
        n = len(self.ranges_m)
        for name in _OF_EACH_RANGE:
            values = getattr(self, name)
            if values is not None and len(values) != n:
                raise ValueError(
                    f"{len(values)} {name} of {n} ranges; there must be one for each range"
                )
        if self.faces_m is not None and (self.bearings_rad is None or not self.is_patch):
            raise ValueError(f"{self}: faces_m are of a patch, and have bearings_rad")
        pairs = [(index, one) for index, one in enumerate(self.mirrors or ()) if one is not None]
        if {(one, index) for index, one in pairs} != set(pairs):
            raise ValueError(f"{self}: mirrors must be indices of each other")
        if (self.radii_m is None) != (self.radius_sigmas_m is None):
            raise ValueError(f"{self}: radii_m and radius_sigmas_m must be given together")
        sigmas = (
            *(self.sigmas_m or ()),
            *(self.bearing_sigmas_rad or ()),
            *(self.radius_sigmas_m or ()),
        )
        numbers = (*self.ranges_m, *(self.moved or ()), *self.blurred_m, *(self.bearings_rad or ()))
        numbers += self.radii_m or ()
        numbers += tuple([end_m for stretch in self.faces_m or () for end_m in stretch])
        if (
            self.radar < 0
            or min(sigmas, default=0.0) < 0.0
            or not math.isfinite(sum(numbers + sigmas))
        ):
            raise ValueError(
                f"{self}: radar must be the index of a mount, every number finite, and none of the "
                "standard deviations negative"
            )

    @property
    def labelled(self) -> tuple[tuple[int, int], ...]:
        """Return index and label of each range that has a label."""
        labels = enumerate(self.labels or ())
        return tuple((index, label) for index, label in labels if label is not None)

    @property
    def n_seen(self) -> int:
        """Return how many things are seen; a point and its mirror image are one."""
        mirrors = enumerate(self.mirrors or ())
        return len(self.ranges_m) - sum(one is not None and one < index for index, one in mirrors)

    def mirrors_of(self, indices: Sequence[int]) -> list[int | None]:
        """Return the mirror image of each of some detections, by index."""
        return [None if self.mirrors is None else self.mirrors[index] for index in indices]

    def with_mirrors(self, indices: Sequence[int]) -> set[int]:
        """Return indices of detections, and those of their mirror images."""
        return {*indices, *(one for one in self.mirrors_of(indices) if one is not None)}

    @property
    def looks(self) -> bool:
        """Return whether the radar looked for whatever is there, and did not ask beacons only."""
        return self.labels is None or None in self.labels

    def sigma(self, index: int, otherwise_m: float) -> float:
        """Return the standard deviation [m] of one range; ``otherwise_m`` if there is none."""
        return otherwise_m if self.sigmas_m is None else self.sigmas_m[index]

    def with_added_sigma(self, sigma_m: float) -> RangeScan:
        if self.sigmas_m is None or not sigma_m:
            return self
        return replace(self, sigmas_m=tuple([math.hypot(s, sigma_m) for s in self.sigmas_m]))


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorWay:
    """The way from where something may be to its mirror image, map frame."""

    x_m: float
    y_m: float
    variance: float  # of either of them [m^2]

    def is_like(self, other: MirrorWay | None) -> bool:
        """Return whether two ways are one, as they are from one straight way.

        From straight ways in two directions, what is there has two mirror images.
        """
        if other is None:
            return False
        gap = (self.x_m - other.x_m) ** 2 + (self.y_m - other.y_m) ** 2
        return is_plausible(gap / (self.variance + other.variance), 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Antennas:
    """Where the radars were when they sampled, in the body frame of the pose.

    ``position_m`` has shape (r, 2), ``yaw_rad`` (r,), ``has_frame`` (r,).
    """

    position_m: Array
    yaw_rad: Array
    has_frame: NDArray[np.bool_]
    nominal_m: Array  # shape (r, 2): positions if every mount were where the rig has it
    turns_rad: Array  # shape (r,): of the robot from the pose to the sample


def antennas_of(
    rig: Rig, scans: Sequence[RangeScan], calibration: Array, moved_m: Array | None = None
) -> Antennas:
    """Return where the antennas were; a radar without a scan stays at its mount.

    ``calibration`` (3,), s, w and kappa, corrects reported motions; over less than a step the
    curvature has no effect. ``moved_m`` (r, 2) is how far the mounts are from the rig's.
    """
    s, w = calibration[:2].tolist()
    mounts = rig.mounts
    nominal = np.array([[mount.x_m, mount.y_m] for mount in mounts])
    position = nominal.copy() if moved_m is None else nominal + moved_m
    yaw = np.array([mount.yaw_rad for mount in mounts])
    turns = np.zeros(len(mounts))
    has_frame = np.zeros(len(mounts), dtype=bool)
    for scan in scans:
        has_frame[scan.radar] = True
        if scan.moved is not None:
            turn = scan.moved[2] / (1.0 + w)
            way = np.array(scan.moved[:2]) / (1.0 + s)
            turned = rotation(turn)
            position[scan.radar] = way + turned @ position[scan.radar]
            nominal[scan.radar] = way + turned @ nominal[scan.radar]
            yaw[scan.radar] += turn
            turns[scan.radar] = turn
    return Antennas(
        position_m=position, yaw_rad=yaw, has_frame=has_frame, nominal_m=nominal, turns_rad=turns
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """All n landmarks and behind them all w walls as all radars should see them."""

    ranges_m: Array  # shape (r, n + w), offsets included; negative behind a wall
    off_boresight_rad: Array  # shape (r, n + w), in [-pi, pi)
    directions: Array  # shape (r, n + w, 2), unit vectors u or n in the map frame
    by_feature: Array  # shape (r, n + w, 2), d(range) / d(error of the landmark or wall)
    turned: Array  # shape (r, 2, 2): rotations from the body frame of the sample to the map
    # Shape (r, n + w): whether no range of the radar is the feature's, whatever is predicted
    barred: NDArray[np.bool_]

    def inside(
        self, noise: RangeNoise, widen_rad: float | Array, widen_m: float
    ) -> NDArray[np.bool_]:
        """Return whether each radar may have each feature in view, shape (r, n + w).

        The view is widened by as much; an angle may be given for each radar and feature.
        """
        return (
            (np.abs(self.off_boresight_rad) <= noise.field_of_view_rad / 2 + widen_rad)
            & (self.ranges_m >= noise.min_range_m - widen_m)
            & (self.ranges_m <= noise.max_range_m + widen_m)
        )

    def without_crowds(self, radars: Sequence[int], noise: RangeNoise, apart_m: float) -> View:
        """Return the view of some radars without what is as near in range to others in view."""
        inside = self.inside(noise, 0.0, apart_m)
        gaps = np.abs(self.ranges_m[:, :, None] - self.ranges_m[:, None, :])
        gaps[:, np.arange(gaps.shape[1]), np.arange(gaps.shape[1])] = math.inf
        crowded = np.zeros(inside.shape, dtype=np.bool_)
        crowded[radars] = np.any((gaps < apart_m) & inside[:, None, :], axis=2)[radars]
        return replace(self, off_boresight_rad=np.where(crowded, math.pi, self.off_boresight_rad))


def view(state: State, antennas: Antennas) -> View:
    R = rotation(state.heading_rad)
    body = (state.landmarks_m - state.position_m) @ R
    offsets = body[None, :, :] - antennas.position_m[:, None, :]
    ranges = np.hypot(offsets[..., 0], offsets[..., 1])
    bearings = np.arctan2(offsets[..., 1], offsets[..., 0])
    directions = (offsets / np.maximum(ranges, _LEAST_RANGE_M)[..., None]) @ R.T
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
    if state.radius_sigma_m:
        ranges = ranges - state.feature_radii_m
    c, s = np.cos(antennas.turns_rad), np.sin(antennas.turns_rad)
    turned = R @ np.stack([np.column_stack([c, -s]), np.column_stack([s, c])], axis=1)
    return View(
        ranges_m=ranges + state.offsets_m[:, None],
        off_boresight_rad=wrap_angles(bearings - antennas.yaw_rad[:, None]),
        directions=directions,
        by_feature=by_feature,
        turned=turned,
        barred=np.zeros(ranges.shape, dtype=np.bool_),
    )


def crossings(
    first_m: Sequence[float], second_m: Sequence[float], a: float, b: float
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return where circles of radii a and b [m] about two points cross, or None.

    The first crossing is on the left of the way from the first point to the second.
    """
    dx, dy = second_m[0] - first_m[0], second_m[1] - first_m[1]
    base = math.hypot(dx, dy)
    if base == 0.0:
        return None
    along = (a**2 - b**2 + base**2) / (2.0 * base)
    square = a**2 - along**2
    if square <= 0.0:
        return None
    dx, dy, across = dx / base, dy / base, math.sqrt(square)
    x, y = first_m[0] + along * dx, first_m[1] + along * dy
    return (x - across * dy, y + across * dx), (x + across * dy, y - across * dx)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Known:
    """The c features that some radar may have in view, and which ranges are theirs."""

    rows: Indices  # shape (c,)
    prior: Array  # shape (c, r, r): H P H^T between the radars, the features' own variances added
    assigned: Indices  # shape (k, 3): radar, index of its range, place in ``rows``
    # shape (s, c, 2), per side: whether it took part, and whether it was missed
    of_side: NDArray[np.bool_]
    unheard: NDArray[np.bool_]  # shape (c, r): surely in view, and no echo near its prediction
    at: Indices  # columns of the error that H has entries for
    H: Array  # shape (k, columns), of the assignment


def find_known(
    state: State,
    seen: View,
    scans: Sequence[RangeScan],
    side_of: Indices,
    parameters: BackEndParameters,
    *,
    beacons: Sequence[int] = (),
) -> Known:
    """Return the likeliest one-to-one assignment of ranges without labels to landmarks.

    ``side_of`` (r,) is the side of each radar. Those whose ranges the prior predicts less surely
    than the radars' ``sigma_m`` take no part, nor do the rows ``beacons``, whose ranges have labels
    and which do not answer every time.
    """
    noise, rule, gates = parameters.ranges, parameters.continuation, parameters.initialisation
    ranges_m, variances, blurred_m = _padded(scans, len(side_of), noise)
    has_frame = np.zeros(len(side_of), dtype=np.bool_)
    has_frame[[scan.radar for scan in scans]] = True
    margin_m = gates.gate_sigmas * noise.sigma_m
    inside = seen.inside(noise, rule.view_margin_rad, margin_m)[has_frame]
    inside[:, list(beacons)] = False
    rows = np.flatnonzero(inside.any(axis=0))
    layout, of_radars = state.layout, state.radar_columns
    at = np.concatenate([np.array([1, 2]), of_radars, layout.columns(rows)])
    block = state.P.block(at)
    widths = np.where(rows < layout.n_landmarks, layout.landmark_size, 2)
    first = 2 + len(of_radars) + np.cumsum(widths) - widths
    by_mount = np.zeros((0, 0, 0))
    if layout.has_mounts:
        by_mount = np.ascontiguousarray(-np.einsum("rni,rij->rnj", seen.directions, seen.turned))
    odds = noise.detection_probability / (1.0 - noise.detection_probability)
    prior, assigned, of_side, unheard, H = kernels.assign(
        seen.ranges_m,
        seen.off_boresight_rad,
        np.ascontiguousarray(seen.directions),
        np.ascontiguousarray(seen.by_feature),
        by_mount,
        rows,
        first,
        widths,
        np.square(state.feature_added_sigmas_m[rows]),
        block,
        has_frame,
        side_of,
        ranges_m,
        variances,
        blurred_m,
        seen.barred,
        np.array(
            [
                noise.field_of_view_rad / 2,
                noise.min_range_m,
                noise.max_range_m,
                rule.view_margin_rad,
                margin_m,
                gates.edge_rad,
                parameters.map.view_inset_m,
                noise.sigma_m**2,
                *chdtri([1, 2], TAIL_PROBABILITY),
                2.0 * math.log(noise.clutter_per_m / odds) + math.log(math.tau),
                math.hypot(noise.sigma_m, parameters.branches.model_sigma_m),
                gates.gate_sigmas,
                rule.blur_m,
            ]
        ),
    )
    return Known(
        rows=rows,
        prior=prior,
        assigned=assigned,
        of_side=of_side,
        unheard=unheard,
        at=at,
        H=H,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WeighedRanges:
    """The k ranges that are of known landmarks, and what they do to a state; shapes (k,)."""

    gain: Array  # shape (m, k), of the ranges in ``weighted``
    weighted: Array  # white innovations, weighted by Huber
    white: Array  # those before the weights
    # In nats, ln(Pd p / lambda), where p is the density of a range given those before it, and
    # lambda that of ranges in its scan, whatever they are of
    evidence: Array


def weigh_known(
    state: State, known: Known, seen: View, scans: Sequence[RangeScan], noise: RangeNoise
) -> WeighedRanges:
    """Weigh all ranges that are of known landmarks by Huber; the state stays as it is."""
    radars, rows = known.assigned[:, 0], known.rows[known.assigned[:, 2]]
    pairs, of_radar = known.assigned[:, :2].tolist(), {scan.radar: scan for scan in scans}
    ranges_m = np.array([of_radar[radar].ranges_m[index] for radar, index in pairs])
    sigmas_m = np.array([of_radar[radar].sigma(index, noise.sigma_m) for radar, index in pairs])
    gain, weighted, white, scales_m = kernels.weigh(
        state.P.columns(known.at),
        known.at,
        known.H,
        ranges_m - seen.ranges_m[radars, rows],
        np.square(sigmas_m) + np.square(state.feature_added_sigmas_m[rows]),
        noise.huber_sigmas,
        state.range_errors.variance_share,
    )
    span_m = noise.max_range_m - noise.min_range_m
    density = np.array([len(of_radar[radar].ranges_m) / span_m for radar, _ in pairs])
    odds = noise.detection_probability / np.maximum(density, noise.clutter_per_m)
    log_density = -0.5 * (np.square(white) + math.log(math.tau)) - np.log(scales_m)
    return WeighedRanges(
        gain=gain,
        weighted=weighted,
        white=white,
        evidence=np.log(odds) + log_density,
    )


def find_labelled(
    state: State,
    seen: View,
    scans: Sequence[RangeScan],
    row_of_label: Mapping[int, int],
    parameters: BackEndParameters,
) -> tuple[Known, list[tuple[int, int, int]]]:
    """Return the ranges whose labels say which landmark they are of, and those too far off for it.

    Each is judged by itself, whatever the field of view: radar, index and row of those further off
    than the quantile of chi-square are returned apart. ``row_of_label`` has the labels in the map.
    """
    layout, noise = state.layout, parameters.ranges
    found = [
        (scan.radar, index, row_of_label[label], scan.sigma(index, noise.sigma_m))
        for scan in scans
        for index, label in scan.labelled
        if label in row_of_label and 0.0 < scan.ranges_m[index] < LONGEST_M
    ]
    rows = np.array(sorted({row for _, _, row, _ in found}), dtype=np.intp)
    at = np.concatenate([np.array([1, 2]), state.radar_columns, layout.columns(rows)])
    block, added_m = state.P.block(at), state.feature_added_sigmas_m
    n_radars, k = len(state.offsets_m), layout.landmark_size
    of_radar = {scan.radar: scan for scan in scans}
    assigned, of_assigned, refused = [], [], []
    for radar, index, row, sigma_m in found:
        place = int(np.searchsorted(rows, row))
        first = 2 + len(state.radar_columns) + k * place
        h = np.zeros(len(at))
        h[:2], h[2 + radar] = -seen.directions[radar, row], 1.0
        if layout.has_mounts:
            mount = 2 + n_radars + 2 * radar
            h[mount : mount + 2] = -seen.directions[radar, row] @ seen.turned[radar]
        h[first : first + 2] = seen.by_feature[radar, row]
        if layout.has_radii:
            h[first + 2] = -1.0
        innovation_m = of_radar[radar].ranges_m[index] - float(seen.ranges_m[radar, row])
        variance = float(h @ block @ h) + sigma_m**2 + float(added_m[row]) ** 2
        if innovation_m**2 <= float(chdtri(1, TAIL_PROBABILITY)) * variance:
            assigned.append((radar, index, place))
            of_assigned.append(h)
        else:
            refused.append((radar, index, row))
    known = Known(
        rows=rows,
        prior=np.zeros((len(rows), n_radars, n_radars)),
        assigned=np.array(assigned, dtype=np.intp).reshape(-1, 3),
        of_side=np.zeros((0, len(rows), 2), dtype=np.bool_),
        unheard=np.zeros((len(rows), n_radars), dtype=np.bool_),
        at=at,
        H=np.array(of_assigned).reshape(-1, len(at)),
    )
    return known, refused


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointView:
    """Range and bearing of n landmarks as one radar should measure them."""

    predicted: Array  # shape (n, 2): range [m], offsets included, and bearing [rad] from boresight
    at: Indices  # shape (c,): columns of the error that H has entries for
    H: Array  # shape (n, 2, c)


def point_view(state: State, seen: View, radar: int, rows: Indices) -> PointView:
    """Return what a radar should measure of landmarks in some rows, and its derivatives."""
    layout, n = state.layout, len(rows)
    at = np.concatenate([np.array([1, 2]), state.radar_columns, layout.columns(rows)])
    u, ranges_m = seen.directions[radar, rows], seen.ranges_m[radar, rows]
    distances_m = ranges_m - state.offsets_m[radar] + state.feature_radii_m[rows]
    across = quarter_turn(u) / np.maximum(distances_m, _LEAST_RANGE_M)[:, None]
    by_place = np.stack([u, across], axis=1)
    H = np.zeros((n, 2, len(at)))
    H[:, :, :2], H[:, 0, 2 + radar] = -by_place, 1.0
    if layout.has_mounts:
        mount = 2 + layout.n_radars + 2 * radar
        H[:, :, mount : mount + 2] = -by_place @ seen.turned[radar]
    first = 2 + len(state.radar_columns) + layout.landmark_size * np.arange(n)
    for axis in range(2):
        H[np.arange(n), :, first + axis] = by_place[:, :, axis]
    if layout.has_radii:
        H[np.arange(n), 0, first + 2] = -1.0
    bearings_rad = seen.off_boresight_rad[radar, rows]
    return PointView(predicted=np.column_stack([ranges_m, bearings_rad]), at=at, H=H)


def point_variances(scan: RangeScan, indices: Sequence[int], noise: RangeNoise) -> Array:
    """Return the variances of range [m^2] and bearing [rad^2] of some detections, (k, 2)."""
    sigmas = [
        (
            scan.sigma(index, noise.sigma_m),
            noise.bearing_sigma_rad
            if scan.bearing_sigmas_rad is None
            else scan.bearing_sigmas_rad[index],
        )
        for index in indices
    ]
    return np.asarray(np.square(np.array(sigmas, dtype=np.float64).reshape(-1, 2)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointMatches:
    """What detections with bearings are against the map."""

    pairs: tuple[tuple[int, int], ...]  # index in the scan and row of its landmark
    # Of each pair, in nats: how much likelier it is than a new landmark; 0 of those with labels
    evidence: tuple[float, ...]
    refused: tuple[tuple[int, int], ...]  # the same of labelled ones too far off
    missed: tuple[int, ...]  # rows without labels surely in view, of which nothing was seen

    def without_mirrors(self, scan: RangeScan) -> PointMatches:
        """Return these without pairs of a detection whose mirror image is a likelier landmark."""
        ranked = [(nats, pair[0]) for nats, pair in zip(self.evidence, self.pairs, strict=True)]
        worth = {one[1]: one for one in ranked}

        def is_likelier(index: int) -> bool:
            both = scan.with_mirrors([index])
            return worth[index] == max(worth[one] for one in both if one in worth)

        kept = [is_likelier(index) for index, _ in self.pairs]
        return replace(
            self,
            pairs=tuple(compress(self.pairs, kept)),
            evidence=tuple(compress(self.evidence, kept)),
        )


def _maybe_in_view(
    state: State, seen: View, radar: int, parameters: BackEndParameters
) -> NDArray[np.bool_]:
    """Return which landmarks a radar may have in view, as uncertain as the pose is, (n + w,).

    What a detection is of may be predicted out of view. Were it left out, its neighbour would have
    no rival.
    """
    noise, gate_sigmas = parameters.ranges, parameters.initialisation.gate_sigmas
    sigmas = gate_sigmas * np.sqrt(state.pose_covariance().diagonal())
    spread_m, spread_rad = float(np.hypot(sigmas[0], sigmas[1])), float(sigmas[2])
    margin_rad = parameters.continuation.view_margin_rad + spread_rad
    inside = seen.inside(
        noise,
        margin_rad + np.arctan2(spread_m, np.abs(seen.ranges_m)),
        gate_sigmas * noise.sigma_m + spread_m,
    )[radar]
    inside[len(state.landmark_ids) :] = False
    return np.asarray(inside)


def find_points(
    state: State,
    seen: View,
    scan: RangeScan,
    waiting: tuple[Sequence[int], Collection[int], Mapping[int, int]],
    parameters: BackEndParameters,
) -> PointMatches:
    """Return which landmarks the detections of a scan with bearings are of.

    ``waiting`` are the indices to be assigned, the rows that have a detection, and rows by label.

    Labels decide where there are any; each of those is judged by itself. Of the others, the
    likeliest one-to-one assignment is looked for, with the costs of ranges. A pair is taken if the
    prior predicts the landmark more surely than the sensor measures it, or if it is certain: more
    likely by `MARGIN_NATS` than that the detection is new, than any other landmark for it, and than
    any other detection for the landmark.
    """
    assert scan.bearings_rad is not None
    noise, gates, radar = parameters.ranges, parameters.initialisation, scan.radar
    free, hit, row_of_label = waiting
    inside = _maybe_in_view(state, seen, radar, parameters)
    inside[list(hit)] = False
    named = {
        index: row_of_label[label]
        for index, label in scan.labelled
        if index in free and label in row_of_label and row_of_label[label] not in hit
    }
    others = [index for index in free if scan.labels is None or scan.labels[index] is None]
    rows = np.unique(np.concatenate([np.flatnonzero(inside), list(named.values())])).astype(np.intp)
    if not len(rows):
        return PointMatches(pairs=(), evidence=(), refused=(), missed=())
    points, indices = point_view(state, seen, radar, rows), [*named, *others]
    prior = points.H @ state.P.block(points.at) @ points.H.transpose(0, 2, 1)
    prior[:, 0, 0] += np.square(state.feature_added_sigmas_m[rows])
    measured = np.array([(scan.ranges_m[k], scan.bearings_rad[k]) for k in indices]).reshape(-1, 2)
    variances = point_variances(scan, indices, noise)
    nu = measured[:, None] - points.predicted
    nu[..., 1] = wrap_angles(nu[..., 1])
    S = prior + variances[:, None, :, None] * np.eye(2)
    distance = np.einsum("kni,knij,knj->kn", nu, np.linalg.inv(S), nu)
    is_near = distance <= float(chdtri(2, TAIL_PROBABILITY))
    place = {row: at for at, row in enumerate(rows.tolist())}
    pairs: list[tuple[int, int]] = []
    refused: list[tuple[int, int]] = []
    for k, (index, row) in enumerate(named.items()):
        (pairs if is_near[k, place[row]] else refused).append((index, row))
    against_new = [0.0] * len(pairs)
    k = len(named)
    odds = noise.detection_probability / (1.0 - noise.detection_probability)
    clutter = noise.clutter_per_m / noise.field_of_view_rad
    is_free = inside[rows] & ~np.isin(rows, list(row_of_label.values()))
    own, most = np.flatnonzero(is_free), gates.gate_sigmas**2
    if len(own) and others:
        log_n = -0.5 * (distance + np.linalg.slogdet(math.tau * S)[1])[k:, own]
        evidence = np.where(is_near[k:, own], log_n + math.log(odds / clutter), -math.inf)
        cost = np.hstack(
            [np.where(evidence > 0.0, -evidence, math.inf), np.zeros((len(others),) * 2)]
        )
        chosen = linear_sum_assignment(cost)[1]
        white = prior[own][None] / np.sqrt(variances[k:, None, :, None] * variances[k:, None, None])
        is_sure = np.linalg.eigvalsh(white)[..., -1] <= most
        # A square metre is the more radians wide, the nearer it is.
        unmapped = np.log(
            parameters.bearings(of_patches=scan.is_patch).unmapped_per_m2
            * (measured[k:, 0] * odds / clutter)
        )
        new = np.maximum(0.0, unmapped)
        for one, at in enumerate(chosen.tolist()):
            if at >= len(own):
                continue
            rivals = [new[one], *np.delete(evidence[one], at), *np.delete(evidence[:, at], one)]
            if is_sure[one, at] or evidence[one, at] - max(rivals) > MARGIN_NATS:
                against_new.append(float(evidence[one, at] - unmapped[one]))
                pairs.append((others[one], int(rows[own[at]])))
    inset, edge = parameters.map.view_inset_m, gates.edge_rad
    well = seen.inside(noise, -edge, -inset)[radar, rows]
    is_known = (
        np.linalg.eigvalsh(
            prior
            / np.array([noise.sigma_m, noise.bearing_sigma_rad])
            / np.array([[noise.sigma_m], [noise.bearing_sigma_rad]])
        )[:, -1]
        <= most
    )
    missed = rows[well & is_known & is_free & ~is_near.any(axis=0)]
    return PointMatches(
        pairs=tuple(pairs),
        evidence=tuple(against_new),
        refused=tuple(refused),
        missed=tuple(missed.tolist()),
    )


def _padded(
    scans: Sequence[RangeScan], n_radars: int, noise: RangeNoise
) -> tuple[Array, Array, Array]:
    """Return ranges and their variances (r, k), and blurred ranges (r, b), filled up with NaN."""
    n = max((len(scan.ranges_m) for scan in scans), default=0)
    n_blurred = max((len(scan.blurred_m) for scan in scans), default=0)
    ranges_m, variances = np.full((n_radars, n), np.nan), np.full((n_radars, n), np.nan)
    blurred_m = np.full((n_radars, n_blurred), np.nan)
    for scan in scans:
        k = len(scan.ranges_m)
        ranges_m[scan.radar, :k] = scan.ranges_m
        sigmas_m = noise.sigma_m if scan.sigmas_m is None else np.array(scan.sigmas_m)
        variances[scan.radar, :k] = np.square(sigmas_m)
        ranges_m[scan.radar, [index for index, _ in scan.labelled]] = np.nan
        blurred_m[scan.radar, : len(scan.blurred_m)] = scan.blurred_m
    return ranges_m, variances, blurred_m


Pairs = tuple[tuple[int, int], ...]
"""Things that may be one and the same, by row, id or another key."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Correspondence:
    """The statement that two things seen or mapped are one and the same."""

    pair: tuple[int, int]  # keys of things
    mahalanobis_sq: float
    evidence: float  # nats against their being two: ln N(residual; 0, S) - ln beta

    @property
    def is_possible(self) -> bool:
        return is_plausible(self.mahalanobis_sq, 2) and self.evidence > 0.0

    def contradicts(self, other: Correspondence) -> bool:
        """Return whether not both can be true: one thing would be two others."""
        return self.pair != other.pair and not set(self.pair).isdisjoint(other.pair)


def correspondence(
    pair: tuple[int, int], residual: Array, S: Array, density: float
) -> Correspondence:
    """Judge a pair of things by its residual (2,), with covariance S (2, 2).

    ``density`` is that of all things of the kind: how likely a chance neighbour is.
    """
    return correspondences([pair], residual[None], S[None], density)[0]


def correspondences(
    pairs: Iterable[tuple[int, int]], residuals: Array, S: Array, density: float
) -> list[Correspondence]:
    """Judge k pairs of things likewise, by residuals (k, 2) with covariances S (k, 2, 2)."""
    distances = (residuals[:, None] @ np.linalg.solve(S, residuals[..., None])).ravel()
    evidence = -0.5 * (distances + np.linalg.slogdet(math.tau * S)[1]) - math.log(density)
    return [
        Correspondence(pair=pair, mahalanobis_sq=distance, evidence=nats)
        for pair, distance, nats in zip(pairs, distances.tolist(), evidence.tolist(), strict=True)
    ]


def certain(
    judged: Sequence[Correspondence], refused: Collection[tuple[int, int]] = ()
) -> Correspondence | None:
    """Return the likeliest of those that are possible and that nothing speaks against.

    That all things are new, and each correspondence that contradicts it, possible or not, must be
    less likely by `MARGIN_NATS`. Those of the pairs ``refused`` are not returned.
    """
    ranked = sorted(judged, key=lambda one: -one.evidence)
    for one in ranked:
        if not one.is_possible or one.pair in refused:
            continue
        # The likeliest of its rivals comes first.
        least = next((other.evidence for other in ranked if one.contradicts(other)), 0.0)
        if one.evidence - max(0.0, least) > MARGIN_NATS:
            return one
    return None


def density_per_m2(points_m: Array, reach_m: float) -> float:
    """Return how many landmarks a square metre has where there are some; points (n, 2) [m].

    That is the mean number of others within reach of each, so that the emptiness between the arms
    of a course does not count, and not less than that of a single one.
    """
    others = 0.0
    if len(points_m) > 1:
        others = 2.0 * len(cKDTree(points_m).query_pairs(reach_m)) / len(points_m)
    return max(others, 1.0) / (math.pi * reach_m**2)


def predicted_ranges(
    state: State, seen: View, known: Known, side_of: Indices, antennas: Antennas
) -> tuple[PredictedRange, ...]:
    """Return the ranges of landmarks that could continue a track, before any is looked at.

    Those of walls are left out: their echoes have no fixed place to compare with a true landmark's.
    """
    which = [
        (radar, row, float(known.prior[place, radar, radar]))
        for side, place in np.argwhere(known.of_side[:, :, 0]).tolist()
        if (row := int(known.rows[place])) < len(state.landmark_ids)
        for radar in np.flatnonzero((side_of == side) & antennas.has_frame).tolist()
        if not seen.barred[radar, row]
    ]
    return ranges_predicted(state, seen, antennas, which)


def ranges_predicted(
    state: State, seen: View, antennas: Antennas, which: Iterable[tuple[int, int, float]]
) -> tuple[PredictedRange, ...]:
    """Return the predictions for radars and rows of landmarks, with variances [m^2]."""
    places = antennas.position_m.tolist()
    points = (state.landmarks_m - state.position_m) @ rotation(state.heading_rad)
    return tuple(
        PredictedRange(
            radar=radar,
            landmark_id=state.landmark_ids[row],
            range_m=float(seen.ranges_m[radar, row]),
            variance=variance,
            antenna_m=(places[radar][0], places[radar][1]),
            point_m=(float(points[row, 0]), float(points[row, 1])),
        )
        for radar, row, variance in which
    )
