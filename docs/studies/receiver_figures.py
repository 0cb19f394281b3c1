"""Measure noise, jitter, leakage and pulse of real X4 modules from baseband recordings of them.

The table holds what `like` in a scene's tables sets (`RECORDED` of `emulator.scene.scene`). The
recordings were made for something else, and somebody moves in them: noise, jitter and leakage are
those of the quietest stretch, and are upper bounds; the pulse is that of what moves.
"""

import argparse
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from xethru_protocol import load
from xethru_protocol.processing.downconversion import CHANNELS, DECIMATION, TAP_COUNT
from xethru_protocol.wire.x4 import CARRIER_HZ, SAMPLING_RATE_HZ

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

SPEED_OF_LIGHT_MPS = 299_792_458.0
TAPS = CHANNELS[3]
FILTER = (np.array(TAPS.i_taps) - 1j * np.array(TAPS.q_taps)) / TAPS.absolute_sum
CARRIER = CARRIER_HZ[3]
SIGMA_S = math.sqrt(math.log(10)) / (math.pi * 1.4e9)  # of the nominal pulse

STRETCH = 64  # frames: 3.8 s
FAR = slice(-20, None)  # bins taken for empty
LEAKAGE_BINS = 13  # 0.62 m behind the strongest
LAG = 40  # frames between two of which the difference shows what moved
PULSE_LAGS = 4  # bins
PARTS = 3  # of a recording, and of its bins, whose pulses are compared


class Figures(NamedTuple):
    """What a recording shows; amplitudes in normalised units of RF samples."""

    pulses: float | None  # iterations x pulses per step / 2**step; None if values show no lattice
    noise: float
    white_rad: float
    phase_rad: float
    amplitude_white: float
    amplitude: float
    leakage: float
    ringing: float
    ringing_m: float
    ringing_error_db: float  # root mean square, behind 0.15 m
    carrier_offset_hz: tuple[float, float]  # median and spread over parts of the recording
    width: tuple[float, float]


def measure(path: Path) -> Figures:
    """Return the figures of a recording of one module at 7.29 GHz, in any format of `load`."""
    iq = load(path).iq
    if iq is None or len(iq) < 2 * STRETCH:
        raise SystemExit(f"{path}: at least {2 * STRETCH} baseband frames are needed")
    return figures_of(iq)


def figures_of(iq: NDArray[np.complex64]) -> Figures:
    """Return the figures of baseband frames, shape (n_frames, n_bins), as the module sent them."""
    frames = iq.astype(np.complex128)
    quiet = quietest(frames)
    strongest = quiet[:, int(np.argmax(np.abs(quiet).mean(axis=0)))]
    phase, amplitude = np.unwrap(np.angle(strongest)), np.abs(strongest)
    amplitude /= amplitude.mean()
    far = quiet[:, FAR]
    # of noise that is white over RF samples, one component of a baseband value
    gain = math.sqrt(float((FILTER.real**2).sum()))
    offsets, widths = pulses_of_what_moves(frames)
    profile = np.abs(quiet.mean(axis=0))[:LEAKAGE_BINS]
    leakage, ringing, ringing_m, error_db = leakage_of(
        profile, float(np.median(offsets)), float(np.median(widths))
    )
    return Figures(
        pulses=pulses_of_lattice(np.concatenate([iq.real.ravel(), iq.imag.ravel()])),
        noise=math.hypot(white(far.real), white(far.imag)) / math.sqrt(2) / gain,
        white_rad=white(phase),
        phase_rad=float(phase.std()),
        amplitude_white=white(amplitude),
        amplitude=float(amplitude.std()),
        leakage=leakage,
        ringing=ringing,
        ringing_m=ringing_m,
        ringing_error_db=error_db,
        carrier_offset_hz=median_and_spread(offsets),
        width=median_and_spread(widths),
    )


def white(values: Array) -> float:
    """Return the deviation of the part that is new with every frame, from second differences."""
    return float(np.sqrt((np.diff(values, 2, axis=0) ** 2).mean() / 6))


def quietest(frames: Complex) -> Complex:
    """Return the stretch of frames whose far bins change least."""
    power = (np.abs(np.diff(frames[:, FAR], 2, axis=0)) ** 2).mean(axis=1)
    start = int(np.argmin(np.convolve(power, np.ones(STRETCH - 2), mode="valid")))
    return frames[start : start + STRETCH]


def pulses_of_lattice(values: NDArray[np.float32]) -> float | None:
    """Return iterations x pulses per step / 2**step, if values are whole counts of such a sweep.

    A baseband value is a whole number times 2**step / (iterations pulses) / 1024 / S (protocol
    reference 9.7). Small values are exact enough to try every number of pulses.
    """
    small = values[np.abs(values) < 1e-4].astype(np.float64)[:2000]
    unit = 1 / (1024 * TAPS.absolute_sum)
    for pulses in range(1, 20_000):
        counts = small * pulses / unit
        if np.abs(counts - np.rint(counts)).mean() < 0.01:
            return float(pulses)
    return None


