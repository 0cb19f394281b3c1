"""How a chest moves and what is true of its rate: closed forms, and integrals taken numerically."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.scene.people import (
    STAGES,
    PersonSpec,
    SleepDepth,
    breathing_rate_per_min,
    chest_displacement_m,
    mean_breathing_rate_per_min,
    sleep_stages,
)

SECOND = 1_000_000_000
AMPLITUDE_M = 0.005
WANDERS = {"rate_wander": 0.2}
SLEEPS = {"posture": "supine", "sleep": {"from_s": 120.0, "cycle_min": 10.0}}


def person(**changes: Any) -> PersonSpec:  # noqa: ANN401 - any field
    fixed = {"name": "somebody", "waypoints_m": ((2.0, 0.0),), "breath_amplitude_m": AMPLITUDE_M}
    return PersonSpec.model_validate(fixed | changes)


def every(step_s: float, until_s: float) -> NDArray[np.int64]:
    return np.arange(0, round(until_s * SECOND), round(step_s * SECOND), dtype=np.int64)


def test_a_realistic_breath_is_in_out_and_a_pause() -> None:
    """Ratio 1 : 1.5 and half cosines; 12 breaths a minute take 5 s each."""
    breathes = person(breath_pattern="realistic", breaths_per_min=12.0)
    t_ns = np.array([0, 0.5, 1, 2, 3, 4, 4.5, 5, 7, 3602], dtype=np.float64) * SECOND
    chest_m = chest_displacement_m(breathes, t_ns.astype(np.int64))
    half_in = (1 - math.cos(math.pi / 4)) / 2
    travel = np.array([0, half_in, 0.5, 1, 0.5, 0, 0, 0, 1, 1])
    assert chest_m == pytest.approx(AMPLITUDE_M * (2 * travel - 1), abs=1e-9)
    slope = np.diff(chest_displacement_m(breathes, every(0.01, 5.0)))
    shares = [float(np.mean(slope > 1e-12)), float(np.mean(slope < -1e-12))]
    assert shares == pytest.approx([0.4, 0.4], abs=0.005)


def test_a_realistic_breath_has_harmonics_and_a_sine_has_none() -> None:
    t_ns = every(0.1, 200.0)  # 40 breaths
    second = {}
    for pattern in ("sine", "realistic"):
        chest_m = chest_displacement_m(person(breath_pattern=pattern, breaths_per_min=12.0), t_ns)
        lines = np.abs(np.fft.rfft(chest_m - chest_m.mean()))
        second[pattern] = lines[80] / lines[40]
    assert second["sine"] < 1e-9
    assert 0.1 < second["realistic"] < 0.5


def test_heartbeat_adds_a_sine() -> None:
    t_ns = every(0.05, 20.0)
    beats = {"heart_amplitude_m": 0.0004, "heartbeats_per_min": 66.0}
    added_m = chest_displacement_m(person(**beats), t_ns) - chest_displacement_m(person(), t_ns)
    assert added_m == pytest.approx(0.0004 * np.sin(math.tau * 1.1 * t_ns / SECOND), abs=1e-12)


@pytest.mark.parametrize("changes", [{}, WANDERS, SLEEPS, WANDERS | SLEEPS], ids=str)
@pytest.mark.parametrize("seed", [0, 7])
def test_the_mean_rate_is_the_integral_of_the_rate(changes: dict[str, Any], seed: int) -> None:
    """The trapezoidal rule over windows of 60 s; stages change within some of them."""
    breathes = person(**changes)
    step_s, window = 0.25, 240
    t_ns = every(step_s, 2400.0)
    rate = breathing_rate_per_min(breathes, t_ns, seed)
    total = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2)])
    by_integral = (total[window:] - total[:-window]) / window
    mean = mean_breathing_rate_per_min(breathes, t_ns[window:], window * step_s, seed)
    assert mean == pytest.approx(by_integral, abs=0.01)


@pytest.mark.parametrize("changes", [WANDERS, WANDERS | SLEEPS], ids=str)
def test_the_chest_breathes_at_the_mean_rate(changes: dict[str, Any]) -> None:
    """Upward zero crossings, interpolated, of a sine: from the first to the last of an hour."""
    breathes = person(**changes)
    t_ns = every(0.05, 3600.0)
    chest_m = chest_displacement_m(breathes, t_ns, 3)
    rises = np.flatnonzero((chest_m[:-1] < 0) & (chest_m[1:] >= 0))
    at_s = 0.05 * (rises + chest_m[rises] / (chest_m[rises] - chest_m[rises + 1]))
    counted = 60 * (len(rises) - 1) / (at_s[-1] - at_s[0])
    end_ns = np.array([round(at_s[-1] * SECOND)])
    (mean,) = mean_breathing_rate_per_min(breathes, end_ns, float(at_s[-1] - at_s[0]), 3)
    assert mean == pytest.approx(counted, abs=1e-3)


def test_an_irregular_rate_stays_in_its_band_and_uses_it() -> None:
    rate = breathing_rate_per_min(person(rate_wander=0.2), every(1.0, 36_000.0))
    assert 12.0 <= rate.min() < 12.6
    assert 17.4 < rate.max() <= 18.0
    assert rate.mean() == pytest.approx(15.0, abs=0.02)
    other = breathing_rate_per_min(person(rate_wander=0.2), every(1.0, 36_000.0), 1)
    assert np.abs(other - rate).max() > 1


def test_apnoea_comes_once_a_stretch_and_lasts() -> None:
    """20 s in every 100 s, 200 times; the chest rests in then, and moves without a jump."""
    stops = person(apnoea={"every_s": 100.0, "lasts_s": 20.0})
    t_ns = every(0.1, 20_000.0)
    rate = breathing_rate_per_min(stops, t_ns, 5)
    nobody = np.isnan(rate).reshape(200, 1000)
    assert set(nobody.sum(axis=1).tolist()) <= {199, 200, 201}
    assert set(rate[~nobody.ravel()].tolist()) == {15.0}
    begins_s = nobody.argmax(axis=1) / 10
    assert begins_s.mean() == pytest.approx(40.0, abs=4 * 80 / math.sqrt(12 * 200))
    chest_m = chest_displacement_m(stops, t_ns, 5)
    ramp = 16
    for row, chest in zip(nobody, chest_m.reshape(200, 1000), strict=True):
        rest = np.flatnonzero(row)[ramp:-ramp]
        assert chest[rest] == pytest.approx(-AMPLITUDE_M, abs=1e-12)
    fastest_m = AMPLITUDE_M * (math.tau / 4 + 2 * 1.5 / 1.5) * 0.1  # of breath and of the ramp
    assert np.abs(np.diff(chest_m)).max() < fastest_m
    undisturbed = chest_displacement_m(person(), t_ns)
    assert chest_m[~nobody.ravel()] == pytest.approx(undisturbed[~nobody.ravel()], abs=1e-12)


def test_a_window_with_apnoea_or_absence_has_no_mean_rate() -> None:
    stops = person(apnoea={"every_s": 300.0, "lasts_s": 20.0}, enters_s=100.0, leaves_s=2000.0)
    t_ns = every(1.0, 2400.0)
    now = np.isnan(breathing_rate_per_min(stops, t_ns))
    mean = np.isnan(mean_breathing_rate_per_min(stops, t_ns, 60.0))
    touched = np.convolve(now, np.ones(61), mode="full")[: len(now)] > 0
    touched[:60] = True  # begins before scene time 0, when nobody was there
    assert (mean == touched).mean() > 0.99  # but for the ends of windows between two seconds
    assert now[:100].all()
    assert now[2000:].all()
    assert not now[150:200].all()


def test_nobody_breathes_at_zero_breaths() -> None:
    assert np.isnan(breathing_rate_per_min(person(breaths_per_min=0.0), every(1.0, 5.0))).all()


def test_stages_follow_each_other_in_cycles() -> None:
    """Shares of cycles of 10 min, after 2 min awake."""
    sleeper = person(**SLEEPS)
    t_ns = every(1.0, 120.0 + 5 * 600.0)
    stages = sleep_stages(sleeper, t_ns)
    assert set(stages[:120].tolist()) == {SleepDepth.AWAKE}
    cycles = stages[120:].reshape(5, 600)
    assert (cycles == cycles[0]).all()
    for stage in (SleepDepth.LIGHT, SleepDepth.DEEP, SleepDepth.REM):
        share = sum(row[1] for row in STAGES if row[0] is stage)
        assert np.mean(cycles == stage) == pytest.approx(share, abs=2 / 600)
    assert sum(row[1] for row in STAGES) == pytest.approx(1.0)
    assert set(sleep_stages(person(), t_ns).tolist()) == {SleepDepth.AWAKE}


def test_deep_sleep_is_slower_and_more_regular() -> None:
    t_ns = every(1.0, 36_000.0)
    sleeper = person(**WANDERS, **SLEEPS)
    rate, stages = breathing_rate_per_min(sleeper, t_ns), sleep_stages(sleeper, t_ns)
    spread = {stage: float(rate[stages == stage].std()) for stage in SleepDepth}
    mean = {stage: float(rate[stages == stage].mean()) for stage in SleepDepth}
    assert spread[SleepDepth.DEEP] < 0.3 * spread[SleepDepth.REM]
    assert mean[SleepDepth.DEEP] < mean[SleepDepth.LIGHT] < mean[SleepDepth.REM]


@pytest.mark.parametrize("changes", [WANDERS | SLEEPS, {"apnoea": {"every_s": 30.0}}], ids=str)
def test_a_time_has_one_answer(changes: dict[str, Any]) -> None:
    """Whatever else is asked with it, before it or after it."""
    breathes = person(**changes)
    t_ns = every(7.3, 5000.0)
    together = chest_displacement_m(breathes, t_ns, 11)
    alone = [chest_displacement_m(breathes, t_ns[n : n + 1], 11)[0] for n in range(len(t_ns))]
    assert together.tolist() == alone
    rates = breathing_rate_per_min(breathes, t_ns, 11)
    backwards = [
        breathing_rate_per_min(breathes, t_ns[n : n + 1], 11)[0] for n in range(680, 0, -17)
    ]
    assert np.array(backwards).tobytes() == rates[680:0:-17].tobytes()
