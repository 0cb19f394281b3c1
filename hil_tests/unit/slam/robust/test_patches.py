"""Points of patches as detections: what their scans say, and what the back end makes of them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.app.sweep.run import make_case, source_of
from slam.config import (
    ConfigError,
    RobustConfig,
    WheelNoise,
    config_from_tables,
    load_preset,
    override,
)
from slam.frames import RadarFrame
from slam.front_end import make_detector
from slam.geometry import between, compose, paper_rig, transform
from slam.imaging.imager import ImagedPatch, Imager
from slam.imaging.patches import Patch
from slam.imaging.points import PatchLine, PatchPoint
from slam.results import Belief
from slam.robust.association import (
    MirrorWay,
    RangeScan,
    View,
    antennas_of,
    find_points,
    view,
)
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import body_point, detections_of
from slam.robust.map import Existence
from slam.robust.parameters import BackEndParameters, ImagedPointRule, MapRule, RangeNoise
from slam.robust.pipeline import PatchScans, PointNoise, RobustSlam
from slam.robust.state import State, SymmetricMatrix

Array = NDArray[np.float64]

RIG = paper_rig()
NOISE = RangeNoise()
PARAMETERS = BackEndParameters(ranges=NOISE)
RULE = ImagedPointRule()
ROD = np.array([0.3, 0.9])  # in view of radar 0 from about the origin


class GivenPatches:
    """An imager that has one patch, of the third frame, and looks up poses as a real one does."""

    def __init__(self, make: Callable[[Array], ImagedPatch]) -> None:
        self._make, self.n_steps = make, 0

    def step(
        self, frames: Sequence[RadarFrame], pose_at: Callable[[int], Array]
    ) -> tuple[ImagedPatch, ...]:
        self.n_steps += 1
        return (self._make(pose_at(2)),) if self.n_steps == 3 else ()


def imaged(origin: Array, rod: Array, sigma_m: float) -> ImagedPatch:
    """Return a patch of radar 0 about a pose that shows a rod, (2,) in its body frame, exactly.

    ``sigma_m`` is the standard deviation that is stated for it, along and across the line of sight.
    """
    mount = RIG.mounts[0]
    away = rod - (mount.x_m, mount.y_m)
    point = PatchPoint(
        x_m=float(rod[0]),
        y_m=float(rod[1]),
        range_m=math.hypot(*away),
        bearing_rad=math.atan2(away[1], away[0]) - mount.yaw_rad,
        sigma_m=sigma_m,
        bearing_sigma_rad=sigma_m / math.hypot(*away),
        amplitude=0.015,
        snr=30.0,
        radius_m=0.0,
        radius_sigma_m=0.03,
    )
    # Scans take the radar, the mount and the origin of a patch, and no profile.
    patch = Patch(
        radar=0,
        mount=mount,
        view=NOISE.field_of_view,
        t_ns=np.array([2]),
        poses=np.zeros((1, 3)),
        middle=0,
        origin=origin,
        profiles=cast("Patch", None),  # type: ignore[arg-type]
    )
    return ImagedPatch(patch=patch, points=(point,), lines=())


def test_a_point_lies_where_it_is_from_the_newest_pose() -> None:
    """Wheels with errors of 2, 3 % and 0.05 rad/m, on a path that turns: known, they do no harm."""
    s, w, kappa = 0.02, 0.03, 0.05
    true = [np.zeros(3)]
    for step in ([0.05, 0.0, 0.1], [0.04, 0.01, -0.2], [0.06, 0.0, 0.15], [0.05, 0.0, 0.1]):
        true.append(compose(true[-1], np.array(step)))
    reported = [np.array([3.0, -2.0, 1.0])]
    for before, after in pairwise(true):
        dx, dy, turn = between(before, after).tolist()
        way = math.hypot(dx, dy)
        motion = np.array([(1 + s) * dx, (1 + s) * dy, (1 + w) * turn + kappa * way])
        reported.append(compose(reported[-1], motion))
    rod_from_2 = transform(between(true[2], np.zeros(3)), ROD)
    imager = GivenPatches(lambda origin: imaged(origin, rod_from_2, 4e-3))
    calibration = np.array([s, w, kappa])
    scans = PatchScans(cast("Imager", imager), RIG, PARAMETERS)
    for t_ns, pose in enumerate(reported):
        scans.take((), {t_ns: pose}, t_ns, calibration)
    scan, of_walls = scans.scans(calibration)
    assert (of_walls.ranges_m, of_walls.faces_m) == ((), ())
    assert scans.scans(calibration) == []
    assert scan.is_patch
    back_end = RobustBackEnd(RIG, PARAMETERS)
    antennas = antennas_of(RIG, [scan], calibration)
    (detection,) = detections_of(scan, [0], 0, antennas, NOISE)
    point = body_point(back_end.state, antennas, detection)
    expected = transform(between(true[4], np.zeros(3)), ROD)
    np.testing.assert_allclose(point.point_m, expected, atol=1e-12)
    # Noise: that of the point, 4 mm each way, and of the wheels between the two poses
    back = between(true[4], true[2])
    along, _, heading = WheelNoise().step_variances(math.hypot(back[0], back[1]), back[2])
    assert scan.sigmas_m == pytest.approx((math.sqrt(16e-6 + along + 4e-6),))
    across = 16e-6 / scan.ranges_m[0] ** 2 + 6.25e-6
    assert scan.bearing_sigmas_rad == pytest.approx((3.0 * math.sqrt(across + heading),))


def test_walls_of_a_patch_are_a_scan_of_their_own_with_their_ends() -> None:
    """A face beside radar 0, a metre ahead of it; its echo came from 0.2 m before to 0.1 m behind.

    Left of the perpendicular, which points along y, is where x is negative.
    """
    mount = RIG.mounts[0]
    line = PatchLine(
        normal=np.array([0.0, 1.0]),
        distance_m=mount.y_m + 1.0,
        range_m=1.0,
        bearing_rad=math.pi / 2 - mount.yaw_rad,
        sigma_m=3e-3,
        bearing_sigma_rad=4e-3,
        ends_m=np.add([[-0.2, 0.0], [0.1, 0.0]], [mount.x_m, mount.y_m + 1.0]),
    )
    imager = GivenPatches(lambda origin: replace(imaged(origin, ROD, 4e-3), lines=(line,)))
    scans, zero = PatchScans(cast("Imager", imager), RIG, PARAMETERS), np.zeros(3)
    for t_ns in range(3):
        scans.take((), {t_ns: zero}, t_ns, zero)
    of_points, of_walls = scans.scans(zero)
    assert of_points.faces_m is None
    assert of_points.ranges_m == pytest.approx((math.dist(ROD, (mount.x_m, mount.y_m)),))
    assert of_walls.is_patch
    assert (of_walls.ranges_m, of_walls.bearings_rad) == ((1.0,), (line.bearing_rad,))
    assert of_walls.faces_m is not None
    (ends_m,) = of_walls.faces_m
    assert ends_m == pytest.approx((-0.1, 0.2))
    # As of points: that of the patch, and what points of a run do not repeat by
    assert of_walls.sigmas_m == pytest.approx((math.hypot(3e-3, 2e-3),), rel=1e-4)
    assert of_walls.bearing_sigmas_rad == pytest.approx((3.0 * math.hypot(4e-3, 2.5e-3),), rel=1e-3)


def test_a_point_is_not_known_better_than_points_repeat_themselves() -> None:
    imager = GivenPatches(lambda origin: imaged(origin, ROD, 1e-5))
    scans, zero = PatchScans(cast("Imager", imager), RIG, PARAMETERS), np.zeros(3)
    for t_ns in range(3):
        scans.take((), {t_ns: zero}, t_ns, zero)
    scan, _ = scans.scans(zero)
    # Beside noise, and the least that a step of the wheels has
    assert scan.sigmas_m == pytest.approx((2e-3,), rel=1e-4)
    assert scan.bearing_sigmas_rad == pytest.approx((7.5e-3,), rel=1e-4)


@pytest.mark.parametrize(("sigma_m", "sigma_rad"), [(8e-3, 0.02), (4e-4, 1e-3)])
def test_the_noise_of_points_is_that_of_their_differences(sigma_m: float, sigma_rad: float) -> None:
    """A rod seen from a line, each time with errors of its own; the prior's share is taken out."""
    rng, noise = np.random.default_rng(38), PointNoise(PARAMETERS)
    for k in range(400):
        noise.take(seen_from_x(0.1 * (k % 8), k, rng.normal(0.0, (sigma_m, sigma_rad))))
    weight = RULE.differences + RULE.prior_differences
    for found, prior, true in (
        (noise.sigma_m, RULE.sigma_m, sigma_m),
        (noise.sigma_rad, RULE.sigma_rad, sigma_rad),
    ):
        own = (found**2 * weight - RULE.prior_differences * prior**2) / RULE.differences
        # The median of 150, of which neighbours have an error in common: some 8 %
        assert math.sqrt(own) == pytest.approx(true, rel=0.25)


