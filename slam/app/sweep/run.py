"""One run of a sweep: the demo's job without ports and processes, and its numbers.

Random choices are words of Philox keyed by the run's seed, so a row changes neither the noise of
receivers nor that of the wheels: runs of one seed, clean and stressed, differ by the stress alone.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from emulator.scene.philox import counter_normals, uniforms
from emulator.scene.rooms import MOST_ROOMS, room_of
from emulator.scene.scene import CarriedSpec, Scene
from emulator.scene.toml_files import TableT, is_name
from emulator.scene.wheels import scene_odometry
from slam.app.errors import UsageError
from slam.app.rig.emulated import (
    FRAME_RATE_HZ,
    RAW_CONFIG,
    end_tick,
    open_loopback,
    outlines_m,
    rig_of,
    scene_and_config,
    true_landmarks_m,
    versions,
    wheels_of,
    with_settings,
)
from slam.app.run.runner import RunSource, execute
from slam.app.run.summary import Summary, summarise
from slam.app.sweep import CLEAN, STRESSES, SceneKeys, Stress
from slam.app.sweep.bound import BoundSummary, StateRanges, bound_of
from slam.app.sweep.outcomes import (
    CarryOutcome,
    carry_of,
    confidently_wrong,
    false_landmarks,
)
from slam.config import SlamConfig
from slam.frames import Detection, Detector, RadarFrame
from slam.front_end import make_detector
from slam.library.slam import make_slam
from slam.live.errors import AppError
from slam.live.odometry_track import NS_PER_S, OdometryTrack
from slam.live.session.description import settings_text
from slam.live.session_records import Scan, SessionInfo, SessionObserver, Snapshot
from slam.results import Pipeline, StepResult
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.wire.x4 import FIRST_COUNTER

# Streams of their own beside the radars' (serial numbers and purposes, below 2**51) and the
# odometry's, 2**63.
_STREAM = 1 << 62
_OFFSETS, _SILENCE, _DROPPED, _OUTLIERS, _MOUNTS, _RANGE_NOISE = (
    _STREAM + (part << 32) for part in range(6)
)

_SILENCE_FROM, _SILENCE_TO = 0.15, 0.75
"""When a silence may begin, in parts of the run."""
_BLOCKS_PER_FRAME = 256
"""Of four words each: three words for each of at most 341 echoes of a frame."""
LARGEST = 1e12
"""What stands for an infinite NEES or NIS."""
NO_STOP = StopFlag()
"""Of runs that no signal stops: it is never entered."""

RunKey = tuple[str, str, tuple[tuple[str, str], ...], str, int | None]
"""Scene, preset, settings, stress, seed."""


def stressed_scene(scene: Scene, stress: Stress, seed: int) -> Scene:
    """Return the scene with the keys of a stress in its tables, and what is drawn for the run.

    A radar beyond those that have a skew in the row takes them from the first again.
    """
    n = len(scene.radars)
    offsets = counter_normals(np.arange(n), seed=seed, stream=_OFFSETS).tolist()
    mounts = counter_normals(np.arange(3 * n), seed=seed, stream=_MOUNTS).reshape(-1, 3).tolist()
    radars = []
    for index, radar in enumerate(scene.radars):
        keys = dict(stress.radars)
        if skews_ms := stress.start_skews_ms:
            keys["start_skew_ms"] = skews_ms[index % len(skews_ms)]
        if stress.offset_sigma_m:
            keys["range_offset_m"] = radar.range_offset_m + stress.offset_sigma_m * offsets[index]
        if stress.mount_sigma_m or stress.mount_sigma_deg:
            x, y, yaw = mounts[index]
            keys["mount_error_m"] = (stress.mount_sigma_m * x, stress.mount_sigma_m * y)
            keys["mount_error_deg"] = stress.mount_sigma_deg * yaw
        if stress.like:
            keys["pulse"] = radar.pulse.recorded(stress.like)
        radars.append(_with(radar, keys))
    duration_s = scene.trajectory().duration_ns / NS_PER_S
    odometry = _with(scene.odometry, stress.odometry)
    if stress.walk_sigmas:
        rate = stress.walk_sigmas / math.sqrt(duration_s)
        odometry = odometry.model_copy(update={"walk_per_sqrt_s": rate})
    path = scene.path
    if stress.carried_skips:
        lift = CarriedSpec(
            at_s=stress.carried_at * duration_s, skips_s=stress.carried_skips * duration_s
        )
        path = path.model_copy(update={"carried": lift})
    recorded = {
        key: getattr(scene, key).recorded(stress.like)
        for key in ("noise", "leakage", "jitter")
        if stress.like
    }
    return scene.model_copy(
        update=recorded
        | {
            "radars": tuple(radars),
            "targets": tuple(_with(target, stress.targets) for target in scene.targets),
            "multipath": _with(scene.multipath, stress.multipath),
            "odometry": odometry,
            "path": path,
        }
    )


def _with(table: TableT, values: SceneKeys) -> TableT:
    """Return a table of a scene with these values of some keys, validated as those of a file."""
    return type(table).model_validate(table.model_dump() | dict(values)) if values else table


def stressed_scans(
    scans: Iterable[Scan], stress: Stress, seed: int, duration_ns: int
) -> Iterator[Scan]:
    """Yield the scans of a whole run without the frames that a row loses.

    A scan that lost all stays, empty. Silence is a part of the run's ``duration_ns``.
    """
    share, dead = stress.dropped_share, stress.dead_radars
    where = float(uniforms(1, seed=seed, stream=_SILENCE)[0])
    begin = _SILENCE_FROM + (_SILENCE_TO - _SILENCE_FROM) * where
    silent_ns = (begin * duration_ns, (begin + stress.silent_share) * duration_ns)

    def is_dropped(frame: RadarFrame) -> bool:
        block = frame.counter - FIRST_COUNTER
        words = uniforms(1, seed=seed, stream=_DROPPED + frame.radar, block=block)
        return float(words[0]) < share

    for scan in scans:
        is_silent = silent_ns[0] <= scan.t_ns < silent_ns[1]
        frames = tuple(
            frame
            for frame in scan.frames
            if not (is_silent or frame.radar in dead or (share and is_dropped(frame)))
        )
        yield scan if len(frames) == len(scan.frames) else replace(scan, frames=frames)


@dataclass(frozen=True, slots=True, kw_only=True)
class DisturbedDetector:
    """A front end whose ranges err, or that gives random ones with the looks of the true detection.

    Random ranges are uniform between the limits, the carrier phase, if there is one, on the circle.
    """

    detector: Detector  # the true front end
    stress: Stress
    config: SlamConfig
    seed: int  # of the run

    def detect(self, frame: RadarFrame, range_offset_m: float = 0.0) -> tuple[Detection, ...]:
        """Return the echoes of one frame, some replaced, nearest first."""
        return self.detect_many([frame], [range_offset_m])[0]

    def detect_many(
        self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
    ) -> list[tuple[Detection, ...]]:
        """Return what ``detect`` returns, for each frame with its range offset."""
        found = self.detector.detect_many(frames, offsets_m)
        if self.stress.range_noise > 1.0:
            found = [self._noisy(*pair) for pair in zip(frames, found, strict=True)]
        if self.stress.outlier_share:
            found = [self._mixed(*pair) for pair in zip(frames, found, strict=True)]
        return [tuple(sorted(each, key=lambda detection: detection.range_m)) for each in found]

    def _noisy(self, frame: RadarFrame, detections: Sequence[Detection]) -> tuple[Detection, ...]:
        robust, first = self.config.robust, (frame.counter - FIRST_COUNTER) * _BLOCKS_PER_FRAME
        normals = counter_normals(
            first + np.arange(len(detections)), seed=self.seed, stream=_RANGE_NOISE + frame.radar
        )
        added = math.sqrt(self.stress.range_noise**2 - 1.0)
        stated_m = [
            math.hypot(robust.range_floor_m, detection.sigma_m)
            if math.isfinite(detection.sigma_m)
            else robust.range_sigma_m
            for detection in detections
        ]
        return tuple(
            replace(detection, range_m=max(detection.range_m + added * sigma_m * normal, 0.0))
            for detection, sigma_m, normal in zip(
                detections, stated_m, normals.tolist(), strict=True
            )
        )

    def _mixed(self, frame: RadarFrame, detections: Sequence[Detection]) -> tuple[Detection, ...]:
        limits, block = self.config.detection, (frame.counter - FIRST_COUNTER) * _BLOCKS_PER_FRAME
        words = uniforms(
            3 * len(detections), seed=self.seed, stream=_OUTLIERS + frame.radar, block=block
        )
        span_m = limits.max_range_m - limits.min_range_m
        return tuple(
            replace(
                detection,
                range_m=limits.min_range_m + span_m * where,
                phase_rad=math.nan
                if math.isnan(detection.phase_rad)
                else math.pi * (2 * phase - 1),
            )
            if chance < self.stress.outlier_share
            else detection
            for detection, (chance, where, phase) in zip(
                detections, words.reshape(-1, 3).tolist(), strict=True
            )
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One run to do, complete: a worker on another machine needs no file of ours.

    ``config`` has the ``settings`` in it; ``bound`` asks for the known-association bound.
    """

    scene: Scene
    config: SlamConfig
    preset: str
    settings: tuple[tuple[str, str], ...] = ()
    stress: str = CLEAN
    seed: int = 0
    bound: bool = False
    room: tuple[str, int] | None = None  # family and number of a random room
    fps: int = FRAME_RATE_HZ  # frames/s that the radars are asked for

    @property
    def key(self) -> RunKey:
        return (self.scene.name, self.preset, self.settings, self.stress, self.seed)

    def with_seeds(self, count: int, first: int = 0) -> list[Case]:
        """Return ``count`` runs with seeds from ``first``; a random room adds its number.

        So no two rooms of a family share the errors of wheels and the noise.
        """
        number, step = (0, 1) if self.room is None else (self.room[1], MOST_ROOMS)
        return [replace(self, seed=first + number + step * run) for run in range(count)]


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepRun(Summary):
    """The numbers of one run of a sweep: those of summary.json, and how it differs from others.

    ``settings`` are those of the preset that were replaced, dotted keys; ``false`` and
    ``confident_false`` count the landmarks of the map where nothing stands, and those of them that
    claim to be known to 5 cm; ``bound`` is on the same data, where it was asked for; ``family`` is
    that of a random room; ``lost_share`` is the share of states reported as lost,
    ``confidently_wrong_share`` that of states as `slam.app.sweep.outcomes.confidently_wrong` counts
    them, and ``carry`` whether a robot that was carried was found again.
    """

    settings: dict[str, str]
    stress: str
    false: int
    confident_false: int
    bound: BoundSummary | None
    family: str
    lost_share: float
    lost_at_end: bool
    confidently_wrong_share: float
    carry: CarryOutcome | None

    @property
    def key(self) -> RunKey:
        return (self.scene, self.preset, tuple(self.settings.items()), self.stress, self.seed)

    @property
    def group(self) -> RunKey:
        """Key of the group of `summarise_groups` that has this run."""
        return (self.family or self.scene, *self.key[1:-1], None)


