"""Emulated frames of a scene that is like a recorded module, against the figures of the recording.

`FIGURES` states them anew: `bare_x4` as the table of its recording has them, the others as
`docs/studies/receiver_figures.py` measures them where the recordings are.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import hilbert
from scipy.stats import norm

from emulator.echo.echo import SceneEcho, echo_source
from emulator.echo.pulse import sum_of_pulses
from emulator.echo.receiver import CarrierJitter
from emulator.scene.scene import (
    RECORDED,
    JitterSpec,
    LeakageSpec,
    NoiseSpec,
    PulseSpec,
    RecordedTable,
    Scene,
    SceneError,
    load_scene,
)
from hil_tests.paths import real_raw_recording, real_recording, study
from hil_tests.unit.emulator.rooms import C_MPS, PAPER, radar_at, room, target
from xethru_protocol.processing.downconversion import downconvert

Floats = NDArray[np.float64]

RATE_HZ = 23.328e9
M_PER_SAMPLE = C_MPS / 2 / RATE_HZ
SIGMA_M = 0.0517  # of the nominal pulse, over range
WIDE = replace(PAPER, first_sample_m=0.18, n_samples=1000, dac_min=0, dac_max=2047)
TABLES: dict[str, type[RecordedTable]] = {
    "noise": NoiseSpec,
    "leakage": LeakageSpec,
    "jitter": JitterSpec,
    "pulse": PulseSpec,
}


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """Amplitudes are of RF samples; a pair holds what a figure lies between."""

    noise: float  # at 16 x 300
    centre_hz: tuple[float, float]
    width_hz: tuple[float, float]
    peak: float  # of the leakage
    decay_db: tuple[tuple[float, float], ...]  # behind that peak, at 0.15, 0.25 and 0.4 m
    white_rad: float
    amplitude_jitter: tuple[float, float]


FIGURES = {
    "x4m03_2025": Recorded(
        noise=1.78e-5,
        centre_hz=(7.29e9 - 75e6 - 47e6, 7.29e9 - 75e6 + 47e6),
        width_hz=(1.4e9 / 1.17, 1.4e9 / 1.07),
        peak=0.067,
        decay_db=((-16.2, -14.2), (-19.4, -17.4), (-23.2, -21.2)),
        white_rad=0.0031,
        amplitude_jitter=(0.0011, 0.0011),
    ),
    "x4_2017": Recorded(
        noise=2.43e-5,
        centre_hz=(7.29e9 - 78e6 - 61e6, 7.29e9 - 78e6 + 61e6),
        width_hz=(1.4e9 / 1.32, 1.4e9 / 0.82),
        peak=0.046,
        decay_db=((-17.5, -15.5), (-19.9, -17.9), (-22.6, -20.6)),
        white_rad=0.0011,
        amplitude_jitter=(0.0006, 0.0006),
    ),
    "bare_x4": Recorded(
        noise=5e-4 / 16,
        centre_hz=(7.07e9, 7.13e9),
        width_hz=(1.28e9, 1.31e9),
        peak=0.54,
        decay_db=((-14, -7), (-19, -10), (-23, -16)),
        white_rad=0.004,
        amplitude_jitter=(0.0033, 0.0051),
    ),
}
NAMES = pytest.mark.parametrize("name", FIGURES)


def like(table: str, name: str) -> Any:  # noqa: ANN401 - the model of the table
    return TABLES[table].model_validate({"like": name})


def counters(scene: Scene, n_frames: int) -> Floats:
    """Return frames as the chip counts them, in normalised units."""
    indices = np.arange(n_frames, dtype=np.int64)
    counts = echo_source(scene, 0, 5).rf_counters(WIDE, indices, indices * 58_000_000)
    return counts / (1024 * WIDE.iterations * WIDE.pulses_per_step) - 1


def test_every_recording_has_its_figures() -> None:
    assert FIGURES.keys() == RECORDED.keys()


@NAMES
def test_noise_per_sample(name: str) -> None:
    scene = room(radar_at(0, 0, 0)).model_copy(update={"noise": like("noise", name)})
    frames = counters(scene, 40)
    # 40 000 samples: a standard error of 0.35 %
    assert frames.std() == pytest.approx(FIGURES[name].noise, rel=0.03)
    of_lags = [(frames[:, :-k] * frames[:, k:]).mean() for k in (1, 2, 8)]
    assert np.abs(of_lags).max() < 0.025 * frames.var()


@NAMES
def test_centre_and_width_of_the_spectrum_of_an_echo(name: str) -> None:
    """Centroid and width of what is within 10 dB of the spectrum's peak."""
    radar = radar_at(0, 0, 0, pulse={"like": name})
    frame = SceneEcho(room(radar, targets=(target(2.0, 0.0),)), radar, 0).echo(WIDE, np.array([0]))
    power = np.abs(np.fft.rfft(frame[0], 1 << 16)) ** 2
    frequency_hz = np.fft.rfftfreq(1 << 16, 1 / RATE_HZ)
    within = power >= power.max() / 10
    band_hz = frequency_hz[within]
    centre_hz = np.average(band_hz, weights=power[within])
    low, high = FIGURES[name].centre_hz
    assert low <= centre_hz <= high
    low, high = FIGURES[name].width_hz
    assert low <= band_hz[-1] - band_hz[0] <= high


