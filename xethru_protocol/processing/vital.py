"""Breathing of a person at rest, from the phase of the chest's echo.

Not a medical device: a rate found here is an estimate by radar, for experiments.

A chest at range r adds ``A exp(-4 pi j r / wavelength)`` to what stands still in its bins, c. While
it moves by millimetres, the sum lies on an arc about c. `breathing_rate` looks for such arcs:

Candidates
    Frames are averaged over a quarter of a second first. Candidates are ranges whose power between
    6 and 40 cycles per minute, on either side of 0 Hz, is a local maximum and at least four times
    the median over range.
Demodulation
    Five bins about a candidate are added with the weights of their first singular vector (the
    empirical orthogonal function of what moves there), which is the sum of the best signal-to-noise
    ratio if all move alike. A circle (Taubin, IEEE Trans. PAMI 13 (1991) 1115) gives the centre c,
    and the angle about it the displacement d, wavelength / 4 pi per radian (arctangent
    demodulation: Park, Boric-Lubecke and Lubecke, IEEE Trans. MTT 55 (2007) 1073). Unlike one
    component of the signal, it has no places where breathing vanishes or appears doubled. An echo
    so weak that noise leaves the circle is taken along its largest component.
Rest
    Frames in which the echo leaves the circle, or moves faster than a chest or than it usually
    does, are left out. If more than a third are, or if the rest of them adds up to a longer way
    than a chest's, the body moves, and neither this candidate nor a weaker one is answered. Nor is
    one if something passes: in blocks of 4 s, a bin's power has the duty ``mean(P)**2 /
    mean(P**2)``, and bins of a duty below 0.4 hold more than 30 % of the movement.
Rate
    The highest peak of ``|V(f)|**2 / f``, V the transform of the velocity under a Hann window,
    between displacement, which favours drift, and velocity, which favours heart and noise. It must
    be the highest below 2 Hz. Where the displacement has more power at half of its frequency, that
    is the rate, and the peak its second harmonic. Then the velocity is turned back by the rate, and
    the turns that are left over the window are added: the mean of a rate that changes.
Confidence
    Share of ``|V(f)|**2 / f`` below 2 Hz that lies at the rate and its next two harmonics; below
    `LEAST_CONFIDENCE` nothing is answered.
Faint echoes
    Where no candidate has an answer and none is strong, one spectral line is looked for: power at
    +-f over its median over range, whose own spectrum is that of noise and slow clutter (a constant
    false alarm rate over range, as in `detection`). Bins are added as above, but by what moves
    within 3 cycles per minute of that line, and taken along their largest component; the spectrum
    of the noise in one component is subtracted before the confidence is computed. A line of which
    anything else at that range, up to half of the frame rate, reaches a third is not answered.

The numbers were chosen with emulated people; `docs/breathing.md` has what comes of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xethru_protocol.processing.doppler import CARRIER_HZ, SPEED_OF_LIGHT_MPS, hann, range_doppler
from xethru_protocol.processing.monitor import Monitor, checked

SLOWEST_BPM, FASTEST_BPM = 6.0, 40.0
"""Rates that are looked for, breaths per minute."""
LEAST_CONFIDENCE = 0.7
"""Share of power below which no rate is answered."""
SHORTEST_S = 20.0
"""Frames of less time than this have no rate: two breaths of the slowest."""

_NEIGHBOURS = 2  # bins on either side of a candidate: the pulse reaches over them
_CANDIDATES = 4
_LEAST_EXCESS, _WEAK_EXCESS = 4.0, 60.0  # power in the median over range
_HIGHEST_HZ = 2.0  # of what is looked at: harmonics, and a heart
_HARMONICS = 3
_FASTEST_CHEST_MPS = 0.06
_LONGEST_TRAVEL_M = 0.03
_OFF_CIRCLE = 0.5  # of the radius
_FASTER_THAN_USUAL = 4.0  # in the upper quartile of the speed
_AROUND_S = 0.75  # before and after a movement, which begins and ends slowly
_LEAST_REST = 2 / 3  # of the window
_BLOCK_S, _LEAST_DUTY, _PASSING = 4.0, 0.4, 0.3
# of faint echoes
_FEWEST_BINS = 8  # of fewer the median over range is not that of noise
_LEAST_LINE = 15.0  # power over its median over range; of noise alone less than 11 in 95 %
_LINE_HZ = 0.05  # on either side of a line
_OTHER_LINES = 0.3  # of a line
_SLOWEST_HZ = 0.015  # of other lines: slower ones are drift
_MEDIAN_OF_MEAN = 0.839  # of the sum of two exponential variables


@dataclass(frozen=True, slots=True, kw_only=True)
class Breathing:
    """One who breathes.

    Attributes
    ----------
    rate_bpm
        Breaths per minute, the mean over the window.
    confidence
        0 to 1: share of the movement's power that is at the rate and its harmonics.
    range_m
        Range of the chest, in the unit of the given ranges.
    """

    rate_bpm: float
    confidence: float
    range_m: float


def phase_at(iq: ArrayLike, ranges_m: ArrayLike, range_m: float) -> NDArray[np.float64]:
    """Return the phase of what moves at a range, about what stands still there, shape (n_frames,).

    Unwrapped, in radians. It falls by 4 pi per wavelength as range grows: a displacement towards
    the radar is ``phase * wavelength / (4 pi)``. Where nothing moves it is noise.

    Parameters
    ----------
    iq
        Shape (n_frames, n_bins), complex.
    ranges_m
        Shape (n_bins,).
    range_m
        The bin nearest to it, and two on either side, are used.
    """
    frames, ranges = checked(iq, ranges_m)
    if not frames.size:
        raise ValueError(f"frames of shape {frames.shape}: must have frames and bins")
    echo = _echo_near(frames, int(np.argmin(np.abs(ranges - range_m))))
    return np.unwrap(np.angle(echo - circle_centre(echo)))


def circle_centre(points: NDArray[np.complex128]) -> complex:
    """Return the centre of the circle through complex points, shape (n,): Taubin's fit."""
    middle = points.mean()
    z = points - middle
    square = z.real**2 + z.imag**2
    mean_square = float(square.mean())
    if mean_square == 0:
        return complex(middle)
    scale = 2 * math.sqrt(mean_square)
    columns = np.stack([(square - mean_square) / scale, z.real, z.imag], axis=1)
    _, vectors = np.linalg.eigh(columns.T @ columns)
    a, b, c = vectors[:, 0] / (scale, 1.0, 1.0)
    if a == 0:
        return complex(middle)  # on a line: there is no circle
    return complex(middle - (b + 1j * c) / (2 * a))


