"""Walls and boxes as flat faces: where their mirrors and edges are, and what passes through them.

A face is a straight segment of the floor plan from ``a`` over its length along the unit vector
``t``; its normal ``n = (-t_y, t_x)`` is on its left. ``along`` and ``height`` are a point's
coordinates on t and n, from a. Faces of boxes are given clockwise, so that n points outwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emulator.diffraction import past_edge
from emulator.scene_tables import ObjectSpec, WallSpec

__all__ = [
    "ON_THE_FACE_M",
    "TOUCHING_M",
    "Closure",
    "Faces",
    "closed_ends",
    "faces_of",
    "length",
    "passing",
]

Array = NDArray[np.float64]

TOUCHING_M = 0.02
"""Ends that come this near to another face meet it: nobody draws a plan to the millimetre."""
ON_THE_FACE_M = 1e-3
"""What is nearer to a face than this stands on it: neither before it nor behind."""
_RIGHT_ANGLE_TOLERANCE = math.sin(math.radians(1.0))
_LEGS_TIMES_FACES = 200_000  # of one block of `passing`: bounds its memory


@dataclass(frozen=True, slots=True, kw_only=True)
class Closure:
    """An end of a face that stands on another one at a right angle.

    For a radar in the quarter between the two they are an inner corner: with the corner's mirror
    image the field is complete, and there is no edge to be heard. From behind an L it is one.

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
        Ends that are no edges.
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
        """Return how many there are."""
        return len(self.length_m)

    def along(self, x: Array, y: Array) -> Array:
        """Return coordinates along t [m]; the last axis of x and y is that of the faces, or 1."""
        return (x - self.a_x) * self.t_x + (y - self.a_y) * self.t_y

    def height(self, x: Array, y: Array) -> Array:
        """Return coordinates along n [m]; the last axis of x and y is that of the faces, or 1."""
        return (y - self.a_y) * self.t_x - (x - self.a_x) * self.t_y

    def at(self, along_m: Array) -> tuple[Array, Array]:
        """Return x and y [m] of points on the faces' lines; the last axis is that of the faces."""
        return self.a_x + along_m * self.t_x, self.a_y + along_m * self.t_y

    def mirrored(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return x and y [m] of mirror images; the last axis is that of the faces."""
        twice = 2 * self.height(x, y)
        return x + twice * self.t_y, y - twice * self.t_x

    def take(self, index: NDArray[np.int64]) -> Faces:
        """Return some of the faces, in the order asked for; closures stay behind."""
        return Faces(
            a_x=self.a_x[index],
            a_y=self.a_y[index],
            b_x=self.b_x[index],
            b_y=self.b_y[index],
            t_x=self.t_x[index],
            t_y=self.t_y[index],
            length_m=self.length_m[index],
            reflection=self.reflection[index],
            transmission=self.transmission[index],
            body=self.body[index],
            outward_only=self.outward_only[index],
            closures=(),
        )


def faces_of(walls: tuple[WallSpec, ...], objects: tuple[ObjectSpec, ...]) -> Faces:
    """Return the faces of all walls, then of all boxes."""
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
    upright = np.abs(_outer(faces.t_x, faces.t_x) + _outer(faces.t_y, faces.t_y))
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


def _outer(one: Array, other: Array) -> Array:
    return one[:, np.newaxis] * other


def closed_ends(faces: Faces, height_m: Array) -> NDArray[np.bool_]:
    """Return which ends are no edges for a radar, shape (n_frames, n_faces, 2).

    Parameters
    ----------
    faces
        The faces.
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
        Bodies that do not count, shape (m,) each: those a leg was reflected by; -1 is none.
    wavelength_m
        Of the carrier.
    """
    share = np.ones(len(from_x))
    step = max(_LEGS_TIMES_FACES // max(len(faces), 1), 1)
    for first in range(0, len(from_x), step):
        part = slice(first, first + step)
        x0, y0 = from_x[part, np.newaxis], from_y[part, np.newaxis]
        x1, y1 = to_x[part, np.newaxis], to_y[part, np.newaxis]
        h0, h1 = faces.height(x0, y0), faces.height(x1, y1)
        crosses = (h0 * h1 < 0) & (np.minimum(np.abs(h0), np.abs(h1)) > ON_THE_FACE_M)
        for body in but:
            crosses &= faces.body != body[part, np.newaxis]
        leg, face = np.nonzero(crosses)
        one = faces.take(face)
        x0, y0, x1, y1 = x0[leg, 0], y0[leg, 0], x1[leg, 0], y1[leg, 0]
        height0, height1 = h0[leg, face], h1[leg, face]
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
