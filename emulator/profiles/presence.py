"""The presence profile's processing: frames in; once a tick its state, detections and movement.

Excess
    Per bin, the power at moving frequencies over the noise map's, 1 where nobody moves. A bin
    with an excess beyond the threshold, ``14 - sensitivity`` dB, in either matrix is occupied; so
    is one where the last three frames, less the mean of the fast window, lie 4 dB further above
    the noise, because the matrices smear a person who walks.
Detection
    A run of occupied bins, gaps of up to 0.4 m bridged. Its distance is where most moves in the
    last three frames if they excite it, else that of the largest excess, as for a person who only
    breathes. A detection whose distance lies outside the zone is dropped. One that moves now comes
    first, before an old trail in the slow matrix.
Velocity
    From the phase between the newest frames: unambiguous within +-17.5 cm/s at 7.29 GHz and
    17 frames/s, so the change of range over half a second selects which multiple of 35 cm/s to
    add. Direction is its sign, still below 10 cm/s.

A slow matrix remembers 20 s, so presence outlives a person by up to that. False alarms: in white
noise at sensitivity 9 none came in 43 325 ticks, twelve hours of virtual time. By the rule of
three that is fewer than one in 14 000 ticks with 95 % confidence; a lower rate was not measured.

The reference gives the fields of messages only; everything here is ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.profiles.doppler import (
    FAST,
    FRAME_RATE_HZ,
    MATRICES,
    SLOW,
    Matrix,
    NoiseMap,
    Powers,
    ProfileSweep,
    SlowTime,
)
from xethru_protocol.processing.doppler import hann
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import MatrixInstance, PresenceDirection, PresenceState
from xethru_protocol.wire.x4 import SPEED_OF_LIGHT_MPS

BEST_QUALITY = 10
_DB_PER_QUALITY = 3.0
_TINY = float(np.finfo(np.float64).tiny)
_BRIDGED_BINS = 8
_NEWEST_FRAMES = 3
_EARLIER_BY = 9
_NEWEST_MARGIN_DB = 4.0
_STILL_MPS = 0.1
_QUIETEST_THRESHOLD_DB = 14.0
_INTERVAL_BINS = 10
_FULL_MOVEMENT_DB = 40.0
_NO_MOVEMENT_DB = 3.0
_ABSORBABLE = 2.0
"""Excess up to which the noise map adapts; every threshold lies above."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectedPerson:
    """A person in the zone.

    Attributes
    ----------
    distance_m
        Module metres.
    velocity_mps
        Radial velocity, positive away; 0 for a person who does not walk.
    """

    distance_m: float
    excess_db: float
    velocity_mps: float
    moving: bool

    @property
    def direction(self) -> PresenceDirection:
        if abs(self.velocity_mps) < _STILL_MPS:
            return PresenceDirection.STILL
        away = self.velocity_mps > 0
        return PresenceDirection.AWAY if away else PresenceDirection.TOWARDS


def excess_over(noise_map: NoiseMap, power: Powers, matrix: Matrix) -> NDArray[np.float64]:
    """Return movement over the noise map per bin, shape (n_bins,), linear."""
    moving = matrix.moving
    floor = noise_map.power[matrix.instance][:, moving].sum(axis=1)
    now = power[matrix.instance][:, moving].sum(axis=1)
    # a source without any noise has no floor to compare with
    return np.asarray(now / np.maximum(floor, _TINY), dtype=np.float64)


def threshold_db(sensitivity: int) -> float:
    """Return the excess from which a bin is occupied."""
    return _QUIETEST_THRESHOLD_DB - sensitivity


def signal_quality(found: DetectedPerson, sensitivity: int) -> int:
    """Return a step per 3 dB above the threshold, 1...10."""
    margin_db = found.excess_db - threshold_db(sensitivity)
    return min(max(round(margin_db / _DB_PER_QUALITY), 1), BEST_QUALITY)


