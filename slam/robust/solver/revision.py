"""What a solution over the whole run changes (belief, noise of ranges), and what it allows."""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from slam.geometry import align_se2, transform, wrap_angle
from slam.robust.association import Pairs
from slam.robust.map import MERGE_SIGMA_M, apply_merge
from slam.robust.parameters import (
    FIRST_NOISE_FACTOR,
    SECOND_NOISE_FACTOR,
    SIGMA_PER_MEDIAN,
    TAIL_PROBABILITY,
    BackEndParameters,
    is_plausible,
)
from slam.robust.solver.run_log import (
    Estimate,
    Problem,
    RunLog,
    all_poses,
    chain_of,
    motion_covariances,
    turned,
)
from slam.robust.solver.smoother import (
    Smoother,
    Solution,
    joint_covariance,
    measurement_residuals,
)
from slam.robust.state import (
    HEAD_SIZE,
    LEAST_VARIANCE,
    Array,
    Indices,
    State,
)

_LEAST_SHARE, _MOST_SHARE = 0.5, 1000.0  # keep `RangeErrors.variance_share` finite
_UNKNOWN = 100.0  # standard deviation of what is not determined
_LEAST_VARIANCE_M2 = 1e-18  # keeps the noise of ranges that the front end gave from vanishing


def is_due(log: RunLog, state: State, parameters: BackEndParameters) -> bool:
    """Return whether the pose is too far from the stored trajectory."""
    rule = parameters.relinearisation
    if log.since_solved < rule.every or not state.feature_ids:
        return False
    if log.since_solved >= max(rule.at_least_every, rule.run_share * log.n_poses):
        return True
    shift_m, turn_rad = log.parted(state.pose)
    return turn_rad > rule.turn_rad or shift_m > rule.shift_m


def relinearise(log: RunLog, state: State, parameters: BackEndParameters) -> bool:
    """Solve for all poses and replace the belief by the result; return whether it worked."""
    log.since_solved = 0
    problem = log.problem(state, parameters)
    solution = _solved(log, state, problem, parameters)
    if solution is None or not is_determined(solution.information):
        return False
    adopt(log, state, problem, solution, parameters)
    return True


def adopt(
    log: RunLog, state: State, problem: Problem, solution: Solution, parameters: BackEndParameters
) -> None:
    """Replace the belief by a solution, and let it choose the noise of ranges.

    The belief is less sure of radii than the solution is (`slam.robust.solver.radii`).
    """
    believed = Smoother(problem, parameters).believe(solution)
    # Other ranges may be outliers in it, and a landmark may have none left.
    solution = believed if is_determined(believed.information) else solution
    _replace(state, problem, solution)
    log.solved(problem, solution.estimate)
    learn_noise(problem, solution.estimate, state, parameters)


def _solved(
    log: RunLog, state: State, problem: Problem, parameters: BackEndParameters
) -> Solution | None:
    """Solve from the start of the least cost.

    If that fails, or moves the pose by more than its covariance allows, the other starts are tried,
    too, and the best solution counts. Where a landmark has corrected the pose at once, the filter's
    path has a jump: its cost is large, although it leads to the better solution.
    """
    smoother = Smoother(problem, parameters)
    found: list[Solution] = []
    for start in sorted(log.starts(state, problem), key=smoother.cost):
        solution = smoother.solve(start)
        if solution is not None:
            found.append(solution)
            if _is_expected(solution, state):
                break
    return min(found, key=lambda each: each.cost, default=None)


