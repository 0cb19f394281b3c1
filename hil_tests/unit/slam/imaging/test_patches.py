"""Patches: which frames they hold, in which frame of reference, and what is taken out of them."""

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.frames import RadarFrame
from slam.front_end.pulse import ModulePulse, PulseModel
from slam.geometry import FieldOfView, Mount, compose
from slam.imaging.back_projection import back_project
from slam.imaging.patches import (
    Patch,
    PatchMaker,
    PatchRule,
    RecordedFrame,
    longest_spacing_m,
)
from slam.imaging.range_profiles import StaticPart

Array = NDArray[np.float64]

BIN_M = 299_792_458.0 / (2 * 23.328e9)
MODEL = PulseModel()
WAVE_NUMBER = math.tau / MODEL.wavelength_m
MOUNT = Mount(name="left", x_m=0.1, y_m=0.2, yaw_rad=math.pi / 2, range_offset_m=0.03)
VIEW = FieldOfView()
PULSE = ModulePulse(model=MODEL, error=0.1)
START_M, N_BINS = 0.2, 500
# Half a step shorter than 25 steps of 1 cm, so that rounding of the way decides nothing
RULE = PatchRule(travel_m=0.245, hop_m=0.125)
ROD = np.array([0.3, 1.2])


def frame_at(pose: Array, index: int, *, leakage: float = 0.0, n_bins: int = N_BINS) -> RadarFrame:
    """Return what the mount gets of a rod, labelled with its range offset, and of leakage."""
    antenna = compose(pose, np.array([MOUNT.x_m, MOUNT.y_m, 0.0]))[:2]
    labels = START_M + BIN_M * np.arange(n_bins)
    samples = np.zeros(n_bins)
    for amplitude, range_m in ((0.01, math.dist(ROD, antenna)), (leakage, 0.35)):
        x = labels - MOUNT.range_offset_m - range_m
        samples += amplitude * np.exp(-0.5 * (x / MODEL.sigma_m) ** 2) * np.cos(WAVE_NUMBER * x)
    return RadarFrame(
        radar=0,
        t_ns=200_000_000 * index,
        counter=index + 1,
        samples=samples.astype(np.float32),
        range_start_m=START_M,
        bin_length_m=BIN_M,
    )


def patches_of(poses: Iterable[Array], *, leakage: float = 0.0) -> list[Patch]:
    maker = PatchMaker(0, MOUNT, VIEW, lambda _: PULSE, RULE)
    made = (
        maker.add(frame_at(pose, index, leakage=leakage), pose) for index, pose in enumerate(poses)
    )
    return [patch for patch in made if patch is not None]


def line(length_m: float, step_m: float = 0.01, heading: float = 0.0) -> list[Array]:
    steps = np.arange(round(length_m / step_m) + 1) * step_m
    return [np.array([s * math.cos(heading), s * math.sin(heading), heading]) for s in steps]


def test_a_patch_is_as_long_as_the_rule_says_and_the_next_begins_a_hop_later() -> None:
    patches = patches_of(line(1.0))
    assert all(0.245 <= patch.aperture.length_m < 0.255 for patch in patches)
    starts = np.array([patch.t_ns[0] for patch in patches]) / 200_000_000 * 0.01
    assert np.all((np.diff(starts) >= 0.125 - 1e-9) & (np.diff(starts) <= 0.13 + 1e-9))
    assert starts[-1] + 0.25 + 0.13 > 1.0


def test_poses_are_in_the_body_frame_of_the_middle() -> None:
    path = [compose(np.array([3.0, -2.0, 0.7]), pose) for pose in line(0.3, heading=0.2)]
    (patch,) = patches_of(path)
    np.testing.assert_allclose(patch.poses[patch.middle], 0, atol=1e-12)
    assert patch.middle == pytest.approx(len(patch.poses) / 2, abs=1)
    back = [compose(patch.origin, pose) for pose in patch.poses]
    np.testing.assert_allclose(back, path[: len(back)], atol=1e-9)


