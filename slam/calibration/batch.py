"""The terms of a batch problem over a robot's drive: odometry, single ranges, priors.

A problem is a list of terms; the answer minimises the sum of their costs. Method: Gauss-Newton on
the normal equations with Levenberg and Marquardt's damping, robust kernels by reweighting (Triggs
et al., "Bundle adjustment - a modern synthesis", 2000, sections 4.3 and 6).

The unknowns are eliminated in the order of the state vector: the factor is banded with a narrow
border, and the work is linear in the number of poses.

A state vector holds, in this order: n poses [x m, y m, heading rad] in time order, heading
continuous; k landmarks [x m, y m]; the three constants of the wheels [scale, turn scale,
curvature rad/m]; and for each radar its range offset [m] and mount position x, y [m, body frame].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Scale of a robust term that keeps 95 % of the efficiency under Gaussian noise.
CAUCHY_SCALE = 2.385
# Share of the diagonal that is added to the normal equations, at first and at least.
_DAMPING, _LEAST_DAMPING = 1e-4, 1e-12


class SingularProblemError(ValueError):
    """The terms leave a direction of the state without any bound; a prior is missing."""


class Term(Protocol):
    """One group of residuals of one kind."""

    @property
    def cauchy_scale(self) -> float | None:
        """Residual, in standard deviations, with half the weight; None for least squares."""

    def residuals(self, state: Array) -> Array:
        """Return the whitened residuals, shape (m,)."""

    def jacobian(self, state: Array) -> csr_array[np.float64]:
        """Return their derivatives, shape (m, n_state)."""


def _costs(residuals: Array, scale: float | None) -> Array:
    """Return c^2 / 2 ln(1 + r^2 / c^2), Cauchy's cost for the scale c; r^2 / 2 without one."""
    if scale is None:
        return residuals**2 / 2
    return np.asarray(scale**2 / 2 * np.log1p((residuals / scale) ** 2))


