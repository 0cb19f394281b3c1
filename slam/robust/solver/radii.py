"""What is believed of the radii of landmarks: most things are thin, and others of any size.

The likeliest radii are looked for with a prior 1 / (tau + rho), or a power of that. It takes most
of them for thin, and of those that are not every size for likely.

Ranges may hardly tell a thin thing from a thick one. The belief has two modes then, and a search
ends in one of them: a pillar is thin to a millimetre, and the wheels are what errs. So the belief
has another prior, a mixture: normal about zero with a small scale for a share of all things, and
half-normal with a large scale for the others. Expectation propagation replaces the prior of each
radius by a normal density, its site, such that the belief has the moments that it has with the
prior itself. They are taken about the likelier mode, not about the mean, which is of neither kind
of things: what is thin stays where it is, and is less sure.

Source: Minka, Expectation propagation for approximate Bayesian inference, UAI 2001.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, log_ndtr

from slam.robust.initialisation import is_thick
from slam.robust.parameters import RadiusRule
from slam.robust.state import Array

_LEAST_SHARE = 1e-4  # of a variance: what is left of it at least behind a limit
_TINY = 1e-300  # keeps the information of a thick thing's prior from vanishing


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sites:
    """Normal densities in place of the priors of radii: means and deviations [m], shape (k,)."""

    means_m: Array
    sigmas_m: Array

    @classmethod
    def prior(cls, n: int, rule: RadiusRule) -> _Sites:
        """Return those of ``n`` radii of which nothing is known."""
        sigma_m = math.sqrt(1.0 - rule.thin_share) * rule.thick_m
        return cls(means_m=np.zeros(n), sigmas_m=np.full(n, sigma_m))

    def improved(self, radii_m: Array, variances_m2: Array, rule: RadiusRule) -> _Sites:
        """Return the sites with which the belief has the moments that it has with the prior.

        ``radii_m`` and ``variances_m2`` (k,) are what is believed with these sites.
        """
        least = rule.thick_m**-2.0
        # What all else says of each radius
        precisions = np.maximum(1.0 / variances_m2 - self.sigmas_m**-2.0, _LEAST_SHARE * least)
        means = (radii_m / variances_m2 - self.means_m * self.sigmas_m**-2.0) / precisions
        log_thin, thin_means, thin_variances = _product(means, precisions, rule.thin_m)
        log_both, normal_means, normal_variances = _product(means, precisions, rule.thick_m)
        log_mass, thick_means, thick_variances = _above_zero(normal_means, normal_variances)
        log_odds = math.log(rule.thin_share / (1.0 - rule.thin_share))
        share = expit(log_odds + log_thin - (math.log(2.0) + log_both + log_mass))
        middles = np.where(share > 0.5, thin_means, thick_means)
        second = share * (thin_variances + (thin_means - middles) ** 2)
        second += (1.0 - share) * (thick_variances + (thick_means - middles) ** 2)
        of_sites = np.maximum(1.0 / second - precisions, least)
        site_means = (middles * (precisions + of_sites) - precisions * means) / of_sites
        return _Sites(means_m=site_means, sigmas_m=of_sites**-0.5)


def _product(means: Array, precisions: Array, scale_m: float) -> tuple[Array, Array, Array]:
    """Return log evidence, mean and variance of normal densities times one about zero, (k,)."""
    both = 1.0 / precisions + scale_m**2
    variances = 1.0 / (precisions + scale_m**-2.0)
    log_evidence = -(means**2 / both + np.log(math.tau * both)) / 2.0
    return log_evidence, variances * precisions * means, variances


class RadiusPrior:
    """The prior of some radii, (k,): the one to search with, then the sites of the belief.

    ``shown_m`` and ``shown_sigmas_m`` (k,) are what wavefronts show of each, infinite where they
    show nothing. What they show to be thick has no other prior in a search.
    """

    def __init__(self, shown_m: Array, shown_sigmas_m: Array, rule: RadiusRule) -> None:
        self._rule = rule
        self._prices = np.where(is_thick(shown_m, shown_sigmas_m), _TINY, 1.0)
        self._sites: _Sites | None = None

    def begin_belief(self) -> None:
        """Take the sites of radii of which nothing is known."""
        self._sites = _Sites.prior(len(self._prices), self._rule)

    def improve(self, radii_m: Array, variances_m2: Array) -> None:
        """Take better sites, given radii [m] and variances [m^2] that are believed, (k,) each."""
        if self._sites is not None:
            self._sites = self._sites.improved(radii_m, variances_m2, self._rule)

    def away(self, radii_m: Array) -> tuple[Array, Array]:
        """Return how far radii are from the mean, and the standard deviations of that, (k,) each.

        Those of a search are of the quadratic that touches its prior, as Huber's weights are.
        """
        if self._sites is not None:
            return radii_m - self._sites.means_m, self._sites.sigmas_m
        tau = self._rule.thin_m
        least = np.maximum(radii_m, tau)
        rounded = np.sqrt(least * (tau + least) / self._prices)
        return radii_m, np.where(radii_m < 0.0, tau, rounded)

    def cost(self, radii_m: Array) -> float:
        """Return what radii [m], (k,), cost: twice the negative logarithm of their prior.

        In a search that is 2 ln(tau + rho), and quadratic where rho is less than tau.
        """
        if self._sites is not None:
            away, sigmas = self.away(radii_m)
            return float(np.sum((away / sigmas) ** 2))
        tau = self._rule.thin_m
        thin, below = np.clip(radii_m, 0.0, tau), np.minimum(radii_m, 0.0)
        costs = self._prices * thin**2 / (2.0 * tau * tau)
        costs += self._prices * 2.0 * np.log((tau + np.maximum(radii_m, tau)) / (2.0 * tau))
        return float(np.sum(costs) + np.sum((below / tau) ** 2))


def _above_zero(means: Array, variances: Array) -> tuple[Array, Array, Array]:
    """Return log mass, mean and variance of normal densities above zero, shape (k,) each."""
    sigmas = np.sqrt(variances)
    at = -means / sigmas
    log_mass = log_ndtr(-at)
    hazard = np.exp(-(at**2 + math.log(math.tau)) / 2.0 - log_mass)
    share = np.maximum(1.0 + at * hazard - hazard**2, _LEAST_SHARE)
    return log_mass, means + sigmas * hazard, variances * share
