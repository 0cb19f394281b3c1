"""Paths from a radar to reflectors and back: how long, how strong, in which phase.

Formulas and sources are on the model page, ``emulator.echo``.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emulator.people import (
    AMPLITUDE_OF_1_M2,
    PersonSpec,
    chest_displacement_m,
    positions_m,
    present,
)
from emulator.scene_tables import RadarSpec, TargetSpec

__all__ = [
    "BEAM_EXPONENT",
    "Reflections",
    "beam_gain",
    "person_reflections",
    "reflection_phase_rad",
    "target_reflections",
]

BEAM_EXPONENT = math.log(math.sqrt(0.5)) / math.log(math.cos(math.radians(65 / 2)))
"""n of the two-way amplitude pattern cos(angle)**n: 2.0354."""
_RANGE_EXPONENT = {"rod": 1.5, "point": 2.0}
_NEAREST_M = 0.05


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
        Shape (k,), float64: carrier phase added by the reflection.
    """

    range_m: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    phase_rad: NDArray[np.float64]


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


def target_reflections(
    targets: tuple[TargetSpec, ...], radar: RadarSpec, robot_poses: NDArray[np.float64]
) -> Reflections:
    """Return the direct echoes of targets.

    Parameters
    ----------
    targets
        Reflectors in the world frame, k of them.
    radar
        The mount.
    robot_poses
        Shape (n_frames, 3), float64: true x [m], y [m], heading [rad] at each sample time.
    """
    return _reflections(
        radar,
        robot_poses,
        at_x=np.array([target.x_m for target in targets]),
        at_y=np.array([target.y_m for target in targets]),
        strength=np.array([target.amplitude_1m for target in targets]),
        exponent=np.array([_RANGE_EXPONENT[target.kind] for target in targets]),
        phase_rad=np.array([reflection_phase_rad(target.name) for target in targets]),
    )


def person_reflections(
    person: PersonSpec,
    radar: RadarSpec,
    robot_poses: NDArray[np.float64],
    t_ns: NDArray[np.int64],
) -> Reflections:
    """Return the echo of a person, k = 1, at scene times of shape (n_frames,), int64."""
    position = positions_m(person, t_ns)
    strength = AMPLITUDE_OF_1_M2 * math.sqrt(person.rcs_m2)
    standing = _reflections(
        radar,
        robot_poses,
        at_x=position[:, :1],
        at_y=position[:, 1:],
        strength=np.where(present(person, t_ns), strength, 0.0)[:, np.newaxis],
        exponent=np.array([_RANGE_EXPONENT["point"]]),
        phase_rad=np.array([reflection_phase_rad(person.name)]),
    )
    chest_m = chest_displacement_m(person, t_ns)[:, np.newaxis]
    return replace(standing, range_m=standing.range_m - chest_m)


def _reflections(
    radar: RadarSpec,
    robot_poses: NDArray[np.float64],
    *,
    at_x: NDArray[np.float64],
    at_y: NDArray[np.float64],
    strength: NDArray[np.float64],
    exponent: NDArray[np.float64],
    phase_rad: NDArray[np.float64],
) -> Reflections:
    """Return echoes from points of shape (k,) or (n_frames, k), world frame."""
    x, y, heading = robot_poses.T[:, :, np.newaxis]
    cosine, sine = np.cos(heading), np.sin(heading)
    radar_x = x + cosine * radar.x_m - sine * radar.y_m
    radar_y = y + sine * radar.x_m + cosine * radar.y_m
    yaw_rad = math.radians(radar.yaw_deg)
    boresight_x = cosine * math.cos(yaw_rad) - sine * math.sin(yaw_rad)
    boresight_y = sine * math.cos(yaw_rad) + cosine * math.sin(yaw_rad)

    dx = at_x - radar_x
    dy = at_y - radar_y
    range_m = np.sqrt(dx * dx + dy * dy)
    near_m = np.maximum(range_m, _NEAREST_M)
    cos_angle = (dx * boresight_x + dy * boresight_y) / near_m
    return Reflections(
        range_m=range_m,
        amplitude=strength * near_m**-exponent * beam_gain(cos_angle),
        phase_rad=phase_rad,
    )