def _weights(residuals: Array, scale: float | None) -> Array:
    """Return the derivative of the cost by half the square, in [0, 1]."""
    return np.ones_like(residuals) if scale is None else 1 / (1 + (residuals / scale) ** 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """When the iteration ends."""

    most_iterations: int = 60  # linear solves, refused steps included
    relative_decrease: float = 1e-9  # least share of the cost that an accepted step must gain


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BatchSolution:
    """The most likely state and how well it is known."""

    state: Array  # shape (n,)
    cost: float  # sum over all residuals
    # Shape (n, n), weighted normal matrix at `state`, without damping
    information: csc_array[np.float64]

    def covariance(self, indices: Sequence[int] | NDArray[np.intp]) -> Array:
        """Return the joint posterior covariance of some entries of the state, shape (k, k).

        Raises
        ------
        SingularProblemError
            Some direction has no bound.
        """
        rows = np.asarray(indices, dtype=np.intp)
        unit = np.zeros((self.information.shape[0], len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        block: Array = _factor(self.information).solve(unit)[rows]
        return (block + block.T) / 2


def minimise(start: Array, terms: Sequence[Term], stop: Stop | None = None) -> BatchSolution:
    """Return the state of least cost near a start.

    Raises
    ------
    SingularProblemError
        The terms together do not bound every direction of the state.
    """
    rule = stop or Stop()
    state = np.array(start, dtype=np.float64)
    cost, share = _cost(terms, state), _DAMPING
    information, gradient = _normal_equations(terms, state)
    for _ in range(rule.most_iterations):
        diagonal = information.diagonal()
        damped = csc_array(information + diags_array(share * diagonal, format="csc"))
        step = -_factor(damped).solve(gradient)
        trial = state + step
        trial_cost = _cost(terms, trial)
        if not trial_cost < cost:  # NaN does not count as an improvement either
            curved = np.asarray(information @ step)
            decrease = -float(gradient @ step) - float(step @ curved) / 2
            if decrease <= rule.relative_decrease * cost:
                break  # not even the quadratic model promises anything
            share = max(10 * share, 1e-8)
            continue
        gained = cost - trial_cost
        state, cost = trial, trial_cost
        information, gradient = _normal_equations(terms, state)
        share = max(share / 10, _LEAST_DAMPING)
        if gained <= rule.relative_decrease * cost:
            break
    return BatchSolution(state=state, cost=cost, information=information)


def _cost(terms: Sequence[Term], state: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):  # a wild trial step is refused anyway
        return float(sum(_costs(term.residuals(state), term.cauchy_scale).sum() for term in terms))


def _normal_equations(terms: Sequence[Term], state: Array) -> tuple[csc_array[np.float64], Array]:
    information = csc_array((len(state), len(state)))
    gradient = np.zeros(len(state))
    for term in terms:
        residuals = term.residuals(state)
        jacobian = term.jacobian(state)
        weights = _weights(residuals, term.cauchy_scale)
        weighted = diags_array(weights, format="csr") @ jacobian
        information = csc_array(information + jacobian.T @ weighted)
        gradient += np.asarray(weighted.T @ residuals)
    return information, gradient


def _factor(matrix: csc_array[np.float64]) -> SuperLU:
    """Factor a symmetric positive definite matrix without changing its order."""
    try:
        options = {"SymmetricMode": True}
        return splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options)
    except RuntimeError as error:
        raise SingularProblemError(
            "the problem leaves a direction of the state without any bound"
        ) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class StateLayout:
    """Where each unknown lies in the state vector."""

    n_poses: int
    n_landmarks: int
    n_radars: int

    @property
    def size(self) -> int:
        return 3 * self.n_poses + 2 * self.n_landmarks + 3 + 3 * self.n_radars

    @property
    def poses(self) -> slice:
        return slice(0, 3 * self.n_poses)

    @property
    def landmarks(self) -> slice:
        return slice(3 * self.n_poses, 3 * self.n_poses + 2 * self.n_landmarks)

    @property
    def wheels(self) -> slice:
        """Return where scale, turn scale and curvature are."""
        return slice(self.landmarks.stop, self.landmarks.stop + 3)

    @property
    def radars(self) -> slice:
        """Return where offset, mount x and mount y of each radar are."""
        return slice(self.wheels.stop, self.size)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PriorTerm:
    """Entries of the state with independent priors; indices, means, sigmas of shape (m,)."""

    indices: Indices
    means: Array
    sigmas: Array
    cauchy_scale: float | None = None

    def residuals(self, state: Array) -> Array:
        return (state[self.indices] - self.means) / self.sigmas

    def jacobian(self, state: Array) -> csr_array[np.float64]:
        rows = np.arange(len(self.indices))
        return csr_array((1 / self.sigmas, (rows, self.indices)), shape=(len(rows), len(state)))


def steps_of(poses: Array) -> Array:
    """Return each step in the body frame at its start, shape (n - 1, 3): [m], [m], [rad]."""
    step_x, step_y, turn = np.diff(poses, axis=0).T
    cosine, sine = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    return np.column_stack([cosine * step_x + sine * step_y, cosine * step_y - sine * step_x, turn])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OdometryTerm:
    """The reported steps of the wheels from one pose to the next.

    With d, a a true step in the body frame at its start, the wheels report (constants s, w,
    kappa)::

        u_xy = (1 + s) d + white        u_a = (1 + w) a + kappa |u_xy| / (1 + s) + white
    """

    layout: StateLayout
    steps: Array  # shape (n_poses - 1, 3): reported ux [m], uy [m], ua [rad]
    sigmas: Array  # shape (n_poses - 1, 3), standard deviations in the same units
    cauchy_scale: float | None = None

    def residuals(self, state: Array) -> Array:
        dx, dy, turn = steps_of(state[self.layout.poses].reshape(-1, 3)).T
        scale, turn_scale, curvature = state[self.layout.wheels]
        distance = np.sqrt(self.steps[:, 0] ** 2 + self.steps[:, 1] ** 2)
        expected = np.column_stack(
            [
                (1 + scale) * dx,
                (1 + scale) * dy,
                (1 + turn_scale) * turn + curvature * distance / (1 + scale),
            ]
        )
        return ((expected - self.steps) / self.sigmas).ravel()

    def jacobian(self, state: Array) -> csr_array[np.float64]:
        poses = state[self.layout.poses].reshape(-1, 3)
        dx, dy, turn = steps_of(poses).T
        cosine, sine = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
        scale, turn_scale, curvature = state[self.layout.wheels]
        distance = np.sqrt(self.steps[:, 0] ** 2 + self.steps[:, 1] ** 2)
        n = len(dx)
        first = 3 * np.arange(n)
        wheels = self.layout.wheels.start
        grown, one = 1 + scale, np.ones(n)
        parts: list[tuple[int, Indices, Array]] = [
            # row within the step, column, value
            (0, first, -grown * cosine),
            (0, first + 1, -grown * sine),
            (0, first + 2, grown * dy),
            (0, first + 3, grown * cosine),
            (0, first + 4, grown * sine),
            (0, np.full(n, wheels), dx),
            (1, first, grown * sine),
            (1, first + 1, -grown * cosine),
            (1, first + 2, -grown * dx),
            (1, first + 3, -grown * sine),
            (1, first + 4, grown * cosine),
            (1, np.full(n, wheels), dy),
            (2, first + 2, -(1 + turn_scale) * one),
            (2, first + 5, (1 + turn_scale) * one),
            (2, np.full(n, wheels), -curvature * distance / grown**2),
            (2, np.full(n, wheels + 1), turn),
            (2, np.full(n, wheels + 2), distance / grown),
        ]
        rows = np.concatenate([first + row for row, _, _ in parts])
        columns = np.concatenate([column for _, column, _ in parts])
        values = np.concatenate([value / self.sigmas[:, row] for row, _, value in parts])
        return csr_array((values, (rows, columns)), shape=(3 * n, len(state)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeTerm:
    """Single ranges: from one radar at one time to one landmark.

    z = |l - p - R m| + b + noise; the pose at the sample's own time lies between two poses,
    linear in position and in heading, which is exact on straights and for turns on the spot.
    """

    layout: StateLayout
    # Shape (m,) each: index of the pose before the sample, and how far on to the next, [0, 1]
    pose: Indices
    fraction: Array
    # Shape (m,), indices
    landmark: Indices
    radar: Indices
    # Shape (m,), true metres, no offset removed; and its standard deviation
    range_m: Array
    sigma_m: Array
    cauchy_scale: float | None = None

    def residuals(self, state: Array) -> Array:
        _, _, distance, _, _ = self._sight(state)
        offset = state[self._radar_columns()]
        return (distance + offset - self.range_m) / self.sigma_m

    def jacobian(self, state: Array) -> csr_array[np.float64]:
        ux, uy, _, (arm_x, arm_y), (cosine, sine) = self._sight(state)
        m = len(self.pose)
        one = np.ones(m)
        before, after = 1 - self.fraction, self.fraction
        here, there = 3 * self.pose, 3 * np.minimum(self.pose + 1, self.layout.n_poses - 1)
        point = self.layout.landmarks.start + 2 * self.landmark
        radar = self._radar_columns()
        swing = ux * arm_y - uy * arm_x  # -u . d(R m)/d heading
        parts = [
            (here, -before * ux),
            (here + 1, -before * uy),
            (here + 2, before * swing),
            (there, -after * ux),
            (there + 1, -after * uy),
            (there + 2, after * swing),
            (point, ux),
            (point + 1, uy),
            (radar, one),
            (radar + 1, -(ux * cosine + uy * sine)),
            (radar + 2, ux * sine - uy * cosine),
        ]
        rows = np.tile(np.arange(m), len(parts))
        columns = np.concatenate([column for column, _ in parts])
        values = np.concatenate([value / self.sigma_m for _, value in parts])
        return csr_array((values, (rows, columns)), shape=(m, len(state)))

    def _radar_columns(self) -> Indices:
        columns: Indices = self.layout.radars.start + 3 * self.radar
        return columns

    def _sight(
        self, state: Array
    ) -> tuple[Array, Array, Array, tuple[Array, Array], tuple[Array, Array]]:
        """Return direction and distance of each sight, its arm R m and the robot's heading."""
        poses = state[self.layout.poses].reshape(-1, 3)
        following = np.minimum(self.pose + 1, self.layout.n_poses - 1)
        part = self.fraction[:, np.newaxis]
        x, y, heading = ((1 - part) * poses[self.pose] + part * poses[following]).T
        cosine, sine = np.cos(heading), np.sin(heading)
        mount_x, mount_y = state[self._radar_columns() + 1], state[self._radar_columns() + 2]
        arm_x, arm_y = cosine * mount_x - sine * mount_y, sine * mount_x + cosine * mount_y
        points = state[self.layout.landmarks].reshape(-1, 2)[self.landmark]
        dx, dy = points[:, 0] - x - arm_x, points[:, 1] - y - arm_y
        distance = np.sqrt(dx * dx + dy * dy)  # numpy's hypot takes no complex step
        return dx / distance, dy / distance, distance, (arm_x, arm_y), (cosine, sine)