def make_case(
    scene: str,
    preset: str,
    seed: int,
    *,
    settings: Mapping[str, str] | None = None,
    stress: str = CLEAN,
    bound: bool = False,
    laps: int | None = None,
) -> Case:
    """Load what a run needs by its names; ``laps`` leaves out all but the first.

    Raises AppError if a name or a setting is not known, or a file cannot be used.
    """
    loaded, config = scene_and_config(scene, preset)
    named = tuple((settings or {}).items())
    return Case(
        scene=loaded if laps is None else first_laps(loaded, laps),
        config=with_settings(config, named),
        preset=preset,
        settings=named,
        stress=stress,
        seed=seed,
        bound=bound,
        room=room_of(scene) if is_name(scene) else None,
    )


def first_laps(scene: Scene, count: int) -> Scene:
    has = len(scene.path.laps)
    if count > has:
        raise UsageError(f"--laps {count}: scene {scene.name} has {has} laps; give {has} at most")
    path = scene.path.model_copy(update={"laps": scene.path.laps[:count]})
    return scene.model_copy(update={"path": path})


def loopback_source(
    scene: Scene,
    preset: str,
    slam: Pipeline,
    seed: int,
    *,
    noise_seed: int | None = None,
    stress: Stress = STRESSES[CLEAN],
    fps: int = FRAME_RATE_HZ,
    stop: StopFlag = NO_STOP,
) -> RunSource:
    """Return the emulated robot in this process: same driver, device and odometry text as the demo.

    ``seed`` is that of odometry and stress, and of the receivers' noise unless ``noise_seed`` is.
    """
    trajectory = scene.trajectory()
    duration_ns = trajectory.duration_ns
    radars = open_loopback(scene, seed if noise_seed is None else noise_seed)
    radars.start(RAW_CONFIG, fps)
    scans = radars.scans(end_tick(duration_ns, fps), stop)
    return RunSource(
        info=SessionInfo(
            scene=scene.name,
            preset=preset,
            seed=seed,
            radars=radars.radars,
            true_landmarks_m=true_landmarks_m(scene),
            outlines_m=outlines_m(scene),
            versions={},
            config_json=settings_text(slam.config),
        ),
        rig=rig_of(scene),
        slam=slam,
        scans=stressed_scans(scans, stress, seed, duration_ns),
        odometry=OdometryTrack.from_lines(scene_odometry(scene, seed)),
        truth_at=trajectory.poses,
        close=radars.close,
    )


