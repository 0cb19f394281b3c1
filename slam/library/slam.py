"""`Slam`: one class in front of both pipelines, for a loop of your own."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam.config import BackEnd, SlamConfig, WheelNoise, load_preset
from slam.frames import Detection, Detector, RadarFrame, StepInputError
from slam.front_end.numba_compilation import compile_kernels
from slam.geometry import MOST_M, Rig, between, compose, transform
from slam.library.pose_track import NEAR_NS, PoseTrack
from slam.library.rig_files import RigFile
from slam.library.saved_map import MapFile, load_map, save_map
from slam.paper.ekf import motion_jacobian
from slam.paper.pipeline import UwbRadarSlam
from slam.results import (
    Belief,
    MapChanges,
    NoiseAt,
    Pipeline,
    SmoothedRun,
    StartOnMap,
    StepResult,
)
from slam.robust.association import LONGEST_M, RangeScan
from slam.robust.parameters import BackEndParameters
from slam.robust.pipeline import RobustSlam
from slam.robust.solver.one_blas_thread import one_blas_thread
from slam.robust.state import turned_covariance

Array = NDArray[np.float64]
Row: TypeAlias = Sequence[float | None]
"""One range or point, numbers and perhaps an id; see `Slam.step`."""

_KEPT_NS = 2_000_000_000
_ROUND_NS = 1_000_000_000  # longest round of mounts that measure in turn
_SAME = 1e-9  # [m] and [rad]: two poses of one time that differ by less are one
_ROUNDED = 1e-9  # of gathered noise, for covariances without full rank
_MOST_STAMP_NS = 2**63 - 1


def make_slam(
    config: SlamConfig,
    rig: Rig,
    wheels: WheelNoise,
    detector: Detector | None = None,
    *,
    rules: BackEndParameters | None = None,
    noise_at: NoiseAt | None = None,
    on_map: StartOnMap | None = None,
) -> Pipeline:
    """Return the pipeline that ``config.back_end`` names.

    ``wheels`` is the robot's odometry noise; preset ``paper`` has numbers of its own. ``detector``
    replaces the front end that the configuration names, ``rules`` those of the robust back end,
    which alone begins ``on_map``, and ``noise_at`` the white noise of ``wheels`` there.
    """
    if config.back_end is BackEnd.ROBUST:
        compile_kernels()  # so that the first scans need not wait
        return RobustSlam(
            config, rig, wheels, detector, rules=rules, noise_at=noise_at, on_map=on_map
        )
    return UwbRadarSlam(config, rig, detector)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SlamState:
    """Where the robot is at one time, map frame.

    Between the states of the pipeline, which makes one when the robot has moved (preset ``paper``
    14 states later), the pose is that of the newest one and odometry since then.

    Attributes
    ----------
    t_ns
        Time of the step; None before the first one.
    pose
        Shape (3,): x [m], y [m], heading [rad] in [-pi, pi).
    covariance
        Shape (3, 3), of the pose, errors additive, [m, m, rad].
    is_lost
        Whether the place on the map is unknown: the robot was carried. The pose is then that before
        it and odometry since, and the covariance covers the map.
    results
        The states that the pipeline made in this step, in its own map frame, which begins at the
        first pose: what was seen, and what it was taken for.
    """

    t_ns: int | None
    pose: Array
    covariance: Array
    is_lost: bool = False
    results: tuple[StepResult, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmarks:
    """The n landmarks that are reported, map frame; each keeps its id.

    Attributes
    ----------
    ids
        Numbers of their own, in the order of the rows.
    positions_m, covariances_m2
        Shape (n, 2) and (n, 2, 2), errors additive.
    given_ids
        The ``landmark_id`` of the ranges or points that each was made of, None where they had none.
    """

    ids: tuple[int, ...]
    positions_m: Array
    covariances_m2: Array
    given_ids: tuple[int | None, ...]

    def __len__(self) -> int:
        return len(self.ids)


class Slam:
    """SLAM step by step, with whatever a robot's own loop has: frames, ranges or points.

    Lengths are true metres, angles radians, counter-clockwise. The body frame has x forward and y
    left; the map frame begins at the first pose. One thread at a time may use it.

    Parameters
    ----------
    rig
        The mounts, or a rig file by `load_rig`, which has the wheels' noise, too.
    preset
        ``"robust"`` or ``"paper"``, or settings of your own (`load_preset`, `override`).
    wheels
        How odometry errs; None: as the rig file says, or the defaults of `WheelNoise`. Preset
        ``paper`` has numbers of its own.
    start
        Where the map has the first pose: x [m], y [m], heading [rad]; None: at the origin, or with
        a ``map`` anywhere on it. On a map it is taken to be right to 0.1 m and 0.1 rad.
    odometry_noise
        Returns the covariance (3, 3) of the noise that odometry has gathered until a time [ns], in
        the order and frame of its poses; preset ``robust`` takes its growth in place of the white
        noise of ``wheels``. It goes on, in the same frame, if the source is restarted.
    front_end
        Finds ranges in frames, in place of the preset's; see `Detector`.
    map
        A map to begin with: a file that `save_map` has written, or what `load_map` returns of it.
        Until the place on it is found, ``state.is_lost`` is true. Preset ``robust`` only.
    localise
        Leave that map as it is: what is new in it serves the pose only.

    Attributes
    ----------
    state
        Where the robot was at the last step.
    """

    def __init__(
        self,
        rig: Rig | RigFile,
        preset: str | SlamConfig = "robust",
        *,
        wheels: WheelNoise | None = None,
        start: ArrayLike | None = None,
        odometry_noise: NoiseAt | None = None,
        front_end: Detector | None = None,
        map: str | Path | MapFile | None = None,
        localise: bool = False,
    ) -> None:
        if isinstance(rig, RigFile):
            wheels = wheels or rig.wheels.noise
            rig = rig.rig
        if not isinstance(rig, Rig):
            raise ValueError(f"rig is {rig!r}; give a Rig, or what load_rig returns of a file")
        if not rig.mounts:
            raise ValueError("the rig has no mount; what measures ranges sits at one")
        self.rig = rig
        self.config = load_preset(preset) if isinstance(preset, str) else preset
        self._wheels = wheels or WheelNoise()
        given = None if start is None else _pose(start, "start")
        if given is not None and abs(given[2]) > math.tau:
            raise ValueError(
                f"start: its heading is {given[2]:g}; give radians, at most a turn (math.radians)"
            )
        on_map = None if map is None else _on_map(map, given, is_fixed=localise)
        if (map is not None or localise) and self.config.back_end is not BackEnd.ROBUST:
            raise ValueError("map, localise: preset paper begins with an empty map; use robust")
        if localise and map is None:
            raise ValueError("localise: in which map? Give map, too")
        # Where the pipeline's map, if it is not an earlier one, lies on the map
        self._start = np.zeros(3) if given is None or on_map is not None else given
        # Until the last step, and until that which is being taken
        self._noise_at, self._noise = odometry_noise, np.zeros((3, 3))
        self._noise_now = self._noise
        noise_at = None if odometry_noise is None else lambda _: self._noise_now
        self._pipeline = make_slam(
            self.config, rig, self._wheels, front_end, noise_at=noise_at, on_map=on_map
        )
        self._odometry = PoseTrack()
        self._newest: dict[int, tuple[int, int]] = {}  # stream and counter, by radar
        # By mount, ranges that wait for those of the others, and the mounts of the newest step that
        # had its ranges; the mounts of the last round
        self._waiting: dict[int, _Waiting] = {}
        self._beside: dict[int, set[int]] = {}
        self._round = set[int]()
        self._stepped_ns = -_MOST_STAMP_NS  # when the pipeline was stepped last
        self._is_lost = on_map is not None and on_map.pose is None
        # The newest belief, and odometry at it
        self._belief = Belief(mean=np.zeros(3), covariance=np.zeros((3, 3)))
        if on_map is not None and isinstance(self._pipeline, RobustSlam):
            self._belief = self._pipeline.belief()
        self._belief_at: Array | None = None
        self.state = SlamState(
            t_ns=None,
            pose=compose(self._start, self._belief.pose),
            covariance=self._belief.pose_covariance,
            is_lost=self._is_lost,
        )

    def add_odometry(self, t_ns: int, pose: ArrayLike) -> None:
        """Take a pose of the wheels between steps: frames get their poses from it.

        Times rise. A robot whose odometry comes more often than its scans calls this for each pose.
        If the source is restarted, at its first pose or at zero, the robot goes on as before.
        Raises StepInputError, a ValueError, and forgets the pose, if it cannot be one.
        """
        t_ns, pose = _stamp(t_ns), _pose(pose, f"odometry at {t_ns} ns")
        if len(self._odometry) and t_ns <= self._odometry.last_ns:
            raise StepInputError(
                f"odometry at {t_ns} ns is not later than that before it, {self._odometry.last_ns}"
            )
        self._odometry.add(t_ns, pose.tolist())

    def step(
        self,
        t_ns: int,
        odometry_pose: ArrayLike | Callable[[int], ArrayLike] | None = None,
        *,
        frames: Iterable[RadarFrame] = (),
        ranges: Iterable[Row] = (),
        points: Iterable[Row] = (),
    ) -> SlamState:
        """Take what was seen around one time; return where the robot is.

        Preset ``paper`` takes either frames or ranges without ids; ``robust`` takes all, but of one
        mount only one kind in a step.

        Parameters
        ----------
        t_ns
            Time of the state, whole nanoseconds of any clock; times of steps do not fall.
        odometry_pose
            Pose of the wheels then, in a frame of their own: x [m], y [m], heading [rad], which
            need not be unwrapped. None: from `add_odometry`. Or a function that returns the pose
            at a time [ns], such as `Scan.odometry` of a session.
        frames
            At most one of each radar, each with its own time of the same clock. Its pose lies
            between those given, which are at most a second apart while the robot drives; up to 100
            ms behind the newest one it is extrapolated.
        ranges
            (radar, range_m, sigma_m) or (radar, range_m, sigma_m, landmark_id): index of the mount,
            true metres from there at ``t_ns``, standard deviation. With an id, any whole number, it
            is known what was ranged, as from a UWB anchor, and range and field of view do not
            matter. All that a mount measured without ids must be given at once: what should be
            there and is not counts against a landmark. A mount that is not mentioned did not look.
            Mounts that measure in turn may have a step each: ranges without ids wait until every
            mount of the last round has some, one measures again, or a second is over.
        points
            (radar, range_m, bearing_rad, sigma_m, bearing_sigma_rad), and an id in the same way:
            the bearing is counted from the mount's ``yaw_rad``.

        Raises
        ------
        StepInputError
            A ValueError: something cannot be taken. Then nothing of the step was: later results are
            the same, to the last bit, as without it.
        """
        t_ns, taken = _stamp(t_ns), _items(frames, "frames")
        if self.state.t_ns is not None and t_ns < self.state.t_ns:
            raise StepInputError(f"t_ns is {t_ns}, before that of the last step, {self.state.t_ns}")
        scans = self._scans(taken, _items(ranges, "ranges"), _items(points, "points"))
        track = deepcopy(self._odometry)
        pose_at = self._pose_at(track, t_ns, odometry_pose)
        is_first = self._belief_at is None  # frames at the first pose are not looked at
        stamps_ns = {t_ns} if is_first else {t_ns, *(frame.t_ns for frame in taken)}
        poses = {stamp: _pose(pose_at(stamp), f"odometry at {stamp} ns") for stamp in stamps_ns}
        if self._noise_at is not None:
            self._noise_now = _later_noise(self._noise_at(t_ns), self._noise, t_ns)
        with one_blas_thread():
            results = self._gathered(taken, scans, poses, t_ns)
        track.forget_before(t_ns - _KEPT_NS)
        self._odometry, self._noise = track, self._noise_now
        self._newest |= {frame.radar: (frame.stream, frame.counter) for frame in taken}
        if self._belief_at is None:
            self._belief_at = poses[t_ns]
        for result in results:
            self._belief, self._belief_at = result.belief, result.odometry_pose
            self._is_lost = result.is_lost
        self.state = self._state(t_ns, poses[t_ns], results)
        return self.state

    @property
    def landmarks(self) -> Landmarks:
        """Return the map after the newest state."""
        belief = self._belief
        given = dict[int, int]()
        if isinstance(self._pipeline, RobustSlam):
            of_label = self._pipeline.back_end.landmark_of_label
            given = {landmark: label for label, landmark in of_label.items()}
        return Landmarks(
            ids=belief.landmark_ids,
            positions_m=self._placed(belief.landmarks),
            covariances_m2=self._turned(belief.landmark_covariances()),
            given_ids=tuple(given.get(id_) for id_ in belief.landmark_ids),
        )

    @property
    def walls(self) -> Array:
        """Return the ends of the stretches of wall that answered, (k, 2, 2) [m], map frame."""
        spans = self._pipeline.wall_spans_m()
        return self._placed(spans.reshape(-1, 2)).reshape(-1, 2, 2)

    def smoothed(self) -> SmoothedRun | None:
        """Return the solution over all states until now, map frame; None if there is none.

        It is solved for at every call; later steps return the same as without it. Preset ``paper``
        has none.
        """
        with one_blas_thread():
            run = self._pipeline.smoothed()
        if run is None or not self._start.any():
            return run
        return replace(
            run,
            poses=np.array([compose(self._start, pose) for pose in run.poses]).reshape(-1, 3),
            pose_covariances=self._turned(run.pose_covariances),
            landmarks_m=self._placed(run.landmarks_m),
            landmark_covariances_m2=self._turned(run.landmark_covariances_m2),
        )

    def save_map(self, path: str | Path) -> None:
        """Write the map for later runs, as the solution over all states has it.

        It takes as long as `smoothed`. Of a fixed map the file is written that was given.

        Raises
        ------
        ValueError
            The preset is ``paper``, or ``start`` is another place than the origin of a map: then
            leave it out, and the map begins at the first pose.
        OSError
            The file cannot be written.
        """
        with one_blas_thread():
            saved = self._pipeline.saved_map()
        if saved is None or self._start.any():
            raise ValueError("save_map: it takes preset robust, and a map that begins at (0, 0, 0)")
        save_map(path, MapFile(map=saved))

    @property
    def map_changes(self) -> MapChanges | None:
        """Return which landmarks of the given map were seen, are gone, or are new; None without."""
        return self._pipeline.map_changes()

    def _scans(
        self, frames: Sequence[RadarFrame], ranges: Sequence[Row], points: Sequence[Row]
    ) -> list[RangeScan]:
        """Check all that was seen; return ranges and points as one scan of each mount."""
        kinds: dict[int, str] = {}
        for frame in frames:
            if not isinstance(frame, RadarFrame):
                raise StepInputError(f"frames: a {type(frame).__name__} is not a RadarFrame")
            which = f"frame {frame.counter} of radar {frame.radar}"
            if frame.radar in kinds:
                raise StepInputError(f"{which}: a step takes one frame of each radar")
            if np.isinf(frame.samples).any():
                raise StepInputError(f"{which}: its samples are not finite")
            if self._newest.get(frame.radar) == (frame.stream, frame.counter):
                raise StepInputError(f"{which}: it came before")
            kinds[frame.radar] = "frame"
        measured: dict[int, list[_Measured]] = {}
        for kind, rows in (("range", ranges), ("point", points)):
            for row in rows:
                one = _measured(row, kind)
                if kinds.setdefault(one.radar, kind) != kind:
                    raise StepInputError(
                        f"radar {one.radar} gave a {kinds[one.radar]} and a {kind}; a step takes "
                        "one kind of each"
                    )
                measured.setdefault(one.radar, []).append(one)
        if unknown := [radar for radar in kinds if not 0 <= radar < len(self.rig.mounts)]:
            raise StepInputError(
                f"radar {unknown[0]}: the rig has {len(self.rig.mounts)}, numbered from 0 in the "
                "order of its mounts"
            )
        if self.config.back_end is BackEnd.PAPER:
            has_ids = any(one.label is not None for many in measured.values() for one in many)
            if points or has_ids or (frames and ranges):
                what = "points" if points else "ids of landmarks" if has_ids else "both kinds"
                raise StepInputError(
                    f"{what}: the back end of preset paper takes frames, or ranges without ids; "
                    "preset robust takes all of them"
                )
        return [_scan_of(radar, many, kinds[radar]) for radar, many in measured.items()]

    def _pose_at(
        self,
        track: PoseTrack,
        t_ns: int,
        odometry_pose: ArrayLike | Callable[[int], ArrayLike] | None,
    ) -> Callable[[int], ArrayLike]:
        """Return what gives poses at the times of a step; a pose that is given joins the track."""
        if callable(odometry_pose):
            return odometry_pose
        if odometry_pose is not None:
            pose = _pose(odometry_pose, f"odometry at {t_ns} ns")
            if len(track) and t_ns <= track.last_ns:
                apart = between(track.pose_at(t_ns), compose(track.frame_at(t_ns), pose))
                if t_ns < track.last_ns or np.abs(apart).max() > _SAME:
                    raise StepInputError(
                        f"odometry_pose at {t_ns} ns: poses until {track.last_ns} ns were given "
                        "before; leave it out, and the pose comes from them"
                    )
            else:
                track.add(t_ns, pose.tolist())

        def pose_at(stamp_ns: int) -> Array:
            if not len(track) or not track.first_ns <= stamp_ns <= track.last_ns + NEAR_NS:
                known = f"{track.first_ns} to {track.last_ns} ns" if len(track) else "none so far"
                raise StepInputError(
                    f"no odometry at {stamp_ns} ns: known {known}; give poses until then first, by "
                    "add_odometry or as a function of time, or frames of that time in a later step"
                )
            if stamp_ns > track.last_ns:
                return track.extrapolated(stamp_ns)
            if (gap := track.gap_at(stamp_ns)) is not None:
                raise StepInputError(
                    f"no odometry at {stamp_ns} ns: the robot drove, and no pose came between "
                    f"{gap[0]} and {gap[1]} ns; leave out what was seen then"
                )
            return track.pose_at(stamp_ns)

        return pose_at

    def _gathered(
        self,
        frames: Sequence[RadarFrame],
        scans: Sequence[RangeScan],
        poses: dict[int, Array],
        t_ns: int,
    ) -> tuple[StepResult, ...]:
        """Step the pipeline; with ranges of mounts that measure in turn, once a round is over."""
        new = [_Waiting(scan=scan, t_ns=t_ns, pose=poses[t_ns]) for scan in scans]
        given = [one for one in new if not one.is_part_of_round]
        ranged = {one.scan.radar: one for one in new if one.is_part_of_round}
        others = {one.scan.radar for one in given} | {frame.radar for frame in frames}
        before = {radar: one for radar, one in self._waiting.items() if radar not in others}
        results: tuple[StepResult, ...] = ()
        newest_ns = max([one.t_ns for one in before.values()], default=t_ns)
        is_late = t_ns - min([one.t_ns for one in before.values()], default=t_ns) >= _ROUND_NS
        if is_late or not before.keys().isdisjoint(ranged):
            # That round ends without the mounts that are missing, when it was measured. A step with
            # frames may be refused still, and must leave all as it was.
            if newest_ns >= self._stepped_ns and not frames:
                results = self._stepped((), [*before.values()], {}, newest_ns)
            self._round, before = set(before), {}
        waiting = before | ranged
        # A mount that measures together with others, and has no range this time, is not waited for.
        due = self._round.difference(waiting, *[self._beside.get(radar, ()) for radar in waiting])
        if waiting and not due:
            given += waiting.values()
            self._round, waiting = set(waiting), {}
        if given or frames or not waiting:
            results += self._stepped(frames, given, poses, t_ns)
        self._waiting = waiting
        self._beside |= {radar: set(ranged) for radar in ranged}
        return results

    def _stepped(
        self,
        frames: Sequence[RadarFrame],
        given: Sequence[_Waiting],
        poses: dict[int, Array],
        t_ns: int,
    ) -> tuple[StepResult, ...]:
        poses = poses | {one.t_ns: one.pose for one in given}
        pose_at, self._stepped_ns = poses.__getitem__, t_ns
        if isinstance(self._pipeline, RobustSlam):
            scans = [one.scan_from(t_ns, poses[t_ns], self._wheels) for one in given]
            return self._pipeline.step_scans(frames, scans, pose_at, t_ns)
        if given:
            detections = [
                Detection(radar=one.scan.radar, t_ns=one.t_ns, range_m=range_m, amplitude=math.nan)
                for one in given
                for range_m in one.scan.ranges_m
            ]
            return self._pipeline.step_detections(detections, pose_at, t_ns)
        return self._pipeline.step(frames, pose_at, t_ns)

    def _state(self, t_ns: int, odometry: Array, results: tuple[StepResult, ...]) -> SlamState:
        """Return the newest belief's pose, moved on by odometry since then."""
        assert self._belief_at is not None
        pose, covariance = self._belief.pose, self._belief.pose_covariance
        if not np.array_equal(odometry, self._belief_at):
            moved = between(self._belief_at, odometry)
            G = motion_jacobian(float(pose[2]), moved)
            covariance = G @ covariance @ G.T + _motion_noise(moved, float(pose[2]), self._wheels)
            pose = compose(pose, moved)
        if self._start.any():
            pose, covariance = compose(self._start, pose), self._turned(covariance)
        return SlamState(
            t_ns=t_ns, pose=pose, covariance=covariance, is_lost=self._is_lost, results=results
        )

    def _placed(self, points_m: Array) -> Array:
        """Return points (n, 2) of the pipeline's map in the map that begins at ``start``."""
        return transform(self._start, points_m) if self._start.any() else points_m

    def _turned(self, covariances: Array) -> Array:
        """Return covariances (..., 2, 2) or (..., 3, 3) in the same way."""
        if not self._start.any():
            return covariances
        R = np.eye(covariances.shape[-1])
        cosine, sine = math.cos(self._start[2]), math.sin(self._start[2])
        R[:2, :2] = [[cosine, -sine], [sine, cosine]]
        return np.asarray(R @ covariances @ R.T)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Waiting:
    """What a mount measured, when, and where odometry had the robot then."""

    scan: RangeScan
    t_ns: int
    pose: Array

    @property
    def is_part_of_round(self) -> bool:
        """Return whether it is ranges without ids, which say little without the other mounts'."""
        return self.scan.bearings_rad is None and self.scan.labels is None

    def scan_from(self, t_ns: int, pose: Array, wheels: WheelNoise) -> RangeScan:
        """Return the scan as part of a state at another time; the way there adds to its noise."""
        if t_ns == self.t_ns:
            return self.scan
        moved = between(pose, self.pose)
        added_m = math.sqrt(np.trace(_motion_noise(moved, 0.0, wheels)[:2, :2]))
        x, y, turn = moved.tolist()
        return replace(self.scan.with_added_sigma(added_m), moved=(x, y, turn))


