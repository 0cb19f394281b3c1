"""Presence and matrices as messages.

Assumed where the reference is silent: counters of all messages are those of radar frames; radar
cross sections are 0, because released firmware computes none; bytes begin at -130 dB and go in
steps of 0.5 dB, rounded to the nearest.

Source: protocol reference 7.2 and 7.3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from emulator.profiles.detection import threshold_db
from emulator.profiles.doppler import Matrix
from emulator.profiles.presence import Presence
from emulator.profiles.sweep import FRAME_RATE_HZ, ProfileSweep
from xethru_protocol import messages as m
from xethru_protocol.codes import OutputFeature, PresenceDirection

__all__ = ["MATRIX_REPORTS", "matrix_reports", "moving_list", "presence_single"]

BYTE_START_DB = -130.0
BYTE_STEP_DB = 0.5
_DB_PER_QUALITY = 3.0
BEST_QUALITY = 10

MATRIX_REPORTS: dict[int, Callable[..., m.Response]] = {
    OutputFeature.PULSEDOPPLER_FLOAT: m.PulseDopplerFloat,
    OutputFeature.PULSEDOPPLER_BYTE: m.PulseDopplerByte,
    OutputFeature.NOISEMAP_FLOAT: m.NoiseMapFloat,
    OutputFeature.NOISEMAP_BYTE: m.NoiseMapByte,
}
_BYTES = frozenset({OutputFeature.PULSEDOPPLER_BYTE, OutputFeature.NOISEMAP_BYTE})


def presence_single(counter: int, presence: Presence, sensitivity: int) -> m.PresenceSingle:
    """Return the nearest thing to one person: the first detection.

    Signal quality is a step per 3 dB above the threshold, 1...10, and 0 without presence.
    """
    strongest = presence.detections[0] if presence.detections else None
    quality = 0
    if strongest is not None:
        margin_db = strongest.excess_db - threshold_db(sensitivity)
        quality = min(max(round(margin_db / _DB_PER_QUALITY), 1), BEST_QUALITY)
    return m.PresenceSingle(
        counter=counter & 0xFFFFFFFF,
        state=presence.state,
        distance_m=0.0 if strongest is None else strongest.distance_m,
        direction=PresenceDirection.STILL if strongest is None else strongest.direction,
        signal_quality=quality,
    )


def moving_list(counter: int, presence: Presence) -> m.PresenceMovingList:
    """Return movement by range, and the distances of all detections."""
    nothing = (0.0,) * len(presence.detections)
    return m.PresenceMovingList(
        counter=counter & 0xFFFFFFFF,
        state=presence.state,
        movement_slow=presence.movement_slow,
        movement_fast=presence.movement_fast,
        detection_distance_m=tuple(found.distance_m for found in presence.detections),
        detection_rcs=nothing,
        detection_velocity=nothing,
    )


def matrix_reports(
    feature: int,
    matrix: Matrix,
    sweep: ProfileSweep,
    power: NDArray[np.float64],
    *,
    counter: int,
    matrix_counter: int,
) -> Iterator[m.Response]:
    """Yield the messages of one matrix, a range bin each.

    Parameters
    ----------
    feature
        A key of `MATRIX_REPORTS`.
    matrix
        Which of the two.
    sweep
        Its ranges.
    power
        Shape (n_bins, matrix.pulses), of pulse-Doppler or noise map; a snapshot.
    counter
        Of the newest frame in it.
    matrix_counter
        Matrices of this kind since the profile started.
    """
    message = MATRIX_REPORTS[feature]
    levels = _levels(power) if feature in _BYTES else None
    for index, range_m in enumerate(sweep.range_m.tolist()):
        content = (
            {"power": power[index].astype(np.float32)}
            if levels is None
            else {
                "levels": levels[index].tobytes(),
                "byte_step_start_db": BYTE_START_DB,
                "byte_step_size_db": BYTE_STEP_DB,
            }
        )
        yield message(
            counter=counter & 0xFFFFFFFF,
            matrix_counter=matrix_counter & 0xFFFFFFFF,
            range_idx=index,
            range_bins=sweep.n_bins,
            frequency_count=matrix.pulses,
            pulsedoppler_instance=int(matrix.instance),
            fps=FRAME_RATE_HZ,
            fps_decimated=matrix.rate_hz,
            frequency_start_hz=matrix.start_hz,
            frequency_step_hz=matrix.step_hz,
            range_m=range_m,
            **content,
        )


def _levels(power: NDArray[np.float64]) -> NDArray[np.uint8]:
    decibels = 10 * np.log10(np.maximum(power, np.finfo(np.float64).tiny))
    steps = np.rint((decibels - BYTE_START_DB) / BYTE_STEP_DB)
    return np.clip(steps, 0, 255).astype(np.uint8)
