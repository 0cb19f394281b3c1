"""Echoes of walls and boxes: mirror images, edges and corners.

Formulas and sources are on the model page, ``emulator.echo``. A radar sees itself in a flat face:
the transmitter's image is as far behind as the radar is in front.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.diffraction import edge_wave, past_edge
from emulator.reflections import NEAREST_M, Reflections, Viewpoint, beam_gain
from emulator.scene_tables import MIRROR_AMPLITUDE_1M
from emulator.walls import ON_THE_FACE_M, TOUCHING_M, Faces, closed_ends, length, passing

__all__ = ["CornerPairs", "corner_pairs", "corner_reflections", "face_reflections"]

Array = NDArray[np.float64]

_PARALLEL = math.sin(math.radians(5.0))
_WEAKEST_CORNER = 1e-2  # of one whose edges are far: the rest is deep in Fresnel's shadow


def face_reflections(faces: Faces, view: Viewpoint, wavelength_m: float) -> Reflections:
    """Return mirror images and edge waves of single faces.

    Shape (n_frames, 3 n_faces): all mirrors, all ends a, all ends b.
    """
    height = faces.height(view.x_m, view.y_m)
    along = faces.along(view.x_m, view.y_m)
    mirror_m = np.abs(height)
    heard = MIRROR_AMPLITUDE_1M * faces.reflection * ((height > 0) | ~faces.outward_only)
    closed = closed_ends(faces, height)
    foot_x, foot_y = faces.at(along)
    on_it = (along >= 0) & (along <= faces.length_m)

    range_m = [mirror_m]
    amplitude = [heard * on_it / np.maximum(mirror_m, NEAREST_M)]
    phase_rad = [np.full(height.shape, np.pi)]
    at_x, at_y = [foot_x], [foot_y]
    for end, end_x, end_y, beyond in (
        (0, faces.a_x, faces.a_y, along < 0),
        (1, faces.b_x, faces.b_y, along > faces.length_m),
    ):
        end_m = length(end_x - view.x_m, end_y - view.y_m)
        size, lag_rad = edge_wave(2 * (end_m - mirror_m), wavelength_m)
        obliquity = mirror_m / np.maximum(end_m, NEAREST_M)
        range_m.append(end_m)
        amplitude.append(
            heard * size * obliquity * ~closed[:, :, end] / np.maximum(end_m, NEAREST_M)
        )
        # Within the face an edge takes away from the mirror, beyond it an edge stands for it.
        phase_rad.append(lag_rad + np.where(beyond, np.pi, 0.0))
        at_x.append(np.broadcast_to(end_x, height.shape))
        at_y.append(np.broadcast_to(end_y, height.shape))

    strength = np.concatenate(amplitude, axis=1)
    x, y = np.concatenate(at_x, axis=1), np.concatenate(at_y, axis=1)
    ranges = np.concatenate(range_m, axis=1)
    strength *= beam_gain(_cos_angle(view, x, y))
    frame, path = np.nonzero(strength)
    strength[frame, path] *= (
        passing(
            faces,
            view.x_m[frame, 0],
            view.y_m[frame, 0],
            x[frame, path],
            y[frame, path],
            but=(faces.body[path % len(faces)],),
            wavelength_m=wavelength_m,
        )
        ** 2
    )
    return Reflections(
        range_m=ranges, amplitude=strength, phase_rad=np.concatenate(phase_rad, axis=1)
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CornerPairs:
    """Ordered pairs of faces that may form a corner, both orders of each: shape (k,).

    Attributes
    ----------
    first, second
        The face reflected by first, and the other one.
    meet_first_m, meet_second_m
        Where their lines meet, along each of them.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    meet_first_m: Array
    meet_second_m: Array


def corner_pairs(faces: Faces) -> CornerPairs:
    """Return the pairs of faces of different bodies that reflect and are not parallel."""
    cross = faces.t_x[:, np.newaxis] * faces.t_y - faces.t_y[:, np.newaxis] * faces.t_x
    reflect = (faces.reflection[:, np.newaxis] * faces.reflection) > 0
    apart = faces.body[:, np.newaxis] != faces.body
    first, second = np.nonzero(apart & reflect & (np.abs(cross) > _PARALLEL))
    one, two = faces.take(first), faces.take(second)
    dx, dy = two.a_x - one.a_x, two.a_y - one.a_y
    return CornerPairs(
        first=first,
        second=second,
        meet_first_m=(dx * two.t_y - dy * two.t_x) / cross[first, second],
        meet_second_m=(dx * one.t_y - dy * one.t_x) / cross[first, second],
    )


