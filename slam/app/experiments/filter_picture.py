"""Draws the experiment `filter`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.axes import Axes

from slam.app.experiments.filter_study import TABLE_I, Outcome, Seen, Setting
from slam.app.picture import ESTIMATE, INK, LANDMARK, ODOMETRY, PALE_INK, TRUTH, label, picture

_Value = Callable[[Setting], float]

_PARAMETERS: tuple[tuple[str, str, _Value], ...] = (
    ("window_size", "window_size [states], and its latency", lambda setting: setting.window_size),
    ("min_opc", "min_opc [fixes]", lambda setting: setting.min_opc),
    ("search_rad", "search_rad [cm]", lambda setting: 1e2 * setting.search_rad_m),
)


def draw_filter(
    path: Path, studies: Sequence[tuple[Seen, Sequence[Outcome]]], *, seed: int
) -> None:
    """Draw the shares kept over each of the three parameters, a row per scene; a PNG file."""
    with picture(path, width_in=10.4, height_in=1.3 + 3.1 * len(studies)) as figure:
        figure.suptitle(
            "The paper's DBSCAN filter, one parameter varied at a time; dashed: Table I "
            f"(one lap, simulated, seed {seed})",
            fontsize=11,
            color=INK,
            x=0.01,
            ha="left",
        )
        panels = figure.subplots(len(studies), len(_PARAMETERS), squeeze=False, sharey=True)
        for row, (seen, outcomes) in zip(panels, studies, strict=True):
            for axes, (name, x_label, value) in zip(row, _PARAMETERS, strict=True):
                _draw(axes, name, value, outcomes)
                label(axes, f"{seen.scene}: {name}", x_label, "share [%]")
        figure.legend(
            *panels[0, 0].get_legend_handles_labels(),
            loc="outside lower center",
            ncols=4,
            frameon=False,
        )


def _draw(axes: Axes, name: str, value: _Value, outcomes: Sequence[Outcome]) -> None:
    varied = [row for row in outcomes if _differs_only_in(value, row.setting)]
    varied.sort(key=lambda row: value(row.setting))
    x = [value(row.setting) for row in varied]
    for shares, colour, what in (
        ([row.true_kept for row in varied], ESTIMATE, "true fixes kept"),
        ([row.ghosts_kept for row in varied], ODOMETRY, "ghosts kept (ranges of two landmarks)"),
        ([row.clutter_kept for row in varied], TRUTH, "other false fixes kept"),
        ([row.wrong_observations for row in varied], LANDMARK, "observations > 15 cm off"),
    ):
        percent = [float("nan") if share is None else 1e2 * share for share in shares]
        axes.plot(x, percent, marker="o", markersize=4, linewidth=1.4, color=colour, label=what)
    axes.axvline(value(TABLE_I), color=PALE_INK, linewidth=0.9, linestyle="--")
    axes.set_ylim(-4, 104)
    if name == "window_size":
        axes.set_xticks(x, [f"{row.setting.window_size}\n{row.latency_s:.1f} s" for row in varied])


def _differs_only_in(value: _Value, setting: Setting) -> bool:
    others = [other for _, _, other in _PARAMETERS if other is not value]
    return all(other(setting) == other(TABLE_I) for other in others)
