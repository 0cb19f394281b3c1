"""Experiments: what they measure, the pictures and tables they leave, and how the command ends."""

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.scene.scene import load_scene
from hil_tests.paths import real_recording
from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.slam.app.sweep.sweep_runs import run_of
from slam.app.cli import main
from slam.app.errors import AppError
from slam.app.experiments import sweep_results
from slam.app.experiments.figure7 import measure_steps, range_errors
from slam.app.experiments.filter import Origin, Seen, Setting, drive, outcome
from slam.app.experiments.recording import (
    FAR_BINS,
    SlowTime,
    emulate,
    equivalent_scene,
    read_slow_time,
)
from slam.app.experiments.smoke import in_smoke, light_attenuation_db, smoke_attenuation_db
from slam.app.run.pictures import picture
from slam.app.sweep.run import SweepRun, make_case
from slam.app.sweep.statistics import summarise_groups
from slam.geometry import transform
from xethru_protocol.system import StopFlag

RANGES_M = (0.6, 0.61, 0.62, 0.9, 0.91, 0.92)


def test_the_peaks_of_every_front_end_follow_a_rod_in_1_cm_steps() -> None:
    steps = measure_steps(RANGES_M, seed=4, frames_per_step=6, stop=StopFlag())
    errors = range_errors(steps, StopFlag())
    assert set(errors) == {"paper", "matched_filter", "joint"}
    numbers = {name: error.numbers() for name, error in errors.items()}
    for name, error in numbers.items():
        assert (error["found"], error["others_per_frame"]) == (1.0, 0.0), name
    paper, matched = numbers["paper"], numbers["matched_filter"]
    # 30 dB at 1 m: the bound is 0.88 mm there, clutter and jitter add; a half carrier cycle is 10
    assert matched["std_m"] < 2.5e-3 < paper["std_m"] < 15e-3
    assert abs(matched["bias_m"]) < 1.5e-3
    steps_m = np.diff(RANGES_M + errors["matched_filter"].position_means_m)[[0, 1, 3, 4]]
    np.testing.assert_allclose(steps_m, 0.01, atol=3e-3)


def test_an_empty_room_gives_no_rod() -> None:
    # beyond what SLAM uses
    steps = measure_steps([3.0], seed=4, frames_per_step=2, stop=StopFlag())
    for error in range_errors(steps, StopFlag()).values():
        numbers = error.numbers()
        assert numbers["found"] == 0.0
        assert math.isnan(numbers["bias_m"])


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


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    scene = write_short_scene(tmp_path_factory.mktemp("scene"))
    return drive(str(scene), seed=0, stop=StopFlag())


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
    lax, table_i, strict, narrow = (
        outcome(seen, Setting(window_size=15, min_opc=count, search_rad_m=radius_m), StopFlag())
        for count, radius_m in ((1, 0.2), (9, 0.2), (15, 0.2), (9, 0.025))
    )
    assert lax.true_kept == 1.0
    assert table_i.true_kept is not None
    assert strict.true_kept is not None
    assert narrow.true_kept is not None
    assert strict.true_kept < table_i.true_kept < 1.0
    assert narrow.true_kept < table_i.true_kept
    assert lax.n_observations >= table_i.n_observations > strict.n_observations


def test_a_picture_is_the_same_file_each_time(tmp_path: Path) -> None:
    for name in ("one.png", "two.png"):
        with picture(tmp_path / name, width_in=2, height_in=2) as figure:
            figure.subplots().plot([0, 1, 2], [1, 0, 1], color="#1f6fd0")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


SIGMA = 3e-5
SEEDS = range(6)


def frames_of(iq: NDArray[Any]) -> SlowTime:
    return SlowTime(iq=iq.astype(np.complex128), rate_hz=17.0, first_bin_m=0.3, bin_length_m=0.05)


@pytest.fixture(scope="module")
def white() -> SlowTime:
    rng = np.random.default_rng(11)
    iq = SIGMA * (rng.normal(size=(4000, 40)) + 1j * rng.normal(size=(4000, 40)))
    iq[:, 4] += 0.02
    return frames_of(iq)


def test_white_noise_is_its_own_floor_and_all_new_with_every_frame(white: SlowTime) -> None:
    numbers = white.numbers()
    for name in ("far_sigma", "far_white", "far_floor"):
        assert numbers[name] == pytest.approx(SIGMA, rel=0.03), name
    assert abs(numbers["far_lag_1"]) < 0.02
    assert numbers["far_neighbours"] < 0.04
    assert white.strongest == 4
    # small noise beside a strong echo: its quadrature part over the amplitude
    assert numbers["phase_rad"] == pytest.approx(SIGMA / 0.02, rel=0.05)
    assert numbers["phase_white_rad"] == pytest.approx(SIGMA / 0.02, rel=0.05)


