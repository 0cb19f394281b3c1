"""Two ranges from two radars of one side become a point in the body frame (paper eq. 1 to 4).

The paper calls it trilateration; it is the intersection of two circles, of which the one that both
radars have in view is kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from slam.config import Pairing, TrilaterationConfig
from slam.frames import Detection
from slam.geometry import FieldOfView, RadarPair, Rig, mount_at, pair_of, wrap_angles
from slam.results import Fix

Array = NDArray[np.float64]

_PAPERS_LIMITS_M = (0.2, 1.5)
_NS_PER_S = 1_000_000_000
# No range of this world; beyond it squares of lengths would not be numbers.
_MAX_LENGTH_M = 1e150
# Amplitudes are compared between these: a peak without a height counts as very faint.
_AMPLITUDES = (1e-12, 1e12)

NO_MOTIONS: Mapping[int, Array] = MappingProxyType({})
"""All radars sampled at one time, or are taken to have."""


def bilaterate(
    first_m: Array, second_m: Array, pair: RadarPair, field_of_view_rad: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Intersect range circles around two antennas and find the intersection that both radars see.

    With l1, l2 the ranges (``first_m``, ``second_m``), d the baseline and u, v the coordinates
    along the base from its middle and square to it towards the boresight::

        u = (l1 - l2) (l1 + l2) / (2 d)          v = sqrt((l1^2 + l2^2) / 2 - d^2 / 4 - u^2)
        alpha = atan2(v, u + d/2)                beta = atan2(v, d/2 - u)

    alpha and beta are the paper's inner angles, whose cosines its eq. 2 gives; atan2 loses no
    digits near 0. Seen by both means that each antenna's direction to the point is less than
    theta / 2 off its boresight; for a boresight square to the base that is exactly alpha > gamma
    and beta > gamma, with gamma = (pi - theta) / 2 of eq. 1. The circles meet a second time at
    (u, -v), which only radars see that look across or along their base.

    Returns positions (n, 2) [m], body frame, NaN where the circles do not meet; and whether both
    radars see one of the two intersections and not the other (n,), never for ranges that are
    negative, zero, not finite or beyond 1e150 m. The position is (u, v) unless only (u, -v) is
    seen.
    """
    l1, l2 = np.asarray(first_m, dtype=np.float64), np.asarray(second_m, dtype=np.float64)
    d = pair.baseline_m
    valid = (l1 > 0) & (l2 > 0) & (l1 < _MAX_LENGTH_M) & (l2 < _MAX_LENGTH_M)
    l1, l2 = np.where(valid, l1, np.nan), np.where(valid, l2, np.nan)
    # Triangle inequality, written so that NaN fails it.
    meets = (np.abs(l1 - l2) <= d) & (l1 + l2 >= d)
    u = np.where(meets, (l1 - l2) * (l1 + l2) / (2 * d), np.nan)
    v = np.sqrt(np.maximum((l1**2 + l2**2) / 2 - d**2 / 4 - u**2, 0.0))
    alpha = np.arctan2(v, u + d / 2)
    beta = np.arctan2(v, d / 2 - u)
    half_view, (first_rad, second_rad) = field_of_view_rad / 2, pair.boresights_rad
    seen = (np.abs(alpha - first_rad) < half_view) & (
        np.abs(math.pi - beta - second_rad) < half_view
    )
    mirror_seen = (np.abs(wrap_angles(-alpha - first_rad)) < half_view) & (
        np.abs(wrap_angles(beta - math.pi - second_rad)) < half_view
    )
    accepted = meets & (seen != mirror_seen)
    v = np.where(accepted & mirror_seen, -v, v)
    xy = pair.midpoint + u[:, None] * pair.along + v[:, None] * pair.ahead
    return xy, accepted


