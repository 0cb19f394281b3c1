"""What an innovation far from its prediction counts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.robust.back_end import huber_weighted_sigmas_m
from slam.robust.ranges import RangeScan

positive = st.floats(1e-4, 1e-1)


@given(prior=positive, sigma=positive, sigmas_off=st.floats(0.0, 2.0))
def test_near_its_prediction_a_range_counts_in_full(
    prior: float, sigma: float, sigmas_off: float
) -> None:
    nu = np.array([sigmas_off * np.sqrt(prior**2 + sigma**2)]) * (1 - 1e-9)
    weighed = huber_weighted_sigmas_m(nu, np.array([prior**2]), np.array([sigma]), 2.0)
    np.testing.assert_array_equal(weighed, [sigma])


@given(prior=positive, sigma=positive, sigmas_off=st.floats(2.0, 1e3))
def test_far_from_it_a_range_moves_the_state_no_further_than_at_the_bound(
    prior: float, sigma: float, sigmas_off: float
) -> None:
    """Closed form: a scalar state of variance p moves by nu p / S', which is 2 p / sqrt(S)."""
    S = prior**2 + sigma**2
    nu = sigmas_off * np.sqrt(S)
    weighed = huber_weighted_sigmas_m(np.array([nu]), np.array([prior**2]), np.array([sigma]), 2.0)
    moved = nu * prior**2 / (prior**2 + float(weighed[0]) ** 2)
    assert moved == pytest.approx(2.0 * prior**2 / np.sqrt(S), rel=1e-9)


def test_without_a_bound_every_range_counts_in_full() -> None:
    weighed = huber_weighted_sigmas_m(np.array([5.0]), np.array([0.0]), np.array([1e-3]), np.inf)
    np.testing.assert_array_equal(weighed, [1e-3])


def test_a_doubt_is_added_to_what_the_front_end_tells_and_to_nothing_else() -> None:
    told = RangeScan(radar=0, ranges_m=(1.0, 2.0), sigmas_m=(3e-3, 4e-3))
    assert told.with_added_sigma(4e-3).sigmas_m == pytest.approx((5e-3, np.sqrt(32) * 1e-3))
    assert told.with_added_sigma(0.0) is told
    untold = RangeScan(radar=0, ranges_m=(1.0,))
    assert untold.with_added_sigma(4e-3) is untold
