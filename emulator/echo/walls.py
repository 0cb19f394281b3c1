"""Walls and boxes: their mirrors, edges, corners, echoes, and what passes through them.

A wave that passes an edge by a detour of ``d`` (its way over the edge less its straight or
mirrored way) does so at ``v = sqrt(4 d / wavelength)`` Fresnel parameters from the edge: for a
wall at R with the edge h beside the foot that is ``sqrt(2) h / sqrt(wavelength R / 2)``, the
first Fresnel zone. What gets past the edge into its shadow is (Kirchhoff; Born and Wolf,
Principles of Optics, 8.7.3; ITU-R P.526, 4.1)

    E(v) = 1 / (1 - j) integral_v^inf exp(-j pi u**2 / 2) du,    E(-v) = 1 - E(v),  E(0) = 1/2.

With ``E(v) = Q(v) exp(-j pi v**2 / 2)`` and the exponential written as a delay, Q is the wave
that comes from the edge itself: 1/2 at the boundary, 1 / (sqrt(2) pi v) far from it. All is taken
at the carrier: over the pulse's bandwidth, v changes by a tenth.

A face is a straight segment of the floor plan from ``a`` over its length along the unit vector
``t``; its normal ``n = (-t_y, t_x)`` is on its left. ``along`` and ``height`` are a point's
coordinates on t and n, from a. Faces of boxes are given clockwise, so that n points outwards.

A radar sees itself in a flat face: the transmitter's image is as far behind as the radar is in
front. Seen from a target, the radar stands where it is and once more behind every face that shows
it: legs from there to the target, one for the way out and one for the way back, make every path
with at most one mirror each way. All formulas and their sources are in ``emulator.echo.echo``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fresnel

from emulator.echo.paths import (
    NEAREST_M,
    Reflections,
    Scatterers,
    Viewpoint,
    beam_gain,
    mirrored_ways,
)
from emulator.scene.scene import MIRROR_AMPLITUDE_1M, ObjectSpec, WallSpec

Array = NDArray[np.float64]

TOUCHING_M = 0.02
"""Ends that come this near to another face meet it: plans are not drawn to the millimetre."""
ON_THE_FACE_M = 1e-3
"""What is nearer to a face than this stands on it: neither before it nor behind."""
WEAKEST_LEG = 1e-3
"""A leg by way of a mirror counts from this share of a free one on boresight: -60 dB."""
_RIGHT_ANGLE_TOLERANCE = math.sin(math.radians(1.0))
_PARALLEL = math.sin(math.radians(5.0))
_LEGS_TIMES_FACES = 16_000  # of one block of `passing`: stays in the processor's cache
_WEAKEST_CORNER = 1e-2  # of one whose edges are far: the rest is deep in Fresnel's shadow


def edge_wave(detour_m: Array, wavelength_m: float) -> tuple[Array, Array]:
    """Return magnitude and phase [rad] of Q for detours >= 0 of any shape."""
    v = _parameter(detour_m, wavelength_m)
    sine, cosine = fresnel(v)
    turn = 0.5 * np.pi * v * v
    s, c = 0.5 - sine, 0.5 - cosine
    cos, sin = np.cos(turn), np.sin(turn)
    # the auxiliary functions of the Fresnel integrals (DLMF 7.4): Q = (g - j f) / (1 - j)
    f, g = s * cos - c * sin, c * cos + s * sin
    return np.sqrt(0.5 * (f * f + g * g)), np.arctan2(g - f, g + f)


def past_edge(
    detour_m: Array, beyond: NDArray[np.bool_], wavelength_m: float
) -> NDArray[np.complex128]:
    """Return E: what passes an edge, at the carrier, any shape.

    Parameters
    ----------
    detour_m
        How much longer the way over the edge is, >= 0.
    beyond
        Whether the straight way is on the open side of the edge, so that v is negative.
    """
    sine, cosine = fresnel(_parameter(detour_m, wavelength_m))
    s, c = 0.5 - sine, 0.5 - cosine
    dark_re, dark_im = 0.5 * (c + s), 0.5 * (c - s)  # (c - j s) / (1 - j)
    passes = np.empty(dark_re.shape, dtype=np.complex128)
    passes.real = np.where(beyond, 1 - dark_re, dark_re)
    passes.imag = np.where(beyond, -dark_im, dark_im)
    return passes


def _parameter(detour_m: Array, wavelength_m: float) -> Array:
    v: Array = np.sqrt(np.maximum(detour_m, 0.0) * (4 / wavelength_m))
    return v


@dataclass(frozen=True, slots=True, kw_only=True)
class Closure:
    """An end of a face that stands on another one at a right angle.

    For a radar in the quarter between the two they are an inner corner: with the corner's mirror
    image the field is complete, and no edge is seen. From behind an L it is one.

    Attributes
    ----------
    face, end
        Whose end it is, and which: 0 is a, 1 is b.
    other
        The face it stands on.
    side
        +1.0 or -1.0: sign of the height over ``other`` where the corner is an inner one.
    own_sides
        Signs of the height over ``face`` where it is: both if the other goes on beyond the end.
    """

    face: int
    end: int
    other: int
    side: float
    own_sides: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Faces:
    """Flat reflectors, world frame; every array has the shape (n_faces,).

    Attributes
    ----------
    a_x, a_y, b_x, b_y
        Ends [m].
    t_x, t_y, length_m
        Unit vector from a to b, and their distance.
    reflection
        Magnitude of the reflection coefficient, 0 ... 1; its phase is pi.
    transmission
        Factor on the amplitude of what passes through, one way.
    body
        Which wall or box a face belongs to.
    outward_only
        Whether it reflects on the side of its normal only.
    closures
        Ends that are not edges.
    """

    a_x: Array
    a_y: Array
    b_x: Array
    b_y: Array
    t_x: Array
    t_y: Array
    length_m: Array
    reflection: Array
    transmission: Array
    body: NDArray[np.int64]
    outward_only: NDArray[np.bool_]
    closures: tuple[Closure, ...]

    def __len__(self) -> int:
        return len(self.length_m)

    def along(self, x: Array, y: Array) -> Array:
        """Return coordinates along t; here and below, the last axis is that of the faces, or 1."""
        return (x - self.a_x) * self.t_x + (y - self.a_y) * self.t_y

    def height(self, x: Array, y: Array) -> Array:
        height: Array = y - self.a_y
        height *= self.t_x
        across = x - self.a_x
        across *= self.t_y
        height -= across
        return height

    def at(self, along_m: Array) -> tuple[Array, Array]:
        """Return x and y of points on the faces' lines."""
        return self.a_x + along_m * self.t_x, self.a_y + along_m * self.t_y

    def mirrored(self, x: Array, y: Array) -> tuple[Array, Array]:
        twice = 2 * self.height(x, y)
        return x + twice * self.t_y, y - twice * self.t_x

    def take(self, index: NDArray[np.int64]) -> Faces:
        """Return some of the faces, in the order asked for; closures stay behind."""
        arrays = (each.name for each in fields(self) if each.name != "closures")
        return Faces(**{name: getattr(self, name)[index] for name in arrays}, closures=())


