"""What the front ends reach, beside what no front end can pass.

Light, so that ``--help`` is; the work is in ``limit_cells``, ``limit_detection`` and
``limit_picture``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from slam.app.commands.options import count, seed
from slam.app.errors import StopFlag
from slam.app.experiments.limit_cells import (
    BIN_LENGTH_M,
    FRONT_ENDS,
    N_BINS,
    NOISE_SIGMA,
    chip_frames,
    detection_probability,
    front_end,
    known_pulse,
    ranges_of,
    ranging,
    single_echoes,
)
from slam.app.run.pictures import ESTIMATE, INK, LANDMARK, ODOMETRY, PALE_INK, TRUTH, label, picture
from slam.config import MatchedFilterConfig
from slam.front_end.matched_filter import threshold_sigmas

METHODS = (*FRONT_ENDS, "lasso", "omp", "clean")
_LOOKS: Mapping[str, dict[str, Any]] = {
    "paper": {"color": ODOMETRY, "marker": "s"},
    "matched_filter": {"color": LANDMARK, "marker": "^"},
    "joint": {"color": ESTIMATE, "marker": "o"},
    "lasso": {"color": "#3a8f5c", "marker": "v"},
    "omp": {"color": "#7a5cc2", "marker": "D"},
    "clean": {"color": TRUTH, "marker": "x"},
}
_BOUND: dict[str, Any] = {"color": INK, "linewidth": 1.2, "linestyle": "--"}

_Row = Mapping[str, Any]


def draw_limits(
    path: Path, tables: Mapping[str, Sequence[_Row]], *, trials: int, seed: int
) -> None:
    """Draw ranging, resolution, detection and saturation, a panel each; a PNG file."""
    with picture(path, width_in=10.4, height_in=8.2) as figure:
        figure.suptitle(
            f"Front ends beside their limits ({trials} emulated frames per point, seed {seed})",
            fontsize=11,
            color=INK,
            x=0.01,
            ha="left",
        )
        panels = figure.subplots(2, 2)
        _ranging(panels[0, 0], tables["ranging"])
        _resolution(panels[0, 1], tables["resolution"])
        _detection(panels[1, 0], tables["detection"])
        _saturation(panels[1, 1], tables["saturation"])


def _ranging(axes: Axes, rows: Sequence[_Row]) -> None:
    x = [row["snr_db"] for row in rows]
    axes.plot(x, [row["bound_mm"] for row in rows], label="Cramer-Rao bound", **_BOUND)
    for name in FRONT_ENDS:
        _line(axes, x, [row[f"chip.{name}"]["std_mm"] for row in rows], name)
    axes.set_yscale("log")
    label(axes, "One echo: standard deviation of its range", "SNR [dB]", "std [mm]")
    axes.legend(frameon=False)


def _resolution(axes: Axes, rows: Sequence[_Row]) -> None:
    x = [row["separation_mm"] for row in rows]
    axes.plot(
        x, [1e2 * row["bound_resolved"] for row in rows], label="at the Cramer-Rao bound", **_BOUND
    )
    for name in METHODS:
        _line(axes, x, [1e2 * row[name]["resolved"] for row in rows], name)
    axes.set_ylim(-4, 104)
    axes.set_xlim(x[0] - 8, x[-1] + 120)  # room for the legend
    label(
        axes,
        "Two equal echoes at 29.5 dB: two found, each within 20 mm",
        "separation [mm]",
        "share [%]",
    )
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
    axes.plot(
        x, [row["bound_unclipped_mm"] for row in rows], label="bound, nothing clipped", **_BOUND
    )
    for name in FRONT_ENDS:
        _line(axes, x, [row[name]["std_mm"] for row in rows], name)
    axes.axvline(1.0, color=PALE_INK, linewidth=0.9, linestyle=":")
    axes.set_yscale("log")
    label(
        axes,
        "One echo clipped: standard deviation of its range",
        "amplitude over the DAC window",
        "std [mm]",
    )
    axes.legend(frameon=False)


def _line(axes: Axes, x: Sequence[float], y: Sequence[float | None], name: str) -> None:
    values = [float("nan") if value is None else value for value in y]
    # the matched filter and the joint fit coincide on single echoes: the later one is hollow
    hollow = {"markerfacecolor": "none", "markersize": 7} if name == "joint" else {"markersize": 4}
    axes.plot(x, values, label=name, linewidth=1.4, **_LOOKS[name], **hollow)


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


NAME = "limits"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add seed and number of trials."""
    parser.add_argument(
        "--seed",
        type=seed,
        default=0,
        help="seed of places, phases and noise (default: %(default)s)",
    )
    parser.add_argument(
        "--trials", type=count, default=2000, help="frames per cell (default: %(default)s)"
    )


