"""Draws the experiment `limits`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from slam.app.experiments.limit_cells import FRONT_ENDS
from slam.app.picture import ESTIMATE, INK, LANDMARK, ODOMETRY, PALE_INK, TRUTH, label, picture

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
