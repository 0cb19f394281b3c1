"""Scores of points and lines per patch, in the frame of the patch, against emulated truth.

The frame of a patch is the true body frame at the time of its middle: what odometry gathered before
does not count, what it errs inside the patch, and errors of mounts, do. A reflector
(`hil_tests.bench.image_points.truth`) is required where it is in view, and strong enough, in at
least half of the frames of a patch. Points are matched one to one with these and with those that
may be found, within a largest distance: as many pairs as there can be, and of these the nearest.

recall
    Required reflectors that have a point, over all that are required.
precision
    Points that have a reflector, required or not, over all points.
along, across
    Difference of the distances from the nominal antenna in the middle of the patch, and of the
    bearings. The robust sigma is 1.4826 times the median of the absolute differences from the
    median, so a bias shows in the RMS alone.
room recall
    Reflectors that have a point in any patch, over those that are required in any.
lines
    Length of faces that was seen at normal incidence from any pose, and the share of it that lies
    within 2 cm of a line of any patch, between the line's ends; length of lines without a face
    within 2 cm, over the length of all lines.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from hil_tests.bench.image_points.truth import (
    ALLOWED_SIGMAS,
    REQUIRED_SIGMAS,
    Kind,
    RoomTruth,
    points_along,
)
from slam.geometry import Mount, between, transform, wrap_angles

Array = NDArray[np.float64]

MATCH_M = 0.05
LINE_M = 0.02
NEAR_PERSON_M = 0.3
_CELL_M = 0.01
_MAD = 1.4826


def pairs_within(points_m: Array, places_m: Array, most_m: float) -> list[tuple[int, int]]:
    """Return pairs of rows of points (m, 2) and places (k, 2): most pairs, then least distance.

    >>> pairs_within(np.array([[0.0, 0], [0.04, 0]]), np.array([[0.05, 0], [0.08, 0]]), 0.05)
    [(0, 0), (1, 1)]
    """
    distances = np.linalg.norm(points_m[:, np.newaxis] - places_m, axis=2)
    near = distances <= most_m
    # A pair more must be worth more than all distances together.
    worth = most_m * (1 + min(near.shape, default=0))
    rows, columns = linear_sum_assignment(np.where(near, distances - worth, 0.0))
    kept = near[rows, columns]
    return list(zip(rows[kept].tolist(), columns[kept].tolist(), strict=True))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoredPatch:
    """What became of one patch.

    Attributes
    ----------
    required, found, found_besides
        Reflectors by index in the room: those that are required, those of them that have a point,
        and others that have one.
    n_points
        Right ones have a reflector in either.
    n_late
        False points within the largest distance of a reflector in view in less than half the
        frames.
    n_near_people
        False points within `NEAR_PERSON_M` of a person or mover.
    along_m, across_rad
        Errors of the points of required reflectors.
    """

    required: tuple[int, ...]
    found: tuple[int, ...]
    found_besides: tuple[int, ...]
    n_points: int
    n_late: int
    n_near_people: int
    along_m: Array
    across_rad: Array


def score_points(
    truth: RoomTruth,
    points_m: Array,
    *,
    mount: Mount,
    poses: Array,
    t_ns: NDArray[np.int64],
    middle: int,
    most_m: float = MATCH_M,
) -> ScoredPatch:
    """Score the points (m, 2) of a patch in its frame.

    ``poses`` (n, 3) are the true ones at the times (n,) of its frames, ``middle`` the row whose
    body frame is that of the patch; ``mount`` is the one that the imager was given.
    """
    origin = poses[middle]
    inside_out = between(origin, np.zeros(3))  # of the world, in the patch
    antenna = np.array([mount.x_m, mount.y_m])
    view = truth.viewpoint(poses[middle : middle + 1])
    places_m = transform(
        inside_out, truth.reflectors.surfaces_m(np.array([view.x_m[0, 0], view.y_m[0, 0]]))
    )
    echoes = truth.echoes(poses, t_ns)
    is_edge = np.array([kind is Kind.EDGE for kind in truth.reflectors.kinds], dtype=np.bool_)
    required = ((echoes >= REQUIRED_SIGMAS).mean(axis=0) >= 0.5) & ~is_edge
    shares = (echoes >= ALLOWED_SIGMAS).mean(axis=0)
    allowed = np.flatnonzero(shares >= 0.5)
    pairs = pairs_within(points_m, places_m[allowed], most_m)
    matched = [(point, int(allowed[row])) for point, row in pairs]
    measured = [(point, reflector) for point, reflector in matched if required[reflector]]
    rest = np.ones(len(points_m), dtype=np.bool_)
    rest[[point for point, _ in matched]] = False
    reported = points_m[[point for point, _ in measured]] - antenna
    true = places_m[[reflector for _, reflector in measured]] - antenna
    turned = np.arctan2(reported[:, 1], reported[:, 0]) - np.arctan2(true[:, 1], true[:, 0])
    late = places_m[(shares > 0) & (shares < 0.5)]
    people = transform(inside_out, truth.people_m(t_ns).reshape(-1, 2))
    return ScoredPatch(
        required=tuple(np.flatnonzero(required).tolist()),
        found=tuple(reflector for _, reflector in measured),
        found_besides=tuple(reflector for _, reflector in matched if not required[reflector]),
        n_points=len(points_m),
        n_late=_n_near(points_m[rest], late, most_m),
        n_near_people=_n_near(points_m[rest], people, NEAR_PERSON_M),
        along_m=np.linalg.norm(reported, axis=1) - np.linalg.norm(true, axis=1),
        across_rad=wrap_angles(turned),
    )


def _n_near(points_m: Array, places_m: Array, most_m: float) -> int:
    if not (len(points_m) and len(places_m)):
        return 0
    distances = np.linalg.norm(points_m[:, np.newaxis] - places_m, axis=2)
    return int(np.count_nonzero(distances.min(axis=1) <= most_m))


class FaceLengths:
    """How much of a room's faces was seen at normal incidence, and found as lines."""

    def __init__(self, truth: RoomTruth) -> None:
        self._faces = truth.faces
        lengths = self._faces.length_m.tolist()
        self._middles_m = [
            (np.arange(max(1, round(one / _CELL_M))) + 0.5) * (one / max(1, round(one / _CELL_M)))
            for one in lengths
        ]
        self._places_m = [
            points_along(self._faces, face, along) for face, along in enumerate(self._middles_m)
        ]
        self._seen = [np.zeros(len(along), dtype=np.bool_) for along in self._middles_m]
        self._found = [np.zeros(len(along), dtype=np.bool_) for along in self._middles_m]
        self._errors_m: list[Array] = []
        self._line_m = self._false_line_m = 0.0

    def see(self, feet_m: Array) -> None:
        """Take the feet (n, n_faces) of one radar's way, NaN where a face is not seen."""
        for face, along in enumerate(self._middles_m):
            for one, other in zip(feet_m[:-1, face], feet_m[1:, face], strict=True):
                low, high = min(one, other), max(one, other)
                self._seen[face] |= (along >= low) & (along <= high)  # of NaN: none

    def find(self, ends_m: Array) -> None:
        """Take a line by its ends (2, 2), world frame, placed by the true pose of its patch."""
        way = ends_m[1] - ends_m[0]
        length_m = float(np.hypot(*way))
        if length_m <= 0:
            return
        t = way / length_m
        n = np.array([-t[1], t[0]])
        for face, places in enumerate(self._places_m):
            along, off = (places - ends_m[0]) @ t, (places - ends_m[0]) @ n
            beside = (along >= 0) & (along <= length_m)
            near = beside & (np.abs(off) <= LINE_M)
            self._found[face] |= near
            self._errors_m.append(off[near])
        samples = ends_m[0] + np.outer(np.linspace(0, length_m, 1 + int(length_m / _CELL_M)), t)
        self._line_m += length_m
        self._false_line_m += length_m * float(np.mean(self._off_faces_m(samples) > LINE_M))

    def _off_faces_m(self, points_m: Array) -> Array:
        """Return the distances of points (n, 2) from the nearest face, shape (n,)."""
        faces = self._faces
        x, y = points_m[:, :1], points_m[:, 1:]
        along = np.clip(faces.along(x, y), 0.0, faces.length_m)
        at_x, at_y = faces.at(along)
        off = np.hypot(at_x - x, at_y - y)
        nearest: Array = off.min(axis=1, initial=math.inf)
        return nearest

    @property
    def seen_m(self) -> float:
        return _CELL_M * sum(int(cells.sum()) for cells in self._seen)

    @property
    def found_m(self) -> float:
        both = zip(self._seen, self._found, strict=True)
        return _CELL_M * sum(int((seen & found).sum()) for seen, found in both)

    @property
    def line_m(self) -> float:
        return self._line_m

    @property
    def false_line_m(self) -> float:
        return self._false_line_m

    @property
    def errors_m(self) -> Array:
        """Return how far cells of faces lie from lines, one line after the other."""
        return np.concatenate(self._errors_m) if self._errors_m else np.empty(0)


