"""Tracklets: ranges of the last frames that one point at rest explains.

A point is guessed from ranges of now and followed back through the frames in odometry by a small
Kalman filter on its position in the body frame of now; each frame gives the unused range nearest
to the prediction, if it is near enough. The guess is believed if enough frames hold it and its
residuals are as small as those of a point at rest: clutter has no past, and a ghost, the fix of
two ranges of different targets, does not stay at rest while the robot moves.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from slam.robust.births import BodyPoint
from slam.robust.leftovers import Leftover, Slot
from slam.robust.parameters import RangeNoise, TrackletRule
from slam.robust.ranges import fix_of_pair
from slam.robust.symmetric import Array

_SEED_MARGIN_RAD = 0.05
_MEMBER_MARGIN_RAD = 0.1
_SINGLE_BEARINGS_RAD = (0.0, -0.25, 0.25, -0.5, 0.5)
_SINGLE_SPREAD_RAD = 0.2
_SINGLE_RANGE_SIGMA_M = 0.05


@dataclass(frozen=True, slots=True)
class Member:
    """One range of a tracklet, and where its slot is."""

    slot: Slot
    leftover: Leftover


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Guess:
    """Where a point may be, in the body frame of now: mean (2,) and covariance (2, 2)."""

    point_m: Array
    covariance: Array
    label: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracklet:
    """A point at rest, and the ranges that say so.

    Attributes
    ----------
    point_m, covariance
        In the body frame of now, shapes (2,) and (2, 2), for the range offsets given.
    by_offsets
        shape (2, r), d(point) / d(offsets).
    members
        Newest first.
    chi_square, dof
        Of the residuals.
    share
        Part of the frames with the point in view that hold a member.
    """

    point_m: Array
    covariance: Array
    by_offsets: Array
    members: tuple[Member, ...]
    chi_square: float
    dof: int
    share: float
    label: int | None

    def body_point(self) -> BodyPoint:
        """Return it as a point seen from the body of now."""
        antennas = [(member.slot.x_m, member.slot.y_m) for member in self.members]
        away = self.point_m - np.mean(antennas, axis=0)
        return BodyPoint(
            point_m=self.point_m,
            covariance=self.covariance,
            by_offsets=self.by_offsets,
            outward=away / max(math.hypot(away[0], away[1]), 1e-6),
        )

    @property
    def score(self) -> float:
        """Return 4 dof - chi-square, by which tracklets compete for ranges."""
        return 4.0 * self.dof - self.chi_square


def guesses_of(
    newest: Sequence[Slot], radars: Sequence[int], noise: RangeNoise, rule: TrackletRule
) -> list[Guess]:
    """Return the guesses of what radars of one side saw in the newest frame."""
    return single_guesses(newest) if len(radars) == 1 else pair_guesses(newest, noise, rule)


def pair_guesses(newest: Sequence[Slot], noise: RangeNoise, rule: TrackletRule) -> list[Guess]:
    """Return the fixes of all pairs of unused ranges of now inside both fields of view."""
    guesses = []
    for place, first in enumerate(newest):
        for second in newest[place + 1 :]:
            ahead = np.array([math.cos(first.yaw_rad), math.sin(first.yaw_rad)])
            here, there = np.array([first.x_m, first.y_m]), np.array([second.x_m, second.y_m])
            for a in first.unused:
                for b in second.unused:
                    if a.label != b.label:
                        continue
                    point = fix_of_pair(here, there, a.range_m, b.range_m, ahead)
                    if point is None or not (
                        _in_view(point, first, noise) and _in_view(point, second, noise)
                    ):
                        continue
                    spread = rule.prior_sigma_m**2 * np.eye(2)
                    guesses.append(Guess(point_m=point, covariance=spread, label=a.label))
    return guesses


def single_guesses(newest: Sequence[Slot]) -> list[Guess]:
    """Return, for each unused range of a radar alone, points on its arc."""
    guesses = []
    for slot in newest:
        for leftover in slot.unused:
            for off in _SINGLE_BEARINGS_RAD:
                u = np.array([math.cos(slot.yaw_rad + off), math.sin(slot.yaw_rad + off)])
                across = (_SINGLE_SPREAD_RAD * leftover.range_m) ** 2
                along = _SINGLE_RANGE_SIGMA_M**2
                guesses.append(
                    Guess(
                        point_m=np.array([slot.x_m, slot.y_m]) + leftover.range_m * u,
                        covariance=across * np.eye(2) + (along - across) * np.outer(u, u),
                        label=leftover.label,
                    )
                )
    return guesses


def _in_view(point: Array, slot: Slot, noise: RangeNoise) -> bool:
    dx, dy = float(point[0]) - slot.x_m, float(point[1]) - slot.y_m
    off = math.remainder(math.atan2(dy, dx) - slot.yaw_rad, math.tau)
    return abs(off) <= noise.field_of_view_rad / 2 + _SEED_MARGIN_RAD


class Tracker:
    """Follows guesses back in time.

    Parameters
    ----------
    noise, rule
        Of the radars, and of what is believed.
    offsets_m, offset_covariance
        What the state knows of the radars' range offsets, shapes (r,) and (r, r).
    """

    def __init__(
        self, noise: RangeNoise, rule: TrackletRule, offsets_m: Array, offset_covariance: Array
    ) -> None:
        self._noise, self._rule = noise, rule
        self._offsets: list[float] = offsets_m.tolist()
        self._offset_covariance = offset_covariance
        self._doubt: list[float] = offset_covariance.diagonal().tolist()
        self._offsets_known = max(self._doubt, default=0.0) <= (0.1 * noise.sigma_m) ** 2

    def follow(self, guess: Guess, frames: Sequence[Sequence[Slot]]) -> Tracklet:
        """Return what the last frames hold of a guess; twice, from the result of the first."""
        first = self._walk(guess, frames)
        again = Guess(point_m=first.point_m, covariance=guess.covariance, label=guess.label)
        second = self._walk(again, frames)
        return second if self._offsets_known else self._with_free_offsets(second)

    def _walk(self, guess: Guess, frames: Sequence[Sequence[Slot]]) -> Tracklet:
        """Filter the position backwards; plain floats, the loop is short and runs often."""
        x, y = float(guess.point_m[0]), float(guess.point_m[1])
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
                dx, dy = x - slot.x_m, y - slot.y_m
                distance = math.sqrt(dx * dx + dy * dy)
                off = abs(math.remainder(math.atan2(dy, dx) - slot.yaw_rad, math.tau))
                if off <= half_view and noise.min_range_m <= distance <= noise.max_range_m:
                    sees = True
                if off > half_view + _MEMBER_MARGIN_RAD or not slot.unused or distance == 0.0:
                    continue
                radar = slot.radar
                expected = distance + self._offsets[radar]
                nearest, nu = None, math.inf
                for leftover in slot.unused:
                    miss = leftover.range_m - expected
                    if abs(miss) < abs(nu) and leftover.label == guess.label:
                        nearest, nu = leftover, miss
                if nearest is None:
                    continue
                ux, uy = dx / distance, dy / distance
                px, py = cxx * ux + cxy * uy, cxy * ux + cyy * uy
                variance = nearest.sigma_m**2 + slot.drift
                s = ux * px + uy * py + variance + self._doubt[radar]
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
            point_m=np.array([x, y]),
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
        returned for the offsets the state has, moved along d(point) / d(offsets) from where the
        residuals are least: there the linearisation is right.
        """
        if walked.dof < 1:
            return walked
        radars = sorted({member.slot.radar for member in walked.members})
        place = np.array([radars.index(member.slot.radar) for member in walked.members])
        antennas = np.array([[m.slot.x_m, m.slot.y_m] for m in walked.members])
        z = np.array([m.leftover.range_m - self._offsets[m.slot.radar] for m in walked.members])
        variance = np.array([m.leftover.sigma_m**2 + m.slot.drift for m in walked.members])
        offset_part = np.zeros((len(z), len(radars)))
        offset_part[np.arange(len(z)), place] = 1.0
        prior = self._offset_covariance[np.ix_(radars, radars)]
        prior = np.asarray(np.linalg.inv(prior + 1e-12 * np.eye(len(radars))))
        point, offsets = walked.point_m.copy(), np.zeros(len(radars))
        for _ in range(4):
            away = point - antennas
            distance = np.hypot(away[:, 0], away[:, 1])
            u = away / distance[:, None]
            residual = z - distance - offset_part @ offsets
            J = np.hstack([u, offset_part])
            information = (J.T / variance) @ J
            information[2:, 2:] += prior
            gradient = (J.T / variance) @ residual
            gradient[2:] -= prior @ offsets
            change = np.linalg.solve(information + 1e-9 * np.eye(len(information)), gradient)
            point, offsets = point + change[:2], offsets + change[2:]
        covariance = np.linalg.inv((u.T / variance) @ u + np.eye(2) / self._rule.prior_sigma_m**2)
        by_offsets = np.zeros((2, len(self._offsets)))
        by_offsets[:, radars] = -covariance @ (u.T / variance) @ offset_part
        return Tracklet(
            point_m=point - by_offsets[:, radars] @ offsets,
            covariance=covariance,
            by_offsets=by_offsets,
            members=walked.members,
            chi_square=float(residual @ (residual / variance) + offsets @ prior @ offsets),
            dof=walked.dof,
            share=walked.share,
            label=walked.label,
        )