@pytest.mark.parametrize(("t_ns", "farther_m", "radar"), [(0, 0.0, 0), (3, 0.2, 0), (3, 0.0, 1)])
def test_a_frame_in_common_another_body_or_another_radar_says_nothing_of_noise(
    t_ns: int, farther_m: float, radar: int
) -> None:
    noise = PointNoise(PARAMETERS)
    noise.take(seen_from_x(0.0, 0, np.zeros(2)))
    other = seen_from_x(0.0, t_ns, np.array([farther_m + 0.02, 0.1]))
    noise.take(replace(other, patch=replace(other.patch, radar=radar)))
    assert (noise.sigma_m, noise.sigma_rad) == (RULE.sigma_m, RULE.sigma_rad)


def test_one_point_seen_again_elsewhere_is_a_difference() -> None:
    noise = PointNoise(PARAMETERS)
    noise.take(seen_from_x(0.0, 0, np.zeros(2)))
    noise.take(seen_from_x(0.0, 3, np.array([0.02, 0.1])))
    # A median of one: 1.4826 times the difference, that of two errors of equal variance
    own, prior = 0.5 * (1.4826 * 0.02) ** 2, RULE.prior_differences * RULE.sigma_m**2
    expected = math.sqrt((own + prior) / (1 + RULE.prior_differences))
    assert noise.sigma_m == pytest.approx(expected)


