"""Which range is of which landmark: known landmarks first, one to one.

A landmark takes part if it may be in view and if the prior alone, without the noise of a range,
predicts its ranges more surely than a range measures them. Where the map is less sure than that, a
single range proves nothing, and only tracklets decide. For each landmark one option is chosen, a
range of some of the radars of the side, or of none, at the cost

    nu^T S^-1 nu + ln det(2 pi S) + 2 m ln(clutter density) - 2 m ln(Pd / (1 - Pd))

for m ranges with joint innovation covariance S; none costs nothing. No range is used twice. The
least sum is found by branch and bound, as joint compatibility is (Neira and Tardos, IEEE TRA
17(6), 2001), with likelihoods for counts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from slam.results import PredictedRange
from slam.robust.parameters import ContinuationRule, RangeNoise
from slam.robust.ranges import Antennas, RangeScan, Rows, View, rows_of
from slam.robust.state import Array, Indices, State, rotation


@dataclass(frozen=True, slots=True, kw_only=True)
class Continuation:
    """Range ``index`` of the scan of ``radar`` is of the landmark in ``row``."""

    row: int
    radar: int
    index: int


@dataclass(frozen=True, slots=True)
class Option:
    """One choice for one landmark: ``(radar, index)`` of the ranges used, and its cost."""

    used: tuple[tuple[int, int], ...]
    cost: float


NOTHING = Option((), 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SureLandmarks:
    """Landmarks that one side of the robot may see, or those of them that may be continued."""

    landmarks: Indices  # rows of the landmarks, shape (c,)
    rows: Rows  # their predicted ranges: landmark by landmark, radar by radar
    prior: Array  # H P H^T of those rows, shape (k, k)

    def surer_than(self, limit_m: float) -> SureLandmarks | None:
        """Return those with more certain ranges of all radars; None without any."""
        per_landmark = len(self.rows.radars) // len(self.landmarks)
        variances = self.prior.diagonal().reshape(-1, per_landmark)
        sure = (variances <= limit_m**2).all(axis=1)
        if not sure.any():
            return None
        keep = np.flatnonzero(np.repeat(sure, per_landmark))
        rows = replace(
            self.rows,
            radars=self.rows.radars[keep],
            landmarks=self.rows.landmarks[keep],
            H=self.rows.H[keep],
            predicted_m=self.rows.predicted_m[keep],
        )
        return SureLandmarks(
            landmarks=self.landmarks[sure], rows=rows, prior=self.prior[np.ix_(keep, keep)]
        )

    def with_added_sigma(self, shape_sigmas_m: Array) -> SureLandmarks:
        """Add a standard deviation per row of the map to the predictions."""
        added = np.square(shape_sigmas_m[self.rows.landmarks])
        return self if not added.any() else replace(self, prior=self.prior + np.diag(added))

    def unanswered(self, scans: Sequence[RangeScan], noise: RangeNoise, within_m: float) -> Indices:
        """Return the rows of those near whose predicted ranges no radar has an echo.

        Near is within four standard deviations, or ``BLUR_M`` more from a blurred echo. Those whose
        ranges are less certain than ``within_m`` are left out: they may be out of view.
        """
        scan_of = {scan.radar: scan for scan in scans}
        per_landmark = len(self.rows.radars) // len(self.landmarks)
        variances = self.prior.diagonal()
        silent = variances <= within_m**2
        reaches_m = 4.0 * np.sqrt(variances + noise.sigma_m**2)
        for k in np.flatnonzero(silent).tolist():
            scan, range_m = scan_of[int(self.rows.radars[k])], self.rows.predicted_m[k]
            silent[k] = not scan.answers(float(range_m), float(reaches_m[k]))
        return self.landmarks[silent.reshape(-1, per_landmark).all(axis=1)]


def landmarks_in_view(
    state: State,
    seen: View,
    radars: Sequence[int],
    noise: RangeNoise,
    rule: ContinuationRule,
) -> SureLandmarks | None:
    """Return the landmarks that any of some radars, all with frames, may see, or None."""
    looking = np.array(radars, dtype=np.intp)
    margin_m = 5.0 * noise.sigma_m
    inside = seen.inside(noise, rule.view_margin_rad, margin_m)[looking]
    landmarks = np.flatnonzero(inside.any(axis=0))
    if not len(landmarks):
        return None
    rows = rows_of(
        state, seen, np.tile(looking, len(landmarks)), np.repeat(landmarks, len(looking))
    )
    prior = rows.H @ state.P.block(rows.at) @ rows.H.T
    return SureLandmarks(landmarks=landmarks, rows=rows, prior=prior)


def sure_landmarks(
    state: State,
    seen: View,
    radars: Sequence[int],
    noise: RangeNoise,
    rule: ContinuationRule,
) -> SureLandmarks | None:
    """Return those of them that single ranges may continue; None without any."""
    near = landmarks_in_view(state, seen, radars, noise, rule)
    return None if near is None else near.surer_than(rule.tight_sigmas * noise.sigma_m)


def continue_tracks(
    sure: SureLandmarks, scans: Sequence[RangeScan], noise: RangeNoise, rule: ContinuationRule
) -> list[Continuation]:
    """Return the likeliest one-to-one assignment of the ranges of one side to landmarks."""
    rows, per_landmark = sure.rows, len(sure.rows.radars) // len(sure.landmarks)
    by_radar = {scan.radar: scan for scan in scans}
    options: list[list[Option]] = []
    for place in range(len(sure.landmarks)):
        mine = slice(place * per_landmark, (place + 1) * per_landmark)
        options.append(
            options_of(
                [by_radar[int(radar)] for radar in rows.radars[mine]],
                rows.predicted_m[mine],
                sure.prior[mine, mine],
                noise,
                rule,
            )
        )
    return [
        Continuation(row=int(sure.landmarks[place]), radar=radar, index=index)
        for place, option in enumerate(cheapest(options))
        for radar, index in option.used
    ]


def labelled(
    scans: Sequence[RangeScan], state: State, landmark_of_label: Mapping[int, int]
) -> list[Continuation]:
    """Return the associations by label; ids of landmarks by label are given."""
    rows = {id_: row for row, id_ in enumerate(state.landmark_ids)}
    return [
        Continuation(row=rows[landmark_of_label[label]], radar=scan.radar, index=index)
        for scan in scans
        for index in range(len(scan.ranges_m))
        if (label := scan.label(index)) in landmark_of_label and label is not None
    ]


def options_of(
    scans: Sequence[RangeScan],
    predicted_m: Array,
    prior: Array,
    noise: RangeNoise,
    rule: ContinuationRule,
) -> list[Option]:
    """Return the options of one landmark that cost less than none, cheapest first, none last."""
    near: list[list[tuple[int, float, float] | None]] = []
    for place, scan in enumerate(scans):
        centre, spread = float(predicted_m[place]), float(prior[place, place])
        found: list[tuple[int, float, float] | None] = [None]
        for index, range_m in enumerate(scan.ranges_m):
            variance = scan.sigma(index, noise.sigma_m) ** 2
            if (range_m - centre) ** 2 <= rule.gates[-1] * (spread + variance):
                found.append((index, range_m - centre, variance))
        near.append(found)
    odds = noise.detection_probability / (1.0 - noise.detection_probability)
    per_range = 2.0 * math.log(noise.clutter_per_m / odds) + math.log(math.tau)
    options = []
    for choice in product(*near):
        places = [place for place, taken in enumerate(choice) if taken is not None]
        if not places:
            continue
        nu = [taken[1] for taken in choice if taken is not None]
        variances = [taken[2] for taken in choice if taken is not None]
        gate = rule.gates[min(len(places), len(rule.gates)) - 1]
        distance, log_det = _distance(nu, places, prior, variances)
        cost = distance + log_det + len(places) * per_range
        if distance <= gate and cost < 0.0:
            used = tuple(
                (scans[place].radar, taken[0])
                for place, taken in enumerate(choice)
                if taken is not None
            )
            options.append(Option(used, cost))
    options.sort(key=lambda option: (option.cost, option.used))
    return [*options, NOTHING]


def _distance(
    nu: list[float], places: list[int], prior: Array, variances: list[float]
) -> tuple[float, float]:
    """Return nu^T S^-1 nu and ln det S."""
    if len(places) == 1:
        s = float(prior[places[0], places[0]]) + variances[0]
        return nu[0] ** 2 / s, math.log(s)
    if len(places) == 2:
        i, j = places
        a, b = float(prior[i, i]) + variances[0], float(prior[j, j]) + variances[1]
        c = float(prior[i, j])
        det = a * b - c * c
        squared = b * nu[0] ** 2 - 2.0 * c * nu[0] * nu[1] + a * nu[1] ** 2
        return squared / det, math.log(det)
    S = prior[np.ix_(places, places)] + np.diag(variances)
    return float(nu @ np.linalg.solve(S, nu)), float(np.linalg.slogdet(S)[1])


def cheapest(options: Sequence[Sequence[Option]]) -> list[Option]:
    """Return one option per landmark of least total cost that use no range twice.

    Each landmark's options come cheapest first; the bound on what is still to come is the sum of
    the cheapest. The result does not depend on the order of the landmarks unless costs tie.
    """
    bounds = [0.0] * (len(options) + 1)
    for place in range(len(options) - 1, -1, -1):
        bounds[place] = bounds[place + 1] + options[place][0].cost
    best_cost = math.inf
    best: list[Option] = [NOTHING] * len(options)
    chosen: list[Option] = []
    taken: set[tuple[int, int]] = set()

    def branch(place: int, cost: float) -> None:
        nonlocal best_cost, best
        if cost + bounds[place] >= best_cost:
            return
        if place == len(options):
            best_cost, best = cost, chosen.copy()
            return
        for option in options[place]:
            if taken.isdisjoint(option.used):
                taken.update(option.used)
                chosen.append(option)
                branch(place + 1, cost + option.cost)
                chosen.pop()
                taken.difference_update(option.used)

    branch(0, 0.0)
    return best


def predicted_ranges(state: State, sure: SureLandmarks, antennas: Antennas) -> list[PredictedRange]:
    """Return the ranges of landmarks that could continue a track, before any is looked at.

    Those of walls are left out: their echoes have no fixed place to compare with a true landmark's.
    """
    rows = sure.rows
    of_point = np.flatnonzero(rows.landmarks < len(state.landmark_ids))
    landmarks, radars = rows.landmarks[of_point], rows.radars[of_point]
    places = antennas.position_m[radars].tolist()
    points = state.landmarks_m[landmarks] - state.position_m
    return [
        PredictedRange(
            radar=radar,
            landmark_id=state.landmark_ids[row],
            range_m=range_m,
            variance=variance,
            antenna_m=(place[0], place[1]),
            point_m=(point[0], point[1]),
        )
        for radar, row, range_m, variance, place, point in zip(
            radars.tolist(),
            landmarks.tolist(),
            rows.predicted_m[of_point].tolist(),
            sure.prior.diagonal()[of_point].tolist(),
            places,
            (points @ rotation(state.heading_rad)).tolist(),
            strict=True,
        )
    ]
