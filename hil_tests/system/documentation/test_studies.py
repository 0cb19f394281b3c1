"""The scripts of `docs/studies`: what they measure, and that each makes its picture."""

import json
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.scene.scene import load_scene
from hil_tests.paths import FIXTURES, STUDIES, real_recording, study
from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.slam.app.sweep.sweep_runs import run_of
from slam.app.sweep.run import make_case
from slam.app.sweep.statistics import summarise_groups
from slam.config import FrontEnd
from slam.geometry import transform

figure7, outlier_filter, recording, smoke, sweep_result = (
    study(name) for name in ("figure7", "outlier_filter", "recording", "smoke", "sweep_result")
)
BASELINES = FIXTURES / "baselines"
RARE, THOROUGH = pytest.mark.rare, pytest.mark.thorough

RANGES_M = (0.6, 0.61, 0.62, 0.9, 0.91, 0.92)


def test_the_peaks_of_every_front_end_follow_a_rod_in_1_cm_steps() -> None:
    frames = figure7.frames_of_rod(RANGES_M, seed=4, count=6)
    errors_m = {}
    for name in FrontEnd:
        found = figure7.detections(name, frames)
        assert {len(each) for step in found for each in step} == {1}, name
        errors_m[str(name)] = figure7.range_errors_m(found, RANGES_M)
        assert np.isfinite(errors_m[name]).all(), name
    assert set(errors_m) == {"paper", "matched_filter", "joint"}
    paper_m, matched_m = errors_m["paper"], errors_m["matched_filter"]
    # 30 dB at 1 m: the bound is 0.88 mm there, clutter and jitter add; a half carrier cycle is 10
    assert matched_m.std() < 2.5e-3 < paper_m.std() < 15e-3
    assert abs(matched_m.mean()) < 1.5e-3
    steps_m = np.diff(RANGES_M + matched_m.mean(axis=1))[[0, 1, 3, 4]]
    np.testing.assert_allclose(steps_m, 0.01, atol=3e-3)


def test_an_empty_room_gives_no_rod() -> None:
    frames = figure7.frames_of_rod([3.0], seed=4, count=2)  # beyond what SLAM uses
    for name in FrontEnd:
        errors_m = figure7.range_errors_m(figure7.detections(name, frames), [3.0])
        assert errors_m.shape == (1, 2)
        assert np.isnan(errors_m).all()


def test_smoke_of_fine_particles_is_nothing_to_a_radar() -> None:
    # by hand: 3 pi / 41.124 mm x 5 / 1.8e6 x 3 m = 1.910e-3 nepers of power
    expected_db = 1.910e-3 * 10 / math.log(10)
    assert smoke.smoke_attenuation_db(1.5, 5.0) == pytest.approx(expected_db, rel=1e-3)


def test_a_scene_in_smoke_echoes_weaker_by_just_that_much() -> None:
    clear = load_scene("smoke")
    (before,), (after,) = clear.targets, smoke.in_smoke(clear).targets
    lost_db = -20 * math.log10(after.amplitude_1m / before.amplitude_1m)
    assert lost_db == pytest.approx(smoke.smoke_attenuation_db(1.5), rel=1e-6)
    assert smoke.in_smoke(clear).model_copy(update={"targets": clear.targets}) == clear


@pytest.fixture(scope="module")
def lap(tmp_path_factory: pytest.TempPathFactory) -> Any:  # noqa: ANN401 - of a script
    scene = write_short_scene(tmp_path_factory.mktemp("scene"))
    return outlier_filter.drive(str(scene), seed=0)


def test_a_true_fix_lies_where_a_landmark_is(lap: Any) -> None:  # noqa: ANN401 - of a script
    gaps_m = [
        np.linalg.norm(transform(pose, np.array([[fix.x_m, fix.y_m]])) - lap.landmarks_m, axis=1)
        for state, pose, origins in zip(lap.states, lap.truth, lap.origins, strict=True)
        for fix, origin in zip(state.fixes, origins, strict=True)
        if origin == "true"
    ]
    assert len(gaps_m) > 50
    # two ranges 8 mm off turn the bearing of antennas 0.2 m apart: 57 mm sideways at 1 m
    assert float(np.median([gap.min() for gap in gaps_m])) < 0.057


