"""The sparse batch optimiser against closed forms, derivatives and planted outliers."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_array

from slam.calibration.batch import (
    CAUCHY_SCALE,
    OdometryTerm,
    PriorTerm,
    RangeTerm,
    SingularProblemError,
    StateLayout,
    Stop,
    Term,
    _costs,
    _weights,
    minimise,
)
from slam.calibration.calibration import UNKNOWN_WHEELS

Array = NDArray[np.float64]

LAYOUT = StateLayout(n_poses=6, n_landmarks=3, n_radars=2)


def some_state(seed: int) -> Array:
    return np.random.default_rng(seed).normal(0.0, 1.0, LAYOUT.size)


def odometry_term(seed: int) -> OdometryTerm:
    steps = np.random.default_rng(seed).normal(0.0, 0.3, (5, 3))
    return OdometryTerm(layout=LAYOUT, steps=steps, sigmas=UNKNOWN_WHEELS.step_sigmas(steps))


def range_term(seed: int, cauchy_scale: float | None = None) -> RangeTerm:
    random = np.random.default_rng(seed)
    m = 40
    return RangeTerm(
        layout=LAYOUT,
        pose=random.integers(0, 6, m),  # the last pose too, which has no next one
        fraction=random.uniform(0.0, 1.0, m),
        landmark=random.integers(0, 3, m),
        radar=random.integers(0, 2, m),
        range_m=random.uniform(0.5, 2.0, m),
        sigma_m=random.uniform(1e-3, 1e-2, m),
        cauchy_scale=cauchy_scale,
    )


def prior_term(seed: int) -> PriorTerm:
    random = np.random.default_rng(seed)
    indices = random.permutation(LAYOUT.size)[:9]
    return PriorTerm(indices=indices, means=random.normal(size=9), sigmas=random.uniform(1, 2, 9))


@pytest.mark.parametrize("make", [odometry_term, range_term, prior_term])
@pytest.mark.parametrize("seed", range(3))
def test_jacobians_are_the_complex_step_derivatives(make: type[OdometryTerm], seed: int) -> None:
    term: Term = make(seed)  # type: ignore[call-arg, arg-type]  # functions, called alike
    state = some_state(seed + 100)
    step = 1e-30
    expected = np.empty((len(term.residuals(state)), len(state)))
    for column in range(len(state)):
        moved = state.astype(np.complex128)
        moved[column] += 1j * step
        expected[:, column] = np.imag(term.residuals(moved)) / step  # type: ignore[arg-type]  # complex step
    np.testing.assert_allclose(term.jacobian(state).toarray(), expected, rtol=1e-10, atol=1e-9)


def test_layout_covers_the_state_without_gap() -> None:
    parts = [LAYOUT.poses, LAYOUT.landmarks, LAYOUT.wheels, LAYOUT.radars]
    assert [part.start for part in parts] == [0, *(part.stop for part in parts[:-1])]
    assert parts[-1].stop == LAYOUT.size == 6 * 3 + 3 * 2 + 3 + 2 * 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linear:
    """A x - b: a term whose answer has a closed form."""

    matrix: Array
    right: Array
    cauchy_scale: float | None = None

    def residuals(self, state: Array) -> Array:
        result: Array = self.matrix @ state - self.right
        return result

    def jacobian(self, state: Array) -> csr_array[np.float64]:
        return csr_array(self.matrix)


def linear(seed: int = 0) -> Linear:
    random = np.random.default_rng(seed)
    return Linear(matrix=random.normal(size=(30, 4)), right=random.normal(size=30))


def test_a_linear_problem_has_the_answer_and_covariance_of_the_normal_equations() -> None:
    term = linear()
    solution = minimise(np.full(4, 50.0), [term])
    expected, residue, *_ = np.linalg.lstsq(term.matrix, term.right)
    np.testing.assert_allclose(solution.state, expected, atol=1e-9)
    assert solution.cost == pytest.approx(float(residue[0]) / 2)
    inverse = np.linalg.inv(term.matrix.T @ term.matrix)
    np.testing.assert_allclose(solution.covariance([3, 1]), inverse[np.ix_([3, 1], [3, 1])])


def test_a_robust_kernel_ignores_what_least_squares_follows() -> None:
    clean = linear()
    truth = np.array([1.0, -2.0, 0.5, 3.0])
    spoilt = clean.matrix @ truth
    spoilt[::6] += 500.0
    least_squares = minimise(np.zeros(4), [replace(clean, right=spoilt)])
    robust = minimise(np.zeros(4), [replace(clean, right=spoilt, cauchy_scale=CAUCHY_SCALE)])
    assert np.abs(least_squares.state - truth).max() > 10.0
    assert np.abs(robust.state - truth).max() < 0.02


def test_kernel_weights_are_the_slope_of_the_cost() -> None:
    residuals = np.linspace(0.1, 30.0, 200)
    for scale in (None, 1.7):
        slope = (_costs(residuals + 1e-5, scale) - _costs(residuals - 1e-5, scale)) / 2e-5
        np.testing.assert_allclose(_weights(residuals, scale) * residuals, slope, rtol=1e-7)
    assert _weights(np.array([1.7]), 1.7) == pytest.approx(0.5)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Arctangent:
    """atan(x): undamped Gauss-Newton diverges from beyond 1.39."""

    cauchy_scale: float | None = None

    def residuals(self, state: Array) -> Array:
        return np.arctan(state)

    def jacobian(self, state: Array) -> csr_array[np.float64]:
        return csr_array(np.diag(1 / (1 + state**2)))


def test_cost_falls_where_undamped_gauss_newton_diverges() -> None:
    solution = minimise(np.array([3.0]), [Arctangent()])
    assert solution.state[0] == pytest.approx(0.0, abs=1e-6)
    costs = [
        minimise(np.array([3.0]), [Arctangent()], Stop(most_iterations=n)).cost for n in range(9)
    ]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] < costs[0] == np.arctan(3.0) ** 2 / 2


def test_an_unbounded_direction_is_an_error() -> None:
    half = Linear(matrix=np.array([[1.0, 0.0]]), right=np.array([1.0]))
    with pytest.raises(SingularProblemError):
        minimise(np.zeros(2), [half])