def breathing_rate(
    iq: ArrayLike,
    ranges_m: ArrayLike,
    frame_rate_hz: float,
    *,
    carrier_hz: float = CARRIER_HZ,
) -> Breathing | None:
    """Return rate and range of the strongest one who breathes at rest; None if there is none.

    Nobody there, somebody who walks or moves much, and a movement that is not periodic between 6
    and 40 per minute give None. See the module's docstring for what is computed.

    Parameters
    ----------
    iq
        Shape (n_frames, n_bins), complex, clutter included; 60 s are usual, 20 s the least.
        RF frames are downconverted first.
    ranges_m
        Shape (n_bins,).
    frame_rate_hz
        At least 4; frames are taken at equal intervals.
    carrier_hz
        For lengths from phases.

    Raises
    ------
    ValueError
        For arrays that do not fit each other, fewer frames than 20 s, a rate that is too low, or
        frames with a NaN.
    """
    return next(iter(breathing_rates(iq, ranges_m, frame_rate_hz, carrier_hz=carrier_hz)), None)


def breathing_rates(
    iq: ArrayLike,
    ranges_m: ArrayLike,
    frame_rate_hz: float,
    *,
    carrier_hz: float = CARRIER_HZ,
) -> Iterator[Breathing]:
    """Yield rate and range of each person who breathes at rest, the strongest echo first.

    The four strongest candidates are looked at, as the module's docstring defines them. The search
    ends at the first of them whose body moves, since its echo covers weaker ones; nothing is
    yielded if something passes. One person can be found twice: a second time at a longer range and
    the same rate, by an echo over a wall.

    Parameters
    ----------
    iq
        Shape (n_frames, n_bins), complex, clutter included; 60 s are usual, 20 s the least.
    ranges_m
        Shape (n_bins,).
    frame_rate_hz
        At least 4; frames are taken at equal intervals.
    carrier_hz
        For lengths from phases.

    Yields
    ------
    Each person's rate, confidence and range; nothing where `breathing_rate` returns None.

    Raises
    ------
    ValueError
        When the first one is asked for, as of `breathing_rate`.
    """
    frames, ranges = checked(iq, ranges_m)
    if frame_rate_hz < 2 * _HIGHEST_HZ:
        raise ValueError(f"{frame_rate_hz:g} frames/s: breathing needs at least 4")
    if len(frames) < SHORTEST_S * frame_rate_hz:
        raise ValueError(
            f"{len(frames)} frames at {frame_rate_hz:g} frames/s: breathing needs {SHORTEST_S:g} s"
        )
    unsmoothed = frames
    frames = _smoothed(frames, round(frame_rate_hz / (2 * _HIGHEST_HZ)))
    wavelength_m = SPEED_OF_LIGHT_MPS / carrier_hz
    power, frequency = _spectrum(frames, frame_rate_hz)
    if _passing_share(frames, round(_BLOCK_S * frame_rate_hz)) > _PASSING:
        return
    candidates = _candidates(power, frequency)
    nobody = True
    for bin_index, rate_hz, confidence in _of_candidates(
        frames, candidates, frame_rate_hz, wavelength_m
    ):
        nobody = False
        if not _is_alias(unsmoothed[:, bin_index : bin_index + 1], rate_hz, frame_rate_hz):
            yield Breathing(
                rate_bpm=60 * rate_hz, confidence=confidence, range_m=float(ranges[bin_index])
            )
    if nobody and all(weak for _, weak in candidates):
        faint = _of_line(frames, unsmoothed, ranges, frame_rate_hz)
        if faint is not None:
            yield faint


