"""What the front ends reach, beside what no front end can pass."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slam.app.experiments import Result, Table
from slam.app.experiments.limit_cells import (
    AMPLITUDE,
    FRONT_ENDS,
    MATCH_M,
    NOISE_SIGMA,
    TOLERANCE_M,
    detection_against_snr,
    false_alarms,
    leakage,
    ranging_against_snr,
    resolution_against_separation,
    saturation,
)
from slam.app.run.pictures import ESTIMATE, INK, LANDMARK, ODOMETRY, PALE_INK, TRUTH, label
from xethru_protocol.system import StopFlag

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


def run(arguments: argparse.Namespace, stop: StopFlag) -> Result:
    cells = {
        "ranging": ranging_against_snr,
        "detection": detection_against_snr,
        "false_alarms": false_alarms,
        "resolution": resolution_against_separation,
        "leakage": leakage,
        "saturation": saturation,
    }
    trials, seed = arguments.trials, arguments.seed
    tables: dict[str, Sequence[_Row]] = {}
    for number, (name, measure) in enumerate(cells.items(), start=1):
        sys.stderr.write(f"{number}/{len(cells)} {name}\n")
        sys.stderr.flush()
        tables[name] = measure(trials, seed, stop.check)
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
    return [
        (
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
        ),
        (
            "share of echoes found",
            ("SNR", "Marcum", "sigma told", "matched_filter", "paper"),
            [
                (
                    f"{row['snr_db']} dB",
                    *(f"{row[name]:.4f}" for name in ("marcum", "told", "matched_filter", "paper")),
                )
                for row in tables["detection"]
            ],
        ),
        (
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
        ),
        (
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
        ),
        (
            "one echo beside leakage: found, others per frame, bias / std [mm]",
            ("DAC window, leakage", *FRONT_ENDS),
            [
                (
                    f"{row['dac_window']}, {row['leakage_amplitude']:g} at {row['leakage_m']:g} m",
                    *(_seen(row[name]) for name in FRONT_ENDS),
                )
                for row in tables["leakage"]
            ],
        ),
        (
            "one echo beyond the DAC window: found, others per frame, bias / std [mm]",
            ("over window", *FRONT_ENDS),
            [
                (
                    f"{row['amplitude_over_window']:g}",
                    *(_seen(row[name]) for name in FRONT_ENDS),
                )
                for row in tables["saturation"]
            ],
        ),
    ]


def _error(cell: _Row) -> str:
    if cell["std_mm"] is None:
        return "-"
    return f"{cell['bias_mm']:+.3f} / {cell['std_mm']:.3f}"


def _seen(cell: _Row) -> str:
    return f"{cell['found']:.3f}, {cell['others_per_frame']:.2f}, {_error(cell)}"