def test_a_filter_that_asks_for_more_keeps_less(lap: Any) -> None:  # noqa: ANN401 - of a script
    lax, table_i, strict, narrow = (
        outlier_filter.outcome(lap, outlier_filter.Setting(min_opc=count, search_rad_m=radius_m))
        for count, radius_m in ((1, 0.2), (9, 0.2), (15, 0.2), (9, 0.025))
    )
    assert lax.shares["true"] == 1.0
    assert strict.shares["true"] < table_i.shares["true"] < 1.0
    assert narrow.shares["true"] < table_i.shares["true"]
    assert lax.n_observations >= table_i.n_observations > strict.n_observations


SIGMA = 3e-5
SEEDS = range(6)


def frames_of(iq: NDArray[Any]) -> Any:  # noqa: ANN401 - of a script
    ranges_m = 0.3 + 0.05 * np.arange(iq.shape[1])
    return recording.SlowTime(iq=iq.astype(np.complex128), rate_hz=17.0, ranges_m=ranges_m)


def component(values: NDArray[Any]) -> float:
    """Return the root mean square of the I or Q of values."""
    return float(np.sqrt((np.abs(values) ** 2).mean() / 2))


def neighbours(values: NDArray[Any]) -> float:
    """Return the mean magnitude of the correlation between bins that lie side by side."""
    sigma = np.sqrt((np.abs(values) ** 2).mean(axis=0))
    products = np.abs((values[:, 1:].conj() * values[:, :-1]).mean(axis=0))
    return float((products / (sigma[1:] * sigma[:-1])).mean())


def statistics_of(frames: Any) -> dict[str, float]:  # noqa: ANN401 - of a script
    """Return what describes a record: of its ten farthest bins, and of its strongest.

    ``white`` is what is new with every frame, ``floor`` that of the spectrum from 6 Hz up, as white
    noise; ``neighbours_fast`` is of third differences.
    """
    far, phase = frames.far(), frames.phase_rad()
    frequency, density = frames.spectrum(recording.FAR)
    floor = np.sqrt((density[frequency >= 6.0] ** 2).mean())
    return {
        "amplitude": float(frames.amplitude()[frames.strongest()]),
        "phase_rad": float(phase.std()),
        "phase_white_rad": float(np.diff(phase).std() / np.sqrt(2)),
        "far_sigma": component(far),
        "far_lag_1": float(frames.autocorrelation(2.5 / frames.rate_hz)[1][1]),
        "far_white": component(np.diff(far, axis=0)) / np.sqrt(2),
        "far_floor": float(floor * np.sqrt(frames.rate_hz / 2)),
        "far_neighbours": neighbours(far),
        "far_neighbours_fast": neighbours(np.diff(far, n=3, axis=0)),
    }


@pytest.fixture(scope="module")
def white() -> Any:  # noqa: ANN401 - of a script
    rng = np.random.default_rng(11)
    iq = SIGMA * (rng.normal(size=(4000, 40)) + 1j * rng.normal(size=(4000, 40)))
    iq[:, 4] += 0.02
    return frames_of(iq)


def test_white_noise_is_its_own_floor_and_all_new_with_every_frame(white: Any) -> None:  # noqa: ANN401 - of a script
    numbers = statistics_of(white)
    for name in ("far_sigma", "far_white", "far_floor"):
        assert numbers[name] == pytest.approx(SIGMA, rel=0.03), name
    assert abs(numbers["far_lag_1"]) < 0.02
    assert numbers["far_neighbours"] < 0.04
    assert white.strongest() == 4
    # small noise beside a strong echo: its quadrature part over the amplitude
    assert numbers["phase_rad"] == pytest.approx(SIGMA / 0.02, rel=0.05)
    assert numbers["phase_white_rad"] == pytest.approx(SIGMA / 0.02, rel=0.05)
    _, changes_mrad = white.phase_changes_mrad()
    np.testing.assert_allclose(changes_mrad, 1e3 * np.sqrt(2) * SIGMA / 0.02, rtol=0.05)


def test_a_line_of_known_frequency_stands_in_its_place() -> None:
    time_s = np.arange(1024) / 17.0
    iq = np.zeros((1024, 40), dtype=np.complex128)
    iq[:, 30:] = 1e-3 * np.cos(2 * np.pi * 3.0 * time_s)[:, np.newaxis]
    frequency, density = frames_of(iq).spectrum(recording.FAR)
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
    lags_s, correlation = frames_of(iq[100:]).autocorrelation(6 / 17.0)
    np.testing.assert_allclose(lags_s, np.arange(6) / 17.0)
    np.testing.assert_allclose(correlation, 0.9 ** np.arange(6), atol=0.02)


