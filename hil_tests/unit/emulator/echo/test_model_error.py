"""Laws of model error against their closed forms, in the paths and in frames."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import hilbert

from emulator.echo.echo import SceneEcho, ScenePaths
from emulator.scene.scene import (
    BurstSpec,
    ClutterSpec,
    JitterSpec,
    MultipathSpec,
    PathSpec,
    PulseSpec,
    RadarSpec,
    Scene,
    WanderSpec,
)
from hil_tests.unit.emulator.rooms import C_MPS, PAPER, WAVELENGTH_M, heard, radar_at, room, target

N_SIDES = 360
DRIVING = PathSpec(waypoints_m=((0.0, 0.0), (9.0, 0.0)), laps=("forward",), speed_mps=0.5)
WANDER = {"range_m": 0.003, "inside_m": 0.02, "fading": 0.4, "phase_rad": 1.0}
SAMPLES_PER_M = 2 * 23.328e9 / C_MPS


def all_round(spec: WanderSpec, *, seed: int = 0, name: str = "rod") -> NDArray[np.float64]:
    """Return range, amplitude and phase of a rod, less those of the ideal one, from 1 m all round.

    Shape (3, N_SIDES); amplitudes are divided by the ideal ones.
    """
    rows = []
    for side in np.arange(N_SIDES) * math.tau / N_SIDES:
        radar = radar_at(math.cos(side), math.sin(side), math.degrees(side) - 180)
        rod = target(0.0, 0.0, "rod", name=name)
        ideal, real = (
            ScenePaths(scene, radar, seed).reflections(np.array([0]), WAVELENGTH_M)
            for scene in (
                room(radar, targets=(rod,)),
                room(radar, targets=(rod.model_copy(update={"wander": spec}),)),
            )
        )
        phase_rad = np.broadcast_to(real.phase_rad, real.range_m.shape)
        rows.append(
            (
                real.range_m[0, 0] - ideal.range_m[0, 0],
                real.amplitude[0, 0] / ideal.amplitude[0, 0],
                phase_rad[0, 0] - ideal.phase_rad[0],
            )
        )
    return np.array(rows).T


def harmonics(values: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the amplitudes of cos(k beta + phi), as A exp(i phi), k = 0, 1, ..."""
    spectrum: NDArray[np.complex128] = np.fft.rfft(values) / (N_SIDES / 2)
    spectrum[0] /= 2
    return spectrum


def test_the_scattering_centre_wanders_with_the_bearing() -> None:
    """The Fourier series of the law is its own: harmonics 2 and 5, 3 and 9, 4."""
    range_m, amplitude, phase_rad = map(harmonics, all_round(WanderSpec(**WANDER), seed=3))
    for got, expected in (
        (range_m, {0: -0.02, 2: 0.7 * 0.003, 5: 0.5 * 0.003}),
        (amplitude, {0: 1.0, 3: 0.4, 9: 0.2}),
        (phase_rad, {4: 1.0}),
    ):
        sizes = np.zeros(len(got))
        sizes[list(expected)] = np.abs(list(expected.values()))
        np.testing.assert_allclose(abs(got), sizes, atol=1e-12)
    assert range_m[0].real < 0
    # the phase's harmonic shares phi_1 with the first one of the range
    assert np.angle(phase_rad[4]) == pytest.approx(np.angle(range_m[2]), abs=1e-9)


def test_an_echo_keeps_a_tenth_where_it_fades_most() -> None:
    _, amplitude, _ = all_round(WanderSpec(fading=1.0), seed=3)
    assert amplitude.min() == pytest.approx(0.1)


def test_phases_of_the_wander_are_uniform_and_belong_to_target_and_seed() -> None:
    """Means of cos(phi) and sin(phi) of n uniform phases have the deviation 1 / sqrt(2 n)."""
    radar = radar_at(0, 0, 0)
    wander = WanderSpec(range_m=0.01)
    rods = tuple(target(2.0, 0.0, "rod", name=f"rod_{i}", wander=wander) for i in range(200))
    by_seed = []
    for seed in (0, 1):
        turned = [
            ScenePaths(room(each, targets=rods), each, seed)
            .reflections(np.array([0]), WAVELENGTH_M)
            .range_m[0, :200]
            for each in (radar, radar.model_copy(update={"serial": "000000000008"}))
        ]
        np.testing.assert_array_equal(turned[0], turned[1])  # the same body for every radar
        by_seed.append(turned[0] - 2.0)
    values: NDArray[np.float64] = np.concatenate(by_seed)
    # variance of 0.7 cos + 0.5 cos, independent: (0.49 + 0.25) / 2
    assert values.mean() == pytest.approx(0.0, abs=4 * 0.01 * math.sqrt(0.37 / 400))
    assert values.std() == pytest.approx(0.01 * math.sqrt(0.37), rel=0.1)
    assert abs(np.corrcoef(by_seed[0], by_seed[1])[0, 1]) < 4 / math.sqrt(200)