def test_a_line_of_known_frequency_stands_in_its_place() -> None:
    time_s = np.arange(1024) / 17.0
    iq = np.zeros((1024, 40), dtype=np.complex128)
    iq[:, 30:] = 1e-3 * np.cos(2 * np.pi * 3.0 * time_s)[:, np.newaxis]
    frequency, density = frames_of(iq).spectrum(slice(-FAR_BINS, None))
    assert frequency[np.argmax(density)] == pytest.approx(3.0, abs=17 / 128)
    # power: (1e-3)^2 / 2 in I and none in Q, so half of it per component
    power = float((density**2).sum() * (frequency[1] - frequency[0]))
    assert power == pytest.approx(1e-6 / 4, rel=0.03)


def test_first_order_process_has_its_autocorrelation() -> None:
    rng = np.random.default_rng(2)
    steps = rng.normal(size=(6000, 40)) + 1j * rng.normal(size=(6000, 40))
    iq = np.zeros_like(steps)
    for frame in range(1, 6000):
        iq[frame] = 0.9 * iq[frame - 1] + steps[frame]
    np.testing.assert_allclose(
        frames_of(iq[100:]).autocorrelation(6), 0.9 ** np.arange(6), atol=0.02
    )


def test_the_quietest_stretch_is_found(white: SlowTime) -> None:
    loud = white.iq.copy()
    loud[:1000] *= 5
    loud[1128:] *= 3
    quiet = frames_of(loud).quietest()
    assert quiet.iq.shape == (128, 40)
    assert quiet.numbers()["far_white"] == pytest.approx(SIGMA, rel=0.1)


def test_emulated_frames_have_the_statistics_of_the_recording() -> None:
    """Spreads over seeds are those of 30 s of slow processes; what is fast is held tightly."""
    recorded = read_slow_time(real_recording())
    assert recorded.rate_hz == pytest.approx(17.05, abs=0.01)
    scene = equivalent_scene(recorded)
    runs = [emulate(scene, recorded, seed).numbers() for seed in SEEDS]
    real = recorded.numbers()
    # the figures that the recording's description gives
    assert real["far_sigma"] == pytest.approx(1.4e-4, rel=0.01)
    assert real["far_lag_1"] == pytest.approx(0.98, abs=0.005)
    assert real["far_white"] == pytest.approx(2.1e-5, rel=0.02)
    assert real["phase_rad"] == pytest.approx(0.032, rel=0.02)
    assert real["phase_white_rad"] == pytest.approx(0.0056, rel=0.02)
    for name, within in (
        ("amplitude", 0.01),
        ("far_sigma", 0.15),
        ("far_lag_1", 0.006),
        ("far_white", 0.10),
        ("far_floor", 0.08),
        ("far_neighbours", 0.08),
        ("phase_white_rad", 0.08),
        ("phase_rad", 0.40),
    ):
        median = np.median([run[name] for run in runs])
        assert median == pytest.approx(real[name], rel=within), name


def test_white_noise_of_neighbouring_bins_is_as_alike_as_in_the_real_filter() -> None:
    """In the quietest stretch the fast part is the receiver's: it went through the real taps."""
    recorded = read_slow_time(real_recording())
    real = recorded.quietest().numbers()["far_neighbours_fast"]
    emulated = emulate(equivalent_scene(recorded), recorded, 0).numbers()["far_neighbours_fast"]
    assert emulated == pytest.approx(real, abs=0.06)


def test_the_experiment_leaves_picture_numbers_and_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--recording", str(real_recording()), "--runs", "2", "--out", str(tmp_path)]
    assert main(["experiment", "recording", *options]) == 0
    numbers = json.loads((tmp_path / "recording.json").read_text())
    assert numbers["frames"] == 514
    assert numbers["recorded"]["far_sigma"] == pytest.approx(1.4e-4, rel=0.01)
    assert (tmp_path / "recording.png").read_bytes().startswith(b"\x89PNG")
    assert "ten farthest bins" in capsys.readouterr().out


TIMES_S = tuple(float(second) for second in range(1, 11))


def made_up(preset: str, stress: str, seed: int, nees: tuple[float, ...], ate_m: float) -> SweepRun:
    """Return a run with these ten NEES; NIS 2.0 of 2 dof, but 20.0 at the first time."""
    run = run_of(make_case("lab", preset, seed, stress=stress))
    return replace(
        run,
        ate_rmse_m=ate_m,
        nees_pose=tuple(zip(TIMES_S, nees, strict=True)),
        nis_times=tuple((t_s, 20.0 if t_s == 1.0 else 2.0, 2) for t_s in TIMES_S),
        bound=None,
    )


def written(folder: Path, runs: list[SweepRun]) -> str:
    path = folder / "sweep.json"
    result = {"runs": [asdict(run) for run in runs], "groups": summarise_groups(runs)}
    path.write_text(json.dumps(result))
    return str(path)


# For 4 seeds the band is [1.10, 5.83] (chi-square of 12 dof: 4.404 and 23.337).
HONEST = (3.0,) * 10
TWICE_OUT = (9.0, 0.5, *(3.0,) * 8)


