"""What a radar receives: from a scene and the robot's true pose to integer chip counters.

This is the page on the model: each term, its formula, its source, what it leaves out. The world is
a floor plan seen from one phase centre per radar. In normalised units (full scale of the 11 bit
DAC is +-1) RF sample n of a frame at true time t is

    x[n] = sum_i a_i p(n - u_i; phase_i + j(t)) + c[n](t) + sigma w[n]

with the leakage among the paths i, and the chip counts ``clip(round((x[n] + N / 2048) / q), 0,
max)``. Elevation of targets, polarisation, and paths of more bounces than named here are left out.

Pulse p
    Gaussian envelope on the carrier (``emulator.echo.paths``). Where a radar of the scene
    has a table ``pulse``, the standard deviation is width (1 - skew) sigma before the peak and
    width (1 + skew) sigma after it, and ringing times the same pulse follows 3.2 sigma later, its
    carrier 1 rad ahead; carrier_offset_hz is added to the carrier. All that this radar receives has
    this pulse, except for its clutter. Edges of walls take the nominal carrier's wavelength.
    The form is assumed; real pulses of the X4 are a little asymmetric and ring.
Time t
    Nominal time of the frame, made earlier by the module's fast clock and later by its start
    skew (``emulator.chip.chip``), and off by N(0, stamp_sigma_ms), new with every frame, which
    the reader of the frame cannot see. The robot stands still within a frame: a sweep at 5 cm/s
    moves it by micrometres per pulse.
Place of a radar
    Its mount and, beside what its user assumes, mount_error_m and mount_error_deg.
Position u = 2 fs (1 + ppm 1e-6) (R + offset) / c - 2 fs L / c_module
    R is half the length of the path; c = 299 792 458 m/s; offset is the module's range error; L is
    the label of sample 0 in module metres (c_module = 3.0e8 m/s, protocol reference 9.1).
Amplitude a of rod, point, person, mover (``emulator.echo.paths``)
    amplitude_1m R**-1.5 (rod) or R**-2 (point), times the beam cos(angle)**n, the root of TX power
    and the module's gain. Radar equation for amplitudes (Skolnik, Introduction to Radar Systems):
    a point spreads twice as a sphere, a long rod once as a sphere and once as a cylinder. The
    beam's n makes the two-way -3 dB full width 65 degrees; no hard edge, nothing from behind.
    Aspect is left out but for people, and the law is held at 5 cm from there inwards. People
    (``emulator.scene.people``) and movers (``emulator.scene.motion``) are placed anew for every
    frame, like the robot.
Chest of a person (``emulator.scene.people``)
    R is the distance less the chest's displacement times a share; the amplitude goes with the root
    of the cross section times another. Both shares depend on the angle at which the chest is seen.
Cylinder
    Its surface, at R - radius, weakened by (1 / s) sqrt((1 + radius) / (s + radius)) over the
    distance s to it: geometric optics of a convex mirror.
Body (``emulator.echo.targets``)
    A target with points sends one echo from each, at its own range and of its share of the
    amplitude; they add coherently, which is what makes complex targets fade and their apparent
    place wander with aspect (Skolnik, 2.7: two points l apart give 2 (1 + cos(4 pi l sin(angle) /
    wavelength)) times the power of one). Points do not shade each other.
Scintillation (``emulator.echo.targets``)
    The amplitude of a target times 10**(sigma_db g(t) / 20), or times sqrt((g(t)**2 + h(t)**2) /
    2), whose power is exponential: Swerling's case I (IRE Trans. IT-6 (1960) 269), here with a
    correlation in time. g and h are stationary Gaussian processes (``emulator.echo.receiver``) of
    variance 1, keyed by the target and alike for all radars.
Antenna
    A path appears sin2_m sin(angle)**2 farther; ways out and back each count half. For an antenna
    whose phase centre lies d before the place that its ranges are calibrated for, the path is
    longer by d (1 - cos(angle)), near d / 2 sin(angle)**2. Shape and bandwidth of the pulse stay.
Floor, ceiling (``emulator.echo.targets``)
    Horizontal mirrors at the distance h from the antenna, phase pi each. Rods and cylinders stand
    from floor to ceiling and make a right angle with it, which sends back what comes: half path
    s = sqrt(d**2 + h**2) over the distance d to the surface, amplitude_1m / (d sqrt(s)) for a rod
    (stationary phase along it, both orders of bouncing half of the first Fresnel zone each) and
    sqrt((1 + radius) / (d + radius)) / s for a cylinder. Points, people and movers are at the
    antenna's height: legs of sqrt(d**2 + (2 h)**2), half path and spread as for ghosts. Beam and
    antenna as for the leg's angle off boresight, elevation included. Walls have no such images, and
    no wave goes by floor and ceiling on the same leg. Shadows are those of the straight leg.
Wander (``emulator.echo.model_error``)
    Of a target seen under the bearing beta, from target to radar: range + a (0.7 cos(2 beta +
    phi_1) + 0.5 cos(5 beta + phi_2)) - rho; amplitude times max(0.1, 1 + c cos(3 beta + phi_3) +
    c/2 cos(9 beta + phi_4)); phase + b cos(4 beta + phi_1) rad; phi_k uniform, per target and
    seed. Assumed: a few harmonics in place of a body's true signature. Ghosts and shadows are
    those of the ideal target.
Echo by way of two targets (``emulator.echo.model_error``)
    For targets i, j closer than 1 m: at (r_i + r_j + d_ij) / 2, amplitude g sqrt(A_i A_j)
    sqrt(0.1 m / d_ij), phases added. Assumed, after the wave between two rods, which spreads as a
    cylinder: amplitude d**-1/2. r and A are those of the direct echoes.
Wall, face of a box (``emulator.echo.walls``)
    A mirror at the distance R of its line: amplitude_1m / R, phase pi. |reflection| is
    amplitude_1m / (0.06 sqrt(pi)), because an image at 2 R equals a cross section of pi R**2 and
    0.06 is the echo of 1 m**2 (``emulator.scene.motion``). Roughness, thickness and the
    reflection's dependence on angle are left out.
Edge of a wall (``emulator.echo.walls``)
    Kirchhoff's half-plane at the carrier (Born and Wolf, Principles of Optics, 8.7): the echo fades
    over the first Fresnel zone as the mirror point leaves the wall, and half of it is left where
    that point is the end. The edge's wave is weakened by the cosine of its angle off the normal.
Corner
    Image of image in two walls, both orders of bouncing. At 90 degrees each passes half of the
    aperture, so together they are one image at the apex.
Ghosts (``emulator.echo.walls``)
    Radar, wall, target, radar and its reverse, and by walls both ways: half path (L_out + L_back)
    / 2, 1 / (s_1 s_2) for a point, sqrt(2 / (s_1 s_2 (s_1 + s_2))) for a rod; doubled where out
    and back differ, phase pi per mirror, the beam once per leg.
Shadow and transmission (``emulator.echo.walls``)
    Each leg is multiplied, per face it crosses, by |t + (1 - t) (E_a + E_b)|: what passes through
    and what bends round both ends (single knife edge, ITU-R P.526). The bent way's own delay is
    left out; people, movers, rods and cylinders cast no shadow. Ends count as free edges also
    where two walls meet, so an opaque joint lets some -12 dB past it; and where a leg's end crosses
    the line of a wall beyond its end, what bends round that end appears at once, by up to -6 dB.
Phase
    Each reflector's is fixed by its name (SHA-256), for every radar, aspect and seed.
Phase jitter j
    White (by frame) and slow (by time), common to all echoes and the leakage of a frame
    (``emulator.echo.receiver``): figures of the strongest reflector of a real X4 recording. The
    envelope is not moved. The amplitude jitters likewise, by frame, where a scene asks for it.
Leakage
    The direct pulse at the scene's range and amplitude, and the antennas' ringing, a resonance at
    the carrier that dies away behind it (``emulator.echo.paths``); by default there is none.
Clutter c
    Slow, correlated, inside the transmitted band (``emulator.echo.receiver``): every 8 samples a
    complex Gaussian scatterer that answers with the pulse, of equal strength at all ranges, times
    TX power and gain; in time three stationary processes (``emulator.echo.receiver``) fitted to the
    ten farthest bins of that recording. It ignores where the robot is, and radars do not share it.
Noise w
    White and Gaussian (``emulator.scene.philox``), keyed by seed and the radar's serial, selected
    by the frame's index. sigma is given at a working point and falls with the root of
    iterations x pulses per step; neither gain nor TX power change it. Flicker is left out.
Bursts (``emulator.echo.model_error``)
    Of other modules: echo_share of the frames hold 1 to 3 pulses, equally likely, at uniform
    ranges and phases, of amplitude times exp N(0, spread) and the module's gain; noise_share hold
    white noise of noise_sigma more. Assumed; keyed like w. Working points do not change them.
Other modules (``emulator.echo.other_modules``)
    Their pulses arrive amplitude_1m / distance strong, the beam once, and drift through the frame
    by the difference of the clocks; the frame holds their mean over its sweep. 2 x 0.106 at 1 m is
    a module of the same power that looks here: a mirror's echo has gone 2 m.
Count q = 2**dac_step / (iterations pulses_per_step) / 1024, N = dac_max - dac_min + 1
    Protocol reference 9.7; outside the DAC window the counter saturates.
Smoke
    Nothing. Particles far smaller than the wavelength absorb by their volume (Bohren and Huffman,
    chapter 5): (6 pi / wavelength) (mass per m**3 / density) Im((m**2 - 1) / (m**2 + 2)), whose
    last factor is 1/2 at most; for 1 g/m**3 and water's density 2.3e-4 of the power per metre,
    0.001 dB.

Determinism: float64 throughout, no BLAS, no float32 function. A last-bit difference of a cosine
or a power moves an echo by 1e-11 counts before it is rounded to an integer.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from emulator.chip.chip import CaptureSettings, EchoSource
from emulator.echo.model_error import Bursts, StampError, TargetPairs, Wander
from emulator.echo.other_modules import OtherModules
from emulator.echo.paths import (
    Reflections,
    Viewpoint,
    direct_reflections,
    leakage_reflections,
    viewpoint,
)
from emulator.echo.people import mover_scatterer, person_scatterer
from emulator.echo.pulse import sum_of_pulses
from emulator.echo.receiver import CarrierJitter, Receiver, one_count
from emulator.echo.targets import Targets, mirrored_reflections
from emulator.echo.walls import (
    corner_pairs,
    corner_reflections,
    direct_share,
    face_reflections,
    faces_of,
    ghost_reflections,
)
from emulator.scene.scene import RadarSpec, Scene
from xethru_protocol.wire import x4
from xethru_protocol.wire.x4 import SPEED_OF_LIGHT_MPS

_SAMPLES_PER_M = 2 * x4.SAMPLING_RATE_HZ / SPEED_OF_LIGHT_MPS
_SAMPLES_PER_MODULE_M = 2 * x4.SAMPLING_RATE_HZ / x4.MODULE_SPEED_MPS

# Assumed: the X4 documents its power steps by name only (off, low, medium, high); 3 dB apart.
_TX_AMPLITUDE = {0: 0.0, 1: math.sqrt(0.5), 2: 1.0, 3: math.sqrt(2.0)}


class ScenePaths:
    """The paths of one radar of a scene. What does not move is worked out once."""

    def __init__(self, scene: Scene, radar: RadarSpec, seed: int) -> None:
        self._scene = scene
        self._radar = radar
        self._seed = seed
        self._trajectory = scene.trajectory()
        self._targets = Targets(scene.targets, seed)
        self._wander = Wander(scene.targets, seed)
        self._target_pairs = TargetPairs(self._targets.steady, scene.multipath.target_pairs)
        self._walled = bool(scene.walls or scene.objects)
        self._faces = faces_of(scene.walls, scene.objects)
        self._pairs = corner_pairs(self._faces)

    def view(self, t_ns: NDArray[np.int64]) -> Viewpoint:
        """Return where the radar is at true sample times of shape (n_frames,), int64."""
        return viewpoint(self._radar, self._trajectory.poses(t_ns))

    def reflections(self, t_ns: NDArray[np.int64], wavelength_m: float) -> Reflections:
        """Return all paths at true sample times of shape (n_frames,), int64.

        Amplitudes are at TX power 2 and before the receiver; a path that does not exist in a
        frame has amplitude 0.
        """
        view = self.view(t_ns)
        heights = self._scene.heights
        scatterers = [
            *self._targets.scatterers(t_ns),
            *(person_scatterer(each, t_ns, view, self._seed) for each in self._scene.people),
            *(mover_scatterer(each, t_ns) for each in self._scene.movers),
        ]
        direct = [direct_reflections(each, view) for each in scatterers]
        if self._wander:
            direct[0] = self._wander.applied(direct[0], self._targets.steady, view)
        walls: list[Reflections] = []
        ghosts: list[Reflections] = []
        shares: list[NDArray[np.float64] | float] = [1.0] * len(scatterers)
        if self._walled:
            walls.append(face_reflections(self._faces, view, wavelength_m))
            if self._scene.multipath.corners:
                walls.append(corner_reflections(self._faces, self._pairs, view, wavelength_m))
            for number, each in enumerate(scatterers):
                share = shares[number] = direct_share(self._faces, each, view, wavelength_m)
                amplitude = direct[number].amplitude * share * share
                direct[number] = replace(direct[number], amplitude=amplitude)
                if self._scene.multipath.double_bounce:
                    ghosts.append(ghost_reflections(self._faces, each, view, share, wavelength_m))
        mirrored: list[Reflections] = []
        if heights.floor_reflection or heights.ceiling_reflection:
            mirrored = [
                mirrored_reflections(each, view, heights, share)
                for each, share in zip(scatterers, shares, strict=True)
            ]
        leakage = leakage_reflections(
            self._scene.leakage, len(t_ns), wavelength_m, self._radar.pulse.carrier_offset_hz
        )
        pairs = [self._target_pairs.reflections(direct[0])] if self._target_pairs else []
        # frames are sums in this order, to the last bit
        return _together([direct[0], leakage, *direct[1:], *walls, *ghosts, *pairs, *mirrored])


def _together(terms: list[Reflections]) -> Reflections:
    phases = [term.phase_rad for term in terms]
    if any(phase.ndim > 1 for phase in phases):
        phases = [np.broadcast_to(term.phase_rad, term.range_m.shape) for term in terms]
    return Reflections(
        range_m=np.concatenate([term.range_m for term in terms], axis=1),
        amplitude=np.concatenate([term.amplitude for term in terms], axis=1),
        phase_rad=np.concatenate(phases, axis=-1),
    )


class SceneEcho:
    """The echo of one radar of a scene: an :class:`~emulator.chip.chip.EchoSource`."""

    def __init__(self, scene: Scene, radar: RadarSpec, seed: int) -> None:
        self._radar = radar
        self._paths = ScenePaths(scene, radar, seed)
        self._bursts = Bursts(radar, seed)
        self._stamps = StampError(radar, seed)
        self._others = OtherModules(scene.other_modules, radar)
        self._clock = radar.clock
        self._gain = 10.0 ** (radar.gain_db / 20)
        self._jitter = CarrierJitter(scene.jitter, seed=seed, serial=int(radar.serial))
        self._receiver = Receiver(scene, radar, seed)

    def echo(
        self,
        capture: CaptureSettings,
        scene_times_ns: NDArray[np.int64],
        carrier_phase_rad: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Return the noise-free signal before quantisation, leakage included.

        Shape (n_frames, capture.n_samples), float64, normalised units. A reflection weaker than
        one count is skipped. ``carrier_phase_rad`` of shape (n_frames,) is added to all echoes
        of a frame.
        """
        wavelength_m = SPEED_OF_LIGHT_MPS / x4.CARRIER_HZ[capture.tx_center_frequency]
        paths = self._paths.reflections(self._clock.scene_times_ns(scene_times_ns), wavelength_m)
        amplitude = paths.amplitude * (_TX_AMPLITUDE[capture.tx_power] * self._gain)
        position = (paths.range_m + self._radar.range_offset_m) * (
            _SAMPLES_PER_M * self._clock.rate
        )
        position -= capture.first_sample_m * _SAMPLES_PER_MODULE_M
        frame, path = np.nonzero(amplitude >= one_count(capture))
        of_each_frame = paths.phase_rad.ndim > 1
        phase_rad = paths.phase_rad[frame, path] if of_each_frame else paths.phase_rad[path]
        if carrier_phase_rad is not None:
            phase_rad = phase_rad + carrier_phase_rad[frame]
        return sum_of_pulses(
            frame=frame,
            position=position[frame, path],
            amplitude=amplitude[frame, path],
            phase_rad=phase_rad,
            tx_center_frequency=capture.tx_center_frequency,
            shape=(len(amplitude), capture.n_samples),
            pulse=self._radar.pulse,
        )

    def rf_counters(
        self,
        capture: CaptureSettings,
        indices: NDArray[np.int64],
        scene_times_ns: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        """Return raw RF chip counters, shape (n_frames, n_samples); see ``EchoSource``."""
        taken_ns = self._stamps.taken_ns(scene_times_ns, indices)
        times_ns = self._clock.scene_times_ns(taken_ns)
        jitter_rad = self._jitter.phases_rad(indices, times_ns)
        signal = self.echo(capture, taken_ns, jitter_rad)
        self._jitter.scale(signal, indices)
        self._bursts.add_to(signal, indices, capture, self._gain)
        if self._others:
            view = self._paths.view(times_ns)
            self._others.add_to(signal, view, times_ns, capture, self._gain)
        return self._receiver.counters(
            signal,
            indices,
            times_ns,
            capture,
            gain=_TX_AMPLITUDE[capture.tx_power] * self._gain,
        )


def echo_source(scene: Scene, radar_index: int, seed: int) -> EchoSource:
    """Return the echo source of ``scene.radars[radar_index]``.

    The seed, 0 ... 2**64 - 1, selects receiver noise, clutter, jitter and model error.
    """
    return SceneEcho(scene, scene.radars[radar_index], seed)
