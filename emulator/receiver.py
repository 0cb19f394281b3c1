"""From the signal at the sampler to integer chip counters: clutter, noise, counting, clipping."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from emulator.clutter import ClutterField
from emulator.echo_source import CaptureSettings
from emulator.noise import UNITS_PER_SIGMA, Purpose, frame_noise_units, stream_of
from emulator.scene import Scene
from emulator.scene_tables import NoiseSpec, RadarSpec
from xethru_protocol import x4

__all__ = ["Receiver", "noise_sigma", "one_count"]


def one_count(capture: CaptureSettings) -> float:
    """Return one chip count in normalised units (protocol reference 9.7).

    In float64: `xethru_protocol.x4.Normalisation` rounds it to float32, as the wire needs it.
    """
    return 2.0**capture.dac_step / (capture.iterations * capture.pulses_per_step) / 1024


def noise_sigma(noise: NoiseSpec, capture: CaptureSettings) -> float:
    """Return the white noise's standard deviation per RF sample, normalised units.

    A frame is a mean over iterations x pulses per step, whose noise is independent.
    """
    pulses = capture.iterations * capture.pulses_per_step
    return noise.rf_sigma * math.sqrt(noise.iterations * noise.pulses_per_step / pulses)


class Receiver:
    """The receiver of one radar of a scene."""

    def __init__(self, scene: Scene, radar: RadarSpec, seed: int) -> None:
        self._noise = scene.noise
        self._seed = seed
        self._stream = stream_of(int(radar.serial), Purpose.RECEIVER_NOISE)
        self._clutter = ClutterField(scene.clutter, seed=seed, serial=int(radar.serial))

    def counters(
        self,
        signal: NDArray[np.float64],
        frame_counters: NDArray[np.int64],
        scene_times_ns: NDArray[np.int64],
        capture: CaptureSettings,
        *,
        gain: float,
    ) -> NDArray[np.int64]:
        """Return what the chip counts when a signal reaches its sampler.

        Parameters
        ----------
        signal
            Shape (n_frames, capture.n_samples), float64, normalised units: echoes and leakage.
            Clutter is added in place.
        frame_counters
            Shape (n_frames,), int64; they select the noise.
        scene_times_ns
            Shape (n_frames,), int64: when this radar truly took each frame.
        capture
            The chip's settings.
        gain
            Amplitude of the transmitter at its power setting times the receiver's gain: the
            factor that the signal already has and the clutter needs. The noise has none.

        Returns
        -------
        Shape (n_frames, capture.n_samples), int64, clipped to [0, largest counter].
        """
        normalisation = x4.Normalisation.of(
            iterations=capture.iterations,
            pulses_per_step=capture.pulses_per_step,
            dac_min=capture.dac_min,
            dac_max=capture.dac_max,
            dac_step=capture.dac_step,
        )
        self._clutter.add_to(signal, scene_times_ns, capture, gain)
        units = frame_noise_units(
            frame_counters, capture.n_samples, seed=self._seed, stream=self._stream
        )
        counts: NDArray[np.float64] = units * (noise_sigma(self._noise, capture) / UNITS_PER_SIGMA)
        counts += signal
        counts += normalisation.dac_offset
        counts *= 1 / one_count(capture)
        np.rint(counts, out=counts)
        np.clip(counts, 0, normalisation.max_counter, out=counts)
        return counts.astype(np.int64)