class StepKeeper(SessionObserver):
    """Keeps all that led to every state of a run, for short ones."""

    def __init__(self) -> None:
        self.steps: list[StepResult] = []

    def on_snapshot(self, snapshot: Snapshot) -> None:
        assert snapshot.step is not None  # a run in this process
        self.steps.append(snapshot.step)


def source_of(case: Case, stop: StopFlag = NO_STOP) -> RunSource:
    """Return the source of a case; SLAM gets the scene's own rig and wheels, no stress."""
    stress, front_end = STRESSES[case.stress], None
    if stress.outlier_share or stress.range_noise > 1.0:
        front_end = DisturbedDetector(
            detector=make_detector(case.config, rig_of(case.scene)),
            stress=stress,
            config=case.config,
            seed=case.seed,
        )
    slam = make_slam(case.config, rig_of(case.scene), wheels_of(case.scene), front_end)
    scene = stressed_scene(case.scene, stress, case.seed)
    return loopback_source(
        scene, case.preset, slam, case.seed, stress=stress, fps=case.fps, stop=stop
    )


def run_case(case: Case, program: str | None = None, *, stop: StopFlag = NO_STOP) -> SweepRun:
    """Run one case and return its numbers.

    ``program`` is the `program_version` of the caller, if that may be another machine.

    Raises AppError if the scene is too short for a single state, or the program here is another
    version.
    """
    if program not in (None, program_version()):
        raise AppError(
            "a worker has another version of xethru-hil or its libraries than this machine; "
            "install the same on both"
        )
    source = source_of(case, stop)
    ranges = StateRanges()
    record = execute(source, [ranges] if case.bound else [])
    summary = summarise(record, source.info, source.rig)
    if summary is None or record.last is None:
        raise AppError(f"{case.scene.name}: too short for SLAM, no state was estimated")
    false, confident = false_landmarks(record.last, case.scene)
    lost = record.states.lost
    carried_ns = (
        stressed_scene(case.scene, STRESSES[case.stress], case.seed).trajectory().carried_ns
    )
    carry = None
    if carried_ns is not None:
        carry = carry_of(record, carried_ns[1], source.info, source.rig)
    run = SweepRun(
        **{row.name: getattr(summary, row.name) for row in fields(summary)},
        settings=dict(case.settings),
        stress=case.stress,
        family="" if case.room is None else case.room[0],
        lost_share=float(lost.mean()),
        lost_at_end=bool(lost[-1]),
        confidently_wrong_share=confidently_wrong(record, carried_ns, carry),
        carry=carry,
        false=false,
        confident_false=confident,
        bound=bound_of(record, ranges, case.scene, case.config) if case.bound else None,
    )
    return finite(run)


