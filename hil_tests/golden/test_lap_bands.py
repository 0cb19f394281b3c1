"""Three laps of two scenes against the bands that thirty seeds left in fixtures/baselines."""

import pytest

from hil_tests.golden.lap_bands import CASES, Band, run_lap, stored_bands

# What another processor's rounding may add to the worst of the thirty.
ROUNDING = 1.001


# The others are thorough.
MARKS = {("lab", 0): [], ("classroom", 2): [pytest.mark.rare]}
LAPS = [
    pytest.param(
        band,
        seed,
        id=f"{band.scene}-{band.preset}-{seed}",
        marks=MARKS.get((band.scene, seed), [pytest.mark.thorough]),
    )
    for band in stored_bands()
    for seed in range(3)
]


@pytest.mark.slow
@pytest.mark.parametrize(("band", "seed"), LAPS)
def test_a_lap_stays_in_its_band(band: Band, seed: int) -> None:
    run = run_lap(band.scene, band.preset, seed)
    assert 1e3 * run.ate_rmse_m <= ROUNDING * band.ate_most_mm
    assert run.ate_rmse_m < run.odometry_ate_rmse_m
    assert run.landmarks.rmse_m is not None
    assert 1e3 * run.landmarks.rmse_m <= ROUNDING * band.landmark_rmse_most_mm
    assert run.landmarks.recall is not None
    assert run.landmarks.recall >= band.recall_least
    assert run.landmarks.precision is not None
    assert run.landmarks.precision >= band.precision_least
    assert run.landmarks.duplicates <= band.duplicates_most


def test_every_case_has_a_band() -> None:
    assert tuple((band.scene, band.preset) for band in stored_bands()) == CASES