def test_the_quietest_stretch_is_found(white: Any) -> None:  # noqa: ANN401 - of a script
    loud = white.iq.copy()
    loud[:1000] *= 5
    loud[1128:] *= 3
    quiet = frames_of(loud).quietest()
    assert quiet.iq.shape == (128, 40)
    assert statistics_of(quiet)["far_white"] == pytest.approx(SIGMA, rel=0.1)


def test_emulated_frames_have_the_statistics_of_the_recording() -> None:
    """Spreads over seeds are those of 30 s of slow processes; what is fast is held tightly."""
    recorded = recording.read(real_recording())
    assert len(recorded.iq) == 514
    assert recorded.rate_hz == pytest.approx(17.05, abs=0.01)
    scene = recording.equivalent_scene(recorded)
    runs = [statistics_of(recording.emulate(scene, recorded, seed)) for seed in SEEDS]
    real = statistics_of(recorded)
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
    recorded = recording.read(real_recording())
    emulated = recording.emulate(recording.equivalent_scene(recorded), recorded, 0)
    real = statistics_of(recorded.quietest())["far_neighbours_fast"]
    assert statistics_of(emulated)["far_neighbours_fast"] == pytest.approx(real, abs=0.06)


def test_a_recording_without_enough_frames_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "short.npz"
    np.savez(path, iq=np.ones((10, 30), dtype=np.complex64), ranges_m=np.arange(30.0))
    with pytest.raises(SystemExit, match="at least 256 baseband frames"):
        recording.read(path)


@pytest.mark.parametrize("name", ["consistency", "stress", "scenes"])
def test_a_sweep_without_any_error_is_drawn(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ideal wheels give no ratio, and a logarithmic axis has no place for zero."""
    clean = replace(
        run_of(make_case("lab", "robust", 0)), ate_rmse_m=0.0, odometry_ate_rmse_m=0.0, bound=None
    )
    path = tmp_path / "sweep.json"
    path.write_text(
        json.dumps({"groups": summarise_groups([clean, replace(clean, stress="skew")])})
    )
    monkeypatch.setattr("sys.argv", ["", name, str(path), "--out", str(tmp_path)])
    sweep_result.main()
    assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file"),
        ("{", "is not a result of"),
        ("[]", "is not a result of"),
        ('{"groups": []}', "has no runs that stress shows"),
    ],
)
def test_a_file_without_a_sweep_is_one_line(
    content: str | None, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "sweep.json"
    if content is not None:
        path.write_text(content)
    monkeypatch.setattr("sys.argv", ["", "stress", str(path), "--out", str(tmp_path)])
    with pytest.raises(SystemExit, match=message):
        sweep_result.main()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "picture", "options"),
    [
        pytest.param("figure7", "figure7", ("--frames", "1"), marks=THOROUGH),
        pytest.param("smoke", "smoke", (), marks=THOROUGH),
        pytest.param("outlier_filter", "filter", ("--scene", "{scene}"), marks=RARE),
        pytest.param("limits", "limits", ("--trials", "10"), marks=THOROUGH),
        pytest.param(
            "recording", "recording", ("--runs", "2", "--recording", "{recording}"), marks=RARE
        ),
        pytest.param(  # drawn in this process above
            "sweep_result",
            "consistency",
            ("consistency", str(BASELINES / "sweep.json")),
            marks=RARE,
        ),
        pytest.param(
            "sweep_result", "stress", ("stress", str(BASELINES / "stress.json")), marks=RARE
        ),
        pytest.param(
            "sweep_result", "scenes", ("scenes", str(BASELINES / "scenes.json")), marks=RARE
        ),
    ],
)
def test_a_study_makes_its_picture(
    name: str, picture: str, options: Sequence[str], tmp_path: Path
) -> None:
    place = {"scene": write_short_scene(tmp_path)}
    if name == "recording":
        place["recording"] = real_recording()
    words = [option.format_map(place) for option in options]
    command = [sys.executable, str(STUDIES / f"{name}.py"), "--out", str(tmp_path / "out"), *words]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ""
    (made,) = (tmp_path / "out").iterdir()
    assert made.name == f"{picture}.png"
    assert made.read_bytes().startswith(b"\x89PNG")