def _is_expected(solution: Solution, state: State) -> bool:
    """Return whether a solution moves the pose by no more than its covariance allows."""
    away = solution.estimate.poses[-1] - state.pose
    away[2] = wrap_angle(float(away[2]))
    covariance = state.pose_covariance() + LEAST_VARIANCE * np.eye(3)
    return is_plausible(float(away @ np.linalg.solve(covariance, away)), 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Merged:
    """The whole run, solved for with landmarks as one."""

    problem: Problem
    solution: Solution
    left_out: Indices  # shape (k,): rows of the log's ranges that are of nothing then


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Trial:
    """The whole run with the landmarks of pairs, by row, as two and as one."""

    two: Problem
    one: Problem
    left_out: Indices  # shape (k,): rows of the log's ranges that are in neither
    pairs: Pairs
    most_rise: float  # of the cost, from two to one
    parameters: BackEndParameters

    def merged(self, together: Solution | None) -> Merged | None:
        """Return a solution as one with what it is of; None of none."""
        if together is None:
            return None
        return Merged(problem=self.one, solution=together, left_out=self.left_out)

    def allows(self, together: Solution, least: float) -> bool:
        """Return whether a solution with them as one is good enough; ``least`` is that as two."""
        if together.cost - least > self.most_rise or not is_determined(together.information):
            return False
        # The cost of a range is bounded: few of them could lie anywhere.
        rows = measurement_residuals(self.one, together.estimate)
        residual = rows.residual[: len(self.one.ranges_m)]
        fits = np.abs(residual) <= self.parameters.relinearisation.outlier_sigmas
        of_rows = [self.two.range_landmarks == row for pair in self.pairs for row in pair]
        # Those of a map may have none in this run.
        return all(np.mean(fits[mine]) > 0.5 for mine in of_rows if mine.any())

    def solved_from(self, closed: Estimate, apart_cost: float) -> Solution | None:
        """Return the solution as one from far off, None if the run does not allow it."""
        start = _annealed(self.one, closed, self.parameters)
        together = Smoother(self.one, self.parameters).solve(start)
        if together is None or not self.allows(together, apart_cost):
            return None
        # The search went further than that for the solution with them as two: so does this one.
        doubled = with_doubled(self.two, together.estimate, self.pairs)
        again = Smoother(self.two, self.parameters).solve(doubled)
        least = apart_cost if again is None else min(apart_cost, again.cost)
        return together if self.allows(together, least) else None


def solved_as_one(
    log: RunLog,
    state: State,
    pairs: Pairs,
    parameters: BackEndParameters,
    known_ids: Collection[int] = (),
) -> Merged | None:
    """Solve for the whole run with landmarks, by row, as one, in pairs.

    None if the run does not allow it.

    The run is solved for with them as two and as one, their ranges having the noise of the noisier
    one. The cost may rise by what chance explains, the quantile of chi-square with two degrees of
    freedom for each pair, and most ranges of each landmark must fit where it is then.

    Behind a slip the robot may have taken one thing for another. So if all that fails, and there
    are as many pairs as place a robot, mistaken passages are left out of both solutions. Each
    landmark that they were taken for costs `BranchRule.most_against`. Landmarks of ``known_ids``
    are known for certain whenever they are seen.
    """
    ids, rule = state.landmark_ids, parameters.branches
    same = {ids[gone]: ids[kept] for kept, gone in pairs}
    two, one = copy.copy(state), copy.deepcopy(state)
    two.added_sigmas_m = state.added_sigmas_m | noisier(state, same)
    one.added_sigmas_m |= noisier(state, same)
    apply_merge(one, pairs, MERGE_SIGMA_M)
    by_chance = float(chdtri(2 * len(pairs), TAIL_PROBABILITY))

    def trial(left_out: Indices, most_rise: float) -> _Trial:
        return _Trial(
            two=log.problem(two, parameters, without=left_out),
            one=log.problem(one, parameters, same, left_out),
            left_out=left_out,
            pairs=pairs,
            most_rise=most_rise,
            parameters=parameters,
        )

    every = trial(np.zeros(0, dtype=np.intp), by_chance)
    apart = _solved(log, two, every.two, parameters)
    if apart is None:
        return None
    # Most pairs are near enough to be solved for from where the filter has them.
    together = _solved(log, one, every.one, parameters)
    if together is not None and every.allows(together, apart.cost):
        return every.merged(together)
    closed = with_closed_loop(every.two, apart.estimate, pairs)
    together = every.solved_from(closed, apart.cost)
    if together is not None or len(pairs) < rule.least_landmarks:
        return every.merged(together)
    rows, passages = log.passages(one, same)
    is_certain = np.isin(one.feature_ids, [*same.values(), *known_ids])
    limit = parameters.relinearisation.outlier_sigmas
    is_mistaken = mistaken(every.one, closed, passages, is_certain, limit)
    n_mistaken = len(np.unique(every.one.range_landmarks[is_mistaken]))
    most_rise = by_chance - 2.0 * rule.most_against * n_mistaken  # a nat is a cost of two
    if not n_mistaken or most_rise <= 0.0:
        return None
    some = trial(rows[is_mistaken], most_rise)
    again = Smoother(some.two, parameters).solve(apart.estimate)
    return None if again is None else some.merged(some.solved_from(closed, again.cost))


def mistaken(
    problem: Problem,
    closed: Estimate,
    passages: Indices,
    is_certain: NDArray[np.bool_],
    outlier_sigmas: float,
) -> NDArray[np.bool_]:
    """Return which ranges are of passages in which something was taken for a landmark, (m,).

    Most ranges of such a passage are too far off where the loop is closed to be solved for. It is
    not the first one of the landmark, which says what the landmark is, and not of one that
    ``is_certain`` (n,), by row. ``passages`` (m,) are those of the ranges.
    """
    residual = measurement_residuals(problem, closed).residual[: len(passages)]
    is_far = np.abs(residual) > SECOND_NOISE_FACTOR * outlier_sigmas
    are_mistaken = np.bincount(passages, is_far) > 0.5 * np.bincount(passages)
    of_range = problem.range_landmarks
    # Passages are numbered by landmark, and those of one in the order of time.
    first = np.full(len(is_certain), len(passages))
    np.minimum.at(first, of_range, passages)
    are_mistaken[first[np.unique(of_range)]] = False
    return are_mistaken[passages] & ~is_certain[of_range]


def with_closed_loop(problem: Problem, apart: Estimate, pairs: Pairs) -> Estimate:
    """Return an estimate with the second landmark of each pair, by row, where the first one is.

    ``problem`` and ``apart`` are of them as two; the estimate has no second landmarks. Poses are
    (k + 1, 3) [m, m, rad], landmarks (n, 2) [m], map frame. All poses since the first of the second
    ones was seen are moved as one. The motions between that and the last sight of a first one share
    the correction in proportion to their variances: turns, then what is left of the way
    (G. Dubbelman and B. Browning, "COP-SLAM", IEEE Transactions on Robotics 31(5), 2015). Features
    move with the pose that saw them first, but for the first landmarks of the pairs and those of a
    map.
    """
    kept, gone = np.array(pairs, dtype=np.intp).T
    layout, at, seen_from = problem.layout, problem.range_landmarks, problem.range_poses
    values = np.concatenate([np.zeros(HEAD_SIZE), apart.fixed])
    landmarks = values[layout.landmarks].reshape(-1, layout.landmark_size)
    walls = values[layout.walls].reshape(-1, 2)
    motion = align_se2(landmarks[gone, :2], landmarks[kept, :2])
    last = len(apart.poses) - 1
    begin = int(seen_from[np.isin(at, gone)].min(initial=last))
    end = int(seen_from[np.isin(at, kept) & (seen_from < begin)].max(initial=0))
    chain = chain_of(problem.steps, problem.keys, apart.calibration[:last])
    variances = motion_covariances(chain, problem.step_covariances)[end:begin]
    poses, turns, sharing = apart.poses.copy(), np.zeros(last + 1), slice(end + 1, begin + 1)
    turns[sharing] = motion[2] * _shares(variances[:, 2, 2])
    turns[begin:] = motion[2]
    ways = turned(np.diff(apart.poses[end : begin + 1, :2], axis=0), turns[end:begin])
    poses[sharing, :2] = poses[end, :2] + np.cumsum(ways, axis=0)
    missed = transform(motion, apart.poses[begin, :2]) - poses[begin, :2]
    poses[sharing, :2] += _shares(variances[:, 0, 0] + variances[:, 1, 1])[:, None] * missed
    poses[begin:, :2] = transform(motion, apart.poses[begin:, :2])
    poses[:, 2] += turns
    first = np.full(layout.n_landmarks + layout.n_walls, last)
    np.minimum.at(first, at, seen_from)
    is_of_map = np.isin(layout.first_columns(np.arange(len(first))), problem.known_at)
    stays = is_of_map | np.isin(np.arange(len(first)), kept)
    moved, moved_walls = np.split(
        np.flatnonzero(~stays), [int(np.sum(~stays[: layout.n_landmarks]))]
    )
    by = first[moved]
    away = landmarks[moved, :2] - apart.poses[by, :2]
    landmarks[moved, :2] = poses[by, :2] + turned(away, turns[by])
    # n . q = d for the places q of a wall, before and behind
    by, moved_walls = first[moved_walls], moved_walls - layout.n_landmarks
    walls[moved_walls, 1] -= _along(walls[moved_walls, 0], apart.poses[by, :2])
    walls[moved_walls, 0] += turns[by]
    walls[moved_walls, 1] += _along(walls[moved_walls, 0], poses[by, :2])
    constants = apart.fixed[: layout.landmarks.start - HEAD_SIZE]
    fixed = np.concatenate([constants, np.delete(landmarks, gone, axis=0).ravel(), walls.ravel()])
    return replace(apart, poses=poses, fixed=fixed)


def with_doubled(problem: Problem, together: Estimate, pairs: Pairs) -> Estimate:
    """Return an estimate with the second landmark of each pair, by row, where the first one is [m].

    ``problem`` is of them as two, ``together`` a solution with them as one, map frame.
    """
    kept, gone = np.array(pairs, dtype=np.intp).T
    layout = problem.layout
    n_constants, size = layout.landmarks.start - HEAD_SIZE, layout.landmark_size
    own = np.delete(np.arange(layout.n_landmarks), gone)
    constants, rest = np.split(together.fixed, [n_constants])
    landmarks = np.zeros((layout.n_landmarks, size))
    landmarks[own] = rest[: size * len(own)].reshape(-1, size)
    landmarks[gone] = landmarks[kept]
    fixed = np.concatenate([constants, landmarks.ravel(), rest[size * len(own) :]])
    return replace(together, fixed=fixed)


def _annealed(problem: Problem, start: Estimate, parameters: BackEndParameters) -> Estimate:
    """Return the solution from a start with much more noise of measurements, then with less.

    Far from the solution, Gauss-Newton steps with precise ranges end in another minimum. Radii stay
    as they are: with vague ranges their prior would take all landmarks for thin.
    """
    layout = problem.layout
    radii = np.arange(layout.size)[layout.radii if layout.has_radii else slice(0, 0)] - HEAD_SIZE
    for factor in (FIRST_NOISE_FACTOR, SECOND_NOISE_FACTOR):
        vague = replace(
            problem,
            range_sigmas_m=factor * problem.range_sigmas_m,
            range_bearing_sigmas_rad=factor * problem.range_bearing_sigmas_rad,
        )
        solution = Smoother(vague, parameters).solve(start)
        if solution is None:
            return start
        fixed = solution.estimate.fixed.copy()
        fixed[radii] = start.fixed[radii]
        start = replace(solution.estimate, fixed=fixed)
    return start


def _shares(variances: Array) -> Array:
    """Return which part of their sum variances (k,) have reached after each, shape (k,)."""
    reached = np.cumsum(variances + _LEAST_VARIANCE_M2)
    return np.asarray(reached / reached[-1:])


def _along(directions_rad: Array, places_m: Array) -> Array:
    """Return how far places (k, 2) [m] are along directions (k,) [rad], shape (k,) [m]."""
    return np.asarray(
        np.cos(directions_rad) * places_m[:, 0] + np.sin(directions_rad) * places_m[:, 1]
    )


def noisier(state: State, same: Mapping[int, int]) -> dict[int, float]:
    """Return by id what is added to the sigmas of landmarks that may be one [m]: the larger of two.

    ``same`` maps the id of a landmark to that of the one that it may be.
    """
    added = state.added_sigmas_m
    return {
        id_: max(added.get(gone, 0.0), added.get(kept, 0.0))
        for gone, kept in same.items()
        for id_ in (gone, kept)
    }


def learn_noise(
    problem: Problem, estimate: Estimate, state: State, parameters: BackEndParameters
) -> None:
    """Let the residuals of a solution choose the noise of ranges, of each landmark and of all.

    The variance of single ranges is that of their median residual; a landmark's own is believed in
    proportion to its passages. A wall's added sigma is never less than `WallRule.roughness_m`.
    Where many ranges are averaged, more must be allowed for: those that see a body from one side
    err alike, on every lap, since its scattering centre depends on the side. The sums of their
    residuals show it: had all ranges errors of their own, the variance of a sum would be the number
    of its terms. Of walls those of some keyframes are summed. Errors that places and radii have
    taken up are missing in the residuals, which counts as so many sums less. Poses take up what
    changes with aspect; where bodies err so, the share is therefore never below the configured one.
    """
    n, rule = len(problem.ranges_m), parameters.noise
    if n < rule.fewest_ranges:
        return
    ids, at = state.feature_ids, problem.range_landmarks
    rows = measurement_residuals(problem, estimate)
    residual, away = rows.residual[:n], rows.by_pose[:n, :2]
    added = np.array([state.added_sigmas_m.get(id_, 0.0) for id_ in ids])
    given_m = np.sqrt(np.maximum(problem.range_sigmas_m**2 - added[at] ** 2, _LEAST_VARIANCE_M2))
    ratio = residual * problem.range_sigmas_m / given_m
    of_all = (SIGMA_PER_MEDIAN * float(np.median(np.abs(ratio)))) ** 2
    block = problem.range_poses // rule.keys_per_passage
    own = np.zeros(len(ids))
    for row, id_ in enumerate(ids):
        mine = np.flatnonzero(at == row)
        if not len(mine):
            continue
        n_passages = len(np.unique(block[mine]))
        raw = (SIGMA_PER_MEDIAN * float(np.median(np.abs(ratio[mine])))) ** 2
        believed = (n_passages * raw + rule.prior_weight * of_all) / (
            n_passages + rule.prior_weight
        )
        own[row] = math.sqrt(max(believed - 1.0, 0.0)) * float(np.median(given_m[mine]))
        if id_ in state.wall_ids:
            own[row] = max(own[row], parameters.walls.roughness_m)
        state.added_sigmas_m[id_] = own[row]
    sigmas_m, most_sigmas = np.hypot(given_m, own[at]), parameters.initialisation.gate_sigmas
    white = np.clip(ratio * given_m / sigmas_m, -most_sigmas, most_sigmas)
    alike = np.column_stack([at, block])
    if rule.aspect_rad > 0.0:
        aspects = np.floor(np.arctan2(away[:, 1], away[:, 0]) / rule.aspect_rad)
        alike[:, 1] = np.where(at < state.layout.n_landmarks, aspects, block)
    sums = np.bincount(np.unique(alike, axis=0, return_inverse=True)[1].ravel(), white)
    n_groups = len(sums)
    n_unknowns = (2 + state.layout.has_radii) * len(np.unique(at))
    share = n_groups * float(np.sum(sums**2)) / n
    configured = parameters.ranges.variance_share
    share += rule.prior_weight * configured
    share /= max(n_groups - n_unknowns, 0) + rule.prior_weight
    share = max(min(share, _MOST_SHARE), configured if rule.aspect_rad > 0.0 else _LEAST_SHARE)
    added_m = math.sqrt(max(of_all - 1.0, 0.0)) * float(np.median(given_m))
    state.range_errors = replace(state.range_errors, added_m=added_m, variance_share=share)


def solve_whole_run(
    log: RunLog, state: State, parameters: BackEndParameters
) -> tuple[Array, Array, Array, Array, Array] | None:
    """Return poses (n + 1, 3) and covariances, features (m, 2) and covariances, and constants.

    None if it fails. Radii are the likeliest, and covariances those of the search for them. Errors
    are additive; of the constants see `SmoothedRun`. Nothing is changed.
    """
    if log.n_poses < 2:
        return None
    problem = log.problem(state, parameters)
    smoother = Smoother(problem, parameters)
    found = [smoother.solve(start) for start in log.starts(state, problem)]
    solutions = [solution for solution in found if solution is not None]
    if not solutions:
        return None
    best = min(solutions, key=lambda each: each.cost).estimate
    try:
        of_keys, border = smoother.covariances(best)
    except np.linalg.LinAlgError:
        return None
    first = problem.layout.first_columns(np.arange(len(state.feature_ids)))
    columns = np.column_stack([first, first + 1])
    blocks = border[columns[:, :, None], columns[:, None, :]]
    poses, of_poses = all_poses(problem, best, of_keys)
    away, sigmas = smoother.constants(best)
    stated = np.full(len(away), parameters.ranges.offset_sigma_m)
    stated[:3] = parameters.wheels.calibration_sigmas
    constants = np.column_stack([away, np.where(stated > 0.0, sigmas, np.inf)])
    return poses, of_poses, best.fixed[columns - HEAD_SIZE], blocks, constants


def is_determined(information: Array) -> bool:
    """Return whether all unknowns of a solution are known to better than 100 m, rad or 1.

    A landmark all of whose ranges were left out as too far off has no information but rounding;
    its covariance would be of 1e14 m^2, and have negative eigenvalues.
    """
    variances = np.linalg.inv(information).diagonal()
    return bool(np.all((variances > 0.0) & (variances < _UNKNOWN**2)))


def _replace(state: State, problem: Problem, solution: Solution) -> None:
    estimate, layout = solution.estimate, state.layout
    pose = estimate.poses[-1]
    state.position_m = pose[:2].copy()
    state.heading_rad = math.remainder(float(pose[2]), math.tau)
    state.calibration = estimate.calibration[-1].copy()
    values = np.concatenate([np.zeros(HEAD_SIZE), estimate.fixed])
    state.offsets_m = values[layout.offsets].copy()
    if layout.has_mounts:
        state.mounts_m = values[layout.mounts].reshape(-1, 2).copy()
    landmarks = values[layout.landmarks].reshape(-1, layout.landmark_size)
    state.landmarks_m = landmarks[:, :2].copy()
    if layout.has_radii:
        state.radii_m = landmarks[:, 2].copy()
    state.walls = values[layout.walls].reshape(-1, 2).copy()
    keys = np.searchsorted(problem.keys, state.past_numbers)
    state.past = estimate.poses[keys]
    # The smoother orders (x, y, heading, ...), the filter (heading, x, y, ...)
    additive = joint_covariance(solution.eliminated, keys)
    order = np.concatenate([[2, 0, 1], np.arange(3, len(additive))])
    state.set_additive_covariance(additive[np.ix_(order, order)])