def detections(
    sweep: ProfileSweep,
    excess: NDArray[np.float64],
    noise_map: NoiseMap,
    frames: NDArray[np.complex128],
    sensitivity: int,
) -> tuple[DetectedPerson, ...]:
    """Return who is in the zone: who moves right now first, then the strongest.

    Parameters
    ----------
    excess
        Shape (n_bins,): the larger of the two matrices'.
    noise_map
        The noise of a frame follows from it.
    frames
        Shape (n_frames, n_bins), the frames of the fast matrix, oldest first.
    """
    threshold = 10 ** (threshold_db(sensitivity) / 10)
    residual = frames - frames.mean(axis=0)
    newest = _mean_power(residual[-_NEWEST_FRAMES:])
    floor = _frame_noise(noise_map)
    audible = np.maximum(floor, _TINY) * 10 ** (_NEWEST_MARGIN_DB / 10) * threshold
    now = newest / audible * threshold
    strength = np.maximum(excess, now)
    found = []
    for first, last in _runs(strength > threshold):
        run = slice(first, last + 1)
        centre = first + int(np.argmax(strength[run]))
        velocity_mps = 0.0
        candidate = first + int(np.argmax(now[run]))
        moving = bool(now[candidate] > threshold)
        if moving:
            centre = candidate
            velocity_mps = _velocity_mps(residual, centre, audible, sweep.carrier_hz)
        if sweep.in_zone[centre]:
            found.append(
                DetectedPerson(
                    distance_m=float(sweep.range_m[centre]),
                    excess_db=10 * math.log10(float(strength[run].max())),
                    velocity_mps=velocity_mps,
                    moving=moving,
                )
            )
    return tuple(sorted(found, key=lambda one: (not one.moving, -one.excess_db)))


def movement_list(sweep: ProfileSweep, excess: NDArray[np.float64]) -> tuple[float, ...]:
    """Return movement 0...100 per interval of ten bins (51 cm), their average in front.

    The largest `movement_share` of an interval counts.
    """
    inside = excess[sweep.in_zone]
    starts = np.arange(0, len(inside), _INTERVAL_BINS)
    values = 100 * movement_share(np.maximum.reduceat(inside, starts))
    return (float(values.mean()), *values.tolist())


