"""CFAR finds as many bins of noise as it says, and an echo that stands out."""

import numpy as np
import pytest

from xethru_protocol.processing.detection import cfar, range_profile


@pytest.mark.parametrize(("rate", "training"), [(1e-2, 8), (1e-3, 8), (5e-2, 1)])
def test_share_of_false_alarms_in_exponential_noise(rate: float, training: int) -> None:
    """The bins at the ends, which have fewer training bins, included."""
    rng = np.random.default_rng(11)
    noise = rng.normal(size=(2000, 2, 150))
    frames = noise[:, 0] + 1j * noise[:, 1]
    found = np.concatenate(
        [
            cfar(np.abs(frame), false_alarm_rate=rate, training_bins=training).bins
            for frame in frames
        ]
    )
    count = frames.size
    # neighbouring decisions share training bins: wider than binomial
    deviation = np.sqrt(count * rate * (1 - rate))
    assert abs(len(found) - count * rate) < 5 * deviation
    at_the_ends = np.isin(found, (0, 1, 148, 149)).sum()
    assert at_the_ends == pytest.approx(4 * 2000 * rate, abs=5 * np.sqrt(8000 * rate))


def test_threshold_is_the_formula() -> None:
    """Richards 6.5: alpha = N (P**(-1/N) - 1) times the mean power of N training bins."""
    amplitude = np.arange(1.0, 22.0)
    found = cfar(amplitude, false_alarm_rate=1e-3, training_bins=3, guard_bins=1)
    training = amplitude[[6, 7, 8, 12, 13, 14]] ** 2
    assert found.threshold[10] ** 2 == pytest.approx(6 * (1e-3 ** (-1 / 6) - 1) * training.mean())
    first = amplitude[[2, 3, 4]] ** 2
    assert found.threshold[0] ** 2 == pytest.approx(3 * (1e-3 ** (-1 / 3) - 1) * first.mean())


def test_an_echo_is_found_and_its_neighbours_are_not() -> None:
    rng = np.random.default_rng(2)
    profile = np.abs(rng.normal(size=90) + 1j * rng.normal(size=90))
    profile[40] = 60.0
    assert cfar(profile, false_alarm_rate=1e-4).bins.tolist() == [40]


def test_profile_is_the_root_of_the_mean_power() -> None:
    frames = np.array([[3 + 4j, 0], [0, 1]])
    np.testing.assert_allclose(range_profile(frames), [np.sqrt(12.5), np.sqrt(0.5)])
    np.testing.assert_allclose(range_profile(frames[0]), [5, 0])


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"false_alarm_rate": 0.0}, "false_alarm_rate 0"),
        ({"training_bins": 0}, "0 training_bins"),
        ({"guard_bins": 10}, r"a profile of shape \(20,\).* at least 22"),
    ],
)
def test_what_makes_no_threshold_raises(wrong: dict[str, float], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        cfar(np.ones(20), **wrong)  # type: ignore[arg-type]  # wrong on purpose


def test_the_shortest_profile_has_a_training_bin_for_each_bin() -> None:
    assert np.isfinite(cfar(np.ones(20), guard_bins=9).threshold).all()
