"""From the sampler to integer chip counters: jitter, clutter, noise, counting, clipping.

Slow noise
----------
Independent normals, one set per knot of a time grid, are joined by the cubic B-spline:

    x(t) = sum_k g_k B3((t + offset) / spacing - k) / sqrt(B7(0)),  B7(0) = 151/315

The grid's offset is uniform in one spacing and drawn once per process, so over seeds the process is
stationary in the strict sense, with variance 1 and autocorrelation B7(lag / spacing) / B7(0): the
spline of degree 7, nearly a Gaussian of variance 2/3 spacing**2. It is 1/e after 1.185 spacings and
0 after four. Along one path the variance breathes by +-4 % between knots and half-way points.
A sum of such processes with knots ever farther apart has a long tail without long memory.

The sum is computed at instants a fixed step apart, which belong to the process like its knots, and
is linear between them: frames that follow each other fast share two instants. That takes a little
off the variance of the fastest member, at most 2.3 % half-way between instants a quarter of its
spacing apart.

A knot depends on (seed, serial number, purpose, its index) alone, so a value does not depend on
what was asked for before.

Source: I. J. Schoenberg, Quart. Appl. Math. 4 (1946) 45, on cardinal splines.

Jitter of the carrier phase
---------------------------
The sampler's clock jitters against the transmitter's: every echo of a frame, and the leakage, are
turned by the same phase. White jitter is a new normal for every frame; slow jitter is a
stationary process of scene time that falls to 1/e after ``slow_correlation_s``. At 7.29 GHz one
radian is 3.3 mm of range; the envelope is not moved, which for 0.03 rad would be 0.1 mm. Echoes
and leakage are also multiplied by 1 + ``amplitude`` times another normal for every frame. Jitter
within a sweep is left out.

Clutter
-------
At every instant the clutter is a dense row of weak scatterers, one complex normal for every 8 RF
samples (one baseband bin), each answering with the transmitted pulse: Gaussian, of equal strength
at all ranges, inside the transmitted band, with autocorrelation exp(-d**2 / 4 s**2) cos(2 pi fc d)
over a distance of d samples (s: the pulse envelope's standard deviation). Over the row the variance
is even to 2e-4. The row repeats after 13 m, which is longer than any frame.

In time each scatterer's amplitude is a sum of three slow processes whose weights and knots were
fitted to the ten farthest bins of one real recording (`GRIDS`). It falls to 1/e after the scene's
``correlation_s``, steeply at first and slowly later. Linear interpolation between instants takes
0.3 % off the variance.

What it leaves out: a real room's clutter is the same for two radars side by side and changes as
the robot drives; this one is independent from radar to radar, and of place and boresight.
Its strength does not fall with range.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from emulator.chip.chip import CaptureSettings, normalisation
from emulator.echo.pulse import CARRIER_CYCLES_PER_SAMPLE, SIGMA_S
from emulator.scene.philox import (
    UNITS_PER_SIGMA,
    Purpose,
    Rng,
    counter_normals,
    frame_noise_units,
    stream_of,
)
from emulator.scene.scene import ClutterSpec, JitterSpec, NoiseSpec, RadarSpec, Scene
from xethru_protocol.wire import x4
from xethru_protocol.wire.x4 import RF_BIN_M, SAMPLING_RATE_HZ

SPACINGS_PER_E_FOLD = 1.185
"""Lag at which B7(lag) / B7(0) is 1/e, in knot spacings."""
_KNOTS = 5
_FIVE = np.arange(_KNOTS)
_KNOTS_AHEAD = 8
_INSTANTS_AHEAD = 3
_SCALE = (151 / 315) ** -0.5 / UNITS_PER_SIGMA
# Knot indices must not be negative, while a clock that is early may ask for a time before 0.
_FIRST_KNOT = 1 << 40

_T = TypeVar("_T")

_JITTER_INSTANTS_PER_KNOT = 16
_COUNTERS_AT_ONCE = 256
# What is worked on stays in the processor's cache, a block of frames does not.
_FRAMES_AT_ONCE = 4
_VALUES_AT_ONCE = 2048

GRIDS = ((0.054, 0.16), (0.239, 0.24), (1.205, 0.60))
"""Spacing of the clutter's knots in correlation times, and share of the variance, fastest first."""
_CLUTTER_INSTANTS_PER_KNOT = 4
_MOST_FRAMES_WITHOUT_INSTANTS = 4.0  # between two instants; fewer cost less each by themselves
_SCATTERER_SAMPLES = 8
_SCATTERERS = 256
_REACH = 4
"""Scatterers on either side that a sample receives: 32 samples, four envelope deviations."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KnotGrid:
    """One member of a sum: how far apart its knots are, and its standard deviation."""

    spacing_ns: int
    sigma: float

    @classmethod
    def falling_in(cls, correlation_s: float, sigma: float) -> KnotGrid:
        """Return the member whose autocorrelation is 1/e after ``correlation_s``."""
        return cls(spacing_ns=round(correlation_s / SPACINGS_PER_E_FOLD * 1e9), sigma=sigma)


class SlowNoise:
    """Several slow processes of the same kind, independent of each other.

    Parameters
    ----------
    grids
        Members of the sum, fastest first; its variance is the sum of their ``sigma**2``.
    n_values
        How many processes.
    instants_per_knot
        Instants in a spacing of the fastest grid.
    """

    def __init__(
        self,
        grids: tuple[KnotGrid, ...],
        n_values: int,
        *,
        instants_per_knot: int,
        seed: int,
        serial: int,
        purpose: Purpose,
    ) -> None:
        self._seed = seed
        self._streams = [stream_of(serial, purpose, part) for part in range(len(grids))]
        self._instant_ns = grids[0].spacing_ns // instants_per_knot
        # the parts behind the grids' own: their offsets, and that of the instants
        periods_ns = [*(grid.spacing_ns for grid in grids), self._instant_ns]
        *offsets_ns, self._instants_offset_ns = (
            Rng(seed, stream_of(serial, purpose, part)).below(period_ns)
            for part, period_ns in enumerate(periods_ns, len(grids))
        )
        # columns, one row for each grid
        self._offsets_of_grids_ns = np.array(offsets_ns, dtype=np.int64)[:, np.newaxis]
        self._spacings_ns = np.array([[grid.spacing_ns] for grid in grids], dtype=np.int64)
        self._scales = np.array([[grid.sigma * _SCALE] for grid in grids])
        self._n_values = n_values
        none_yet = _Knots(numbers=np.empty(0, dtype=np.int64), values=np.empty((0, n_values)))
        self._held = [none_yet] * len(grids)

    @property
    def instants_apart_ns(self) -> int:
        return self._instant_ns

    def instants_before(
        self, times_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the instants before scene times and the fractions of the way to the next.

        Shape (n,) each, like ``times_ns``.
        """
        instants, rest_ns = np.divmod(times_ns + self._instants_offset_ns, self._instant_ns)
        return instants, rest_ns / self._instant_ns

    def at_instants(
        self,
        instants: NDArray[np.int64],
        kept: Mapping[int, _T],
        make: Callable[[NDArray[np.float64]], Iterable[_T]],
    ) -> dict[int, _T]:
        """Return what belongs to instants, their successors and perhaps a few more.

        What was kept from the last call is taken from there; ``make`` gets the values at others,
        shape (m, n_values).
        """
        wanted = sorted({*instants.tolist(), *(instants + 1).tolist()})
        missing = [instant for instant in wanted if instant not in kept]
        if not missing:
            return dict(kept)
        missing += range(wanted[-1] + 1, wanted[-1] + 1 + _INSTANTS_AHEAD)
        times_ns = np.array(missing, dtype=np.int64) * self._instant_ns
        times_ns -= self._instants_offset_ns
        made = dict(zip(missing, make(self.values_at(times_ns)), strict=True))
        return {instant: kept[instant] for instant in wanted if instant in kept} | made

    def values_at(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the values at scene times of shape (n,): shape (n, n_values), float64."""
        instants, fractions = self.instants_before(times_ns)
        fraction = fractions[:, np.newaxis]
        first_knots, since_ns = np.divmod(
            instants * self._instant_ns + self._offsets_of_grids_ns, self._spacings_ns
        )
        # The next instant may lie behind the next knot: both instants together have five.
        later_ns = since_ns + self._instant_ns
        is_behind = later_ns >= self._spacings_ns
        later_ns -= is_behind * self._spacings_ns
        here = _cubic_weights(since_ns / self._spacings_ns, self._scales) * (1 - fraction)
        there = _cubic_weights(later_ns / self._spacings_ns, self._scales) * fraction
        weights = np.zeros((*first_knots.shape, _KNOTS))
        weights[..., :-1] = here
        weights[..., :-1] += there * ~is_behind[..., np.newaxis]
        weights[..., 1:] += there * is_behind[..., np.newaxis]
        weight = weights.transpose(1, 0, 2).reshape(len(times_ns), len(self._streams) * _KNOTS)
        knots = [self._with_knots(member, first) for member, first in enumerate(first_knots)]
        values = np.empty((len(times_ns), self._n_values))
        at_once = max(_VALUES_AT_ONCE // self._n_values, 1)
        near = np.empty((min(at_once, len(times_ns)), weight.shape[1], self._n_values))
        for first in range(0, len(times_ns), at_once):
            part = slice(first, first + at_once)
            factors = weight[part]
            for member, (held, place) in enumerate(knots):
                columns = slice(member * _KNOTS, (member + 1) * _KNOTS)
                near[: len(factors), columns] = held[place[part]]
            # einsum multiplies and adds in loops of its own, never by BLAS
            np.einsum("ik,ikn->in", factors, near[: len(factors)], out=values[part])
        return values

    def _with_knots(
        self, member: int, first_knot: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return knots of a member, and where among them the five from each first are, (n, 5)."""
        held = self._held[member]
        place = held.numbers.searchsorted(first_knot)
        if not held.have(first_knot, place):
            numbers = np.unique(first_knot[:, np.newaxis] + _FIVE)
            if np.isin(numbers, held.numbers).any():  # frames follow each other: some for the next
                numbers = np.append(numbers, numbers[-1] + 1 + np.arange(_KNOTS_AHEAD))
            known = np.isin(numbers, held.numbers)
            values = np.empty((len(numbers), self._n_values))
            values[known] = held.values[held.numbers.searchsorted(numbers[known])]
            values[~known] = frame_noise_units(
                _FIRST_KNOT + numbers[~known],
                self._n_values,
                seed=self._seed,
                stream=self._streams[member],
            )
            held = self._held[member] = _Knots(numbers=numbers, values=values)
            place = numbers.searchsorted(first_knot)
        return held.values, place[:, np.newaxis] + _FIVE


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Knots:
    """Some knots of one grid: their numbers, shape (n,), ascending, and values, (n, n_values)."""

    numbers: NDArray[np.int64]
    values: NDArray[np.float64]

    def have(self, first: NDArray[np.int64], place: NDArray[np.int64]) -> bool:
        """Return whether the five that begin with each ``first`` begin at ``place``."""
        end = place + (_KNOTS - 1)
        if end.max(initial=0) >= len(self.numbers):
            return len(first) == 0
        # numbers ascend without repeats: five in a row are there if both ends are
        ends_are_there = (self.numbers[place] == first) & (self.numbers[end] == first + _KNOTS - 1)
        return bool(ends_are_there.all())


def _cubic_weights(u: NDArray[np.float64], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights of four knots in a row at fractions u behind the second, (..., 4)."""
    v = 1 - u
    weights = np.empty((*u.shape, 4))
    weights[..., 0] = scale * (v * v * v / 6)
    weights[..., 1] = scale * (2 / 3 - u * u * (2 - u) / 2)
    weights[..., 2] = scale * (2 / 3 - v * v * (2 - v) / 2)
    weights[..., 3] = scale * (u * u * u / 6)
    return weights


class CarrierJitter:
    """The jitter of one radar."""

    def __init__(self, spec: JitterSpec, *, seed: int, serial: int) -> None:
        self._spec = spec
        self._white = _FrameNormals(seed, stream_of(serial, Purpose.JITTER_WHITE))
        self._amplitude = _FrameNormals(seed, stream_of(serial, Purpose.JITTER_AMPLITUDE))
        self._slow = SlowNoise(
            (KnotGrid.falling_in(spec.slow_correlation_s, sigma=spec.slow_rad),),
            1,
            instants_per_knot=_JITTER_INSTANTS_PER_KNOT,
            seed=seed,
            serial=serial,
            purpose=Purpose.JITTER_SLOW,
        )
        self._slow_rad: dict[int, float] = {}

    def phases_rad(
        self, indices: NDArray[np.int64], scene_times_ns: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return what to add to the phase of each frame's carrier, shape (n_frames,) [rad].

        Parameters
        ----------
        indices
            Shape (n_frames,), int64; they select the white part.
        scene_times_ns
            Shape (n_frames,), int64: when this radar truly took each frame.
        """
        phases_rad = np.zeros(len(indices))
        if self._spec.white_rad > 0:
            phases_rad = self._white.at(indices) * self._spec.white_rad
        if self._spec.slow_rad > 0:
            instants, fractions = self._slow.instants_before(scene_times_ns)
            slow_rad = self._slow_rad = self._slow.at_instants(
                instants, self._slow_rad, lambda values: values[:, 0].tolist()
            )
            before = np.array([slow_rad[instant] for instant in instants.tolist()])
            after = np.array([slow_rad[instant + 1] for instant in instants.tolist()])
            phases_rad += before + fractions * (after - before)
        return phases_rad

    def scale(self, signal: NDArray[np.float64], indices: NDArray[np.int64]) -> None:
        """Multiply frames of shape (n_frames, n_samples), with these indices, in place."""
        if self._spec.amplitude > 0:
            signal *= 1 + self._spec.amplitude * self._amplitude.at(indices)[:, np.newaxis]


class _FrameNormals:
    """One normal for each frame of a stream; made for many at once, as frames come one by one."""

    def __init__(self, seed: int, stream: int) -> None:
        self._seed, self._stream = seed, stream
        self._page = -1
        self._normals: list[float] = []

    def at(self, indices: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the normals of frames, shape (n_frames,)."""
        return np.array([self._one(index) for index in indices.tolist()], dtype=np.float64)

    def _one(self, index: int) -> float:
        page, place = divmod(index, _COUNTERS_AT_ONCE)
        if page != self._page:
            counters = page * _COUNTERS_AT_ONCE + np.arange(_COUNTERS_AT_ONCE, dtype=np.int64)
            normals = counter_normals(counters, seed=self._seed, stream=self._stream)
            self._page, self._normals = page, normals.tolist()
        return self._normals[place]


class ClutterField:
    """The clutter of one radar, as a function of scene time and range."""

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
            instants_per_knot=_CLUTTER_INSTANTS_PER_KNOT,
            seed=seed,
            serial=serial,
            purpose=Purpose.CLUTTER,
        )
        self._answers: dict[int, NDArray[np.float64]] = {}
        self._answers_are_of: tuple[_ReceivedScatterers, float] | None = None

    def add_to(
        self,
        signal: NDArray[np.float64],
        scene_times_ns: NDArray[np.int64],
        capture: CaptureSettings,
        gain: float,
    ) -> None:
        """Add the clutter to frames in place; arguments are those of `Receiver.counters`."""
        strength = self._sigma * gain
        if strength == 0.0:
            return
        row = _ReceivedScatterers.of(capture)
        apart_s = self._scatterers.instants_apart_ns / 1e9
        # What the chip is set to decides, not the frames at hand: their last bits must not depend
        # on how many are made at once.
        if highest_rate_hz(capture) * apart_s < _MOST_FRAMES_WITHOUT_INSTANTS:
            signal += row.answers(strength * self._scatterers.values_at(scene_times_ns))
            return
        instants, fractions = self._scatterers.instants_before(scene_times_ns)
        answers = self._scatterers.at_instants(
            instants,
            self._answers if (row, strength) == self._answers_are_of else {},
            lambda values: row.answers(strength * values),
        )
        self._answers, self._answers_are_of = answers, (row, strength)
        at: int | None = None
        clutter = np.empty(capture.n_samples)
        # frame by frame: one stays in the processor's cache, a block does not
        for frame, instant, fraction in zip(
            signal, instants.tolist(), fractions.tolist(), strict=True
        ):
            if instant != at:
                start, at = answers[instant], instant
                rise = answers[instant + 1] - start
            np.multiply(rise, fraction, out=clutter)
            np.add(clutter, start, out=clutter)
            np.add(frame, clutter, out=frame)


@dataclass(frozen=True, slots=True, kw_only=True)
class _ReceivedScatterers:
    """The part of the row of scatterers that a frame receives.

    Attributes
    ----------
    first_sample
        Number of the frame's first RF sample, counted from range label 0.
    """

    first_sample: int
    n_samples: int
    tx_center_frequency: int

    @staticmethod
    def of(capture: CaptureSettings) -> _ReceivedScatterers:
        return _ReceivedScatterers(
            first_sample=round(capture.first_sample_m / RF_BIN_M),
            n_samples=capture.n_samples,
            tx_center_frequency=capture.tx_center_frequency,
        )

    def answers(self, scatterers: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what scatterers answer, of their variance: shape (n, n_samples).

        ``scatterers`` has the shape (n, 2 * _SCATTERERS): real parts, then imaginary parts.
        """
        first_cell, lead = divmod(self.first_sample, _SCATTERER_SAMPLES)
        n_cells = -(-(lead + self.n_samples) // _SCATTERER_SAMPLES)
        places = _near_scatterers(first_cell % _SCATTERERS, n_cells)
        kernels = _KERNELS[self.tx_center_frequency]
        answers = np.empty((len(scatterers), n_cells, _SCATTERER_SAMPLES))
        for first in range(0, len(scatterers), _FRAMES_AT_ONCE):
            values = scatterers[first : first + _FRAMES_AT_ONCE]
            near = values.ravel().take(places[:, : len(values)].reshape(len(places), -1))
            # einsum multiplies and adds in loops of its own, never by BLAS
            by_place = np.einsum("kc,kr->rc", near, kernels)
            by_place = by_place.reshape(_SCATTERER_SAMPLES, len(values), n_cells)
            answers[first : first + _FRAMES_AT_ONCE] = by_place.transpose(1, 2, 0)
        return answers.reshape(len(scatterers), n_cells * _SCATTERER_SAMPLES)[
            :, lead : lead + self.n_samples
        ]


@functools.cache
def _near_scatterers(first_cell: int, n_cells: int) -> NDArray[np.int64]:
    """Return which normals reach the samples of each cell: (4 * _REACH, _FRAMES_AT_ONCE, n_cells).

    Nearest range first; first of the scatterers' real, then of their imaginary parts; numbered
    through frames that follow each other.
    """
    scatterer = first_cell + np.arange(n_cells) + np.arange(1 - _REACH, 1 + _REACH)[:, np.newaxis]
    scatterer %= _SCATTERERS
    normals = np.concatenate([scatterer, scatterer + _SCATTERERS])
    frames = np.arange(_FRAMES_AT_ONCE)[:, np.newaxis]
    return normals[:, np.newaxis, :] + 2 * _SCATTERERS * frames


def _kernels() -> dict[int, NDArray[np.float64]]:
    """Return the pulse by carrier setting, each of shape (4 * _REACH, 8).

    Rows as in `_near_scatterers`, columns by the sample's place in its cell.
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


def highest_rate_hz(capture: CaptureSettings) -> float:
    """Return how many frames the chip can sweep in a second (protocol reference 9.6)."""
    return x4.fps_max(
        iterations=capture.iterations,
        pulses_per_step=capture.pulses_per_step,
        dac_min=capture.dac_min,
        dac_max=capture.dac_max,
        dac_step=capture.dac_step,
    )


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
        indices: NDArray[np.int64],
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
        indices
            Shape (n_frames,), int64; they select the noise.
        scene_times_ns
            Shape (n_frames,), int64: when this radar truly took each frame.
        gain
            Amplitude of the transmitter at its power setting times the receiver's gain: the
            factor that the signal already has and the clutter needs. The noise has none.

        Returns
        -------
        Shape (n_frames, capture.n_samples), int64, clipped to [0, largest counter].
        """
        unit = normalisation(capture)
        self._clutter.add_to(signal, scene_times_ns, capture, gain)
        units = frame_noise_units(indices, capture.n_samples, seed=self._seed, stream=self._stream)
        per_unit = noise_sigma(self._noise, capture) / UNITS_PER_SIGMA
        per_count = 1 / one_count(capture)
        counters = np.empty(signal.shape, dtype=np.int64)
        # a few frames at a time: they stay in the processor's cache, a block does not
        for first in range(0, len(signal), _FRAMES_AT_ONCE):
            part = slice(first, first + _FRAMES_AT_ONCE)
            counts = units[part] * per_unit
            counts += signal[part]
            counts += unit.dac_offset
            counts *= per_count
            np.rint(counts, out=counts)
            np.maximum(counts, 0, out=counts)
            np.minimum(counts, unit.max_counter, out=counts)
            counters[part] = counts
        return counters