def movement_share(excess: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return movement 0...1 of any shape: 0 is an excess of up to 3 dB, 1 one of 40 dB."""
    excess_db = 10 * np.log10(np.maximum(excess, 1e-30))
    share = (excess_db - _NO_MOVEMENT_DB) / (_FULL_MOVEMENT_DB - _NO_MOVEMENT_DB)
    return np.clip(share, 0, 1)


def _runs(occupied: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield first and last bin of each run, short gaps bridged."""
    bins = np.flatnonzero(occupied)
    if len(bins) == 0:
        return
    breaks = np.flatnonzero(np.diff(bins) > _BRIDGED_BINS)
    for run in np.split(bins, breaks + 1):
        yield int(run[0]), int(run[-1])


def _mean_power(frames: NDArray[np.complex128]) -> NDArray[np.float64]:
    power: NDArray[np.float64] = (frames.real**2 + frames.imag**2).mean(axis=0)
    return power


def _frame_noise(noise_map: NoiseMap) -> NDArray[np.float64]:
    """Return the noise power of one frame per bin, from the map at moving frequencies."""
    window = hann(FAST.pulses)
    per_cell = noise_map.power[MatrixInstance.FAST][:, FAST.moving].mean(axis=1)
    scale = float(window.sum() ** 2 / (window**2).sum())
    return np.asarray(per_cell * scale, dtype=np.float64)


def _velocity_mps(
    residual: NDArray[np.complex128],
    centre: int,
    audible: NDArray[np.float64],
    carrier_hz: float,
) -> float:
    """Return the radial velocity of what is newest at a bin, positive away."""
    near = slice(max(centre - 2, 0), centre + 3)
    newest = residual[-2 * _NEWEST_FRAMES :, near]
    turned = (newest[1:] * newest[:-1].conj()).sum()
    wavelength_m = SPEED_OF_LIGHT_MPS / carrier_hz
    per_cycle_mps = wavelength_m / 2 * FRAME_RATE_HZ
    by_phase_mps = -math.atan2(turned.imag, turned.real) / math.tau * per_cycle_mps
    by_range_mps = _range_rate_mps(residual, centre, audible)
    cycles = round((by_range_mps - by_phase_mps) / per_cycle_mps)
    return by_phase_mps + cycles * per_cycle_mps


def _range_rate_mps(
    residual: NDArray[np.complex128], centre: int, audible: NDArray[np.float64]
) -> float:
    """Return the change of range over the last half second, at 2 m/s at most.

    0 if nothing was audible half a second ago, as when a chest pauses.
    """
    now = _mean_power(residual[-_NEWEST_FRAMES:])
    before = _mean_power(residual[-_NEWEST_FRAMES - _EARLIER_BY : -_EARLIER_BY])
    reach = 20
    first = max(centre - reach, 0)
    earlier = first + int(np.argmax(before[first : centre + reach + 1]))
    if before[earlier] < audible[earlier]:
        return 0.0
    moved_bins = _centroid(now, centre) - _centroid(before, earlier)
    return moved_bins * x4.BASEBAND_BIN_M * FRAME_RATE_HZ / _EARLIER_BY


def _centroid(power: NDArray[np.float64], centre: int) -> float:
    near = np.arange(max(centre - 2, 0), min(centre + 3, len(power)))
    weight = power[near]
    total = float(weight.sum())
    return float((near * weight).sum()) / total if total > 0 else float(centre)


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneState:
    """What the profile knows after a tick: who is in the zone, and where it moves.

    It initialises until matrices and noise map are there. Movement is that of `movement_list`.
    """

    state: PresenceState
    detections: tuple[DetectedPerson, ...]
    movement_slow: tuple[float, ...]
    movement_fast: tuple[float, ...]


class PresenceProcessing:
    """Matrices, noise map and detection of one run of the profile.

    Attributes
    ----------
    noise_map
        As it is now; an incomplete one is created from the first matrices.
    power, excess
        The matrices of the last tick, as far as they were full, and movement over the noise map
        per bin, once there is one; by instance.
    """

    def __init__(self, sweep: ProfileSweep, noise_map: NoiseMap) -> None:
        self._sweep = sweep
        self._slow_time = {matrix.instance: SlowTime(matrix) for matrix in MATRICES}
        self.noise_map = noise_map
        self.power: Powers = {}
        self.excess: dict[MatrixInstance, NDArray[np.float64]] = {}

    def pulses(self, instance: MatrixInstance) -> NDArray[np.complex128]:
        """Return the newest pulses of a matrix, oldest first, shape (n_pulses, n_bins)."""
        return self._slow_time[instance].pulses()

    def add(self, iq: NDArray[np.complex128]) -> None:
        for slow_time in self._slow_time.values():
            slow_time.add(iq)

    def refill(self) -> None:
        """Forget the frames, because a gap follows; the noise map stays."""
        for slow_time in self._slow_time.values():
            slow_time.clear()

    def tick(self, sensitivity: int) -> ZoneState:
        """Compute the matrices, and from them who is there."""
        self.power = {
            instance: slow_time.power()
            for instance, slow_time in self._slow_time.items()
            if slow_time.full
        }
        ready = len(self.power) == len(self._slow_time)
        if ready and not self.noise_map.complete:
            self.noise_map.learn(self.power)
            ready = False
        if not ready:
            nothing = movement_list(self._sweep, np.ones(self._sweep.n_bins))
            return ZoneState(
                state=PresenceState.INITIALIZING,
                detections=(),
                movement_slow=nothing,
                movement_fast=nothing,
            )
        slow, fast = (excess_over(self.noise_map, self.power, matrix) for matrix in (SLOW, FAST))
        self.excess = {SLOW.instance: slow, FAST.instance: fast}
        either = np.maximum(slow, fast)
        frames = self._slow_time[FAST.instance].pulses()
        found = detections(self._sweep, either, self.noise_map, frames, sensitivity)
        self.noise_map.adapt(self.power, either < _ABSORBABLE)
        return ZoneState(
            state=PresenceState.PRESENCE if found else PresenceState.NO_PRESENCE,
            detections=found,
            movement_slow=movement_list(self._sweep, slow),
            movement_fast=movement_list(self._sweep, fast),
        )
