"""Draw what the front ends reach beside what no front end can pass.

`limits.png` shows the standard deviation of one echo's range beside the Cramer-Rao bound, the share
of pairs of echoes that are resolved, the share of echoes that are found beside Marcum's, and the
range of an echo beyond the DAC window. The values drawn are printed. All frames are simulated, with
the emulator's pulse, receiver (noise by counter, counting, clipping) and normalisation. Positions
are in bins, s is the envelope's standard deviation in bins, sigma the noise per RF sample.
"""

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.stats import ncx2

from emulator.chip.chip import CaptureSettings
from emulator.echo.pulse import sum_of_pulses
from emulator.echo.receiver import Receiver
from emulator.scene.scene import NoiseSpec, RadarSpec, empty_room
from slam.app.run.output import print_table
from slam.app.run.pictures import ESTIMATE, INK, LANDMARK, ODOMETRY, label, picture
from slam.config import MatchedFilterConfig, SlamConfig, override
from slam.frames import RadarFrame
from slam.front_end import make_detector
from slam.front_end.matched_filter import threshold_sigmas
from slam.front_end.pulse import PulseModel
from slam.live.frame_sources import sampler_limits
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.wire.x4 import Normalisation

Array = NDArray[np.float64]
Row = dict[str, float]  # a number of the bound, and of each front end

N_BINS, RANGE_START_M, BIN_LENGTH_M = 1431, 0.2, 299_792_458.0 / (2 * 23.328e9)
PULSE = PulseModel()
SIGMA_BINS, CARRIER_RAD = PULSE.sigma_bins(BIN_LENGTH_M), PULSE.carrier_rad(BIN_LENGTH_M)
DAC_WINDOW = 0.07421875  # largest amplitude within the DAC sweep of RawConfig
AMPLITUDE, NOISE_SIGMA = 0.015, 5e-4
TOLERANCE_M = 0.02  # how far a resolved echo may be off
MATCH_M = 0.1  # a detection farther off is not the echo's: two envelope sigmas
SNRS_DB = (18, 21, 24, 27, 30, 33, 36, 42, 48)
SEPARATIONS_MM = (30, 40, 50, 60, 70, 80, 90, 100, 120, 140, 160, 180, 200)
STRENGTHS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
LOW_SNRS_DB = (0, 2, 3, 4, 5, 6, 7, 8, 10, 12, 16, 20, 22, 23, 24, 25, 26, 28)
# The matched filter and the joint fit coincide on single echoes: the later one is hollow.
LOOKS: Mapping[str, dict[str, Any]] = {
    "paper": {"color": ODOMETRY, "marker": "s", "markersize": 4},
    "matched_filter": {"color": LANDMARK, "marker": "^", "markersize": 4},
    "joint": {"color": ESTIMATE, "marker": "o", "markersize": 7, "markerfacecolor": "none"},
}


def pair_covariance(
    distance: Array, ratio: float, turn_rad: Array, *, snr: float, envelope_sigma: float
) -> Array:
    """Return the Cramer-Rao bound of the positions of two echoes, amplitudes and phases unknown.

    With d the distance, r = exp(-d**2 / (4 s**2)) the overlap of the pulses, a complex amplitude c
    per echo (that of its envelope on a common carrier) and sums over n taken as integrals over
    Gaussians, the Fisher matrix of the positions once both amplitudes are fitted is

        J_kl = E / sigma**2 Re(conj(c_k) c_l) (M_kl - m_k^T R^-1 m_l),   E = s sqrt(pi) / 2
        M_11 = M_22 = 1 / (2 s**2),   M_12 = r (1 / (2 s**2) - d**2 / (4 s**4))
        R = [[1, r], [r, 1]],   m_1 = (0, q),  m_2 = (-q, 0),   q = r d / (2 s**2)

    with m_k the correlations of the derivative of pulse k by its position with both pulses.

    `distance` (n,) > 0 and `turn_rad` (n,) lead from the first echo to the second, the phase on a
    common carrier; `ratio` is the amplitude of the second over the first, `snr` that of the first
    over sigma. Returns shape (n, 2, 2), squared bins.
    """
    s, d = envelope_sigma, distance
    r = np.exp(-((d / (2 * s)) ** 2))
    q, left = r * d / (2 * s**2), 1 - r**2
    # derivative by u_1 correlates with pulse 2 by +q, derivative by u_2 with pulse 1 by -q
    own = 1 / (2 * s**2) - q**2 / left
    cross = r * (1 / (2 * s**2) - d**2 / (4 * s**4)) - q**2 * r / left
    amplitude = snr**2 * s * np.sqrt(np.pi) / 2
    cross *= ratio * np.cos(turn_rad)
    information = amplitude * np.array([[own, cross], [cross, ratio**2 * own]])
    return np.linalg.inv(np.moveaxis(information, -1, 0))


