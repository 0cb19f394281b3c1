"""The experiment `limits`: what the front ends reach, beside what no front end can pass.

Positions in bins, s the envelope's standard deviation in bins, sigma the noise per RF sample. The
frames are the emulator's: its pulse, its receiver (noise by counter, counting, clipping) and the
module's normalisation.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import ncx2

from emulator.chip.chip import CaptureSettings
from emulator.echo.receiver import Receiver
from emulator.echo.reflections import sum_of_pulses
from emulator.scene.scene import NoiseSpec, RadarSpec, empty_room
from slam.app.experiments import Result, Table, table
from slam.app.rig.sources import sampler_limits
from slam.app.run.output import print_progress
from slam.app.run.pictures import ESTIMATE, INK, LANDMARK, ODOMETRY, PALE_INK, label
from slam.config import FrontEnd, MatchedFilterConfig, SlamConfig, override
from slam.frames import Detector, RadarFrame
from slam.front_end import make_detector
from slam.front_end.matched_filter import threshold_sigmas
from slam.front_end.overlapping import KnownPulse
from slam.front_end.pulse import PulseModel
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.system import StopFlag
from xethru_protocol.wire.x4 import Normalisation

Array = NDArray[np.float64]

N_BINS = 1431
RANGE_START_M = 0.2
BIN_LENGTH_M = 299_792_458.0 / (2 * 23.328e9)
PULSE = KnownPulse(
    envelope_sigma_bins=PulseModel().sigma_bins(BIN_LENGTH_M),
    carrier_rad_per_bin=PulseModel().carrier_rad(BIN_LENGTH_M),
)
DAC_WINDOW = 0.07421875
"""Largest amplitude within the DAC sweep of `RawConfig`."""

AMPLITUDE = 0.015
NOISE_SIGMA = 5e-4
TOLERANCE_M = 0.02
"""How far a resolved echo may be off."""
MATCH_M = 0.1
"""A detection farther off is not the echo's: two envelope sigmas."""
SNRS_DB = (18, 21, 24, 27, 30, 33, 36, 42, 48)
SEPARATIONS_M = (0.03, 0.04, 0.05, 0.06, 0.07, 0.08, 0.09, 0.10, 0.12, 0.14, 0.16, 0.18, 0.20)
SATURATIONS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
DETECTION_SNRS_DB = (0, 2, 3, 4, 5, 6, 7, 8, 10, 12, 16, 20, 22, 23, 24, 25, 26, 28)
_NEAREST_M, _FARTHEST_M = 0.5, 1.3

FRONT_ENDS = tuple(front_end.value for front_end in FrontEnd)
_LOOKS: Mapping[str, dict[str, Any]] = {
    "paper": {"color": ODOMETRY, "marker": "s"},
    "matched_filter": {"color": LANDMARK, "marker": "^"},
    "joint": {"color": ESTIMATE, "marker": "o"},
}
_BOUND: dict[str, Any] = {"color": INK, "linewidth": 1.2, "linestyle": "--"}