def test_the_pulse_of_a_bare_board_is_a_third_off_the_nominal_one() -> None:
    """What is left of it beside the nominal pulse that fits best: .30 to .43 of its amplitude."""
    radar = radar_at(0, 0, 0, pulse={"like": "bare_x4"})
    scene = room(radar, targets=(target(2.0, 0.0),))
    frame = SceneEcho(scene, radar, 0).echo(WIDE, np.array([0]))[0]
    middle = int(np.argmax(np.abs(frame)))
    left = []
    for place in middle + np.arange(-20, 20, 0.1):
        t_s = (np.arange(len(frame)) - place) / RATE_HZ
        pulse = np.exp(-0.5 * (t_s * C_MPS / 2 / SIGMA_M) ** 2 + 2j * np.pi * 7.29e9 * t_s)
        pair = np.column_stack([pulse.real, pulse.imag])
        rest = frame - pair @ np.linalg.lstsq(pair, frame)[0]
        left.append(np.linalg.norm(rest) / np.linalg.norm(frame))
    assert 0.29 <= min(left) <= 0.43


@NAMES
def test_leakage_peaks_and_decays_as_recorded(name: str) -> None:
    radar = radar_at(0, 0, 0, pulse={"like": name})
    leakage = like("leakage", name).model_copy(update={"range_m": 1.5})
    scene = room(radar).model_copy(update={"leakage": leakage})
    frame = SceneEcho(scene, radar, 0).echo(WIDE, np.array([0]))[0]
    envelope = np.abs(hilbert(frame))
    peak = int(np.argmax(envelope))
    assert envelope[peak] == pytest.approx(FIGURES[name].peak, rel=0.06)
    place_m = np.arange(len(envelope)) * M_PER_SAMPLE
    for behind_m, (low, high) in zip((0.15, 0.25, 0.4), FIGURES[name].decay_db, strict=True):
        there = np.interp(place_m[peak] + behind_m, place_m, envelope)
        assert low <= 20 * math.log10(there / envelope[peak]) <= high


def test_ringing_leakage_is_the_pulse_convolved_with_a_damped_carrier() -> None:
    """Its envelope is an exponentially modified Gaussian: R. Jeansonne, J. Foley (1991), eq. 2."""
    radar = radar_at(0, 0, 0)
    ringing, ringing_m = 0.5, 0.25
    leakage = LeakageSpec(amplitude=0.1, range_m=1.5, ringing=ringing, ringing_m=ringing_m)
    scene = room(radar).model_copy(update={"leakage": leakage})
    frame = SceneEcho(scene, radar, 0).echo(WIDE, np.array([0]))[0]
    # c / 2 for true metres; sample 0 lies at the label 0.18 in module metres
    x = np.arange(len(frame)) * M_PER_SAMPLE + 0.18 * C_MPS / 3e8 - 1.5
    tail = np.exp(SIGMA_M**2 / (2 * ringing_m**2) - x / ringing_m)
    tail *= norm.cdf(x / SIGMA_M - SIGMA_M / ringing_m)
    expected = 0.1 * (np.exp(-0.5 * (x / SIGMA_M) ** 2) + ringing * tail)
    got = np.abs(hilbert(frame))
    # where it begins, steps of a deviation show: 0.5 % of the peak
    np.testing.assert_allclose(got[30:500], expected[30:500], atol=7e-4)
    tail_only = (x > 0.25) & (x < 1.2)
    np.testing.assert_allclose(got[tail_only], expected[tail_only], rtol=2e-3)