def seen_from_x(x_m: float, t_ns: int, errors: Array) -> ImagedPatch:
    """Return a patch at (x, 0) that shows the rod with an error of range and one of bearing."""
    mount, origin = RIG.mounts[0], np.array([x_m, 0.0, 0.0])
    away = ROD - origin[:2] - (mount.x_m, mount.y_m)
    range_m = math.hypot(*away) + errors[0]
    bearing_rad = math.atan2(away[1], away[0]) + errors[1]
    toward = np.array([math.cos(bearing_rad), math.sin(bearing_rad)])
    made = imaged(origin, range_m * toward + (mount.x_m, mount.y_m), 1e-5)
    return replace(made, patch=replace(made.patch, t_ns=np.array([t_ns])))


def test_patches_of_all_radars_are_taken_one_a_state() -> None:
    class AllAtOnce:
        n_steps = 0

        def step(
            self, frames: Sequence[RadarFrame], pose_at: Callable[[int], Array]
        ) -> tuple[ImagedPatch, ...]:
            self.n_steps += 1
            one = imaged(pose_at(self.n_steps - 1), ROD, 1e-3)
            return (one,) * {1: 4, 2: 3}.get(self.n_steps, 0)

    scans, zero = PatchScans(cast("Imager", AllAtOnce()), RIG, PARAMETERS), np.zeros(3)
    taken = []
    for t_ns in range(5):
        scans.take((), {t_ns: zero}, t_ns, zero)
        taken.append(len([one for one in scans.scans(zero) if one.faces_m is None]))
    # Behind the first there are 3 and 3 more: 4 may wait on
    assert taken == [1, 3, 1, 1, 1]


def test_what_waits_is_forgotten_with_the_way_to_it() -> None:
    """A patch that waits when a slip is found is never taken; one of after it is."""
    anew = []

    class OneAStep:
        def step(
            self, frames: Sequence[RadarFrame], pose_at: Callable[[int], Array]
        ) -> tuple[ImagedPatch, ...]:
            return (imaged(pose_at(0), ROD, 1e-3),)

        def begin_anew(self) -> None:
            anew.append(True)

    scans, zero = PatchScans(cast("Imager", OneAStep()), RIG, PARAMETERS), np.zeros(3)
    taken = []
    for t_ns in range(6):
        scans.take((), {0: zero, t_ns: zero}, t_ns, zero)
        if t_ns == 4:
            scans.begin_anew()
        elif t_ns != 3:
            taken.append(len([one for one in scans.scans(zero) if one.faces_m is None]))
    assert taken == [1, 1, 1, 1]
    assert len(anew) == 1
    scans.take((), {0: zero, 6: zero}, 6, zero)
    scans.begin_anew()
    assert scans.scans(zero) == []