_Row = dict[str, Any]


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

    ``distance`` (n,) > 0 and ``turn_rad`` (n,) lead from the first echo to the second, the phase on
    a common carrier; ``ratio`` is the amplitude of the second over the first, ``snr`` that of the
    first over sigma. Returns shape (n, 2, 2), squared bins.
    """
    s = envelope_sigma
    d = np.asarray(distance, dtype=np.float64)
    r = np.exp(-((d / (2 * s)) ** 2))
    own = np.full_like(d, 1 / (2 * s**2))
    cross = r * (1 / (2 * s**2) - d**2 / (4 * s**4))
    q = r * d / (2 * s**2)
    left = 1 - r**2
    # derivative by u_1 correlates with pulse 2 by +q, derivative by u_2 with pulse 1 by -q
    own -= q**2 / left
    cross -= q**2 * r / left
    amplitude = snr**2 * s * np.sqrt(np.pi) / 2
    information = np.empty((*d.shape, 2, 2))
    information[..., 0, 0] = amplitude * own
    information[..., 1, 1] = amplitude * ratio**2 * own
    information[..., 0, 1] = amplitude * ratio * np.cos(turn_rad) * cross
    information[..., 1, 0] = information[..., 0, 1]
    covariance: Array = np.linalg.inv(information)
    return covariance


def detection_probability(snr: Array, threshold_sigmas: float, envelope_sigma: float) -> Array:
    """Return how often the matched filter's output at the echo exceeds a threshold: Marcum's Q.

    ``snr`` is amplitude over sigma, of any shape; the threshold is in standard deviations of one
    quadrature of the filter's output. The filter gains s sqrt(pi) / 2 in power.
    """
    noncentrality = np.asarray(snr) ** 2 * envelope_sigma * np.sqrt(np.pi) / 2
    probability: Array = ncx2.sf(threshold_sigmas**2, 2, noncentrality)
    return probability


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Echoes:
    """What is in each of n frames, k echoes each: arrays of shape (n, k)."""

    range_m: Array  # true metres
    amplitude: Array  # peak of the envelope, normalised units
    phase_rad: Array  # of the carrier at the pulse's centre

    @property
    def position_bins(self) -> Array:
        """Return where the echoes lie, in bins from sample 0."""
        return (self.range_m - RANGE_START_M) / BIN_LENGTH_M


def chip_frames(echoes: Echoes, *, noise_sigma: float, seed: int) -> list[RadarFrame]:
    """Return frames as the emulated chip takes them and the driver reads them.

    ``noise_sigma`` is per RF sample, in normalised units.
    """
    config = RawConfig()
    capture = CaptureSettings(
        first_sample_m=RANGE_START_M,
        n_samples=N_BINS,
        iterations=config.iterations,
        pulses_per_step=config.pulses_per_step,
        dac_min=config.dac_min,
        dac_max=config.dac_max,
        dac_step=config.dac_step,
        tx_power=config.tx_power,
        tx_center_frequency=config.tx_center_frequency,
    )
    normalisation = Normalisation.of(
        iterations=config.iterations,
        pulses_per_step=config.pulses_per_step,
        dac_min=config.dac_min,
        dac_max=config.dac_max,
    )
    limits = sampler_limits(config)
    radar = RadarSpec(name="radar", serial="000000000001", x_m=0.0, y_m=0.0, yaw_deg=0.0)
    scene = empty_room().model_copy(update={"noise": NoiseSpec(rf_sigma=noise_sigma)})
    receiver = Receiver(scene, radar, seed)
    position = echoes.position_bins
    n, k = position.shape
    signal = sum_of_pulses(
        frame=np.repeat(np.arange(n), k),
        position=position.ravel(),
        amplitude=echoes.amplitude.ravel(),
        phase_rad=echoes.phase_rad.ravel(),
        tx_center_frequency=config.tx_center_frequency,
        shape=(n, N_BINS),
    )
    counters = np.arange(n, dtype=np.int64)
    counts = receiver.counters(signal, counters, counters * 200_000_000, capture, gain=1.0)
    samples = counts.astype(np.float32) * np.float32(normalisation.quantum)
    samples -= np.float32(normalisation.dac_offset)
    return [_frame(counter, row, limits) for counter, row in enumerate(samples)]


def _frame(
    counter: int, samples: NDArray[np.float32], limits: tuple[float, float] | None
) -> RadarFrame:
    return RadarFrame(
        radar=0,
        t_ns=counter * 200_000_000,
        counter=counter,
        samples=samples,
        range_start_m=RANGE_START_M,
        bin_length_m=BIN_LENGTH_M,
        limits=limits,
    )


def front_end(name: str, settings: Mapping[str, object] | None = None) -> Detector:
    """Return a front end with the paper's settings but for ``settings``."""
    return make_detector(override(SlamConfig(), {"detection.front_end": name, **(settings or {})}))


def ranges_of(detector: Detector, frames: Sequence[RadarFrame]) -> list[Array]:
    found = detector.detect_many(frames, [0.0] * len(frames))
    return [np.array([d.range_m for d in each]) for each in found]


def single_echoes(n: int, amplitude: float, rng: np.random.Generator) -> Echoes:
    """Return one echo per frame, anywhere in range, bin and phase."""
    return Echoes(
        range_m=rng.uniform(_NEAREST_M, _FARTHEST_M, (n, 1)),
        amplitude=np.full((n, 1), amplitude),
        phase_rad=rng.uniform(0, math.tau, (n, 1)),
    )


def echo_pairs(n: int, separation_m: float, rng: np.random.Generator) -> Echoes:
    """Return two equal echoes per frame, anywhere in range and bin, with independent phases."""
    first = rng.uniform(_NEAREST_M, _FARTHEST_M - separation_m, (n, 1))
    return Echoes(
        range_m=np.hstack([first, first + separation_m]),
        amplitude=np.full((n, 2), AMPLITUDE),
        phase_rad=rng.uniform(0, math.tau, (n, 2)),
    )


