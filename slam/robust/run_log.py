"""The log of one run: the measurements of a solution over all poses.

The measurements of poses that are kept no longer are condensed into a prior on the first pose kept,
the calibration, the offsets and the landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from slam.config import WheelNoise
from slam.geometry import compose, wrap_angle
from slam.robust.state import Array, Indices, Motion, State, rotation

# Standard deviations of calibration and offsets below this are taken as this, so that information
# stays finite.
_LEAST_SIGMA = 1e-7
# Standard deviations of a step that the wheels did not measure.
_CARRIED_M, _CARRIED_RAD = 100.0, 10.0
# No frame gives more used ranges than that.
_MOST_RANGES_PER_POSE = 24


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Values of all unknowns."""

    poses: Array  # shape (k + 1, 3): x, y, heading
    calibration: Array  # shape (k + 1, 3) if it walks, else (1, 3): s, w, kappa
    # shapes (r,) and (n, 2); the last of the landmarks may be walls, (phi, d)
    offsets_m: Array
    landmarks_m: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """Prior knowledge of the first pose, its calibration, the offsets and landmarks.

    A quadratic ``e^T information e + 2 gradient^T e`` in right-invariant errors e from ``mean``
    (`slam.robust.smoother`), all of size 6 + r + 2 n in that order; the last ``n_walls`` of the n
    landmarks are walls.
    """

    information: Array
    gradient: Array
    mean: Array
    n_walls: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Problem:
    """All that was measured."""

    # shapes (k, 3) and (k, 3, 3): reported steps from pose to pose, and their noise
    increments: Array
    covariances: Array
    # shape (k, 3): variance each calibration error gains per step; all zero: constants
    walks: Array
    prior: Prior  # of the first pose and everything that does not move
    # shape (m,) each: which pose, radar and landmark a range belongs to
    range_poses: Indices
    range_radars: Indices
    range_landmarks: Indices
    # shapes (m, 2) and (m,): antenna in the body frame of the pose
    range_antennas: Array
    ranges_m: Array
    range_sigmas_m: Array  # shape (m,), noise of the ranges
    # shapes (q,), (q,), (q, 2), (q, 2, 2): range and bearing seen from the body's origin, and a
    # matrix that makes their noise white
    point_poses: Indices
    point_landmarks: Indices
    points: Array
    point_roots: Array
    n_walls: int = 0  # how many of the landmarks, the last ones, are walls

    @property
    def is_walking(self) -> bool:
        return bool(np.any(self.walks > 0.0))

    def beginning(self, n_steps: int) -> Problem:
        """Return the steps up to pose ``n_steps`` and the measurements before it."""
        ranges = self.range_poses < n_steps
        points = self.point_poses < n_steps
        return replace(
            self,
            increments=self.increments[:n_steps],
            covariances=self.covariances[:n_steps],
            walks=self.walks[:n_steps],
            range_poses=self.range_poses[ranges],
            range_radars=self.range_radars[ranges],
            range_landmarks=self.range_landmarks[ranges],
            range_antennas=self.range_antennas[ranges],
            ranges_m=self.ranges_m[ranges],
            range_sigmas_m=self.range_sigmas_m[ranges],
            point_poses=self.point_poses[points],
            point_landmarks=self.point_landmarks[points],
            points=self.points[points],
            point_roots=self.point_roots[points],
        )


def start_prior(
    calibration_sigmas: tuple[float, float, float],
    offset_sigmas_m: tuple[float, ...],
    n_landmarks: int,
    pose_sigma: float = 1e-6,
) -> Prior:
    """Return the prior of a run that starts at the origin of its own map."""
    calibration = np.maximum(calibration_sigmas, _LEAST_SIGMA)
    offsets = np.maximum(offset_sigmas_m, _LEAST_SIGMA)
    sigmas = np.concatenate([np.full(3, pose_sigma), calibration, offsets])
    size = len(sigmas) + 2 * n_landmarks
    information = np.zeros((size, size))
    np.fill_diagonal(information[: len(sigmas), : len(sigmas)], sigmas**-2.0)
    return Prior(information=information, gradient=np.zeros(size), mean=np.zeros(size))


