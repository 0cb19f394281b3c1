"""New landmarks: ranges of the last frames that one point at rest explains.

A point is guessed from ranges of the newest frame and followed back through the frames along
odometry by a small Kalman filter on its position in the newest body frame; each frame gives the
unused range nearest to the prediction, if it passes the gate. The guess is accepted if enough
frames hold it and its residuals are as small as those of a point at rest: clutter has no past, and
a ghost, the fix of two ranges of different targets, does not stay at rest while the robot moves.

A point b with noise n and known dependence D_b on the radars' range offsets measures

    y = b - R^T (l - p),   H = [e_p: -R^T, e_l: R^T, e_b: -D_b],   S = H P H^T + C_b,

and a new landmark is l = p + R b with e_l = e_p + R D_b e_b + R n: correlated with all that the
pose is correlated with. (In right-invariant errors the heading enters neither.)

Points measured with range and bearing, b = R^T (l - p) in the body frame, z = (|b|, atan2(b_y,
b_x)) and G = dz / db, have ``H = [e_p: -G R^T, e_l: G R^T]``. They are matched to the landmarks of
least Mahalanobis distance, all points of one time together and no landmark twice, or by label.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from slam.geometry import compose, wrap_angle
from slam.robust.association import LONGEST_M, Antennas, RangeScan, fix_of_pair
from slam.robust.parameters import (
    BackEndParameters,
    MapRule,
    PointRule,
    RangeNoise,
    TrackletRule,
    chi_square_limit,
)
from slam.robust.state import POSITION, Array, Indices, Motion, State, rotation

_SEED_MARGIN_RAD = 0.05
MEMBER_MARGIN_RAD = 0.1
_SINGLE_BEARINGS_RAD = (0.0, -0.25, 0.25, -0.5, 0.5)
_SINGLE_SPREAD_RAD = 0.2
_SINGLE_RANGE_SIGMA_M = 0.05
_FORBIDDEN = 1e9
# What one degree of freedom is worth against chi-square, where tracklets compete
_DOF_WORTH = 4.0
_LEAST_WAY_M = 1e-6
# Offsets surer than this share of a range's standard deviation are taken for known.
_KNOWN_SHARE = 0.1
# Gauss-Newton steps of a fit with offsets, and what keeps its matrices regular
_STEPS, _PRIOR_FLOOR_M2, _LEAST_INFORMATION = 4, 1e-12, 1e-9


@dataclass(frozen=True, slots=True)
class UnassignedRange:
    """One range that is of no landmark and no tracklet yet."""

    range_m: float
    label: int | None  # of its target, where known
    sigma_m: float
    alone: bool = True  # whether no other echo overlaps its own


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenFrame:
    """One frame: where the antennas were in the odometry frame, and the ranges still unused."""

    pose_index: int  # index of its pose in the run
    pose: Array  # shape (3,), odometry frame
    # Way and turn since the start, always growing
    path_m: float
    turned_rad: float
    antennas: Antennas  # in the odometry frame
    mounts_m: Array  # shape (r, 2), the antennas in the body frame of the pose
    unused: tuple[list[UnassignedRange], ...]  # one list per radar; a range that is used is removed


@dataclass(frozen=True, slots=True)
class Slot:
    """One radar's share of one earlier frame."""

    back: int  # how many frames ago
    radar: int
    # The antenna then, in the newest body frame
    x_m: float
    y_m: float
    yaw_rad: float
    drift: float  # variance [m^2] that odometry since then adds to a range
    unused: list[UnassignedRange]
    antenna_then: tuple[float, float]  # in the body frame of then