def ranging(found: Sequence[Array], true_m: Array) -> _Row:
    """Judge detections, ranges per frame, by the true range of each frame, shape (n,).

    Returns
    -------
    ``trials``, ``found``: frames, and the share of them with a detection within ``MATCH_M``;
    ``others_per_frame``: further detections, mean; ``bias_mm``, ``bias_error_mm``, ``std_mm``: of
    the nearest detection's error and the standard error of its bias, None where nothing was found.
    """
    errors = np.array(
        [
            ranges[np.argmin(np.abs(ranges - true))] - true if ranges.size else math.inf
            for ranges, true in zip(found, true_m, strict=True)
        ]
    )
    hit = np.abs(errors) <= MATCH_M
    others = sum(len(ranges) for ranges in found) - int(hit.sum())
    several = np.count_nonzero(hit) > 1
    std_mm = 1e3 * float(errors[hit].std(ddof=1)) if several else None
    return {
        "trials": len(true_m),
        "found": float(hit.mean()),
        "others_per_frame": others / len(true_m),
        "bias_mm": 1e3 * float(errors[hit].mean()) if several else None,
        "bias_error_mm": std_mm / math.sqrt(hit.sum()) if std_mm is not None else None,
        "std_mm": std_mm,
    }


def resolution(found: Sequence[Array], true_m: Array) -> _Row:
    """Judge detections, ranges per frame, by the two true ranges of each, shape (n, 2).

    Returns
    -------
    ``trials``; ``resolved``: the share of frames with exactly two detections, each within
    ``TOLERANCE_M``; ``two_found``: the share with exactly two; ``rms_mm``: error of both positions
    where two were found, None where never.
    """
    two = np.array([len(ranges) == 2 for ranges in found])
    errors = np.array([found[row] - true_m[row] for row in np.flatnonzero(two).tolist()]).reshape(
        -1, 2
    )
    good = (np.abs(errors) <= TOLERANCE_M).all(axis=1)
    return {
        "trials": len(true_m),
        "resolved": float(good.sum() / len(true_m)),
        "two_found": float(two.mean()),
        "rms_mm": 1e3 * float(np.sqrt((errors**2).mean())) if len(errors) else None,
    }


def _of_each_front_end(frames: Sequence[RadarFrame], echoes: Echoes, stop: StopFlag) -> _Row:
    """Return what `ranging` says of each front end, by the first echo of each frame."""
    cells: _Row = {}
    for name in FRONT_ENDS:
        stop.check()
        cells[name] = ranging(ranges_of(front_end(name), frames), echoes.range_m[:, 0])
    return cells


def _bound_mm(snr: float) -> float:
    return 1e3 * BIN_LENGTH_M * PulseModel().position_bound_bins(snr, BIN_LENGTH_M)


def ranging_against_snr(trials: int, seed: int, stop: StopFlag) -> Iterator[_Row]:
    """Yield one row per SNR: the bound, and each front end."""
    for snr_db in SNRS_DB:
        rng = np.random.default_rng([seed, 1, snr_db])
        echoes = single_echoes(trials, AMPLITUDE, rng)
        snr = 10 ** (snr_db / 20)
        row: _Row = {
            "snr_db": snr_db,
            "bound_mm": _bound_mm(snr),
        }
        frames = chip_frames(echoes, noise_sigma=AMPLITUDE / snr, seed=seed + snr_db)
        yield row | _of_each_front_end(frames, echoes, stop)


def resolution_against_separation(trials: int, seed: int, stop: StopFlag) -> Iterator[_Row]:
    """Yield one row per separation of two equal echoes: the bound, and each front end."""
    for separation_m in SEPARATIONS_M:
        rng = np.random.default_rng([seed, 2, round(1e3 * separation_m)])
        echoes = echo_pairs(trials, separation_m, rng)
        frames = chip_frames(echoes, noise_sigma=NOISE_SIGMA, seed=seed + 1)
        turn_rad = np.diff(
            echoes.phase_rad - PULSE.carrier_rad_per_bin * echoes.position_bins, axis=1
        )[:, 0]
        bound = pair_covariance(
            np.full(trials, separation_m / BIN_LENGTH_M),
            1.0,
            turn_rad,
            snr=AMPLITUDE / NOISE_SIGMA,
            envelope_sigma=PULSE.envelope_sigma_bins,
        )
        bound_m2 = BIN_LENGTH_M**2 * bound
        ideal = np.einsum(
            "nij,nj->ni", np.linalg.cholesky(bound_m2), rng.standard_normal((trials, 2))
        )
        row: _Row = {
            "separation_mm": round(1e3 * separation_m),
            "bound_rms_mm": 1e3 * float(np.sqrt(np.trace(bound_m2, axis1=1, axis2=2).mean() / 2)),
            "bound_resolved": float((np.abs(ideal) <= TOLERANCE_M).all(axis=1).mean()),
        }
        for name in FRONT_ENDS:
            stop.check()
            row[name] = resolution(ranges_of(front_end(name), frames), echoes.range_m)
        yield row


