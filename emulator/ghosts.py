"""Target-wall multipath: echoes that reach a target, or come back from it, by way of a mirror.

Formulas and sources are on the model page, ``emulator.echo``. Seen from the target, the radar
stands where it is and once more behind every face that shows it: legs from there to the target,
one for the way out and one for the way back, make every path with at most one mirror each way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.diffraction import past_edge
from emulator.reflections import NEAREST_M, Reflections, Scatterers, Viewpoint, beam_gain
from emulator.walls import ON_THE_FACE_M, Faces, closed_ends, length, passing

__all__ = ["direct_share", "ghost_reflections", "spread"]

Array = NDArray[np.float64]

WEAKEST_LEG = 1e-3
"""A leg by way of a mirror counts from this share of a free one on boresight: -60 dB."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Legs:
    """Ways from the radar to the target: shape (n_frames, n_targets, n_legs) each.

    The first is the straight one, the others go by way of a mirror each. ``gain`` is the share of
    a free leg's amplitude on boresight, and 0 where there is no leg; ``to_x``, ``to_y`` is the
    unit vector from the target back along the leg.
    """

    length_m: Array
    gain: Array
    to_x: Array
    to_y: Array


def direct_share(
    faces: Faces, scatterers: Scatterers, view: Viewpoint, wavelength_m: float
) -> Array:
    """Return what share of the amplitude gets from the radar to each scatterer: (n_frames, k)."""
    x, y = _targets(scatterers, view)
    share = passing(
        faces,
        np.broadcast_to(view.x_m, x.shape).ravel(),
        np.broadcast_to(view.y_m, x.shape).ravel(),
        x.ravel(),
        y.ravel(),
        wavelength_m=wavelength_m,
    )
    return share.reshape(x.shape)


def ghost_reflections(
    faces: Faces, scatterers: Scatterers, view: Viewpoint, share: Array, wavelength_m: float
) -> Reflections:
    """Return target echoes with at least one mirror on the way, shape (n_frames, any).

    Parameters
    ----------
    faces
        The mirrors.
    scatterers
        Targets or a person, k of them.
    view
        The radar.
    share
        Shape (n_frames, k): of the straight leg, from `direct_share`.
    wavelength_m
        Of the carrier.
    """
    legs = _legs(faces, scatterers, view, share, wavelength_m)
    swell_m = np.broadcast_to(scatterers.swell_m, share.shape)
    range_m, amplitude, phase_rad = [], [], []
    n_legs = legs.gain.shape[2]
    for out in range(n_legs):
        for back in range(max(out, 1), n_legs):
            cosine = (
                legs.to_x[:, :, out] * legs.to_x[:, :, back]
                + legs.to_y[:, :, out] * legs.to_y[:, :, back]
            )
            half_cosine = np.sqrt(np.clip(0.5 * (1 + cosine), 0.0, 1.0))
            length_out, length_back = legs.length_m[:, :, out], legs.length_m[:, :, back]
            # Out by one and back by the other, and the reverse: equally long, so they add.
            both_ways = 1.0 if out == back else 2.0
            amplitude.append(
                both_ways
                * legs.gain[:, :, out]
                * legs.gain[:, :, back]
                * spread(scatterers, length_out, length_back, half_cosine)
            )
            range_m.append(0.5 * (length_out + length_back) - swell_m * half_cosine)
            mirrors = 1 if out == 0 else 2
            phase_rad.append(scatterers.phase_rad + np.pi * mirrors)
    if not range_m:
        empty = np.empty((len(share), 0))
        return Reflections(range_m=empty, amplitude=empty, phase_rad=np.empty(0))
    return Reflections(
        range_m=np.concatenate(range_m, axis=1),
        amplitude=np.concatenate(amplitude, axis=1),
        phase_rad=np.concatenate(phase_rad),
    )


def spread(scatterers: Scatterers, out_m: Array, back_m: Array, half_cosine: Array) -> Array:
    """Return the echo's amplitude for two different legs, shape (n_frames, k), beam left aside.

    With equal legs it is that of `emulator.reflections.direct_reflections`.

    Parameters
    ----------
    scatterers
        k of them.
    out_m, back_m
        Shape (n_frames, k): lengths of the legs, to the scatterer's axis.
    half_cosine
        Shape (n_frames, k): cosine of half the angle between the legs at the scatterer.
    """
    radius_m = scatterers.radius_m
    s1 = np.maximum(out_m - radius_m, NEAREST_M)
    s2 = np.maximum(back_m - radius_m, NEAREST_M)
    around = np.where(radius_m > 0, half_cosine, 1.0)  # a thin rod sends the same everywhere
    bent = radius_m * around * (s1 + s2) + 2 * s1 * s2
    line = np.sqrt(4 * (1 + radius_m) * around / ((s1 + s2) * bent))
    outside = (out_m > radius_m) & (back_m > radius_m)
    return scatterers.strength * np.where(scatterers.exponent == 2.0, 1 / (s1 * s2), line) * outside