def is_believable(tracklet: Tracklet, n_radars: int, rule: TrackletRule) -> bool:
    """Tell whether a tracklet is evidence of a point at rest; ``n_radars`` is 1 or 2."""
    frames = {member.slot.back for member in tracklet.members}
    alone = n_radars == 1
    if len(frames) < (rule.single_min_frames if alone else rule.min_frames):
        return False
    hits: dict[int, int] = {}
    for member in tracklet.members:
        hits[member.slot.radar] = hits.get(member.slot.radar, 0) + 1
    if len(hits) < n_radars or min(hits.values()) < rule.min_hits_per_radar:
        return False
    if tracklet.share < rule.min_share:
        return False
    if alone:
        spread = float(np.linalg.eigvalsh(tracklet.covariance)[-1])
        if spread > rule.single_max_sigma_m**2:
            return False
    limit = tracklet.dof + rule.excess_sigmas * math.sqrt(2.0 * max(tracklet.dof, 0))
    return tracklet.chi_square <= limit


def take(members: Iterable[Member]) -> None:
    """Remove the ranges of a tracklet from what is unused."""
    for member in members:
        member.slot.unused.remove(member.leftover)


def find_tracklets(
    tracker: Tracker,
    guesses: Sequence[Guess],
    frames: Sequence[Sequence[Slot]],
    n_radars: int,
    rule: TrackletRule,
    *,
    is_point: Callable[[Tracklet], bool] | None = None,
) -> list[Tracklet]:
    """Return the believable tracklets, best first; their ranges are taken out of the frames.

    ``is_point`` may have doubts about a tracklet that is of a point at rest in all else.
    """
    available: dict[int, int] = {}
    for slots in frames:
        for slot in slots:
            available[slot.radar] = available.get(slot.radar, 0) + bool(slot.unused)
    if len(available) < n_radars or min(available.values()) < rule.min_hits_per_radar:
        return []
    found: list[Tracklet] = []
    waiting = list(guesses)
    while waiting:
        followed = [(tracker.follow(guess, frames), guess) for guess in waiting]
        believed = [pair for pair in followed if is_believable(pair[0], n_radars, rule)]
        if is_point is not None:
            believed = [pair for pair in believed if pair[0].label is not None or is_point(pair[0])]
        if not believed:
            break
        best, chosen = max(believed, key=lambda pair: pair[0].score)
        take(best.members)
        found.append(best)
        # What is left may have lost its ranges: follow it again.
        waiting = [guess for _, guess in believed if guess is not chosen]
    return found
