"""Experiments `figure7`, `smoke` and `filter`: what they measure, and how the command ends."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from emulator.scene.scene import Scene, load_scene
from hil_tests.paths import FIXTURES
from slam.app.cli import main
from slam.app.experiments import EXPERIMENTS
from slam.app.experiments.figure7 import measure_steps, range_errors
from slam.app.experiments.filter import Origin, Seen, Setting, drive, outcomes
from slam.app.experiments.smoke import in_smoke, light_attenuation_db, smoke_attenuation_db
from slam.app.run.pictures import picture
from slam.geometry import transform

RANGES_M = (0.6, 0.61, 0.62, 0.9, 0.91, 0.92)


def test_the_peaks_of_every_front_end_follow_a_rod_in_1_cm_steps() -> None:
    errors = range_errors(measure_steps(seed=4, frames_per_step=6, ranges_m=RANGES_M))
    assert set(errors) == {"paper", "matched_filter", "joint"}
    for name, error in errors.items():
        assert error.found == 1.0, name
        assert error.others_per_frame == 0.0, name
    paper, matched = errors["paper"], errors["matched_filter"]
    # 30 dB at 1 m: the bound is 0.88 mm there, clutter and jitter add; a half carrier cycle is 10
    assert matched.std_m < 2.5e-3 < paper.std_m < 15e-3
    assert abs(matched.bias_m) < 1.5e-3
    steps_m = np.diff(RANGES_M + matched.position_means_m)[[0, 1, 3, 4]]
    np.testing.assert_allclose(steps_m, 0.01, atol=3e-3)


def test_an_empty_room_gives_no_rod() -> None:
    steps = measure_steps(seed=4, frames_per_step=2, ranges_m=[3.0])  # beyond what SLAM uses
    for error in range_errors(steps).values():
        assert error.found == 0.0
        assert error.numbers()["bias_m"] is None


def test_smoke_of_fine_particles_is_nothing_to_a_radar_and_a_wall_to_light() -> None:
    # by hand: 3 pi / 41.124 mm x 5 / 1.8e6 x 3 m = 1.910e-3 nepers of power
    assert smoke_attenuation_db(1.5, 5.0) == pytest.approx(1.910e-3 * 10 / math.log(10), rel=1e-3)
    # by hand: 8.7 x 5 x 3 = 130.5 nepers of power
    assert light_attenuation_db(1.5, 5.0) == pytest.approx(130.5 * 10 / math.log(10), rel=1e-9)


def test_a_scene_in_smoke_echoes_weaker_by_just_that_much() -> None:
    clear = load_scene("smoke")
    (before,), (after,) = clear.targets, in_smoke(clear).targets
    lost_db = -20 * math.log10(after.amplitude_1m / before.amplitude_1m)
    assert lost_db == pytest.approx(smoke_attenuation_db(1.5), rel=1e-6)
    assert in_smoke(clear).model_copy(update={"targets": clear.targets}) == clear


def short(scene: Scene, tmp_path: Path) -> str:
    """Write the lab with a course of half a metre, so that it is driven in a moment."""
    text = (FIXTURES / "scenes" / f"{scene.name}.toml").read_text()
    lines = text.split("\n")
    (row,) = (n for n, line in enumerate(lines) if line.startswith("waypoints_m"))
    lines[row] = "waypoints_m = [[0.0, 0.0], [0.5, 0.0]]"
    (row,) = (n for n, line in enumerate(lines) if line.startswith("laps"))
    lines[row] = 'laps = ["forward"]'
    path = tmp_path / "short.toml"
    path.write_text("\n".join(lines))
    return str(path)


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    return drive(short(load_scene("lab"), tmp_path_factory.mktemp("scene")), seed=0)


def test_a_true_fix_lies_where_a_landmark_is(seen: Seen) -> None:
    assert seen.count(Origin.TRUE) > 50
    gaps = [
        np.linalg.norm(transform(pose, np.array([[fix.x_m, fix.y_m]])) - seen.landmarks_m, axis=1)
        for state, pose, origins in zip(seen.states, seen.truth, seen.origins, strict=True)
        for fix, origin in zip(state.fixes, origins, strict=True)
        if origin is Origin.TRUE
    ]
    # two ranges 8 mm off turn the bearing of antennas 0.2 m apart: 57 mm sideways at 1 m
    assert float(np.median([gap.min() for gap in gaps])) < 0.057


def test_a_filter_that_asks_for_more_keeps_less(seen: Seen) -> None:
    lax, table_i, strict, narrow = outcomes(
        seen,
        [
            Setting(window_size=15, min_opc=1, search_rad_m=0.2),
            Setting(window_size=15, min_opc=9, search_rad_m=0.2),
            Setting(window_size=15, min_opc=15, search_rad_m=0.2),
            Setting(window_size=15, min_opc=9, search_rad_m=0.025),
        ],
    )
    assert lax.true_kept == 1.0
    assert table_i.true_kept is not None
    assert strict.true_kept is not None
    assert narrow.true_kept is not None
    assert strict.true_kept < table_i.true_kept < 1.0
    assert narrow.true_kept < table_i.true_kept
    assert lax.n_observations >= table_i.n_observations > strict.n_observations


def test_an_unknown_experiment_is_wrong_usage_and_lists_the_known(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["experiment", "figure8"])
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert all(name in error for name in EXPERIMENTS)
    assert "Traceback" not in error


@pytest.mark.parametrize("name", [name for name in EXPERIMENTS if name != "recording"])
def test_a_folder_that_cannot_be_written_is_one_line_before_anything_is_measured(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.write_text("not a folder")
    assert main(["experiment", name, "--out", str(file)]) == 1
    captured = capsys.readouterr()
    assert captured.err.startswith(f"uwb-slam: {file}: ")
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_a_picture_is_the_same_file_each_time(tmp_path: Path) -> None:
    for name in ("one.png", "two.png"):
        with picture(tmp_path / name, width_in=2, height_in=2) as figure:
            figure.subplots().plot([0, 1, 2], [1, 0, 1], color="#1f6fd0")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_a_scene_that_is_not_there_is_told_before_the_first_is_driven(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object, **__: object) -> Seen:
        raise AssertionError("driven")

    monkeypatch.setattr("slam.app.experiments.filter.drive", never)
    command = ["experiment", "filter", "--out", str(tmp_path), "--scene", "lab", "nowhere"]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert "nowhere: no such scene" in error
    assert error.count("\n") == 1
