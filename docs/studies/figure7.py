"""Draw the paper's figure of raw observations, with a rod that moves away in steps of 1 cm.

`figure7.png` shows (a) one raw frame, (b) the same frame behind the paper's filters with its peak,
(c) one filtered frame for each of 91 positions of the rod, from 0.5 to 1.4 m, and (d) the error of
the range that each front end finds. All frames are simulated: an emulated X4M300 whose receiver,
with its noise, clutter and jitter, is that of the scene `lab`, read by the driver.
"""

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from emulator.scene.scene import PathSpec, RadarSpec, TargetSpec, load_scene
from slam.app.rig.emulated import FRAME_RATE_HZ, RAW_CONFIG, open_loopback
from slam.app.run.pictures import ESTIMATE, LANDMARK, ODOMETRY, TRUTH, label, picture
from slam.config import FrontEnd, load_preset, override
from slam.frames import Detection, RadarFrame
from slam.front_end import make_detector
from slam.front_end.paper import PaperDetector
from xethru_protocol.operating_system import StopFlag

Array = NDArray[np.float64]
Found = list[list[tuple[Detection, ...]]]  # of each position, of each frame

RANGES_M = tuple(0.5 + 0.01 * step for step in range(91))
MATCH_M = 0.15  # a peak farther off, 2.5 times the pulse's half width, is not the rod's
COLOURS = {"paper": ODOMETRY, "matched_filter": ESTIMATE, "joint": LANDMARK}
SHOWN_TO_M = 1.7


def frames_of_rod(ranges_m: Sequence[float], *, seed: int, count: int) -> list[list[RadarFrame]]:
    """Return `count` frames of a rod at each true range; every position has noise of its own."""
    lab, frames = load_scene("lab"), []
    radar = RadarSpec(name="radar", serial="202305070901", x_m=0.0, y_m=0.0, yaw_deg=0.0)
    for number, range_m in enumerate(ranges_m):
        rod = TargetSpec(name="rod", kind="rod", x_m=range_m, y_m=0.0, amplitude_1m=0.015)
        scene = lab.model_copy(update={"path": PathSpec(), "radars": (radar,), "targets": (rod,)})
        with open_loopback(scene, seed * len(ranges_m) + number) as source:
            source.start(RAW_CONFIG, FRAME_RATE_HZ)
            frames.append([scan.frames[0] for scan in source.scans(count, StopFlag())])
    return frames


def detections(front_end: str, frames: Sequence[Sequence[RadarFrame]]) -> Found:
    """Return what a front end finds in the frames, with the settings of preset `paper`."""
    config = override(load_preset("paper"), {"detection.front_end": front_end})
    # A detector may remember frames, and no position is the continuation of another.
    return [make_detector(config).detect_many(each, [0.0] * len(each)) for each in frames]


def range_errors_m(found: Found, ranges_m: Sequence[float]) -> Array:
    """Return the error of the nearest detection, shape (positions, frames); NaN beyond MATCH_M."""
    nearest = [
        [min((one.range_m - true_m for one in each), key=abs, default=math.nan) for each in frames]
        for frames, true_m in zip(found, ranges_m, strict=True)
    ]
    errors_m: Array = np.array(nearest)
    errors_m[np.abs(errors_m) > MATCH_M] = np.nan
    return errors_m


def axis_m(frame: RadarFrame) -> Array:
    bins_m = frame.bin_length_m * np.arange(len(frame.samples), dtype=np.float64)
    return frame.range_start_m + bins_m


