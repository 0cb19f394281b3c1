"""How much a measurement counts that lies far from its prediction."""

from __future__ import annotations

import numpy as np

from slam.robust.symmetric import Array


def huber_weighted_sigmas_m(
    innovations_m: Array, prior_variances: Array, sigmas_m: Array, bound: float
) -> Array:
    """Return standard deviations of ranges, those of large innovations enlarged.

    With S = prior variance + sigma^2, an innovation of ``k`` standard deviations, k > bound, is
    given the variance S k / bound, so that its information falls by Huber's weight, bound / k, and
    what it moves grows no further. All shapes are (m,), with ``prior_variances`` [m^2] those of the
    predictions. Source: Huber, Annals of Mathematical Statistics 35(1), 1964.

    >>> huber_weighted_sigmas_m(np.array([1.0, 4.0]), np.zeros(2), np.ones(2), 2.0) ** 2
    array([1., 2.])
    """
    S = prior_variances + np.square(sigmas_m)
    excess = np.abs(innovations_m) / (bound * np.sqrt(S))
    return np.where(excess > 1.0, np.sqrt(np.maximum(S * excess - prior_variances, 0.0)), sigmas_m)
