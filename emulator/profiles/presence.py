"""The presence profile's processing: frames in; once a tick its state, detections and movement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.profiles.detection import Detection, Excess, detections, movement_list
from emulator.profiles.doppler import FAST, MATRICES, SlowTime
from emulator.profiles.noise_map import NoiseMap, Powers
from emulator.profiles.sweep import ProfileSweep
from xethru_protocol.codes import PresenceState

__all__ = ["Presence", "PresenceProcessing"]

_ABSORBABLE = 2.0
"""Excess up to which the noise map adapts; every threshold lies above."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Presence:
    """What the profile knows after a tick.

    Attributes
    ----------
    state
        Initialising until matrices and noise map are there, then presence or none.
    detections
        Who is in the zone, whoever moves right now first.
    movement_slow, movement_fast
        0...100 per interval of the zone, the average in front.
    """

    state: PresenceState
    detections: tuple[Detection, ...]
    movement_slow: tuple[float, ...]
    movement_fast: tuple[float, ...]


class PresenceProcessing:
    """Matrices, noise map and detection of one run of the profile.

    Parameters
    ----------
    sweep
        The radar's geometry.
    noise_map
        The map to begin with; an incomplete one is created from the first matrices.

    Attributes
    ----------
    noise_map
        As it is now.
    power
        The matrices of the last tick, as far as they were full.
    """

    def __init__(self, sweep: ProfileSweep, noise_map: NoiseMap) -> None:
        self._sweep = sweep
        self._slow_time = {matrix.instance: SlowTime(matrix) for matrix in MATRICES}
        self.noise_map = noise_map
        self.power: Powers = {}

    @property
    def full(self) -> bool:
        """Whether both matrices are."""
        return all(slow_time.full for slow_time in self._slow_time.values())

    def add(self, iq: NDArray[np.complex128]) -> None:
        """Take one frame."""
        for slow_time in self._slow_time.values():
            slow_time.add(iq)

    def refill(self) -> None:
        """Forget the frames, because a gap follows; the noise map stays."""
        for slow_time in self._slow_time.values():
            slow_time.clear()

    def tick(self, sensitivity: int) -> Presence:
        """Compute the matrices, and from them who is there."""
        self.power = {
            instance: slow_time.power()
            for instance, slow_time in self._slow_time.items()
            if slow_time.full
        }
        if not self.full:
            return self._initialising()
        if not self.noise_map.complete:
            self.noise_map.learn(self.power)
            return self._initialising()
        excess = Excess.of(self.power, self.noise_map)
        frames = self._slow_time[FAST.instance].pulses()
        found = detections(self._sweep, excess, self.noise_map, frames, sensitivity)
        self.noise_map.adapt(self.power, excess.either < _ABSORBABLE)
        return Presence(
            state=PresenceState.PRESENCE if found else PresenceState.NO_PRESENCE,
            detections=found,
            movement_slow=movement_list(self._sweep, excess.slow),
            movement_fast=movement_list(self._sweep, excess.fast),
        )

    def _initialising(self) -> Presence:
        nothing = movement_list(self._sweep, np.ones(self._sweep.n_bins))
        return Presence(
            state=PresenceState.INITIALIZING,
            detections=(),
            movement_slow=nothing,
            movement_fast=nothing,
        )