def seen_from(pose: Array, *rods: Array, radar: int = 0) -> RangeScan:
    """Return the scan of a patch of a radar that shows rods (2,) of the map from a pose."""
    mount = RIG.mounts[radar]
    away = [transform(between(pose, np.zeros(3)), rod) - (mount.x_m, mount.y_m) for rod in rods]
    return RangeScan(
        radar=radar,
        is_patch=True,
        ranges_m=tuple([math.hypot(*one) for one in away]),
        sigmas_m=(1e-3,) * len(rods),
        bearings_rad=tuple([math.atan2(one[1], one[0]) - mount.yaw_rad for one in away]),
        bearing_sigmas_rad=(1e-3,) * len(rods),
    )


STEP = np.array([0.01, 0.0, 0.0])


def ranges_at(
    pose: Array, *, is_imaged: bool = True, axis_m: Array = ROD, radius_m: float = 0.0
) -> list[RangeScan]:
    """Return what radars 0 and 1 measure of the rod, or of a column in its place."""
    found = []
    for radar in (0, 1):
        mount = RIG.mounts[radar]
        antenna = transform(pose, np.array([mount.x_m, mount.y_m]))
        range_m = math.hypot(*(axis_m - antenna)) - radius_m
        one = RangeScan(radar=radar, ranges_m=(range_m,), sigmas_m=(1e-3,), is_imaged=is_imaged)
        found.append(one)
    return found


def test_two_patches_make_a_landmark_with_the_single_ranges_of_before() -> None:
    """Ranges alone make none; patches that do not hold it later say nothing against it."""
    back_end, pose = RobustBackEnd(RIG, PARAMETERS), np.zeros(3)
    counts = []
    for number in range(25):
        back_end.predict(STEP)
        pose = compose(pose, STEP)
        patch = [seen_from(pose, ROD)] if number in (20, 22) else []
        back_end.update([*ranges_at(pose), *patch])
        counts.append(len(back_end.state.landmark_ids))
    assert counts == [0] * 22 + [1] * 3
    assert back_end.reported_rows() == [0]
    np.testing.assert_allclose(back_end.state.landmarks_m[0], ROD, atol=1e-3)
    used = len(back_end._log._ranges.rows)
    assert used >= 2 + 2 * 15 + 2 * 2  # two points, what waited, and two states later
    for _ in range(60):
        back_end.predict(np.zeros(3))
        back_end.update([seen_from(pose)])
    assert back_end.reported_rows() == [0]


def test_a_landmark_whose_wavefront_is_wide_stands_behind_its_surface() -> None:
    """Patches show a column of 0.25 m, give or take 0.03; what answers is that much nearer."""
    noise = replace(NOISE, radius_sigma_m=0.03)
    back_end, pose = RobustBackEnd(RIG, replace(PARAMETERS, ranges=noise)), np.zeros(3)
    axis_m, radius_m = np.array([0.3, 1.15]), 0.25
    for number in range(40):
        back_end.predict(STEP)
        pose = compose(pose, STEP)
        scans = ranges_at(pose, axis_m=axis_m, radius_m=radius_m)
        if number in (20, 22, 34):
            axis = seen_from(pose, axis_m)
            scans.append(
                replace(
                    axis,
                    ranges_m=(axis.ranges_m[0] - radius_m,),
                    bearing_sigmas_rad=(0.02,),
                    radii_m=(radius_m,),
                    radius_sigmas_m=(0.03,),
                )
            )
        back_end.update(scans)
    state = back_end.state
    for _ in range(2):
        np.testing.assert_allclose(state.landmarks_m, [axis_m], atol=5e-3)
        assert state.radii_m == pytest.approx([radius_m], abs=5e-3)
        at = state.layout.columns(np.array([0]))
        assert math.sqrt(state.P.block(at)[2, 2]) < 0.04
        assert back_end.relinearise()


def test_radars_without_images_begin_landmarks_beside_those_with_images() -> None:
    """Ranges that a caller gives for some mounts are enough, whatever the others see."""
    back_end, pose = RobustBackEnd(RIG, PARAMETERS), np.zeros(3)
    empty = [RangeScan(radar=radar, ranges_m=(), is_imaged=True) for radar in (2, 3)]
    for _ in range(20):
        back_end.predict(STEP)
        pose = compose(pose, STEP)
        back_end.update([*ranges_at(pose, is_imaged=False), *empty])
    assert back_end.reported_rows() == [0]
    np.testing.assert_allclose(back_end.state.landmarks_m[0], ROD, atol=2e-3)


