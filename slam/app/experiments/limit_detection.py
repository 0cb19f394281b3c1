"""How often an echo is seen and noise is taken for one: measured, and in closed form."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from slam.app.experiments.limit_bounds import detection_probability, known_pulse
from slam.app.experiments.limit_cells import (
    NOISE_SIGMA,
    front_end,
    ranges_of,
    ranging,
    single_echoes,
)
from slam.app.experiments.limit_frames import BIN_LENGTH_M, N_BINS, chip_frames
from slam.config import MatchedFilterConfig
from slam.pulse_filter import threshold_sigmas

SNRS_DB = (0, 2, 3, 4, 5, 6, 7, 8, 10, 12, 16, 20, 22, 23, 24, 25, 26, 28)
FALSE_ALARMS = (1e-3, 1e-2, 1e-1)
_WHOLE_FRAME: Mapping[str, object] = {"detection.min_range_m": 0.0, "detection.max_range_m": 100.0}


def detection_against_snr(
    trials: int, seed: int, check: Callable[[], None]
) -> list[dict[str, object]]:
    """Return one row per SNR: the share of echoes found, and Marcum's at the same threshold.

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
    sigma = known_pulse(BIN_LENGTH_M).envelope_sigma_bins
    threshold = threshold_sigmas(
        N_BINS / sigma, MatchedFilterConfig().false_alarms_per_frame, noise_is_told=True
    )
    rows: list[dict[str, object]] = []
    for snr_db in SNRS_DB:
        snr = 10 ** (snr_db / 20)
        rng = np.random.default_rng([seed, 5, snr_db])
        echoes = single_echoes(trials, snr * NOISE_SIGMA, rng)
        frames = chip_frames(echoes, noise_sigma=NOISE_SIGMA, seed=seed + 100 + snr_db)
        row: dict[str, object] = {
            "snr_db": snr_db,
            "trials": trials,
            "marcum": float(detection_probability(np.array(snr), threshold, sigma)),
        }
        for name, detector in detectors.items():
            check()
            row[name] = ranging(ranges_of(detector, frames), echoes.range_m[:, 0]).found
        rows.append(row)
    return rows


def false_alarms(trials: int, seed: int, check: Callable[[], None]) -> list[dict[str, object]]:
    """Return one row per configured rate: peaks per frame of noise alone, the whole frame."""
    nothing = single_echoes(trials, 0.0, np.random.default_rng([seed, 6]))
    frames = chip_frames(nothing, noise_sigma=NOISE_SIGMA, seed=seed + 4)

    def per_frame(name: str, settings: Mapping[str, object]) -> float:
        check()
        found = ranges_of(front_end(name, {**_WHOLE_FRAME, **settings}), frames)
        return sum(map(len, found)) / trials

    paper = per_frame("paper", {})
    rows: list[dict[str, object]] = []
    for rate in FALSE_ALARMS:
        settings: dict[str, object] = {"matched_filter.false_alarms_per_frame": rate}
        told = settings | {"matched_filter.noise_sigma": NOISE_SIGMA}
        rows.append(
            {
                "configured_per_frame": rate,
                "trials": trials,
                "standard_error": float(np.sqrt(rate / trials)),
                "paper": paper,
                "matched_filter": per_frame("matched_filter", settings),
                "told": per_frame("matched_filter", told),
                "joint": per_frame("joint", settings),
            }
        )
    return rows
