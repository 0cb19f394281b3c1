"""Frames of a few echoes of our choice, for the limits of front ends; made in two ways.

``chip_frames`` goes the emulator's way: its pulse, its receiver (noise by counter, counting,
clipping) and the module's normalisation. ``closed_form_frames`` writes the pulse down and adds
NumPy's noise; neither counts nor clips. That both give the same numbers shows that neither carries
a mistake of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.echo_source import CaptureSettings
from emulator.pulse import sum_of_pulses
from emulator.receiver import Receiver
from emulator.scene import Scene
from emulator.scene_tables import LeakageSpec, NoiseSpec, RadarSpec
from slam.app.sources import sampler_limits
from slam.frames import RadarFrame
from slam.pulse_model import PulseModel
from xethru_protocol.raw_config import RawConfig
from xethru_protocol.x4 import Normalisation

Array = NDArray[np.float64]

N_BINS = 1431
RANGE_START_M = 0.2
BIN_LENGTH_M = 299_792_458.0 / (2 * 23.328e9)
NARROW, FULL = (949, 1100), (0, 2047)
"""Ends of the DAC sweep: +-0.0742 as radars are used, and everything."""
_ITERATIONS, _PULSES_PER_STEP = 16, 300
_TX_CENTER_FREQUENCY = 3
_BLOCK = 250


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Echoes:
    """What is in each of n frames: k echoes each; every array has shape (n, k).

    Attributes
    ----------
    range_m
        True metres.
    amplitude
        Peak of the envelope, normalised units.
    phase_rad
        Phase of the carrier at the pulse's centre.
    """

    range_m: Array
    amplitude: Array
    phase_rad: Array

    @property
    def position_bins(self) -> Array:
        """Return where the echoes lie, in bins from sample 0."""
        return (self.range_m - RANGE_START_M) / BIN_LENGTH_M

    def beside(self, other: Echoes) -> Echoes:
        """Return frames with the echoes of both."""
        return Echoes(
            range_m=np.hstack([self.range_m, other.range_m]),
            amplitude=np.hstack([self.amplitude, other.amplitude]),
            phase_rad=np.hstack([self.phase_rad, other.phase_rad]),
        )


def chip_frames(
    echoes: Echoes, *, noise_sigma: float, seed: int, dac: tuple[int, int] = NARROW
) -> list[RadarFrame]:
    """Return frames as the emulated chip takes them and the driver reads them.

    Parameters
    ----------
    echoes
        Their content.
    noise_sigma
        White noise per RF sample, normalised units.
    seed
        Of the receiver's noise.
    dac
        First and last level of the DAC sweep.
    """
    capture = CaptureSettings(
        first_sample_m=RANGE_START_M,
        n_samples=N_BINS,
        iterations=_ITERATIONS,
        pulses_per_step=_PULSES_PER_STEP,
        dac_min=dac[0],
        dac_max=dac[1],
        dac_step=0,
        tx_power=2,
        tx_center_frequency=_TX_CENTER_FREQUENCY,
    )
    normalisation = Normalisation.of(
        iterations=_ITERATIONS, pulses_per_step=_PULSES_PER_STEP, dac_min=dac[0], dac_max=dac[1]
    )
    limits = sampler_limits(
        RawConfig(
            iterations=_ITERATIONS,
            pulses_per_step=_PULSES_PER_STEP,
            dac_min=dac[0],
            dac_max=dac[1],
        )
    )
    radar = RadarSpec(name="radar", serial="000000000001", x_m=0.0, y_m=0.0, yaw_deg=0.0)
    scene = Scene(
        name="limits",
        environment="lab",
        description="echoes of a front end's test",
        radars=(radar,),
        noise=NoiseSpec(
            rf_sigma=noise_sigma, iterations=_ITERATIONS, pulses_per_step=_PULSES_PER_STEP
        ),
        leakage=LeakageSpec(amplitude=0.0, range_m=0.0),
    )
    receiver = Receiver(scene, radar, seed)
    frames = []
    for start in range(0, len(echoes.range_m), _BLOCK):
        rows = slice(start, start + _BLOCK)
        position = echoes.position_bins[rows]
        n, k = position.shape
        signal = sum_of_pulses(
            frame=np.repeat(np.arange(n), k),
            position=position.ravel(),
            amplitude=echoes.amplitude[rows].ravel(),
            phase_rad=echoes.phase_rad[rows].ravel(),
            tx_center_frequency=_TX_CENTER_FREQUENCY,
            shape=(n, N_BINS),
        )
        counters = np.arange(start, start + n, dtype=np.int64)
        counts = receiver.counters(signal, counters, counters * 200_000_000, capture, gain=1.0)
        samples = counts.astype(np.float32) * np.float32(normalisation.quantum)
        samples -= np.float32(normalisation.dac_offset)
        frames += [_frame(int(c), row, limits) for c, row in zip(counters, samples, strict=True)]
    return frames


def closed_form_frames(echoes: Echoes, *, noise_sigma: float, seed: int) -> list[RadarFrame]:
    """Return frames by the formula of the pulse and NumPy's noise; arguments as `chip_frames`."""
    rng = np.random.default_rng(seed)
    pulse = PulseModel()
    sigma_m, wavelength_m = pulse.sigma_m, pulse.wavelength_m
    labels = RANGE_START_M + BIN_LENGTH_M * np.arange(N_BINS)
    frames = []
    for n in range(len(echoes.range_m)):
        off = labels - echoes.range_m[n, :, np.newaxis]
        envelope = echoes.amplitude[n, :, np.newaxis] * np.exp(-0.5 * (off / sigma_m) ** 2)
        turn = math.tau * off / wavelength_m + echoes.phase_rad[n, :, np.newaxis]
        samples = (envelope * np.cos(turn)).sum(axis=0)
        samples += noise_sigma * rng.standard_normal(N_BINS)
        frames.append(_frame(n, samples.astype(np.float32), None))
    return frames


def _frame(
    counter: int, samples: NDArray[np.float32], limits: tuple[float, float] | None
) -> RadarFrame:
    return RadarFrame(
        radar=0,
        t_ns=counter * 200_000_000,
        counter=counter,
        samples=samples,
        range_start_m=RANGE_START_M,
        bin_length_m=BIN_LENGTH_M,
        limits=limits,
    )