def runs() -> list[SweepRun]:
    rows = (
        ("paper", "clean", TWICE_OUT, 0.010),
        ("paper", "skew", TWICE_OUT, 0.030),
        ("robust", "clean", HONEST, 0.002),
        ("robust", "skew", HONEST, 0.003),
    )
    return [
        made_up(preset, stress, seed, nees, ate_m)
        for preset, stress, nees, ate_m in rows
        for seed in range(4)
    ]


def numbers_of(name: str, folder: Path) -> dict[str, Any]:
    command = ["experiment", name, "--sweep", written(folder, runs()), "--out", str(folder / "out")]
    assert main(command) == 0
    assert (folder / "out" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    numbers: dict[str, Any] = json.loads((folder / "out" / f"{name}.json").read_text())
    return numbers


def test_consistency_counts_the_times_in_their_bands(tmp_path: Path) -> None:
    numbers = numbers_of("consistency", tmp_path)
    assert numbers["simulated"] is True
    # the stressed runs are not in it
    assert [
        (row["name"], row["runs"], row["anees_in_band"], row["nis_in_band"])
        for row in numbers["groups"]
    ] == [("lab, preset paper", 4, 8, 9), ("lab, preset robust", 4, 10, 9)]


def test_stress_compares_with_clean_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    groups = numbers_of("stress", tmp_path)["groups"]
    assert {row["name"]: row["times_clean"]["median"] for row in groups} == {
        "lab, preset paper": 1.0,
        "lab, preset paper, stress skew": pytest.approx(3.0),
        "lab, preset robust": 1.0,
        "lab, preset robust, stress skew": pytest.approx(1.5),
    }
    assert capsys.readouterr().out.count("x clean") == 2


def test_scenes_has_a_row_per_clean_group(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # 10 and 2 mm, where the wheels have 40
    assert [
        (row["name"], row["ratio"]["median"], row["anees_mean"], row["anees_in_band"])
        for row in numbers_of("scenes", tmp_path)["groups"]
    ] == [
        ("lab, preset paper", pytest.approx(0.25), pytest.approx(3.35), 8),
        ("lab, preset robust", pytest.approx(0.05), pytest.approx(3.0), 10),
    ]
    assert "0.250" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["consistency", "stress", "scenes"])
def test_a_result_never_replaces_its_sweep(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"{name}.json"
    Path(written(tmp_path, runs())).rename(path)
    before = path.read_bytes()
    assert main(["experiment", name, "--sweep", str(path), "--out", str(tmp_path)]) == 1
    assert "choose another --out" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_a_sweep_without_stresses_has_no_stress_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, [run for run in runs() if run.stress == "clean"])
    assert main(["experiment", "stress", "--sweep", path, "--out", str(tmp_path / "out")]) == 1
    assert "has no stressed runs" in capsys.readouterr().err


def damaged(value: Any) -> Iterator[Any]:  # noqa: ANN401 - JSON
    """Yield copies of a document with one part of it gone or replaced."""
    yield from (None, "x", -1, [], {}, math.nan, math.inf, 0)
    if isinstance(value, dict):
        for key, part in value.items():
            yield {name: each for name, each in value.items() if name != key}
            yield from ({**value, key: wrong} for wrong in damaged(part))
    elif isinstance(value, list) and value:
        yield value[:-1]
        yield from ([*value[:-1], wrong] for wrong in damaged(value[-1]))


@pytest.mark.parametrize("name", ["consistency", "stress", "scenes"])
def test_a_file_that_is_no_whole_sweep_is_refused_or_shown(name: str, tmp_path: Path) -> None:
    """Whatever is missing or null in it; what is drawn goes by what `run` lets through."""
    arguments = argparse.Namespace(name=name, out=tmp_path, sweep=Path(written(tmp_path, runs())))
    whole = json.loads(arguments.sweep.read_text())
    del whole["runs"]
    whole["groups"] = whole["groups"][:2]
    refused = shown = 0
    for content in damaged(whole):
        arguments.sweep.write_text(json.dumps(content))
        try:
            numbers = sweep_results.run(arguments, StopFlag()).numbers
        except AppError:
            refused += 1
        else:
            shown += 1
            json.dumps(numbers, allow_nan=False)
    assert refused > 100
    assert shown > 10


@pytest.mark.parametrize("name", ["consistency", "stress", "scenes"])
def test_a_sweep_without_any_error_is_drawn(name: str, tmp_path: Path) -> None:
    """Ideal wheels give no ratio, and a logarithmic axis has no place for zero."""
    perfect = [replace(run, ate_rmse_m=0.0, odometry_ate_rmse_m=0.0) for run in runs()]
    command = ["experiment", name, "--sweep", written(tmp_path, perfect), "--out", str(tmp_path)]
    assert main(command) == 0
    assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("content", ["", '{"command": {}}\n{}\n', "[", "[" * 100_000, "\x00"])
def test_an_unfinished_sweep_is_one_line(
    content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "o.part").write_text(content)
    command = ["experiment", "scenes", "--sweep", str(tmp_path / "o.part"), "--out", str(tmp_path)]
    assert main(command) == 1
    assert capsys.readouterr().err.count("\n") == 1