def run(arguments: argparse.Namespace, stop: StopFlag) -> None:
    """Measure every cell of the table."""
    # heavy, see module text
    from slam.app.experiments import limit_cells
    from slam.app.run.output import write_json

    cells = {
        "ranging": limit_cells.ranging_against_snr,
        "detection": detection_against_snr,
        "false_alarms": false_alarms,
        "resolution": limit_cells.resolution_against_separation,
        "leakage": limit_cells.leakage,
        "saturation": limit_cells.saturation,
    }
    tables: dict[str, Sequence[_Row]] = {}
    for number, (name, measure) in enumerate(cells.items(), start=1):
        sys.stderr.write(f"{number}/{len(cells)} {name}\n")
        sys.stderr.flush()
        tables[name] = measure(arguments.trials, arguments.seed, stop.check)
    write_json(
        arguments.out / f"{NAME}.json",
        {
            "simulated": True,
            "command": f"uwb-slam experiment {NAME} --trials {arguments.trials} "
            f"--seed {arguments.seed}",
            "trials": arguments.trials,
            "seed": arguments.seed,
            "amplitude": limit_cells.AMPLITUDE,
            "noise_sigma": limit_cells.NOISE_SIGMA,
            "match_m": limit_cells.MATCH_M,
            "resolution_tolerance_m": limit_cells.TOLERANCE_M,
            **tables,
        },
    )
    draw_limits(arguments.out / f"{NAME}.png", tables, trials=arguments.trials, seed=arguments.seed)
    _print(tables, f"{arguments.trials} frames per cell, seed {arguments.seed}: simulated numbers")


def _print(tables: Mapping[str, Sequence[_Row]], conditions: str) -> None:
    from slam.app.experiments.limit_cells import FRONT_ENDS
    from slam.app.run.output import print_table

    print_table(
        f"error of one echo's range, bias / std [mm]; {conditions}",
        ("SNR", "bound", *FRONT_ENDS),
        [
            (
                f"{row['snr_db']} dB",
                f"{row['bound_mm']:.3f}",
                *(_error(row[f"chip.{name}"]) for name in FRONT_ENDS),
            )
            for row in tables["ranging"]
        ],
    )
    print_table(
        "share of echoes found",
        ("SNR", "Marcum", "sigma told", "matched_filter", "paper"),
        [
            (
                f"{row['snr_db']} dB",
                *(f"{row[name]:.4f}" for name in ("marcum", "told", "matched_filter", "paper")),
            )
            for row in tables["detection"]
        ],
    )
    print_table(
        "peaks per frame of noise alone",
        ("configured", "std. error", "sigma told", "matched_filter", "joint", "paper"),
        [
            (
                f"{row['configured_per_frame']:g}",
                f"{row['standard_error']:.4f}",
                *(f"{row[name]:.4f}" for name in ("told", "matched_filter", "joint", "paper")),
            )
            for row in tables["false_alarms"]
        ],
    )
    print_table(
        "share of pairs of equal echoes resolved",
        ("separation", "bound", *METHODS),
        [
            (
                f"{row['separation_mm']} mm",
                f"{row['bound_resolved']:.3f}",
                *(f"{row[name]['resolved']:.3f}" for name in METHODS),
            )
            for row in tables["resolution"]
        ],
    )
    print_table(
        "one echo beside leakage: found, others per frame, bias / std [mm]",
        ("DAC window, leakage", *FRONT_ENDS),
        [
            (
                f"{row['dac_window']}, {row['leakage_amplitude']:g} at {row['leakage_m']:g} m",
                *(_seen(row[name]) for name in FRONT_ENDS),
            )
            for row in tables["leakage"]
        ],
    )
    print_table(
        "one echo beyond the DAC window: found, others per frame, bias / std [mm]",
        ("over window", *FRONT_ENDS),
        [
            (
                f"{row['amplitude_over_window']:g}",
                *(_seen(row[name]) for name in FRONT_ENDS),
            )
            for row in tables["saturation"]
        ],
    )


def _error(cell: _Row) -> str:
    if cell["std_mm"] is None:
        return "-"
    return f"{cell['bias_mm']:+.3f} / {cell['std_mm']:.3f}"


def _seen(cell: _Row) -> str:
    return f"{cell['found']:.3f}, {cell['others_per_frame']:.2f}, {_error(cell)}"