def detection_probability(snr: Array, threshold_sigmas: float, envelope_sigma: float) -> Array:
    """Return how often the matched filter's output at the echo exceeds a threshold: Marcum's Q.

    `snr` is amplitude over sigma, of any shape; the threshold is in standard deviations of one
    quadrature of the filter's output. The filter gains s sqrt(pi) / 2 in power.
    """
    noncentrality = np.asarray(snr) ** 2 * envelope_sigma * np.sqrt(np.pi) / 2
    return np.asarray(ncx2.sf(threshold_sigmas**2, 2, noncentrality))


def places(n: int, rng: np.random.Generator, *separation_m: float) -> tuple[Array, Array]:
    """Return true ranges and phases of n echoes, or pairs of echoes, anywhere in range and bin."""
    apart_m = np.array([0.0, *separation_m])
    range_m = rng.uniform(0.5, 1.3 - apart_m[-1], (n, 1)) + apart_m
    return range_m, rng.uniform(0, math.tau, range_m.shape)


def chip_frames(
    range_m: Array, phase_rad: Array, *, amplitude: float, noise_sigma: float, seed: int
) -> list[RadarFrame]:
    """Return frames as the emulated chip takes them and the driver reads them.

    Ranges (true) and phases of the carrier at the pulse's centre are of shape (frames, echoes), the
    amplitude is the envelope's peak and `noise_sigma` per RF sample, both in normalised units.
    """
    config, (n, k), period_ns = RawConfig(), range_m.shape, 200_000_000
    names = ("iterations", "pulses_per_step", "dac_min", "dac_max", "dac_step")
    sweep: dict[str, int] = {name: getattr(config, name) for name in names}
    chip = sweep | {name: getattr(config, name) for name in ("tx_power", "tx_center_frequency")}
    capture = CaptureSettings(first_sample_m=RANGE_START_M, n_samples=N_BINS, **chip)
    signal = sum_of_pulses(
        frame=np.repeat(np.arange(n), k),
        position=((range_m - RANGE_START_M) / BIN_LENGTH_M).ravel(),
        amplitude=np.full(n * k, amplitude),
        phase_rad=phase_rad.ravel(),
        tx_center_frequency=config.tx_center_frequency,
        shape=(n, N_BINS),
    )
    room = empty_room().model_copy(update={"noise": NoiseSpec(rf_sigma=noise_sigma)})
    radar = RadarSpec(name="radar", serial="000000000001", x_m=0.0, y_m=0.0, yaw_deg=0.0)
    numbers, receiver = np.arange(n, dtype=np.int64), Receiver(room, radar, seed)
    counts = receiver.counters(signal, numbers, numbers * period_ns, capture, gain=1.0)
    scale = Normalisation.of(**sweep)
    samples = counts.astype(np.float32) * np.float32(scale.quantum) - np.float32(scale.dac_offset)
    bins: dict[str, Any] = {"range_start_m": RANGE_START_M, "bin_length_m": BIN_LENGTH_M}
    same = bins | {"radar": 0, "limits": sampler_limits(config)}
    rows = enumerate(samples)
    return [RadarFrame(t_ns=i * period_ns, counter=i, samples=row, **same) for i, row in rows]


def ranges_m(frames: Sequence[RadarFrame]) -> dict[str, list[Array]]:
    """Return the ranges that each front end with the settings of the paper finds in each frame."""
    found = {}
    # From 60 echoes on, three frames apart, a detector learns the pulse, and of pairs a wrong one.
    parts = [frames[first : first + 50] for first in range(0, len(frames), 50)]
    for name in LOOKS:
        config = override(SlamConfig(), {"detection.front_end": name})
        detections = [make_detector(config).detect_many(part, [0.0] * len(part)) for part in parts]
        found[name] = [np.array([d.range_m for d in each]) for part in detections for each in part]
    return found


def errors_m(found: Sequence[Array], true_m: Array) -> Array:
    """Return the error of the range nearest to the true one, shape (n,); NaN beyond MATCH_M."""
    pairs = zip(found, true_m, strict=True)
    errors = np.array([min(one - true, key=abs, default=math.inf) for one, true in pairs])
    errors[np.abs(errors) > MATCH_M] = math.nan
    return errors


def resolved(found: Sequence[Array], true_m: Array) -> float:
    """Return the share [%] of frames with two ranges within `TOLERANCE_M` of the true (n, 2)."""
    pairs = zip(found, true_m, strict=True)
    good = [len(one) == 2 and bool((abs(one - true) <= TOLERANCE_M).all()) for one, true in pairs]
    return 1e2 * float(np.mean(good))


def one_echo(trials: int, key: Sequence[int], seed: int, **chip: float) -> dict[str, Array]:
    """Return the errors of each front end; `key` seeds ranges and phases, `seed` the noise."""
    range_m, phase_rad = places(trials, np.random.default_rng(key))
    frames = chip_frames(range_m, phase_rad, seed=seed, **chip)
    return {name: errors_m(of, range_m[:, 0]) for name, of in ranges_m(frames).items()}


