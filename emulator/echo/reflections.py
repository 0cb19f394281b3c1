"""Paths from a radar to reflectors and back, and frames made of the pulses that return.

How long, how strong and in which phase a path is: formulas and sources are on the model page,
``emulator.echo.echo``.

One pulse is ``A exp(-(t - tau)**2 / (2 sigma**2)) cos(2 pi fc (t - tau) + phase)``: a Gaussian
envelope on a carrier, sampled at 23.328 GHz. The carrier is an exact fraction of the sampling
rate, 5/16 or 3/8 (protocol reference 9.2). The -10 dB bandwidth of 1.4 GHz is assumed, as that
reference proposes; the real pulse is not symmetric and rings a little, which is left out.

Arithmetic is float64 additions and multiplications per sample; cosines are taken once per pulse.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from emulator.scene.motion import (
    AMPLITUDE_OF_1_M2,
    PersonSpec,
    chest_displacement_m,
    positions_m,
    present,
)
from emulator.scene.scene import RadarSpec, TargetSpec
from xethru_protocol.wire.x4 import CARRIER_HZ, SAMPLING_RATE_HZ

BANDWIDTH_HZ = 1.4e9
"""Full width of the power spectrum at -10 dB."""
SIGMA_S = math.sqrt(math.log(10)) / (math.pi * BANDWIDTH_HZ)
"""Envelope's standard deviation in time: the spectrum exp(-(2 pi f sigma)**2) is 0.1 at B/2."""
CARRIER_CYCLES_PER_SAMPLE = {
    setting: (Fraction(carrier_hz) / Fraction(SAMPLING_RATE_HZ)).as_integer_ratio()
    for setting, carrier_hz in CARRIER_HZ.items()
}
"""TX centre frequency setting -> carrier / sampling rate as a fraction: 7.290 and 8.748 GHz."""

BEAM_EXPONENT = math.log(math.sqrt(0.5)) / math.log(math.cos(math.radians(65 / 2)))
"""n of the two-way amplitude pattern cos(angle)**n: 2.0354."""
NEAREST_M = 0.05
"""Amplitude laws are held from here inwards."""
_RANGE_EXPONENT = {"rod": 1.5, "point": 2.0, "cylinder": 1.0}

_SIGMA_SAMPLES = SIGMA_S * SAMPLING_RATE_HZ
HALF_WINDOW = math.ceil(6 * _SIGMA_SAMPLES)
"""Samples evaluated on either side of a pulse; beyond, it is below 1.6e-8 of its amplitude."""

_OFFSETS = np.arange(-HALF_WINDOW, HALF_WINDOW + 1)
_SHIFT_ORDER = 5
_PULSES_AT_ONCE = 128


def _envelope_series() -> list[NDArray[np.float64]]:
    """Return the coefficients of the envelope's Taylor series in the shift, in samples.

    ``exp(-(x - h)**2 / 2) = sum_k He_k(x) h**k / k! exp(-x**2 / 2)`` with the probabilists'
    Hermite polynomials. For half a sample, h = 0.062, order 5 leaves 2e-9 of the amplitude.
    """
    x = _OFFSETS / _SIGMA_SAMPLES
    hermite = [np.ones_like(x), x]
    for k in range(1, _SHIFT_ORDER):
        hermite.append(x * hermite[k] - k * hermite[k - 1])
    bell = np.exp(-0.5 * x * x)
    return [
        polynomial * bell / (math.factorial(k) * _SIGMA_SAMPLES**k)
        for k, polynomial in enumerate(hermite)
    ]


_ENVELOPE = _envelope_series()