class Condensed:
    """A prior whose landmarks have ids, in the order of the prior, so that the map may change."""

    def __init__(self, prior: Prior, landmark_ids: Sequence[int]) -> None:
        self._prior = prior
        self._ids = list(landmark_ids)

    def knows(self, landmark_id: int) -> bool:
        return landmark_id in self._ids

    def of(self, landmark_ids: Sequence[int], n_walls: int = 0) -> Prior:
        """Return the prior of a map, the last ``n_walls`` of whose ids are walls'.

        Landmarks it does not know have no information.

        Raises
        ------
        ValueError
            A landmark it does know is not in the map: it should have been dropped or renamed.
        """
        if missing := set(self._ids) - set(landmark_ids):
            raise ValueError(f"the prior tells of landmarks that the map lacks: {sorted(missing)}")
        prior, head = self._prior, self._head
        place = {id_: row for row, id_ in enumerate(landmark_ids)}
        at = np.concatenate([np.arange(head), _columns([place[i] for i in self._ids], head)])
        size = head + 2 * len(landmark_ids)
        information = np.zeros((size, size))
        information[np.ix_(at, at)] = prior.information
        gradient, mean = np.zeros(size), np.zeros(size)
        gradient[at], mean[at] = prior.gradient, prior.mean
        return Prior(information=information, gradient=gradient, mean=mean, n_walls=n_walls)

    def rename(self, gone: int, kept: int) -> None:
        """Use all information about one landmark for another, which is the same point.

        Their errors differ by a constant: e_gone = e_kept + d, d = mean_kept - mean_gone.
        """
        if gone not in self._ids:
            return
        if kept not in self._ids:
            self._ids[self._ids.index(gone)] = kept
            return
        prior = self._prior
        into, from_ = self._at(kept), self._at(gone)
        d = np.zeros(len(prior.mean))
        d[from_] = prior.mean[into] - prior.mean[from_]
        gradient = prior.gradient + prior.information @ d
        information = prior.information.copy()
        information[into] += information[from_]
        information[:, into] += information[:, from_]
        gradient[into] += gradient[from_]
        self._keep(gone, information, gradient)

    def drop(self, landmark_id: int) -> None:
        """Marginalise a landmark."""
        if landmark_id not in self._ids:
            return
        prior, at = self._prior, self._at(landmark_id)
        gain = prior.information[:, at] @ np.linalg.pinv(prior.information[np.ix_(at, at)])
        information = prior.information - gain @ prior.information[at]
        gradient = prior.gradient - gain @ prior.gradient[at]
        self._keep(landmark_id, (information + information.T) / 2, gradient)

    @property
    def _head(self) -> int:
        return len(self._prior.mean) - 2 * len(self._ids)

    def _at(self, landmark_id: int) -> Indices:
        return _columns([self._ids.index(landmark_id)], self._head)

    def _keep(self, gone: int, information: Array, gradient: Array) -> None:
        keep = np.delete(np.arange(len(gradient)), self._at(gone))
        self._prior = Prior(
            information=information[np.ix_(keep, keep)],
            gradient=gradient[keep],
            mean=self._prior.mean[keep],
        )
        self._ids.remove(gone)


def _columns(rows: Sequence[int], head: int) -> Indices:
    first = head + 2 * np.array(rows, dtype=np.intp)
    return np.stack([first, first + 1], axis=-1).ravel()


@dataclass(slots=True)
class _Ranges:
    poses: list[int] = field(default_factory=list)
    radars: list[int] = field(default_factory=list)
    landmarks: list[int] = field(default_factory=list)
    antennas: list[tuple[float, float]] = field(default_factory=list)
    ranges_m: list[float] = field(default_factory=list)
    sigmas_m: list[float] = field(default_factory=list)
    alone: list[bool] = field(default_factory=list)


@dataclass(slots=True)
class _Points:
    poses: list[int] = field(default_factory=list)
    landmarks: list[int] = field(default_factory=list)
    points: list[Array] = field(default_factory=list)
    roots: list[Array] = field(default_factory=list)