class UnassignedRanges:
    """The unused ranges of the last frames, and the way of the robot between them.

    ``sigma_m`` is for ranges whose scan has none; ``drift_per_m`` and ``drift_per_rad_m`` are what
    the standard deviation of a range gains per metre of way back, and per radian of turn.
    """

    def __init__(
        self, capacity: int, sigma_m: float, drift_per_m: float, drift_per_rad_m: float
    ) -> None:
        self._sigma_m = sigma_m
        self._frames: deque[SeenFrame] = deque(maxlen=capacity)
        self._drift_per_m = drift_per_m
        self._drift_per_rad_m = drift_per_rad_m
        self._pose = np.zeros(3)
        self._path_m = 0.0
        self._turned_rad = 0.0

    def move(self, motion: Motion) -> None:
        step = np.array([motion.step_m[0], motion.step_m[1], motion.turn_rad])
        self._pose = compose(self._pose, step)
        self._path_m += motion.distance_m
        self._turned_rad += abs(motion.turn_rad)

    def clear(self) -> None:
        """Forget all frames: they were taken at another place."""
        self._frames.clear()

    def keep(
        self,
        pose_index: int,
        antennas: Antennas,
        scans: Sequence[RangeScan],
        used: set[tuple[int, int]],
    ) -> None:
        """Store a frame without the ranges used, given as (radar, index)."""
        unused: tuple[list[UnassignedRange], ...] = tuple([] for _ in antennas.yaw_rad)
        for scan in scans:
            unused[scan.radar].extend(
                UnassignedRange(
                    range_m,
                    scan.label(index),
                    scan.sigma(index, self._sigma_m),
                    scan.is_alone(index),
                )
                for index, range_m in enumerate(scan.ranges_m)
                if (scan.radar, index) not in used and 0.0 < range_m < LONGEST_M
            )
        turn = rotation(self._pose[2])
        self._frames.append(
            SeenFrame(
                pose_index=pose_index,
                pose=self._pose,
                path_m=self._path_m,
                turned_rad=self._turned_rad,
                antennas=Antennas(
                    position_m=antennas.position_m @ turn.T + self._pose[:2],
                    yaw_rad=antennas.yaw_rad + self._pose[2],
                    has_frame=antennas.has_frame,
                ),
                mounts_m=antennas.position_m,
                unused=unused,
            )
        )

    def newest(self) -> SeenFrame:
        return self._frames[-1]

    def pose_index(self, back: int) -> int:
        return self._frames[-1 - back].pose_index

    def slots(self, radars: Sequence[int], window: int) -> list[list[Slot]]:
        """Return the last frames, newest first, as some radars saw them."""
        now = self._frames[-1]
        R = rotation(now.pose[2])
        frames: list[list[Slot]] = []
        for back in range(min(window, len(self._frames))):
            frame = self._frames[-1 - back]
            way, turn = now.path_m - frame.path_m, now.turned_rad - frame.turned_rad
            drift = (self._drift_per_m * way) ** 2 + (self._drift_per_rad_m * turn) ** 2
            places = ((frame.antennas.position_m - now.pose[:2]) @ R).tolist()
            yaws = (frame.antennas.yaw_rad - now.pose[2]).tolist()
            then = frame.mounts_m.tolist()
            frames.append(
                [
                    Slot(
                        back,
                        radar,
                        places[radar][0],
                        places[radar][1],
                        math.remainder(yaws[radar], math.tau),
                        drift,
                        frame.unused[radar],
                        (then[radar][0], then[radar][1]),
                    )
                    for radar in radars
                    if frame.antennas.has_frame[radar]
                ]
            )
        return frames


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyPoint:
    """A point in the newest body frame."""

    point_m: Array  # shape (2,)
    covariance: Array  # shape (2, 2)
    by_offsets: Array  # shape (2, r), d(point) / d(range offsets)
    # shape (2,): away from where it was seen from, where the axis of a round target lies
    outward: Array | None = None


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

    @property
    def log_det(self) -> float:
        return math.log(float(np.linalg.det(self.S)))


def point_rows(state: State, row: int, point: BodyPoint) -> FeatureRows:
    R = rotation(state.heading_rad)
    offsets = np.arange(state.offsets.start, state.offsets.stop)
    at = np.concatenate([np.array([1, 2]), offsets, state.landmark_columns(np.array([row]))])
    H = np.hstack([-R.T, -point.by_offsets, R.T])
    S = H @ state.P.block(at) @ H.T + point.covariance
    seen_m = point.point_m
    if point.outward is not None and (radius_m := state.radii_m.get(state.landmark_ids[row], 0.0)):
        seen_m = seen_m + radius_m * point.outward
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


def match(
    state: State, point: BodyPoint, rule: MapRule, old_map: Collection[int] = ()
) -> int | None:
    """Return the row of the landmark that a point is, or None where no match is clear.

    A match must pass the gate, be likelier than a landmark not yet in the map,
    ``N(residual; 0, S) > beta``, and beat the next best in ``d^2 + ln det S``. Landmarks of the
    ``old_map``, by id, are not considered.
    """
    scored = []
    for row in near_rows(state, point, rule.merge_reach_m):
        if state.landmark_ids[row] in old_map:
            continue
        rows = point_rows(state, int(row), point)
        scored.append((rows.mahalanobis_sq + rows.log_det, rows.mahalanobis_sq, int(row)))
    return clear_match(scored, rule.match_gate, rule.unmapped_per_m2, rule.match_margin)


