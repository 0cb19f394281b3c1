"""The picture of a benchmark: a map of each run."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from slam.app.benchmarks.evaluation import ODOMETRY, WITH_IDS, WITHOUT_IDS, ScoredRun
from slam.app.run.pictures import ESTIMATE, INK, LANDMARK, SMOOTHED, TRUTH, label
from slam.app.run.pictures import ODOMETRY as ODOMETRY_COLOUR

_COLUMNS = 4
_PANEL_IN = 3.4
_ALONE_IN = 7.5
_STYLES = {
    ODOMETRY: ("dead reckoning", ODOMETRY_COLOUR, 0.8),
    WITHOUT_IDS: ("causal, without ids", LANDMARK, 1.0),
    WITH_IDS: ("causal, with ids", ESTIMATE, 1.0),
    f"{WITHOUT_IDS}_smoothed": ("smoothed, without ids", "#e599b7", 1.0),
    f"{WITH_IDS}_smoothed": ("smoothed, with ids", SMOOTHED, 1.0),
}


def size_in(n_runs: int) -> tuple[float, float]:
    """Return width and height of the picture of so many runs."""
    columns = min(n_runs, _COLUMNS)
    panel_in = _ALONE_IN if n_runs == 1 else _PANEL_IN * (1.6 if n_runs <= 2 else 1.0)
    return columns * panel_in, math.ceil(n_runs / columns) * panel_in + 0.9


def draw(figure: Figure, title: str, runs: Sequence[ScoredRun]) -> None:
    """Draw the truth of each run, and its paths after the alignment that the ATE uses."""
    columns = min(len(runs), _COLUMNS)
    rows = math.ceil(len(runs) / columns)
    for number, scored in enumerate(runs, start=1):
        _draw_map(figure.add_subplot(rows, columns, number), scored, small=len(runs) > 2)
    figure.suptitle(title, fontsize=11, color=INK, x=0.01, ha="left")
    used = [name for name in _STYLES if any(name in one.paths for one in runs)]
    handles = [Line2D([], [], color=TRUTH, linewidth=3.0, alpha=0.6)]
    handles += [Line2D([], [], color=_STYLES[name][1], linewidth=1.6) for name in used]
    names = ["truth", *(_STYLES[name][0] for name in used)]
    figure.legend(handles, names, loc="outside lower left", ncols=3, frameon=False, fontsize=9)


def _draw_map(axes: Axes, scored: ScoredRun, *, small: bool) -> None:
    axes.set_aspect("equal", adjustable="box")
    truth = scored.run.truth.xy_m
    axes.plot(*truth.T, ".", markersize=2.5, color=TRUTH, alpha=0.6)
    for name, (_, colour, width) in _STYLES.items():
        if name in scored.paths:
            axes.plot(*scored.aligned_m(name).T, color=colour, linewidth=width, alpha=0.85)
    # Dead reckoning may leave the picture: what is compared with it shall be seen.
    low, high = truth.min(axis=0), truth.max(axis=0)
    margin = 0.12 * float(max(high - low))
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    best = min(scored.ate_rmse_m.items(), key=lambda pair: pair[1])
    reckoned = scored.ate_rmse_m[ODOMETRY]
    separator = "\n" if small else ": "
    text = f"{_STYLES[best[0]][0]} {best[1]:.2f} m, dead reckoning {reckoned:.2f} m"
    title = f"{scored.run.name}{separator}{text}"
    label(axes, title, "x [m]", "y [m]", fontsize=8 if small else 10)