def finite(run: SweepRun) -> SweepRun:
    """Return the run with NEES and NIS of a state that is certain and wrong, infinite, at 1e12.

    JSON has no infinity, and one such run must neither end a sweep nor go unseen in its means.

    Raises AppError if another number is not finite: SLAM has diverged.
    """
    smoothed = run.smoothed_nees_pose
    capped = replace(
        run,
        nees_pose=_capped(run.nees_pose),
        smoothed_nees_pose=None if smoothed is None else _capped(smoothed),
        nis_mean=None if run.nis_mean is None else min(run.nis_mean, LARGEST),
        nis_times=_capped(run.nis_times),
    )
    try:
        json.dumps(asdict(capped), allow_nan=False)
    except ValueError:
        wrong = [
            row.name for row in fields(capped) if "nan" in repr(getattr(capped, row.name)).lower()
        ]
        raise AppError(
            f"{run.scene}, {run.preset}, stress {run.stress}, seed {run.seed}: SLAM diverged, "
            f"not finite: {', '.join(wrong) or 'an error'}; leave this preset or stress out"
        ) from None
    return capped


def _capped(rows: tuple[tuple[Any, ...], ...]) -> tuple[Any, ...]:
    """Return rows of a time, a NEES or NIS, and more, with these no larger than `LARGEST`."""
    return tuple((t_s, min(value, LARGEST), *more) for t_s, value, *more in rows)


@cache
def program_version() -> str:
    """Return a digest of our own sources and of the versions of what they build on."""
    digest = hashlib.sha256(repr(sorted(versions().items())).encode())
    for package in ("xethru_protocol", "emulator", "slam"):
        found = find_spec(package)
        assert found is not None
        assert found.origin is not None
        folder = Path(found.origin).parent
        for path in sorted(folder.rglob("*.py")):
            digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()
