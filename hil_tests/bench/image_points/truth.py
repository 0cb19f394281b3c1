"""What one radar of an emulated room can see: points that reflect, and faces seen at right angles.

The emulator's own echo model (`emulator.echo.echo`) decides. A reflector is in view in a frame
where it is in beam and range of the field of view, from the true pose and the true mount. How
strong its echo is, in standard deviations of the white noise per RF sample, has shadows and beam in
it. From `REQUIRED_SIGMAS` on it must be found; down to `ALLOWED_SIGMAS` it may be, since an image
sums frames. What counts as its place:

target
    A rod or a point, so a desk's or a chair's leg, where it stands; a body's scattering points in
    place of the body. The offsets of ``wander`` are errors of a point, not of the truth.
cylinder
    The point of its surface nearest to the antenna in the middle of the patch.
corner
    The apex of two faces of different bodies at 90 degrees (1 degree off at most), where the double
    bounce between them is seen: it lies at the apex for every antenna, even if the faces end before
    they meet. Two faces at another angle have no place that is the same for all antennas.
edge
    A free end of a wall, or a corner of a box. It diffracts: strong beside its own mirror image,
    weak elsewhere. It may be found, and need not.
face
    A wall, or a side of a box, is a line. It is seen at normal incidence where the foot of the
    perpendicular from the antenna lies on it, in beam and range, and its echo is strong enough.

People and movers, images of targets and corners in walls, echoes by way of two targets, and points
on a face are no truth: a point there is false.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from emulator.echo.paths import Viewpoint, direct_reflections, viewpoint
from emulator.echo.targets import Targets
from emulator.echo.walls import (
    Faces,
    corner_pairs,
    corner_reflections,
    direct_share,
    face_reflections,
    faces_of,
)
from emulator.scene.motion import swings
from emulator.scene.people import positions_m
from emulator.scene.scene import Scene
from slam.geometry import FieldOfView
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import TxCenterFrequency

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

REQUIRED_SIGMAS, ALLOWED_SIGMAS = 4.0, 1.0
_RIGHT_ANGLE = math.sin(math.radians(1.0))
_SAME_PLACE_M = 1e-3
_WAVELENGTH_M = x4.SPEED_OF_LIGHT_MPS / x4.CARRIER_HZ[TxCenterFrequency.LOW_BAND]


class Kind(StrEnum):
    """What a point that reflects is."""

    TARGET = "target"
    CYLINDER = "cylinder"
    CORNER = "corner"
    EDGE = "edge"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reflectors:
    """The points of a room that reflect, k of them, in the world frame.

    Attributes
    ----------
    kinds
        Shape (k,).
    places_m
        Shape (k, 2): of a cylinder, its axis.
    radii_m
        Shape (k,): 0 but for cylinders.
    """

    kinds: tuple[Kind, ...]
    places_m: Array
    radii_m: Array

    def surfaces_m(self, antenna_m: Array) -> Array:
        """Return the points that are nearest to an antenna (2,), shape (k, 2)."""
        ways = antenna_m - self.places_m
        lengths = np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
        return np.asarray(self.places_m + ways * (self.radii_m[:, np.newaxis] / lengths))


class RoomTruth:
    """What one radar of a scene sees from true poses of the robot.

    ``scene`` has the keys of its stress in it.

    Attributes
    ----------
    reflectors
        Alike for all radars of the scene.
    faces
        Walls and sides of boxes.
    """

    def __init__(self, scene: Scene, radar: int, view: FieldOfView, seed: int = 0) -> None:
        self._scene, self._radar, self._view = scene, scene.radars[radar], view
        self._seed = seed
        self._noise = scene.noise.rf_sigma
        self._targets = Targets(scene.targets, seed)
        self.faces = faces_of(scene.walls, scene.objects)
        self._pairs = corner_pairs(self.faces)
        at_ns = np.zeros(1, dtype=np.int64)
        groups = self._targets.scatterers(at_ns)
        target_m = np.concatenate([np.column_stack([g.x_m, g.y_m]) for g in groups])
        radii_m = np.concatenate([g.radius_m for g in groups])
        apex_m, self._apex_of_pair = self._apexes()
        edge_m, self._edge_of_end = self._edges()
        self.reflectors = Reflectors(
            kinds=(
                *(Kind.CYLINDER if radius > 0 else Kind.TARGET for radius in radii_m.tolist()),
                *(Kind.CORNER,) * len(apex_m),
                *(Kind.EDGE,) * len(edge_m),
            ),
            places_m=np.concatenate([target_m, apex_m, edge_m]),
            radii_m=np.concatenate([radii_m, np.zeros(len(apex_m) + len(edge_m))]),
        )

    def _apexes(self) -> tuple[Array, NDArray[np.intp]]:
        """Return the apexes (m, 2), and for each pair of faces its apex, -1 for none."""
        one = self.faces.take(self._pairs.first)
        two = self.faces.take(self._pairs.second)
        is_right = np.abs(one.t_x * two.t_x + one.t_y * two.t_y) < _RIGHT_ANGLE
        places, of_pair = _merged(np.column_stack(one.at(self._pairs.meet_first_m))[is_right])
        apex_of_pair = np.full(len(is_right), -1, dtype=np.intp)
        apex_of_pair[is_right] = of_pair
        return places, apex_of_pair

    def _edges(self) -> tuple[Array, NDArray[np.intp]]:
        """Return the places of ends (m, 2), and for ends a, then ends b, of faces their place."""
        ends = np.concatenate(
            [
                np.column_stack([self.faces.a_x, self.faces.a_y]),
                np.column_stack([self.faces.b_x, self.faces.b_y]),
            ]
        )
        return _merged(ends)

    def viewpoint(self, poses: Array) -> Viewpoint:
        """Return where the radar truly is at true poses (n, 3)."""
        return viewpoint(self._radar, poses)

    def echoes(self, poses: Array, t_ns: NDArray[np.int64]) -> Array:
        """Return how strong echoes are from true poses (n, 3) at times (n,), shape (n, k).

        In standard deviations of the noise; 0 out of view.
        """
        view = self.viewpoint(poses)
        direct = []
        for each in self._targets.scatterers(t_ns):
            amplitude = direct_reflections(each, view).amplitude
            if len(self.faces):
                amplitude = amplitude * direct_share(self.faces, each, view, _WAVELENGTH_M) ** 2
            direct.append(amplitude)
        n_frames = len(poses)
        n_apexes, n_edges = (self.reflectors.kinds.count(k) for k in (Kind.CORNER, Kind.EDGE))
        apexes, edges = np.zeros((n_frames, n_apexes)), np.zeros((n_frames, n_edges))
        if n_apexes:
            bounces = corner_reflections(self.faces, self._pairs, view, _WAVELENGTH_M).amplitude
            for pair in np.flatnonzero(self._apex_of_pair >= 0):
                apexes[:, self._apex_of_pair[pair]] += bounces[:, pair]
        if n_edges:
            waves = face_reflections(self.faces, view, _WAVELENGTH_M).amplitude
            for end, edge in enumerate(self._edge_of_end.tolist(), start=len(self.faces)):
                edges[:, edge] = np.maximum(edges[:, edge], waves[:, end])
        amplitude = np.concatenate([*direct, apexes, edges], axis=1)
        x, y = self.reflectors.places_m.T
        range_m, cosine = view.towards(x, y)
        in_view = self._in_view(range_m - self.reflectors.radii_m, cosine)
        return np.where(in_view, amplitude / self._noise, 0.0)

    def feet_m(self, poses: Array) -> Array:
        """Return where along each face it is seen at normal incidence, (n, n_faces); NaN: not."""
        view = self.viewpoint(poses)
        if not len(self.faces):
            return np.empty((len(poses), 0))
        along = self.faces.along(view.x_m, view.y_m)
        range_m, cosine = view.towards(*self.faces.at(along))
        mirrors = face_reflections(self.faces, view, _WAVELENGTH_M).amplitude[:, : len(self.faces)]
        is_seen = self._in_view(range_m, cosine) & (mirrors >= REQUIRED_SIGMAS * self._noise)
        return np.where(is_seen, along, np.nan)

    def people_m(self, t_ns: NDArray[np.int64]) -> Array:
        """Return where people and movers are, shape (n, p, 2)."""
        places = [
            *(positions_m(each, t_ns, self._seed) for each in self._scene.people),
            *(swings(each, t_ns)[0] for each in self._scene.movers),
        ]
        return np.stack(places, axis=1) if places else np.empty((len(t_ns), 0, 2))

    def _in_view(self, range_m: Array, cosine: Array) -> Flags:
        in_range = (range_m >= self._view.min_range_m) & (range_m <= self._view.max_range_m)
        return np.asarray(in_range & (cosine >= math.cos(self._view.opening_rad / 2)))


def points_along(faces: Faces, face: int, along_m: Array) -> Array:
    """Return points of one face, shape (n, 2)."""
    one = faces.take(np.array([face]))
    return np.column_stack(one.at(along_m))


def _merged(places: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return places (n, 2) of which no two are the same, and for each given one its index there."""
    kept: list[Array] = []
    index = np.zeros(len(places), dtype=np.intp)
    for number, place in enumerate(places):
        for known, other in enumerate(kept):
            if float(np.hypot(*(place - other))) <= _SAME_PLACE_M:
                index[number] = known
                break
        else:
            index[number] = len(kept)
            kept.append(place)
    return np.array(kept).reshape(-1, 2), index