def clear_match(
    scored: list[tuple[float, float, int]], gate: float, density: float, margin: float
) -> int | None:
    """Return the row of the best (d^2 + ln det S, d^2, row), or None where no match is clear."""
    if not scored:
        return None
    scored.sort()
    score, distance, best = scored[0]
    if distance > gate:
        return None
    if -0.5 * score - math.log(math.tau) <= math.log(density):
        return None
    if len(scored) > 1 and scored[1][0] - score < margin:
        return None
    return best


def update_with_point(state: State, row: int, point: BodyPoint) -> float:
    """Correct the state with a point that is the landmark in ``row``; return the NIS."""
    rows = point_rows(state, row, point)
    return state.update(rows.at, rows.H, rows.residual, point.covariance)


def initialise_landmark(state: State, point: BodyPoint) -> int:
    R = rotation(state.heading_rad)
    at = np.arange(state.offsets.stop)
    columns = state.P.columns(at)
    G = np.zeros((2, len(at)))
    G[:, POSITION] = np.eye(2)
    G[:, state.offsets] = R @ point.by_offsets
    cross = columns @ G.T
    corner = G @ cross[at] + R @ point.covariance @ R.T
    return state.augment(state.position_m + R @ point.point_m, cross, (corner + corner.T) / 2)


@dataclass(frozen=True, slots=True)
class Member:
    """One range of a tracklet and its slot."""

    slot: Slot
    measured: UnassignedRange


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Guess:
    """Where a target may be, in the newest body frame: mean (2,) and covariance (2, 2)."""

    target: Array
    covariance: Array
    label: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracklet:
    """A target at rest in the newest body frame, and the ranges that it explains."""

    target: Array  # shape (2,): a point [m], or phi [rad] and d [m] of a wall
    covariance: Array  # shape (2, 2), for the range offsets of the state
    by_offsets: Array  # shape (2, r), d(target) / d(offsets)
    members: tuple[Member, ...]  # newest first
    # Of the residuals
    chi_square: float
    dof: int
    share: float  # part of the frames with the target in view that hold a member
    label: int | None

    @property
    def score(self) -> float:
        """Return 4 dof - chi-square, by which tracklets compete for ranges."""
        return _DOF_WORTH * self.dof - self.chi_square

    @property
    def antennas_m(self) -> Array:
        """Return where the antennas of the members were, shape (k, 2)."""
        return np.array([(member.slot.x_m, member.slot.y_m) for member in self.members])

    def body_point(self) -> BodyPoint:
        away = self.target - np.mean(self.antennas_m, axis=0)
        return BodyPoint(
            point_m=self.target,
            covariance=self.covariance,
            by_offsets=self.by_offsets,
            outward=away / max(math.hypot(away[0], away[1]), _LEAST_WAY_M),
        )


def pair_guesses(newest: Sequence[Slot], noise: RangeNoise, rule: TrackletRule) -> list[Guess]:
    """Return the fixes of all pairs of unused ranges inside both fields of view."""
    guesses = []
    spread = rule.prior_sigma_m**2 * np.eye(2)
    for first, second in combinations(newest, 2):
        ahead = np.array([math.cos(first.yaw_rad), math.sin(first.yaw_rad)])
        here, there = np.array([first.x_m, first.y_m]), np.array([second.x_m, second.y_m])
        for a, b in product(first.unused, second.unused):
            if a.label != b.label:
                continue
            for side in (ahead, -ahead):
                point = fix_of_pair(here, there, a.range_m, b.range_m, side)
                if point is None:
                    break
                if _in_view(point, first, noise) and _in_view(point, second, noise):
                    guesses.append(Guess(target=point, covariance=spread, label=a.label))
    return guesses