def test_what_is_gone_is_deleted_although_patches_do_not_show_it_either() -> None:
    """Nothing answers where the rod was: it is missed as without images."""
    back_end, pose = RobustBackEnd(RIG, PARAMETERS), np.zeros(3)
    for number in range(30):
        back_end.predict(STEP)
        pose = compose(pose, STEP)
        patches = [seen_from(pose, ROD, radar=radar) for radar in (0, 1) if number in (10, 20)]
        back_end.update([*ranges_at(pose), *patches])
    assert back_end.reported_rows() == [0]
    silent = [RangeScan(radar=radar, ranges_m=(), is_imaged=True) for radar in (0, 1)]
    for number in range(60):
        back_end.predict(np.zeros(3))
        patches = [seen_from(pose, radar=radar) for radar in (0, 1) if number % 12 == 5]
        back_end.update([*silent, *patches])
    assert not back_end.state.landmark_ids


def test_the_first_patch_leaves_out_no_ranges_of_before_the_images() -> None:
    """Ranges come alone at first, then frames; the first patch does not show the rod."""
    back_end, pose = RobustBackEnd(RIG, PARAMETERS), np.zeros(3)
    for number in range(40):
        back_end.predict(STEP)
        pose = compose(pose, STEP)
        patches = [seen_from(pose)] if number == 38 else []
        back_end.update([*ranges_at(pose, is_imaged=number >= 30), *patches])
    kept = single_ranges(back_end, 0)
    assert len(kept) >= 28
    assert max(kept) <= 31


def single_ranges(back_end: RobustBackEnd, radar: int) -> set[int]:
    """Return the poses of the single ranges of a radar that a solution over all poses takes."""
    ranges, known = back_end._log._ranges.rows, back_end.state.landmark_ids
    taken = np.isnan(ranges["bearing_rad"]) & (ranges["radar"] == radar)
    return set(ranges["pose"][taken & np.isin(ranges["landmark"], known)].tolist())


def test_single_ranges_of_what_patches_do_not_show_are_not_used() -> None:
    """They wait for the next patch of their radar; in the whole run, those since the last one."""
    back_end, pose = RobustBackEnd(RIG, PARAMETERS), np.zeros(3)
    used: list[set[int]] = []
    rods: dict[int, dict[int, list[Array]]] = {
        20: {0: [ROD]},
        22: {0: [ROD]},
        24: {1: [ROD]},
        28: {1: []},
        32: {0: []},
        40: {0: [ROD]},
    }
    for number in range(45):
        back_end.predict(STEP)
        pose = compose(pose, STEP)
        patches = [seen_from(pose, *one, radar=k) for k, one in rods.get(number, {}).items()]
        report = back_end.update([*ranges_at(pose), *patches])
        used.append({radar for radar, _, _ in report.continued})
        if number == 32:
            taken = single_ranges(back_end, 0), single_ranges(back_end, 1)
    assert used[24:29] == [{0, 1}] * 5
    assert used[29:33] == [{0}] * 4
    assert used[33:41] == [set()] * 8
    assert used[41:] == [{0}] * 4
    # The pose of a number is one more. Those behind the last patches that show it, of 22 and 24:
    assert taken[0].isdisjoint(range(24, 34))
    assert {20, 22, 23} <= taken[0]
    assert taken[1].isdisjoint(range(26, 30))
    assert {24, 25} <= taken[1]
    assert {42, 43, 44, 45} <= single_ranges(back_end, 0)


def test_single_ranges_of_what_a_patch_has_out_of_view_are_used() -> None:
    back_end, pose = RobustBackEnd(RIG, PARAMETERS), np.zeros(3)
    for number in range(30):
        back_end.predict(STEP)
        pose = compose(pose, STEP)
        patches = [seen_from(pose, ROD)] if number in (20, 22) else []
        if number == 28:
            away = (0.0, 0.0, math.pi)
            patches = [replace(seen_from(pose, radar=radar), moved=away) for radar in (0, 1)]
        report = back_end.update([*ranges_at(pose), *patches])
    assert {radar for radar, _, _ in report.continued} == {0, 1}


RIG_AHEAD = replace(RIG, mounts=(replace(RIG.mounts[0], yaw_rad=0.0),))