@NAMES
def test_amplitude_and_phase_jitter(name: str) -> None:
    """Of a strong echo without noise, by projection on its mean: 400 frames."""
    scene = room(radar_at(0, 0, 0), targets=(target(2.0, 0.0, amplitude_1m=1.0),))
    jitter = like("jitter", name).model_copy(update={"slow_rad": 0.0})
    frames = counters(scene.model_copy(update={"jitter": jitter}), 400)
    analytic = hilbert(frames)
    echo = analytic @ analytic.mean(axis=0).conj()
    low, high = FIGURES[name].amplitude_jitter
    # a standard error of 3.5 %
    spread = np.abs(echo).std() / np.abs(echo).mean()
    assert 0.88 * low <= spread <= 1.12 * high
    assert np.angle(echo / echo.mean()).std() == pytest.approx(FIGURES[name].white_rad, rel=0.12)


def test_amplitude_jitter_is_common_to_a_frame_and_selected_by_its_counter() -> None:
    spec, n = JitterSpec(amplitude=0.05), 30
    indices = np.arange(n, dtype=np.int64)
    whole = np.ones((n, 3))
    CarrierJitter(spec, seed=2, serial=7).scale(whole, indices)
    assert (whole == whole[:, :1]).all()
    assert len(np.unique(whole)) == n
    one_by_one = CarrierJitter(spec, seed=2, serial=7)
    for index in np.random.default_rng(0).permutation(n).tolist():
        alone = np.ones((1, 3))
        one_by_one.scale(alone, indices[index : index + 1])
        assert alone.tobytes() == whole[index : index + 1].tobytes()
    for seed, serial in ((3, 7), (2, 8)):
        other = np.ones((n, 3))
        CarrierJitter(spec, seed=seed, serial=serial).scale(other, indices)
        assert not (other == whole).any()


def test_amplitude_and_phase_jitter_are_independent() -> None:
    jitter = CarrierJitter(JitterSpec(white_rad=0.1, amplitude=0.05), seed=2, serial=7)
    indices, frames = np.arange(1000, dtype=np.int64), np.ones((1000, 1))
    jitter.scale(frames, indices)
    phases = jitter.phases_rad(indices, indices * 58_000_000)
    assert abs(np.corrcoef(frames[:, 0], phases)[0, 1]) < 0.13  # 4 standard errors


HEAD = 'name = "mine"\nenvironment = "lab"\ndescription = "a scene"\n'
RADAR = '[[radars]]\nname = "left"\nserial = "000000000001"\nx_m = 0.0\ny_m = 0.2\nyaw_deg = 90.0\n'


def scene_of(folder: Path, table: str, keys: str) -> Scene:
    """Return the scene of a file in which a table has these lines."""
    place = "radars.pulse" if table == "pulse" else table
    path = folder / "mine.toml"
    path.write_text(f"{HEAD}{RADAR}[{place}]\n{keys}\n")
    return load_scene(path)


@pytest.mark.parametrize("table", TABLES)
def test_like_is_the_same_as_its_keys(table: str, tmp_path: Path) -> None:
    for name, tables in RECORDED.items():
        keys = "\n".join(f"{key} = {value}" for key, value in tables[table].items())
        scene = scene_of(tmp_path, table, f'like = "{name}"')
        assert scene == scene_of(tmp_path, table, keys)
        assert Scene.model_validate(scene.model_dump()) == scene
        model = TABLES[table]
        assert model().recorded(name) == model.model_validate(tables[table])


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("value", ['"x4m03"', '"X4_2017"', "3", '["x4_2017"]', '""', "true"])
def test_a_recording_that_there_is_not_is_refused(table: str, value: str, tmp_path: Path) -> None:
    with pytest.raises(SceneError) as caught:
        scene_of(tmp_path, table, f"like = {value}")
    message = str(caught.value)
    assert "\n" not in message
    assert f"{table}: like: " in message
    assert all(name in message for name in RECORDED)


