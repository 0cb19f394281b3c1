"""Draws the experiment `figure7`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from numpy.typing import NDArray

from slam.app.experiments.range_steps import RangeErrors, Steps
from slam.app.picture import ESTIMATE, INK, LANDMARK, ODOMETRY, PALE_INK, TRUTH, label, picture
from slam.config import DetectionConfig, FrontEnd
from slam.detection import PaperDetector
from slam.frames import RadarFrame
from slam.presets import load_preset

_COLOURS = {"paper": ODOMETRY, "matched_filter": ESTIMATE, "joint": LANDMARK}
_SHOWN_TO_M = 1.7
_MILLI = 1e3
_WATER = LinearSegmentedColormap.from_list("water", ["#ffffff", "#9cc0ea", "#12408a"], N=20)


def draw_figure7(path: Path, steps: Steps, errors: Mapping[str, RangeErrors], *, seed: int) -> None:
    """Draw raw frame, smoothed frame, frames of all positions, residuals; into a PNG file."""
    config = load_preset("paper").detection
    middle = len(steps.ranges_m) // 2
    paper = errors[str(FrontEnd.PAPER)]
    with picture(path, width_in=9.8, height_in=7.4) as figure:
        figure.suptitle(
            "From raw frame to range: the paper's figure of raw observations, repeated on an "
            f"emulated X4M300 (simulated, seed {seed})",
            fontsize=11,
            color=INK,
            x=0.01,
            ha="left",
        )
        panels = figure.subplots(2, 2)
        true_m = float(steps.ranges_m[middle])
        frame = steps.frames[middle][0]
        _draw_raw(panels[0, 0], frame, true_m)
        _draw_smoothed(panels[0, 1], frame, true_m, config)
        _draw_positions(panels[1, 0], steps, paper, config)
        _draw_residuals(panels[1, 1], steps, errors)


def _ranges_m(frame: RadarFrame) -> NDArray[np.float64]:
    bins = np.arange(len(frame.samples), dtype=np.float64)
    return frame.range_start_m + frame.bin_length_m * bins


def _draw_raw(axes: Axes, frame: RadarFrame, true_m: float) -> None:
    magnitude = np.abs(frame.samples.astype(np.float64))
    axes.axvspan(true_m - 0.1, true_m + 0.1, color=TRUTH, alpha=0.18, linewidth=0)
    axes.plot(_ranges_m(frame), _MILLI * magnitude, color=ESTIMATE, linewidth=0.8)
    axes.axhline(_MILLI * magnitude.mean(), color=ODOMETRY, linewidth=1.0, linestyle="--")
    axes.annotate(
        "dashed: mean,\nless is set to 0",
        (_SHOWN_TO_M, _MILLI * magnitude.mean()),
        xytext=(-4, 24),
        textcoords="offset points",
        ha="right",
        fontsize=8.5,
        color=ODOMETRY,
    )
    axes.annotate(
        "the rod is here",
        (true_m, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(24, -14),
        textcoords="offset points",
        fontsize=8.5,
        color=PALE_INK,
    )
    axes.set_xlim(frame.range_start_m, _SHOWN_TO_M)
    axes.set_ylim(bottom=0)
    label(axes, "(a) one raw frame, magnitude", "range [m]", "amplitude [1e-3]")


def _draw_smoothed(axes: Axes, frame: RadarFrame, true_m: float, config: DetectionConfig) -> None:
    detector = PaperDetector(config)
    smoothed = detector.smooth(frame.samples)
    axes.axvline(true_m, color=TRUTH, linewidth=3.2, alpha=0.55, label="true range of the rod")
    axes.plot(_ranges_m(frame), _MILLI * smoothed, color=ESTIMATE, linewidth=1.0, label="smoothed")
    axes.axhline(
        _MILLI * config.min_peak_height,
        color=ODOMETRY,
        linewidth=1.0,
        linestyle="--",
        label="least peak height",
    )
    found = detector.detect(frame)
    axes.plot(
        [each.range_m for each in found],
        [_MILLI * each.amplitude for each in found],
        linestyle="none",
        marker="v",
        color=LANDMARK,
        label="detection",
    )
    for each in found:
        axes.annotate(
            f"{each.range_m:.3f} m, {_MILLI * (each.range_m - true_m):+.1f} mm off",
            (each.range_m, _MILLI * each.amplitude),
            xytext=(10, 2),
            textcoords="offset points",
            fontsize=8.5,
            color=LANDMARK,
        )
    axes.set_xlim(frame.range_start_m, _SHOWN_TO_M)
    axes.margins(y=0.12)
    axes.legend(loc="upper left", frameon=False, fontsize=8.5)
    title = (
        f"(b) mean filter, Savitzky-Golay ({config.smoothing_length_bins}, "
        f"{config.smoothing_order}), peaks"
    )
    label(axes, title, "range [m]", "amplitude [1e-3]")


def _draw_positions(axes: Axes, steps: Steps, paper: RangeErrors, config: DetectionConfig) -> None:
    detector = PaperDetector(config)
    rows = np.array([detector.smooth(frames[0].samples) for frames in steps.frames])
    ranges_m = _ranges_m(steps.frames[0][0])
    shown = ranges_m <= _SHOWN_TO_M
    image = axes.pcolormesh(
        ranges_m[shown],
        steps.ranges_m,
        np.clip(_MILLI * rows[:, shown], 0, None),
        cmap=_WATER,
        vmax=_MILLI * float(np.quantile(rows.max(axis=1), 0.7)),
        rasterized=True,
    )
    axes.figure.colorbar(image, ax=axes, label="smoothed amplitude [1e-3]", extend="max")
    axes.plot(
        steps.ranges_m, steps.ranges_m, color=INK, linewidth=0.9, linestyle="--", label="true"
    )
    points = [
        (each.range_m, true_m)
        for of_step, true_m in zip(paper.detections, steps.ranges_m.tolist(), strict=True)
        for each in of_step[0]
    ]
    axes.plot(
        *np.array(points).reshape(-1, 2).T,
        linestyle="none",
        marker="o",
        markersize=2.6,
        color=LANDMARK,
        label="detection",
    )
    axes.legend(loc="upper left", frameon=False, fontsize=8.5)
    label(
        axes,
        "(c) the rod moves away in 1 cm steps: one frame per row",
        "range [m]",
        "true range of the rod [m]",
    )


def _draw_residuals(axes: Axes, steps: Steps, errors: Mapping[str, RangeErrors]) -> None:
    axes.axhline(0.0, color=TRUTH, linewidth=1.0)
    for name, error in errors.items():
        spread = f"bias {_MILLI * error.bias_m:+.2f} mm, std {_MILLI * error.std_m:.2f} mm"
        axes.plot(
            np.repeat(steps.ranges_m, error.residuals_m.shape[1]),
            _MILLI * error.residuals_m.ravel(),
            linestyle="none",
            marker=".",
            markersize=2.0,
            alpha=0.25,
            color=_COLOURS[name],
            zorder=1,
        )
        axes.plot(
            steps.ranges_m,
            _MILLI * error.position_means_m,
            # on a single echo the joint fit is the matched filter: the first line is wide
            linewidth=4.0 if name == FrontEnd.MATCHED_FILTER else 1.0,
            alpha=0.4 if name == FrontEnd.MATCHED_FILTER else 1.0,
            color=_COLOURS[name],
            label=f"{name}: {spread}",
        )
    axes.legend(loc="upper left", frameon=False, fontsize=8.5)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.25 * (high - low))  # room for the legend
    label(
        axes,
        "(d) error: dots frames, lines their mean",
        "true range of the rod [m]",
        "error [mm]",
    )
