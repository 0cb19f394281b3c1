"""The belief about radii has the moments of the prior's two kinds of things, by quadrature."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import simpson

from slam.robust.parameters import RadiusRule
from slam.robust.solver.radii import RadiusPrior

Array = NDArray[np.float64]

RULE = RadiusRule()


def moments(mean_m: float, sigma_m: float) -> tuple[float, float]:
    """Return the mean of the likelier kind, and the root of the second moment about it.

    All else says that the radius is ``mean_m`` with the standard deviation ``sigma_m``.
    """

    def other(rho: Array) -> Array:
        return np.exp(-(((rho - mean_m) / sigma_m) ** 2 - least) / 2.0)

    def normal(rho: Array, scale_m: float) -> Array:
        return np.exp(-((rho / scale_m) ** 2) / 2.0) / (math.sqrt(math.tau) * scale_m)

    def thin(rho: Array) -> Array:
        return RULE.thin_share * normal(rho, RULE.thin_m) * other(rho)

    def thick(rho: Array) -> Array:
        return (1.0 - RULE.thin_share) * 2.0 * normal(rho, RULE.thick_m) * other(rho)

    least = (min(mean_m, 0.0) / sigma_m) ** 2  # keeps the densities from vanishing
    ends = (mean_m - 9.0 * sigma_m, mean_m + 9.0 * sigma_m)
    spans: dict[Callable[[Array], Array], tuple[float, float]] = {
        thin: (max(ends[0], -9.0 * RULE.thin_m), min(ends[1], 9.0 * RULE.thin_m)),
        thick: (max(ends[0], 0.0), min(ends[1], 9.0 * RULE.thick_m)),
    }

    def total(density: Callable[[Array], Array], power: int, about: float = 0.0) -> float:
        low, high = spans[density]
        if high <= low:
            return 0.0
        rho = np.linspace(low, high, 20_001)
        return float(simpson(density(rho) * (rho - about) ** power, x=rho))

    masses = {density: total(density, 0) for density in spans}
    assume(abs(masses[thin] - masses[thick]) > 1e-3 * sum(masses.values()))
    likelier = max(masses, key=lambda density: masses[density])
    middle = total(likelier, 1) / masses[likelier]
    second = sum(total(density, 2, middle) for density in spans) / sum(masses.values())
    return middle, math.sqrt(second)


@given(mean_m=st.floats(0.0, 0.25), sigma_m=st.floats(1e-3, 3.0))
def test_two_rounds_give_the_moments_whatever_the_first_one_gave(
    mean_m: float, sigma_m: float
) -> None:
    prior = RadiusPrior(np.zeros(1), np.full(1, math.inf), RULE)
    prior.begin_belief()
    for _ in range(2):
        mean, variance = believed(prior, mean_m, sigma_m)
        prior.improve(mean, variance)
    middle, deviation = moments(mean_m, sigma_m)
    mean, variance = believed(prior, mean_m, sigma_m)
    assert mean[0] == pytest.approx(middle, rel=1e-3, abs=1e-6)
    # A site is never vaguer than the prior of thick things.
    limited = 1.0 / math.sqrt(sigma_m**-2.0 + RULE.thick_m**-2.0)
    assert math.sqrt(variance[0]) == pytest.approx(min(deviation, limited), rel=1e-3)


def believed(prior: RadiusPrior, mean_m: float, sigma_m: float) -> tuple[Array, Array]:
    """Return mean and variance of the product of a site and what all else says."""
    away, sigmas = prior.away(np.zeros(1))
    variance = 1.0 / (sigmas**-2.0 + sigma_m**-2.0)
    return variance * (-away / sigmas**2 + mean_m / sigma_m**2), variance


def test_what_is_surely_thin_or_thick_is_believed_so() -> None:
    """By closed forms: the product of two normal densities of either scale."""
    prior = RadiusPrior(np.zeros(2), np.full(2, math.inf), RULE)
    means_m, sigmas_m = np.array([5e-4, 0.1]), np.array([1e-3, 2e-3])
    prior.begin_belief()
    for _ in range(2):
        away, of_sites = prior.away(np.zeros(2))
        variances = 1.0 / (of_sites**-2.0 + sigmas_m**-2.0)
        prior.improve(variances * (means_m / sigmas_m**2 - away / of_sites**2), variances)
    away, of_sites = prior.away(np.zeros(2))
    variances = 1.0 / (of_sites**-2.0 + sigmas_m**-2.0)
    means = variances * (means_m / sigmas_m**2 - away / of_sites**2)
    for k, scale_m in ((0, RULE.thin_m), (1, RULE.thick_m)):
        variance = 1.0 / (scale_m**-2.0 + sigmas_m[k] ** -2.0)
        assert variances[k] == pytest.approx(variance, rel=0.02)
        assert means[k] == pytest.approx(variance * means_m[k] / sigmas_m[k] ** 2, rel=0.02)


@given(st.lists(st.floats(-0.1, 1.0), min_size=1, max_size=4))
def test_in_a_search_the_cost_is_that_of_its_density_and_touched_by_a_quadratic(
    radii: list[float],
) -> None:
    """From tau on 2 ln(tau + rho), whose derivative is that of the quadratic."""
    radii_m = np.array(radii)
    prior = RadiusPrior(np.zeros(len(radii)), np.full(len(radii), math.inf), RULE)
    away, sigmas = prior.away(radii_m)
    tau, step = RULE.thin_m, 1e-9
    rising = [prior.cost(radii_m + step * unit) for unit in np.eye(len(radii))]
    falling = [prior.cost(radii_m - step * unit) for unit in np.eye(len(radii))]
    slope = (np.array(rising) - np.array(falling)) / (2.0 * step)
    assert slope == pytest.approx(2.0 * away / sigmas**2, rel=1e-3, abs=1e-2)
    far = np.array([0.05, 0.2])
    costs = [RadiusPrior(np.zeros(1), np.full(1, math.inf), RULE).cost(far[[k]]) for k in (0, 1)]
    assert costs[1] - costs[0] == pytest.approx(2.0 * math.log((tau + 0.2) / (tau + 0.05)))