def detection_against_snr(trials: int, seed: int, stop: StopFlag) -> Iterator[_Row]:
    """Yield one row per SNR: the share of echoes found, and Marcum's at the same threshold.

    Noise stays as it is, the echo changes: the paper's thresholds are absolute. ``told`` is the
    matched filter that is given sigma, for which Marcum's Q holds at the echo's own place; a
    detector takes the highest place nearby and so finds a little more.
    """
    told = {"matched_filter.noise_sigma": NOISE_SIGMA}
    detectors = {
        "paper": front_end("paper"),
        "matched_filter": front_end("matched_filter"),
        "told": front_end("matched_filter", told),
    }
    sigma = PULSE.envelope_sigma_bins
    threshold = threshold_sigmas(
        N_BINS / sigma, MatchedFilterConfig().false_alarms_per_frame, noise_is_known=True
    )
    for snr_db in DETECTION_SNRS_DB:
        snr = 10 ** (snr_db / 20)
        rng = np.random.default_rng([seed, 5, snr_db])
        echoes = single_echoes(trials, snr * NOISE_SIGMA, rng)
        frames = chip_frames(echoes, noise_sigma=NOISE_SIGMA, seed=seed + 100 + snr_db)
        row: _Row = {
            "snr_db": snr_db,
            "trials": trials,
            "marcum": float(detection_probability(np.array(snr), threshold, sigma)),
        }
        for name, detector in detectors.items():
            stop.check()
            row[name] = ranging(ranges_of(detector, frames), echoes.range_m[:, 0])["found"]
        yield row


def saturation(trials: int, seed: int, stop: StopFlag) -> Iterator[_Row]:
    """Yield one row per strength of an echo over the DAC window: each front end's view of it."""
    for strength in SATURATIONS:
        rng = np.random.default_rng([seed, 4, round(10 * strength)])
        echoes = single_echoes(trials, strength * DAC_WINDOW, rng)
        frames = chip_frames(echoes, noise_sigma=NOISE_SIGMA, seed=seed + 3)
        snr = strength * DAC_WINDOW / NOISE_SIGMA
        row: _Row = {
            "amplitude_over_window": strength,
            "bound_unclipped_mm": _bound_mm(snr),
        }
        yield row | _of_each_front_end(frames, echoes, stop)


def _draw(figure: Figure, tables: Mapping[str, Sequence[_Row]]) -> None:
    panels = figure.subplots(2, 2)
    _ranging(panels[0, 0], tables["ranging"])
    _resolution(panels[0, 1], tables["resolution"])
    _detection(panels[1, 0], tables["detection"])
    _saturation(panels[1, 1], tables["saturation"])


def _ranging(axes: Axes, rows: Sequence[_Row]) -> None:
    x = [row["snr_db"] for row in rows]
    axes.plot(x, [row["bound_mm"] for row in rows], label="Cramer-Rao bound", **_BOUND)
    for name in FRONT_ENDS:
        _line(axes, x, [row[name]["std_mm"] for row in rows], name)
    axes.set_yscale("log")
    label(axes, "One echo: standard deviation of its range", "SNR [dB]", "std [mm]")
    axes.legend(frameon=False)


def _resolution(axes: Axes, rows: Sequence[_Row]) -> None:
    x = [row["separation_mm"] for row in rows]
    bound = [1e2 * row["bound_resolved"] for row in rows]
    axes.plot(x, bound, label="at the Cramer-Rao bound", **_BOUND)
    for name in FRONT_ENDS:
        _line(axes, x, [1e2 * row[name]["resolved"] for row in rows], name)
    axes.set_ylim(-4, 104)
    axes.set_xlim(x[0] - 8, x[-1] + 120)  # room for the legend
    title = "Two equal echoes at 29.5 dB: two found, each within 20 mm"
    label(axes, title, "separation [mm]", "share [%]")
    axes.legend(frameon=False, loc="center right")