def faces_of(walls: tuple[WallSpec, ...], objects: tuple[ObjectSpec, ...]) -> Faces:
    ends: list[tuple[tuple[float, float], tuple[float, float]]] = []
    bodies: list[WallSpec | ObjectSpec] = []
    body: list[int] = []
    for wall in walls:
        ends.append((wall.from_m, wall.to_m))
        bodies.append(wall)
        body.append(len(body))
    for number, box in enumerate(objects, start=len(walls)):
        corners = _clockwise_corners(box)
        ends.extend(zip(corners, corners[1:] + corners[:1], strict=True))
        bodies.extend([box] * 4)
        body.extend([number] * 4)
    a_x, a_y, b_x, b_y = np.array(ends, dtype=np.float64).reshape(-1, 4).T
    length_m = np.sqrt((b_x - a_x) ** 2 + (b_y - a_y) ** 2)
    plain = Faces(
        a_x=a_x,
        a_y=a_y,
        b_x=b_x,
        b_y=b_y,
        t_x=(b_x - a_x) / length_m,
        t_y=(b_y - a_y) / length_m,
        length_m=length_m,
        reflection=np.array([each.reflection for each in bodies], dtype=np.float64),
        transmission=np.array([each.transmission for each in bodies], dtype=np.float64),
        body=np.array(body, dtype=np.int64),
        outward_only=np.array([isinstance(each, ObjectSpec) for each in bodies], dtype=np.bool_),
        closures=(),
    )
    return _with_closures(plain)