def test_a_frames_echo_moves_as_its_path_does() -> None:
    """The centroid of the squared envelope, in samples, against the paths' range."""
    radar = radar_at(0, 0, 0)
    rod = target(2.0, 0.3, "rod", amplitude_1m=0.05)
    moved = rod.model_copy(update={"wander": WanderSpec(range_m=0.003)})
    places, ranges = [], []
    for each in (rod, moved):
        scene = room(radar, targets=(each,))
        paths = ScenePaths(scene, radar, 4).reflections(np.array([0]), WAVELENGTH_M)
        ranges.append(float(paths.range_m[0, 0]))
        frame = SceneEcho(scene, radar, 4).echo(PAPER, np.array([0]))[0]
        energy = np.abs(hilbert(frame)) ** 2
        places.append(float((np.arange(len(frame)) * energy).sum() / energy.sum()))
    shift_m = ranges[1] - ranges[0]
    assert 0 < abs(shift_m) <= 0.003 * 1.2
    assert (places[1] - places[0]) / SAMPLES_PER_M == pytest.approx(shift_m, abs=1e-5)


def test_targets_closer_than_a_metre_echo_by_way_of_each_other() -> None:
    rods = (
        target(2.0, 0.0, "rod", name="a"),
        target(2.0, 0.4, "rod", name="b", amplitude_1m=0.02),
        target(2.0, -0.9, "rod", name="c"),
    )
    radar = radar_at(0, 0, 0)
    alone = heard(radar, targets=rods)
    both = heard(radar, targets=rods, multipath=MultipathSpec(target_pairs=0.25))
    # a-b and a-c are near enough, b-c is 1.3 m apart
    assert len(both.range_m) == len(alone.range_m) + 2
    of = {
        name: (range_m, amplitude, phase_rad)
        for name, range_m, amplitude, phase_rad in zip(
            "abc", alone.range_m, alone.amplitude, alone.phase_rad, strict=True
        )
    }
    for other, distance_m in (("b", 0.4), ("c", 0.9)):
        at_m = (of["a"][0] + of[other][0] + distance_m) / 2
        row = int(np.flatnonzero(abs(both.range_m - at_m) < 1e-9)[0])
        assert both.amplitude[row] == pytest.approx(
            0.25 * math.sqrt(of["a"][1] * of[other][1]) * math.sqrt(0.1 / distance_m)
        )
        apart = both.phase_rad[row] - of["a"][2] - of[other][2]
        assert math.remainder(apart, math.tau) == pytest.approx(0.0, abs=1e-9)


def frames_of(radar: RadarSpec, n_frames: int, **parts: Any) -> NDArray[np.float64]:  # noqa: ANN401 - tables of a scene
    """Return frames in normalised units; the DAC takes all of it."""
    capture = replace(PAPER, dac_min=0, dac_max=2047)
    indices = np.arange(n_frames, dtype=np.int64)
    counts = SceneEcho(room(radar, **parts), radar, 9).rf_counters(
        capture, indices, indices * 200_000_000
    )
    quiet = SceneEcho(room(radar_at(0, 0, 0)), radar_at(0, 0, 0), 9).rf_counters(
        capture, indices[:1], indices[:1]
    )
    values: NDArray[np.float64] = (counts - quiet) / (16 * 300 * 1024)
    return values


def test_other_modules_send_pulses_into_a_seventh_of_the_frames() -> None:
    n = 3000
    frames = frames_of(radar_at(0, 0, 0, bursts=BurstSpec(echo_share=0.15)), n)
    peaks = np.abs(hilbert(frames, axis=1)).max(axis=1)
    hit = np.abs(frames).max(axis=1) > 1e-4
    assert hit.mean() == pytest.approx(0.15, abs=4 * math.sqrt(0.15 * 0.85 / n))
    # two of 1 to 3 pulses a frame on average: their energy in amplitudes squared, of a lognormal
    # exp(2 0.6**2) 0.015**2; a pulse's energy is A**2 sqrt(pi) sigma / 2, sigma 8.05 samples
    energy = (frames[hit] ** 2).sum(axis=1)
    of_one = 0.015**2 * math.exp(2 * 0.6**2) * math.sqrt(math.pi) * 8.0485 / 2
    assert energy.mean() == pytest.approx(2 * of_one, rel=0.25)
    # a frame's largest is at least one pulse: a quarter of single pulses lie below 0.010
    assert 0.010 < np.median(peaks[hit]) < 0.035
    assert (np.diff(np.flatnonzero(hit)) == 1).mean() == pytest.approx(0.15, abs=0.07)
    # uniform over the frame: thirds of the energy's places
    places = np.abs(frames[hit]).argmax(axis=1)
    thirds = np.histogram(places, bins=3, range=(0, frames.shape[1]))[0] / hit.sum()
    np.testing.assert_allclose(thirds, 1 / 3, atol=4 * math.sqrt(2 / 9 / hit.sum()))


