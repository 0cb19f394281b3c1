"""Emulated drives, in this process, past an imager, and the score of what it reports.

The drive is that of a sweep (`slam.app.sweep.run`): the same driver, device, wheels and stresses.
The imager gets every frame, the rig and the path that SLAM gets: odometry, nothing of the truth.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from hil_tests.bench.image_points.scoring import MATCH_M, FaceLengths, Score, score_points
from hil_tests.bench.image_points.truth import RoomTruth
from slam.app.rig.emulated import rig_of, wheels_of
from slam.app.sweep import STRESSES
from slam.app.sweep.run import Case, source_of, stressed_scene
from slam.front_end import make_detector
from slam.front_end.matched_filter import MatchedFilterDetector
from slam.geometry import transform
from slam.imaging.imager import Imager
from slam.imaging.patches import Patch, PatchRule

Array = NDArray[np.float64]

SLIPPED_M, SLIPPED_RAD = 0.01, 0.02
"""Errors of odometry in a patch that are most likely a slip: wheels alone err less."""
TURN_WAY_M = 0.05
"""Longest way of the body in a patch of turning on the spot."""


def every_patch(_: Patch, __: Array) -> bool:
    return True


def is_turn(patch: Patch, _: Array) -> bool:
    """Return whether the robot turned on the spot while the patch was taken."""
    steps_m = np.linalg.norm(np.diff(patch.poses[:, :2], axis=0), axis=1)
    return float(steps_m.sum()) < TURN_WAY_M


def has_slip(patch: Patch, truth: Array) -> bool:
    """Return whether the wheels slipped inside a patch, from its true poses (n, 3)."""
    errors = patch.with_poses(truth).poses - patch.poses
    off_m = np.linalg.norm(errors[:, :2], axis=1)
    return bool(off_m.max() > SLIPPED_M or np.abs(errors[:, 2]).max() > SLIPPED_RAD)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A row of a table: runs whose patches are counted together.

    Attributes
    ----------
    rule
        How long patches are.
    most_m
        Largest distance of a point from its reflector.
    counts
        Which patches count, from the patch and its true poses.
    """

    label: str
    cases: tuple[Case, ...]
    rule: PatchRule = field(default_factory=PatchRule)
    most_m: float = MATCH_M
    counts: Callable[[Patch, Array], bool] = every_patch

    def scores(self) -> list[Score]:
        """Return the score of every run."""
        return [drive(case, self.rule, self.most_m, self.counts) for case in self.cases]


def drive(
    case: Case,
    rule: PatchRule,
    most_m: float = MATCH_M,
    counts: Callable[[Patch, Array], bool] = every_patch,
) -> Score:
    """Drive one case past an imager and return the score.

    The front end runs beside it, as in SLAM, since it learns the pulses of the modules; its time is
    not counted.
    """
    score = Score()
    scene = stressed_scene(case.scene, STRESSES[case.stress], case.seed)
    run = f"{case.scene.name} {case.stress} {case.seed}"
    source, rig = source_of(case), rig_of(case.scene)
    detector = make_detector(case.config, rig)
    assert isinstance(detector, MatchedFilterDetector)
    imager = Imager(case.config, rig, wheels_of(case.scene), pulses=detector.estimator, rule=rule)
    truths = [
        RoomTruth(scene, radar, source.info.field_of_view, case.seed)
        for radar in range(len(scene.radars))
    ]
    faces = FaceLengths(truths[0])
    stamps: list[list[int]] = [[] for _ in truths]
    with threadpool_limits(limits=1):
        for scan in source.scans:
            score.n_scans += 1
            for frame in scan.frames:
                detector.learn(frame)
            began_s = time.process_time()
            imaged = imager.step(scan.frames, source.odometry.pose_at)
            score.processor_s += time.process_time() - began_s
            for frame in scan.frames:
                stamps[frame.radar].append(frame.t_ns)
            for each in imaged:
                patch = each.patch
                poses = source.truth_at(patch.t_ns)
                if not counts(patch, poses):
                    continue
                truth = truths[patch.radar]
                points_m = np.array([(p.x_m, p.y_m) for p in each.points]).reshape(-1, 2)
                scored = score_points(
                    truth,
                    points_m,
                    mount=patch.mount,
                    poses=poses,
                    t_ns=patch.t_ns,
                    middle=patch.middle,
                    most_m=most_m,
                )
                score.add(scored, truth.reflectors.kinds, run)
                for line in each.lines:
                    faces.find(transform(poses[patch.middle], line.ends_m))
    source.close()
    for truth, t_ns in zip(truths, stamps, strict=True):
        faces.see(truth.feet_m(source.truth_at(np.array(t_ns, dtype=np.int64))))
    score.add_faces(faces)
    return score
