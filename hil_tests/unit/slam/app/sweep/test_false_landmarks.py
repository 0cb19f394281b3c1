"""Landmarks where nothing stands, and what they claim of themselves."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from emulator.scene.scene import ObjectSpec, Scene, TargetSpec, WallSpec, empty_room
from slam.app.run.runner import RunRecord
from slam.app.sweep.run import distance_m, false_landmarks
from slam.results import Belief, StepResult

ROOM: Scene = empty_room().model_copy(
    update={
        "targets": (
            TargetSpec(name="rod", kind="rod", x_m=1.0, y_m=2.0),
            TargetSpec(name="pillar", kind="cylinder", x_m=-3.0, y_m=0.0, radius_m=0.5),
        ),
        "walls": (WallSpec(name="wall", from_m=(5.0, -1.0), to_m=(5.0, 1.0)),),
        "objects": (
            ObjectSpec(name="box", x_m=0.0, y_m=-4.0, width_m=2.0, depth_m=1.0, yaw_deg=90.0),
        ),
    }
)


@pytest.mark.parametrize(
    ("x_m", "y_m", "far_m"),
    [
        (1.0, 2.1, 0.1),
        (-3.0, 0.3, 0.2),
        (5.3, 0.9, 0.3),
        (5.3, 1.4, 0.5),
        # the box stands on end: 1 m wide along x, 2 m along y
        (0.6, -4.0, 0.1),
        (0.0, -2.7, 0.3),
    ],
)
def test_distance_to_what_reflects(x_m: float, y_m: float, far_m: float) -> None:
    assert distance_m(ROOM, np.array([x_m, y_m])) == pytest.approx(far_m)


def test_nothing_is_infinitely_far_in_an_empty_room() -> None:
    assert distance_m(empty_room(), np.zeros(2)) == math.inf


def record(places: list[tuple[float, float]], sigmas: list[tuple[float, float]]) -> RunRecord:
    mean = np.concatenate([np.zeros(3), np.ravel(places)])
    variances = np.concatenate([np.zeros(3), np.ravel(sigmas)]) ** 2
    ids = tuple(range(len(places)))
    belief = Belief(mean=mean, covariance=np.diag(variances), landmark_ids=ids)
    return RunRecord(
        results=(cast(StepResult, SimpleNamespace(belief=belief)),),
        truth=np.zeros((1, 3)),
        world_from_map=np.array([1.0, 0.0, math.pi / 2]),
        n_frames=1,
        duration_ns=1,
        wall_s=1.0,
    )


def test_false_ones_are_counted_in_the_world_and_by_their_worst_direction() -> None:
    # map (2, 0) is world (1, 2), where the rod stands
    places = [(2.1, 0.0), (2.2, 0.0), (2.2, 0.0), (-9.0, 9.0)]
    sigmas = [(0.01, 0.01), (0.01, 0.04), (0.01, 0.06), (0.2, 0.2)]
    assert false_landmarks(record(places, sigmas), ROOM) == (3, 1)


def test_no_state_no_false_landmark() -> None:
    empty = RunRecord(
        results=(),
        truth=np.zeros((0, 3)),
        world_from_map=np.zeros(3),
        n_frames=0,
        duration_ns=0,
        wall_s=1.0,
    )
    assert false_landmarks(empty, ROOM) == (0, 0)