def single_guesses(newest: Sequence[Slot]) -> list[Guess]:
    """Return, for each unused range of a radar without partner, points on its arc."""
    guesses = []
    for slot in newest:
        for measured in slot.unused:
            for off in _SINGLE_BEARINGS_RAD:
                u = np.array([math.cos(slot.yaw_rad + off), math.sin(slot.yaw_rad + off)])
                across = (_SINGLE_SPREAD_RAD * measured.range_m) ** 2
                along = _SINGLE_RANGE_SIGMA_M**2
                guesses.append(
                    Guess(
                        target=np.array([slot.x_m, slot.y_m]) + measured.range_m * u,
                        covariance=across * np.eye(2) + (along - across) * np.outer(u, u),
                        label=measured.label,
                    )
                )
    return guesses


def _in_view(point: Array, slot: Slot, noise: RangeNoise) -> bool:
    dx, dy = float(point[0]) - slot.x_m, float(point[1]) - slot.y_m
    off = math.remainder(math.atan2(dy, dx) - slot.yaw_rad, math.tau)
    return abs(off) <= noise.field_of_view_rad / 2 + _SEED_MARGIN_RAD


class Tracker:
    """Follows guesses back in time.

    ``offsets_m`` (r,) and ``offset_covariance`` (r, r) are the radars' range offsets in the state.
    """

    def __init__(
        self, parameters: BackEndParameters, offsets_m: Array, offset_covariance: Array
    ) -> None:
        self._noise, self._rule = parameters.ranges, parameters.tracklets
        self._offsets: list[float] = offsets_m.tolist()
        self._offset_covariance = offset_covariance
        self._offset_variances: list[float] = offset_covariance.diagonal().tolist()
        least = (_KNOWN_SHARE * self._noise.sigma_m) ** 2
        self._offsets_known = max(self._offset_variances, default=0.0) <= least

    def follow(self, guess: Guess, frames: Sequence[Sequence[Slot]]) -> Tracklet:
        """Return the ranges that follow a guess; found twice, again from the first result."""
        first = self._walk(guess, frames)
        second = self._walk(replace(guess, target=first.target), frames)
        return second if self._offsets_known else self._with_free_offsets(second)

    def _sight(self, x: float, y: float, slot: Slot) -> tuple[float, float, float, float]:
        """Return a target's range, its angle off boresight, and d(range) / d(target)."""
        dx, dy = x - slot.x_m, y - slot.y_m
        distance = math.sqrt(dx * dx + dy * dy)
        if distance == 0.0:
            return 0.0, math.inf, 0.0, 0.0
        off = abs(math.remainder(math.atan2(dy, dx) - slot.yaw_rad, math.tau))
        return distance, off, dx / distance, dy / distance

    def _walk(self, guess: Guess, frames: Sequence[Sequence[Slot]]) -> Tracklet:
        """Filter the target backwards; plain floats, the loop is short and runs often."""
        x, y = float(guess.target[0]), float(guess.target[1])
        cxx, cxy, cyy = (float(guess.covariance[i]) for i in ((0, 0), (0, 1), (1, 1)))
        noise, rule = self._noise, self._rule
        half_view = noise.field_of_view_rad / 2
        gate_sq = rule.gate_sigmas**2
        n_radars = len(self._offsets)
        dx_do, dy_do = [0.0] * n_radars, [0.0] * n_radars
        members: list[Member] = []
        chi_square = 0.0
        in_view, hit = 0, 0
        for slots in frames:
            sees = hits = False
            for slot in slots:
                distance, off, ux, uy = self._sight(x, y, slot)
                if off <= half_view and noise.min_range_m <= distance <= noise.max_range_m:
                    sees = True
                if off > half_view + MEMBER_MARGIN_RAD or not slot.unused:
                    continue
                radar = slot.radar
                expected = distance + self._offsets[radar]
                nearest, nu = None, math.inf
                for measured in slot.unused:
                    miss = measured.range_m - expected
                    if abs(miss) < abs(nu) and measured.label == guess.label:
                        nearest, nu = measured, miss
                if nearest is None:
                    continue
                px, py = cxx * ux + cxy * uy, cxy * ux + cyy * uy
                variance = nearest.sigma_m**2 + slot.drift
                s = ux * px + uy * py + variance + self._offset_variances[radar]
                if nu * nu > gate_sq * s:
                    continue
                kx, ky = px / s, py / s
                x, y = x + kx * nu, y + ky * nu
                cxx, cxy, cyy = cxx - kx * px, cxy - kx * py, cyy - ky * py
                for other in range(n_radars):
                    change = ux * dx_do[other] + uy * dy_do[other] + (other == radar)
                    dx_do[other] -= kx * change
                    dy_do[other] -= ky * change
                chi_square += nu * nu / s
                members.append(Member(slot, nearest))
                hits = True
            in_view += sees or hits
            hit += hits
        return Tracklet(
            target=np.array([x, y]),
            covariance=np.array([[cxx, cxy], [cxy, cyy]]),
            by_offsets=np.array([dx_do, dy_do]),
            members=tuple(members),
            chi_square=chi_square,
            dof=len(members) - 2,
            share=hit / max(in_view, 1),
            label=guess.label,
        )

    def _with_free_offsets(self, walked: Tracklet) -> Tracklet:
        """Judge the members by a point *and* the radars' common offsets, which are uncertain.

        Least squares over point and offset errors o ~ N(0, offset covariance). The point is
        returned for the offsets of the state, moved along d(point) / d(offsets) from the
        least-squares solution, where the linearisation is right.
        """
        if walked.dof < 1:
            return walked
        radars = sorted({member.slot.radar for member in walked.members})
        place = np.array([radars.index(member.slot.radar) for member in walked.members])
        antennas = walked.antennas_m
        z = np.array([m.measured.range_m - self._offsets[m.slot.radar] for m in walked.members])
        variance = np.array([m.measured.sigma_m**2 + m.slot.drift for m in walked.members])
        offset_part = np.zeros((len(z), len(radars)))
        offset_part[np.arange(len(z)), place] = 1.0
        prior = self._offset_covariance[np.ix_(radars, radars)]
        prior = np.asarray(np.linalg.inv(prior + _PRIOR_FLOOR_M2 * np.eye(len(radars))))
        point, offsets = walked.target.copy(), np.zeros(len(radars))
        for _ in range(_STEPS):
            away = point - antennas
            distance = np.hypot(away[:, 0], away[:, 1])
            u = away / distance[:, None]
            residual = z - distance - offset_part @ offsets
            J = np.hstack([u, offset_part])
            information = (J.T / variance) @ J
            information[2:, 2:] += prior
            gradient = (J.T / variance) @ residual
            gradient[2:] -= prior @ offsets
            change = np.linalg.solve(
                information + _LEAST_INFORMATION * np.eye(len(information)), gradient
            )
            point, offsets = point + change[:2], offsets + change[2:]
        covariance = np.linalg.inv((u.T / variance) @ u + np.eye(2) / self._rule.prior_sigma_m**2)
        by_offsets = np.zeros((2, len(self._offsets)))
        by_offsets[:, radars] = -covariance @ (u.T / variance) @ offset_part
        return replace(
            walked,
            target=point - by_offsets[:, radars] @ offsets,
            covariance=covariance,
            by_offsets=by_offsets,
            chi_square=float(residual @ (residual / variance) + offsets @ prior @ offsets),
        )


