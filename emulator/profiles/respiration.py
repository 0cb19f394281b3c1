"""The respiration profile's processing: who breathes, how often, and how far the chest is out.

It stands on the presence profile's: detections, excess and movement are those of
`emulator.profiles.presence`. The nearest detection is the person whose breathing is reported.

Chest
    The 85 pulses of the slow matrix, 19.94 s, at the person's bin lie on an arc around what stands
    still there. A circle through them gives the arc's centre, their angle about it the phase, and
    that the displacement, lambda / 4 pi per radian.
Rate
    The highest peak between 6 and 40 breaths a minute of the displacement's spectrum (Hann window,
    zero-padded); the window resolves 3 a minute. It is clear if the peak holds at least half of
    the power above 3 a minute and is not a slope at the edge of the band, as a shift of the body
    leaves one; only then a rate is reported.
State
    Initialising until the matrices are full and the noise map is there; no movement without a
    detection; movement tracking while the person walks; breathing with a clear rate; else movement.

The status, sleep and vital sign messages are of the same tick. Heart rate, its distance and its
confidence are 0: no heartbeat is looked for. SLEEPSTAGE is not sent, because no output control
switches it on (4.7).

The reference gives the fields of messages only (7.4); everything here is ours. It is a test signal
with a known answer and says nothing about what a real module measures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.profiles.doppler import FAST, SLOW, ProfileSweep
from emulator.profiles.presence import (
    DetectedPerson,
    PresenceProcessing,
    ZoneState,
    movement_share,
    signal_quality,
)
from xethru_protocol.processing.doppler import hann
from xethru_protocol.wire import messages as m
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import PresenceDirection, PresenceState, RespirationState
from xethru_protocol.wire.x4 import SPEED_OF_LIGHT_MPS

SLOWEST_HZ, FASTEST_HZ = 6 / 60, 40 / 60
_LEAST_HZ = 3 / 60
"""Below it lies what is left of a person's sway."""
_SPECTRUM = 2048
_CLEAR = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Respiration:
    """What the profile knows after a tick.

    Attributes
    ----------
    rate_hz, chest_mm
        Breaths per second, and displacement of the chest towards the radar from its mean over
        20 s [mm]; 0 unless the state is BREATHING.
    confidence
        The peak's share of the power, 0 ... 1, likewise.
    """

    state: RespirationState
    person: DetectedPerson | None = None
    rate_hz: float = 0.0
    chest_mm: float = 0.0
    confidence: float = 0.0


def respiration(
    presence: ZoneState, processing: PresenceProcessing, sweep: ProfileSweep
) -> Respiration:
    """Return who breathes how, from the presence profile's tick and its slow pulses."""
    if presence.state is PresenceState.INITIALIZING:
        return Respiration(state=RespirationState.INITIALIZING)
    if not presence.detections:
        return Respiration(state=RespirationState.NO_MOVEMENT)
    person = min(presence.detections, key=lambda found: found.distance_m)
    if person.direction is not PresenceDirection.STILL:
        return Respiration(state=RespirationState.MOVEMENT_TRACKING, person=person)
    index = int(np.argmin(np.abs(sweep.range_m - person.distance_m)))
    pulses = processing.pulses(SLOW.instance)[:, index]
    chest_m = displacement_m(pulses, SPEED_OF_LIGHT_MPS / sweep.carrier_hz)
    found = breathing_rate_hz(chest_m, SLOW.rate_hz)
    if found is None:
        return Respiration(state=RespirationState.MOVEMENT, person=person)
    rate_hz, share = found
    return Respiration(
        state=RespirationState.BREATHING,
        person=person,
        rate_hz=rate_hz,
        chest_mm=1e3 * float(chest_m[-1]),
        confidence=share,
    )


def displacement_m(pulses: NDArray[np.complex128], wavelength_m: float) -> NDArray[np.float64]:
    """Return the displacement towards the radar of what moves on an arc, mean 0, shape (n,).

    The circle is the algebraic least-squares fit: ``|z|^2 = 2 Re(conj(centre) z) + rest``.
    """
    columns = np.stack([2 * pulses.real, 2 * pulses.imag, np.ones(len(pulses))], axis=1)
    scale = float(np.abs(pulses).max()) or 1.0
    columns[:, :2] /= scale
    fit, *_ = np.linalg.lstsq(columns, np.abs(pulses / scale) ** 2, rcond=None)
    centre = scale * complex(fit[0], fit[1])
    phase = np.unwrap(np.angle(pulses - centre))
    return np.asarray((phase - phase.mean()) * wavelength_m / (4 * math.pi), dtype=np.float64)


