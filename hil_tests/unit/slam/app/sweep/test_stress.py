"""The stress table does what its rows say, as hard as they say, and the same every time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import islice

import numpy as np
import pytest

from emulator.scene.scene import RECORDED, BurstSpec, PulseSpec, Scene, WanderSpec, load_scene
from emulator.scene.toml_files import shipped_names
from emulator.scene.wheels import scene_odometry
from hil_tests.unit.slam.simulation import frame_of
from slam.app.rig.emulated import rig_of, true_landmarks_m, wheels_of
from slam.app.sweep import CLEAN, FAMILIES, STRESSES, Stress
from slam.app.sweep.run import (
    DisturbedDetector,
    make_case,
    source_of,
    stressed_scans,
    stressed_scene,
)
from slam.config import RobustConfig, SlamConfig
from slam.frames import Detection, RadarFrame
from slam.live.odometry_track import OdometryTrack
from slam.live.session_records import Scan
from xethru_protocol.wire.x4 import real_frame_rate

PERIOD_NS = 200_000_000
N_TICKS, N_RADARS = 1000, 4
SAMPLES = np.zeros(1, dtype=np.float32)


def frame(radar: int, tick: int) -> RadarFrame:
    return frame_of(SAMPLES, radar=radar, t_ns=tick * PERIOD_NS, counter=tick + 1)


@cache
def whole_run() -> tuple[Scan, ...]:
    return tuple(
        Scan(
            counter=tick,
            t_ns=tick * PERIOD_NS,
            frames=tuple(frame(radar, tick) for radar in range(N_RADARS)),
        )
        for tick in range(N_TICKS)
    )


def heard(name: str, seed: int) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    """Return which frames are left, shape (ticks, radars); every tick must still be there."""
    scans = list(stressed_scans(whole_run(), STRESSES[name], seed, N_TICKS * PERIOD_NS))
    assert [scan.counter for scan in scans] == list(range(N_TICKS))
    left = np.zeros((N_TICKS, N_RADARS), dtype=bool)
    for scan in scans:
        for kept in scan.frames:
            left[scan.counter, kept.radar] = True
    return left


def test_clean_changes_nothing() -> None:
    scans = whole_run()
    clean = stressed_scans(scans, STRESSES[CLEAN], 3, N_TICKS * PERIOD_NS)
    assert all(new is old for new, old in zip(clean, scans, strict=True))
    assert stressed_scene(load_scene("lab"), STRESSES[CLEAN], 3) == load_scene("lab")


def test_a_tenth_of_the_frames_is_dropped_each_by_itself() -> None:
    left = heard("dropped", 0)
    # 4000 frames: 0.5 % standard deviation
    assert left.mean() == pytest.approx(0.9, abs=0.015)
    lost = ~left
    # neighbours in time and on the robot know nothing of each other
    assert abs(np.corrcoef(lost[1:, 0], lost[:-1, 0])[0, 1]) < 0.1
    assert abs(np.corrcoef(lost[:, 0], lost[:, 1])[0, 1]) < 0.1
    assert (heard("dropped", 0) == left).all()
    assert (heard("dropped", 1) != left).any()


def test_silence_is_one_piece_of_a_tenth_for_all_radars() -> None:
    begins = []
    for seed in range(8):
        left = heard("silent", seed)
        silent = np.flatnonzero(~left.any(axis=1))
        assert len(silent) == pytest.approx(N_TICKS / 10, abs=1)
        assert silent[-1] - silent[0] == len(silent) - 1
        assert left.sum() == N_RADARS * (N_TICKS - len(silent))
        begins.append(silent[0] / N_TICKS)
    assert 0.15 <= min(begins) < 0.35
    assert 0.55 < max(begins) <= 0.75


def test_a_sweep_knows_the_corners_that_landmarks_may_be_of() -> None:
    """Those of the room and of its desks, by which precision is judged."""
    case = make_case("office:0", "robust", 0)
    source = source_of(case)
    source.close()
    corners = len(case.scene.walls) + 4 * len(case.scene.objects)
    assert corners > 4
    assert len(source.info.corners_m) == corners  # the walls of a room share their ends


@pytest.mark.parametrize("fps", [2, 10])
def test_a_run_has_the_frame_rate_that_is_asked_for(fps: int) -> None:
    source = source_of(replace(make_case("lab", "paper", 0), fps=fps))
    first, second = islice(source.scans, 2)
    source.close()
    assert second.t_ns - first.t_ns == pytest.approx(1e9 / real_frame_rate(fps), abs=1.0)
    assert source.info.radars[0].rate_hz == pytest.approx(real_frame_rate(fps))


def test_a_dead_radar_is_never_heard() -> None:
    assert heard("dead", 0).all(axis=0).tolist() == [False, True, True, True]
    assert not heard("dead", 0)[:, 0].any()


@pytest.mark.parametrize("name", STRESSES)
def test_a_stressed_scene_is_a_valid_scene_and_the_same_every_time(name: str) -> None:
    lab = load_scene("lab")
    scene = stressed_scene(lab, STRESSES[name], 5)
    assert Scene.model_validate(scene.model_dump()) == scene
    assert stressed_scene(lab, STRESSES[name], 5) == scene


@cache
def driven_scenes() -> tuple[Scene, ...]:
    rooms = [f"{family}:7" for family in FAMILIES]
    scenes = map(load_scene, (*shipped_names("scenes"), *rooms))
    return tuple(scene for scene in scenes if scene.path.laps)


@pytest.mark.parametrize("name", STRESSES)
def test_every_row_suits_every_scene_that_is_driven(name: str) -> None:
    for scene in driven_scenes():
        stressed = stressed_scene(scene, STRESSES[name], 2)
        assert Scene.model_validate(stressed.model_dump()) == stressed


def test_rows_plant_what_they_say() -> None:
    lab = load_scene("lab")
    skewed = stressed_scene(lab, STRESSES["skew"], 0)
    assert [radar.start_skew_ms for radar in skewed.radars] == [0.0, 190.0, 100.0, 150.0]
    offsets = np.array(
        [
            [r.range_offset_m for r in stressed_scene(lab, STRESSES["offsets_20"], seed).radars]
            for seed in range(200)
        ]
    )
    # 800 of them: 2.5 % standard deviation of a deviation, 0.7 mm of a mean
    assert offsets.std() == pytest.approx(0.02, rel=0.1)
    assert abs(offsets.mean()) < 0.0025
    duration_s = lab.trajectory().duration_ns / 1e9
    walk = stressed_scene(lab, STRESSES["walk"], 0).odometry.walk_per_sqrt_s
    assert walk * math.sqrt(duration_s) == pytest.approx(1.0)


def test_a_carried_robot_goes_on_elsewhere_and_its_wheels_do_not_know() -> None:
    lab = load_scene("lab")
    carried = stressed_scene(lab, STRESSES["carried"], 0)
    at_ns, down_ns = carried.trajectory().carried_ns or (0, 0)
    assert at_ns == pytest.approx(0.4 * lab.trajectory().duration_ns, abs=1)
    lifted, down = carried.trajectory().poses(np.array([at_ns, down_ns]))
    assert math.dist(lifted[:2], down[:2]) > 1.0
    before = (at_ns - PERIOD_NS) // PERIOD_NS
    tracks = [OdometryTrack.from_lines(scene_odometry(scene, 0)) for scene in (carried, lab)]
    times_ns = [tick * PERIOD_NS for tick in range(0, before, 50)]
    poses = [[track.pose_at(t_ns) for t_ns in times_ns] for track in tracks]
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-9)
    in_the_air = [tracks[0].pose_at(t_ns) for t_ns in (at_ns + PERIOD_NS, down_ns - PERIOD_NS)]
    np.testing.assert_array_equal(in_the_air[0], in_the_air[1])


def test_all_and_mismatch_are_their_parts_together() -> None:
    nothing = Stress(help="")
    for name, parts in (("all", FIVE), ("mismatch", MISMATCH)):
        for key in [field.name for field in fields(Stress) if field.name != "help"]:
            planted = [getattr(STRESSES[part], key) for part in parts]
            planted = [value for value in planted if value != getattr(nothing, key)]
            got = getattr(STRESSES[name], key)
            if isinstance(got, dict):
                # tables of several parts hold different keys
                assert sum(map(len, planted)) == len(got)
                assert all(got | part == got for part in planted)
            else:
                assert [got] == (planted or [getattr(nothing, key)])


FIVE = ("outliers", "dropped", "skew", "walk", "silent")
MISMATCH = (
    "pulse",
    "wander_10",
    "rod_rod",
    "bursts",
    "slip",
    "mounts",
    "stamps",
    "offsets_20",
)


def test_model_error_has_the_strengths_of_its_laws() -> None:
    """The numbers are those of the project's laws; SLAM gets the same rig and wheels as without."""
    lab = load_scene("lab")
    for name in (*MISMATCH, "pulse_wide", "wander_3", "mismatch"):
        scene = stressed_scene(lab, STRESSES[name], 4)
        assert scene != lab
        assert rig_of(scene) == rig_of(lab)
        assert wheels_of(scene) == wheels_of(lab)
        assert (true_landmarks_m(scene) == true_landmarks_m(lab)).all()
    scene = stressed_scene(lab, STRESSES["mismatch"], 4)
    for radar in scene.radars:
        assert radar.pulse == PulseSpec(width=1.15, skew=0.15, ringing=0.15)
        assert radar.bursts == BurstSpec(
            echo_share=0.15, amplitude=0.015, spread=0.6, noise_share=0.05, noise_sigma=2.5e-3
        )
        assert radar.stamp_sigma_ms == 20.0
    for target in scene.targets:
        assert target.wander == WanderSpec(range_m=0.01, inside_m=0.02, fading=0.4, phase_rad=1.0)
    assert scene.multipath.target_pairs == 0.25
    slip = scene.odometry
    assert (slip.slips_per_s, slip.slip_sigma_m, slip.slip_sigma_deg) == (0.05, 0.015, 2.0)
    wide = stressed_scene(lab, STRESSES["pulse_wide"], 4)
    assert {radar.pulse for radar in wide.radars} == {PulseSpec(width=1.1)}
    small = stressed_scene(lab, STRESSES["wander_3"], 4)
    assert {target.wander for target in small.targets} == {
        WanderSpec(range_m=0.003, inside_m=0.02, fading=0.4, phase_rad=1.0)
    }