def is_believable(tracklet: Tracklet, n_radars: int, rule: TrackletRule) -> bool:
    """Return whether a tracklet is evidence of a point at rest; ``n_radars`` is 1 or 2."""
    frames = {member.slot.back for member in tracklet.members}
    alone = n_radars == 1
    if len(frames) < (rule.single_min_frames if alone else rule.min_frames):
        return False
    if not is_consistent(tracklet, n_radars, rule):
        return False
    if alone:
        spread = float(np.linalg.eigvalsh(tracklet.covariance)[-1])
        if spread > rule.single_max_sigma_m**2:
            return False
    return True


def is_consistent(tracklet: Tracklet, n_radars: int, rule: TrackletRule) -> bool:
    """Return whether enough radars and frames hold it, with residuals as small as their noise."""
    hits = Counter(member.slot.radar for member in tracklet.members)
    if len(hits) < n_radars or min(hits.values()) < rule.min_hits_per_radar:
        return False
    limit = chi_square_limit(tracklet.dof, rule.excess_sigmas)
    return tracklet.share >= rule.min_share and tracklet.chi_square <= limit


def best_first(
    tracker: Tracker,
    guesses: Sequence[Guess],
    frames: Sequence[Sequence[Slot]],
    accepts: Callable[[Tracklet], bool],
) -> list[Tracklet]:
    """Return the accepted tracklets, best first; their ranges are taken out of the frames."""
    found: list[Tracklet] = []
    waiting = list(guesses)
    while waiting:
        followed = [(tracker.follow(guess, frames), guess) for guess in waiting]
        accepted = [pair for pair in followed if accepts(pair[0])]
        if not accepted:
            break
        best, chosen = max(accepted, key=lambda pair: pair[0].score)
        for member in best.members:
            member.slot.unused.remove(member.measured)
        found.append(best)
        # What is left may have lost its ranges: follow it again.
        waiting = [guess for _, guess in accepted if guess is not chosen]
    return found


