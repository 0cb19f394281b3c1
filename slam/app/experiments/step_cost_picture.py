"""Draws the experiment `step-cost`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slam.app.experiments.step_cost_study import (
    BAR_LANDMARKS,
    BAR_MS,
    REFERENCES,
    SLOPE_FROM,
    StepCost,
    slope_of,
)
from slam.app.picture import ESTIMATE, INK, LANDMARK, ODOMETRY, PALE_INK, TRUTH, label, picture


def draw_step_cost(path: Path, costs: Sequence[StepCost]) -> None:
    """Draw the cost of a step over the number of landmarks, both logarithmic; a PNG file."""
    n = np.array([cost.n_landmarks for cost in costs])
    slope = slope_of(costs)
    fitted = "" if slope is None else f", slope {slope:.2f} from n = {SLOPE_FROM} on"
    with picture(path, width_in=8.6, height_in=6.2) as figure:
        figure.suptitle(
            "One step of the robust filter against the size of the map (CPU time, one BLAS thread)",
            fontsize=11,
            color=INK,
            x=0.01,
            ha="left",
        )
        axes = figure.subplots()
        axes.set_xscale("log")
        axes.set_yscale("log")
        series = (
            ("step_ms", ESTIMATE, "o-", f"measured: predict, view, gate, 4 updates{fitted}"),
            (
                "slowest_ms",
                LANDMARK,
                "v:",
                "measured: slowest step, which carries out what others put off",
            ),
            ("at_once_ms", ODOMETRY, "s--", "measured: dsyr2 + dsyrk, if nothing were put off"),
            ("triangle_ms", TRUTH, "-", "measured: triangle of P read and written once"),
        )
        for name, colour, style, what in series:
            ms = [getattr(cost, name) for cost in costs]
            axes.plot(n, ms, style, color=colour, linewidth=1.4, markersize=4, label=what)
        left = float(n.min())
        for reference in REFERENCES:
            for quoted in {reference.low_ms, reference.high_ms}:
                axes.axhline(quoted, color=PALE_INK, linewidth=0.9, linestyle=(0, (6, 3)))
            text = f"{reference.low_ms:g}"
            if reference.high_ms > reference.low_ms:
                text += f" - {reference.high_ms:g}"
            axes.annotate(
                f"{reference.name}, n = {BAR_LANDMARKS}: {text} ms (quoted)",
                (left, reference.low_ms),
                xytext=(0, -4),
                textcoords="offset points",
                va="top",
                fontsize=8,
                color=PALE_INK,
            )
        axes.plot(
            [BAR_LANDMARKS], [BAR_MS], marker="_", markersize=26, markeredgewidth=2.2, color=INK
        )
        axes.annotate(
            f"bar: {BAR_MS:g} ms",
            (BAR_LANDMARKS, BAR_MS),
            xytext=(16, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=INK,
        )
        ticks = [10, 20, 50, 100, 200, 500, 1000, 2000]
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
        label(axes, "", "landmarks n", "time [ms]")
        figure.legend(loc="outside lower center", ncols=1, frameon=False, fontsize=9)
