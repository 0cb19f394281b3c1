"""One radar, one rod, moved away step by step: frames through the driver, ranges of front ends."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.scene import Scene, load_scene
from emulator.scene_tables import PathSpec, RadarSpec, TargetSpec
from slam.app.emulated_rig import FRAME_RATE_HZ, RAW_CONFIG, open_loopback
from slam.config import FrontEnd, SlamConfig
from slam.detection import make_detector
from slam.detector import Detection
from slam.frames import RadarFrame
from slam.presets import load_preset

Array = NDArray[np.float64]

STEP_M = 0.01
FIRST_M, LAST_M = 0.5, 1.4
ROD_AMPLITUDE_1M = 0.015
# A peak this far from the truth, two and a half times the pulse's half width, is not the rod's.
MATCH_M = 0.15


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Steps:
    """Frames of every position.

    Attributes
    ----------
    ranges_m
        Shape (n_steps,): the rod's true range from the antenna.
    frames
        For each position its frames, as SLAM gets them.
    """

    ranges_m: Array
    frames: tuple[tuple[RadarFrame, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeErrors:
    """What one front end made of the frames.

    Attributes
    ----------
    detections
        For each position and frame all detections.
    residuals_m
        Shape (n_steps, n_frames): the nearest detection's range minus the true one; NaN where
        none lay within ``MATCH_M``.
    """

    detections: tuple[tuple[tuple[Detection, ...], ...], ...]
    residuals_m: Array

    @property
    def found(self) -> float:
        """Return the share of frames in which the rod was found."""
        return float(np.isfinite(self.residuals_m).mean())

    @property
    def others_per_frame(self) -> float:
        """Return how many detections per frame were not the rod's, or its second one."""
        total = sum(len(one) for step in self.detections for one in step)
        return total / self.residuals_m.size - self.found

    @property
    def bias_m(self) -> float:
        """Return the mean residual; NaN where the rod was never found."""
        return float(np.nanmean(self.residuals_m)) if self.found else math.nan

    @property
    def std_m(self) -> float:
        """Return the standard deviation of all residuals."""
        return float(np.nanstd(self.residuals_m)) if self.found else math.nan

    @property
    def position_means_m(self) -> Array:
        """Return the mean residual of each position, shape (n_steps,); NaN where none."""
        seen = np.isfinite(self.residuals_m)
        total = np.where(seen, self.residuals_m, 0.0).sum(axis=1)
        means = np.full(len(total), np.nan)
        means_m: Array = np.divide(total, seen.sum(axis=1), out=means, where=seen.any(axis=1))
        return means_m

    @property
    def noise_std_m(self) -> float:
        """Return the standard deviation about each position's own mean: noise, not bias."""
        about = self.residuals_m - self.position_means_m[:, np.newaxis]
        return float(np.sqrt(np.nanmean(about**2))) if self.found else math.nan

    @property
    def worst_position_m(self) -> float:
        """Return the largest mean residual of a position, by amount."""
        return float(np.nanmax(np.abs(self.position_means_m))) if self.found else math.nan

    def numbers(self) -> dict[str, object]:
        """Return what goes into the JSON file."""
        return {
            "found": self.found,
            "others_per_frame": self.others_per_frame,
            "bias_m": _known(self.bias_m),
            "std_m": _known(self.std_m),
            "noise_std_m": _known(self.noise_std_m),
            "worst_position_m": _known(self.worst_position_m),
            "position_means_m": [_known(value) for value in self.position_means_m.tolist()],
        }


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def measure_steps(
    *,
    seed: int,
    frames_per_step: int,
    ranges_m: Sequence[float] | None = None,
    scene: Scene | None = None,
    check: Callable[[], None] = lambda: None,
) -> Steps:
    """Take frames of a rod at every range, through an emulated module and its driver.

    Parameters
    ----------
    seed
        Of the receiver noise; every position has noise of its own.
    frames_per_step
        Frames taken at each position.
    ranges_m
        True ranges; from 0.5 to 1.4 m in 1 cm steps if not given.
    scene
        Whose receiver: noise, leakage and the like; the lab if not given.
    check
        Asked at every position; may raise to stop.
    """
    room = load_scene("lab") if scene is None else scene
    if ranges_m is None:
        n_steps = round((LAST_M - FIRST_M) / STEP_M)
        ranges_m = [FIRST_M + STEP_M * step for step in range(n_steps + 1)]
    frames = []
    for number, range_m in enumerate(ranges_m):
        check()
        noise_seed = seed * len(ranges_m) + number
        frames.append(_frames(_rod_at(room, range_m), noise_seed, frames_per_step, check))
    return Steps(ranges_m=np.array(ranges_m), frames=tuple(frames))


def _rod_at(room: Scene, range_m: float) -> Scene:
    radar = RadarSpec(name="radar", serial="202305070901", x_m=0.0, y_m=0.0, yaw_deg=0.0)
    rod = TargetSpec(name="rod", kind="rod", x_m=range_m, y_m=0.0, amplitude_1m=ROD_AMPLITUDE_1M)
    return Scene(
        name="range_steps",
        environment=room.environment,
        description="One radar and one rod.",
        path=PathSpec(),
        noise=room.noise,
        leakage=room.leakage,
        clutter=room.clutter,
        jitter=room.jitter,
        radars=(radar,),
        targets=(rod,),
    )


def _frames(
    scene: Scene, seed: int, count: int, check: Callable[[], None]
) -> tuple[RadarFrame, ...]:
    with open_loopback(scene, seed) as source:
        source.start(RAW_CONFIG, FRAME_RATE_HZ)
        return tuple(scan.frames[0] for scan in source.scans(count, check))


def front_ends() -> Mapping[str, SlamConfig]:
    """Return the preset ``paper`` with each front end in turn, by its name."""
    paper = load_preset("paper")
    detection = paper.detection
    return {
        str(front_end): paper.model_copy(
            update={"detection": detection.model_copy(update={"front_end": front_end})}
        )
        for front_end in FrontEnd
    }


def range_errors(
    steps: Steps, *, check: Callable[[], None] = lambda: None
) -> dict[str, RangeErrors]:
    """Return what each front end makes of the same frames, by its name."""
    errors = {}
    for name, config in front_ends().items():
        detections = []
        for frames in steps.frames:
            check()
            # a detector may remember frames, and no position is the continuation of another
            detections.append(tuple(make_detector(config).detect_many(frames, [0.0] * len(frames))))
        residuals = [
            [_residual(found, true_m) for found in of_step]
            for of_step, true_m in zip(detections, steps.ranges_m.tolist(), strict=True)
        ]
        errors[name] = RangeErrors(detections=tuple(detections), residuals_m=np.array(residuals))
    return errors


def _residual(detections: tuple[Detection, ...], true_m: float) -> float:
    nearest = min((each.range_m - true_m for each in detections), key=abs, default=math.nan)
    return nearest if abs(nearest) <= MATCH_M else math.nan
