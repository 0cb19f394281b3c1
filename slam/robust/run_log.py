"""The log of one run: the measurements of a solution over all poses.

The measurements of old poses are condensed into a prior on the first pose after them, the
calibration, the offsets and the landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam.config import WheelNoise
from slam.geometry import wrap_angle
from slam.packed import PackedRows
from slam.robust.state import Array, Indices, Motion, State, rotation

# Standard deviations of calibration and offsets below this are taken as this, so that information
# stays finite.
_LEAST_SIGMA = 1e-7
# Of the first pose [m, rad], where a run's own map begins
_POSE_SIGMA = 1e-6
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
    pose_sigma: float = _POSE_SIGMA,
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


class _Measurements:
    """Measurements of the whole run in the order they were used in, nearly that of their poses."""

    def __init__(self, kind: np.dtype[np.void]) -> None:
        self._table = PackedRows(kind)
        self._begin = 0  # all rows before it are of poses that are condensed

    def append(self, row: ArrayLike) -> None:
        self._table.append(row)

    def all(self) -> NDArray[np.void]:
        return self._table.rows

    def since(self, first_pose: int) -> NDArray[np.void]:
        """Return the measurements of a pose and later ones, the first of those not condensed."""
        rows = self._table.rows[self._begin :]
        return rows[rows["pose"] >= first_pose]

    def newest(self, count: int) -> NDArray[np.void]:
        """Return the newest measurements, at most so many."""
        return self._table.rows[max(len(self._table) - count, self._begin) :]

    def keep(self, wanted: NDArray[np.bool_], first_pose: int) -> None:
        """Remove other measurements; poses before ``first_pose`` are condensed."""
        self._table.keep(wanted)
        since = np.flatnonzero(self._table.rows["pose"] >= first_pose)
        self._begin = int(since[0]) if len(since) else len(self._table)


def _no_ranges() -> _Measurements:
    whose = [("pose", np.int32), ("radar", np.int16), ("landmark", np.int32)]
    where = [("antenna", np.float64, 2), ("range_m", np.float64), ("sigma_m", np.float64)]
    return _Measurements(np.dtype([*whose, *where, ("alone", np.bool_)]))


def _no_points() -> _Measurements:
    whose = [(name, np.int32) for name in ("pose", "landmark")]
    where = [("point", np.float64, 2), ("root", np.float64, (2, 2))]
    return _Measurements(np.dtype([*whose, *where]))


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

    Landmarks are named by id; merges rename, deletions drop what belonged to the landmark. What is
    condensed stays, too, in packed arrays: all poses of a run can be solved for at its end.
    """

    def __init__(self, wheels: WheelNoise) -> None:
        self._wheels = wheels
        self._first = 0  # poses before it are condensed
        self._condensed: Condensed | None = None
        self._increments = PackedRows(np.dtype(np.float64), 3)
        self._covariances = PackedRows(np.dtype(np.float64), 3, 3)
        self._walks = PackedRows(np.dtype(np.float64))
        self._causal = PackedRows(np.dtype(np.float64), 3)
        self._causal.append(np.zeros(3))
        self._ranges, self._points = _no_ranges(), _no_points()
        self._names: dict[int, int | None] = {}
        self.since_solved = 0
        """How many steps ago the trajectory was last solved for, or that was tried."""
        self._stored_pose: Array = np.zeros(3)

    @property
    def n_poses(self) -> int:
        return len(self._causal)

    @property
    def n_kept(self) -> int:
        """How many poses are not condensed."""
        return len(self._causal) - self._first

    def add_motion(self, increment: Array, motion: Motion) -> None:
        """Append a step as reported; ``motion`` is the step as the calibration corrects it."""
        self._increments.append(increment)
        self._covariances.append(motion.covariance)
        self._walks.append(motion.walk_variance)
        heading = float(self._stored_pose[2])
        moved = self._stored_pose[:2] + rotation(heading) @ motion.step_m
        self._stored_pose = np.array([moved[0], moved[1], wrap_angle(heading + motion.turn_rad)])
        self._causal.append(self._stored_pose)
        self.since_solved += 1

    def set_causal(self, pose: Array) -> None:
        """Store the filter's newest pose, its measurements included."""
        self._causal.rows[-1] = pose

    def parted(self, pose: Array) -> tuple[float, float]:
        """Return how far [m], and by what angle [rad], a pose is from the stored trajectory."""
        away = pose - self._stored_pose
        return float(np.hypot(away[0], away[1])), abs(wrap_angle(float(away[2])))

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
        self._ranges.append((pose, radar, landmark_id, antenna, range_m, sigma_m, alone))

    def add_point(self, landmark_id: int, point: Array, covariance: Array) -> None:
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        self._points.append((self.n_poses - 1, landmark_id, point.tolist(), root.tolist()))

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
        turned_rad = np.cumsum(np.abs(self._increments.rows[first:][::-1, 2]))
        first = max(first, self.n_poses - 1 - int(np.sum(turned_rad <= most_turn_rad)))
        steps = self._increments.rows[first:]
        # Rows are nearly in order of time: tracklets look back a few frames only.
        newest = self._ranges.newest(_MOST_RANGES_PER_POSE * window)
        names = self._rows_of(newest["landmark"], {landmark_id: 0})
        own = newest[(names == 0) & (newest["pose"] >= first) & newest["alone"]]
        at = own["pose"].astype(np.intp) - first
        chain = _chain(np.zeros(3), steps, calibration)
        way_m = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
        mounts = own["antenna"]
        c, s = np.cos(chain[at, 2]), np.sin(chain[at, 2])
        turned = np.column_stack(
            [c * mounts[:, 0] - s * mounts[:, 1], s * mounts[:, 0] + c * mounts[:, 1]]
        )
        return LoggedSightings(
            antennas_m=chain[at, :2] + turned,
            places_m=chain[at, :2],
            headings_rad=chain[at, 2],
            way_m=way_m[at],
            ranges_m=own["range_m"].copy(),
            sigmas_m=own["sigma_m"].copy(),
            radars=own["radar"].astype(np.intp),
            newest=chain[-1],
        )

    def problem(self, state: State, prior: Prior, *, whole: bool = False) -> Problem:
        """Return all measurements of the landmarks the state has now.

        ``prior`` is that of the start; condensed poses include it already, unless the problem is to
        be that of the ``whole`` run.
        """
        first = 0 if whole else self._first
        if self._condensed is not None and not whole:
            prior = self._condensed.of(state.feature_ids, len(state.wall_ids))
        rows = {id_: row for row, id_ in enumerate(state.feature_ids)}
        ranges, points = (
            table.all() if whole else table.since(first) for table in (self._ranges, self._points)
        )
        of_range = self._rows_of(ranges["landmark"], rows)
        of_point = self._rows_of(points["landmark"], rows)
        ranges, of_range = ranges[of_range >= 0], of_range[of_range >= 0]
        points, of_point = points[of_point >= 0], of_point[of_point >= 0]
        sigmas = np.square(self._wheels.calibration_sigmas)
        sigmas_m = ranges["sigma_m"].copy()
        if state.shape_sigmas_m:
            sigmas_m = np.hypot(sigmas_m, state.feature_shape_sigmas_m[of_range])
        # What lies on a round target's surface is nearer than its axis, which is the landmark.
        ranges_m = ranges["range_m"] + state.feature_radii_m[of_range]
        return Problem(
            increments=self._increments.rows[first:].copy(),
            covariances=self._covariances.rows[first:].copy(),
            walks=self._walks.rows[first:, None] * sigmas,
            prior=prior,
            range_poses=ranges["pose"].astype(np.intp) - first,
            range_radars=ranges["radar"].astype(np.intp),
            range_landmarks=of_range,
            range_antennas=ranges["antenna"].copy(),
            ranges_m=ranges_m,
            range_sigmas_m=sigmas_m,
            point_poses=points["pose"].astype(np.intp) - first,
            point_landmarks=of_point,
            points=points["point"].copy(),
            point_roots=points["root"].copy(),
            n_walls=len(state.wall_ids),
        )

    def starts(self, state: State, problem: Problem) -> list[Estimate]:
        """Return values to start from.

        One chains all increments with the present calibration, which a closed loop has corrected
        for the whole run; the other keeps the filter's own past.
        """
        n_poses = len(problem.increments) + 1
        poses = self._causal.rows[-n_poses:].copy()
        chained = _chain(poses[0], problem.increments, state.calibration)
        poses[-1] = state.pose
        causal = Estimate(
            poses=poses,
            calibration=np.broadcast_to(
                state.calibration, (n_poses if problem.is_walking else 1, 3)
            ).copy(),
            offsets_m=state.offsets_m.copy(),
            landmarks_m=state.features,
        )
        return [causal, replace(causal, poses=chained)]

    def solved(self, estimate: Estimate) -> None:
        self._causal.rows[-len(estimate.poses) :] = estimate.poses
        self._stored_pose = estimate.poses[-1].copy()
        self.since_solved = 0

    def condense(self, prior: Prior, landmark_ids: Sequence[int], n_steps: int) -> None:
        """Let ``prior`` replace the first ``n_steps`` poses kept and their measurements.

        Its landmarks are those of ``landmark_ids``, the present map. Measurements of landmarks that
        are gone are dropped.
        """
        self._condensed = Condensed(prior, landmark_ids)
        self._first += n_steps
        rows = {id_: id_ for id_ in landmark_ids}
        for table in (self._ranges, self._points):
            measured = table.all()
            measured["landmark"] = self._rows_of(measured["landmark"], rows)
            table.keep(measured["landmark"] >= 0, self._first)
        self._names.clear()

    def _rows_of(self, ids: NDArray[np.int32], rows: dict[int, int]) -> Indices:
        """Return the present row of each id, shape (m,), -1 for landmarks that are gone."""
        present = np.flatnonzero(np.bincount(ids))
        final = np.full(int(present[-1]) + 1 if len(present) else 0, -1, dtype=np.intp)
        for id_ in present.tolist():
            name: int | None = id_
            while name is not None and name in self._names:
                name = self._names[name]
            final[id_] = -1 if name is None else rows.get(name, -1)
        return final[ids]


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