def _clockwise_corners(box: ObjectSpec) -> list[tuple[float, float]]:
    yaw = math.radians(box.yaw_deg)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    half_x, half_y = box.width_m / 2, box.depth_m / 2
    return [
        (box.x_m + cosine * x - sine * y, box.y_m + sine * x + cosine * y)
        for x, y in ((-half_x, -half_y), (-half_x, half_y), (half_x, half_y), (half_x, -half_y))
    ]


def _with_closures(faces: Faces) -> Faces:
    upright = np.abs(np.outer(faces.t_x, faces.t_x) + np.outer(faces.t_y, faces.t_y))
    # A box has no inner corners of its own.
    meets = (upright < _RIGHT_ANGLE_TOLERANCE) & (faces.body[:, np.newaxis] != faces.body)
    ends = [(faces.a_x[:, np.newaxis], faces.a_y[:, np.newaxis])]
    ends.append((faces.b_x[:, np.newaxis], faces.b_y[:, np.newaxis]))
    # Heights of other faces' ends over a face: [other, face, end].
    reaches = np.stack([faces.height(x, y) for x, y in ends], axis=-1)
    found: list[Closure] = []
    for end, (x, y) in enumerate(ends):
        along = faces.along(x, y)
        beside = np.maximum(np.maximum(-along, along - faces.length_m), 0.0)
        touches = meets & (length(beside, faces.height(x, y)) <= TOUCHING_M)
        other_end = faces.height(*ends[1 - end])
        found.extend(
            Closure(
                face=face,
                end=end,
                other=other,
                side=math.copysign(1.0, other_end[face, other]),
                own_sides=tuple(
                    own
                    for own in (1.0, -1.0)
                    if float((own * reaches[other, face]).max()) > TOUCHING_M
                ),
            )
            for face, other in np.argwhere(touches).tolist()
        )
    return replace(faces, closures=tuple(found))


def closed_ends(faces: Faces, height_m: Array) -> NDArray[np.bool_]:
    """Return which ends are not edges for a radar, shape (n_frames, n_faces, 2).

    Parameters
    ----------
    height_m
        Shape (n_frames, n_faces): the radar's height over each of them.
    """
    closed = np.zeros((*height_m.shape, 2), dtype=np.bool_)
    for closure in faces.closures:
        inside = height_m[:, closure.other] * closure.side > 0
        for own in closure.own_sides:
            before = height_m[:, closure.face] * own > 0
            closed[:, closure.face, closure.end] |= inside & before
    return closed