def test_a_patch_says_which_samples_the_sampler_has_cut_off() -> None:
    maker = PatchMaker(0, MOUNT, VIEW, lambda _: PULSE, RULE)
    for index, pose in enumerate(line(0.3)):
        frame = frame_at(pose, index)
        loud = frame.samples * (index in (3, 4))  # of two frames the rod is beyond the limits
        patch = maker.add(replace(frame, samples=loud, limits=(-0.005, 0.005)), pose)
        if patch is not None:
            break
    assert patch is not None
    assert patch.cut is not None
    assert np.flatnonzero(patch.cut.any(axis=1)).tolist() == [3, 4]
    at = patch.cut.any(axis=0)
    assert np.ptp(patch.profiles.ranges_m[at]) < 6 * MODEL.sigma_m
    assert patches_of(line(0.3))[0].cut is None


def test_a_rod_comes_to_a_focus_where_it_is_in_the_frame_of_the_patch() -> None:
    # The rod stands beside the end of the path: of so few frames that see it, the static part,
    # their mean, keeps little.
    patch = patches_of([pose - [1.6, 0, 0] for pose in line(2.0)])[-1]
    rod = ROD - patch.origin[:2]
    image = back_project(patch.profiles, patch.aperture, rod)
    assert float(image.count) > 20
    assert float(image.coherence_factor) > 0.95


def test_what_stands_still_with_the_robot_is_taken_out() -> None:
    # Leakage three times as strong as the rod, 0.35 m away from the antenna in every frame
    patch = patches_of(line(1.5), leakage=0.03)[-1]
    bins = np.abs(patch.profiles.ranges_m - 0.35) < 0.02
    assert np.abs(patch.profiles.values[:, bins]).max() < 0.1 * 0.03


def test_turning_on_the_spot_counts_by_the_lever_of_the_mount() -> None:
    turn = [np.array([0.0, 0.0, angle]) for angle in np.arange(0, 1.3, 0.02)]
    patches = patches_of(turn)
    # 0.25 m at a lever of hypot(0.1, 0.2) m is 1.118 rad; the step is 0.02 rad.
    assert len(patches) == 1
    assert np.ptp(patches[0].poses[:, 2]) == pytest.approx(0.25 / math.hypot(0.1, 0.2), abs=0.021)


def test_a_robot_that_stands_adds_no_frames() -> None:
    path = [np.zeros(3)] * 80 + line(0.3)
    (patch,) = patches_of(path)
    assert len(patch.t_ns) == 26


def test_behind_a_long_stand_or_with_other_bins_a_patch_begins_anew() -> None:
    maker = PatchMaker(
        0, MOUNT, VIEW, lambda _: PULSE, replace(RULE, longest_stand_ns=5_000_000_000)
    )
    path = line(0.6)
    for index, pose in enumerate(path[:20]):
        assert maker.add(frame_at(pose, index), pose) is None
    later = [maker.add(frame_at(pose, 60 + i), pose) for i, pose in enumerate(path[20:46])]
    assert [patch is not None for patch in later] == [False] * 25 + [True]
    assert maker.add(frame_at(path[46], 90, n_bins=200), path[46]) is None


