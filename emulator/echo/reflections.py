"""Paths from a radar to reflectors and back, and frames made of the pulses that return.

How long, how strong and in which phase a path is: formulas and sources are on the model page,
``emulator.echo.echo``.

One pulse is ``A exp(-(t - tau)**2 / (2 sigma**2)) cos(2 pi fc (t - tau) + phase)``: a Gaussian
envelope on a carrier, sampled at 23.328 GHz. The carrier is an exact fraction of the sampling
rate, 5/16 or 3/8 (protocol reference 9.2). The -10 dB bandwidth of 1.4 GHz is assumed, as that
reference proposes. `PulseShape` holds how a module's own pulse differs from that.

Arithmetic is float64 additions and multiplications per sample; cosines are taken once per pulse.
"""

from __future__ import annotations

import functools
import hashlib
import math
from dataclasses import dataclass, fields
from fractions import Fraction
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from emulator.scene.scene import AntennaSpec, PulseSpec, RadarSpec, TargetSpec
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
RANGE_EXPONENT = {"rod": 1.5, "point": 2.0, "cylinder": 1.0}
SPEED_OF_LIGHT_MPS = 299_792_458.0

_SIGMA_SAMPLES = SIGMA_S * SAMPLING_RATE_HZ
HALF_WINDOW = math.ceil(6 * _SIGMA_SAMPLES)
"""Samples evaluated on either side of a pulse; beyond, it is below 1.6e-8 of its amplitude."""

_SHIFT_ORDER = 5
_PULSES_AT_ONCE = 128


def _envelope_series() -> list[NDArray[np.float64]]:
    """Return the coefficients of the envelope's Taylor series in the shift, in samples.

    ``exp(-(x - h)**2 / 2) = sum_k He_k(x) h**k / k! exp(-x**2 / 2)`` with the probabilists'
    Hermite polynomials. For half a sample, h = 0.062, order 5 leaves 2e-9 of the amplitude.
    """
    x = np.arange(-HALF_WINDOW, HALF_WINDOW + 1) / _SIGMA_SAMPLES
    hermite = [np.ones_like(x), x]
    for k in range(1, _SHIFT_ORDER):
        hermite.append(x * hermite[k] - k * hermite[k - 1])
    bell = np.exp(-0.5 * x * x)
    return [
        polynomial * bell / (math.factorial(k) * _SIGMA_SAMPLES**k)
        for k, polynomial in enumerate(hermite)
    ]


_ENVELOPE = _envelope_series()

RINGING_SIGMAS = 3.2
"""How much later than the pulse its ringing copy comes, in the nominal pulse's sigma."""
RINGING_PHASE_RAD = 1.0
"""How far the carrier of the copy is ahead."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PulseShape:
    """The pulse of one module: standard deviations in those of the nominal one, and its ringing.

    The envelope is that of a Gaussian of ``before`` up to its peak and of ``after`` from there on;
    a copy of the whole, ``ringing`` times as strong, follows by ``RINGING_SIGMAS``.
    """

    before: float = 1.0
    after: float = 1.0
    ringing: float = 0.0

    @classmethod
    def of(cls, spec: PulseSpec) -> PulseShape:
        return cls(
            before=spec.width * (1 - spec.skew),
            after=spec.width * (1 + spec.skew),
            ringing=spec.ringing,
        )

    @property
    def half_window(self) -> int:
        """Samples evaluated on either side; beyond, it is below 1.6e-8 of its amplitude."""
        return math.ceil(6 * _SIGMA_SAMPLES * max(self.before, self.after))

    def envelope(self, shift: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the envelopes of pulses ``shift`` samples after a whole sample.

        Shape (p, 2 half_window + 1), without the ringing; ``shift`` has the shape (p, 1) and lies
        within +-0.5.
        """
        if self.before == self.after == 1.0:
            wave = shift * _ENVELOPE[-1]
            for coefficients in _ENVELOPE[-2:0:-1]:
                wave += coefficients
                wave *= shift
            wave += _ENVELOPE[0]
            return wave
        after_peak = _offsets(self.half_window) - shift
        after_peak /= _SIGMA_SAMPLES * np.where(after_peak < 0, self.before, self.after)
        bell: NDArray[np.float64] = np.exp(-0.5 * after_peak * after_peak)
        return bell


