"""What a radar hears: from a scene and the robot's true pose to integer chip counters.

A frame is, in normalised units (full scale of the 11 bit DAC is +-1) at RF sample n,

    x[n] = sum_i a_i p(n - u_i; phase_i) + a_L p(n - u_L; phase_L) + sigma w[n]

and the chip counts ``clip(round((x[n] + N / 2048) / q), 0, max)``.

Pulse p
    Gaussian envelope on the carrier (``emulator.pulse``).
Position u = 2 fs (R + offset) / c - 2 fs L / c_module
    R is the distance from the radar's phase centre (mount on the robot's true pose at the
    radar's own sample time, start skew included) to the reflector; c = 299 792 458 m/s;
    L is the label of sample 0, in module metres (c_module = 3.0e8 m/s, protocol reference 9.1).
    The robot stands still within a frame (a sweep at 5 cm/s moves it by micrometres per pulse).
Amplitude a = amplitude_1m R**-1.5 (rod) or R**-2 (point), cos(angle)**n, TX power
    Radar equation for amplitudes: a point spreads twice as a sphere, a long rod once as a sphere
    and once as a cylinder. The beam's n makes the two-way -3 dB full width 65 degrees; there is
    no edge, and nothing is heard from behind. Ground, elevation, polarisation, aspect
    and shadowing are left out, and the law is held at 5 cm from there inwards. People are points
    that move (``emulator.people``); they are placed anew for every frame, like the robot.
Phase
    Each reflector's is fixed by its name (SHA-256), for every radar, aspect and seed.
Leakage L
    The direct pulse at the scene's range and amplitude; antenna ringing is left out.
Noise w
    White and Gaussian (``emulator.noise``), keyed by seed and the radar's serial, selected by
    the frame counter. sigma is given at a working point and falls with the root of
    iterations x pulses per step. Flicker, interference and jitter are left out.
Count q = 2**dac_step / (iterations pulses_per_step) / 1024, N = dac_max - dac_min + 1
    Protocol reference 9.7; outside the DAC window the counter saturates.

Determinism: float64 throughout, no BLAS, no float32 function. A last-bit difference of a cosine
or a power moves an echo by 1e-11 counts before it is rounded to an integer.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emulator.echo_source import CaptureSettings, EchoSource
from emulator.noise import UNITS_PER_SIGMA, frame_noise_units
from emulator.people import (
    AMPLITUDE_OF_1_M2,
    PersonSpec,
    chest_displacement_m,
    positions_m,
    present,
)
from emulator.pulse import sum_of_pulses
from emulator.scene import RadarSpec, Scene, TargetSpec
from xethru_protocol import x4

__all__ = [
    "BEAM_EXPONENT",
    "SPEED_OF_LIGHT_MPS",
    "Reflections",
    "SceneEcho",
    "beam_gain",
    "echo_source",
    "person_reflections",
    "reflection_phase_rad",
    "target_reflections",
]

SPEED_OF_LIGHT_MPS = 299_792_458.0
_SAMPLES_PER_M = 2 * x4.SAMPLING_RATE_HZ / SPEED_OF_LIGHT_MPS
_SAMPLES_PER_MODULE_M = 2 * x4.SAMPLING_RATE_HZ / x4.MODULE_SPEED_MPS

BEAM_EXPONENT = math.log(math.sqrt(0.5)) / math.log(math.cos(math.radians(65 / 2)))
"""n of the two-way amplitude pattern cos(angle)**n: 2.0354."""
_RANGE_EXPONENT = {"rod": 1.5, "point": 2.0}
_NEAREST_M = 0.05

# Assumed: the X4 documents its power steps by name only (off, low, medium, high); 3 dB apart.
_TX_AMPLITUDE = {0: 0.0, 1: math.sqrt(0.5), 2: 1.0, 3: math.sqrt(2.0)}


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


class SceneEcho:
    """The echo of one radar of a scene: an :class:`~emulator.echo_source.EchoSource`."""

    def __init__(self, scene: Scene, radar: RadarSpec, seed: int) -> None:
        self._scene = scene
        self._radar = radar
        self._seed = seed
        self._trajectory = scene.trajectory()
        self._skew_ns = round(radar.start_skew_ms * 1e6)

    def echo(
        self, capture: CaptureSettings, scene_times_ns: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the noise-free signal before quantisation, leakage included.

        Shape (n_frames, capture.n_samples), float64, normalised units. A reflection weaker than
        one count is skipped.
        """
        times_ns = scene_times_ns + self._skew_ns
        poses = self._trajectory.poses(times_ns)
        leakage = self._scene.leakage
        terms = [
            target_reflections(self._scene.targets, self._radar, poses),
            Reflections(
                range_m=np.full((len(poses), 1), leakage.range_m),
                amplitude=np.full((len(poses), 1), leakage.amplitude),
                phase_rad=np.array([reflection_phase_rad("leakage")]),
            ),
            *(
                person_reflections(person, self._radar, poses, times_ns)
                for person in self._scene.people
            ),
        ]
        range_m = np.concatenate([term.range_m for term in terms], axis=1)
        amplitude = np.concatenate([term.amplitude for term in terms], axis=1)
        phase_rad = np.concatenate([term.phase_rad for term in terms])

        amplitude *= _TX_AMPLITUDE[capture.tx_power]
        position = (range_m + self._radar.range_offset_m) * _SAMPLES_PER_M
        position -= capture.first_sample_m * _SAMPLES_PER_MODULE_M
        frame, path = np.nonzero(amplitude >= _count(capture))
        return sum_of_pulses(
            frame=frame,
            position=position[frame, path],
            amplitude=amplitude[frame, path],
            phase_rad=phase_rad[path],
            tx_center_frequency=capture.tx_center_frequency,
            shape=(len(poses), capture.n_samples),
        )

    def rf_counters(
        self,
        capture: CaptureSettings,
        frame_counters: NDArray[np.int64],
        scene_times_ns: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        """Return raw RF chip counters, shape (n_frames, n_samples); see ``EchoSource``."""
        normalisation = x4.Normalisation.of(
            iterations=capture.iterations,
            pulses_per_step=capture.pulses_per_step,
            dac_min=capture.dac_min,
            dac_max=capture.dac_max,
            dac_step=capture.dac_step,
        )
        pulses = capture.iterations * capture.pulses_per_step
        noise = self._scene.noise
        sigma = noise.rf_sigma * math.sqrt(noise.iterations * noise.pulses_per_step / pulses)

        units = frame_noise_units(
            frame_counters, capture.n_samples, seed=self._seed, stream=int(self._radar.serial)
        )
        counts: NDArray[np.float64] = units * (sigma / UNITS_PER_SIGMA)
        counts += self.echo(capture, scene_times_ns)
        counts += normalisation.dac_offset
        counts *= 1 / _count(capture)
        np.rint(counts, out=counts)
        np.clip(counts, 0, normalisation.max_counter, out=counts)
        return counts.astype(np.int64)


def _count(capture: CaptureSettings) -> float:
    """Return one chip count in normalised units (protocol reference 9.7).

    In float64: `xethru_protocol.x4.Normalisation` rounds it to float32, as the wire needs it.
    """
    return 2.0**capture.dac_step / (capture.iterations * capture.pulses_per_step) / 1024


def echo_source(scene: Scene, radar_index: int, seed: int) -> EchoSource:
    """Return the echo source of one of the scene's radars.

    Parameters
    ----------
    scene
        The scene; its order of radars changes only which index means which radar.
    radar_index
        Index into ``scene.radars``.
    seed
        0 ... 2**64 - 1; selects the receiver noise.
    """
    return SceneEcho(scene, scene.radars[radar_index], seed)