def _of_candidates(
    frames: NDArray[np.complex128],
    candidates: list[tuple[int, bool]],
    frame_rate_hz: float,
    wavelength_m: float,
) -> Iterator[tuple[int, float, float]]:
    """Yield bin, rate [Hz] and confidence of candidates, to the first whose body moves."""
    for bin_index, weak in candidates:
        echo = _echo_near(frames, bin_index)
        velocity_mps, rests = _velocity(echo, frame_rate_hz, wavelength_m)
        if weak and rests.mean() < _LEAST_REST:
            velocity_mps, rests = _velocity_of_line(echo, frame_rate_hz, wavelength_m)
        low, high = np.percentile(np.cumsum(velocity_mps) / frame_rate_hz, (5, 95))
        if high - low > _LONGEST_TRAVEL_M or rests.mean() < _LEAST_REST:
            return
        found = _periodicity(velocity_mps, frame_rate_hz)
        if found is not None and found[1] >= LEAST_CONFIDENCE:
            yield bin_index, *found


def _is_alias(of_bin: NDArray[np.complex128], rate_hz: float, frame_rate_hz: float) -> bool:
    """Return whether frames of a bin, shape (n_frames, 1), hold a stronger line above 2 Hz."""
    power, frequency = _spectrum(of_bin, frame_rate_hz)
    own = power[np.abs(frequency - rate_hz) <= _LINE_HZ]
    return bool(power[frequency > _HIGHEST_HZ].max(initial=0.0) > own.max(initial=0.0))


def _smoothed(frames: NDArray[np.complex128], width: int) -> NDArray[np.complex128]:
    """Return the mean of each ``width`` neighbouring frames."""
    if width < 2:
        return frames
    sums = np.cumsum(frames, axis=0)
    sums[width:] -= sums[:-width].copy()
    return sums[width - 1 :] / width