def find_tracklets(
    tracker: Tracker,
    guesses: Sequence[Guess],
    frames: Sequence[Sequence[Slot]],
    n_radars: int,
    rule: TrackletRule,
    *,
    is_point: Callable[[Tracklet], bool] | None = None,
) -> list[Tracklet]:
    """Return the tracklets of points, as `best_first` does; ``is_point`` is the last test."""
    available: dict[int, int] = {}
    for slots in frames:
        for slot in slots:
            available[slot.radar] = available.get(slot.radar, 0) + bool(slot.unused)
    if len(available) < n_radars or min(available.values()) < rule.min_hits_per_radar:
        return []

    def accepts(tracklet: Tracklet) -> bool:
        if not is_believable(tracklet, n_radars, rule):
            return False
        return is_point is None or tracklet.label is not None or is_point(tracklet)

    return best_first(tracker, guesses, frames, accepts)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeBearing:
    """One point: range and bearing in the body frame, covariance (2, 2)."""

    range_m: float
    bearing_rad: float
    covariance: Array
    label: int | None = None  # of the target, where known

    @property
    def values(self) -> Array:
        return np.array([self.range_m, self.bearing_rad])

    def body_point(self, n_radars: int) -> BodyPoint:
        c, s = math.cos(self.bearing_rad), math.sin(self.bearing_rad)
        G = np.array([[c, -self.range_m * s], [s, self.range_m * c]])
        return BodyPoint(
            point_m=self.range_m * np.array([c, s]),
            covariance=G @ self.covariance @ G.T,
            by_offsets=np.zeros((2, n_radars)),
        )


def range_bearing_rows(state: State, row: int, seen: RangeBearing) -> FeatureRows:
    R = rotation(state.heading_rad)
    b = R.T @ (state.landmarks_m[row] - state.position_m)
    q = float(b @ b)
    r = math.sqrt(q)
    G = np.array([[b[0] / r, b[1] / r], [-b[1] / q, b[0] / q]]) @ R.T
    at = np.concatenate([np.array([1, 2]), state.landmark_columns(np.array([row]))])
    H = np.hstack([-G, G])
    S = H @ state.P.block(at) @ H.T + seen.covariance
    residual = seen.values - np.array([r, math.atan2(b[1], b[0])])
    residual[1] = wrap_angle(float(residual[1]))
    return FeatureRows(residual=residual, at=at, H=H, S=(S + S.T) / 2)


def named_rows(
    state: State, points: Sequence[RangeBearing], landmark_of_label: Mapping[int, int]
) -> list[int | None] | None:
    """Return the rows of labelled points, -1 for new ones; None if a point has no label."""
    labels = [point.label for point in points if point.label is not None]
    if len(labels) < len(points):
        return None
    known = {id_: row for row, id_ in enumerate(state.landmark_ids)}
    return [known.get(landmark_of_label.get(label, -1), -1) for label in labels]


def assign(state: State, points: Sequence[RangeBearing], rule: PointRule) -> list[int | None]:
    """Return for each point the row of its landmark, -1 for a new one, None if ambiguous.

    A point nearer than the rule's ``new_gate`` but not assigned is ambiguous.
    """
    if not points:
        return []
    n = len(state.landmark_ids)
    cost = np.full((len(points), n + len(points)), _FORBIDDEN)
    nearest = np.full(len(points), math.inf)
    for i, point in enumerate(points):
        cost[i, n + i] = rule.gate
        for row in near_rows(state, point.body_point(0), rule.reach_m):
            distance = range_bearing_rows(state, int(row), point).mahalanobis_sq
            nearest[i] = min(nearest[i], distance)
            if distance < rule.gate:
                cost[i, row] = distance
    new = [-1 if distance > rule.new_gate else None for distance in nearest.tolist()]
    columns = linear_sum_assignment(cost)[1].tolist()
    return [column if column < n else new[i] for i, column in enumerate(columns)]
