"""The cells of the table of limits: each a number of frames, the front ends, and what they made."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from slam.app.experiments.echo_separators import SEPARATORS
from slam.app.experiments.limit_bounds import known_pulse, pair_covariance
from slam.app.experiments.limit_frames import (
    BIN_LENGTH_M,
    FULL,
    NARROW,
    Echoes,
    chip_frames,
    closed_form_frames,
)
from slam.close_echoes import SplitTest
from slam.config import FrontEnd, SlamConfig
from slam.detection import make_detector
from slam.detector import Detector
from slam.frames import RadarFrame
from slam.presets import override
from slam.pulse_model import PulseModel

Array = NDArray[np.float64]

AMPLITUDE = 0.015
NOISE_SIGMA = 5e-4
SNRS_DB = (18, 21, 24, 27, 30, 33, 36, 42, 48)
SEPARATIONS_M = (0.03, 0.04, 0.05, 0.06, 0.07, 0.08, 0.09, 0.10, 0.12, 0.14, 0.16, 0.18, 0.20)
TOLERANCE_M = 0.02
"""How far a resolved echo may be off."""
MATCH_M = 0.1
"""A detection farther off is not the echo's: two envelope sigmas."""
FRONT_ENDS = tuple(front_end.value for front_end in FrontEnd)
DAC_WINDOW = 0.07421875
SATURATIONS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
LEAKAGES = tuple((amplitude, at_m) for amplitude in (0.06, 0.5) for at_m in (0.05, 0.15))
_NEAREST_M, _FARTHEST_M = 0.5, 1.3


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranging:
    """What a front end made of frames of one wanted echo.

    Attributes
    ----------
    trials
        Frames.
    found
        Share of frames with a detection within ``MATCH_M``.
    others_per_frame
        Further detections, mean.
    bias_mm, std_mm
        Of the nearest detection's error; None where nothing was found.
    bias_error_mm
        Standard error of the bias.
    """

    trials: int
    found: float
    others_per_frame: float
    bias_mm: float | None
    bias_error_mm: float | None
    std_mm: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Resolution:
    """What a method made of frames of two echoes.

    Attributes
    ----------
    trials
        Frames.
    resolved
        Share with exactly two detections, each within ``TOLERANCE_M``.
    two_found
        Share with exactly two detections.
    rms_mm
        Error of both positions where two were found; None where never.
    """

    trials: int
    resolved: float
    two_found: float
    rms_mm: float | None


def front_end(name: str, settings: Mapping[str, object] | None = None) -> Detector:
    """Return a front end with the paper's settings but for ``settings``."""
    return make_detector(override(SlamConfig(), {"detection.front_end": name, **(settings or {})}))


def ranges_of(detector: Detector, frames: Sequence[RadarFrame]) -> list[Array]:
    """Return the detected ranges of each frame, ascending."""
    found = detector.detect_many(frames, [0.0] * len(frames))
    return [np.array([d.range_m for d in each]) for each in found]


def single_echoes(n: int, amplitude: float, rng: np.random.Generator) -> Echoes:
    """Return one echo per frame, anywhere in range, bin and phase."""
    return Echoes(
        range_m=rng.uniform(_NEAREST_M, _FARTHEST_M, (n, 1)),
        amplitude=np.full((n, 1), amplitude),
        phase_rad=rng.uniform(0, math.tau, (n, 1)),
    )


def echo_pairs(n: int, separation_m: float, ratio: float, rng: np.random.Generator) -> Echoes:
    """Return two echoes per frame, anywhere in range and bin, with independent phases."""
    first = rng.uniform(_NEAREST_M, _FARTHEST_M - separation_m, (n, 1))
    return Echoes(
        range_m=np.hstack([first, first + separation_m]),
        amplitude=np.tile([AMPLITUDE, ratio * AMPLITUDE], (n, 1)),
        phase_rad=rng.uniform(0, math.tau, (n, 2)),
    )


def ranging(found: Sequence[Array], true_m: Array) -> Ranging:
    """Judge detections, ranges per frame, by the true range of each frame, shape (n,)."""
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
    return Ranging(
        trials=len(true_m),
        found=float(hit.mean()),
        others_per_frame=others / len(true_m),
        bias_mm=1e3 * float(errors[hit].mean()) if several else None,
        bias_error_mm=std_mm / math.sqrt(hit.sum()) if std_mm is not None else None,
        std_mm=std_mm,
    )


def resolution(found: Sequence[Array], true_m: Array) -> Resolution:
    """Judge detections, ranges per frame, by the two true ranges of each, shape (n, 2)."""
    two = np.array([len(ranges) == 2 for ranges in found])
    errors = np.array([found[row] - true_m[row] for row in np.flatnonzero(two).tolist()]).reshape(
        -1, 2
    )
    good = (np.abs(errors) <= TOLERANCE_M).all(axis=1)
    return Resolution(
        trials=len(true_m),
        resolved=float(good.sum() / len(true_m)),
        two_found=float(two.mean()),
        rms_mm=1e3 * float(np.sqrt((errors**2).mean())) if len(errors) else None,
    )


def ranging_against_snr(
    trials: int, seed: int, check: Callable[[], None]
) -> list[dict[str, object]]:
    """Return one row per SNR: the bound, and each front end on both kinds of frames."""
    rows: list[dict[str, object]] = []
    for snr_db in SNRS_DB:
        rng = np.random.default_rng([seed, 1, snr_db])
        echoes = single_echoes(trials, AMPLITUDE, rng)
        snr = 10 ** (snr_db / 20)
        row: dict[str, object] = {
            "snr_db": snr_db,
            "bound_mm": 1e3 * BIN_LENGTH_M * PulseModel().position_bound_bins(snr, BIN_LENGTH_M),
        }
        for source, make in (("chip", chip_frames), ("closed_form", closed_form_frames)):
            frames = make(echoes, noise_sigma=AMPLITUDE / snr, seed=seed + snr_db)
            for name in FRONT_ENDS:
                check()
                found = ranges_of(front_end(name), frames)
                row[f"{source}.{name}"] = asdict(ranging(found, echoes.range_m[:, 0]))
        rows.append(row)
    return rows


