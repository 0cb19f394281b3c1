"""Laws of model error: what real modules and targets do beside the ideal ones of a scene.

Each is off unless the scene's tables ask for it. The laws are of the project; strengths that the
stresses of ``uwb-slam sweep`` use stand in ``slam.app.sweep``. Formulas are on the model page,
``emulator.echo.echo``.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from emulator.chip.chip import CaptureSettings
from emulator.echo.paths import Reflections, Scatterers, Viewpoint
from emulator.echo.pulse import sum_of_pulses
from emulator.scene.philox import (
    UNITS_PER_SIGMA,
    WORDS_PER_BLOCK,
    Purpose,
    counter_normals,
    frame_noise_units,
    stream_of,
    uniforms,
)
from emulator.scene.scene import RadarSpec, TargetSpec

PAIR_REACH_M = 1.0
"""Distance up to which two targets send an echo by way of each other."""
PAIR_AT_M = 0.1
"""Distance of two targets at which the echo by way of both has the strength of the scene."""

_MOST_PULSES = 3
_WORDS_PER_FRAME = 3 + 3 * _MOST_PULSES
"""Chance of pulses, their number, chance of noise; then places, phases and sizes of pulses."""
_BLOCKS_PER_FRAME = -(-_WORDS_PER_FRAME // WORDS_PER_BLOCK)


class Wander:
    """How the echoes of a scene's targets depend on the side that they are seen from."""

    def __init__(self, targets: tuple[TargetSpec, ...], seed: int) -> None:
        specs = [target.wander for target in targets]
        rows = [(spec.range_m, spec.inside_m, spec.fading, spec.phase_rad) for spec in specs]
        self._strengths = np.array(rows).reshape(-1, 4).T
        streams = [stream_of(number, Purpose.WANDER) for number in range(len(targets))]
        phases = [math.tau * uniforms(4, seed=seed, stream=stream) for stream in streams]
        self._phases_rad = np.array(phases).reshape(-1, 4).T

    def __bool__(self) -> bool:
        """Return whether any target's echo differs from the ideal one."""
        return bool(self._strengths.any())

    def applied(self, direct: Reflections, targets: Scatterers, view: Viewpoint) -> Reflections:
        """Return the direct echoes of k targets, shape (n_frames, k), changed by the law."""
        beta = np.arctan2(view.y_m - targets.y_m, view.x_m - targets.x_m)
        range_m, inside_m, fading, phase_rad = self._strengths
        first, second, third, fourth = self._phases_rad
        wave = 0.7 * np.cos(2 * beta + first) + 0.5 * np.cos(5 * beta + second)
        fade = np.cos(3 * beta + third) + 0.5 * np.cos(9 * beta + fourth)
        return replace(
            direct,
            range_m=direct.range_m + (range_m * wave - inside_m),
            amplitude=direct.amplitude * np.maximum(0.1, 1 + fading * fade),
            phase_rad=direct.phase_rad + phase_rad * np.cos(4 * beta + first),
        )


class TargetPairs:
    """Echoes that go from one target to another that is near, and from there to the radar."""

    def __init__(self, targets: Scatterers, strength: float) -> None:
        x, y = targets.x_m, targets.y_m
        between_m = np.hypot(x - x[:, np.newaxis], y - y[:, np.newaxis])
        near = np.triu(between_m <= PAIR_REACH_M, 1) & (strength > 0) & (between_m > 0)
        self._first, self._second = np.nonzero(near)
        self._between_m = between_m[near]
        self._gain = strength * np.sqrt(PAIR_AT_M / self._between_m)

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return len(self._gain) > 0

    def reflections(self, direct: Reflections) -> Reflections:
        """Return them, from the direct echoes of the targets, shape (n_frames, k)."""
        i, j = self._first, self._second
        phase_rad = direct.phase_rad
        return Reflections(
            range_m=(direct.range_m[:, i] + direct.range_m[:, j] + self._between_m) / 2,
            amplitude=self._gain * np.sqrt(direct.amplitude[:, i] * direct.amplitude[:, j]),
            phase_rad=phase_rad[..., i] + phase_rad[..., j],
        )


class Bursts:
    """What other modules send into the frames of one radar, each frame by its index alone."""

    def __init__(self, radar: RadarSpec, seed: int) -> None:
        self._spec = radar.bursts
        self._pulse = radar.pulse
        self._seed = seed
        serial = int(radar.serial)
        self._chances, self._noise = (stream_of(serial, Purpose.BURSTS, part) for part in (0, 1))

    def add_to(
        self,
        signal: NDArray[np.float64],
        indices: NDArray[np.int64],
        capture: CaptureSettings,
        gain: float,
    ) -> None:
        """Add them in place to frames of shape (n_frames, capture.n_samples), with these indices.

        ``gain`` is the receiver's: of the pulses, not of the noise.
        """
        spec = self._spec
        if not (spec.echo_share or spec.noise_share):
            return
        words = np.array(
            [
                uniforms(
                    _WORDS_PER_FRAME,
                    seed=self._seed,
                    stream=self._chances,
                    block=index * _BLOCKS_PER_FRAME,
                )
                for index in indices.tolist()
            ]
        ).reshape(-1, _WORDS_PER_FRAME)
        chance, number, noise_chance = words[:, :3].T
        where, phase, size = words[:, 3:].reshape(-1, 3, _MOST_PULSES).transpose(1, 0, 2)
        count = np.where(chance < spec.echo_share, 1 + np.floor(_MOST_PULSES * number), 0)
        frame, pulse = np.nonzero(np.arange(_MOST_PULSES) < count[:, np.newaxis])
        # the smallest uniform that is not 0 stands for it: ndtri(0) is infinite
        size = np.exp(spec.spread * ndtri(np.maximum(size[frame, pulse], 2.0**-53)))
        signal += sum_of_pulses(
            frame=frame,
            position=where[frame, pulse] * (capture.n_samples - 1),
            amplitude=spec.amplitude * gain * size,
            phase_rad=math.tau * phase[frame, pulse],
            tx_center_frequency=capture.tx_center_frequency,
            shape=signal.shape,
            pulse=self._pulse,
        )
        noisy = np.flatnonzero(noise_chance < spec.noise_share)
        units = frame_noise_units(
            indices[noisy], capture.n_samples, seed=self._seed, stream=self._noise
        )
        signal[noisy] += units * (spec.noise_sigma / UNITS_PER_SIGMA)


class StampError:
    """How far the times at which frames are taken lie from those that their reader assumes."""

    def __init__(self, radar: RadarSpec, seed: int) -> None:
        self._sigma_ns = radar.stamp_sigma_ms * 1e6
        self._seed, self._stream = seed, stream_of(int(radar.serial), Purpose.STAMPS)

    def taken_ns(
        self, scene_times_ns: NDArray[np.int64], indices: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Return when frames are taken, shape (n_frames,) [ns], from assumed times and indices."""
        if not self._sigma_ns:
            return scene_times_ns
        normals = counter_normals(indices, seed=self._seed, stream=self._stream)
        return scene_times_ns + np.rint(self._sigma_ns * normals).astype(np.int64)