def seen_ahead(pose: Array, rod: Array, *, first: bool = True) -> RangeScan:
    """Return the scan of a patch of a radar that looks along its way, and shows a rod (2,).

    Its mirror image is the second of the two points, or the ``first``.
    """
    mount = RIG_AHEAD.mounts[0]
    x, y = transform(between(pose, np.zeros(3)), rod) - (mount.x_m, mount.y_m)
    bearings_rad = (math.atan2(y, x), math.atan2(-y, x))
    return RangeScan(
        radar=0,
        is_patch=True,
        ranges_m=(math.hypot(x, y),) * 2,
        sigmas_m=(1e-3,) * 2,
        bearings_rad=bearings_rad if first else bearings_rad[::-1],
        bearing_sigmas_rad=(5e-3,) * 2,
        mirrors=(1, 0),
    )


def driven(*moves: tuple[tuple[float, float, float], bool]) -> tuple[RobustBackEnd, list[int]]:
    """Return a back end after moves with a patch behind each, and its landmarks reported then."""
    back_end, pose, n_reported = RobustBackEnd(RIG_AHEAD, PARAMETERS), np.zeros(3), list[int]()
    for move, first in moves:
        back_end.predict(np.array(move))
        pose = compose(pose, np.array(move))
        back_end.update([seen_ahead(pose, AHEAD_ROD, first=first)])
        n_reported.append(len(back_end.reported_rows()))
    return back_end, n_reported


AHEAD_ROD = np.array([1.6, 0.5])
ALONG, TURNED = (0.1, 0.0, 0.0), (0.1, 0.0, 0.3)


def test_a_point_is_reported_once_its_mirror_image_is_refuted() -> None:
    """On a straight way it is a landmark, which holds the pose; a turn shows on which side."""
    back_end, n_reported = driven(*[(ALONG, True)] * 4, (TURNED, True))
    assert n_reported == [0, 0, 0, 0, 1]
    (place,) = back_end.state.landmarks_m
    assert place == pytest.approx(AHEAD_ROD, abs=0.01)
    assert len(back_end._log._ranges.rows) == 5  # each patch once


def test_a_mirror_image_is_never_reported() -> None:
    """What is there is, from ways in three directions."""
    moves = [(ALONG, False)] * 4 + [(TURNED, True), (ALONG, True)] * 2
    back_end, n_reported = driven(*moves)
    assert n_reported[:6] == [0] * 6
    (row,) = back_end.reported_rows()
    assert back_end.state.landmarks_m[row] == pytest.approx(AHEAD_ROD, abs=0.02)


def test_a_known_landmark_is_known_by_its_mirror_image() -> None:
    """From ways that cross, whichever of the two the patch has found first."""
    moves = [(ALONG, True), (TURNED, True)] + [(ALONG, False), (ALONG, True)] * 3
    back_end, n_reported = driven(*moves)
    assert n_reported[2:] == [1] * 6  # by three patches
    assert len(back_end.state.landmark_ids) == 1
    assert len(back_end._log._ranges.rows) == 8


WAY = MirrorWay(x_m=1.0, y_m=0.0, variance=1e-4)


@pytest.mark.parametrize(
    ("ways", "is_reported"),
    [([WAY], False), ([WAY, None], True), ([replace(WAY, x_m=0.0, y_m=1.0)], True)],
    ids=["same way", "no mirror image", "another way"],
)
def test_two_landmarks_that_are_one_may_be_a_mirror_image_if_they_have_one_way(
    ways: list[MirrorWay | None], is_reported: bool
) -> None:
    existence = Existence(MapRule(), 1, 0.9)
    for id_ in (0, 1):
        existence.hit(id_, 5)
    existence.begin_mirrored(0, [WAY])
    existence.begin_mirrored(1, ways)
    assert not existence.is_reported(0)
    existence.merge(0, 1)
    assert existence.is_reported(0) == is_reported


def test_what_most_patches_hide_and_no_radar_hears_is_not_reported() -> None:
    """From far two rods are one between them; of two that are one, either may have been heard."""
    existence = Existence(MapRule(), 1, 0.9)
    for id_ in (0, 1, 2):
        existence.hit(id_, 5)
    for shown, hidden in (({0, 1}, set()), ({0}, {1}), (set(), {0, 1}), (set(), {2})):
        existence.show(shown)
        existence.show(hidden, -1)
    assert [existence.is_reported(id_) for id_ in (0, 1, 2)] == [True, False, False]
    existence.heard(1)
    assert existence.is_reported(1)
    existence.merge(2, 1)
    assert existence.is_reported(2)
    existence.know(3, 50)  # of a saved map
    existence.show([3], -1)
    assert existence.is_reported(3)