def _detection(axes: Axes, rows: Sequence[_Row]) -> None:
    x = [row["snr_db"] for row in rows]
    axes.plot(x, [1e2 * row["marcum"] for row in rows], label="Marcum, sigma known", **_BOUND)
    for name in ("paper", "matched_filter"):
        _line(axes, x, [1e2 * row[name] for row in rows], name)
    axes.set_ylim(-4, 104)
    label(axes, "One echo: found within 10 cm", "SNR [dB]", "share [%]")
    axes.legend(frameon=False)


def _saturation(axes: Axes, rows: Sequence[_Row]) -> None:
    x = [row["amplitude_over_window"] for row in rows]
    bound = [row["bound_unclipped_mm"] for row in rows]
    axes.plot(x, bound, label="bound, nothing clipped", **_BOUND)
    for name in FRONT_ENDS:
        _line(axes, x, [row[name]["std_mm"] for row in rows], name)
    axes.axvline(1.0, color=PALE_INK, linewidth=0.9, linestyle=":")
    axes.set_yscale("log")
    title = "One echo clipped: standard deviation of its range"
    label(axes, title, "amplitude over the DAC window", "std [mm]")
    axes.legend(frameon=False)


def _line(axes: Axes, x: Sequence[float], y: Sequence[float | None], name: str) -> None:
    values = [float("nan") if value is None else value for value in y]
    # the matched filter and the joint fit coincide on single echoes: the later one is hollow
    hollow = {"markerfacecolor": "none", "markersize": 7} if name == "joint" else {"markersize": 4}
    axes.plot(x, values, label=name, linewidth=1.4, **_LOOKS[name], **hollow)


def run(arguments: argparse.Namespace, stop: StopFlag) -> Result:
    cells = {
        "ranging": ranging_against_snr,
        "detection": detection_against_snr,
        "resolution": resolution_against_separation,
        "saturation": saturation,
    }
    trials, seed = arguments.trials, arguments.seed
    tables: dict[str, Sequence[_Row]] = {}
    for number, (name, measure) in enumerate(cells.items(), start=1):
        print_progress(f"{number}/{len(cells)} {name}")
        tables[name] = list(measure(trials, seed, stop))
    return Result(
        numbers={
            "simulated": True,
            "command": f"uwb-slam experiment limits --trials {trials} --seed {seed}",
            "trials": trials,
            "seed": seed,
            "amplitude": AMPLITUDE,
            "noise_sigma": NOISE_SIGMA,
            "match_m": MATCH_M,
            "resolution_tolerance_m": TOLERANCE_M,
            **tables,
        },
        title=f"Front ends beside their limits ({trials} emulated frames per point, seed {seed})",
        size_in=(10.4, 8.2),
        draw=lambda figure: _draw(figure, tables),
        tables=_printed(tables, f"{trials} frames per cell, seed {seed}: simulated numbers"),
    )


def _printed(tables: Mapping[str, Sequence[_Row]], conditions: str) -> list[Table]:
    ranging, detection, resolution, saturation = tables.values()
    return [
        table(
            f"error of one echo's range, bias / std [mm]; {conditions}",
            {
                "SNR": [f"{row['snr_db']} dB" for row in ranging],
                "bound": [f"{row['bound_mm']:.3f}" for row in ranging],
            }
            | {name: [_error(row[name]) for row in ranging] for name in FRONT_ENDS},
        ),
        table(
            "share of echoes found",
            {
                "SNR": [f"{row['snr_db']} dB" for row in detection],
                "Marcum": [f"{row['marcum']:.4f}" for row in detection],
                "sigma told": [f"{row['told']:.4f}" for row in detection],
                "matched_filter": [f"{row['matched_filter']:.4f}" for row in detection],
                "paper": [f"{row['paper']:.4f}" for row in detection],
            },
        ),
        table(
            "share of pairs of equal echoes resolved",
            {
                "separation": [f"{row['separation_mm']} mm" for row in resolution],
                "bound": [f"{row['bound_resolved']:.3f}" for row in resolution],
            }
            | {name: [f"{row[name]['resolved']:.3f}" for row in resolution] for name in FRONT_ENDS},
        ),
        table(
            "one echo beyond the DAC window: found, others per frame, bias / std [mm]",
            {"over window": [f"{row['amplitude_over_window']:g}" for row in saturation]}
            | {name: [_seen(row[name]) for row in saturation] for name in FRONT_ENDS},
        ),
    ]


def _error(cell: _Row) -> str:
    if cell["std_mm"] is None:
        return "-"
    return f"{cell['bias_mm']:+.3f} / {cell['std_mm']:.3f}"


def _seen(cell: _Row) -> str:
    return f"{cell['found']:.3f}, {cell['others_per_frame']:.2f}, {_error(cell)}"
