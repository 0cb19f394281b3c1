"""From the signal at the sampler to integer chip counters: noise, quantisation, clipping."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from emulator.echo_source import CaptureSettings
from emulator.noise import UNITS_PER_SIGMA, frame_noise_units
from emulator.scene import Scene
from emulator.scene_tables import RadarSpec
from xethru_protocol import x4

__all__ = ["one_count", "rf_counters"]


def one_count(capture: CaptureSettings) -> float:
    """Return one chip count in normalised units (protocol reference 9.7).

    In float64: `xethru_protocol.x4.Normalisation` rounds it to float32, as the wire needs it.
    """
    return 2.0**capture.dac_step / (capture.iterations * capture.pulses_per_step) / 1024


def rf_counters(
    signal: NDArray[np.float64],
    frame_counters: NDArray[np.int64],
    scene_times_ns: NDArray[np.int64],
    *,
    capture: CaptureSettings,
    scene: Scene,
    radar: RadarSpec,
    seed: int,
) -> NDArray[np.int64]:
    """Return what the chip counts when a signal reaches its sampler.

    Parameters
    ----------
    signal
        Shape (n_frames, capture.n_samples), float64, normalised units: echoes and leakage.
    frame_counters
        Shape (n_frames,), int64; they select the noise.
    scene_times_ns
        Shape (n_frames,), int64: when this radar truly took each frame.
    capture
        The chip's settings.
    scene, radar, seed
        Where the receiver's figures stand, and what keys its noise.

    Returns
    -------
    Shape (n_frames, capture.n_samples), int64, clipped to [0, largest counter].
    """
    del scene_times_ns
    normalisation = x4.Normalisation.of(
        iterations=capture.iterations,
        pulses_per_step=capture.pulses_per_step,
        dac_min=capture.dac_min,
        dac_max=capture.dac_max,
        dac_step=capture.dac_step,
    )
    pulses = capture.iterations * capture.pulses_per_step
    noise = scene.noise
    sigma = noise.rf_sigma * math.sqrt(noise.iterations * noise.pulses_per_step / pulses)

    units = frame_noise_units(
        frame_counters, capture.n_samples, seed=seed, stream=int(radar.serial)
    )
    counts: NDArray[np.float64] = units * (sigma / UNITS_PER_SIGMA)
    counts += signal
    counts += normalisation.dac_offset
    counts *= 1 / one_count(capture)
    np.rint(counts, out=counts)
    np.clip(counts, 0, normalisation.max_counter, out=counts)
    return counts.astype(np.int64)