def _legs(
    faces: Faces, scatterers: Scatterers, view: Viewpoint, share: Array, wavelength_m: float
) -> _Legs:
    x, y = _targets(scatterers, view)
    straight_x, straight_y = view.x_m - x, view.y_m - y
    straight_m = np.maximum(length(straight_x, straight_y), NEAREST_M)
    straight_cos = -(straight_x * view.boresight_x + straight_y * view.boresight_y) / straight_m
    straight_gain = share * np.sqrt(beam_gain(straight_cos))

    # All candidates as flat lists in the order frame, target, face.
    x_all, y_all = x[:, :, np.newaxis], y[:, :, np.newaxis]
    radar_height = faces.height(view.x_m, view.y_m)
    target_height = faces.height(x_all, y_all)
    seen = (radar_height > 0) | ~faces.outward_only
    candidate = (radar_height * seen)[:, np.newaxis, :] * target_height > 0
    candidate &= faces.reflection > WEAKEST_LEG
    # What stands on a face has no image in it: its strength is that of both together.
    candidate &= np.abs(target_height) > ON_THE_FACE_M
    candidate &= np.abs(radar_height)[:, np.newaxis, :] > ON_THE_FACE_M
    candidate &= (scatterers.strength > 0)[..., np.newaxis]
    frame, target, number = np.nonzero(candidate)
    face = faces.take(number)
    radar_x, radar_y = view.x_m[frame, 0], view.y_m[frame, 0]
    target_x, target_y = x[frame, target], y[frame, target]
    image_x, image_y = face.mirrored(radar_x, radar_y)
    to_x, to_y = image_x - target_x, image_y - target_y
    length_m = length(to_x, to_y)

    height_r = np.abs(radar_height[frame, number])
    height_t = np.abs(target_height[frame, target, number])
    start = face.along(radar_x, radar_y)
    bounce = start + (face.along(target_x, target_y) - start) * height_r / (height_r + height_t)
    closed = closed_ends(faces, radar_height)[frame, number]
    over_a = length(face.a_x - radar_x, face.a_y - radar_y)
    over_a += length(face.a_x - target_x, face.a_y - target_y)
    over_b = length(face.b_x - radar_x, face.b_y - radar_y)
    over_b += length(face.b_x - target_x, face.b_y - target_y)
    lost = past_edge(over_a - length_m, bounce < 0, wavelength_m) * ~closed[:, 0]
    lost += past_edge(over_b - length_m, bounce > face.length_m, wavelength_m) * ~closed[:, 1]
    bounce_x, bounce_y = face.at(np.clip(bounce, 0.0, face.length_m))
    dx, dy = bounce_x - radar_x, bounce_y - radar_y
    cos_angle = dx * view.boresight_x[frame, 0] + dy * view.boresight_y[frame, 0]
    cos_angle /= np.maximum(length(dx, dy), NEAREST_M)
    gain = face.reflection * np.abs(1 - lost) * np.sqrt(beam_gain(cos_angle))

    kept = np.flatnonzero(gain > WEAKEST_LEG)
    for end_x, end_y in ((radar_x, radar_y), (target_x, target_y)):
        gain[kept] *= passing(
            faces,
            bounce_x[kept],
            bounce_y[kept],
            end_x[kept],
            end_y[kept],
            but=(face.body[kept],),
            wavelength_m=wavelength_m,
        )
        kept = kept[gain[kept] > WEAKEST_LEG]

    # Back to one row for each target, with as many places as the richest needs.
    frame, target = frame[kept], target[kept]
    row = frame * x.shape[1] + target
    first_of_row = np.searchsorted(row, row, side="left")
    place = 1 + np.arange(len(row)) - first_of_row
    shape = (*x.shape, 1 + int(place.max(initial=0)))
    legs = _Legs(
        length_m=np.ones(shape), gain=np.zeros(shape), to_x=np.ones(shape), to_y=np.zeros(shape)
    )
    for table, straight, mirrored in (
        (legs.length_m, straight_m, length_m[kept]),
        (legs.gain, straight_gain, gain[kept]),
        (legs.to_x, straight_x / straight_m, to_x[kept] / length_m[kept]),
        (legs.to_y, straight_y / straight_m, to_y[kept] / length_m[kept]),
    ):
        table[:, :, 0] = straight
        table[frame, target, place] = mirrored
    return legs


def _targets(scatterers: Scatterers, view: Viewpoint) -> tuple[Array, Array]:
    """Return positions of shape (n_frames, k), moving or not."""
    shape = (len(view.x_m), scatterers.x_m.shape[-1])
    return np.broadcast_to(scatterers.x_m, shape), np.broadcast_to(scatterers.y_m, shape)