def test_other_modules_noise_is_in_a_twentieth_of_the_frames() -> None:
    n = 2000
    frames = frames_of(radar_at(0, 0, 0, bursts=BurstSpec(noise_share=0.05)), n)
    hit = frames.any(axis=1)
    assert hit.mean() == pytest.approx(0.05, abs=4 * math.sqrt(0.05 * 0.95 / n))
    noise = frames[hit]
    assert noise.std() == pytest.approx(2.5e-3, rel=4 / math.sqrt(2 * noise.size))
    assert abs(np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1]) < 0.02


def test_what_a_frame_holds_does_not_depend_on_the_others() -> None:
    """Also where frames are taken in another order than that of their indices."""
    bursts = BurstSpec(echo_share=0.5, noise_share=0.5)
    radar = radar_at(0, 0, 0, bursts=bursts, stamp_sigma_ms=200.0)
    slow = {"clutter": ClutterSpec(sigma=5e-4), "jitter": JitterSpec(white_rad=0.1, slow_rad=0.1)}
    echo = SceneEcho(room(radar, targets=(target(2.0, 0.0, "rod"),), **slow), radar, 9)
    indices = np.arange(12, dtype=np.int64)
    together = echo.rf_counters(PAPER, indices, indices * 10**8)
    for index in (7, 2):
        one = echo.rf_counters(PAPER, indices[[index]], indices[[index]] * 10**8)
        np.testing.assert_array_equal(one[0], together[index])


def test_frames_are_taken_20_ms_off_the_time_that_they_carry() -> None:
    """A robot that drives at 0.5 m/s away from its origin: 10 mm of range."""
    radar = radar_at(0, 0, 0, stamp_sigma_ms=20.0)
    n = 1500
    indices = np.arange(n, dtype=np.int64)
    times_ns = 1_000_000_000 + indices * 10_000_000  # within the first leg of 18 s
    scene = room(radar, targets=(target(9.0, 0.0, "rod", amplitude_1m=0.05),), path=DRIVING)
    echo = SceneEcho(scene, radar, 2)
    capture = replace(PAPER, dac_min=0, dac_max=2047)
    counts = echo.rf_counters(capture, indices, times_ns).astype(np.float64)
    counts -= counts[:, -50:].mean(axis=1, keepdims=True)
    energy = np.abs(hilbert(counts, axis=1)) ** 2
    places = (np.arange(counts.shape[1]) * energy).sum(axis=1) / energy.sum(axis=1)
    inside = (places > 60) & (places < counts.shape[1] - 60)
    assert inside.sum() > 1000
    ideal_m = 9.0 - 0.5 * times_ns * 1e-9
    errors_s = (ideal_m - places / SAMPLES_PER_M)[inside] / 0.5
    errors_s -= errors_s.mean()
    assert errors_s.std() == pytest.approx(0.020, rel=4 / math.sqrt(2 * inside.sum()))
    assert abs(np.corrcoef(errors_s[1:], errors_s[:-1])[0, 1]) < 0.13


def test_a_radar_is_where_its_mount_error_puts_it() -> None:
    place = target(2.0, 1.0, "point")
    off = radar_at(0.1, 0.2, 20.0, mount_error_m=(0.005, -0.004), mount_error_deg=1.5)
    got = heard(off, targets=(place,))
    expected = heard(radar_at(0.105, 0.196, 21.5), targets=(place,))
    np.testing.assert_allclose(got.range_m, expected.range_m, rtol=1e-15)
    np.testing.assert_allclose(got.amplitude, expected.amplitude, rtol=1e-14)
    assert got.range_m[0] == pytest.approx(math.hypot(2.0 - 0.105, 1.0 - 0.196), rel=1e-15)


def test_a_radar_receives_its_own_pulse() -> None:
    """The width of an echo's envelope, sqrt of its second moment, grows as the pulse's does."""
    widths = []
    for pulse in (PulseSpec(), PulseSpec(width=1.1)):
        radar = radar_at(0, 0, 0, pulse=pulse)
        scene: Scene = room(radar, targets=(target(2.0, 0.0, "rod", amplitude_1m=0.05),))
        frame = SceneEcho(scene, radar, 0).echo(PAPER, np.array([0]))[0]
        energy = np.abs(hilbert(frame)) ** 2
        energy /= energy.sum()
        samples = np.arange(len(frame))
        centre = (samples * energy).sum()
        widths.append(math.sqrt((((samples - centre) ** 2) * energy).sum()))
    assert widths[1] / widths[0] == pytest.approx(1.1, rel=1e-3)