@pytest.mark.parametrize("name", RECORDED)
def test_modules_like_recorded_ones_have_their_tables_and_slam_the_same_rig(name: str) -> None:
    lab = load_scene("lab")
    scene = stressed_scene(lab, STRESSES[f"like_{name}"], 4)
    for table, figures in RECORDED[name].items():
        tables = [getattr(scene, table)] if table != "pulse" else [r.pulse for r in scene.radars]
        for each in tables:
            assert each.model_dump().items() >= figures.items()
    assert scene.leakage.range_m == lab.leakage.range_m
    assert scene.clutter == lab.clutter
    assert rig_of(scene) == rig_of(lab)
    assert wheels_of(scene) == wheels_of(lab)
    assert stressed_scene(lab, STRESSES[CLEAN], 4) == lab


def test_modules_have_the_pulse_of_a_recorded_one_alone() -> None:
    lab = load_scene("lab")
    scene = stressed_scene(lab, STRESSES["pulse_x4m03_2025"], 4)
    for radar in scene.radars:
        assert radar.pulse.model_dump().items() >= RECORDED["x4m03_2025"]["pulse"].items()
    for table in ("noise", "leakage", "jitter"):
        assert getattr(scene, table) == getattr(lab, table)
    assert rig_of(scene) == rig_of(lab)


