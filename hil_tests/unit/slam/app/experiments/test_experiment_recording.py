"""The recording experiment: its statistics on known signals, and emulated beside real frames."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.paths import REPOSITORY
from hil_tests.unit.slam.app.sessions import session_info
from slam.app.cli import main
from slam.app.experiments.recording import (
    FAR_BINS,
    SlowTime,
    emulate,
    equivalent_scene,
    read_slow_time,
    spread_of,
)
from slam.app.odometry.track import OdometryTrack
from slam.app.odometry.tum import TumSample
from slam.app.session.log import SessionLog

SIGMA = 3e-5
SEEDS = range(6)


def shared_recording() -> Path:
    named = os.environ.get("XETHRU_SHARED_DATA")
    shared = Path(named) if named else REPOSITORY.parent / "shared" / "data"
    path = shared / "x4_baseband_iq_2017"
    if not path.is_dir():
        pytest.skip(f"no recording {path}: set XETHRU_SHARED_DATA to the folder that holds it")
    return path


def frames_of(iq: NDArray[Any]) -> SlowTime:
    return SlowTime(iq=iq.astype(np.complex128), rate_hz=17.0, first_bin_m=0.3, bin_length_m=0.05)


@pytest.fixture(scope="module")
def white() -> SlowTime:
    rng = np.random.default_rng(11)
    iq = SIGMA * (rng.normal(size=(4000, 40)) + 1j * rng.normal(size=(4000, 40)))
    iq[:, 4] += 0.02
    return frames_of(iq)


def test_of_a_session_of_several_radars_one_is_chosen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The remedy that is offered works: what is missing then are frames."""
    session = tmp_path / "session.mcap"
    start = TumSample(t_ns=0, x_m=0.0, y_m=0.0, qz=0.0, qw=1.0)
    SessionLog(session, session_info(), OdometryTrack([start])).close()
    command = ["experiment", "recording", "--out", str(tmp_path), "--recording", str(session)]
    assert main(command) == 1
    assert "choose one: --radar NAME" in capsys.readouterr().err
    assert main([*command, "--radar", "radar0"]) == 1
    assert "0 baseband frames" in capsys.readouterr().err


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
    recorded = read_slow_time(shared_recording())
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
        _, median, _ = spread_of([run[name] for run in runs])
        assert median == pytest.approx(real[name], rel=within), name


def test_white_noise_of_neighbouring_bins_is_as_alike_as_in_the_real_filter() -> None:
    """In the quietest stretch the fast part is the receiver's: it went through the real taps."""
    recorded = read_slow_time(shared_recording())
    real = recorded.quietest().numbers()["far_neighbours_fast"]
    emulated = emulate(equivalent_scene(recorded), recorded, 0).numbers()["far_neighbours_fast"]
    assert emulated == pytest.approx(real, abs=0.06)


def test_the_experiment_leaves_picture_numbers_and_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = shared_recording()
    options = ["--recording", str(recording), "--runs", "2", "--out", str(tmp_path)]
    assert main(["experiment", "recording", *options]) == 0
    numbers = json.loads((tmp_path / "recording.json").read_text())
    assert numbers["frames"] == 514
    assert numbers["recorded"]["far_sigma"] == pytest.approx(1.4e-4, rel=0.01)
    assert (tmp_path / "recording.png").read_bytes().startswith(b"\x89PNG")
    assert "ten farthest bins" in capsys.readouterr().out


def test_a_missing_recording_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = tmp_path / "nowhere"
    code = main(
        ["experiment", "recording", "--recording", str(missing), "--out", str(tmp_path / "out")]
    )
    said = capsys.readouterr().err.strip()
    assert code == 1
    assert str(missing) in said
    assert "\n" not in said