def passing(
    faces: Faces,
    from_x: Array,
    from_y: Array,
    to_x: Array,
    to_y: Array,
    *,
    but: tuple[NDArray[np.int64], ...] = (),
    wavelength_m: float,
) -> Array:
    """Return what share of the amplitude arrives at the far end of straight legs, shape (m,).

    A face between the ends lets ``|t + (1 - t) (E(v_a) + E(v_b))|`` pass: its transmission, and
    what bends round its two ends. A leg that ends on a face does not cross it.

    Parameters
    ----------
    faces
        What may stand in the way.
    from_x, from_y, to_x, to_y
        Shape (m,) each, world frame [m].
    but
        Bodies that do not count, shape (m,) each: those a leg was reflected by; -1: none.
    """
    share = np.ones(len(from_x))
    # A row for each face: NumPy's inner loops run over the legs, of which there are more.
    rows = faces.take(np.arange(len(faces))[:, np.newaxis])
    step = max(_LEGS_TIMES_FACES // max(len(faces), 1), 1)
    for first in range(0, len(from_x), step):
        part = slice(first, first + step)
        x0, y0, x1, y1 = from_x[part], from_y[part], to_x[part], to_y[part]
        h0, h1 = rows.height(x0, y0), rows.height(x1, y1)
        crosses = (h0 * h1 < 0) & (np.minimum(np.abs(h0), np.abs(h1)) > ON_THE_FACE_M)
        for body in but:
            crosses &= rows.body != body[part]
        face, leg = np.nonzero(crosses)
        one = faces.take(face)
        x0, y0, x1, y1 = x0[leg], y0[leg], x1[leg], y1[leg]
        height0, height1 = h0[crosses], h1[crosses]
        start, stop = one.along(x0, y0), one.along(x1, y1)
        at = start + (stop - start) * (height0 / (height0 - height1))
        way = length(x1 - x0, y1 - y0)
        over_a = length(one.a_x - x0, one.a_y - y0) + length(x1 - one.a_x, y1 - one.a_y)
        over_b = length(one.b_x - x0, one.b_y - y0) + length(x1 - one.b_x, y1 - one.b_y)
        lit = past_edge(over_a - way, at < 0, wavelength_m)
        lit += past_edge(over_b - way, at > one.length_m, wavelength_m)
        factor = np.abs(one.transmission + (1 - one.transmission) * lit)
        np.multiply.at(share[part], leg, factor)
    return share


def length(dx: Array, dy: Array) -> Array:
    """Return lengths of vectors, any shape; not ``hypot``, whose last bit is the platform's."""
    return np.sqrt(dx * dx + dy * dy)


def face_reflections(faces: Faces, view: Viewpoint, wavelength_m: float) -> Reflections:
    """Return mirror images and edge waves of single faces.

    Shape (n_frames, 3 n_faces): all mirrors, all ends a, all ends b.
    """
    height = faces.height(view.x_m, view.y_m)
    along = faces.along(view.x_m, view.y_m)
    mirror_m = np.abs(height)
    seen = MIRROR_AMPLITUDE_1M * faces.reflection * ((height > 0) | ~faces.outward_only)
    closed = closed_ends(faces, height)
    foot_x, foot_y = faces.at(along)
    on_it = (along >= 0) & (along <= faces.length_m)

    range_m = [mirror_m]
    amplitude = [seen * on_it / np.maximum(mirror_m, NEAREST_M)]
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
            seen * size * obliquity * ~closed[:, :, end] / np.maximum(end_m, NEAREST_M)
        )
        # Within the face an edge takes away from the mirror, beyond it an edge stands for it.
        phase_rad.append(lag_rad + np.where(beyond, np.pi, 0.0))
        at_x.append(np.broadcast_to(end_x, height.shape))
        at_y.append(np.broadcast_to(end_y, height.shape))

    strength = np.concatenate(amplitude, axis=1)
    x, y = np.concatenate(at_x, axis=1), np.concatenate(at_y, axis=1)
    ranges = np.concatenate(range_m, axis=1)
    _, cos_angle = view.towards(x, y)
    strength *= beam_gain(cos_angle)
    ranges += view.antenna_m(cos_angle)
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
    cross = np.outer(faces.t_x, faces.t_y) - np.outer(faces.t_y, faces.t_x)
    reflect = np.outer(faces.reflection, faces.reflection) > 0
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

    # From here on in lists, shape (m,): first those that exist, then those before the antenna.
    amplitude = np.zeros_like(path_m)
    half_m = path_m / 2
    frame, pair = np.nonzero(exists)
    one, two, seen_from = one.take(pair), two.take(pair), view.take(frame)
    x, y = seen_from.x_m, seen_from.y_m
    height1, height2, height_once, near1, far1, near2, far2, once_x, once_y, path_m = (
        each[frame, pair]
        for each in (
            *(height1, height2, height_once, near1, far1, near2, far2),
            *(once_x, once_y, path_m),
        )
    )
    along_once = two.along(once_x, once_y)
    share2 = height_once / (height_once + height2)
    bounce2 = along_once + (two.along(x, y) - along_once) * share2
    x2, y2 = two.at(_between(bounce2, near2, far2))
    # Bounce 2 is held on the radar's side of the first face, so the way to it bounces there.
    rise = np.abs(one.height(x2, y2))
    share1 = np.abs(height1) / np.maximum(np.abs(height1) + rise, 1e-12)
    start1 = one.along(x, y)
    bounce1 = start1 + (one.along(x2, y2) - start1) * share1
    x1, y1 = one.at(_between(bounce1, near1, far1))
    (_, cos1), (_, cos2) = seen_from.towards(x1, y1), seen_from.towards(x2, y2)
    gain1, gain2 = np.sqrt(beam_gain(cos1)), np.sqrt(beam_gain(cos2))
    half_m[frame, pair] += 0.5 * (seen_from.antenna_m(cos1) + seen_from.antenna_m(cos2))

    # Edges, one by one: the way over the edge against the way of the mirrors.
    window = np.where((gain1 > 0) & (gain2 > 0), 1.0, 0.0)
    back_x, back_y = two.mirrored(x, y)
    apex = (apex1 & apex2)[frame, pair]  # one edge, not two
    for face, edge, inwards, start, stop, counts in (
        (two, near2, (bounce2 - near2) * np.sign(far2 - near2), (once_x, once_y), (x, y), True),
        (two, far2, (far2 - bounce2) * np.sign(far2 - near2), (once_x, once_y), (x, y), True),
        (one, far1, (far1 - bounce1) * np.sign(far1 - near1), (x, y), (back_x, back_y), True),
        (one, near1, (bounce1 - near1) * np.sign(far1 - near1), (x, y), (back_x, back_y), ~apex),
    ):
        edge_x, edge_y = face.at(edge)
        over_m = length(edge_x - start[0], edge_y - start[1])
        over_m += length(stop[0] - edge_x, stop[1] - edge_y)
        lit = np.flatnonzero((window > 0) & counts)
        window[lit] *= np.abs(past_edge((over_m - path_m)[lit], inwards[lit] > 0, wavelength_m))

    strength = MIRROR_AMPLITUDE_1M * one.reflection * two.reflection * window
    strength /= np.maximum(path_m / 2, NEAREST_M)
    strength *= gain1
    strength *= gain2
    lit = np.flatnonzero(window > _WEAKEST_CORNER)
    body1, body2 = one.body[lit], two.body[lit]
    x, y, x1, y1, x2, y2, strength = (each[lit] for each in (x, y, x1, y1, x2, y2, strength))
    for a_x, a_y, b_x, b_y, but in (
        (x, y, x1, y1, (body1,)),
        (x1, y1, x2, y2, (body1, body2)),
        (x2, y2, x, y, (body2,)),
    ):
        strength *= passing(faces, a_x, a_y, b_x, b_y, but=but, wavelength_m=wavelength_m)
    amplitude[frame[lit], pair[lit]] = strength
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Legs:
    """Ways from the radar to the target: shape (n_frames, n_targets, n_legs) each.

    The first is the straight one, the others go by way of a mirror each. ``gain`` is the share of
    a free leg's amplitude on boresight, and 0 without a leg; ``to_x``, ``to_y`` is the
    unit vector from the target back along the leg; ``antenna_m`` is how much longer the antenna
    makes it.
    """

    length_m: Array
    antenna_m: Array
    gain: Array
    to_x: Array
    to_y: Array