def test_on_which_side_it_is_a_turn_that_did_not_happen_does_not_show() -> None:
    """The wheels slip; the filter has the pose from elsewhere."""
    back_end, _ = driven(*[(ALONG, True)] * 4)
    pose = np.array([0.5, 0.0, 0.0])
    back_end.predict(np.array([0.1, 0.0, 0.3]), np.diag([1e-4, 1e-4, 0.1]))
    back_end.state.set_pose(pose, np.diag([1e-6, 1e-6, 1e-6]))
    back_end.update([seen_ahead(pose, AHEAD_ROD)])
    assert len(back_end._log._ranges.rows) == 5
    assert back_end.reported_rows() == []


def test_points_that_are_their_own_mirror_images_are_one_detection() -> None:
    """Of the others the mirror image follows behind all points."""
    made = imaged(np.zeros(3), ROD, 1e-3)
    (point,) = made.points
    points = [replace(point, mirrored_rad=one) for one in (-0.3, None, point.bearing_rad, 0.2)]
    of_three = replace(made, points=tuple(points))
    scans, zero = PatchScans(cast("Imager", GivenPatches(lambda _: of_three)), RIG, PARAMETERS), 0.0
    for t_ns in range(3):
        scans.take((), {t_ns: np.full(3, zero)}, t_ns, np.zeros(3))
    scan, _ = scans.scans(np.zeros(3))
    assert scan.mirrors == (4, None, 2, 5, 0, 3)
    assert scan.bearings_rad == (*[point.bearing_rad] * 4, -0.3, 0.2)
    assert scan.n_seen == 4
    with pytest.raises(ValueError, match="mirrors"):
        replace(scan, mirrors=(4, None, 2, 5, 1, 3))


def test_what_may_be_known_is_decided_with_two_patches() -> None:
    """The pose is known to 0.3 m only: a rod 20 cm from a known one is taken for that."""
    back_end, pose = RobustBackEnd(RIG, PARAMETERS), np.zeros(3)
    for _ in range(2):
        back_end.predict(STEP)
        pose = compose(pose, STEP)
        back_end.update([seen_from(pose, ROD)])
    back_end.predict(STEP, np.diag([0.09, 0.09, 0.01]))
    pose = compose(pose, STEP)
    other, counts, off_m = np.array([0.5, 0.9]), [], []
    for _ in range(4):
        back_end.update([seen_from(pose, other)])
        counts.append(len(back_end.state.landmark_ids))
        off_m.append(float(back_end.pose[0] - pose[0]))
        back_end.predict(STEP)
        pose = compose(pose, STEP)
    assert counts == [1] * 4
    assert off_m[0] == pytest.approx(0.0, abs=1e-3)
    assert off_m[1:] == pytest.approx([ROD[0] - other[0]] * 3, abs=0.03)


def test_a_landmark_that_is_predicted_out_of_view_is_a_rival() -> None:
    """The robot is 0.12 m left of where it is believed, of 0.06 m standard deviation.

    A patch shows a rod at 1.45 m, which is predicted beyond the end of the view, at 1.57; another
    one 0.1 m before it is predicted in view, and would do with 0.02 m.
    """
    seen, other = np.array([-0.1, 1.77]), np.array([-0.1, 1.67])
    scan = seen_from(np.array([0.0, 0.12, 0.0]), seen)
    state = State((0.0,) * 3, (0.0,) * 4)
    pairs = []
    for marks in ((other,), (other, seen)):
        state.landmarks_m, state.landmark_ids = np.array(marks), list(range(len(marks)))
        state.P = SymmetricMatrix(1e-12 * np.eye(state.layout.size))
        state.set_pose(np.zeros(3), np.diag([1e-12, 0.06**2, 1e-12]))
        at = view(state, antennas_of(RIG, [scan], np.zeros(3)))
        pairs.append(find_points(state, at, scan, ([0], set(), {}), PARAMETERS).pairs)
    assert pairs == [((0, 0),), ()]