def test_mounts_are_off_by_5_mm_per_axis_and_1_degree() -> None:
    lab = load_scene("lab")
    errors = np.array(
        [
            (*radar.mount_error_m, radar.mount_error_deg)
            for seed in range(200)
            for radar in stressed_scene(lab, STRESSES["mounts"], seed).radars
        ]
    )
    # 800 of each: 2.5 % standard deviation of a deviation, 3.5 % of a mean
    np.testing.assert_allclose(errors.std(axis=0), [0.005, 0.005, 1.0], rtol=0.1)
    np.testing.assert_array_less(abs(errors.mean(axis=0)), [7e-4, 7e-4, 0.14])
    assert abs(np.corrcoef(errors.T) - np.eye(3)).max() < 0.14


@dataclass(frozen=True)
class ThreeEchoes:
    """A front end that sees the same everywhere."""

    phase_rad: float = 0.5
    sigma_m: float = math.nan

    def detect(self, frame: RadarFrame, range_offset_m: float = 0.0) -> tuple[Detection, ...]:
        return self.detect_many([frame], [range_offset_m])[0]

    def detect_many(
        self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
    ) -> list[tuple[Detection, ...]]:
        return [
            tuple(
                Detection(
                    radar=one.radar,
                    t_ns=one.t_ns,
                    range_m=range_m,
                    amplitude=range_m,
                    phase_rad=self.phase_rad,
                    sigma_m=self.sigma_m,
                )
                for range_m in (0.5, 0.7, 0.9)
            )
            for one in frames
        ]