@dataclass(slots=True, kw_only=True)
class Score:
    """Sums over patches, radars and runs; see the module for the words."""

    n_patches: int = 0
    n_scans: int = 0
    n_points: int = 0
    n_late: int = 0
    n_near_people: int = 0
    required: Counter[Kind] = field(default_factory=Counter)
    found: Counter[Kind] = field(default_factory=Counter)
    found_besides: Counter[Kind] = field(default_factory=Counter)
    along_m: list[Array] = field(default_factory=list)
    across_rad: list[Array] = field(default_factory=list)
    room_required: set[tuple[str, int]] = field(default_factory=set)
    room_found: set[tuple[str, int]] = field(default_factory=set)
    seen_m: float = 0.0
    found_m: float = 0.0
    line_m: float = 0.0
    false_line_m: float = 0.0
    line_errors_m: list[Array] = field(default_factory=list)
    processor_s: float = 0.0

    def add(self, patch: ScoredPatch, kinds: Sequence[Kind], run: str) -> None:
        """Add a patch of a run, whose room has reflectors of these kinds."""
        self.n_patches += 1
        self.n_points += patch.n_points
        self.n_late += patch.n_late
        self.n_near_people += patch.n_near_people
        self.required.update(kinds[each] for each in patch.required)
        self.found.update(kinds[each] for each in patch.found)
        self.found_besides.update(kinds[each] for each in patch.found_besides)
        self.room_required.update((run, each) for each in patch.required)
        self.room_found.update((run, each) for each in patch.found)
        self.along_m.append(patch.along_m)
        self.across_rad.append(patch.across_rad)

    def add_faces(self, faces: FaceLengths) -> None:
        self.seen_m += faces.seen_m
        self.found_m += faces.found_m
        self.line_m += faces.line_m
        self.false_line_m += faces.false_line_m
        self.line_errors_m.append(faces.errors_m)

    @classmethod
    def together(cls, scores: Iterable[Score]) -> Score:
        """Return the sums of several runs."""
        whole = cls()
        for each in scores:
            for name in cls.__slots__:
                one, other = getattr(whole, name), getattr(each, name)
                setattr(whole, name, one | other if isinstance(one, set) else one + other)
        return whole

    @property
    def recall(self) -> float:
        return _share(self.found.total(), self.required.total())

    def recall_of(self, kind: Kind) -> float:
        return _share(self.found[kind], self.required[kind])

    @property
    def n_false(self) -> int:
        return self.n_points - self.found.total() - self.found_besides.total()

    @property
    def precision(self) -> float:
        return _share(self.n_points - self.n_false, self.n_points)

    @property
    def room_recall(self) -> float:
        return _share(len(self.room_found), len(self.room_required))

    @property
    def line_share(self) -> float:
        return _share(self.found_m, self.seen_m)

    @property
    def false_line_share(self) -> float:
        return _share(self.false_line_m, self.line_m)

    @property
    def points_per_patch(self) -> float:
        return _share(self.n_points, self.n_patches)

    @property
    def ms_per_scan(self) -> float:
        return 1e3 * _share(self.processor_s, self.n_scans)


def _share(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def robust_sigma(errors: Sequence[Array]) -> float:
    """Return 1.4826 times the median absolute deviation from the median; NaN of none."""
    values = np.concatenate([*errors, np.empty(0)])
    if not values.size:
        return math.nan
    return _MAD * float(np.median(np.abs(values - np.median(values))))


def rms(errors: Sequence[Array]) -> float:
    values = np.concatenate([*errors, np.empty(0)])
    return math.sqrt(float(np.mean(values**2))) if values.size else math.nan
