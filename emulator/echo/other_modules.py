"""Pulses of other modules, which are not synchronised with the radar that receives them.

Both modules repeat their pulses with their own clocks, so those of the other one arrive a little
earlier or later after each of the radar's own: they drift through the frame and come in again at
its other end. A frame is a mean over its sweep, during which they drift from u_0 to u_1 samples::

    x[n] = a / (u_1 - u_0) integral_u_0^u_1 p(n - u) du = a (H(n - u_1) - H(n - u_0)) / (u_1 - u_0)

    H(x) = integral_x^inf exp(-s**2 / (2 sigma**2)) cos(k s + phase) ds
         = sigma sqrt(pi / 2) exp(-x**2 / (2 sigma**2))
           Re(exp(j (k x + phase)) w(j x / (sqrt(2) sigma) + k sigma / sqrt(2))),    x >= 0

with w(z) = exp(-z**2) erfc(-j z), the Faddeeva function (DLMF 7.2.3, 7.7), and k the carrier in
radians per sample. For x < 0 it is minus the same with the argument of w negated, since the whole
integral, in proportion to exp(-(k sigma)**2 / 2) < 1e-54, is nothing. So the mean leaves two weak
pulses, at both ends of the drift, about 1 / (k (u_1 - u_0)) as strong as the pulse.

Where the drift begins at scene time 0 is fixed by the module's name. Source: the X4 adds up the
pulses of a sweep whatever arrives (protocol reference 9.6 and 9.7); what one antenna receives of
another is Friis, Proc. IRE 34 (1946) 254. Assumed: the sweep adds linearly, and pulses are sent
without a code of phases. Walls and what other modules do to the noise are left out.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import wofz

from emulator.chip.chip import CaptureSettings
from emulator.echo.paths import (
    NEAREST_M,
    Viewpoint,
    beam_gain,
    reflection_phase_rad,
)
from emulator.echo.pulse import CARRIER_CYCLES_PER_SAMPLE, HALF_WINDOW, SIGMA_S, sum_of_pulses
from emulator.echo.receiver import highest_rate_hz
from emulator.scene.scene import OtherModuleSpec, RadarSpec
from xethru_protocol.wire.x4 import (
    FRAME_SAMPLES,
    MODULE_SPEED_MPS,
    SAMPLING_RATE_HZ,
    SPEED_OF_LIGHT_MPS,
    SWEEP_SHARE,
)

_SIGMA_SAMPLES = SIGMA_S * SAMPLING_RATE_HZ
_SHORT_DRIFT = 1.0
# Gauss and Legendre's: for a drift of a sample the mean of either carrier is off by 2e-9 at most
_NODES, _WEIGHTS = (each / 2 for each in np.polynomial.legendre.leggauss(5))


class OtherModules:
    """What one radar receives from the other modules of a scene."""

    def __init__(self, modules: tuple[OtherModuleSpec, ...], radar: RadarSpec) -> None:
        self._modules = modules
        self._radar = radar

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return bool(self._modules)

    def add_to(
        self,
        signal: NDArray[np.float64],
        view: Viewpoint,
        times_ns: NDArray[np.int64],
        capture: CaptureSettings,
        gain: float,
    ) -> None:
        """Add their pulses in place to frames of shape (n_frames, capture.n_samples).

        Parameters
        ----------
        view
            Where the radar is in each frame.
        times_ns
            Shape (n_frames,), int64: scene time of each frame by a true clock [ns].
        gain
            Factor of the radar's receiver on amplitudes.
        """
        sweep_s = SWEEP_SHARE / highest_rate_hz(capture)
        rate_hz = SAMPLING_RATE_HZ * self._radar.clock.rate
        first = capture.first_sample_m * (2 * SAMPLING_RATE_HZ / MODULE_SPEED_MPS)
        for module in self._modules:
            distance_m, cosine = view.towards(np.array([module.x_m]), np.array([module.y_m]))
            distance_m, cosine = np.maximum(distance_m[:, 0], NEAREST_M), cosine[:, 0]
            amplitude = gain * module.amplitude_1m / distance_m * np.sqrt(beam_gain(cosine))
            drift_hz = (self._radar.clock_ppm - module.clock_ppm) * 1e-6 * rate_hz
            begin = reflection_phase_rad(f"{module.name}: repetition") / math.tau * FRAME_SAMPLES
            arrival = begin + distance_m / SPEED_OF_LIGHT_MPS * rate_hz + drift_hz * 1e-9 * times_ns
            signal += mean_of_drifting_pulses(
                position=np.mod(arrival, FRAME_SAMPLES) - first,
                drift=drift_hz * sweep_s,
                amplitude=amplitude,
                phase_rad=reflection_phase_rad(module.name),
                tx_center_frequency=capture.tx_center_frequency,
                n_samples=capture.n_samples,
            )


def mean_of_drifting_pulses(
    *,
    position: NDArray[np.float64],
    drift: float,
    amplitude: NDArray[np.float64],
    phase_rad: float,
    tx_center_frequency: int,
    n_samples: int,
) -> NDArray[np.float64]:
    """Return means of pulses that repeat every `FRAME_SAMPLES` and drift, (n_frames, n_samples).

    Parameters
    ----------
    position
        Shape (n_frames,): where one of the pulses is centred when a sweep begins, in samples.
    drift
        How many samples it moves during a sweep.
    amplitude
        Shape (n_frames,): of a pulse that does not drift.
    phase_rad
        Phase of the carrier at a pulse's centre.
    """
    frames = np.arange(len(position))
    if abs(drift) < _SHORT_DRIFT:
        ends, weights = position[:, np.newaxis] + drift * (0.5 + _NODES), _WEIGHTS
    else:
        ends = position[:, np.newaxis] + np.array([0.0, drift])
        weights = np.array([-1.0, 1.0]) / drift
    # each within one repetition before the frame's end, and those before and after it
    ends = np.mod(ends, FRAME_SAMPLES)[:, :, np.newaxis]
    centre = (ends + FRAME_SAMPLES * np.arange(-1, 2)).reshape(len(position), -1)
    strength = amplitude[:, np.newaxis] * np.repeat(weights, 3)
    if abs(drift) < _SHORT_DRIFT:
        return sum_of_pulses(
            frame=np.repeat(frames, centre.shape[1]),
            position=centre.ravel(),
            amplitude=strength.ravel(),
            phase_rad=np.full(centre.size, phase_rad),
            tx_center_frequency=tx_center_frequency,
            shape=(len(position), n_samples),
        )
    mean = np.zeros((len(position), n_samples))
    near = (centre > -HALF_WINDOW) & (centre < n_samples - 1 + HALF_WINDOW) & (strength != 0)
    for frame, end in np.argwhere(near).tolist():
        middle = round(centre[frame, end])
        part = slice(max(middle - HALF_WINDOW, 0), min(middle + HALF_WINDOW + 1, n_samples))
        x = np.arange(part.start, part.stop) - centre[frame, end]
        mean[frame, part] += strength[frame, end] * _pulse_from(x, phase_rad, tx_center_frequency)
    return mean


def _pulse_from(
    x: NDArray[np.float64], phase_rad: float, tx_center_frequency: int
) -> NDArray[np.float64]:
    """Return H(x), the integral of a pulse from x samples behind its centre on, shape (n,)."""
    cycles, samples = CARRIER_CYCLES_PER_SAMPLE[tx_center_frequency]
    k = math.tau * cycles / samples
    side = np.where(x < 0, -1.0, 1.0)
    w = wofz(side * (1j * x / _SIGMA_SAMPLES + k * _SIGMA_SAMPLES) / math.sqrt(2))
    turn = k * x + phase_rad
    envelope = np.exp(-0.5 * (x / _SIGMA_SAMPLES) ** 2)
    envelope *= side * _SIGMA_SAMPLES * math.sqrt(math.pi / 2)
    integral: NDArray[np.float64] = envelope * (np.cos(turn) * w.real - np.sin(turn) * w.imag)
    return integral