def disturbed(name: str, true: ThreeEchoes, seed: int = 0) -> DisturbedDetector:
    config = SlamConfig(robust=RobustConfig(range_floor_m=3e-3, range_sigma_m=5e-3))
    return DisturbedDetector(detector=true, stress=STRESSES[name], config=config, seed=seed)


def outliers(true: ThreeEchoes, seed: int = 0) -> DisturbedDetector:
    return disturbed("outliers", true, seed)


@pytest.mark.parametrize("sigma_m", [4e-3, math.nan, math.inf])
def test_ranges_err_four_times_as_much_as_stated(sigma_m: float) -> None:
    """The preset states 5 mm of an error of 4 mm, and of one that is not known."""
    frames = [frame(radar, tick) for tick in range(N_TICKS) for radar in range(N_RADARS)]
    true = ThreeEchoes(sigma_m=sigma_m)
    noisy = disturbed("noise_stated_low", true).detect_many(frames, [0.0] * len(frames))
    errors = np.array([d.range_m - d.amplitude for of_one in noisy for d in of_one])
    # what the front end's own error, of the stated size, would make four times as much
    assert errors.std() == pytest.approx(math.sqrt(15) * 5e-3, rel=0.02)
    assert abs(errors.mean()) < 1e-3
    assert abs(np.corrcoef(errors[1:], errors[:-1])[0, 1]) < 0.05
    assert noisy[7] == disturbed("noise_stated_low", true).detect(frames[7])


def test_a_fifth_of_the_detections_gets_a_random_range_and_looks_as_before() -> None:
    frames = [frame(radar, tick) for tick in range(N_TICKS) for radar in range(N_RADARS)]
    mixed = outliers(ThreeEchoes()).detect_many(frames, [0.0] * len(frames))
    assert all(sorted(d.amplitude for d in of_one) == [0.5, 0.7, 0.9] for of_one in mixed)
    assert all([d.range_m for d in of_one] == sorted(d.range_m for d in of_one) for of_one in mixed)
    wrong = [d for of_one in mixed for d in of_one if d.range_m != d.amplitude]
    # 12 000 detections: 0.37 % standard deviation
    assert len(wrong) / (3 * len(frames)) == pytest.approx(0.2, abs=0.012)
    ranges = np.array([d.range_m for d in wrong])
    assert 0.2 <= ranges.min() < 0.21
    assert 1.49 < ranges.max() <= 1.5
    # uniform: 2400 of them know a quartile to 1 % of the span
    quartiles = np.quantile(ranges, [0.25, 0.5, 0.75])
    np.testing.assert_allclose(quartiles, [0.525, 0.85, 1.175], atol=0.05)
    assert np.std([d.phase_rad for d in wrong]) == pytest.approx(math.pi / math.sqrt(3), rel=0.05)


def test_outliers_depend_on_frame_and_seed_alone() -> None:
    frames = [frame(radar, tick) for tick in range(30) for radar in range(N_RADARS)]
    together = outliers(ThreeEchoes()).detect_many(frames, [0.0] * len(frames))
    alone = [outliers(ThreeEchoes()).detect(one) for one in reversed(frames)]
    assert together == alone[::-1]
    assert together != outliers(ThreeEchoes(), seed=1).detect_many(frames, [0.0] * len(frames))


def test_without_a_phase_an_outlier_has_none_either() -> None:
    mixed = [outliers(ThreeEchoes(phase_rad=math.nan)).detect(frame(0, n)) for n in range(20)]
    assert all(math.isnan(d.phase_rad) for of_one in mixed for d in of_one)