def _on_map(given: str | Path | MapFile, start: Array | None, *, is_fixed: bool) -> StartOnMap:
    file = given if isinstance(given, MapFile) else load_map(given)
    pose = None if start is None else (float(start[0]), float(start[1]), float(start[2]))
    return StartOnMap(map=file.map, pose=pose, is_fixed=is_fixed)


class _Measured(NamedTuple):
    """One range, or one point with a bearing, of a mount."""

    radar: int
    label: int | None
    range_m: float
    sigma_m: float
    bearing_rad: float = 0.0
    bearing_sigma_rad: float = 0.0


_FIELDS = {
    "range": ("radar", "range_m", "sigma_m"),
    "point": ("radar", "range_m", "bearing_rad", "sigma_m", "bearing_sigma_rad"),
}
"""What rows of numbers hold; the id of a landmark may follow."""


def _measured(row: Sequence[Any], kind: str) -> _Measured:
    """Return what a row of ``ranges`` or ``points`` says; StepInputError if it cannot be."""
    names, values = _FIELDS[kind], _items(row, f"{kind}s: one of them")
    n = len(names)
    try:
        if len(values) not in (n, n + 1):
            raise ValueError
        radar = operator.index(values[0])
        numbers = dict(zip(names[1:], map(float, values[1:n]), strict=True))
        label = None if values[n:] in ((), (None,)) else operator.index(values[n])
    except (TypeError, ValueError, OverflowError):
        text = (
            f"({', '.join(names)}), the radar as a whole number (int), the others as numbers, "
            "and perhaps the id of a landmark, an int"
        )
        raise StepInputError(f"{kind} {values}: must be {text}") from None
    one = _Measured(radar, label, **numbers)
    sigmas = [value for name, value in numbers.items() if "sigma" in name]
    if not all(map(math.isfinite, numbers.values())) or min(sigmas) <= 0.0:
        raise StepInputError(f"{kind} {values}: numbers must be finite, sigmas positive")
    if not 0.0 < one.range_m < LONGEST_M or one.sigma_m > LONGEST_M:
        raise StepInputError(
            f"{kind} {values}: range_m must be positive, range_m and sigma_m below {LONGEST_M:g}"
        )
    return one