def std_mm(trials: int, key: Sequence[int], seed: int, amplitude: float, noise: float) -> Row:
    """Return the standard deviation of one echo's range: the bound, and of each front end."""
    errors = one_echo(trials, key, seed, amplitude=amplitude, noise_sigma=noise)
    bound_m = BIN_LENGTH_M * PULSE.position_bound_bins(amplitude / noise, BIN_LENGTH_M)
    std_m = {name: float(np.nanstd(each, ddof=1)) for name, each in errors.items()}
    return {name: 1e3 * each for name, each in ({"Cramer-Rao bound": bound_m} | std_m).items()}


def share_found(trials: int, snr_db: int, seed: int) -> Row:
    """Noise stays as it is, the echo changes: the paper's thresholds are absolute."""
    snr, alarms = 10 ** (snr_db / 20), MatchedFilterConfig().false_alarms_per_frame
    threshold = threshold_sigmas(N_BINS / SIGMA_BINS, alarms, noise_is_known=True)
    marcum = float(detection_probability(np.array(snr), threshold, SIGMA_BINS))
    chip = {"amplitude": snr * NOISE_SIGMA, "noise_sigma": NOISE_SIGMA}
    errors = one_echo(trials, [seed, 5, snr_db], seed + 100 + snr_db, **chip)
    shares = {name: float(np.isfinite(each).mean()) for name, each in errors.items()}
    return {name: 1e2 * each for name, each in ({"Marcum, sigma known": marcum} | shares).items()}


def share_resolved(trials: int, separation_mm: int, seed: int) -> Row:
    """Return the share of pairs of equal echoes that are resolved, at the bound and really."""
    rng = np.random.default_rng([seed, 2, separation_mm])
    range_m, phase_rad = places(trials, rng, 1e-3 * separation_mm)
    chip = {"amplitude": AMPLITUDE, "noise_sigma": NOISE_SIGMA}
    frames = chip_frames(range_m, phase_rad, seed=seed + 1, **chip)
    apart, turn_rad = (np.diff(each)[:, 0] for each in (range_m / BIN_LENGTH_M, phase_rad))
    pulse = {"snr": AMPLITUDE / NOISE_SIGMA, "envelope_sigma": SIGMA_BINS}
    covariance = pair_covariance(apart, 1.0, turn_rad - CARRIER_RAD * apart, **pulse)
    root_m = BIN_LENGTH_M * np.linalg.cholesky(covariance)
    ideal_m = range_m + np.einsum("nij,nj->ni", root_m, rng.standard_normal((trials, 2)))
    found = {"at the Cramer-Rao bound": list(ideal_m), **ranges_m(frames)}
    return {name: resolved(of, range_m) for name, of in found.items()}


def draw(axes: Axes, x: Sequence[float], rows: Sequence[Row], *labels: str) -> None:
    for name in rows[0]:
        look = LOOKS.get(name, {"color": INK, "linestyle": "--"})
        axes.plot(x, [row[name] for row in rows], label=name, **look)
    axes.set_yscale("log" if labels[2] == "std [mm]" else "linear")
    axes.legend(frameon=False)
    label(axes, *labels)
    cells = [[f"{v:.4g}" for v in (at, *row.values())] for at, row in zip(x, rows, strict=True)]
    print_table(f"{labels[0]}, {labels[2]}", (labels[1], *rows[0]), cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/studies"), help="folder to write to")
    parser.add_argument("--seed", type=int, default=0, help="seed of places, phases and noise")
    parser.add_argument("--trials", type=int, default=2000, help="frames per point")
    given = parser.parse_args()
    n, seed = given.trials, given.seed
    title = f"Front ends beside their limits ({n} emulated frames per point, seed {seed})"
    with picture(given.out / "limits.png", width_in=10.4, height_in=8.2, title=title) as figure:
        (one, two), (found, clipped) = figure.subplots(2, 2)
        noises = {x: AMPLITUDE / 10 ** (x / 20) for x in SNRS_DB}
        rows = [std_mm(n, [seed, 1, x], seed + x, AMPLITUDE, noises[x]) for x in SNRS_DB]
        draw(one, SNRS_DB, rows, "One echo: its range", "SNR [dB]", "std [mm]")
        rows = [share_resolved(n, x, seed) for x in SEPARATIONS_MM]
        title = "Two equal echoes at 29.5 dB: two found, each within 20 mm"
        draw(two, SEPARATIONS_MM, rows, title, "separation [mm]", "share [%]")
        rows = [share_found(n, x, seed) for x in LOW_SNRS_DB]
        draw(found, LOW_SNRS_DB, rows, "One echo: found within 10 cm", "SNR [dB]", "share [%]")
        keys = {strength * DAC_WINDOW: [seed, 4, round(10 * strength)] for strength in STRENGTHS}
        rows = [std_mm(n, key, seed + 3, echo, NOISE_SIGMA) for echo, key in keys.items()]
        title, x_label = "One echo, clipped beyond 1: its range", "amplitude over the DAC window"
        draw(clipped, STRENGTHS, rows, title, x_label, "std [mm]")


if __name__ == "__main__":
    main()