def direct_share(
    faces: Faces, scatterers: Scatterers, view: Viewpoint, wavelength_m: float
) -> Array:
    """Return the share of the amplitude that gets from the radar to scatterers, (n_frames, k)."""
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
    scatterers
        Targets or a person, k of them.
    share
        Shape (n_frames, k): of the straight leg, from `direct_share`.
    """
    legs = _legs(faces, scatterers, view, share, wavelength_m)
    n_frames, n_targets, n_legs = legs.gain.shape
    ways = mirrored_ways(n_legs)
    out, back = np.array(ways, dtype=np.int64).reshape(-1, 2).T
    gain = legs.gain.transpose(0, 2, 1)
    amplitude = gain[:, out] * gain[:, back]
    # Out by one and back by the other, and the reverse: equally long, so they add.
    amplitude *= np.where(out == back, 1.0, 2.0)[:, np.newaxis]
    range_m = np.zeros(amplitude.shape)

    # in lists, shape (m,): those that exist
    frame, way, target = there = np.nonzero(amplitude)
    going, coming = (frame, target, out[way]), (frame, target, back[way])
    one = scatterers.take(frame, target, (n_frames, n_targets))
    cosine = legs.to_x[going] * legs.to_x[coming] + legs.to_y[going] * legs.to_y[coming]
    half_cosine = np.sqrt(np.clip(0.5 * (1 + cosine), 0.0, 1.0))
    out_m, back_m = legs.length_m[going], legs.length_m[coming]
    amplitude[there] *= spread(one, out_m, back_m, half_cosine)
    antenna_m = 0.5 * (legs.antenna_m[going] + legs.antenna_m[coming])
    range_m[there] = 0.5 * (out_m + back_m) - one.swell_m * half_cosine + antenna_m

    mirrors = np.where(out == 0, 1, 2)
    phase_rad = scatterers.phase_rad + np.pi * mirrors[:, np.newaxis]
    shape = n_frames, len(ways) * n_targets
    return Reflections(
        range_m=range_m.reshape(shape),
        amplitude=amplitude.reshape(shape),
        phase_rad=phase_rad.ravel(),
    )


def spread(scatterers: Scatterers, out_m: Array, back_m: Array, half_cosine: Array) -> Array:
    """Return the echoes' amplitudes for two different legs, shape (m,), beam left aside.

    With equal legs it is that of `emulator.echo.paths.direct_reflections`.

    Parameters
    ----------
    out_m, back_m
        Shape (m,): lengths of the legs, to the scatterer's axis.
    half_cosine
        Shape (m,): cosine of half the angle between the legs at the scatterer.
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
    straight_m, straight_cos = view.towards(x, y)
    straight_m = np.maximum(straight_m, NEAREST_M)
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
    seen_from = view.take(frame)
    radar_x, radar_y = seen_from.x_m, seen_from.y_m
    target_x, target_y = x[frame, target], y[frame, target]
    image_x, image_y = face.mirrored(radar_x, radar_y)
    to_x, to_y = image_x - target_x, image_y - target_y
    length_m = length(to_x, to_y)

    height_r = np.abs(radar_height[frame, number])
    height_t = np.abs(target_height[frame, target, number])
    start = face.along(radar_x, radar_y)
    bounce = start + (face.along(target_x, target_y) - start) * height_r / (height_r + height_t)
    bounce_x, bounce_y = face.at(np.clip(bounce, 0.0, face.length_m))
    _, cos_angle = seen_from.towards(bounce_x, bounce_y)
    gain = np.sqrt(beam_gain(cos_angle))
    closed = closed_ends(faces, radar_height)[frame, number]
    lost = np.zeros(len(gain), dtype=np.complex128)
    for end, end_x, end_y, beyond in (
        (0, face.a_x, face.a_y, bounce < 0),
        (1, face.b_x, face.b_y, bounce > face.length_m),
    ):
        over_m = length(end_x - radar_x, end_y - radar_y)
        over_m += length(end_x - target_x, end_y - target_y)
        lit = np.flatnonzero((gain > 0) & ~closed[:, end])
        lost[lit] += past_edge((over_m - length_m)[lit], beyond[lit], wavelength_m)
    gain *= face.reflection * np.abs(1 - lost)

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
        length_m=np.ones(shape),
        antenna_m=np.zeros(shape),
        gain=np.zeros(shape),
        to_x=np.ones(shape),
        to_y=np.zeros(shape),
    )
    for table, straight, mirrored in (
        (legs.length_m, straight_m, length_m[kept]),
        (legs.antenna_m, view.antenna_m(straight_cos), view.antenna_m(cos_angle[kept])),
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
