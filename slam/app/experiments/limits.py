"""What the front ends reach, beside what no front end can pass.

Light, so that ``--help`` is; the work is in ``limit_cells``, ``limit_detection`` and
``limit_picture``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from slam.app.arguments import count, seed
from slam.app.stop import StopFlag

NAME = "limits"

_Row = Mapping[str, Any]


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
    from slam.app.experiments import limit_cells, limit_detection
    from slam.app.experiments.limit_picture import draw_limits
    from slam.app.experiments.results import write_json

    cells = {
        "ranging": limit_cells.ranging_against_snr,
        "detection": limit_detection.detection_against_snr,
        "false_alarms": limit_detection.false_alarms,
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
    from slam.app.experiments.limit_picture import METHODS
    from slam.app.experiments.results import print_table

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