@pytest.mark.parametrize("table", TABLES)
def test_a_key_beside_like_is_refused_if_the_recording_has_it(table: str, tmp_path: Path) -> None:
    key, value = next(iter(RECORDED["bare_x4"][table].items()))
    with pytest.raises(SceneError, match=rf"{table}: {key}: "):
        scene_of(tmp_path, table, f'like = "bare_x4"\n{key} = {value}')


def test_a_key_beside_like_that_the_recording_lacks_is_taken(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, "leakage", 'like = "x4_2017"\nrange_m = 0.33')
    assert (scene.leakage.range_m, scene.leakage.amplitude) == (0.33, 0.041)


def test_what_is_measured_is_what_was_emulated() -> None:
    """Leakage, noise and jitter alone, and then echoes at random places, new in every frame."""
    name, n_quiet, n = "x4m03_2025", 80, 500
    radar = radar_at(0, 0, 0, pulse={"like": name})
    # on sample 39.5, where line 5 is centred
    leakage = like("leakage", name).model_copy(
        update={"range_m": 0.18 * C_MPS / 3e8 + 39.5 * M_PER_SAMPLE}
    )
    tables = {table: like(table, name) for table in ("noise", "jitter")}
    scene = room(radar).model_copy(update={**tables, "leakage": leakage})
    indices = np.arange(n, dtype=np.int64)
    counts = echo_source(scene, 0, 1).rf_counters(WIDE, indices, indices * 58_000_000)
    frame = np.repeat(np.arange(n_quiet, n), 40)
    rng = np.random.default_rng(3)
    echoes = sum_of_pulses(
        frame=frame,
        position=rng.uniform(-50, WIDE.n_samples + 50, len(frame)),
        amplitude=1e-3 * rng.normal(size=len(frame)),
        phase_rad=rng.uniform(0, math.tau, len(frame)),
        tx_center_frequency=3,
        shape=counts.shape,
        pulse=like("pulse", name),
    )
    one_count = 1 / (1024 * WIDE.iterations * WIDE.pulses_per_step)
    rf = (counts + np.rint(echoes / one_count)) * one_count
    found = study("receiver_figures").figures_of(downconvert(rf)[:, 3:])
    assert found.pulses == 4800
    assert found.noise == pytest.approx(1.8e-5, rel=0.05)
    assert found.white_rad == pytest.approx(0.0031, rel=0.25)  # 64 frames: 10 %
    assert found.amplitude_white == pytest.approx(0.0011, rel=0.25)
    assert found.leakage == pytest.approx(0.059, rel=0.03)
    assert found.ringing == pytest.approx(0.25, rel=0.05)
    assert found.ringing_m == pytest.approx(0.35, rel=0.05)
    assert found.carrier_offset_hz[0] == pytest.approx(-7.5e7, abs=1e7)
    assert found.width[0] == pytest.approx(1.12, abs=0.02)


@pytest.mark.parametrize("name", ["x4m03_2025", "x4_2017"])
def test_figures_are_those_of_the_recording(name: str) -> None:
    """Values that a scene takes are rounded."""
    measured = study("receiver_figures").measure(
        real_raw_recording() if name == "x4m03_2025" else real_recording()
    )
    tables = RECORDED[name]
    if name == "x4m03_2025":
        # values are whole counts of that many pulses, the working point that is written down
        assert measured.pulses == tables["noise"]["iterations"] * tables["noise"]["pulses_per_step"]
    else:
        assert measured.pulses is None
    jitter, leakage, pulse = (tables[table] for table in ("jitter", "leakage", "pulse"))
    for got, stated, within in (
        (measured.noise, tables["noise"]["rf_sigma"], 0.02),
        (measured.white_rad, jitter["white_rad"], 0.02),
        (measured.phase_rad, math.hypot(jitter["white_rad"], jitter["slow_rad"]), 0.02),
        (measured.amplitude_white, jitter["amplitude"], 0.03),
        (measured.leakage, leakage["amplitude"], 0.02),
        (measured.ringing, leakage["ringing"], 0.03),
        (measured.ringing_m, leakage["ringing_m"], 0.03),
    ):
        assert stated == pytest.approx(got, rel=within)
    offset_hz, spread_hz = measured.carrier_offset_hz
    assert pulse["carrier_offset_hz"] == pytest.approx(offset_hz, abs=1e6)
    assert spread_hz < 8e7
    assert pulse["width"] == pytest.approx(measured.width[0], abs=0.005)
