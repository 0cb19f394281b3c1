"""One run of a sweep: the demo's job without ports and processes, and its numbers."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from emulator.odometry import scene_odometry
from emulator.scene import Scene
from slam.app.emulated_rig import (
    FRAME_RATE_HZ,
    RAW_CONFIG,
    end_counter,
    open_loopback,
    rig_of,
    scene_and_config,
    true_landmarks_m,
    versions,
    wheels_of,
)
from slam.app.errors import AppError, UsageError
from slam.app.evaluation import summarise
from slam.app.false_landmarks import false_landmarks
from slam.app.known_bound import BoundSummary, bound_of
from slam.app.odometry import OdometryTrack
from slam.app.runner import RunRecord, run_slam
from slam.app.stress import CLEAN, STRESSES, Stress
from slam.app.stress_effects import OutlierDetector, stressed_scans, stressed_scene
from slam.app.summary import Summary
from slam.config import SlamConfig
from slam.detection import make_detector
from slam.pipeline import Slam
from slam.presets import ConfigError, override
from slam.robust_pipeline import make_slam

LARGEST = 1e12
"""What stands for an infinite NEES or NIS."""

Key = tuple[str, str, tuple[tuple[str, str], ...], str, int | None]
"""Scene, preset, settings, stress, seed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One run to do, complete: a worker on another machine needs no file of ours.

    Attributes
    ----------
    scene, config
        Loaded; `config` has the settings in it.
    preset, settings, stress, seed
        What the run is called by.
    bound
        Whether to compute the known-association bound on the same data.
    """

    scene: Scene
    config: SlamConfig
    preset: str
    settings: tuple[tuple[str, str], ...] = ()
    stress: str = CLEAN
    seed: int = 0
    bound: bool = False

    @property
    def key(self) -> Key:
        """Return what tells the run from all others of its sweep."""
        return (self.scene.name, self.preset, self.settings, self.stress, self.seed)


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepRun(Summary):
    """The numbers of one run of a sweep: those of summary.json, and how it differs from others.

    Attributes
    ----------
    settings
        Settings of the preset that were replaced, dotted keys.
    stress
        Row of the stress table.
    false, confident_false
        Landmarks of the map where nothing stands, and those of them that claim to be known to
        5 cm.
    bound
        The known-association bound on the same data, where it was asked for.
    """

    settings: dict[str, str] = field(default_factory=dict)
    stress: str = CLEAN
    false: int = 0
    confident_false: int = 0
    bound: BoundSummary | None = None

    @property
    def key(self) -> Key:
        """Return what tells the run from all others of its sweep."""
        return (self.scene, self.preset, tuple(self.settings.items()), self.stress, self.seed)


def never() -> None:
    """Do not stop."""


def make_case(
    scene: str,
    preset: str,
    seed: int,
    *,
    settings: Mapping[str, str] | None = None,
    stress: str = CLEAN,
    bound: bool = False,
) -> Case:
    """Load what a run needs by its names.

    Raises
    ------
    AppError
        A name or a setting is not known, or a file cannot be used; one line.
    """
    loaded, config = scene_and_config(scene, preset)
    if stress not in STRESSES:
        raise UsageError(f"unknown stress {stress!r}; known: {', '.join(STRESSES)}")
    named = tuple((settings or {}).items())
    try:
        config = override(config, dict(named))
    except ConfigError as error:
        raise UsageError(f"--set: {error}") from None
    return Case(
        scene=loaded,
        config=config,
        preset=preset,
        settings=named,
        stress=stress,
        seed=seed,
        bound=bound,
    )


def run_in_process(
    scene: str,
    preset: str,
    seed: int,
    *,
    stress: str = CLEAN,
    settings: Mapping[str, str] | None = None,
    check: Callable[[], None] = never,
) -> RunRecord:
    """Do what the demo does without ports and processes: same driver, device, odometry text."""
    return record_of(make_case(scene, preset, seed, settings=settings, stress=stress), check=check)


def run_one(scene: str, preset: str, seed: int, *, check: Callable[[], None] = never) -> Summary:
    """Run a scene with a preset and return its numbers.

    Raises
    ------
    AppError
        The scene is too short for a single state.
    """
    case = make_case(scene, preset, seed)
    return _summary(case, record_of(case, check=check))


def record_of(case: Case, *, check: Callable[[], None] = never) -> RunRecord:
    """Drive the robot through a case; SLAM is told the scene's own rig and wheels, no stress."""
    stress = STRESSES[case.stress]
    scene = stressed_scene(case.scene, stress, case.seed)
    trajectory = scene.trajectory()
    duration_ns = trajectory.duration_ns
    odometry = OdometryTrack.from_lines(scene_odometry(scene, case.seed))
    with open_loopback(scene, case.seed) as source:
        source.start(RAW_CONFIG, FRAME_RATE_HZ)
        scans = source.scans(end_counter(duration_ns), check)
        return run_slam(
            stressed_scans(scans, stress, case.seed, duration_ns),
            odometry,
            _slam(case, stress),
            trajectory.poses,
        )


def run_case(
    case: Case, program: str | None = None, *, check: Callable[[], None] = never
) -> SweepRun:
    """Run one case and return its numbers.

    Parameters
    ----------
    case
        What to run.
    program
        `program_version` of whoever asks, if that may be another machine.
    check
        Called once per scan; may raise to stop.

    Raises
    ------
    AppError
        The scene is too short for a single state, or the program here is another version.
    """
    if program not in (None, program_version()):
        raise AppError(
            "a worker has another version of xethru-hil or its libraries than this machine; "
            "install the same on both"
        )
    record = record_of(case, check=check)
    summary = _summary(case, record)
    false, confident = false_landmarks(record, case.scene)
    run = SweepRun(
        **{row.name: getattr(summary, row.name) for row in fields(summary)},
        settings=dict(case.settings),
        stress=case.stress,
        false=false,
        confident_false=confident,
        bound=bound_of(record, case.scene, case.config) if case.bound else None,
    )
    return finite(run)


def finite(run: SweepRun) -> SweepRun:
    """Return the run with NEES and NIS of a state that is certain and wrong, infinite, at 1e12.

    JSON has no infinity, and one such run must neither end a sweep nor go unseen in its means.

    Raises
    ------
    AppError
        Another number is not finite: SLAM has diverged.
    """
    nis_mean = None if run.nis_mean is None else min(run.nis_mean, LARGEST)
    capped = replace(
        run,
        nees_pose=tuple((t_s, min(nees, LARGEST)) for t_s, nees in run.nees_pose),
        nis_mean=nis_mean,
        nis_times=tuple((t_s, min(nis, LARGEST), dof) for t_s, nis, dof in run.nis_times),
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


def _slam(case: Case, stress: Stress) -> Slam:
    rig, wheels = rig_of(case.scene), wheels_of(case.scene)
    return make_slam(case.config, rig, wheels, _front_end(case, stress))


def _front_end(case: Case, stress: Stress) -> OutlierDetector | None:
    if not stress.outlier_share:
        return None
    limits = case.config.detection
    return OutlierDetector(
        detector=make_detector(case.config),
        share=stress.outlier_share,
        min_range_m=limits.min_range_m,
        max_range_m=limits.max_range_m,
        seed=case.seed,
    )


def _summary(case: Case, record: RunRecord) -> Summary:
    summary = summarise(
        record,
        scene=case.scene.name,
        preset=case.preset,
        seed=case.seed,
        rig=rig_of(case.scene),
        true_landmarks_m=true_landmarks_m(case.scene),
    )
    if summary is None:
        raise AppError(f"{case.scene.name}: too short for SLAM, no state was estimated")
    return summary
