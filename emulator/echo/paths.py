"""Paths from a radar to reflectors and back.

How long, how strong and in which phase a path is: formulas and sources are on the model page,
``emulator.echo.echo``. The pulses that return by them are in `emulator.echo.pulse`.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, fields
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from emulator.echo.pulse import SIGMA_S
from emulator.scene.scene import AntennaSpec, LeakageSpec, RadarSpec, TargetSpec
from xethru_protocol.wire.x4 import SPEED_OF_LIGHT_MPS

BEAM_EXPONENT = math.log(math.sqrt(0.5)) / math.log(math.cos(math.radians(65 / 2)))
"""n of the two-way amplitude pattern cos(angle)**n: 2.0354."""
NEAREST_M = 0.05
"""Amplitude laws are held from here inwards."""
RANGE_EXPONENT = {"rod": 1.5, "point": 2.0, "cylinder": 1.0}
RINGING_DECAYS = 7
"""Over how many of its decay lengths the leakage rings; there it is 61 dB down."""
_RINGING_STEP_M = SIGMA_S * SPEED_OF_LIGHT_MPS / 2  # pulses this close add up without ripple


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
        return self.antenna.sin2_m * (1 - cos_angle * cos_angle)

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


def leakage_reflections(
    spec: LeakageSpec, n_frames: int, wavelength_m: float, carrier_offset_hz: float
) -> Reflections:
    """Return the direct pulse and the pulses that it rings on with, alike in all frames.

    Ringing is the pulse convolved with exp(-x / ringing_m) and the carrier over x > 0 of range, as
    of a damped resonance, by the midpoint rule in steps of the nominal pulse's deviation: behind
    that pulse its envelope is ringing amplitude exp(-x / ringing_m), a little more where the decay
    is as short as the pulse.
    """
    count = math.ceil(RINGING_DECAYS * spec.ringing_m / _RINGING_STEP_M) if spec.ringing else 0
    behind_m = (np.arange(count) + 0.5) * _RINGING_STEP_M
    share = spec.ringing / math.sqrt(math.tau) * np.exp(-behind_m / spec.ringing_m)
    wave_number = 1 / wavelength_m + carrier_offset_hz / SPEED_OF_LIGHT_MPS
    turned_rad = 2 * math.tau * wave_number * behind_m
    leaks = np.ones((n_frames, 1))
    return Reflections(
        range_m=leaks * (spec.range_m + np.array([0.0, *behind_m])),
        amplitude=leaks * (spec.amplitude * np.array([1.0, *share])),
        phase_rad=reflection_phase_rad("leakage") + np.array([0.0, *turned_rad]),
    )