def draw_frame(raw: Axes, filtered: Axes, frame: RadarFrame, true_m: float) -> None:
    magnitude, config = 1e3 * np.abs(frame.samples.astype(np.float64)), load_preset("paper")
    detector, least = PaperDetector(config.detection), 1e3 * config.detection.min_peak_height
    raw.plot(axis_m(frame), magnitude, color=ESTIMATE, linewidth=0.8)
    raw.axhline(magnitude.mean(), color=ODOMETRY, linestyle="--", label="mean, less is set to 0")
    filtered.plot(axis_m(frame), 1e3 * detector.smooth(frame.samples), color=ESTIMATE)
    filtered.axhline(least, color=ODOMETRY, linestyle="--", label="least peak height")
    for each in detector.detect(frame):
        text = f"{1e3 * (each.range_m - true_m):+.1f} mm off"
        filtered.plot(each.range_m, 1e3 * each.amplitude, "v", color=LANDMARK, label=text)
    window = f"({config.detection.smoothing_length_bins}, {config.detection.smoothing_order})"
    label(raw, "(a) one raw frame, magnitude", "range [m]", "amplitude [1e-3]")
    title = f"(b) mean filter, Savitzky-Golay {window}, peaks"
    label(filtered, title, "range [m]", "amplitude [1e-3]")
    for axes in (raw, filtered):
        axes.axvline(true_m, color=TRUTH, linewidth=3.2, alpha=0.55, label="true range")
        axes.set_xlim(frame.range_start_m, SHOWN_TO_M)
        axes.legend(loc="upper right", frameon=False, fontsize=8.5)


def draw_positions(axes: Axes, frames: Sequence[Sequence[RadarFrame]], found: Found) -> None:
    detector = PaperDetector(load_preset("paper").detection)
    rows = np.array([1e3 * detector.smooth(each[0].samples) for each in frames])
    bins_m = axis_m(frames[0][0])
    image = axes.pcolormesh(bins_m, RANGES_M, rows, cmap="Blues", vmin=0, rasterized=True)
    axes.figure.colorbar(image, ax=axes, label="smoothed amplitude [1e-3]")
    axes.set_xlim(bins_m[0], SHOWN_TO_M)
    axes.plot(RANGES_M, RANGES_M, color="black", linewidth=0.9, linestyle="--", label="true")
    peaks = [(one.range_m, r) for each, r in zip(found, RANGES_M, strict=True) for one in each[0]]
    axes.plot(*np.array(peaks).reshape(-1, 2).T, "o", color=LANDMARK, ms=2.6, label="detection")
    axes.legend(loc="upper left", frameon=False, fontsize=8.5)
    label(axes, "(c) 1 cm steps: one frame per row", "range [m]", "true range of the rod [m]")


def draw_errors(axes: Axes, errors_m: Mapping[str, Array]) -> None:
    axes.axhline(0.0, color=TRUTH, linewidth=1.0)
    for name, each_m in errors_m.items():
        error, x, colour = 1e3 * each_m, np.repeat(RANGES_M, each_m.shape[1]), COLOURS[name]
        text = f"{name}: bias {np.nanmean(error):+.2f} mm, std {np.nanstd(error):.2f} mm"
        axes.plot(x, error.ravel(), ".", color=colour, markersize=2.0, alpha=0.25, zorder=1)
        # On a single echo the joint fit is the matched filter: the first line is wide.
        width, alpha = (4.0, 0.4) if name == FrontEnd.MATCHED_FILTER else (1.0, 1.0)
        mean = np.nanmean(error, axis=1)
        axes.plot(RANGES_M, mean, color=colour, linewidth=width, alpha=alpha, label=text)
    axes.legend(loc="upper left", frameon=False, fontsize=8.5)
    axes.margins(y=0.25)  # room for the legend
    label(axes, "(d) error: dots frames, lines their mean", "true range [m]", "error [mm]")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/studies"), help="folder to write to")
    parser.add_argument("--seed", type=int, default=0, help="seed of the receiver noise")
    parser.add_argument("--frames", type=int, default=20, help="frames at each position")
    given = parser.parse_args()
    frames = frames_of_rod(RANGES_M, seed=given.seed, count=given.frames)
    found = {str(name): detections(name, frames) for name in FrontEnd}
    title = "From raw frame to range: the paper's figure of raw observations, repeated on an "
    title += f"emulated X4M300 (simulated, seed {given.seed})"
    with picture(given.out / "figure7.png", width_in=9.8, height_in=7.4, title=title) as figure:
        (raw, filtered), (positions, errors) = figure.subplots(2, 2)
        draw_frame(raw, filtered, frames[45][0], RANGES_M[45])  # at 0.95 m
        draw_positions(positions, frames, found["paper"])
        draw_errors(errors, {name: range_errors_m(each, RANGES_M) for name, each in found.items()})


if __name__ == "__main__":
    main()
