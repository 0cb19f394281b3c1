"""`uwb-slam benchmark p440` on look-alikes whose truth is known, and on the real trials."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from hil_tests.paths import shared_data
from hil_tests.unit.slam.app.benchmarks import rails
from slam.app.benchmarks.p440 import (
    coherence,
    coherent,
    evaluate,
    focus,
    read_trial,
    spoilt,
    width_m,
)
from slam.app.cli import main
from slam.live.errors import AppError
from xethru_protocol.operating_system import StopFlag


@pytest.mark.slow
def test_the_command_images_every_trial_of_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("slam.app.benchmarks.p440._SEEDS", range(1))
    monkeypatch.setattr("slam.app.benchmarks.p440._CLOCK_STEP_NS", 5_000_000)
    monkeypatch.setattr("slam.app.benchmarks.p440._PATH_ERRORS", {"10 mm": (0.0, 0.010)})
    for seed, name in enumerate(("one", "two")):
        rails.write_trial(tmp_path / "data", name, rails.arrays_of(seed=seed))
    command = [
        "benchmark",
        "p440",
        "--data",
        str(tmp_path / "data"),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main([*command, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "out" / "p440.json").read_text(encoding="ascii"))
    with Image.open(tmp_path / "out" / "p440.png") as image:
        assert min(image.size) > 400
    rows = printed["reflectors"]
    assert [row["reflector"] for row in rows[::2]] == [
        "one left",
        "one right",
        "two left",
        "two right",
    ]
    for row in rows:
        corner_m = rails.CORNERS_M[row["reflector"].split()[1]]
        by_motion = row["clock"] == "motion"
        # By 40 weaker echoes around. By motion the clock is some 20 ms off, at up to 0.9 m/s.
        assert row["focus"]["coherence"] > (0.9 if by_motion else 0.97)
        assert row["focus"]["to_apex_m"] < (0.02 if by_motion else 0.003)
        assert row["focus"]["over_median_db"] > row["focus"]["incoherent_db"] + 20.0
        np.testing.assert_allclose(row["peak_m"], corner_m, atol=0.02 if by_motion else 0.003)
        assert row["clock_s"] == pytest.approx(rails.CLOCK_NS * 1e-9, abs=0.03 * by_motion)
        own, other = row["reflector"], row["reflector"].replace("one", "TWO")
        other = other.replace("two", "one").replace("TWO", "two")
        assert row["apex_of"] == (other if by_motion else own)
    lost = rows[0]["loss_db"]
    assert lost["10 mm, autofocus"] < lost["10 mm"]


def test_an_echo_is_as_wide_as_its_pulse_and_the_aperture_allow(tmp_path: Path) -> None:
    trial = read_trial(rails.write_trial(tmp_path, "one", rails.arrays_of()))
    name, _, apex_m = trial.reflectors[0]
    found = focus(trial, "given", rails.CLOCK_NS, (name, apex_m))["focus"]
    # Envelope exp(-x**2 / 2 s**2) is 0.708 at 0.83 s; equalised, it is a little narrower or wider.
    assert found["along_m"] == pytest.approx(2 * 0.8326 * rails.SIGMA_M, rel=0.25)
    # A sinc of sin(bearing): 0.886 half wavelengths R / L, L across the line of sight
    _, aperture = trial.image(rails.CLOCK_NS)
    sights = apex_m - aperture.antennas_m
    bearings = np.arctan2(sights[:, 1], np.hypot(sights[:, 0], sights[:, 2]))
    spread = np.sin(bearings).max() - np.sin(bearings).min()
    assert found["across_m"] == pytest.approx(0.886 * rails.HALF_WAVE_M / spread, rel=0.15)
    assert found["incoherent_m"] is None or found["incoherent_m"] > 5 * found["across_m"]


def test_phases_that_turn_the_other_way_do_not_focus(tmp_path: Path) -> None:
    trial = read_trial(rails.write_trial(tmp_path, "one", rails.arrays_of()))
    profiles, aperture = trial.image(rails.CLOCK_NS)
    turned = replace(profiles, values=np.conj(profiles.values))
    for _, _, apex_m in trial.reflectors:
        right, wrong = (coherent((each, aperture), apex_m) for each in (profiles, turned))
        assert wrong < 0.2 * right


def test_with_another_lever_a_reflector_is_elsewhere(tmp_path: Path) -> None:
    longer = (rails.LEVER_M + np.array([0.0, 0.3, 0.0])).tolist()
    arrays = rails.arrays_of() | {"meta": rails.meta_of(lever_m=longer)}
    trial = read_trial(rails.write_trial(tmp_path, "lever", arrays))
    # The radar is thought to be 0.3 m along its own y, which does not turn: so is what it sees.
    moved_m = rails.TURN.apply([0.0, 0.3, 0.0])
    name, _, apex_m = trial.reflectors[0]
    found = focus(trial, "given", rails.CLOCK_NS, (name, apex_m + moved_m))
    assert found["focus"]["coherence"] > 0.97
    np.testing.assert_allclose(found["peak_m"][:2], (apex_m + moved_m)[:2], atol=0.003)


def test_coherence_is_of_phases_and_not_of_amplitudes() -> None:
    metres = np.full(1000, 0.001)
    amplitudes = np.linspace(1.0, 9.0, 1000)
    assert coherence(amplitudes * np.exp(0.4j), metres) == pytest.approx(1.0)
    turned = np.exp(2j * np.pi * np.arange(1000) / 1000)
    assert coherence(turned, metres) == pytest.approx(0.0, abs=1e-3)
    # Over a quarter of a turn: sin(pi / 4) / (pi / 4)
    assert coherence(turned, metres, 0.25) == pytest.approx(np.sinc(0.25), abs=2e-3)


def test_the_width_is_where_a_cut_crosses_3_db() -> None:
    x = 0.002 * np.arange(-1000, 1001)
    assert width_m(np.exp(-0.5 * (x / 0.05) ** 2)) == pytest.approx(
        2 * 0.05 * np.sqrt(np.log(2)), rel=1e-3
    )
    assert width_m(np.ones(2001)) is None


def test_a_spoilt_path_has_the_scale_and_the_walk_that_are_asked_for() -> None:
    straight = np.column_stack([np.zeros(1001), np.linspace(0.0, 4.0, 1001), np.ones(1001)])
    scaled = spoilt(straight, 0.01, 0.0, seed=0)
    np.testing.assert_allclose(scaled[:, 1] - 2.0, 1.01 * (straight[:, 1] - 2.0), atol=1e-12)
    ends = [spoilt(straight, 0.0, 0.01, seed)[[0, -1]] - straight[[0, -1]] for seed in range(400)]
    # Two metres to either end: 10 mm times the root of two
    assert np.std(np.array(ends)[..., :2]) == pytest.approx(0.01 * np.sqrt(2.0), rel=0.1)
    assert np.all(np.array(ends)[..., 2] == 0.0)


def without(name: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda arrays: {key: value for key, value in arrays.items() if key != name}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (without("pose_xyzw"), "pose_xyzw"),
        (without("meta"), "meta"),
        (lambda a: a | {"pose_m": a["pose_m"][:-1]}, "pose_m"),
        (lambda a: a | {"samples": a["samples"][0]}, "samples"),
        (lambda a: a | {"meta": rails.meta_of(lever_m=None)}, "lever_m"),
        (lambda a: a | {"meta": rails.meta_of(use={})}, "background_box_m"),
        (lambda a: a | {"meta": np.array("{")}, "line 1"),
        (lambda a: a | {"meta": np.array("[]")}, "list"),
        (lambda a: a | {"meta": rails.meta_of(range_offset_m=float("nan"))}, "reach"),
        (lambda a: a | {"meta": rails.meta_of(use=rails.use_of(1e6))}, "background_box_m"),
        (lambda a: a | {"meta": rails.meta_of(range_offset_m=-50.0)}, "reach"),
        (lambda a: a | {"reflector_apex_m": a["reflector_apex_m"] + 90.0}, "reach"),
        (lambda a: a | {"meta": rails.meta_of(reflectors=[])}, "reflectors"),
        (lambda a: a | {"meta": rails.meta_of(clock_offset_ns=0)}, "clock_offset_ns"),
        (lambda a: a | {"meta": rails.meta_of(clock_offset_ns=10**30)}, "large"),
        (lambda a: a | {"bin_length_m": np.array(0.0)}, "bin_length_m"),
        (lambda a: a | {"bin_length_m": np.array(1e-12)}, "bin_length_m"),
        (lambda a: a | {"bin_length_m": np.array(1e6)}, "bin_length_m"),
        (lambda a: a | {"t_ns": a["t_ns"][::-1]}, "t_ns"),
        (lambda a: a | {"pose_t_ns": a["pose_t_ns"][::-1]}, "pose_t_ns"),
        (lambda a: a | {"pose_m": np.full_like(a["pose_m"], np.nan)}, "pose_m"),
        (lambda a: a | {"pose_m": np.zeros_like(a["pose_m"])}, "motion"),
        (lambda a: a | {"samples": a["samples"].astype(str)}, "samples"),
    ],
)
def test_what_is_missing_or_wrong_in_a_file_is_named(
    tmp_path: Path, change: Callable[[dict[str, Any]], dict[str, Any]], named: str
) -> None:
    path = rails.write_trial(tmp_path, "bad", change(rails.arrays_of(path=0.2)))
    with pytest.raises(AppError) as caught:
        read_trial(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 cut"])
def test_what_is_no_archive_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "p440_rail_x.npz"
    path.write_bytes(content)
    with pytest.raises(AppError, match="p440_rail_x"):
        read_trial(path)


def test_a_folder_without_trials_ends_the_command(tmp_path: Path) -> None:
    assert main(["benchmark", "p440", "--data", str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert not (tmp_path / "out").exists()


def test_a_trial_of_three_scans_ends_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arrays = rails.arrays_of()
    few = {name: arrays[name][300:303] for name in ("samples", "t_ns")}
    rails.write_trial(tmp_path, "few", arrays | few)
    assert main(["benchmark", "p440", "--data", str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert "few" in capsys.readouterr().err


def check_focus(row: dict[str, Any], least_coherence: float, widest_m: float) -> None:
    """Check the bounds of the README beside the data."""
    found = row["focus"]
    assert found["coherence"] >= least_coherence
    assert found["across_m"] <= widest_m
    assert found["over_median_db"] > found["incoherent_db"] + 20.0
    assert found["to_apex_m"] < 0.02


@pytest.mark.parametrize(
    ("name", "least_coherence", "widest_m"),
    [
        ("2019-07-23_a corner", 0.95, 0.06),
        ("2019-07-23_b corner", 0.95, 0.06),
        ("2019-07-24 left", 0.93, 0.10),
        ("2019-07-24 right", 0.85, 0.10),
    ],
)
def test_real_scans_focus(name: str, least_coherence: float, widest_m: float) -> None:
    trial = read_trial(shared_data("p440_2019") / f"p440_rail_{name.split()[0]}.npz")
    (apex_m,) = (apex_m for each, _, apex_m in trial.reflectors if each == name)
    offset_ns = trial.meta["clock_offset_ns"]
    check_focus(focus(trial, "given", offset_ns, (name, apex_m)), least_coherence, widest_m)
    # 0.1 s beside its time, what rolls with changing speed is out of focus.
    if name.startswith("2019-07-24"):
        late = focus(trial, "late", offset_ns + 100_000_000, (name, apex_m))
        assert late["focus"]["coherence"] < 0.6


@pytest.mark.rare
@pytest.mark.slow
def test_real_scans_focus_with_nothing_fitted_on_them_and_on_spoilt_paths() -> None:
    folder = shared_data("p440_2019")
    rows = evaluate([read_trial(path) for path in sorted(folder.glob("*.npz"))], StopFlag())
    for row in rows:
        if row["clock"] == "motion" and row["apex_of"] != row["reflector"]:
            check_focus(row, 0.95, 0.06)
    assert sum(row["apex_of"] != row["reflector"] for row in rows) == 2
    losses = [row["loss_db"] for row in rows if row["clock"] == "given"]
    assert max(max(each["0.7 %, 2 mm"]) for each in losses) <= 0.5
    lost, left = (
        np.mean([each[name] for each in losses]) for name in ("10 mm", "10 mm, autofocus")
    )
    assert lost > 1.0
    assert left < 0.5 * lost