class Trilaterator:
    """Pairs the detections of one pose, those of one radar with those of the other.

    K echoes seen by both radars give up to K^2 fixes. As printed, all that pass the geometry are
    kept, and the ghosts among them are left to the outlier filter. With ``Pairing.ONE_TO_ONE`` each
    detection takes part in at most one fix of a pair of radars, see ``one_to_one``.
    """

    def __init__(
        self,
        config: TrilaterationConfig,
        rig: Rig,
        range_limits_m: tuple[float, float] = _PAPERS_LIMITS_M,
    ) -> None:
        self.config = config
        self.rig = rig
        nearest_m, farthest_m = range_limits_m
        self.pairs = rig.pairs(
            FieldOfView(
                opening_rad=config.field_of_view_rad,
                min_range_m=nearest_m,
                max_range_m=farthest_m,
            )
        )

    def locate(
        self,
        detections: Sequence[Detection],
        t_ns: int,
        motions: Mapping[int, Array] = NO_MOTIONS,
    ) -> tuple[Fix, ...]:
        """Return the fixes of one pose, at ``t_ns`` and in its body frame, from all detections.

        ``motions`` has, by session time, the pose of the robot then as seen from the pose at
        ``t_ns``, shape (3,); detections of a time without entry were made at ``t_ns``.
        """
        by_radar: dict[int, list[Detection]] = {}
        for detection in detections:
            by_radar.setdefault(detection.radar, []).append(detection)
        fixes: list[Fix] = []
        for index, pair in enumerate(self.pairs):
            combinations = [
                (a, b)
                for a in by_radar.get(pair.first, ())
                for b in by_radar.get(pair.second, ())
                if abs(a.t_ns - b.t_ns) <= self.config.max_stamp_difference_s * _NS_PER_S
            ]
            of_pair = self._fixes(index, combinations, t_ns, motions)
            one_each = self.config.pairing is Pairing.ONE_TO_ONE and of_pair
            fixes.extend(one_to_one(of_pair) if one_each else of_pair)
        return tuple(fixes)

    def _fixes(
        self,
        index: int,
        combinations: Sequence[tuple[Detection, Detection]],
        t_ns: int,
        motions: Mapping[int, Array],
    ) -> list[Fix]:
        by_stamps: dict[tuple[int, int], list[tuple[Detection, Detection]]] = {}
        for a, b in combinations:
            by_stamps.setdefault((a.t_ns, b.t_ns), []).append((a, b))
        fixes = []
        for stamps_ns, members in by_stamps.items():
            pair = self._pair_at(index, stamps_ns, motions)
            if pair is None:
                continue
            ranges_m = np.array([(a.range_m, b.range_m) for a, b in members])
            xy, accepted = bilaterate(
                ranges_m[:, 0], ranges_m[:, 1], pair, self.config.field_of_view_rad
            )
            fixes += [
                Fix(pair=index, t_ns=t_ns, x_m=x, y_m=y, detections=(a, b))
                for (a, b), (x, y), seen in zip(
                    members, xy.tolist(), accepted.tolist(), strict=True
                )
                if seen
            ]
        return fixes

    def _pair_at(
        self, index: int, stamps_ns: tuple[int, int], motions: Mapping[int, Array]
    ) -> RadarPair | None:
        """Return the pair as it sampled; None where motion brought one to the other's place."""
        pair = self.pairs[index]
        if motions.keys().isdisjoint(stamps_ns):
            return pair
        first, second = (
            mount_at(self.rig.mounts[radar], motions.get(stamp_ns, np.zeros(3)))
            for radar, stamp_ns in zip((pair.first, pair.second), stamps_ns, strict=True)
        )
        return pair_of(pair.first, pair.second, (first, second))


def one_to_one(fixes: Sequence[Fix]) -> list[Fix]:
    """Return fixes of one pair of radars that share no detection.

    As many as possible; among those choices the one whose amplitudes fit best: least sum of
    ``|ln(a1 / a2)|``, because two radars side by side receive one target with nearly equal
    amplitude. The order of the fixes plays no part, and equal detections of one radar are one.
    """
    firsts = _numbered(fix.detections[0] for fix in fixes)
    seconds = _numbered(fix.detections[1] for fix in fixes)
    table = {(firsts[fix.detections[0]], seconds[fix.detections[1]]): fix for fix in fixes}
    mismatches = {cell: _mismatch(fix) for cell, fix in table.items()}
    # One forbidden combination must cost more than any number of allowed ones.
    cost = np.full((len(firsts), len(seconds)), 1.0 + sum(mismatches.values()))
    for cell, mismatch in mismatches.items():
        cost[cell] = mismatch
    rows, columns = linear_sum_assignment(cost)
    chosen = zip(rows.tolist(), columns.tolist(), strict=True)
    return [table[cell] for cell in chosen if cell in table]


def _numbered(detections: Iterable[Detection]) -> dict[Detection, int]:
    """Return a number for each different detection, the same whatever order they come in."""
    ordered = sorted(set(detections), key=lambda d: (d.range_m, d.t_ns, d.amplitude))
    return {detection: number for number, detection in enumerate(ordered)}


def _mismatch(fix: Fix) -> float:
    a, b = np.clip(np.nan_to_num([d.amplitude for d in fix.detections]), *_AMPLITUDES)
    return abs(math.log(a / b))