def pulses_of_what_moves(frames: Complex) -> tuple[Array, Array]:
    """Return offset of the carrier [Hz] and width of pulses, of parts of a recording.

    Echoes of what moves lie anywhere, so over many frames the correlation of a difference of
    frames from bin to bin is that of one pulse behind the module's filter. A Gaussian's is fitted.
    """
    moved = frames[LAG:] - frames[:-LAG]
    around = np.ones(LAG + 1)
    found = []
    for bins in np.array_split(moved, PARTS, axis=1):
        # what moves little counts as much; over many frames, as the level of a frame by itself
        # depends on its correlation
        power = np.convolve((np.abs(bins) ** 2).mean(axis=1), around, "same")
        power /= np.convolve(np.ones(len(bins)), around, "same")
        even = bins / np.sqrt(power)[:, np.newaxis]
        even /= np.sqrt((np.abs(even) ** 2).mean(axis=0))  # what is far is weaker
        n = even.shape[1]
        for some in np.array_split(even, PARTS):
            products = [some[:, lag:] * some[:, : n - lag].conj() for lag in range(PULSE_LAGS)]
            correlation = np.array([each.mean() for each in products])
            found.append(fitted_pulse(correlation / correlation[0].real))
    offsets, widths = np.array(found).T
    return offsets, widths


def fitted_pulse(correlation: Complex) -> tuple[float, float]:
    frequency = np.linspace(-0.5, 0.5, 801) * SAMPLING_RATE_HZ / DECIMATION
    taps = np.arange(TAP_COUNT)
    at = (CARRIER + frequency)[:, np.newaxis] / SAMPLING_RATE_HZ
    passed = np.abs(np.exp(2j * np.pi * at * taps) @ FILTER) ** 2
    lags = np.arange(PULSE_LAGS)[:, np.newaxis] * DECIMATION / SAMPLING_RATE_HZ
    waves = np.exp(2j * np.pi * frequency * lags)

    def misfit(parameters: Array) -> Array:
        offset, width = parameters[0] * 1e9, parameters[1]
        density = passed * np.exp(-((2 * np.pi * (frequency - offset) * width * SIGMA_S) ** 2))
        expected = waves @ density
        difference = expected / expected[0].real - correlation
        return np.concatenate([difference.real, difference.imag])

    offset, width = least_squares(misfit, [0.0, 1.0]).x
    return float(offset) * 1e9, float(width)


def leakage_of(profile: Array, offset_hz: float, width: float) -> tuple[float, float, float, float]:
    """Return amplitude, ringing, its decay [m] and its misfit [dB] from the static first bins.

    The pulse is taken to lie on the strongest bin. What else stands in the first 0.6 m of the room
    is part of it, so ringing is an upper bound.
    """
    first = int(np.argmax(profile))
    heard = 20 * np.log10(profile[first:] / profile[first])

    def law(ringing: float, ringing_m: float) -> Array:
        sigma_m = SIGMA_S * SPEED_OF_LIGHT_MPS / 2
        behind = np.concatenate([[0.0], (np.arange(80) + 0.5) * sigma_m])
        share = ringing / math.sqrt(2 * math.pi) * np.exp(-behind / ringing_m)
        share[0] = 1.0
        samples = np.arange(-TAPS.centre, DECIMATION * len(heard) + TAP_COUNT) / SAMPLING_RATE_HZ
        late = samples[:, np.newaxis] - 2 * behind / SPEED_OF_LIGHT_MPS
        bell = np.exp(-0.5 * (late / (width * SIGMA_S)) ** 2) @ share
        rf = bell * np.cos(2 * np.pi * (CARRIER + offset_hz) * samples)
        starts = DECIMATION * np.arange(len(heard))
        return np.array([abs(FILTER @ rf[at : at + TAP_COUNT]) for at in starts])

    def misfit(parameters: Array) -> Array:
        expected = law(*np.exp(parameters))
        return np.asarray((20 * np.log10(expected / expected[0]) - heard)[1:])

    starts = [np.log([ringing, 0.25]) for ringing in (0.2, 0.6)]
    fits = [least_squares(misfit, start, loss="soft_l1", f_scale=2.0) for start in starts]
    best = min(fits, key=lambda fit: float(fit.cost))
    ringing, ringing_m = np.exp(best.x)
    behind = misfit(best.x)[2:]  # from 0.15 m on
    error_db = float(np.sqrt((behind**2).mean()))
    return float(profile[first] / law(ringing, ringing_m)[0]), ringing, ringing_m, error_db


def median_and_spread(values: Array) -> tuple[float, float]:
    """Return the median, and 1.48 times the median distance from it."""
    median = float(np.median(values))
    return median, 1.48 * float(np.median(np.abs(values - median)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING")
    for path in parser.parse_args().recordings:
        print(path)
        for name, value in measure(path)._asdict().items():
            numbers = value if isinstance(value, tuple) else (value,)
            shown = " +- ".join("unknown" if one is None else f"{one:.3g}" for one in numbers)
            print(f"  {name:18} {shown}")


if __name__ == "__main__":
    main()
