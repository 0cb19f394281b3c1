"""Wall tracklets: ranges of the last frames that one wall explains, and no point does.

As in :mod:`slam.robust.tracklets`, a small Kalman filter follows a guess back through the frames;
here its state is a line (phi, d) in the body frame of now, whose range is d - n . a. What it
gathers must follow the wall's law, and the point's clearly less well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam.robust.classification import Law, Sightings, compare, fit_wall
from slam.robust.leftovers import Slot
from slam.robust.parameters import BackEndParameters, RangeNoise, WallRule
from slam.robust.symmetric import Array
from slam.robust.tracklets import Member, Tracklet

_PRIOR_RAD = 0.3
_MARGIN_RAD = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WallTracklet:
    """A wall in the body frame of now, and the ranges that say so.

    Attributes
    ----------
    wall, covariance
        phi [rad] and d [m], shapes (2,) and (2, 2), for the range offsets given.
    by_offsets
        shape (2, r), d(phi, d) / d(offsets).
    members
        Newest first.
    chi_square, dof
        Of the residuals.
    share
        Part of the frames with the wall in view that hold a member.
    """

    wall: Array
    covariance: Array
    by_offsets: Array
    members: tuple[Member, ...]
    chi_square: float
    dof: int
    share: float

    @property
    def score(self) -> float:
        """Return 4 dof - chi-square, by which tracklets compete for ranges."""
        return 4.0 * self.dof - self.chi_square


def wall_guesses(newest: Sequence[Slot], noise: RangeNoise) -> list[Array]:
    """Return the lines (phi, d) that touch both circles of every pair of unused ranges of now."""
    guesses = []
    for place, first in enumerate(newest):
        for second in newest[place + 1 :]:
            base_x, base_y = second.x_m - first.x_m, second.y_m - first.y_m
            base = math.hypot(base_x, base_y)
            for a in first.unused:
                for b in second.unused:
                    cosine = (a.range_m - b.range_m) / base if base else 2.0
                    if abs(cosine) > 1.0 or a.label is not None or b.label is not None:
                        continue
                    along, off = math.atan2(base_y, base_x), math.acos(cosine)
                    phi = min(
                        (along + off, along - off),
                        key=lambda angle: abs(math.remainder(angle - first.yaw_rad, math.tau)),
                    )
                    away = abs(math.remainder(phi - first.yaw_rad, math.tau))
                    if away > noise.field_of_view_rad / 2 + _MARGIN_RAD:
                        continue
                    d = a.range_m + math.cos(phi) * first.x_m + math.sin(phi) * first.y_m
                    guesses.append(np.array([phi, d]))
    return guesses


class WallTracker:
    """Follows guesses of walls back in time.

    Parameters
    ----------
    parameters, rule
        Noise of radars and wheels, and rules.
    offsets_m, offset_covariance
        What the state knows of the radars' range offsets, shapes (r,) and (r, r).
    """

    def __init__(
        self,
        parameters: BackEndParameters,
        rule: WallRule,
        offsets_m: Array,
        offset_covariance: Array,
    ) -> None:
        self._noise, self._rule, self._walls = parameters.ranges, parameters.tracklets, rule
        self._offsets: list[float] = offsets_m.tolist()
        self._doubt: list[float] = offset_covariance.diagonal().tolist()
        known = max(self._doubt, default=0.0) <= (0.1 * self._noise.sigma_m) ** 2
        self._offset_covariance = None if known else offset_covariance
        self._heading_rad_per_sqrt_m = parameters.wheels.heading_rad_per_sqrt_m

    def follow(self, guess: Array, frames: Sequence[Sequence[Slot]]) -> WallTracklet:
        """Return what the last frames hold of a guess; twice, from the result of the first."""
        first = self._walk(float(guess[0]), float(guess[1]), frames)
        second = self._walk(float(first.wall[0]), float(first.wall[1]), frames)
        return second if self._offset_covariance is None else self._with_free_offsets(second)

    def _walk(self, phi: float, d: float, frames: Sequence[Sequence[Slot]]) -> WallTracklet:
        """Filter the line backwards; plain floats, the loop is short and runs often."""
        noise, rule = self._noise, self._rule
        half_view, gate_sq = noise.field_of_view_rad / 2, rule.gate_sigmas**2
        cpp, cpd, cdd = _PRIOR_RAD**2, 0.0, rule.prior_sigma_m**2
        n_radars = len(self._offsets)
        dp_do, dd_do = [0.0] * n_radars, [0.0] * n_radars
        members: list[Member] = []
        chi_square = 0.0
        in_view, hit = 0, 0
        for slots in frames:
            sees = hits = False
            cosine, sine = math.cos(phi), math.sin(phi)
            for slot in slots:
                distance = d - cosine * slot.x_m - sine * slot.y_m
                off = abs(math.remainder(phi - slot.yaw_rad, math.tau))
                if off <= half_view and noise.min_range_m <= distance <= noise.max_range_m:
                    sees = True
                if off > half_view + _MARGIN_RAD or not slot.unused:
                    continue
                radar = slot.radar
                expected = distance + self._offsets[radar]
                nearest = min(slot.unused, key=lambda left: abs(left.range_m - expected))
                nu = nearest.range_m - expected
                h = sine * slot.x_m - cosine * slot.y_m
                pp, pd = cpp * h + cpd, cpd * h + cdd
                variance = nearest.sigma_m**2 + slot.drift
                s = h * pp + pd + variance + self._doubt[radar]
                if nearest.label is not None or nu * nu > gate_sq * s:
                    continue
                kp, kd = pp / s, pd / s
                phi, d = phi + kp * nu, d + kd * nu
                cosine, sine = math.cos(phi), math.sin(phi)
                cpp, cpd, cdd = cpp - kp * pp, cpd - kp * pd, cdd - kd * pd
                for other in range(n_radars):
                    change = h * dp_do[other] + dd_do[other] + (other == radar)
                    dp_do[other] -= kp * change
                    dd_do[other] -= kd * change
                chi_square += nu * nu / s
                members.append(Member(slot, nearest))
                hits = True
            in_view += sees or hits
            hit += hits
        return WallTracklet(
            wall=np.array([phi, d]),
            covariance=np.array([[cpp + self._turned(members), cpd], [cpd, cdd]]),
            by_offsets=np.array([dp_do, dd_do]),
            members=tuple(members),
            chi_square=chi_square,
            dof=len(members) - 2,
            share=hit / max(in_view, 1),
        )

    def _with_free_offsets(self, walked: WallTracklet) -> WallTracklet:
        """Judge the members by a wall *and* the radars' common offsets, which are uncertain.

        While walking, the doubt about an offset is noise of each range, and a wall would be
        allowed to miss every range by it. It is one number: a wall may miss them all alike.
        """
        if walked.dof < 1:
            return walked
        sightings, rule = self.sightings(walked.members), self._rule
        fit = fit_wall(sightings, walked.wall)
        information = (fit.by_law.T / sightings.variances) @ fit.by_law
        prior = np.diag([_PRIOR_RAD**-2, rule.prior_sigma_m**-2])
        covariance: Array = np.asarray(np.linalg.inv(information + prior), dtype=np.float64)
        by_offsets = np.zeros((2, len(self._offsets)))
        by_offsets[:, fit.radars] = -covariance @ (fit.by_law.T / sightings.variances) @ fit.extra
        covariance[0, 0] += self._turned(walked.members)
        return replace(
            walked,
            wall=fit.unknown - by_offsets[:, fit.radars] @ fit.offsets_m,
            covariance=covariance,
            by_offsets=by_offsets,
            chi_square=fit.chi_square,
        )

    def _turned(self, members: Sequence[Member]) -> float:
        """Return the variance of the heading over the way of the members, about its mean."""
        if not members:
            return 0.0
        first, last = members[-1].slot, members[0].slot
        way = math.hypot(last.x_m - first.x_m, last.y_m - first.y_m)
        return self._heading_rad_per_sqrt_m**2 * way / 3.0

    def _way_m(self, tracklet: WallTracklet) -> float:
        """Return how far the echo moved along the wall."""
        phi = float(tracklet.wall[0])
        along = [math.cos(phi) * m.slot.y_m - math.sin(phi) * m.slot.x_m for m in tracklet.members]
        of_radar: dict[int, list[float]] = {}
        for member, place in zip(tracklet.members, along, strict=True):
            of_radar.setdefault(member.slot.radar, []).append(place)
        return max(max(places) - min(places) for places in of_radar.values())

    def is_wall(self, tracklet: WallTracklet) -> bool:
        """Tell whether a tracklet is evidence of a wall and not of a point."""
        rule, members = self._rule, tracklet.members
        if len({member.slot.back for member in members}) < self._walls.min_frames:
            return False
        if self._way_m(tracklet) < self._walls.min_way_m:
            return False
        hits: dict[int, int] = {}
        for member in members:
            hits[member.slot.radar] = hits.get(member.slot.radar, 0) + 1
        if len(hits) < 2 or min(hits.values()) < rule.min_hits_per_radar:
            return False
        limit = tracklet.dof + rule.excess_sigmas * math.sqrt(2.0 * max(tracklet.dof, 0))
        if tracklet.share < rule.min_share or tracklet.chi_square > limit:
            return False
        verdict = compare(self.sightings(members), float(tracklet.wall[0]))
        return verdict.law(self._walls.wall_lead) is Law.WALL

    def is_point(self, tracklet: Tracklet) -> bool:
        """Tell whether the ranges of a tracklet follow a point's law rather than a wall's."""
        members = tracklet.members
        middle = np.mean([(m.slot.x_m, m.slot.y_m) for m in members], axis=0)
        x, y = tracklet.point_m - middle
        verdict = compare(self.sightings(members), math.atan2(y, x))
        return verdict.law(self._walls.point_lead) is Law.POINT

    def sightings(self, members: Sequence[Member]) -> Sightings:
        """Return members as ranges from places in the body frame of now."""
        offsets = np.array([self._offsets[member.slot.radar] for member in members])
        return Sightings(
            antennas_m=np.array([(m.slot.x_m, m.slot.y_m) for m in members]),
            ranges_m=np.array([m.leftover.range_m for m in members]) - offsets,
            variances=np.array([m.leftover.sigma_m**2 + m.slot.drift for m in members]),
            radars=np.array([m.slot.radar for m in members]),
            offset_covariance=self._offset_covariance,
        )


def find_wall_tracklets(
    tracker: WallTracker, guesses: Sequence[Array], frames: Sequence[Sequence[Slot]]
) -> list[WallTracklet]:
    """Return the wall tracklets, best first; their ranges are taken out of the frames."""
    found: list[WallTracklet] = []
    waiting = list(guesses)
    while waiting:
        followed = [(tracker.follow(guess, frames), guess) for guess in waiting]
        walls = [pair for pair in followed if tracker.is_wall(pair[0])]
        if not walls:
            break
        best, chosen = max(walls, key=lambda pair: pair[0].score)
        for member in best.members:
            member.slot.unused.remove(member.leftover)
        found.append(best)
        waiting = [guess for _, guess in walls if guess is not chosen]
    return found