def test_no_patch_holds_frames_of_before_and_after_it_began_anew() -> None:
    """Each half of a way of 0.6 m has a patch; no patch holds frames of both halves."""
    maker = PatchMaker(0, MOUNT, VIEW, lambda _: PULSE, RULE)
    poses = line(0.6)
    made = []
    for index, pose in enumerate(poses):
        if index == 30:
            maker.begin_anew()
        patch = maker.add(frame_at(pose, index), pose)
        made += [] if patch is None else [patch]
    spans = [np.unique(patch.t_ns // 200_000_000 < 30) for patch in made]
    assert [span.tolist() for span in spans] == [[True], [False]]


@pytest.mark.parametrize(("stood_ns", "n_patches"), [(20_000_000_000, 0), (19_999_999_999, 1)])
def test_a_robot_that_stood_for_20_s_may_have_been_moved(stood_ns: int, n_patches: int) -> None:
    maker, made = PatchMaker(0, MOUNT, VIEW, lambda _: PULSE), []
    for index, pose in enumerate(line(0.3)):
        frame = frame_at(pose, index)
        later = 0 if index < 15 else stood_ns - 200_000_000
        made.append(maker.add(replace(frame, t_ns=frame.t_ns + later), pose))
    assert sum(patch is not None for patch in made) == n_patches


def test_bins_beyond_the_field_of_view_are_left_out_and_the_range_offset_is_removed() -> None:
    (patch,) = patches_of(line(0.3))
    ranges_m = patch.profiles.ranges_m
    assert ranges_m[0] == pytest.approx(START_M - MOUNT.range_offset_m)
    assert VIEW.max_range_m + 0.29 < ranges_m[-1] < VIEW.max_range_m + 0.31


def test_a_patch_on_other_poses_keeps_its_profiles() -> None:
    (patch,) = patches_of(line(0.3))
    other = [compose(np.array([1.0, 2.0, 3.0]), pose) for pose in line(0.25, heading=0.1)]
    moved = patch.with_poses(np.array(other))
    assert moved.profiles is patch.profiles
    np.testing.assert_allclose(moved.origin, other[patch.middle])
    np.testing.assert_allclose(moved.poses[patch.middle], 0, atol=1e-12)
    assert moved.aperture.length_m == pytest.approx(patch.aperture.length_m)


def test_the_pulse_is_asked_for_with_every_patch() -> None:
    asked: list[float] = []

    def pulse_of(bin_length_m: float) -> ModulePulse:
        asked.append(bin_length_m)
        return PULSE

    maker = PatchMaker(0, MOUNT, VIEW, pulse_of, RULE)
    made = [maker.add(frame_at(pose, i), pose) for i, pose in enumerate(line(0.6))]
    assert asked == [BIN_M] * sum(patch is not None for patch in made)


def test_a_static_part_that_is_known_is_taken_out_and_stays_as_it_is() -> None:
    def patch_of(static: StaticPart, leakage: float) -> Patch:
        maker = PatchMaker(0, MOUNT, VIEW, lambda _: PULSE, RULE, static=static)
        made = [maker.add(frame_at(p, i, leakage=leakage), p) for i, p in enumerate(line(0.3))]
        (patch,) = [one for one in made if one is not None]
        return patch

    far = np.array([0.0, -50.0, 0.0])  # from where nothing but leakage is in the frame
    known, nothing = StaticPart(), StaticPart()
    near = PatchMaker(0, MOUNT, VIEW, lambda _: PULSE, RULE).near
    for step in range(8):  # of as many headings as it takes to be sure of what is far away
        place, heading = np.array([0.1 * step, 0.0]), 0.7 * step
        known.add(near(frame_at(far, 0, leakage=0.03)), place, heading)
        nothing.add(near(frame_at(far, 0)), place, heading)
    found, expected = patch_of(known, 0.03), patch_of(nothing, 0.0)
    np.testing.assert_allclose(found.profiles.values, expected.profiles.values, atol=1e-8)
    assert known.samples is not None
    np.testing.assert_array_equal(known.samples, near(frame_at(far, 0, leakage=0.03)))


def test_samples_that_are_not_known_count_as_zero() -> None:
    frame = frame_at(np.zeros(3), 0)
    frame.samples[3:5] = np.nan
    near = PatchMaker(0, MOUNT, VIEW, lambda _: PULSE, RULE).near(frame)
    expected = np.append(frame.samples[:3], [0.0, 0.0])
    np.testing.assert_array_equal(near[:5], expected)


def test_baseband_frames_come_to_a_focus_as_rf_frames_do() -> None:
    bin_m, n_bins = 8 * BIN_M, 60
    ranges_m = START_M + bin_m * np.arange(n_bins)
    nothing = StaticPart()
    nothing.add(np.zeros(n_bins, dtype=np.complex128), np.zeros(2))
    view = replace(VIEW, max_range_m=5.0)  # beyond the bins
    maker = PatchMaker(0, MOUNT, view, lambda _: PULSE, RULE, static=nothing)
    made = []
    for index, pose in enumerate(line(0.3)):
        antenna = compose(pose, np.array([MOUNT.x_m, MOUNT.y_m, 0.0]))[:2]
        r = math.dist(ROD, antenna)
        x = ranges_m - MOUNT.range_offset_m - r
        samples = 0.01 * np.exp(-0.5 * (x / MODEL.sigma_m) ** 2 - 1j * WAVE_NUMBER * r)
        frame = RecordedFrame(
            t_ns=200_000_000 * index,
            samples=samples.astype(np.complex64),
            range_start_m=START_M,
            bin_length_m=bin_m,
        )
        made.append(maker.add(frame, pose))
    (patch,) = [one for one in made if one is not None]
    places = ROD - patch.origin[:2] + np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.2]])
    image = back_project(patch.profiles, patch.aperture, places)
    assert image.amplitude[0] == pytest.approx(0.01, rel=0.03)
    assert image.coherence_factor[0] > 0.99
    assert image.amplitude[1:].max() < 0.5 * 0.01


