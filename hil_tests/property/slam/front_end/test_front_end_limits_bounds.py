"""The bounds and the judgement of the experiment `limits`; oracles by numerical differentiation."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import eval_genlaguerre

from slam.app.cli import main
from slam.app.experiments.limit_cells import (
    BIN_LENGTH_M,
    SEPARATORS,
    detection_probability,
    known_pulse,
    pair_covariance,
    ranging,
    resolution,
)
from slam.front_end.matched_filter import _MEDIAN_EFFICIENCY
from slam.front_end.overlapping import SplitTest

Array = NDArray[np.float64]

PULSE = known_pulse(BIN_LENGTH_M)
S, CARRIER = PULSE.envelope_sigma_bins, PULSE.carrier_rad_per_bin
MIDDLE = 60


def echoes(values: Array) -> Array:
    """Return the samples of echoes; positions, amplitudes, phases one after the other."""
    position, amplitude, phase = values.reshape(3, -1, 1)
    x = np.arange(3 * MIDDLE) - position
    pulses = amplitude * np.exp(-0.5 * (x / S) ** 2) * np.cos(CARRIER * x + phase)
    total: Array = pulses.sum(axis=0)
    return total


@settings(max_examples=30)
@given(st.floats(0.5, 4.0), st.floats(0.2, 1.0), st.floats(0.0, math.tau), st.floats(0.0, math.tau))
def test_pair_bound_is_that_of_the_whole_fisher_matrix(
    apart: float, ratio: float, one: float, other: float
) -> None:
    values = np.array([MIDDLE, MIDDLE + apart * S, 1.0, ratio, one, other])
    step = 1e-5
    jacobian = np.stack(
        [
            (echoes(values + bump) - echoes(values - bump)) / (2 * step)
            for bump in step * np.eye(values.size)
        ]
    )
    snr = 30.0
    whole = np.linalg.inv(snr**2 * jacobian @ jacobian.T)[:2, :2]
    turn = other - one - CARRIER * apart * S
    bound = pair_covariance(
        np.array([apart * S]), ratio, np.array([turn]), snr=snr, envelope_sigma=S
    )[0]
    # the closed form takes cosine and sine of the carrier as orthogonal
    assert np.diag(bound) == pytest.approx(np.diag(whole), rel=0.02)


def test_marcum_is_what_a_correlation_with_the_pulse_exceeds() -> None:
    rng = np.random.default_rng(1)
    n, snr, threshold = 20_000, 1.8, 4.5
    cosine, sine = (echoes(np.array([MIDDLE, 1.0, phase])) for phase in (0.0, -math.pi / 2))
    norm = math.sqrt(S * math.sqrt(math.pi) / 2)
    samples = snr * cosine + rng.standard_normal((n, cosine.size))
    height = np.hypot(samples @ cosine, samples @ sine) / norm
    expected = float(detection_probability(np.array(snr), threshold, S))
    assert 0.2 < expected < 0.8
    error = math.sqrt(expected * (1 - expected) / n)
    assert np.mean(height > threshold) == pytest.approx(expected, abs=4 * error)


@pytest.mark.parametrize("method", sorted(SEPARATORS))
def test_every_separator_places_one_echo_and_two_far_apart(method: str) -> None:
    rng = np.random.default_rng(2)
    window = slice(MIDDLE - 35, MIDDLE + 85)
    one = echoes(np.array([MIDDLE + 0.3, 1.0, 2.0]))
    two = one + echoes(np.array([MIDDLE + 0.3 + 6 * S, 0.8, 0.5]))
    windows = np.stack([one[window], two[window]]) + 0.01 * rng.standard_normal((2, 120))
    found = SEPARATORS[method](windows, PULSE, np.full(2, 0.01), SplitTest())
    assert found[0] == pytest.approx([35.3], abs=0.5)
    assert found[1] == pytest.approx([35.3, 35.3 + 6 * S], abs=0.5)


def test_what_counts_as_found_and_as_resolved() -> None:
    true_m = np.array([1.0, 1.0, 1.0, 1.0])
    found = [np.array([1.002]), np.array([0.998, 2.0]), np.array([]), np.array([1.2])]
    seen = ranging(found, true_m)
    assert (seen.found, seen.others_per_frame) == (0.5, 0.5)
    assert seen.bias_mm == pytest.approx(0.0)
    assert seen.std_mm == pytest.approx(2 * math.sqrt(2))

    pairs = np.tile([1.0, 1.1], (4, 1))
    split = [
        np.array([1.01, 1.09]),
        np.array([1.0, 1.13]),
        np.array([1.0]),
        np.array([1.0, 1.1, 1.2]),
    ]
    told_apart = resolution(split, pairs)
    assert (told_apart.resolved, told_apart.two_found) == (0.25, 0.5)
    assert told_apart.rms_mm == pytest.approx(math.sqrt((100 + 100 + 0 + 900) / 4))


def test_the_command_writes_table_picture_and_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["experiment", "limits", "--trials", "2", "--out", str(tmp_path)]) == 0
    numbers = json.loads((tmp_path / "limits.json").read_text())
    assert numbers["command"] == "uwb-slam experiment limits --trials 2 --seed 0"
    assert {len(numbers[name]) > 0 for name in ("ranging", "detection", "resolution")} == {True}
    assert (tmp_path / "limits.png").read_bytes().startswith(b"\x89PNG")
    out, err = capsys.readouterr()
    assert "share of pairs of equal echoes resolved" in out
    assert "6/6 saturation" in err


def test_the_scatter_of_the_estimated_noise_is_that_of_a_median_of_correlated_powers() -> None:
    """Powers of complex noise that correlate by q have joint density sum q**k L_k L_k exp exp.

    So do the indicators of being above the median m = ln 2, with coefficients
    c_k = int_m^inf L_k(p) exp(-p) dp = m exp(-m) L^1_(k-1)(m) / k, and a median varies by the sum
    of their covariances over the squared density there, 1/2.
    """
    spacing = 0.75  # of the cells that are looked at, in envelope sigmas
    median = math.log(2)
    k = np.arange(1, 2001)
    c = median * math.exp(-median) * eval_genlaguerre(k - 1, 1, median) / k
    lags = spacing * np.arange(-30, 31)
    covariances = np.sum(c**2 @ np.exp(-0.5 * np.outer(k, lags**2)))
    covariances += 0.25 - np.sum(c**2)  # higher orders: lag 0 alone
    cells = 4 * covariances / median**2  # relative variance of the estimate, times their number
    mean = math.sqrt(math.tau) / spacing  # the same of a mean of powers
    assert mean / cells == pytest.approx(_MEDIAN_EFFICIENCY, abs=2e-3)