def corner_reflections(
    faces: Faces, pairs: CornerPairs, view: Viewpoint, wavelength_m: float
) -> Reflections:
    """Return the double bounces radar - first - second - radar, shape (n_frames, k)."""
    one, two = faces.take(pairs.first), faces.take(pairs.second)
    x, y = view.x_m, view.y_m
    height1, height2 = one.height(x, y), two.height(x, y)
    once_x, once_y = one.mirrored(x, y)
    height_once = two.height(once_x, once_y)
    twice_x, twice_y = two.mirrored(once_x, once_y)
    path_m = length(twice_x - x, twice_y - y)

    open1, open2 = ~one.outward_only | (height1 > 0), ~two.outward_only | (height2 > 0)
    near1, far1, apex1 = _seen_part(one, pairs.meet_first_m, two, height2)
    near2, far2, apex2 = _seen_part(two, pairs.meet_second_m, one, height1)
    exists = (height_once * height2 > 0) & open1 & open2 & (near1 != far1) & (near2 != far2)
    exists &= np.minimum(np.abs(height1), np.abs(height2)) > ON_THE_FACE_M

    share2 = height_once / np.where(exists, height_once + height2, 1.0)
    along_once = two.along(once_x, once_y)
    bounce2 = along_once + (two.along(x, y) - along_once) * share2
    held2 = _between(bounce2, near2, far2)
    x2, y2 = two.at(held2)
    # Bounce 2 is held on the radar's side of the first face, so the way to it bounces there.
    rise = np.abs(one.height(x2, y2))
    share1 = np.abs(height1) / np.maximum(np.abs(height1) + rise, 1e-12)
    start1 = one.along(x, y)
    bounce1 = start1 + (one.along(x2, y2) - start1) * share1
    x1, y1 = one.at(_between(bounce1, near1, far1))

    # Edges, one by one: the way over the edge against the way of the mirrors.
    back_x, back_y = two.mirrored(x, y)
    window = np.ones_like(path_m)
    for face, edge, inwards, counts, start, stop in (
        (two, near2, (bounce2 - near2) * np.sign(far2 - near2), exists, (once_x, once_y), (x, y)),
        (two, far2, (far2 - bounce2) * np.sign(far2 - near2), exists, (once_x, once_y), (x, y)),
        (one, far1, (far1 - bounce1) * np.sign(far1 - near1), exists, (x, y), (back_x, back_y)),
        (
            one,
            near1,
            (bounce1 - near1) * np.sign(far1 - near1),
            exists & ~(apex1 & apex2),  # the apex is one edge, not two
            (x, y),
            (back_x, back_y),
        ),
    ):
        edge_x, edge_y = face.at(edge)
        over_m = length(edge_x - start[0], edge_y - start[1]) + length(
            stop[0] - edge_x, stop[1] - edge_y
        )
        passes = np.abs(past_edge(over_m - path_m, inwards > 0, wavelength_m))
        window *= np.where(counts, passes, 1.0)

    half_m = path_m / 2
    amplitude = MIRROR_AMPLITUDE_1M * one.reflection * two.reflection * window
    amplitude *= exists & (window > _WEAKEST_CORNER)
    amplitude /= np.maximum(half_m, NEAREST_M)
    amplitude *= np.sqrt(beam_gain(_cos_angle(view, x1, y1)))
    amplitude *= np.sqrt(beam_gain(_cos_angle(view, x2, y2)))
    frame, pair = np.nonzero(amplitude)
    here_x, here_y = x[frame, 0], y[frame, 0]
    body1, body2 = one.body[pair], two.body[pair]
    at1 = x1[frame, pair], y1[frame, pair]
    at2 = x2[frame, pair], y2[frame, pair]
    both = (body1, body2)
    for a_x, a_y, b_x, b_y, but in (
        (here_x, here_y, *at1, (body1,)),
        (*at1, *at2, both),
        (*at2, here_x, here_y, (body2,)),
    ):
        amplitude[frame, pair] *= passing(
            faces, a_x, a_y, b_x, b_y, but=but, wavelength_m=wavelength_m
        )
    return Reflections(range_m=half_m, amplitude=amplitude, phase_rad=np.zeros(half_m.shape[1]))


def _seen_part(
    face: Faces, meet_m: Array, other: Faces, radar_height: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the part of a face on the radar's side of another: near and far end, and its kind.

    Near and far are from where the faces' lines meet; they are equal where nothing is left: what
    is thinner than ``ON_THE_FACE_M`` is the rounding of faces that share an end. The kind is
    whether the near end is the apex of the corner.
    """
    slope = other.t_x * face.t_y - other.t_y * face.t_x  # of the height over the other, along t
    upwards = slope * radar_height > 0
    near = np.where(upwards, np.maximum(meet_m, 0.0), np.minimum(meet_m, face.length_m))
    far = np.where(upwards, face.length_m, 0.0)
    gone = np.where(upwards, far - near, near - far) <= ON_THE_FACE_M
    return near, np.where(gone, near, far), np.abs(near - meet_m) <= TOUCHING_M


def _between(value: Array, one: Array, other: Array) -> Array:
    return np.clip(value, np.minimum(one, other), np.maximum(one, other))


def _cos_angle(view: Viewpoint, x: Array, y: Array) -> Array:
    dx, dy = x - view.x_m, y - view.y_m
    range_m = np.maximum(length(dx, dy), NEAREST_M)
    cosine: Array = (dx * view.boresight_x + dy * view.boresight_y) / range_m
    return cosine