def _keep(table: _Ranges | _Points, at: Sequence[int]) -> None:
    for name in (column.name for column in fields(table)):
        values = getattr(table, name)
        setattr(table, name, [values[i] for i in at])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoggedSightings:
    """Ranges of one landmark over the last frames, where odometry alone has the antennas."""

    antennas_m: Array  # shape (k, 2), in the frame of the first pose looked back to
    # shapes (k, 2), (k,), (k,): of the robot, and its way since that pose
    places_m: Array
    headings_rad: Array
    way_m: Array
    # shape (k,)
    ranges_m: Array
    sigmas_m: Array
    radars: Indices
    newest: Array  # shape (3,): the newest pose in that frame


class RunLog:
    """Increments, used ranges and points, with the trajectory they were last solved for.

    Landmarks are named by id; merges rename, deletions drop what belonged to the landmark.
    """

    def __init__(self, wheels: WheelNoise) -> None:
        self._wheels = wheels
        self._first = 0
        self._condensed: Condensed | None = None
        self._increments: list[Array] = []
        self._covariances: list[Array] = []
        self._walks: list[float] = []
        self._causal: list[Array] = [np.zeros(3)]
        self._ranges = _Ranges()
        self._points = _Points()
        self._names: dict[int, int | None] = {}
        self.since_solved = 0
        """How many steps ago the trajectory was last solved for, or that was tried."""
        self._stored_pose: Array = np.zeros(3)

    @property
    def n_poses(self) -> int:
        return self._first + len(self._causal)

    @property
    def n_kept(self) -> int:
        return len(self._causal)

    def add_motion(self, increment: Array, motion: Motion) -> None:
        """Append a step as reported; ``motion`` is the step as the calibration corrects it."""
        self._increments.append(np.array(increment, dtype=np.float64))
        self._covariances.append(motion.covariance)
        self._walks.append(motion.walk_variance)
        heading = float(self._stored_pose[2])
        moved = self._stored_pose[:2] + rotation(heading) @ motion.step_m
        self._stored_pose = np.array([moved[0], moved[1], wrap_angle(heading + motion.turn_rad)])
        self._causal.append(self._stored_pose)
        self.since_solved += 1

    def set_causal(self, pose: Array) -> None:
        """Store the filter's newest pose, its measurements included."""
        self._causal[-1] = pose

    def parted(self, pose: Array) -> tuple[float, float]:
        """Return how far [m], and by what angle [rad], a pose is from the stored trajectory."""
        away = pose - self._stored_pose
        return float(np.hypot(away[0], away[1])), abs(wrap_angle(float(away[2])))

    def forget_from(self, pose: int) -> None:
        """Forget all measurements from a pose on; the steps stay."""
        for table in (self._ranges, self._points):
            _keep(table, np.flatnonzero(np.array(table.poses) < pose).tolist())

    def break_odometry(self, pose: Array) -> None:
        """Make the last step uninformative, and set the newest pose."""
        self._covariances[-1] = np.diag([_CARRIED_M**2, _CARRIED_M**2, _CARRIED_RAD**2])
        self._causal[-1] = pose
        self._stored_pose = pose

    def move_poses(self, first: int, motion: Array) -> None:
        """Apply a motion (3,) from the left to all poses from one on."""
        for k in range(max(first - self._first, 0), len(self._causal)):
            self._causal[k] = compose(motion, self._causal[k])
        self._stored_pose = self._causal[-1]

    def add_range(
        self,
        pose: int,
        radar: int,
        landmark_id: int,
        *,
        antenna: tuple[float, float],
        range_m: float,
        sigma_m: float,
        alone: bool = True,
    ) -> None:
        """Append a range used.

        ``antenna`` is in the body frame of the pose, ``sigma_m`` that used in the filter, with
        association sigma and Huber's weight; ``alone``: no other echo overlaps its own.

        Raises
        ------
        ValueError
            The pose is kept no longer: fewer are kept than tracklets look back.
        """
        if pose < self._first:
            raise ValueError(f"pose {pose} is kept no longer, the first one is {self._first}")
        ranges = self._ranges
        ranges.poses.append(pose)
        ranges.radars.append(radar)
        ranges.landmarks.append(landmark_id)
        ranges.antennas.append(antenna)
        ranges.ranges_m.append(range_m)
        ranges.sigmas_m.append(sigma_m)
        ranges.alone.append(alone)

    def add_point(self, landmark_id: int, point: Array, covariance: Array) -> None:
        points = self._points
        points.poses.append(self.n_poses - 1)
        points.landmarks.append(landmark_id)
        points.points.append(np.array(point, dtype=np.float64))
        points.roots.append(np.linalg.inv(np.linalg.cholesky(covariance)))

    def rename(self, gone: int, kept: int) -> None:
        self._names[gone] = kept
        if self._condensed is not None:
            self._condensed.rename(gone, kept)

    def drop(self, landmark_id: int) -> None:
        """Leave out all of a landmark's measurements; it is marginalised from condensed poses."""
        self._names[landmark_id] = None
        if self._condensed is not None:
            self._condensed.drop(landmark_id)

    def is_condensed(self, landmark_id: int) -> bool:
        return self._condensed is not None and self._condensed.knows(landmark_id)

    def sightings(
        self, landmark_id: int, window: int, calibration: Array, most_turn_rad: float
    ) -> LoggedSightings:
        """Return the ranges of a landmark over the last poses, of echoes all alone.

        These are ``window`` poses, fewer if the robot turned by more than ``most_turn_rad`` since.
        """
        first = max(self.n_poses - 1 - window, self._first)
        steps = np.array(self._increments[first - self._first :]).reshape(-1, 3)
        turned_rad = np.cumsum(np.abs(steps[::-1, 2]))
        first = max(first, self.n_poses - 1 - int(np.sum(turned_rad <= most_turn_rad)))
        steps = np.array(self._increments[first - self._first :]).reshape(-1, 3)
        ranges = self._ranges
        # Rows are nearly in order of time: tracklets look back a few frames only.
        begin = max(len(ranges.poses) - _MOST_RANGES_PER_POSE * window, 0)
        poses = np.array(ranges.poses[begin:], dtype=np.intp)
        names = self._rows_of(ranges.landmarks[begin:], {landmark_id: 0})
        alone = np.array(ranges.alone[begin:], dtype=bool)
        rows = begin + np.flatnonzero((names == 0) & (poses >= first) & alone)
        at = np.array([ranges.poses[row] for row in rows], dtype=np.intp) - first
        chain = _chain(np.zeros(3), steps, calibration)
        way_m = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
        mounts = np.array([ranges.antennas[row] for row in rows]).reshape(-1, 2)
        c, s = np.cos(chain[at, 2]), np.sin(chain[at, 2])
        turned = np.column_stack(
            [c * mounts[:, 0] - s * mounts[:, 1], s * mounts[:, 0] + c * mounts[:, 1]]
        )
        return LoggedSightings(
            antennas_m=chain[at, :2] + turned,
            places_m=chain[at, :2],
            headings_rad=chain[at, 2],
            way_m=way_m[at],
            ranges_m=np.array([ranges.ranges_m[row] for row in rows]),
            sigmas_m=np.array([ranges.sigmas_m[row] for row in rows]),
            radars=np.array([ranges.radars[row] for row in rows], dtype=np.intp),
            newest=chain[-1],
        )

    def problem(self, state: State, prior: Prior) -> Problem:
        """Return all measurements of the landmarks the state has now.

        ``prior`` is that of the start; condensed poses include it already.
        """
        if self._condensed is not None:
            prior = self._condensed.of(state.feature_ids, len(state.wall_ids))
        rows = {id_: row for row, id_ in enumerate(state.feature_ids)}
        ranges, points = self._ranges, self._points
        of_range = self._rows_of(ranges.landmarks, rows)
        of_point = self._rows_of(points.landmarks, rows)
        used, used_points = np.flatnonzero(of_range >= 0), np.flatnonzero(of_point >= 0)
        sigmas = np.square(self._wheels.calibration_sigmas)
        sigmas_m = np.array(ranges.sigmas_m)[used]
        if state.shape_sigmas_m:
            sigmas_m = np.hypot(sigmas_m, state.feature_shape_sigmas_m[of_range[used]])
        # What lies on a round target's surface is nearer than its axis, which is the landmark.
        ranges_m = np.array(ranges.ranges_m)[used] + state.feature_radii_m[of_range[used]]
        return Problem(
            increments=np.array(self._increments).reshape(-1, 3),
            covariances=np.array(self._covariances).reshape(-1, 3, 3),
            walks=np.array(self._walks)[:, None] * sigmas,
            prior=prior,
            range_poses=np.array(ranges.poses, dtype=np.intp)[used] - self._first,
            range_radars=np.array(ranges.radars, dtype=np.intp)[used],
            range_landmarks=of_range[used],
            range_antennas=np.array(ranges.antennas).reshape(-1, 2)[used],
            ranges_m=ranges_m,
            range_sigmas_m=sigmas_m,
            point_poses=np.array(points.poses, dtype=np.intp)[used_points] - self._first,
            point_landmarks=of_point[used_points],
            points=np.array(points.points).reshape(-1, 2)[used_points],
            point_roots=np.array(points.roots).reshape(-1, 2, 2)[used_points],
            n_walls=len(state.wall_ids),
        )

    def starts(self, state: State, problem: Problem) -> list[Estimate]:
        """Return values to start from.

        One chains all increments with the present calibration, which a closed loop has corrected
        for the whole run; the other keeps the filter's own past.
        """
        shape = (len(self._causal), 3) if problem.is_walking else (1, 3)
        poses = np.array(self._causal)
        poses[-1] = state.pose
        causal = Estimate(
            poses=poses,
            calibration=np.broadcast_to(state.calibration, shape).copy(),
            offsets_m=state.offsets_m.copy(),
            landmarks_m=state.features,
        )
        chained = _chain(self._causal[0], problem.increments, state.calibration)
        return [causal, replace(causal, poses=chained)]

    def solved(self, estimate: Estimate) -> None:
        self._causal = list(estimate.poses)
        self._stored_pose = estimate.poses[-1].copy()
        self.since_solved = 0

    def condense(self, prior: Prior, landmark_ids: Sequence[int], n_steps: int) -> None:
        """Forget the first ``n_steps`` poses kept; ``prior`` replaces their measurements.

        Its landmarks are those of ``landmark_ids``, the present map. Measurements of landmarks that
        are gone are dropped.
        """
        self._condensed = Condensed(prior, landmark_ids)
        rows = {id_: id_ for id_ in landmark_ids}
        for table in (self._ranges, self._points):
            names = self._rows_of(table.landmarks, rows)
            table.landmarks = names.tolist()
            _keep(table, np.flatnonzero(names >= 0).tolist())
        self._names.clear()
        for kept in (self._increments, self._covariances, self._walks, self._causal):
            del kept[:n_steps]
        self._first += n_steps
        for table in (self._ranges, self._points):
            _keep(table, np.flatnonzero(np.array(table.poses) >= self._first).tolist())

    def _rows_of(self, ids: list[int], rows: dict[int, int]) -> Indices:
        """Return the present row of each id, -1 for landmarks that are gone."""
        final: dict[int, int] = {}
        for id_ in set(ids):
            name: int | None = id_
            while name is not None and name in self._names:
                name = self._names[name]
            final[id_] = -1 if name is None else rows.get(name, -1)
        return np.array([final[id_] for id_ in ids], dtype=np.intp)


def _chain(first: Array, increments: Array, calibration: Array) -> Array:
    """Return the poses that calibrated increments lead through from the first one, (3,)."""
    s, w, kappa = calibration
    d = increments[:, :2] / (1.0 + s)
    a = (increments[:, 2] - kappa * np.hypot(d[:, 0], d[:, 1])) / (1.0 + w)
    heading = first[2] + np.concatenate([[0.0], np.cumsum(a)])
    c, sn = np.cos(heading[:-1]), np.sin(heading[:-1])
    x = first[0] + np.concatenate([[0.0], np.cumsum(c * d[:, 0] - sn * d[:, 1])])
    y = first[1] + np.concatenate([[0.0], np.cumsum(sn * d[:, 0] + c * d[:, 1])])
    return np.column_stack([x, y, heading])
