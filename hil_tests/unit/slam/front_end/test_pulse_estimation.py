"""The pulse of a module, planted in frames as a formula, and what the front end makes of them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.config import SlamConfig, override
from slam.frames import Detection, RadarFrame
from slam.front_end.matched_filter import MatchedFilterDetector
from slam.front_end.pulse import PulseModel
from slam.geometry import ReceivedPulse

C = 299_792_458.0
BIN_M = C / (2 * 23.328e9)
N_BINS, START_M = 900, 0.2
CARRIER_RAD = math.tau * 2 * BIN_M * 7.29e9 / C
# the envelope's power spectrum falls to a tenth 0.7 GHz off the carrier
SIGMA_BINS = math.sqrt(math.log(10)) / (math.pi * 1.4e9) * C / 2 / BIN_M
NOISE = 2e-4
REACH = 100  # bins, 12 sigmas
CONFIG = override(SlamConfig(), {"detection.front_end": "joint", "detection.max_range_m": "5"})


@dataclass(frozen=True)
class Shape:
    """A pulse ``width`` times as wide, ``skew`` more behind its peak, and an echo of itself."""

    width: float = 1.0
    skew: float = 0.0
    ringing: float = 0.0

    def envelope(self, x: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the complex envelope at x bins from the peak."""
        late = x - 3.2 * SIGMA_BINS
        turn = np.exp(1j * (1 - CARRIER_RAD * 3.2 * SIGMA_BINS))
        envelope: NDArray[np.complex128] = self._bump(x) + self.ringing * turn * self._bump(late)
        return envelope

    def _bump(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        sigma = SIGMA_BINS * self.width * np.where(x < 0, 1 - self.skew, 1 + self.skew)
        bump: NDArray[np.float64] = np.exp(-0.5 * (x / sigma) ** 2)
        return bump


WIDE = Shape(width=1.1)
BAD = Shape(width=1.15, skew=0.15, ringing=0.15)


def samples(
    shape: Shape, echoes: list[tuple[float, float, float]], noise: NDArray[np.float64] | float = 0.0
) -> NDArray[np.float32]:
    """Return a frame of echoes: position [bins], amplitude, phase."""
    total = np.zeros(N_BINS) + noise
    for position, amplitude, phase in echoes:
        first, last = max(0, int(position) - REACH), min(N_BINS, int(position) + REACH)
        x = np.arange(first, last, dtype=np.float64) - position
        pulse = shape.envelope(x) * np.exp(1j * (CARRIER_RAD * x + phase))
        total[first:last] += amplitude * pulse.real
    return total.astype(np.float32)


def frame(radar: int, counter: int, values: NDArray[np.float32]) -> RadarFrame:
    return RadarFrame(
        radar=radar,
        t_ns=counter * 200_000_000,
        counter=counter,
        samples=values,
        range_start_m=START_M,
        bin_length_m=BIN_M,
    )


def drive(
    shapes: list[Shape], n_frames: int, *, blend: bool = False, seed: int = 1
) -> Iterator[RadarFrame]:
    """Yield frames of radars with these pulses past a strong reflector, weak ones around it.

    ``blend``: every strong echo has another one of half its height or more within three sigmas.
    """
    random = np.random.default_rng(seed)
    for counter in range(n_frames):
        for radar, shape in enumerate(shapes):
            position = 450 + 120 * math.sin(0.05 * counter + radar)
            phases = random.uniform(0, math.tau, 4)
            echoes = [(position, 0.01 * random.uniform(1, 3), phases[0])]
            for phase in phases[1:]:
                where = position + random.uniform(-14, 14) * SIGMA_BINS
                echoes.append((where, 0.002 * random.uniform(0, 1), phase))
            if blend:
                apart = random.uniform(1, 3) * random.choice([-1, 1])
                other = echoes[0][1] * random.uniform(0.5, 1)
                echoes.append((position + apart * SIGMA_BINS, other, random.uniform(0, math.tau)))
            noise = NOISE * random.standard_normal(N_BINS)
            yield frame(radar, counter, samples(shape, echoes, noise))


def trained(
    frames: Iterator[RadarFrame], received: tuple[ReceivedPulse | None, ...] = ()
) -> MatchedFilterDetector:
    detector = MatchedFilterDetector(CONFIG, received)
    for each in frames:
        detector.learn(each)
    return detector


@cache
def bad_pulse() -> ReceivedPulse:
    """Return the pulse that two modules with the same bad one have after 200 frames each."""
    pulse = trained(drive([BAD] * 2, 200)).estimator.pulse(0)
    assert pulse is not None
    return pulse


def error(pulse: ReceivedPulse, shape: Shape) -> float:
    """Return the relative difference from the planted envelope, its delay and scale left free."""
    estimate = np.array(pulse.real) + 1j * np.array(pulse.imaginary)
    at = (np.arange(estimate.size) - estimate.size // 2) * pulse.step_m / BIN_M
    best = math.inf
    for delay in np.linspace(-8, 8, 321):
        truth = shape.envelope(at - delay)
        scale = np.vdot(estimate, truth) / np.vdot(estimate, estimate)
        left = float(np.linalg.norm(truth - scale * estimate) / np.linalg.norm(truth))
        best = min(best, left)
    return best


@pytest.mark.parametrize("shape", [WIDE, BAD])
def test_a_planted_pulse_is_estimated_to_within_its_own_error(shape: Shape) -> None:
    detector = trained(drive([shape] * 2, 200))
    for radar in range(2):
        pulse = detector.estimator.pulse(radar)
        assert pulse is not None
        assert error(pulse, shape) < 0.03
        assert error(pulse, shape) < 2 * pulse.relative_error
        assert pulse.relative_error < 0.05


def strongest(detector: MatchedFilterDetector, values: NDArray[np.float32]) -> Detection:
    return max(detector.detect(frame(0, 0, values)), key=lambda each: each.amplitude)


def test_an_echo_alone_keeps_its_range_and_phase_when_the_pulse_changes() -> None:
    nominal = MatchedFilterDetector(override(CONFIG, {"detection.front_end": "matched_filter"}))
    equalised = MatchedFilterDetector(CONFIG, (bad_pulse(),))
    for position in (300.0, 411.3, 520.75):
        echo = samples(BAD, [(position, 0.02, 0.7)])
        before, after = strongest(nominal, echo), strongest(equalised, echo)
        assert after.range_m == pytest.approx(before.range_m, abs=0.3e-3)
        assert math.remainder(after.phase_rad - before.phase_rad, math.tau) == pytest.approx(
            0, abs=0.05
        )
        assert after.amplitude == pytest.approx(before.amplitude, rel=0.02)


def test_equalised_echoes_have_no_misfit_and_do_not_fall_apart() -> None:
    equalised = MatchedFilterDetector(CONFIG, (bad_pulse(),))
    noise = NOISE * np.random.default_rng(5).standard_normal(N_BINS)
    echoes = [(300.0, 0.02, 0.7), (300.0 + 3.2 * SIGMA_BINS, 0.01, 2.0), (500.0, 0.03, 0.1)]
    echo = frame(0, 0, samples(BAD, echoes, noise))
    found = equalised.detect(echo)
    assert len(found) == 3
    assert max(each.misfit for each in found) < 1.5
    single = strongest(equalised, samples(BAD, echoes[:1]))
    assert found[0].range_m == pytest.approx(single.range_m, abs=1.5e-3)
    apart = found[1].range_m - found[0].range_m
    assert apart == pytest.approx(3.2 * SIGMA_BINS * BIN_M, abs=3e-3)


def test_a_nominal_pulse_stays_and_detections_are_the_same_to_the_last_bit() -> None:
    detector = MatchedFilterDetector(CONFIG)
    found = [detector.detect(each) for each in drive([Shape()] * 2, 150)]
    assert detector.estimator.echoes(0) > 40
    assert [detector.estimator.pulse(radar) for radar in range(2)] == [None, None]
    last = list(drive([Shape()] * 2, 150))[-1]
    assert MatchedFilterDetector(CONFIG).detect(last) == found[-1]


def test_blends_alone_are_no_pulse() -> None:
    detector = trained(drive([Shape()] * 4, 300, blend=True))
    assert [detector.estimator.pulse(radar) for radar in range(4)] == [None] * 4


def test_a_module_that_differs_from_the_others_gets_its_own_pulse() -> None:
    detector = trained(drive([BAD, BAD, BAD, Shape()], 280))
    pulses = [detector.estimator.pulse(radar) for radar in range(4)]
    for pulse, shape in zip(pulses, [BAD, BAD, BAD, Shape()], strict=True):
        assert pulse is not None
        assert error(pulse, shape) < 0.04


def test_the_same_frames_give_the_same_bits() -> None:
    assert trained(drive([BAD] * 2, 200)).estimator.pulse(0) == bad_pulse()


def test_a_given_pulse_is_kept_unless_the_echoes_differ() -> None:
    given = (bad_pulse(),)
    assert trained(drive([BAD], 200, seed=2), given).estimator.pulse(0) is given[0]
    learnt = trained(drive([WIDE], 200, seed=2), given).estimator.pulse(0)
    assert learnt is not None
    assert error(learnt, WIDE) < 0.04


def test_of_a_robot_that_stands_still_one_echo_is_taken() -> None:
    still = next(drive([BAD], 1))
    detector = trained(iter([replace(still, counter=counter) for counter in range(400)]))
    assert detector.estimator.echoes(0) == 1


def test_a_pulse_of_another_step_is_the_same_pulse() -> None:
    step_m = 0.5 * SIGMA_BINS * BIN_M
    envelope = BAD.envelope(np.arange(-18.0, 19.0) * 0.5 * SIGMA_BINS)
    pulse = ReceivedPulse(
        step_m=step_m,
        real=tuple(envelope.real.tolist()),
        imaginary=tuple(envelope.imag.tolist()),
        relative_error=0.02,
    )
    detector = MatchedFilterDetector(CONFIG, (pulse,))
    found = strongest(detector, samples(BAD, [(400.0, 0.02, 0.3)]))
    # the middle of this envelope is where it is planted, so ranges have no bias
    assert found.range_m == pytest.approx(START_M + 400 * BIN_M, abs=0.2e-3)
    assert PulseModel().sigma_bins(BIN_M) == pytest.approx(SIGMA_BINS)
