"""Sparse nonlinear least squares: the most likely state of a whole recording at once.

A problem is a list of terms. Each maps the state vector to residuals, divided by their standard
deviations already, and their Jacobian; the answer minimises the sum of the terms' costs. Method:
Gauss-Newton on the normal equations with Levenberg and Marquardt's damping, robust kernels by
reweighting (Triggs et al., "Bundle adjustment - a modern synthesis", 2000, sections 4.3 and 6).

The unknowns are eliminated in the order of the state vector. With poses in time order first and
what all of them share (landmarks, calibration) last, the factor is banded with a narrow border,
and the work is linear in the number of poses.
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


class SingularProblemError(ValueError):
    """The terms leave a direction of the state without any bound; a prior is missing."""


class Term(Protocol):
    """One group of residuals of one kind."""

    @property
    def kernel(self) -> Kernel:
        """What a residual costs."""

    def residuals(self, state: Array) -> Array:
        """Return the whitened residuals, shape (m,)."""

    def jacobian(self, state: Array) -> csr_array[np.float64]:
        """Return their derivatives, shape (m, n_state)."""


class Kernel(Protocol):
    """The cost of a whitened residual and the weight it gets in the normal equations."""

    def costs(self, residuals: Array) -> Array:
        """Return the cost of each residual; half its square where nothing is robust."""

    def weights(self, residuals: Array) -> Array:
        """Return the derivative of the cost by half the square, in [0, 1]."""


class Square:
    """Least squares: for Gaussian noise without outliers."""

    def costs(self, residuals: Array) -> Array:
        """Return r^2 / 2."""
        return residuals**2 / 2

    def weights(self, residuals: Array) -> Array:
        """Return ones."""
        return np.ones_like(residuals)


@dataclass(frozen=True, slots=True, kw_only=True)
class Cauchy:
    """Lorentzian cost: an outlier pulls the less the farther it is off.

    Attributes
    ----------
    scale
        Residual, in standard deviations, at which the weight is one half; 2.385 keeps 95 % of the
        efficiency under Gaussian noise.
    """

    scale: float = 2.385

    def costs(self, residuals: Array) -> Array:
        """Return c^2 / 2 ln(1 + r^2 / c^2)."""
        result: Array = self.scale**2 / 2 * np.log1p((residuals / self.scale) ** 2)
        return result

    def weights(self, residuals: Array) -> Array:
        """Return 1 / (1 + r^2 / c^2)."""
        return 1 / (1 + (residuals / self.scale) ** 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Damping:
    """When the iteration stops and how it is held back.

    Attributes
    ----------
    initial, least
        Share of the diagonal that is added to the normal equations, at first and at least.
    most_iterations
        Linear solves, refused steps included.
    relative_decrease
        The iteration has converged once an accepted step lowers the cost by less than this share
        of it.
    """

    initial: float = 1e-4
    least: float = 1e-12
    most_iterations: int = 60
    relative_decrease: float = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """The most likely state and how well it is known.

    Attributes
    ----------
    state
        Shape (n,).
    cost
        Sum over all residuals, and `costs` that of every accepted state, descending.
    information
        Shape (n, n), weighted normal matrix at `state`, without damping.
    converged
        False where `most_iterations` came first.
    """

    state: Array
    cost: float
    costs: tuple[float, ...]
    information: csc_array[np.float64]
    converged: bool

    def covariance(self, indices: Sequence[int] | NDArray[np.intp]) -> Array:
        """Return the joint posterior covariance of some entries of the state.

        Shape (k, k) for k indices: that block of the inverse of `information`, by k solves.

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


def minimise(start: Array, terms: Sequence[Term], damping: Damping | None = None) -> Solution:
    """Return the state of least cost near a start.

    Parameters
    ----------
    start
        Shape (n,).
    terms
        Together they must bound every direction of the state.
    damping
        Stopping rule.

    Raises
    ------
    SingularProblemError
        Some direction has no bound.
    """
    rule = damping or Damping()
    state = np.array(start, dtype=np.float64)
    cost = _cost(terms, state)
    costs = [cost]
    share, converged = rule.initial, False
    information, gradient = _normal_equations(terms, state)
    for _ in range(rule.most_iterations):
        diagonal = information.diagonal()
        damped = csc_array(information + diags_array(share * diagonal, format="csc"))
        step = -_factor(damped).solve(gradient)
        trial = state + step
        trial_cost = _cost(terms, trial)
        if not trial_cost < cost:  # NaN is no improvement either
            curved = np.asarray(information @ step)
            decrease = -float(gradient @ step) - float(step @ curved) / 2
            if decrease <= rule.relative_decrease * cost:
                converged = True  # not even the quadratic model promises anything
                break
            share = max(10 * share, 1e-8)
            continue
        gained = cost - trial_cost
        state, cost = trial, trial_cost
        costs.append(cost)
        information, gradient = _normal_equations(terms, state)
        share = max(share / 10, rule.least)
        if gained <= rule.relative_decrease * cost:
            converged = True
            break
    return Solution(
        state=state,
        cost=cost,
        costs=tuple(costs),
        information=information,
        converged=converged,
    )


def _cost(terms: Sequence[Term], state: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):  # a wild trial step is refused anyway
        return float(sum(term.kernel.costs(term.residuals(state)).sum() for term in terms))


def _normal_equations(terms: Sequence[Term], state: Array) -> tuple[csc_array[np.float64], Array]:
    information = csc_array((len(state), len(state)))
    gradient = np.zeros(len(state))
    for term in terms:
        residuals = term.residuals(state)
        jacobian = term.jacobian(state)
        weights = term.kernel.weights(residuals)
        weighted = diags_array(weights, format="csr") @ jacobian
        information = csc_array(information + jacobian.T @ weighted)
        gradient += np.asarray(weighted.T @ residuals)
    return information, gradient


def _factor(matrix: csc_array[np.float64]) -> SuperLU:
    """Factor a symmetric positive definite matrix without changing its order."""
    try:
        return splu(
            matrix,
            permc_spec="NATURAL",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:
        raise SingularProblemError(
            "the problem leaves a direction of the state without any bound"
        ) from error