def _carrier(cycles: int, samples: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return cosine and sine of the carrier at whole samples; the phase is reduced in integers."""
    phase_rad = math.tau * ((cycles * _OFFSETS) % samples) / samples
    return np.cos(phase_rad), np.sin(phase_rad)


_CARRIER = {setting: _carrier(*ratio) for setting, ratio in CARRIER_CYCLES_PER_SAMPLE.items()}


def sum_of_pulses(
    *,
    frame: NDArray[np.int64],
    position: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    phase_rad: NDArray[np.float64],
    tx_center_frequency: int,
    shape: tuple[int, int],
) -> NDArray[np.float64]:
    """Return frames that are sums of pulses, of a shape (n_frames, n_samples), float64.

    Parameters
    ----------
    frame
        Shape (p,), int64, ascending: the frame each pulse belongs to. Pulses of one frame are added
        in the order given, so a frame's rounding does not depend on the other frames.
    position
        Shape (p,), float64: where the pulse is centred, in samples from the frame's first; any
        real number, also outside the frame.
    amplitude
        Shape (p,), float64: peak of the envelope.
    phase_rad
        Shape (p,), float64: phase of the carrier at the pulse's centre.
    """
    n_frames, n_samples = shape
    # Half a window of padding on either side takes every pulse that reaches into the frame.
    touches = (position > -HALF_WINDOW) & (position < n_samples - 1 + HALF_WINDOW)
    frame, position = frame[touches], position[touches]
    amplitude, phase_rad = amplitude[touches], phase_rad[touches]

    # floor, not rint: ties must fall alike for odd and even bins, so that a shift is exact.
    nearest = np.floor(position + 0.5)
    shift = position - nearest
    cycles, samples = CARRIER_CYCLES_PER_SAMPLE[tx_center_frequency]
    centre_phase = phase_rad - math.tau * cycles / samples * shift
    in_phase, quadrature = amplitude * np.cos(centre_phase), amplitude * np.sin(centre_phase)
    first = nearest.astype(np.int64) + 2 * HALF_WINDOW

    width = n_samples + 4 * HALF_WINDOW
    padded = np.empty((n_frames, width))
    # whole frames at a time: what is added stays in the processor's cache, a block does not
    ends = np.searchsorted(frame, np.arange(1, n_frames + 1)).tolist()
    begin = done = 0
    for n_done, end in enumerate(ends, 1):
        if end - begin < _PULSES_AT_ONCE and n_done < n_frames:
            continue
        part = slice(begin, end)
        bins = ((frame[part] - done) * width + first[part])[:, np.newaxis] + _OFFSETS
        waves = _waves(shift[part], in_phase[part], quadrature[part], tx_center_frequency)
        padded[done:n_done] = np.bincount(
            bins.ravel(), weights=waves.ravel(), minlength=(n_done - done) * width
        ).reshape(-1, width)
        begin, done = end, n_done
    return padded[:, 2 * HALF_WINDOW : 2 * HALF_WINDOW + n_samples]


def _waves(
    shift: NDArray[np.float64],
    in_phase: NDArray[np.float64],
    quadrature: NDArray[np.float64],
    tx_center_frequency: int,
) -> NDArray[np.float64]:
    """Return pulses at `_OFFSETS` from their nearest samples, shape (p, 2 HALF_WINDOW + 1)."""
    h = shift[:, np.newaxis]
    wave = h * _ENVELOPE[-1]
    for coefficients in _ENVELOPE[-2:0:-1]:
        wave += coefficients
        wave *= h
    wave += _ENVELOPE[0]
    cosine, sine = _CARRIER[tx_center_frequency]
    carrier = in_phase[:, np.newaxis] * cosine
    carrier -= quadrature[:, np.newaxis] * sine
    wave *= carrier
    return wave


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reflections:
    """Paths from transmitter to receiver, frame by frame.

    Attributes
    ----------
    range_m
        Shape (n_frames, k), float64: half the path's length, true metres.
    amplitude
        Shape (n_frames, k), float64: of the envelope, normalised units, at TX power 2.
    phase_rad
        Shape (k,) or (n_frames, k), float64: carrier phase added by the reflection.
    """

    range_m: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    phase_rad: NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scatterers:
    """Reflectors that send an echo everywhere: points, rods, cylinders, people.

    Arrays have the shape (k,), or (n_frames, k) for what moves; x and y are those of their axes,
    world frame.

    Attributes
    ----------
    strength
        Echo on boresight at 1 m, normalised units.
    exponent
        Shape (k,): the echo falls with range**-exponent; 2 for a point, 1.5 for a rod, 1 (and a
        factor of its own) for a cylinder.
    radius_m
        Shape (k,): of a cylinder; 0 for the others.
    swell_m
        How far the reflecting surface stands out towards the radar.
    phase_rad
        Shape (k,): carrier phase added by the reflection.
    """

    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    strength: NDArray[np.float64]
    exponent: NDArray[np.float64]
    radius_m: NDArray[np.float64]
    swell_m: NDArray[np.float64]
    phase_rad: NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Viewpoint:
    """A radar's phase centre and boresight (a unit vector): shape (n_frames, 1), world frame."""

    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    boresight_x: NDArray[np.float64]
    boresight_y: NDArray[np.float64]


def reflection_phase_rad(name: str) -> float:
    """Return the fixed reflection phase of a named reflector, in [0, 2 pi).

    >>> round(reflection_phase_rad("rod_01"), 6) == round(reflection_phase_rad("rod_02"), 6)
    False
    """
    fraction = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big") / 2**32
    return math.tau * fraction


def beam_gain(cos_angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the two-way amplitude pattern for cosines of the angle off boresight, any shape."""
    gain: NDArray[np.float64] = np.maximum(cos_angle, 0.0) ** BEAM_EXPONENT
    return gain


def viewpoint(radar: RadarSpec, robot_poses: NDArray[np.float64]) -> Viewpoint:
    """Return where a radar is, from robot poses (x [m], y [m], heading [rad]) of shape (n, 3)."""
    x, y, heading = robot_poses.T[:, :, np.newaxis]
    cosine, sine = np.cos(heading), np.sin(heading)
    yaw_rad = math.radians(radar.yaw_deg)
    return Viewpoint(
        x_m=x + cosine * radar.x_m - sine * radar.y_m,
        y_m=y + sine * radar.x_m + cosine * radar.y_m,
        boresight_x=cosine * math.cos(yaw_rad) - sine * math.sin(yaw_rad),
        boresight_y=sine * math.cos(yaw_rad) + cosine * math.sin(yaw_rad),
    )


def target_scatterers(targets: tuple[TargetSpec, ...]) -> Scatterers:
    """Return targets as arrays of shape (k,)."""
    radius_m = np.array([target.radius_m for target in targets])
    return Scatterers(
        x_m=np.array([target.x_m for target in targets]),
        y_m=np.array([target.y_m for target in targets]),
        strength=np.array([target.amplitude_1m for target in targets]),
        exponent=np.array([_RANGE_EXPONENT[target.kind] for target in targets]),
        radius_m=radius_m,
        swell_m=radius_m,
        phase_rad=np.array([reflection_phase_rad(target.name) for target in targets]),
    )


def person_scatterer(person: PersonSpec, t_ns: NDArray[np.int64]) -> Scatterers:
    """Return a person at scene times of shape (n_frames,), int64: k = 1."""
    position = positions_m(person, t_ns)
    strength = AMPLITUDE_OF_1_M2 * math.sqrt(person.rcs_m2)
    return Scatterers(
        x_m=position[:, :1],
        y_m=position[:, 1:],
        strength=np.where(present(person, t_ns), strength, 0.0)[:, np.newaxis],
        exponent=np.array([_RANGE_EXPONENT["point"]]),
        radius_m=np.array([0.0]),
        swell_m=chest_displacement_m(person, t_ns)[:, np.newaxis],
        phase_rad=np.array([reflection_phase_rad(person.name)]),
    )


def direct_reflections(scatterers: Scatterers, view: Viewpoint) -> Reflections:
    """Return the echoes by the straight way there and back; nothing stands in between."""
    dx = scatterers.x_m - view.x_m
    dy = scatterers.y_m - view.y_m
    range_m = np.sqrt(dx * dx + dy * dy)
    near_m = np.maximum(range_m, NEAREST_M)
    cos_angle = (dx * view.boresight_x + dy * view.boresight_y) / near_m
    surface_m = near_m
    round_ones = scatterers.radius_m > 0
    strength = scatterers.strength
    if round_ones.any():
        radius_m = scatterers.radius_m
        surface_m = np.maximum(range_m - radius_m, NEAREST_M)
        # Its mirror image is nearer the smaller the radius; inside it, nothing is received.
        spread = np.sqrt((1 + radius_m) / (surface_m + radius_m)) * (range_m > radius_m)
        strength = strength * np.where(round_ones, spread, 1.0)
    return Reflections(
        range_m=range_m - scatterers.swell_m,
        amplitude=strength * surface_m**-scatterers.exponent * beam_gain(cos_angle),
        phase_rad=scatterers.phase_rad,
    )
