"""Doubts: carries and slips that may have happened, until known landmarks confirm the pose.

A carry that is possible during a stop, or a possible slip of the wheels, adds to the reported
covariance. The pose itself stays where it is. A doubt ends when landmarks known before it fit the
pose, and their ranges leave no direction of the motion open: two landmarks abeam of the robot say
nothing of where it is along its course. Where too few were known before a carry, its doubt ends
once enough are known since; that of a slip stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri

from slam.geometry import transform, wrap_angle
from slam.results import UpdateReport
from slam.robust.parameters import TAIL_PROBABILITY, BranchRule
from slam.robust.state import LEAST_VARIANCE, Array, quarter_turn

_LEAST_SHARE = 1e-9  # of the largest variance: a direction with less is not in doubt


def covered_share(probability: float) -> float:
    """Return the share of a motion's variance that allows for a motion of a probability.

    With probability p the position is away by a normal error of variance V, else it is right. The
    region that a normal distribution of variance s V leaves with the probability q is left with q
    by that, too, if s = ln(p / q) / ln(1 / q) (two dimensions; q is `TAIL_PROBABILITY`); p V is the
    least, the variance of such a mixture.
    """
    if probability <= TAIL_PROBABILITY:
        return probability
    return max(probability, 1.0 - math.log(probability) / math.log(TAIL_PROBABILITY))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenRanges:
    """Ranges of landmarks, k of them, map frame."""

    ids: Array  # shape (k,), of the landmarks
    antennas_m: Array  # shape (k, 2)
    along: Array  # shape (k, 2), unit vectors from the landmarks to the antennas
    variances: Array  # shape (k,), of ranges [m^2]: one over the information in each


def seen_ranges(report: UpdateReport, pose: Array, rule: BranchRule) -> SeenRanges | None:
    """Return the ranges of landmarks at a pose (3,), those that were heard; None if none was."""
    continued = {(radar, id_) for radar, _, id_ in report.continued}
    heard = [one for one in report.predicted if (one.radar, one.landmark_id) in continued]
    if not heard:
        return None
    antennas = transform(pose, np.array([one.antenna_m for one in heard]))
    away = antennas - transform(pose, np.array([one.point_m for one in heard]))
    variances = rule.model_sigma_m**2 + np.array([one.variance for one in heard])
    return SeenRanges(
        ids=np.array([one.landmark_id for one in heard], dtype=np.float64),
        antennas_m=antennas,
        along=away / np.linalg.norm(away, axis=1, keepdims=True),
        variances=rule.correlated_steps * variances,
    )


def _nothing() -> Array:
    return np.zeros((3, 3))


@dataclass(slots=True, kw_only=True, eq=False)
class Doubt:
    """Motions that the wheels did not report, carries or slips, if they happened."""

    next_id: int  # landmarks known before them have smaller ids
    knew_few: bool  # whether these were fewer than place a robot
    is_carry: bool  # one of several that exclude each other; slips add up
    position_m: Array  # shape (2,), where the newest of them may have been
    probability: float  # added up
    # shape (3, 3), of x, y [m] and heading for a pose at the position: the probability times the
    # variances, added up
    covariance: Array
    # shape (3, 3), covariance of x, y [m] and heading if they happened, at the position
    motion_covariance: Array
    nats: dict[int, float] = field(default_factory=dict)  # evidence since, by landmark
    # shape (3, 3), of the ranges since about such a motion, at the position
    information: Array = field(default_factory=_nothing)
    # landmarks, and how often `BranchRule.most_for` they say, that were found to fit elsewhere, too
    alike: tuple[frozenset[int], int] | None = None

    def take(self, evidence: Array, rule: BranchRule) -> None:
        """Add the evidence of a step, ids and nats of shape (k, 2)."""
        for landmark, nats in evidence.tolist():
            if landmark < self.next_id:
                total = self.nats.get(int(landmark), 0.0) + nats / rule.correlated_steps
                self.nats[int(landmark)] = min(max(total, -rule.most_against), rule.most_for)

    def measure(self, seen: SeenRanges) -> None:
        """Add what the ranges of a step tell of such a motion.

        A motion (dx, dy, turn) at a position p moves an antenna at a by (dx, dy) + turn J (a - p).
        """
        known = seen.ids < self.next_id
        along = seen.along[known]
        levers = quarter_turn(seen.antennas_m[known] - self.position_m)
        rows = np.column_stack([along, np.sum(along * levers, axis=1)])
        self.information += rows.T @ (rows / seen.variances[known, None])

    def is_confirmed(self, rule: BranchRule) -> bool:
        """Return whether known landmarks fit the pose, and leave no such motion open."""
        if sum(self.nats.values()) <= rule.price_nats:
            return False
        variances, axes = np.linalg.eigh(self.motion_covariance)
        is_open = variances > _LEAST_SHARE * variances[-1]
        root = axes[:, is_open] * np.sqrt(variances[is_open])
        gained = np.linalg.eigvalsh(root.T @ self.information @ root)
        return bool(1.0 / (1.0 + gained[0]) < rule.open_share)

    def allows(self, motion: Array, model_sigma_m: float) -> bool:
        """Return whether a motion (3,) [m, m, rad] of the map is one of those in doubt.

        ``model_sigma_m`` is how far the places that show it may be off; for the turn, at a metre.
        """
        away_m = transform(motion, self.position_m) - self.position_m
        away = np.array([*away_m, wrap_angle(float(motion[2]))])
        covariance = self.motion_covariance + model_sigma_m**2 * np.eye(3)
        return float(away @ np.linalg.solve(covariance, away)) <= float(chdtri(3, TAIL_PROBABILITY))

    def at(self, position_m: Array) -> Array:
        """Return the covariance (3, 3) for a pose at a position (2,).

        A turn by an angle a at the doubt's position moves a pose at a distance d from there by
        d sin(a) across the way, for which d a is taken, and by d (cos(a) - 1) along it. The mean
        square of the latter is added.
        """
        probability = self.probability if self.is_carry else 1.0
        away_m = position_m - self.position_m
        T = np.eye(3)
        T[:2, 2] = quarter_turn(away_m)
        covariance = np.asarray(T @ self.covariance @ T.T)
        along = probability * _mean_square_of_cosine(covariance[2, 2] / probability)
        covariance[:2, :2] += along * np.outer(away_m, away_m)
        return covariance

    def add(self, newer: Doubt) -> None:
        """Add a doubt with the same evidence; what is measured of the newer one counts."""
        self.covariance = self.at(newer.position_m) + newer.covariance
        self.motion_covariance = self.motion_covariance + newer.motion_covariance
        self.probability += newer.probability
        self.knew_few &= newer.knew_few
        self.position_m, self.information = newer.position_m, newer.information

    def join(self, newer: Doubt) -> None:
        """Add a doubt with other evidence: what confirms both confirms either.

        Of one that knew too few landmarks nothing can: the other one's count.
        """
        if self.knew_few and not newer.knew_few:
            self.next_id = newer.next_id
        self.add(newer)
        self.nats = {id_: nats for id_, nats in newer.nats.items() if id_ < self.next_id}
        # The newer one's is also of landmarks that the older one did not know.
        self.information = _nothing()
        self.alike = None


def _mean_square_of_cosine(variance: float) -> float:
    """Return the mean of (cos(a) - 1)^2 of a normal angle a; of a small one 0.75 variance^2."""
    return 0.5 * math.expm1(-2.0 * variance) - 2.0 * math.expm1(-variance / 2.0)


def doubted_covariance(doubts: Sequence[Doubt], position_m: Array) -> Array:
    """Return what doubts add to the covariance of a pose at a position (2,), (3, 3).

    Of each doubt the mean motion is covered (`covered_share`). A robot that stopped often is no
    more lost than one that was carried.
    """
    carries, lost_share = np.zeros((3, 3)), 0.0
    for doubt in doubts:
        share = covered_share(min(doubt.probability, 1.0))
        carries += doubt.at(position_m) * (share / doubt.probability)
        lost_share += share
    return carries / max(lost_share, 1.0)


def covering(covariance: Array, other: Array) -> Array:
    """Return what is to be added to a covariance (k, k) for it to be nowhere less than another one.

    The sum is the least that covers both: with ``covariance`` = L L^T, the eigenvalues of
    L^-1 ``other`` L^-T that are larger than one count, in the directions of their eigenvectors.
    Shape (k, k), units of the covariances.
    """
    root = np.linalg.cholesky(covariance + LEAST_VARIANCE * np.eye(len(covariance)))
    scaled = np.linalg.solve(root, np.linalg.solve(root, other).T)
    ratios, axes = np.linalg.eigh(scaled)
    missing = root @ axes
    return np.asarray(missing * np.maximum(ratios - 1.0, 0.0) @ missing.T)