def test_ranges_of_landmarks_at_one_range_are_not_used() -> None:
    """Of a radar with images that has both in its field of view; of others they are."""
    view = View(
        ranges_m=np.array([[0.9, 1.0, 0.95, 1.3], [0.7, 1.0, 0.9, 1.3]]),
        off_boresight_rad=np.array([[0.1, -0.2, 2.0, 0.0], [0.1, -0.2, 0.3, 0.0]]),
        directions=np.zeros((2, 4, 2)),
        by_feature=np.zeros((2, 4, 2)),
        turned=np.zeros((2, 2, 2)),
        barred=np.zeros((2, 4), dtype=np.bool_),
    )
    crowded = [[True, True, True, False], [False, True, True, False]]
    for imaged, out in (([0, 1], crowded), ([1], [[False] * 4, crowded[1]])):
        left = view.without_crowds(imaged, NOISE, PARAMETERS.continuation.blur_m)
        is_out = left.off_boresight_rad == math.pi
        assert is_out.tolist() == out
        np.testing.assert_array_equal(
            left.off_boresight_rad[~is_out], view.off_boresight_rad[~is_out]
        )


@pytest.mark.parametrize("value", ["true", 1, 1.0, "yes"])
def test_the_switch_of_a_file_is_true_or_false(value: object) -> None:
    with pytest.raises(ConfigError):
        config_from_tables({"robust": {"patches": value}}, source="x.toml")
    config = config_from_tables({"robust": {"patches": True}}, source="x.toml")
    assert config.robust.patches
    assert RobustConfig().patches


def images_of(slam: RobustSlam) -> bool:
    """Return whether a pipeline images the frames that it is given."""
    samples = np.zeros(300, dtype=np.float32)
    asked: list[int] = []

    def pose_at(t_ns: int) -> Array:
        asked.append(t_ns)
        return np.array([1e-9 * t_ns, 0.0, 0.0])

    for t_ns in (0, 100_000_000):
        frame = RadarFrame(
            radar=0, t_ns=t_ns - 7, counter=0, samples=samples, range_start_m=0.0, bin_length_m=6e-3
        )
        slam.step([frame], pose_at, t_ns)
        if not t_ns:
            assert asked == [0]  # frames at the first pose are not looked at
    return asked.count(100_000_000 - 7) > 1  # once for its ranges, once for its image


def test_images_are_made_of_frames_that_this_front_end_takes() -> None:
    preset, wheels = load_preset("robust"), WheelNoise()
    assert images_of(RobustSlam(preset, paper_rig(), wheels))
    off = override(preset, {"robust.patches": False})
    assert not images_of(RobustSlam(off, paper_rig(), wheels))
    other = make_detector(preset, paper_rig())
    assert not images_of(RobustSlam(preset, paper_rig(), wheels, other))


def short_drive(patches: str) -> tuple[Belief, Array]:
    """Return what is known at the end of the first leg of a dense room, and the true rods."""
    case = make_case("dense:13", "robust", 13, settings={"robust.patches": patches}, laps=1)
    source = source_of(case)
    assert isinstance(source.slam, RobustSlam)
    pose_at = source.odometry.pose_at
    belief = None
    for number, scan in enumerate(source.scans):
        for result in source.slam.step(scan.frames, pose_at, scan.t_ns):
            belief = result.belief
        if number == 200:
            break
    source.close()
    assert belief is not None
    start = source.truth_at(np.array([0]))[0]
    rods = transform(between(start, np.zeros(3)), source.info.true_landmarks_m)
    return belief, np.asarray(rods)


def test_a_dense_room_is_mapped_on_the_first_leg() -> None:
    """With patches every rod that one sees for long is a landmark, without them some are not."""
    found = []
    for patches in ("true", "false"):
        belief, rods = short_drive(patches)
        end = belief.pose
        # Beside the middle of the leg, 0.3 to 1 m from the antennas: in view for 0.4 m at least
        is_beside = (rods[:, 0] > 0.2 * end[0]) & (rods[:, 0] < 0.8 * end[0])
        is_beside &= (np.abs(rods[:, 1]) > 0.5) & (np.abs(rods[:, 1]) < 1.2)
        gaps = np.linalg.norm(rods[is_beside][:, None] - belief.landmarks[None], axis=2)
        found.append(int(np.count_nonzero(gaps.min(axis=1, initial=9.0) < 0.05)))
        n = int(np.count_nonzero(is_beside))
    assert found[0] == n
    assert found[1] < n