def _spectrum(
    frames: NDArray[np.complex128], frame_rate_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return power, shape (n_frequencies, n_bins), of what moves, and the absolute frequencies."""
    found = range_doppler(frames - frames.mean(axis=0), frame_rate_hz)
    return found.power, np.abs(found.frequencies_hz)


def _passing_share(frames: NDArray[np.complex128], block: int) -> float:
    """Return the share of movement that is in bins where something is for a short time only."""
    deviation = frames - frames.mean(axis=0)
    power = deviation.real**2 + deviation.imag**2
    blocks = power[: len(power) // block * block].reshape(-1, block, power.shape[1]).mean(axis=1)
    moving = blocks[:, blocks.mean(axis=0) > _LEAST_EXCESS * np.median(blocks)]
    mean = moving.mean(axis=0)
    duty = mean**2 / np.maximum((moving**2).mean(axis=0), np.finfo(np.float64).tiny)
    return float(mean[duty < _LEAST_DUTY].sum() / max(mean.sum(), np.finfo(np.float64).tiny))


def _candidates(
    of_frequencies: NDArray[np.float64], frequency: NDArray[np.float64]
) -> list[tuple[int, bool]]:
    """Return bins of most power at breathing's frequencies, strongest first, and which are weak."""
    band = (frequency >= SLOWEST_BPM / 60) & (frequency <= FASTEST_BPM / 60)
    power = of_frequencies[band].sum(axis=0)
    padded = np.concatenate([[0.0], power, [0.0]])
    is_peak = (power >= padded[:-2]) & (power > padded[2:])
    excess = power / max(float(np.median(power)), np.finfo(np.float64).tiny)
    peaks = np.flatnonzero(is_peak & (excess > _LEAST_EXCESS))
    strongest = peaks[np.argsort(-power[peaks])][:_CANDIDATES]
    return [(int(peak), bool(excess[peak] < _WEAK_EXCESS)) for peak in strongest]


def _echo_near(frames: NDArray[np.complex128], bin_index: int) -> NDArray[np.complex128]:
    """Return the sum of the bins about one, weighted by how they move, shape (n_frames,)."""
    block = frames[:, max(bin_index - _NEIGHBOURS, 0) : bin_index + _NEIGHBOURS + 1]
    moving = block - block.mean(axis=0)
    _, vectors = np.linalg.eigh(moving.conj().T @ moving)
    return np.asarray(block @ vectors[:, -1], dtype=np.complex128)


def _velocity(
    echo: NDArray[np.complex128], frame_rate_hz: float, wavelength_m: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return velocity towards the radar, 0 while the body moves, and whether it rests."""
    arm = echo - circle_centre(echo)
    radius = np.abs(arm)
    on_circle = np.abs(radius / np.median(radius) - 1) < _OFF_CIRCLE
    step_rad = np.angle(arm[1:] * arm[:-1].conj())
    velocity_mps = step_rad * (wavelength_m / (4 * math.pi) * frame_rate_hz)
    return _resting(velocity_mps, on_circle[1:] & on_circle[:-1], frame_rate_hz)


def _velocity_of_line(
    echo: NDArray[np.complex128], frame_rate_hz: float, wavelength_m: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the same of an echo too weak for a circle, from its largest component.

    Only proportional to the velocity, because the radius is unknown: that of what stands is taken.
    """
    deviation = echo - echo.mean()
    along = deviation * np.exp(-0.5j * np.angle((deviation**2).mean()))
    step_rad = np.diff(along.real) / max(abs(complex(echo.mean())), np.finfo(np.float64).tiny)
    velocity_mps = step_rad * (wavelength_m / (4 * math.pi) * frame_rate_hz)
    return _resting(velocity_mps, np.ones(len(velocity_mps), dtype=np.bool_), frame_rate_hz)


def _resting(
    velocity_mps: NDArray[np.float64], on_circle: NDArray[np.bool_], frame_rate_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    speed_mps = np.abs(velocity_mps)
    fastest_mps = min(_FASTEST_CHEST_MPS, _FASTER_THAN_USUAL * float(np.percentile(speed_mps, 75)))
    around = np.ones(2 * round(_AROUND_S * frame_rate_hz) + 1)
    rests = np.convolve(~on_circle | (speed_mps > fastest_mps), around, mode="same") < 0.5
    return np.where(rests, velocity_mps, 0.0), rests


def _periodicity(
    velocity_mps: NDArray[np.float64], frame_rate_hz: float
) -> tuple[float, float] | None:
    """Return frequency and confidence of what moves periodically, or None."""
    length = 8 * len(velocity_mps)
    weighted = (velocity_mps - velocity_mps.mean()) * hann(len(velocity_mps))
    frequency = np.asarray(np.fft.rfftfreq(length, 1 / frame_rate_hz), dtype=np.float64)
    power = np.abs(np.fft.rfft(weighted, length)) ** 2 / np.maximum(frequency, frequency[1])
    peak = _highest(power, frequency)
    if peak is None or power[peak] < power[frequency < _HIGHEST_HZ].max():
        return None
    # of the displacement: power over frequency squared
    half = _highest(power[: round(0.6 * peak)], frequency[: round(0.6 * peak)])
    if half is not None and abs(half / peak - 0.5) < 0.05 and 2 * power[half] > power[peak]:
        peak = half
    rate_hz = _mean_rate_hz(velocity_mps, float(frequency[peak]), frame_rate_hz)
    heard = (frequency > 0.5 * SLOWEST_BPM / 60) & (frequency < _HIGHEST_HZ)
    near = _near_harmonics(frequency, rate_hz, len(velocity_mps) / frame_rate_hz)
    return rate_hz, float(power[heard & near].sum() / power[heard].sum())


def _of_line(
    frames: NDArray[np.complex128],
    unsmoothed: NDArray[np.complex128],
    ranges: NDArray[np.float64],
    frame_rate_hz: float,
) -> Breathing | None:
    """Return who breathes behind an echo that is seen as a spectral line only, or None."""
    if frames.shape[1] < _FEWEST_BINS:
        return None
    lines, line_hz = _over_median(*_spectrum(frames, frame_rate_hz))
    in_band = (line_hz >= SLOWEST_BPM / 60) & (line_hz <= FASTEST_BPM / 60)
    # the window and the pulse reach over two cells at least
    wide = (lines[:-1, :-1] + lines[:-1, 1:] + lines[1:, :-1] + lines[1:, 1:]) / 4
    wide[~in_band[:-1]] = 0.0
    row, column = np.unravel_index(int(np.argmax(wide)), wide.shape)
    if wide[row, column] < _LEAST_LINE:
        return None
    bin_index = int(column + (lines[row, column + 1] > lines[row, column]))
    velocity = _along_line(frames, bin_index, float(line_hz[row]), frame_rate_hz)
    found = _periodicity_in_noise(
        velocity, _noise_of_component(np.diff(frames, axis=0)), frame_rate_hz
    )
    if found is None or found[1] < LEAST_CONFIDENCE:
        return None
    rate_hz, confidence = found
    if not SLOWEST_BPM <= 60 * rate_hz <= FASTEST_BPM:
        return None
    # a fan's fundamental, or a curtain's, of which the line is an alias or a harmonic
    lines, line_hz = _over_median(*_spectrum(unsmoothed, frame_rate_hz))
    here = lines[:, max(bin_index - 1, 0) : bin_index + 2].mean(axis=1)
    here, line_hz = (here[:-1] + here[1:]) / 2, line_hz[:-1]
    own = _near_harmonics(line_hz, rate_hz, len(unsmoothed) / frame_rate_hz)
    others = here[~own & (line_hz > _SLOWEST_HZ)].max(initial=0.0)
    if others > _OTHER_LINES * here[own].max(initial=0.0):
        return None
    return Breathing(rate_bpm=60 * rate_hz, confidence=confidence, range_m=float(ranges[bin_index]))


def _over_median(
    power: NDArray[np.float64], frequency: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return power at +-f over its median over range, shape (n, n_bins), and f > 0, rising."""
    zero = int(np.argmin(frequency))
    count = min(zero, len(power) - 1 - zero)
    both = power[zero + 1 : zero + 1 + count] + power[zero - count : zero][::-1]
    median = np.median(both, axis=1, keepdims=True)
    rising = frequency[zero + 1 : zero + 1 + count]
    return both / np.maximum(median, np.finfo(np.float64).tiny), rising


def _along_line(
    frames: NDArray[np.complex128], bin_index: int, line_hz: float, frame_rate_hz: float
) -> NDArray[np.float64]:
    """Return the steps of the largest component of what moves at a frequency, about a bin."""
    block = frames[:, max(bin_index - _NEIGHBOURS, 0) : bin_index + _NEIGHBOURS + 1]
    window = hann(len(block))[:, np.newaxis]
    spectrum = np.fft.fft((block - block.mean(axis=0)) * window, axis=0)
    offset_hz = np.abs(np.abs(np.fft.fftfreq(len(block), 1 / frame_rate_hz)) - line_hz)
    at_line = np.where((offset_hz <= _LINE_HZ)[:, np.newaxis], spectrum, 0.0)
    _, vectors = np.linalg.eigh(at_line.conj().T @ at_line)
    weights = vectors[:, -1]
    narrow = np.fft.ifft(at_line @ weights)
    turn = np.exp(-0.5j * np.angle((narrow**2).mean()))
    return np.asarray(np.diff((block @ weights * turn).real))


def _noise_of_component(steps: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return the spectrum of noise in one component of a bin, by the median over bins.

    Of the same window and length as in `_periodicity_in_noise`, the mean of 25 neighbours.
    """
    length = 8 * len(steps)
    spectrum = np.fft.fft((steps - steps.mean(axis=0)) * hann(len(steps))[:, None], length, axis=0)
    power = spectrum.real**2 + spectrum.imag**2
    both = power[: length // 2 + 1] + power[-np.arange(length // 2 + 1)]
    median = np.median(both, axis=1) / (4 * _MEDIAN_OF_MEAN)
    return np.convolve(median, np.ones(25) / 25, mode="same")


def _periodicity_in_noise(
    steps: NDArray[np.float64], noise: NDArray[np.float64], frame_rate_hz: float
) -> tuple[float, float] | None:
    """Return the same as `_periodicity`, of a component with noise of this spectrum."""
    length = 8 * len(steps)
    frequency = np.asarray(np.fft.rfftfreq(length, 1 / frame_rate_hz), dtype=np.float64)
    weighted = (steps - steps.mean()) * hann(len(steps))
    power = np.abs(np.fft.rfft(weighted, length)) ** 2
    ratio = power / np.maximum(noise, np.finfo(np.float64).tiny)
    heard = (frequency > 0.5 * SLOWEST_BPM / 60) & (frequency < _HIGHEST_HZ)
    peak = _highest(ratio, frequency)
    if peak is None or ratio[peak] < ratio[heard].max():
        return None
    half = round(0.45 * peak) + int(np.argmax(ratio[round(0.45 * peak) : round(0.55 * peak) + 1]))
    slow_enough = frequency[half] >= SLOWEST_BPM / 60
    # of the displacement: power over frequency squared
    if slow_enough and ratio[half] > _LEAST_LINE and 4 * power[half] > power[peak]:
        peak = half
    if ratio[peak] < _LEAST_LINE:
        return None
    rate_hz = _mean_rate_hz(steps, float(frequency[peak]), frame_rate_hz)
    near = heard & _near_harmonics(frequency, rate_hz, len(steps) / frame_rate_hz)
    without_noise = (power - noise) / np.maximum(frequency, frequency[1])
    moving = max(float(without_noise[heard].sum()), np.finfo(np.float64).tiny)
    return rate_hz, min(float(without_noise[near].sum()) / moving, 1.0)


def _near_harmonics(
    frequency: NDArray[np.float64], rate_hz: float, window_s: float
) -> NDArray[np.bool_]:
    near = np.zeros(len(frequency), dtype=np.bool_)
    for harmonic in range(1, _HARMONICS + 1):
        near |= np.abs(frequency - harmonic * rate_hz) < 2 / window_s + 0.1 * rate_hz
    return near


def _mean_rate_hz(
    velocity_mps: NDArray[np.float64], about_hz: float, frame_rate_hz: float
) -> float:
    """Return the mean frequency of an oscillation: the turns of its phase, over time."""
    count = len(velocity_mps)
    turned = velocity_mps * np.exp(-2j * np.pi * about_hz * np.arange(count) / frame_rate_hz)
    width = min(round(2 * frame_rate_hz / about_hz), count // 2)
    kernel = hann(width + 1)[1:]
    slow = np.convolve(turned, kernel, mode="same")
    phase = np.unwrap(np.angle(slow))
    return about_hz + float(phase[-1] - phase[0]) / (2 * np.pi) * frame_rate_hz / (count - 1)


def _highest(power: NDArray[np.float64], frequency: NDArray[np.float64]) -> int | None:
    """Return the highest local maximum at breathing's frequencies, or None."""
    middle = power[1:-1]
    is_peak = (middle >= power[:-2]) & (middle > power[2:])
    in_band = (frequency >= SLOWEST_BPM / 60) & (frequency <= FASTEST_BPM / 60)
    peaks = 1 + np.flatnonzero(is_peak & in_band[1:-1])
    return int(peaks[np.argmax(power[peaks])]) if len(peaks) else None


class BreathingMonitor(Monitor[Breathing | None]):
    """Breathing from frames as they come: `breathing_rate` of the newest window.

    Parameters
    ----------
    ranges_m, frame_rate_hz, carrier_hz
        As of `breathing_rate`.
    window_s
        Seconds that are looked back on.
    every_s
        Seconds from one answer to the next.
    """

    def __init__(
        self,
        ranges_m: ArrayLike,
        frame_rate_hz: float,
        *,
        window_s: float = 60.0,
        every_s: float = 1.0,
        carrier_hz: float = CARRIER_HZ,
    ) -> None:
        if window_s < SHORTEST_S:
            raise ValueError(f"window_s {window_s:g}: must be at least {SHORTEST_S:g}")
        compute = partial(breathing_rate, carrier_hz=carrier_hz)
        super().__init__(compute, ranges_m, frame_rate_hz, window_s=window_s, every_s=every_s)

    @property
    def breathing(self) -> Breathing | None:
        """The latest answer: None until the window is full, and while there is none."""
        return self.newest