def breathing_rate_hz(
    chest_m: NDArray[np.float64], sampling_hz: float
) -> tuple[float, float] | None:
    """Return the rate of a periodic displacement, shape (n,), and its share of the power.

    None if it is not clear.
    """
    weighted = (chest_m - chest_m.mean()) * hann(len(chest_m))
    power = np.abs(np.fft.rfft(weighted, _SPECTRUM)) ** 2
    frequency_hz = np.fft.rfftfreq(_SPECTRUM, 1 / sampling_hz)
    breaths = np.flatnonzero((frequency_hz >= SLOWEST_HZ) & (frequency_hz <= FASTEST_HZ))
    peak = int(breaths[np.argmax(power[breaths])])
    if power[peak - 1 : peak + 2].max() > power[peak]:  # the slope of what lies outside the band
        return None
    lobe_hz = 2 * sampling_hz / len(chest_m)  # half the width of the window's main lobe
    near = np.abs(frequency_hz - frequency_hz[peak]) <= lobe_hz
    total = float(power[(frequency_hz >= _LEAST_HZ) | near].sum())
    share = float(power[near].sum()) / total if total > 0 else 0.0
    return (float(frequency_hz[peak]), share) if share >= _CLEAR else None


# --- messages


def status(counter: int, now: Respiration, sensitivity: int) -> m.RespStatus:
    person = now.person
    return m.RespStatus(
        counter=counter,
        state=now.state,
        rpm=round(60 * now.rate_hz),
        distance_m=0.0 if person is None else person.distance_m,
        movement_mm=now.chest_mm,
        signal_quality=0 if person is None else signal_quality(person, sensitivity),
    )


def sleep_status(
    counter: int, now: Respiration, presence: ZoneState, sensitivity: int
) -> m.SleepStatus:
    """Return the status with the zone's average movement, 0...100 (`presence.movement_list`)."""
    person = now.person
    return m.SleepStatus(
        counter=counter,
        state=now.state,
        rpm=60 * now.rate_hz,
        distance_m=0.0 if person is None else person.distance_m,
        signal_quality=0 if person is None else signal_quality(person, sensitivity),
        movement_slow=presence.movement_slow[0],
        movement_fast=presence.movement_fast[0],
    )


def vital_signs(
    counter: int, now: Respiration, processing: PresenceProcessing, sweep: ProfileSweep
) -> m.VitalSigns:
    """Return rate, distance and confidence 0...1 (assumed), and the zone's average movement.

    Movement is normalised as in `normalized_movement_list`; start and end are those of the zone.
    """
    slow, fast = _normalized_movement(processing, sweep)
    zone_m = sweep.range_m[sweep.in_zone]
    return m.VitalSigns(
        counter=counter,
        state=now.state,
        respiration_rate=60 * now.rate_hz,
        respiration_distance_m=0.0 if now.person is None else now.person.distance_m,
        respiration_confidence=now.confidence,
        heart_rate=0.0,
        heart_distance_m=0.0,
        heart_confidence=0.0,
        normalized_movement_slow=float(np.mean(slow)),
        normalized_movement_fast=float(np.mean(fast)),
        normalized_movement_start_m=float(zone_m[0]),
        normalized_movement_end_m=float(zone_m[-1]),
    )


def moving_list(counter: int, presence: ZoneState) -> m.RespirationMovingList:
    return m.RespirationMovingList(
        counter=counter,
        movement_slow=presence.movement_slow,
        movement_fast=presence.movement_fast,
    )


def detection_list(counter: int, presence: ZoneState) -> m.RespirationDetectionList:
    """Return all detections; radar cross sections are 0, as released firmware has them."""
    found = presence.detections
    return m.RespirationDetectionList(
        counter=counter,
        detection_distance_m=tuple(one.distance_m for one in found),
        detection_rcs=(0.0,) * len(found),
        detection_velocity=tuple(one.velocity_mps for one in found),
    )


def normalized_movement_list(
    counter: int, processing: PresenceProcessing, sweep: ProfileSweep
) -> m.RespirationNormalizedMovementList:
    """Return movement 0...1 per bin of the zone; 0 is an excess of 3 dB, 1 one of 40 dB."""
    slow, fast = _normalized_movement(processing, sweep)
    return m.RespirationNormalizedMovementList(
        counter=counter,
        start_m=float(sweep.range_m[sweep.in_zone][0]),
        bin_length_m=x4.BASEBAND_BIN_M,
        movement_slow=slow,
        movement_fast=fast,
    )


def _normalized_movement(
    processing: PresenceProcessing, sweep: ProfileSweep
) -> list[tuple[float, ...]]:
    """Return the movement in each bin of the zone, of the slow and of the fast matrix."""
    still = np.ones(sweep.n_bins)
    excesses = [processing.excess.get(matrix.instance, still) for matrix in (SLOW, FAST)]
    return [tuple(movement_share(excess[sweep.in_zone]).tolist()) for excess in excesses]
