"""The scores of the bench of images, on rooms and points that were made by hand."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.scene.scene import Scene
from hil_tests.bench.image_points.drives import drive
from hil_tests.bench.image_points.scoring import (
    FaceLengths,
    Score,
    ScoredPatch,
    pairs_within,
    rms,
    robust_sigma,
    score_points,
)
from hil_tests.bench.image_points.tables import cases, with_scene
from hil_tests.bench.image_points.truth import (
    ALLOWED_SIGMAS,
    REQUIRED_SIGMAS,
    Kind,
    RoomTruth,
)
from slam.geometry import FieldOfView, Mount, between, compose
from slam.imaging.patches import PatchRule

Array = NDArray[np.float64]

VIEW = FieldOfView()
MOUNT = Mount(x_m=0.0, y_m=0.2, yaw_rad=math.pi / 2)
T_NS = np.arange(11, dtype=np.int64) * 200_000_000
# 20 cm along x: the antenna goes from x = -0.1 to 0.1 at y = 0.2 and looks along y
POSES = np.column_stack([np.linspace(-0.1, 0.1, 11), np.zeros((11, 2))])


def room(**tables: object) -> Scene:
    return Scene.model_validate(
        {
            "name": "room",
            "environment": "lab",
            "description": "",
            "radars": [
                {"name": "left", "serial": "1" * 12, "x_m": 0.0, "y_m": 0.2, "yaw_deg": 90.0}
            ],
            **tables,
        }
    )


def rod(x_m: float, y_m: float, **keys: object) -> dict[str, object]:
    name = f"rod_{round(1e4 * x_m)}_{round(1e4 * y_m)}".replace("-", "m")
    return {"name": name, "kind": "rod", "x_m": x_m, "y_m": y_m, **keys}


def wall(name: str, start: tuple[float, float], end: tuple[float, float]) -> dict[str, object]:
    return {"name": name, "from_m": start, "to_m": end, "amplitude_1m": 0.05}


def truth_of(**tables: object) -> RoomTruth:
    return RoomTruth(room(**tables), 0, VIEW)


def scored_at(truth: RoomTruth, points_m: Array, poses: Array = POSES) -> ScoredPatch:
    return score_points(truth, points_m, mount=MOUNT, poses=poses, t_ns=T_NS, middle=5)


def test_a_rod_is_seen_from_where_the_beam_holds_it() -> None:
    # 0.8 m off the course: the half beam of 32.5 degrees reaches 0.8 tan(32.5 deg) along it
    reach_m = 0.8 * math.tan(math.radians(32.5))
    truth = truth_of(targets=[rod(0.55, 1.0)])
    seen = truth.echoes(POSES, T_NS)[:, 0] > 0
    assert seen.tolist() == (0.55 - POSES[:, 0] <= reach_m).tolist()
    assert 0 < seen.sum() < len(seen)


def test_a_rod_is_seen_between_the_limits_of_range() -> None:
    truth = truth_of(targets=[rod(0.0, 0.2 + r) for r in (0.1, 0.25, 1.45, 1.6)])
    assert (truth.echoes(POSES[5:6], T_NS[5:6])[0] > 0).tolist() == [False, True, True, False]


def test_a_rod_behind_an_opaque_wall_is_none() -> None:
    blind = {**wall("screen", (-3.0, 0.7), (3.0, 0.7)), "transmission": 0.0}
    truth = truth_of(targets=[rod(0.0, 1.2)], walls=[blind])
    assert truth.echoes(POSES, T_NS)[:, 0].max() < ALLOWED_SIGMAS


def test_a_mount_is_where_it_truly_is() -> None:
    scene = room(targets=[rod(0.0, 1.0)])
    turned = scene.radars[0].model_copy(update={"mount_error_deg": 40.0})
    away = RoomTruth(scene.model_copy(update={"radars": (turned,)}), 0, VIEW)
    assert RoomTruth(scene, 0, VIEW).echoes(POSES, T_NS).all()
    assert not away.echoes(POSES, T_NS).any()


def test_a_cylinder_is_where_its_surface_is_nearest() -> None:
    truth = truth_of(targets=[rod(0.3, 0.6, radius_m=0.1) | {"kind": "cylinder"}])
    # from (0, 0.2) the axis is 0.5 m away under 3:4
    surface = truth.reflectors.surfaces_m(np.array([0.0, 0.2]))[0]
    assert surface == pytest.approx([0.24, 0.52])
    assert truth.reflectors.kinds == (Kind.CYLINDER,)


def test_faces_at_a_right_angle_have_an_apex_and_others_have_none() -> None:
    square = truth_of(
        walls=[wall("a", (-1.0, 1.0), (0.3, 1.0)), wall("b", (0.3, 1.0), (0.3, -0.5))]
    )
    corner = square.reflectors.kinds.index(Kind.CORNER)
    assert square.reflectors.places_m[corner] == pytest.approx([0.3, 1.0])
    assert (square.echoes(POSES, T_NS)[:, corner] > REQUIRED_SIGMAS).all()
    slanting = truth_of(
        walls=[wall("a", (-1.0, 1.0), (0.3, 1.0)), wall("b", (0.3, 1.0), (0.5, -0.5))]
    )
    assert Kind.CORNER not in slanting.reflectors.kinds


def test_the_apex_behind_a_corner_is_not_seen() -> None:
    # The course is outside: the two walls turn their backs on it.
    truth = truth_of(walls=[wall("a", (-0.2, 0.9), (-0.2, 2.0)), wall("b", (-0.2, 0.9), (2, 0.9))])
    corner = truth.reflectors.kinds.index(Kind.CORNER)
    assert not truth.echoes(POSES, T_NS)[:, corner].any()
    edge = truth.reflectors.kinds.index(Kind.EDGE)
    assert truth.reflectors.places_m[edge] == pytest.approx([-0.2, 0.9])
    assert truth.echoes(POSES, T_NS)[:, edge].any()


def test_a_face_is_seen_where_the_feet_are_on_it() -> None:
    truth = truth_of(walls=[wall("a", (0.0, 1.0), (2.0, 1.0))])
    feet_m = truth.feet_m(POSES)[:, 0]
    on_it = POSES[:, 0] >= 0
    assert feet_m[on_it] == pytest.approx(POSES[on_it, 0])
    assert np.isnan(feet_m[~on_it]).all()
    turned = POSES + np.array([0.0, 0.0, math.radians(35.0)])  # the foot is out of the beam
    assert np.isnan(truth.feet_m(turned)).all()


def test_a_point_at_a_person_is_false() -> None:
    truth = truth_of(people=[{"name": "ada", "waypoints_m": [[0.2, 1.1]]}])
    assert truth.people_m(T_NS) == pytest.approx(np.tile([0.2, 1.1], (11, 1, 1)), abs=0.05)
    scored = scored_at(truth, np.array([[0.2, 0.9], [0.2, 0.7]]))
    assert (scored.found, scored.n_points, scored.n_near_people) == ((), 2, 1)


@pytest.mark.parametrize("turn_rad", [0.0, 2.0])
def test_errors_are_along_and_across_in_the_true_frame_of_the_middle(turn_rad: float) -> None:
    start = np.array([3.0, -2.0, turn_rad])
    poses = np.array([compose(start, pose) for pose in POSES])
    place = compose(start, np.array([0.1, 1.0, 0.0]))
    truth = truth_of(targets=[rod(float(place[0]), float(place[1]))])
    range_m, bearing_rad = math.hypot(0.1, 0.8), math.atan2(0.8, 0.1)
    reported = np.array(
        [
            [(range_m + 0.004) * math.cos(bearing_rad + 0.01)],
            [(range_m + 0.004) * math.sin(bearing_rad + 0.01) + 0.2],
        ]
    ).T
    scored = scored_at(truth, reported, poses)
    assert scored.along_m == pytest.approx([0.004])
    assert scored.across_rad == pytest.approx([0.01])
    assert (scored.required, scored.found, scored.n_points) == ((0,), (0,), 1)


def test_odometry_before_the_patch_does_not_count_and_a_turn_inside_does() -> None:
    """The points are those of an imager on odometry; true poses may be anywhere."""
    truth = truth_of(targets=[rod(0.0, 1.0)])
    away = np.array([5.0, 4.0, 1.0])
    moved = np.array([compose(away, pose) for pose in POSES])
    place = compose(away, np.array([0.0, 1.0, 0.0]))
    there = truth_of(targets=[rod(float(place[0]), float(place[1]))])
    point = np.array([[0.0, 1.0]])
    for room_truth, poses in ((truth, POSES), (there, moved)):
        scored = scored_at(room_truth, point, poses)
        assert scored.along_m == pytest.approx([0.0], abs=1e-12)
    turned = POSES + np.array([0.0, 0.0, 0.02])
    scored = scored_at(truth, point, turned)
    # the true body stands turned by 0.02 rad, so the rod is under a smaller bearing there
    true_m = between(turned[5], np.array([0.0, 1.0, 0.0]))[:2] - [0.0, 0.2]
    assert scored.across_rad == pytest.approx(
        [math.pi / 2 - math.atan2(true_m[1], true_m[0])], abs=1e-12
    )


def test_a_point_is_false_unless_its_reflector_is_seen_in_half_of_the_frames() -> None:
    reach_m = 0.8 * math.tan(math.radians(32.5))
    truth = truth_of(targets=[rod(reach_m + 0.05, 1.0)])  # seen from x >= 0.05: 3 of 11 frames
    scored = scored_at(truth, np.array([[reach_m + 0.05, 1.0]]))
    assert (scored.required, scored.found, scored.n_points, scored.n_late) == ((), (), 1, 1)


def test_two_points_at_one_rod_are_one_right_and_one_false() -> None:
    truth = truth_of(targets=[rod(0.0, 1.0), rod(0.3, 1.0)])
    points_m = np.array([[0.0, 1.01], [0.0, 0.98], [1.0, 1.0]])
    scored = scored_at(truth, points_m)
    score = Score()
    score.add(scored, truth.reflectors.kinds, "run")
    assert score.recall == pytest.approx(1 / 2)
    assert score.precision == pytest.approx(1 / 3)
    assert scored.along_m == pytest.approx([0.01])


def test_edges_are_right_but_not_required() -> None:
    truth = truth_of(walls=[wall("a", (0.0, 1.0), (2.0, 1.0))])
    edge = truth.reflectors.kinds.index(Kind.EDGE)
    for points_m, precision in (([[0.0, 1.0]], 1.0), ([[0.0, 0.9]], 0.0)):
        score = Score()
        scored = scored_at(truth, np.array(points_m))
        assert edge not in scored.required
        score.add(scored, truth.reflectors.kinds, "run")
        assert score.precision == precision
        assert math.isnan(score.recall)


def test_a_weak_rod_may_be_found_and_need_not() -> None:
    # 0.8 m away: 0.8**-1.5 = 1.398 of its echo at 1 m, over 5e-4 of noise
    weak, weaker = (truth_of(targets=[rod(0.0, 1.0, amplitude_1m=a)]) for a in (1e-3, 2e-4))
    assert weak.echoes(POSES[5:6], T_NS[5:6])[0] == pytest.approx([1.398 * 2], rel=1e-3)
    point = np.array([[0.0, 1.0]])
    assert (scored_at(weak, point).required, scored_at(weak, point).found_besides) == ((), (0,))
    assert scored_at(weaker, point).found_besides == ()


def test_pairs_are_as_many_as_can_be() -> None:
    # The nearest pair alone would leave the other two apart.
    points_m, places_m = np.array([[0.0, 0.0], [0.045, 0.0]]), np.array([[0.04, 0.0], [0.09, 0.0]])
    assert pairs_within(points_m, places_m, 0.05) == [(0, 0), (1, 1)]
    assert pairs_within(points_m, places_m, 0.01) == [(1, 0)]
    assert pairs_within(points_m, places_m, 0.001) == []
    assert pairs_within(np.empty((0, 2)), places_m, 0.05) == []


def test_a_room_is_recalled_by_any_patch() -> None:
    truth = truth_of(targets=[rod(-0.2, 1.0), rod(0.2, 1.0)])
    score = Score()
    for points_m in ([[-0.2, 1.0]], [[0.2, 1.0]], [[0.2, 1.0]]):
        scored = scored_at(truth, np.array(points_m))
        score.add(scored, truth.reflectors.kinds, "run")
    assert (score.recall, score.precision, score.room_recall) == (0.5, 1.0, 1.0)
    other = Score()
    other.add(scored, truth.reflectors.kinds, "other run")
    whole = Score.together([score, other])
    assert (whole.n_points, whole.room_recall) == (4, 3 / 4)


def test_a_share_of_a_face_is_found() -> None:
    truth = truth_of(walls=[wall("a", (-1.0, 1.0), (1.0, 1.0))])
    lengths = FaceLengths(truth)
    poses = np.column_stack([np.linspace(-0.5, 0.5, 101), np.zeros((101, 2))])
    lengths.see(truth.feet_m(poses))
    assert lengths.seen_m == pytest.approx(1.0, abs=0.02)
    lengths.find(np.array([[0.0, 1.03], [0.5, 1.03]]))
    assert lengths.found_m == 0.0
    assert lengths.false_line_m == pytest.approx(0.5)
    lengths.find(np.array([[0.5, 1.01], [0.0, 1.01]]))
    assert lengths.found_m == pytest.approx(0.5, abs=0.02)
    lengths.find(np.array([[0.25, 1.0], [3.0, 1.0]]))
    assert lengths.found_m == pytest.approx(0.5, abs=0.02)
    assert lengths.false_line_m == pytest.approx(0.5 + 2.0, abs=0.05)
    assert np.abs(lengths.errors_m).max() == pytest.approx(0.01)


def test_a_face_between_two_frames_that_do_not_see_it_is_not_seen() -> None:
    truth = truth_of(walls=[wall("a", (-1.0, 1.0), (1.0, 1.0))])
    lengths = FaceLengths(truth)
    lengths.see(np.array([[0.2], [math.nan], [0.8], [0.9]]))
    assert lengths.seen_m == pytest.approx(0.1, abs=0.011)


def test_a_bias_counts_in_the_rms_and_an_outlier_does_not_in_the_sigma() -> None:
    errors = [np.array([0.02, 0.021]), np.empty(0), np.array([0.019, 0.08, 0.018])]
    assert robust_sigma(errors) == pytest.approx(1.4826 * 0.001)
    squares = 0.02**2 + 0.021**2 + 0.019**2 + 0.08**2 + 0.018**2
    assert rms(errors) == pytest.approx(math.sqrt(squares / 5))
    assert math.isnan(rms([]))
    assert math.isnan(robust_sigma([]))


def test_a_short_drive_past_the_imager_is_scored() -> None:
    (case,) = cases("dense:0")
    way = {"waypoints_m": ((0.0, 0.0), (0.7, 0.0)), "laps": ("forward",)}
    (short,) = with_scene((case,), lambda scene: _driven(scene, way))
    score = drive(short, PatchRule())
    assert score.n_scans > 0.7 / 0.05 * 5  # 1 cm a scan, there and back
    assert score.recall > 0.8
    assert score.precision > 0.6
    assert rms(score.along_m) < 0.01


def _driven(scene: Scene, way: Mapping[str, object]) -> Scene:
    return scene.model_copy(update={"path": scene.path.model_copy(update=way)})