def _scan_of(radar: int, many: Sequence[_Measured], kind: str) -> RangeScan:
    is_point, has_label = kind == "point", any(one.label is not None for one in many)
    return RangeScan(
        radar=radar,
        ranges_m=tuple([one.range_m for one in many]),
        sigmas_m=tuple([one.sigma_m for one in many]),
        labels=tuple([one.label for one in many]) if has_label else None,
        bearings_rad=tuple([one.bearing_rad for one in many]) if is_point else None,
        bearing_sigmas_rad=tuple([one.bearing_sigma_rad for one in many]) if is_point else None,
    )


def _items(given: Iterable[Any], what: str) -> tuple[Any, ...]:
    try:
        return tuple(given)
    except TypeError:
        raise StepInputError(f"{what} must be rows, not {given!r}") from None


def _stamp(t_ns: int) -> int:
    try:
        stamp_ns = operator.index(t_ns)
    except TypeError:
        raise StepInputError(f"t_ns is {t_ns!r}; times are whole nanoseconds") from None
    if abs(stamp_ns) > _MOST_STAMP_NS:
        raise StepInputError(f"t_ns is {t_ns}; times are of 64 bits")
    return stamp_ns


def _pose(given: ArrayLike, what: str) -> Array:
    """Return a pose as an array (3,); StepInputError if it is not three numbers of the Earth."""
    try:
        pose = np.array(given, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape != (3,) or not np.isfinite(pose).all() or np.abs(pose).max() > MOST_M:
        raise StepInputError(
            f"{what} is {given!r}; a pose is three finite numbers, x [m], y [m] and heading [rad]"
        )
    return pose


def _later_noise(given: ArrayLike, before: Array, t_ns: int) -> Array:
    """Return gathered noise (3, 3); StepInputError if it is none, or less than that before."""
    noise = np.array(given, dtype=np.float64)
    if noise.shape != (3, 3) or not np.isfinite(noise).all():
        raise StepInputError(f"odometry_noise at {t_ns} ns is not a finite matrix (3, 3)")
    variances = np.linalg.eigvalsh(noise - before)
    if variances[0] < -_ROUNDED * np.abs(noise).max():
        raise StepInputError(
            f"odometry_noise at {t_ns} ns: it is less than before by a variance of "
            f"{-variances[0]:g}; noise that odometry has gathered never falls"
        )
    return noise


def _motion_noise(moved: Array, heading_rad: float, wheels: WheelNoise) -> Array:
    """Return the covariance that a short motion (3,) adds, (3, 3), map axes.

    White noise, and the three calibration errors as if nothing were known of them yet.
    """
    distance_m, turn_rad = math.hypot(moved[0], moved[1]), float(moved[2])
    along, across, heading = wheels.step_variances(distance_m, turn_rad)
    scale, turn_scale, curvature = wheels.calibration_sigmas
    along += (scale * distance_m) ** 2
    heading += (turn_scale * turn_rad) ** 2 + (curvature * distance_m) ** 2
    return turned_covariance(np.diag([along, across, heading]), heading_rad)