@pytest.mark.parametrize("half_beam_deg", [20.0, 32.5, 60.0])
def test_at_the_longest_spacing_echoes_of_both_edges_of_the_beam_look_alike(
    half_beam_deg: float,
) -> None:
    view = FieldOfView(opening_rad=2 * math.radians(half_beam_deg))
    step_m = longest_spacing_m(MODEL, view)
    turns = [
        4 * math.pi * 7.29e9 / 299_792_458.0 * step_m * math.sin(math.radians(bearing_deg))
        for bearing_deg in (half_beam_deg, -half_beam_deg)
    ]
    assert turns[0] - turns[1] == pytest.approx(math.tau)


def test_bins_of_another_length_begin_a_patch_and_a_filter_anew() -> None:
    maker = PatchMaker(0, MOUNT, VIEW, lambda _: PULSE, RULE)
    few, longer_m = 250, 1.05 * BIN_M  # all of them within the field of view
    patches = []
    for index, pose in enumerate(line(0.8)):
        frame = frame_at(pose, index, n_bins=few)
        frame = frame if index < 20 else replace(frame, bin_length_m=longer_m)
        patches.append(maker.add(frame, pose))
    made = [patch for patch in patches if patch is not None]
    assert made
    assert all(patch.t_ns[0] >= 20 * 200_000_000 for patch in made)
    assert {patch.profiles.bin_length_m for patch in made} == {longer_m}
    # The filter, too, is that of the new bins, not one kept from patches before.
    back = [maker.add(frame_at(p, 100 + i, n_bins=few), p) for i, p in enumerate(line(0.5))]
    fresh = PatchMaker(0, MOUNT, VIEW, lambda _: PULSE, RULE)
    alone = [fresh.add(frame_at(p, 100 + i, n_bins=few), p) for i, p in enumerate(line(0.5))]
    for one, other in zip(back, alone, strict=True):
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            np.testing.assert_array_equal(one.profiles.values, other.profiles.values)


@pytest.mark.parametrize("number", [math.nan, math.inf])
@pytest.mark.parametrize("at", [0, 2])
def test_a_pose_that_is_not_finite_is_refused(number: float, at: int) -> None:
    maker, pose = PatchMaker(0, MOUNT, VIEW, lambda _: PULSE, RULE), np.zeros(3)
    pose[at] = number
    with pytest.raises(ValueError, match="200000000 ns"):
        maker.add(frame_at(np.zeros(3), 1), pose)


def test_samples_no_radar_sends_count_as_zero() -> None:
    maker, pose = PatchMaker(0, MOUNT, VIEW, lambda _: PULSE, RULE), np.zeros(3)
    frame = frame_at(pose, 0)
    frame.samples[[3, 4, 5]] = np.inf, -np.inf, 1e30
    near = maker.near(frame)
    np.testing.assert_array_equal(near[3:6], 0.0)
    assert near[6:].any()