def resolution_against_separation(
    trials: int, seed: int, check: Callable[[], None]
) -> list[dict[str, object]]:
    """Return one row per separation of two equal echoes: the bound, and each method.

    The methods of `echo_separators` get the window of each frame that holds the two echoes, 3.5
    envelope sigmas either side; the front ends get the frame.
    """
    rows: list[dict[str, object]] = []
    pulse = known_pulse(BIN_LENGTH_M)
    for separation_m in SEPARATIONS_M:
        rng = np.random.default_rng([seed, 2, round(1e3 * separation_m)])
        echoes = echo_pairs(trials, separation_m, 1.0, rng)
        frames = chip_frames(echoes, noise_sigma=NOISE_SIGMA, seed=seed + 1)
        turn_rad = np.diff(
            echoes.phase_rad - pulse.carrier_rad_per_bin * echoes.position_bins, axis=1
        )[:, 0]
        bound = pair_covariance(
            np.full(trials, separation_m / BIN_LENGTH_M),
            1.0,
            turn_rad,
            snr=AMPLITUDE / NOISE_SIGMA,
            envelope_sigma=pulse.envelope_sigma_bins,
        )
        bound_m2 = BIN_LENGTH_M**2 * bound
        ideal = np.einsum(
            "nij,nj->ni", np.linalg.cholesky(bound_m2), rng.standard_normal((trials, 2))
        )
        row: dict[str, object] = {
            "separation_mm": round(1e3 * separation_m),
            "bound_rms_mm": 1e3 * float(np.sqrt(np.trace(bound_m2, axis1=1, axis2=2).mean() / 2)),
            "bound_resolved": float((np.abs(ideal) <= TOLERANCE_M).all(axis=1).mean()),
        }
        for name in FRONT_ENDS:
            check()
            row[name] = asdict(resolution(ranges_of(front_end(name), frames), echoes.range_m))
        windows, first_bins = windows_of(frames, echoes)
        for name, separator in SEPARATORS.items():
            check()
            positions = separator(windows, pulse, np.full(trials, NOISE_SIGMA), SplitTest())
            found = [
                frames[0].range_start_m + BIN_LENGTH_M * (first + each)
                for first, each in zip(first_bins, positions, strict=True)
            ]
            row[name] = asdict(resolution(found, echoes.range_m))
        rows.append(row)
    return rows


def windows_of(frames: Sequence[RadarFrame], echoes: Echoes) -> tuple[Array, NDArray[np.intp]]:
    """Cut the window around the echoes out of each frame: shape (n, m), and its first bins."""
    sigma = known_pulse(BIN_LENGTH_M).envelope_sigma_bins
    position = echoes.position_bins
    reach = math.ceil(3.5 * sigma + 0.5 * float(np.ptp(position, axis=1).max()))
    first = np.rint(position.mean(axis=1)).astype(np.intp) - reach
    windows = [
        frame.samples[start : start + 2 * reach + 1].astype(np.float64)
        for frame, start in zip(frames, first, strict=True)
    ]
    return np.stack(windows), first


def leakage(trials: int, seed: int, check: Callable[[], None]) -> list[dict[str, object]]:
    """Return one row per leakage and DAC window: each front end's view of one echo beside it."""
    rows: list[dict[str, object]] = []
    for window, dac in (("narrow", NARROW), ("full", FULL)):
        for amplitude, at_m in ((0.0, 0.05), *LEAKAGES):
            rng = np.random.default_rng([seed, 3, round(1e3 * amplitude), round(1e3 * at_m)])
            echoes = single_echoes(trials, AMPLITUDE, rng)
            leak = Echoes(
                range_m=np.full((trials, 1), at_m),
                amplitude=np.full((trials, 1), amplitude),
                phase_rad=rng.uniform(0, math.tau, (trials, 1)),
            )
            frames = chip_frames(
                echoes.beside(leak), noise_sigma=NOISE_SIGMA, seed=seed + 2, dac=dac
            )
            row: dict[str, object] = {
                "dac_window": window,
                "leakage_amplitude": amplitude,
                "leakage_m": at_m,
            }
            for name in FRONT_ENDS:
                check()
                found = ranges_of(front_end(name), frames)
                row[name] = asdict(ranging(found, echoes.range_m[:, 0]))
            rows.append(row)
    return rows


def saturation(trials: int, seed: int, check: Callable[[], None]) -> list[dict[str, object]]:
    """Return one row per strength of an echo over the DAC window: each front end's view of it."""
    rows: list[dict[str, object]] = []
    for strength in SATURATIONS:
        rng = np.random.default_rng([seed, 4, round(10 * strength)])
        echoes = single_echoes(trials, strength * DAC_WINDOW, rng)
        frames = chip_frames(echoes, noise_sigma=NOISE_SIGMA, seed=seed + 3)
        snr = strength * DAC_WINDOW / NOISE_SIGMA
        row: dict[str, object] = {
            "amplitude_over_window": strength,
            "bound_unclipped_mm": 1e3
            * BIN_LENGTH_M
            * PulseModel().position_bound_bins(snr, BIN_LENGTH_M),
        }
        for name in FRONT_ENDS:
            check()
            found = ranges_of(front_end(name), frames)
            row[name] = asdict(ranging(found, echoes.range_m[:, 0]))
        rows.append(row)
    return rows
