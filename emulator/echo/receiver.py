"""From the signal at the sampler to integer chip counters: clutter, noise, counting, clipping.

At every instant it is a dense row of weak scatterers, one complex normal for every 8 RF samples
(one baseband bin), each answering with the transmitted pulse: Gaussian, of equal strength at all
ranges, inside the transmitted band, with autocorrelation exp(-d**2 / 4 s**2) cos(2 pi fc d) over a
distance of d samples (s: the pulse envelope's standard deviation). Over the row the variance is
even to 2e-4. The row repeats after 13 m, which is longer than any frame.

In time each scatterer's amplitude is a sum of three slow processes (``emulator.echo.noise``) whose
weights and knots were fitted to the ten farthest bins of one real recording (`GRIDS`). It falls to
1/e after the scene's ``correlation_s``, steeply at first and slowly later. Linear interpolation
between instants takes 0.3 % off the variance.

What it leaves out: it does not know that the robot moves, or which way the radar looks; a real
room's clutter is the same for two radars side by side and changes as the robot drives, this is
independent of both. Its strength does not fall with range.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.chip.chip import CaptureSettings
from emulator.echo.noise import KnotGrid, SlowNoise
from emulator.echo.pulse import CARRIER_CYCLES_PER_SAMPLE, SIGMA_S
from emulator.scene.philox import UNITS_PER_SIGMA, Purpose, frame_noise_units, stream_of
from emulator.scene.scene import ClutterSpec, NoiseSpec, RadarSpec, Scene
from xethru_protocol.wire import x4
from xethru_protocol.wire.x4 import RF_BIN_M, SAMPLING_RATE_HZ

GRIDS = ((0.054, 0.16), (0.239, 0.24), (1.205, 0.60))
"""Spacing of the knots in correlation times, and share of the variance, of the three processes."""

_SCATTERER_SAMPLES = 8
_SCATTERERS = 256
_REACH = 4
"""Scatterers on either side that a sample hears: 32 samples, four envelope deviations."""
_INSTANTS_PER_KNOT = 4


class ClutterField:
    """The clutter of one radar, as a function of scene time and range.

    Parameters
    ----------
    spec
        Strength and correlation time.
    seed, serial
        The run's seed and the module's serial number: they select the clutter.
    """

    def __init__(self, spec: ClutterSpec, *, seed: int, serial: int) -> None:
        self._sigma = spec.sigma
        self._scatterers = SlowNoise(
            tuple(
                KnotGrid(
                    spacing_ns=round(spacing * spec.correlation_s * 1e9), sigma=math.sqrt(share)
                )
                for spacing, share in GRIDS
            ),
            2 * _SCATTERERS,
            instants_per_knot=_INSTANTS_PER_KNOT,
            seed=seed,
            serial=serial,
            purpose=Purpose.CLUTTER,
        )
        self._line_of: tuple[int, _Row] | None = None
        self._line_now = (np.empty(0), np.empty(0))
        self._answers: dict[int, NDArray[np.float64]] = {}
        self._row: _Row | None = None

    def add_to(
        self,
        signal: NDArray[np.float64],
        scene_times_ns: NDArray[np.int64],
        capture: CaptureSettings,
        gain: float,
    ) -> None:
        """Add the clutter to frames in place.

        Parameters
        ----------
        signal
            Shape (n_frames, capture.n_samples), float64, normalised units.
        scene_times_ns
            Shape (n_frames,), int64: when this radar truly took each frame.
        capture
            The chip's settings.
        gain
            Amplitude of the transmitter at its power setting times the receiver's gain.
        """
        strength = self._sigma * gain
        if strength == 0.0:
            return
        row = _Row.of(capture)
        at: int | None = None
        clutter = np.empty(capture.n_samples)
        # frame by frame: one stays in the processor's cache, a block does not
        for frame, time_ns in zip(signal, scene_times_ns.tolist(), strict=True):
            instant, fraction = self._scatterers.instant_before(time_ns)
            if instant != at:
                start, rise = self._line(instant, row)
                start, at = start * strength, instant
            np.multiply(rise, strength * fraction, out=clutter)
            np.add(clutter, start, out=clutter)
            np.add(frame, clutter, out=frame)

    def _line(self, instant: int, row: _Row) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the unit clutter at an instant and by how much it rises until the next."""
        if (instant, row) != self._line_of:
            start, end = (self._answers_at(number, row) for number in (instant, instant + 1))
            self._line_now, self._line_of = (start, end - start), (instant, row)
            self._answers = {instant + 1: end}
            self._row = row
        return self._line_now

    def _answers_at(self, instant: int, row: _Row) -> NDArray[np.float64]:
        if row == self._row and instant in self._answers:
            return self._answers[instant]
        return row.answers(self._scatterers.values_at(instant))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Row:
    """The part of the row of scatterers that a frame hears.

    Attributes
    ----------
    first_sample
        Number of the frame's first RF sample, counted from range label 0.
    n_samples
        Length of the frame.
    tx_center_frequency
        Which carrier.
    """

    first_sample: int
    n_samples: int
    tx_center_frequency: int

    @staticmethod
    def of(capture: CaptureSettings) -> _Row:
        return _Row(
            first_sample=round(capture.first_sample_m / RF_BIN_M),
            n_samples=capture.n_samples,
            tx_center_frequency=capture.tx_center_frequency,
        )

    def answers(self, scatterers: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what scatterers answer.

        Parameters
        ----------
        scatterers
            Shape (2 * _SCATTERERS,), float64: real parts, then imaginary parts.

        Returns
        -------
        Shape (n_samples,), float64, variance 1 for scatterers of variance 1.
        """
        first_cell, lead = divmod(self.first_sample, _SCATTERER_SAMPLES)
        n_cells = -(-(lead + self.n_samples) // _SCATTERER_SAMPLES)
        heard = np.take(scatterers, _heard(first_cell % _SCATTERERS, n_cells))
        # einsum multiplies and adds in loops of its own, never by BLAS
        answers = np.einsum("kc,kr->rc", heard, _KERNELS[self.tx_center_frequency])
        frame: NDArray[np.float64] = answers.T.ravel()[lead : lead + self.n_samples]
        return frame


@functools.cache
def _heard(first_cell: int, n_cells: int) -> NDArray[np.int64]:
    """Return which normals the samples of each cell hear, shape (4 * _REACH, n_cells).

    Nearest range first; first of the scatterers' real, then of their imaginary parts.
    """
    scatterer = first_cell + np.arange(n_cells) + np.arange(1 - _REACH, 1 + _REACH)[:, np.newaxis]
    scatterer %= _SCATTERERS
    return np.concatenate([scatterer, scatterer + _SCATTERERS])


def _kernels() -> dict[int, NDArray[np.float64]]:
    """Return the pulse by carrier setting, each of shape (4 * _REACH, 8).

    Rows as in `_heard`, columns by the sample's place in its cell.
    """
    step = np.arange(2 * _REACH)[:, np.newaxis]
    distance = np.arange(_SCATTERER_SAMPLES) + _SCATTERER_SAMPLES * (_REACH - 1 - step)
    envelope = np.exp(-0.5 * (distance / (SIGMA_S * SAMPLING_RATE_HZ)) ** 2)
    envelope /= math.sqrt(float((envelope**2).sum()) / _SCATTERER_SAMPLES)
    kernels = {}
    for setting, (cycles, samples) in CARRIER_CYCLES_PER_SAMPLE.items():
        phase_rad = math.tau * ((cycles * distance) % samples) / samples
        kernels[setting] = np.concatenate(
            [envelope * np.cos(phase_rad), -envelope * np.sin(phase_rad)]
        )
    return kernels


_KERNELS = _kernels()


def one_count(capture: CaptureSettings) -> float:
    """Return one chip count in normalised units (protocol reference 9.7).

    In float64: `xethru_protocol.wire.x4.Normalisation` rounds it to float32, as the wire needs it.
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
