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
        grids, n_values, instants_per_knot=64, seed=seed, serial=serial, purpose=purpose
    )


def path(noise: SlowNoise, n_instants: int) -> NDArray[np.float64]:
    return noise.values_at(np.arange(n_instants) * (SPACING_NS // PER_KNOT))


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
    for part in np.split(shuffled, [1, 2, 4, 8, 16, 30]):
        values = other.values_at(part * (SPACING_NS // PER_KNOT))
        assert values.tobytes() == in_order[part].tobytes()
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
    """Without an offset the variance would breathe by 4 % alike for all seeds: not stationary."""
    times_ns = np.arange(4) * (SPACING_NS // 4)
    values = np.stack([slow_noise(seed=seed).values_at(times_ns) for seed in range(150)])
    np.testing.assert_allclose((values**2).mean(axis=(0, 2)), 1.0, atol=0.02)  # 4 standard errors


def test_it_is_straight_between_instants() -> None:
    noise = SlowNoise(
        (KnotGrid(spacing_ns=4000, sigma=1.0),),
        16,
        instants_per_knot=4,
        seed=0,
        serial=1,
        purpose=Purpose.CLUTTER,
    )
    bends = np.abs(np.diff(noise.values_at(np.arange(-50_000, 50_000, 100)), 2, axis=0)).max(axis=1)
    # instants are 1000 ns apart: one bend in ten steps, or two where none falls on a step
    assert ((bends > 1e-9).reshape(-1)[: 10 * 99].reshape(99, 10).sum(axis=1) <= 2).all()
    assert (bends > 1e-9).sum() >= 99


def test_a_time_before_zero_exists() -> None:
    """A module whose clock is early samples before scene time 0."""
    values = slow_noise(n_values=4).values_at(np.array([-5_000_000_000, -1, 0]))
    assert np.isfinite(values).all()
    np.testing.assert_allclose(values[1], values[2], atol=1e-6)