NOMINAL_PULSE = PulseShape()


def _offsets(half_window: int) -> NDArray[np.int64]:
    return np.arange(-half_window, half_window + 1)


@functools.cache
def _carrier(
    tx_center_frequency: int, half_window: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return cosine and sine of the carrier at whole samples; the phase is reduced in integers."""
    cycles, samples = CARRIER_CYCLES_PER_SAMPLE[tx_center_frequency]
    phase_rad = math.tau * ((cycles * _offsets(half_window)) % samples) / samples
    return np.cos(phase_rad), np.sin(phase_rad)


def sum_of_pulses(
    *,
    frame: NDArray[np.int64],
    position: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    phase_rad: NDArray[np.float64],
    tx_center_frequency: int,
    shape: tuple[int, int],
    pulse: PulseShape = NOMINAL_PULSE,
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
    half_window = pulse.half_window
    if pulse.ringing:
        frame = np.repeat(frame, 2)
        later = RINGING_SIGMAS * _SIGMA_SAMPLES
        position = np.column_stack([position, position + later]).ravel()
        amplitude = np.column_stack([amplitude, pulse.ringing * amplitude]).ravel()
        phase_rad = np.column_stack([phase_rad, phase_rad + RINGING_PHASE_RAD]).ravel()
    # Half a window of padding on either side takes every pulse that reaches into the frame.
    touches = (position > -half_window) & (position < n_samples - 1 + half_window)
    frame, position = frame[touches], position[touches]
    amplitude, phase_rad = amplitude[touches], phase_rad[touches]

    # floor, not rint: ties must fall alike for odd and even bins, so that a shift is exact.
    nearest = np.floor(position + 0.5)
    shift = position - nearest
    cycles, samples = CARRIER_CYCLES_PER_SAMPLE[tx_center_frequency]
    centre_phase = phase_rad - math.tau * cycles / samples * shift
    in_phase, quadrature = amplitude * np.cos(centre_phase), amplitude * np.sin(centre_phase)
    first = nearest.astype(np.int64) + 2 * half_window

    width = n_samples + 4 * half_window
    frames = np.empty((n_frames, n_samples))
    # whole frames at a time: what is added stays in the processor's cache, a block does not
    ends = np.searchsorted(frame, np.arange(1, n_frames + 1)).tolist()
    begin = done = 0
    for n_done, end in enumerate(ends, 1):
        if end - begin < _PULSES_AT_ONCE and n_done < n_frames:
            continue
        part = slice(begin, end)
        bins = ((frame[part] - done) * width + first[part])[:, np.newaxis] + _offsets(half_window)
        waves = pulse.envelope(shift[part, np.newaxis])
        waves *= _on_carrier(in_phase[part], quadrature[part], tx_center_frequency, half_window)
        padded = np.bincount(
            bins.ravel(), weights=waves.ravel(), minlength=(n_done - done) * width
        ).reshape(-1, width)
        frames[done:n_done] = padded[:, 2 * half_window : 2 * half_window + n_samples]
        begin, done = end, n_done
    return frames


def _on_carrier(
    in_phase: NDArray[np.float64],
    quadrature: NDArray[np.float64],
    tx_center_frequency: int,
    half_window: int,
) -> NDArray[np.float64]:
    """Return carriers about the whole samples nearest to pulses, (p, 2 half_window + 1)."""
    cosine, sine = _carrier(tx_center_frequency, half_window)
    carrier: NDArray[np.float64] = in_phase[:, np.newaxis] * cosine
    carrier -= quadrature[:, np.newaxis] * sine
    return carrier


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
    """Reflectors that send an echo everywhere: points, rods, cylinders, people, movers.

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

    def take(
        self, frame: NDArray[np.int64], number: NDArray[np.int64], shape: tuple[int, int]
    ) -> Scatterers:
        """Return some of the scatterers in some of the frames, of (n_frames, k): shape (m,)."""
        arrays = (each.name for each in fields(self))
        return Scatterers(
            **{name: np.broadcast_to(getattr(self, name), shape)[frame, number] for name in arrays}
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Viewpoint:
    """A radar's phase centre and boresight (a unit vector), world frame.

    Shape (n_frames, 1) each, or (m,) as `take` returns them. ``antenna`` is how the phase centre
    depends on the angle.
    """

    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    boresight_x: NDArray[np.float64]
    boresight_y: NDArray[np.float64]
    antenna: AntennaSpec

    def towards(
        self, x_m: NDArray[np.float64], y_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return distances of points of the world frame, and cosines of their angles off boresight.

        A cosine takes a distance below `NEAREST_M` as `NEAREST_M`.
        """
        dx, dy = x_m - self.x_m, y_m - self.y_m
        distance_m = np.sqrt(dx * dx + dy * dy)
        along_m = dx * self.boresight_x + dy * self.boresight_y
        return distance_m, along_m / np.maximum(distance_m, NEAREST_M)

    def antenna_m(self, cos_angle: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how much farther a path appears whose ways out and back leave at an angle."""
        law = self.antenna
        farther_m = law.sin2_m * (1 - cos_angle * cos_angle)
        if law.angle_deg:
            angle_deg = np.degrees(np.arccos(np.clip(cos_angle, -1.0, 1.0)))
            farther_m += np.interp(angle_deg, law.angle_deg, law.range_m)
        return farther_m

    def take(self, frame: NDArray[np.int64]) -> Viewpoint:
        """Return where the radar is in some frames, shape (m,) each."""
        return Viewpoint(
            x_m=self.x_m[frame, 0],
            y_m=self.y_m[frame, 0],
            boresight_x=self.boresight_x[frame, 0],
            boresight_y=self.boresight_y[frame, 0],
            antenna=self.antenna,
        )


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
    error_x_m, error_y_m = radar.mount_error_m
    mount_x_m, mount_y_m = radar.x_m + error_x_m, radar.y_m + error_y_m
    yaw_rad = math.radians(radar.yaw_deg + radar.mount_error_deg)
    return Viewpoint(
        x_m=x + cosine * mount_x_m - sine * mount_y_m,
        y_m=y + sine * mount_x_m + cosine * mount_y_m,
        boresight_x=cosine * math.cos(yaw_rad) - sine * math.sin(yaw_rad),
        boresight_y=sine * math.cos(yaw_rad) + cosine * math.sin(yaw_rad),
        antenna=radar.antenna,
    )


def target_scatterers(targets: tuple[TargetSpec, ...]) -> Scatterers:
    """Return targets as arrays of shape (k,)."""
    radius_m = np.array([target.radius_m for target in targets])
    return Scatterers(
        x_m=np.array([target.x_m for target in targets]),
        y_m=np.array([target.y_m for target in targets]),
        strength=np.array([target.amplitude_1m for target in targets]),
        exponent=np.array([RANGE_EXPONENT[target.kind] for target in targets]),
        radius_m=radius_m,
        swell_m=radius_m,
        phase_rad=np.array([reflection_phase_rad(target.name) for target in targets]),
    )


def curved_spread(
    surface_m: NDArray[np.float64], radius_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return what curvature takes from an echo at distances from a surface; 1 without a radius.

    The mirror image in a cylinder is nearer the smaller the radius.
    """
    spread = np.sqrt((1 + radius_m) / (surface_m + radius_m))
    return np.where(radius_m > 0, spread, 1.0)


def mirrored_ways(n_legs: int) -> list[tuple[int, int]]:
    """Return pairs of legs, out and back, of which at most one is leg 0, the straight one.

    A pair stands for both orders.

    >>> mirrored_ways(3)
    [(0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    """
    return [*combinations_with_replacement(range(n_legs), 2)][1:]


def direct_reflections(scatterers: Scatterers, view: Viewpoint) -> Reflections:
    """Return the echoes by the straight way there and back; nothing stands in between."""
    range_m, cos_angle = view.towards(scatterers.x_m, scatterers.y_m)
    surface_m = np.maximum(range_m, NEAREST_M)
    round_ones = scatterers.radius_m > 0
    strength = scatterers.strength
    if round_ones.any():
        radius_m = scatterers.radius_m
        surface_m = np.maximum(range_m - radius_m, NEAREST_M)
        # inside it, nothing is received
        strength = strength * (curved_spread(surface_m, radius_m) * (range_m > radius_m))
    return Reflections(
        range_m=range_m - scatterers.swell_m + view.antenna_m(cos_angle),
        amplitude=strength * surface_m**-scatterers.exponent * beam_gain(cos_angle),
        phase_rad=scatterers.phase_rad,
    )
