"""The paper's figure of raw observations: a frame from raw to peaks, a target that moves away."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from emulator.scene.scene import PathSpec, RadarSpec, Scene, TargetSpec, load_scene
from slam.app.experiments import Result, table
from slam.app.rig.emulated import FRAME_RATE_HZ, RAW_CONFIG, open_loopback
from slam.app.run.pictures import ESTIMATE, INK, LANDMARK, ODOMETRY, PALE_INK, TRUTH, label, note
from slam.config import DetectionConfig, FrontEnd, load_preset, override
from slam.frames import Detection, RadarFrame
from slam.front_end import make_detector
from slam.front_end.paper import PaperDetector
from xethru_protocol.system import StopFlag

Array = NDArray[np.float64]

STEP_M = 0.01
FIRST_M, LAST_M = 0.5, 1.4
ROD_AMPLITUDE_1M = 0.015
MATCH_M = 0.15
"""A peak farther from the truth, two and a half times the pulse's half width, is not the rod's."""

_COLOURS = {"paper": ODOMETRY, "matched_filter": ESTIMATE, "joint": LANDMARK}
_SHOWN_TO_M = 1.7
_MILLI = 1e3
_WATER = LinearSegmentedColormap.from_list("water", ["#ffffff", "#9cc0ea", "#12408a"], N=20)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Steps:
    """Frames of every position of the rod."""

    ranges_m: Array  # (n_steps,): true ranges from the antenna
    frames: tuple[tuple[RadarFrame, ...], ...]  # of each position


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeErrors:
    """What one front end made of the frames."""

    detections: tuple[tuple[tuple[Detection, ...], ...], ...]  # by position and frame
    # (n_steps, n_frames): nearest detection minus truth; NaN where none lay within MATCH_M
    residuals_m: Array

    @property
    def position_means_m(self) -> Array:
        """Return the mean residual of each position, shape (n_steps,); NaN where none."""
        seen = np.isfinite(self.residuals_m)
        total = np.where(seen, self.residuals_m, 0.0).sum(axis=1)
        means = np.full(len(total), np.nan)
        means_m: Array = np.divide(total, seen.sum(axis=1), out=means, where=seen.any(axis=1))
        return means_m

    def numbers(self) -> dict[str, float]:
        """Return the figures of the table; NaN where nothing was found.

        ``others_per_frame`` are not the rod's, or its second ones; ``noise_std_m`` is about each
        position's own mean: noise, not bias.
        """
        found = float(np.isfinite(self.residuals_m).mean())
        n_detections = sum(len(one) for step in self.detections for one in step)
        names = ("bias_m", "std_m", "noise_std_m", "worst_position_m")
        values = [math.nan] * len(names)
        if found:
            means_m = self.position_means_m
            about = self.residuals_m - means_m[:, np.newaxis]
            values = [
                float(np.nanmean(self.residuals_m)),
                float(np.nanstd(self.residuals_m)),
                float(np.sqrt(np.nanmean(about**2))),
                float(np.nanmax(np.abs(means_m))),
            ]
        others_per_frame = n_detections / self.residuals_m.size - found
        return {"found": found, "others_per_frame": others_per_frame} | dict(
            zip(names, values, strict=True)
        )


def rod_ranges_m() -> list[float]:
    n_steps = round((LAST_M - FIRST_M) / STEP_M)
    return [FIRST_M + STEP_M * step for step in range(n_steps + 1)]


def measure_steps(
    ranges_m: Sequence[float], *, seed: int, frames_per_step: int, stop: StopFlag
) -> Steps:
    """Take frames of a rod at every true range, through an emulated module and its driver.

    The receiver, with its noise, leakage and the like, is the lab's; every position has noise of
    its own.
    """
    lab, frames = load_scene("lab"), []
    for number, range_m in enumerate(ranges_m):
        noise_seed = seed * len(ranges_m) + number
        with open_loopback(_rod_at(lab, range_m), noise_seed) as source:
            source.start(RAW_CONFIG, FRAME_RATE_HZ)
            scans = source.scans(frames_per_step, stop)
            frames.append(tuple(scan.frames[0] for scan in scans))
    return Steps(ranges_m=np.array(ranges_m), frames=tuple(frames))


def _rod_at(lab: Scene, range_m: float) -> Scene:
    radar = RadarSpec(name="radar", serial="202305070901", x_m=0.0, y_m=0.0, yaw_deg=0.0)
    rod = TargetSpec(name="rod", kind="rod", x_m=range_m, y_m=0.0, amplitude_1m=ROD_AMPLITUDE_1M)
    return lab.model_copy(update={"path": PathSpec(), "radars": (radar,), "targets": (rod,)})


def range_errors(steps: Steps, stop: StopFlag) -> dict[str, RangeErrors]:
    """Return what each front end, under preset ``paper``, makes of the same frames, by its name."""
    errors = {}
    for front_end in FrontEnd:
        config = override(load_preset("paper"), {"detection.front_end": str(front_end)})
        detections = []
        for frames in steps.frames:
            stop.check()
            # a detector may remember frames, and no position is the continuation of another
            detections.append(tuple(make_detector(config).detect_many(frames, [0.0] * len(frames))))
        residuals = [
            [_residual(found, true_m) for found in of_step]
            for of_step, true_m in zip(detections, steps.ranges_m.tolist(), strict=True)
        ]
        errors[str(front_end)] = RangeErrors(
            detections=tuple(detections), residuals_m=np.array(residuals)
        )
    return errors


def _residual(detections: tuple[Detection, ...], true_m: float) -> float:
    nearest = min((each.range_m - true_m for each in detections), key=abs, default=math.nan)
    return nearest if abs(nearest) <= MATCH_M else math.nan


def _draw(figure: Figure, steps: Steps, errors: Mapping[str, RangeErrors]) -> None:
    config = load_preset("paper").detection
    panels = figure.subplots(2, 2)
    middle = len(steps.ranges_m) // 2
    true_m, frame = float(steps.ranges_m[middle]), steps.frames[middle][0]
    _draw_raw(panels[0, 0], frame, true_m)
    _draw_smoothed(panels[0, 1], frame, true_m, config)
    _draw_positions(panels[1, 0], steps, errors[str(FrontEnd.PAPER)], config)
    _draw_residuals(panels[1, 1], steps, errors)


def _ranges_m(frame: RadarFrame) -> NDArray[np.float64]:
    bins = np.arange(len(frame.samples), dtype=np.float64)
    return frame.range_start_m + frame.bin_length_m * bins


def _draw_raw(axes: Axes, frame: RadarFrame, true_m: float) -> None:
    magnitude = np.abs(frame.samples.astype(np.float64))
    axes.axvspan(true_m - 0.1, true_m + 0.1, color=TRUTH, alpha=0.18, linewidth=0)
    axes.plot(_ranges_m(frame), _MILLI * magnitude, color=ESTIMATE, linewidth=0.8)
    axes.axhline(_MILLI * magnitude.mean(), color=ODOMETRY, linewidth=1.0, linestyle="--")
    mean = (_SHOWN_TO_M, _MILLI * magnitude.mean())
    note(axes, "dashed: mean,\nless is set to 0", mean, (-4, 24), ODOMETRY, ha="right")
    top = ("data", "axes fraction")
    note(axes, "the rod is here", (true_m, 1.0), (24, -14), PALE_INK, xycoords=top)
    axes.set_xlim(frame.range_start_m, _SHOWN_TO_M)
    axes.set_ylim(bottom=0)
    label(axes, "(a) one raw frame, magnitude", "range [m]", "amplitude [1e-3]")


def _draw_smoothed(axes: Axes, frame: RadarFrame, true_m: float, config: DetectionConfig) -> None:
    detector = PaperDetector(config)
    smoothed = detector.smooth(frame.samples)
    axes.axvline(true_m, color=TRUTH, linewidth=3.2, alpha=0.55, label="true range of the rod")
    axes.plot(_ranges_m(frame), _MILLI * smoothed, color=ESTIMATE, linewidth=1.0, label="smoothed")
    least = _MILLI * config.min_peak_height
    axes.axhline(least, color=ODOMETRY, linewidth=1.0, linestyle="--", label="least peak height")
    found = detector.detect(frame)
    heights = [_MILLI * each.amplitude for each in found]
    axes.plot([each.range_m for each in found], heights, "v", color=LANDMARK, label="detection")
    for each in found:
        text = f"{each.range_m:.3f} m, {_MILLI * (each.range_m - true_m):+.1f} mm off"
        note(axes, text, (each.range_m, _MILLI * each.amplitude), (10, 2), LANDMARK)
    axes.set_xlim(frame.range_start_m, _SHOWN_TO_M)
    axes.margins(y=0.12)
    axes.legend(loc="upper left", frameon=False, fontsize=8.5)
    settings = f"({config.smoothing_length_bins}, {config.smoothing_order})"
    title = f"(b) mean filter, Savitzky-Golay {settings}, peaks"
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
    x, y = np.array(points).reshape(-1, 2).T
    axes.plot(x, y, "o", markersize=2.6, color=LANDMARK, label="detection")
    axes.legend(loc="upper left", frameon=False, fontsize=8.5)
    title = "(c) the rod moves away in 1 cm steps: one frame per row"
    label(axes, title, "range [m]", "true range of the rod [m]")


def _draw_residuals(axes: Axes, steps: Steps, errors: Mapping[str, RangeErrors]) -> None:
    axes.axhline(0.0, color=TRUTH, linewidth=1.0)
    for name, error in errors.items():
        numbers = error.numbers()
        bias_mm, std_mm = _MILLI * numbers["bias_m"], _MILLI * numbers["std_m"]
        spread = f"bias {bias_mm:+.2f} mm, std {std_mm:.2f} mm"
        colour = _COLOURS[name]
        # on a single echo the joint fit is the matched filter: the first line is wide
        width, alpha = (4.0, 0.4) if name == FrontEnd.MATCHED_FILTER else (1.0, 1.0)
        axes.plot(
            np.repeat(steps.ranges_m, error.residuals_m.shape[1]),
            _MILLI * error.residuals_m.ravel(),
            ".",
            markersize=2.0,
            alpha=0.25,
            color=colour,
            zorder=1,
        )
        axes.plot(
            steps.ranges_m,
            _MILLI * error.position_means_m,
            linewidth=width,
            alpha=alpha,
            color=colour,
            label=f"{name}: {spread}",
        )
    axes.legend(loc="upper left", frameon=False, fontsize=8.5)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.25 * (high - low))  # room for the legend
    title = "(d) error: dots frames, lines their mean"
    label(axes, title, "true range of the rod [m]", "error [mm]")


def run(arguments: argparse.Namespace, stop: StopFlag) -> Result:
    seed, n_frames = arguments.seed, arguments.frames
    steps = measure_steps(rod_ranges_m(), seed=seed, frames_per_step=n_frames, stop=stop)
    errors = range_errors(steps, stop)
    numbers = {name: error.numbers() for name, error in errors.items()}
    return Result(
        numbers={
            "simulated": True,
            "seed": seed,
            "frames_per_step": n_frames,
            "true_ranges_m": steps.ranges_m.tolist(),
            "front_ends": {
                name: {key: _known(value) for key, value in numbers[name].items()}
                | {"position_means_m": list(map(_known, error.position_means_m.tolist()))}
                for name, error in errors.items()
            },
        },
        title="From raw frame to range: the paper's figure of raw observations, repeated on an "
        f"emulated X4M300 (simulated, seed {seed})",
        size_in=(9.8, 7.4),
        draw=lambda figure: _draw(figure, steps, errors),
        tables=[
            table(
                f"a rod moved away in {len(steps.ranges_m)} steps of 1 cm, {n_frames} frames each, "
                f"seed {seed}: simulated numbers",
                {
                    "front end": list(numbers),
                    "found": [f"{each['found']:.3f}" for each in numbers.values()],
                    "others/frame": [
                        f"{each['others_per_frame']:.3f}" for each in numbers.values()
                    ],
                    "bias": [_mm(each["bias_m"]) for each in numbers.values()],
                    "std": [_mm(each["std_m"]) for each in numbers.values()],
                    "of it noise": [_mm(each["noise_std_m"]) for each in numbers.values()],
                    "worst position": [_mm(each["worst_position_m"]) for each in numbers.values()],
                },
            )
        ],
    )


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _mm(length_m: float) -> str:
    return f"{1e3 * length_m:.2f} mm"
