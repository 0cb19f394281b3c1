"""Slow noise is the stationary process its page describes, from any side it is asked."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from emulator.echo.receiver import SPACINGS_PER_E_FOLD, KnotGrid, SlowNoise
from emulator.scene.philox import Purpose

SPACING_NS = 1_000_000_000
PER_KNOT = 4


def slow_noise(
    *,
    seed: int = 0,
    serial: int = 202305070101,
    purpose: Purpose = Purpose.CLUTTER,
    grids: tuple[KnotGrid, ...] = (KnotGrid(spacing_ns=SPACING_NS, sigma=1.0),),
    n_values: int = 512,
) -> SlowNoise:
    return SlowNoise(
        grids, n_values, instants_per_knot=PER_KNOT, seed=seed, serial=serial, purpose=purpose
    )


def path(noise: SlowNoise, n_instants: int) -> NDArray[np.float64]:
    return noise.values_at(np.arange(n_instants))


def spline_of_degree_7(lag: float) -> float:
    """Return B7(lag) / B7(0): SciPy's spline, not ours."""
    spline = BSpline.basis_element(np.arange(-4.0, 5.0), extrapolate=False)
    return float(np.nan_to_num(spline(lag)) / spline(0.0))


def test_variance_and_autocorrelation_are_those_of_the_spline_of_degree_7() -> None:
    values = path(slow_noise(), 400)
    variance = float((values**2).mean())
    assert variance == pytest.approx(1.0, abs=0.02)  # 4 standard errors
    for lag in (1, 2, 4, 6, 8, 12, 16, 24):
        product = float((values[:-lag] * values[lag:]).mean())
        assert product / variance == pytest.approx(spline_of_degree_7(lag / PER_KNOT), abs=0.02)
    assert spline_of_degree_7(SPACINGS_PER_E_FOLD) == pytest.approx(np.exp(-1), abs=1e-3)


def test_members_add_their_variances() -> None:
    grids = tuple(
        KnotGrid(spacing_ns=SPACING_NS * times, sigma=sigma)
        for times, sigma in ((1, 3.0), (3, 4.0))
    )
    values = path(slow_noise(grids=grids), 600)
    assert float((values**2).mean()) == pytest.approx(25.0, rel=0.03)
    far_apart = float((values[:-20] * values[20:]).mean())  # five spacings: the fast one is gone
    assert far_apart == pytest.approx(16.0 * spline_of_degree_7(5 / 3), abs=0.6)


def test_a_value_does_not_depend_on_what_was_asked_before() -> None:
    in_order = path(slow_noise(n_values=8), 60)
    other = slow_noise(n_values=8)
    shuffled = np.random.default_rng(3).permutation(60)
    for instants in np.split(shuffled, [1, 2, 4, 8, 16, 30]):
        assert other.values_at(instants).tobytes() == in_order[instants].tobytes()
    assert other.values_at(shuffled[:0]).shape == (0, 8)


@pytest.mark.parametrize(
    "other",
    [{"seed": 1}, {"serial": 202305070102}, {"purpose": Purpose.JITTER_SLOW}],
    ids=["seed", "serial", "purpose"],
)
def test_other_keys_give_independent_noise(other: dict[str, int]) -> None:
    one, two = path(slow_noise(), 100), path(slow_noise(**other), 100)  # type: ignore[arg-type]  # purpose is an IntEnum
    assert abs(float((one * two).mean())) < 0.03


def test_grids_of_different_seeds_have_different_offsets() -> None:
    """Without an offset the variance would breathe alike for all seeds: stationary for none."""
    zero = np.array([0])
    fractions = np.concatenate(
        [slow_noise(seed=seed, n_values=1).instants_before(zero)[1] for seed in range(200)]
    )
    counts, _ = np.histogram(fractions, bins=5, range=(0, 1))
    assert counts.min() > 20


def test_an_instant_before_time_zero_exists() -> None:
    """A module whose clock is early samples before scene time 0."""
    noise = slow_noise(n_values=4)
    instants, fractions = noise.instants_before(np.array([-5_000_000_000, -1, 0]))
    assert ((fractions >= 0) & (fractions < 1)).all()
    assert np.isfinite(noise.values_at(instants)).all()
    assert instants[0] < 0
