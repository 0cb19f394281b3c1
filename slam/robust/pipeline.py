"""The pipeline around the robust back end: radar frames and odometry in, pose and map out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from slam.config import SlamConfig, WheelNoise
from slam.frames import Detection, Detector, RadarFrame, detect_all
from slam.front_end import make_detector
from slam.front_end.matched_filter import MatchedFilterDetector
from slam.geometry import Rig, between, compose, has_moved, transform, wrap_angles
from slam.imaging.imager import ImagedPatch, Imager
from slam.imaging.patches import Patch
from slam.imaging.points import PatchLine, PatchPoint
from slam.results import (
    Belief,
    InputCheck,
    LaggedPose,
    MapChanges,
    NoiseAt,
    PoseAt,
    SavedMap,
    SmoothedRun,
    StartOnMap,
    StepResult,
)
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.branches import Branches
from slam.robust.parameters import (
    SIGMA_PER_MEDIAN,
    BackEndParameters,
    RangeNoise,
)
from slam.robust.solver.growing_arrays import PackedRows
from slam.robust.state import calibrated_motion, quarter_turn, turned_covariance

Array = NDArray[np.float64]

_NS_PER_S = 1_000_000_000
_STILL_M, _STILL_RAD = 1e-3, 1e-3  # wheels that report less stand


class RobustSlam:
    """Ranges of all radars, each at its own time, into the robust back end; nothing is delayed.

    The belief's errors are additive, as everywhere outside ``slam.robust``; it holds the reported
    landmarks, and their ids stay. ``noise_at`` replaces the white noise of the wheels, not their
    calibration errors. With a map of an earlier run (`StartOnMap`) all is in its frame.
    """

    def __init__(
        self,
        config: SlamConfig,
        rig: Rig,
        wheels: WheelNoise,
        detector: Detector | None = None,
        *,
        rules: BackEndParameters | None = None,
        noise_at: NoiseAt | None = None,
        on_map: StartOnMap | None = None,
    ) -> None:
        self.config = config
        self.rig = rig
        parameters = back_end_parameters(config, wheels, rules)
        self._on_map = on_map
        self._branches = Branches(rig, parameters, on_map)
        # What is reported of a map that stays as it is
        self._fixed: tuple[Belief, Array] | None = None
        if on_map is not None and on_map.is_fixed:
            begin = self._branches.map
            self._fixed = belief_of(begin), begin.wall_spans_m()
        self._detector = detector or make_detector(config, rig)
        self._noise_at, self._noise = noise_at, np.zeros((3, 3))  # the latter at the last state
        self._least_noise = np.diag(np.square([wheels.floor_m, wheels.floor_m, wheels.floor_rad]))
        self._patches: PatchScans | None = None
        # With a caller's detector there are no images.
        if config.robust.patches and detector is None:
            learned = self._detector
            pulses = learned.estimator if isinstance(learned, MatchedFilterDetector) else None
            imager = Imager(config, rig, wheels, pulses)
            self._patches = PatchScans(imager, rig, parameters)
        self._check = InputCheck(rig)
        self._pose: Array | None = None  # odometry at the last state
        self._t_ns = 0  # time of that
        # Since when the wheels have stood at a pose, and how long they did since the last state
        self._still, self._still_ns, self._stood_ns = np.zeros(3), 0, 0
        self._stamps_ns = PackedRows(np.dtype(np.int64))  # of all states
        self._last_lagged = 0  # number of the newest lagged pose that was reported

    @property
    def back_end(self) -> RobustBackEnd:
        """Return the back end that is believed now."""
        return self._branches.main

    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Return the state if the robot has moved; without any frame there is odometry alone."""
        return self.step_scans(frames, (), pose_at, t_ns)

    def step_detections(
        self, detections: Sequence[Detection], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Do what ``step`` does; a radar without a detection looked at ``t_ns`` and saw nothing."""
        stamps_ns = dict.fromkeys(range(len(self.rig.mounts)), t_ns)
        stamps_ns |= self._check.stamps_ns(detections)
        return self._take(lambda: tuple(detections), stamps_ns, pose_at, t_ns)

    def step_scans(
        self,
        frames: Sequence[RadarFrame],
        given: Sequence[RangeScan],
        pose_at: PoseAt,
        t_ns: int,
    ) -> tuple[StepResult, ...]:
        """Do what ``step`` does, with ready scans of other mounts beside the frames.

        A mount with neither did not look.
        """
        stamps_ns = self._check.stamps_ns(frames)
        detect = partial(detect_all, self._detector, frames, self.rig)
        return self._take(detect, stamps_ns, pose_at, t_ns, given=given, frames=frames)

    def flush(self) -> tuple[StepResult, ...]:
        return ()

    def wall_spans_m(self) -> Array:
        if self._fixed is not None:
            return self._fixed[1]
        branches = self._branches
        return (branches.map if branches.is_unplaced else branches.main).wall_spans_m()

    def smoothed(self) -> SmoothedRun | None:
        if not len(self._stamps_ns) or self._branches.is_unplaced:
            return None
        smoothed = self.back_end.smoothed(self._stamps_ns.rows.copy())
        if smoothed is None or self._fixed is None:
            return smoothed
        fixed = self._fixed[0]
        return replace(
            smoothed,
            landmark_ids=fixed.landmark_ids,
            landmarks_m=fixed.landmarks,
            landmark_covariances_m2=fixed.landmark_covariances(),
        )

    def saved_map(self) -> SavedMap:
        """Return the map for another run; one that stays as it is, or has no place yet, as it was.

        It is that of the solution over all poses, which takes as long as `smoothed`.
        """
        if self._on_map is not None and (self._fixed is not None or self._branches.is_unplaced):
            return self._on_map.map
        return self._branches.map.saved_map()

    def map_changes(self) -> MapChanges | None:
        if self._on_map is None:
            return None
        return self._branches.map.map_changes(self._on_map.map)

    def _take(
        self,
        detect: Callable[[], tuple[Detection, ...]],
        stamps_ns: dict[int, int],
        pose_at: PoseAt,
        t_ns: int,
        *,
        given: Sequence[RangeScan] = (),
        frames: Sequence[RadarFrame] = (),
    ) -> tuple[StepResult, ...]:
        pose = self._check.begin(pose_at, t_ns)
        poses = {t_ns: pose}
        if self._pose is None:
            self._accept((), poses, t_ns)
            self._pose, self._t_ns = pose, t_ns
            self._still, self._still_ns, self._stood_ns = pose, t_ns, 0
            self._noise_since(pose, t_ns)
            return ()
        if self._patches is not None:
            poses |= {frame.t_ns: self._check.pose(pose_at, frame.t_ns) for frame in frames}
        # What is seen again from one place is no new evidence: clutter and aspect stay the same.
        window = self.config.window
        if not has_moved(self._pose, pose, window.min_distance_m, window.min_turn_rad):
            self._accept(frames, poses, t_ns)
            self._stand(pose, t_ns)
            return ()
        moved = {
            radar: None if stamp_ns == t_ns else between(pose, self._check.pose(pose_at, stamp_ns))
            for radar, stamp_ns in stamps_ns.items()
        }
        detections = detect()
        self._accept(frames, poses, t_ns)
        self._stand(pose, t_ns)
        sigmas_m = tuple(self._sigma_m(detection) for detection in detections)
        branches = self._branches
        elapsed_s = (t_ns - self._t_ns) / _NS_PER_S
        covariance = self._noise_since(self._pose, t_ns)
        stood_s = self._stood_ns / _NS_PER_S
        branches.predict(between(self._pose, pose), elapsed_s, stood_s, covariance)
        imaged = {frame.radar for frame in frames} if self._patches is not None else set[int]()
        scans = [*self._scans(detections, sigmas_m, moved, imaged), *given]
        if self._patches is not None and branches.main.slipped is not None:
            self._patches.begin_anew()
        elif self._patches is not None and not branches.main.undecided_covariance.any():
            scans += self._patches.scans(self.back_end.state.calibration)
        report = branches.update(scans)
        self._pose, self._t_ns, self._stood_ns = pose, t_ns, 0
        self._stamps_ns.append(t_ns)
        return (
            StepResult(
                t_ns=t_ns,
                odometry_pose=pose,
                belief=self.belief(),
                detections=detections,
                report=report,
                range_sigmas_m=sigmas_m,
                lagged=self._lagged(),
            ),
        )

    def _lagged(self) -> tuple[LaggedPose, ...]:
        """Return the past poses that became final in the newest step; none while it is lost."""
        if self._branches.is_lost:
            return ()
        # A back end that is believed from now on may have poses that the one before has reported.
        new = [one for one in self.back_end.lagged if one.number > self._last_lagged]
        if new:
            self._last_lagged = new[-1].number
        return tuple(
            LaggedPose(
                t_ns=int(self._stamps_ns.rows[one.number - 1]),  # pose 0, the start, is no state
                pose=one.pose,
                covariance=one.covariance,
            )
            for one in new
        )

    def _accept(self, frames: Sequence[RadarFrame], poses: Mapping[int, Array], t_ns: int) -> None:
        """Take a step; images take every frame, even where the robot has hardly moved."""
        self._check.accept(t_ns)
        if self._patches is not None:
            self._patches.take(frames, poses, t_ns, self.back_end.state.calibration)

    def _stand(self, pose: Array, t_ns: int) -> None:
        """Note for how long the wheels have stood."""
        if has_moved(self._still, pose, _STILL_M, _STILL_RAD):
            self._still, self._still_ns = pose, t_ns
        self._stood_ns = max(self._stood_ns, t_ns - self._still_ns)

    def _noise_since(self, before: Array, t_ns: int) -> Array | None:
        """Return the noise since the last state, (3, 3), body frame of the pose before.

        None where the model of the wheels has it.
        """
        if self._noise_at is None:
            return None
        noise = self._noise_at(t_ns)
        new, self._noise = noise - self._noise, noise
        return np.asarray(turned_covariance(new, -float(before[2])) + self._least_noise)

    def belief(self) -> Belief:
        """Return pose and map as they are reported now."""
        branches = self._branches
        belief = belief_of(branches.map, branches.lost_pose, branches.doubted_covariance)
        if self._fixed is None:
            return belief
        fixed = self._fixed[0]
        covariance = fixed.covariance.copy()
        covariance[:3, :3] = belief.pose_covariance
        covariance[:3, 3:], covariance[3:, :3] = 0.0, 0.0
        mean = np.concatenate([belief.pose, fixed.mean[3:]])
        return replace(fixed, mean=mean, covariance=covariance)

    def _sigma_m(self, detection: Detection) -> float:
        """Return the standard deviation of a range; infinite for one to be left out."""
        config = self.config.robust
        if math.isnan(detection.sigma_m):
            return config.range_sigma_m
        if detection.misfit > config.max_misfit or detection.sigma_m > config.max_predicted_sigma_m:
            return math.inf
        return math.hypot(config.range_floor_m, detection.sigma_m)

    def _scans(
        self,
        detections: Sequence[Detection],
        sigmas_m: Sequence[float],
        moved: Mapping[int, Array | None],
        imaged: Collection[int],
    ) -> list[RangeScan]:
        """Return the scan of every radar with a frame, the ranges that are unfit as blurred."""
        fit: dict[int, list[tuple[float, float]]] = {radar: [] for radar in moved}
        blurred: dict[int, list[float]] = {radar: [] for radar in moved}
        for detection, sigma_m in zip(detections, sigmas_m, strict=True):
            if sigma_m < math.inf:
                fit[detection.radar].append((detection.range_m, sigma_m))
            else:
                blurred[detection.radar].append(detection.range_m)
        return [
            RangeScan(
                radar=radar,
                ranges_m=tuple(range_m for range_m, _ in fit[radar]),
                sigmas_m=tuple(sigma_m for _, sigma_m in fit[radar]),
                moved=None if motion is None else (motion[0], motion[1], motion[2]),
                blurred_m=tuple(blurred[radar]),
                is_imaged=radar in imaged,
            )
            for radar, motion in moved.items()
        ]


class PointNoise:
    """Standard deviations of the points of patches, learned from how the points repeat.

    Each point is compared with the nearest one in the newest earlier patch of the same radar that
    shares no frame with its own. The two differ by the errors of both and by those of the wheels in
    between; they differ more if the body does not answer from one place, which no model of noise
    and wheels contains. ``sigma_m`` and ``sigma_rad`` are those of a single point, from the median
    magnitude of the newest differences; the rule's own values count as some further differences.
    """

    def __init__(self, parameters: BackEndParameters) -> None:
        self._rule = rule = parameters.imaged
        self._most_apart_m = parameters.continuation.blur_m
        self._patches: dict[int, list[ImagedPatch]] = {}  # the last one compared with, and later
        self._differences: deque[tuple[float, float]] = deque(maxlen=rule.differences)
        self.sigma_m, self.sigma_rad = rule.sigma_m, rule.sigma_rad

    def begin_anew(self) -> None:
        """Compare no patch of before with those that come: the way between them is not known."""
        self._patches.clear()

    def take(self, imaged: ImagedPatch) -> None:
        """Compare the points of a patch, whose origin is on the path of those before."""
        newest = self._patches.setdefault(imaged.patch.radar, [])
        apart = [one for one in newest if one.patch.t_ns[-1] < imaged.patch.t_ns[0]]
        del newest[: max(len(apart) - 1, 0)]
        newest.append(imaged)
        if not (apart and apart[-1].points and imaged.points):
            return
        before, mount = apart[-1], imaged.patch.mount
        places = np.array([(one.x_m, one.y_m) for one in before.points])
        seen = transform(between(imaged.patch.origin, before.patch.origin), places)
        away = seen - (mount.x_m, mount.y_m)
        ranges_m = np.hypot(away[:, 0], away[:, 1])
        bearings = np.arctan2(away[:, 1], away[:, 0]) - mount.yaw_rad
        for one in imaged.points:
            by_range = one.range_m - ranges_m
            by_bearing = wrap_angles(one.bearing_rad - bearings)
            apart_m = np.hypot(by_range, one.range_m * by_bearing)
            nearest = int(np.argmin(apart_m))
            if apart_m[nearest] < self._most_apart_m:
                self._differences.append((float(by_range[nearest]), float(by_bearing[nearest])))
        n, prior = len(self._differences), self._rule.prior_differences
        if n:
            both = SIGMA_PER_MEDIAN * np.median(np.abs(np.array(self._differences)), axis=0)
            variances = n * np.square(both) / 2.0
            variances += prior * np.square([self._rule.sigma_m, self._rule.sigma_rad])
            self.sigma_m, self.sigma_rad = np.sqrt(variances / (n + prior)).tolist()


class PatchScans:
    """Points and walls of patches as scans with bearings, each as of the newest pose.

    The wheels' path is corrected by what is known of their calibration: an error of scale would
    turn all bearings.
    """

    def __init__(self, imager: Imager, rig: Rig, parameters: BackEndParameters) -> None:
        self._imager, self._rig = imager, rig
        self._wheels, self._rule = parameters.wheels, parameters.imaged
        # The newest pose, as reported and on the corrected path
        self._reported: Array | None = None
        self._path = np.zeros(3)
        self._waiting: list[ImagedPatch] = []
        self._noise = PointNoise(parameters)

    def take(
        self,
        frames: Sequence[RadarFrame],
        poses: Mapping[int, Array],
        t_ns: int,
        calibration: Array,
    ) -> None:
        """Image frames; odometry has the ``poses`` at their times and at that of the step."""
        before = poses[t_ns] if self._reported is None else self._reported
        path = self._path

        def pose_at(t_ns: int) -> Array:
            motion = calibrated_motion(between(before, poses[t_ns]), calibration, self._wheels)
            return compose(path, np.append(motion.step_m, motion.turn_rad))

        self._waiting += self._imager.step(frames, pose_at)
        self._reported, self._path = poses[t_ns], pose_at(t_ns)

    def begin_anew(self) -> None:
        """Forget the frames so far, and what waits: the way from there to now is not known."""
        self._imager.begin_anew()
        self._noise.begin_anew()
        self._waiting.clear()

    def scans(self, calibration: Array) -> list[RangeScan]:
        """Return the scans of the oldest patch that waits: of its points, and of its walls.

        Not to be called while the newest steps may be a slip: the way from a patch to now would not
        be known. If a patch of each radar waits there are those of several, so that patches of one
        side are taken one after the other.
        """
        ready = self._waiting[: max(1, len(self._waiting) - len(self._rig.mounts) + 1)]
        del self._waiting[: len(ready)]
        for one in ready:
            self._noise.take(one)
        return [scan for one in ready for scan in self._scans(one, calibration)]

    def _scans(self, imaged: ImagedPatch, calibration: Array) -> tuple[RangeScan, RangeScan]:
        mount = imaged.patch.mount
        stretches = [
            (line.ends_m - (mount.x_m, mount.y_m)) @ quarter_turn(line.normal)
            for line in imaged.lines
        ]
        faces_m = tuple([(float(one.min()), float(one.max())) for one in stretches])
        return (
            self._scan(imaged.patch, imaged.points, calibration),
            self._scan(imaged.patch, imaged.lines, calibration, faces_m),
        )

    def _scan(
        self,
        patch: Patch,
        found: Sequence[PatchPoint | PatchLine],
        calibration: Array,
        faces_m: tuple[tuple[float, float], ...] | None = None,
    ) -> RangeScan:
        dx, dy, turn = between(self._path, patch.origin).tolist()
        s, w, _ = calibration.tolist()
        # What the wheels do between the patch and the newest pose
        along, _, heading = self._wheels.step_variances(math.hypot(dx, dy), turn)
        share, noise = self._rule.bearing_share, self._noise
        bearings_rad = [one.bearing_rad for one in found]
        mirrors: list[int | None] = [None] * len(found)
        for k, one in enumerate(tuple(found)):
            mirrored_rad = one.mirrored_rad if isinstance(one, PatchPoint) else None
            if mirrored_rad == one.bearing_rad:
                mirrors[k] = k
            elif mirrored_rad is not None:
                mirrors[k] = len(mirrors)
                mirrors.append(k)
                bearings_rad.append(mirrored_rad)
        found = [*found, *(found[k] for k in mirrors[len(found) :] if k is not None)]
        radii_m, radius_sigmas_m = None, None
        if faces_m is None:
            points = [one for one in found if isinstance(one, PatchPoint)]
            radii_m = tuple([one.radius_m for one in points])
            radius_sigmas_m = tuple([one.radius_sigma_m for one in points])
        return RangeScan(
            radar=patch.radar,
            is_patch=True,
            moved=(dx * (1.0 + s), dy * (1.0 + s), turn * (1.0 + w)),  # as the wheels report it
            ranges_m=tuple([one.range_m for one in found]),
            sigmas_m=tuple([math.sqrt(one.sigma_m**2 + along + noise.sigma_m**2) for one in found]),
            bearings_rad=tuple(bearings_rad),
            mirrors=tuple(mirrors),
            bearing_sigmas_rad=tuple(
                [
                    share * math.sqrt(one.bearing_sigma_rad**2 + heading + noise.sigma_rad**2)
                    for one in found
                ]
            ),
            faces_m=faces_m,
            radii_m=radii_m,
            radius_sigmas_m=radius_sigmas_m,
        )


def back_end_parameters(
    config: SlamConfig, wheels: WheelNoise, rules: BackEndParameters | None = None
) -> BackEndParameters:
    """Return the rules, by default those of this version, with the noise that is configured."""
    robust, limits = config.robust, config.detection
    reach_m = limits.max_range_m - limits.min_range_m
    rules = rules or BackEndParameters()
    return replace(
        rules,
        wheels=replace(wheels, walk_per_sqrt_m=robust.wheel_walk_per_sqrt_m),
        ranges=RangeNoise(
            sigma_m=robust.range_sigma_m,
            association_sigma_m=robust.association_doubt_m,
            huber_sigmas=robust.huber_sigmas,
            offset_sigma_m=robust.offset_sigma_m,
            mount_sigma_m=robust.mount_sigma_m,
            radius_sigma_m=robust.radius_sigma_m,
            variance_share=robust.range_variance_share,
            detection_probability=robust.detection_probability,
            clutter_per_m=robust.false_ranges_per_frame / reach_m,
            field_of_view_rad=robust.field_of_view_rad,
            min_range_m=limits.min_range_m,
            max_range_m=limits.max_range_m,
        ),
    )


def belief_of(
    back_end: RobustBackEnd,
    lost_pose: tuple[Array, Array] | None = None,
    doubted: Array | None = None,
) -> Belief:
    """Return pose and reported landmarks with additive errors, as a belief of its own.

    While the robot is lost, ``lost_pose`` replaces its pose (3,) and covariance (3, 3).

    With e_add = e + t e_th, t = J x for every point x (``State.additive_transform``), the
    covariance is P + t p_th^T + p_th t^T + P_thth t t^T: O(m^2), not a product of matrices. The
    position has what `State.curved_covariance` adds, too.
    """
    state = back_end.state
    rows = np.array(back_end.reported_rows(), dtype=np.intp)
    at = np.concatenate([np.array([1, 2, 0]), state.landmark_columns(rows)])
    P = state.P.block(at)
    landmarks = state.landmarks_m[rows]
    turned = np.concatenate(
        [quarter_turn(state.position_m), [0.0], quarter_turn(landmarks).ravel()]
    )
    along = np.outer(turned, P[2] + 0.5 * P[2, 2] * turned)
    covariance = P + (along + along.T)
    covariance[:2, :2] += state.curved_covariance()
    if doubted is not None:
        covariance[:3, :3] += doubted
    pose = state.pose
    if lost_pose is not None:
        covariance[:3], covariance[:, :3] = 0.0, 0.0
        pose, covariance[:3, :3] = lost_pose
    return Belief(
        mean=np.concatenate([pose, landmarks.ravel()]),
        covariance=covariance,
        landmark_ids=tuple(state.landmark_ids[row] for row in rows),
        next_id=state.next_id,
    )
