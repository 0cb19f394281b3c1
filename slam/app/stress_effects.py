"""What the rows of the stress table do: to the scene, to the frames on their way, to detections.

Random choices are words of Philox keyed by the run's seed, so a row changes neither the noise of
receivers nor that of the wheels: runs of one seed, clean and stressed, differ by the stress alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emulator.noise import counter_normals
from emulator.scene import CarriedSpec, Scene
from slam.app.session import Scan
from slam.app.stress import Stress
from slam.app.tum import NS_PER_S
from slam.detection import Detection
from slam.detector import Detector
from slam.frames import RadarFrame

# Streams of their own beside the radars' (serial numbers and purposes, below 2**51) and the
# odometry's, 2**63.
_STREAM = 1 << 62
_OFFSETS, _SILENCE, _DROPPED, _OUTLIERS = (_STREAM + (part << 32) for part in range(4))

# When a silence may begin, in parts of the run.
_SILENCE_FROM, _SILENCE_TO = 0.15, 0.75
_BLOCKS_PER_FRAME = 256
"""Of four words each: three words for each of at most 341 echoes of a frame."""


def stressed_scene(scene: Scene, stress: Stress, seed: int) -> Scene:
    """Return the scene with what a row plants in it: skews, range offsets, wheels, a lift.

    A radar beyond those that have a skew in the row takes them from the first again.
    """
    radars = scene.radars
    if stress.start_skews_ms:
        skews_ms = stress.start_skews_ms
        radars = tuple(
            radar.model_copy(update={"start_skew_ms": skews_ms[index % len(skews_ms)]})
            for index, radar in enumerate(radars)
        )
    if stress.offset_sigma_m:
        normals = counter_normals(np.arange(len(radars)), seed=seed, stream=_OFFSETS)
        radars = tuple(
            radar.model_copy(
                update={"range_offset_m": radar.range_offset_m + stress.offset_sigma_m * normal}
            )
            for radar, normal in zip(radars, normals.tolist(), strict=True)
        )
    duration_s = scene.trajectory().duration_ns / NS_PER_S
    odometry = scene.odometry
    if stress.walk_sigmas:
        rate = stress.walk_sigmas / math.sqrt(duration_s)
        odometry = odometry.model_copy(update={"walk_per_sqrt_s": rate})
    path = scene.path
    if stress.carried_skips:
        lift = CarriedSpec(
            at_s=stress.carried_at * duration_s, skips_s=stress.carried_skips * duration_s
        )
        path = path.model_copy(update={"carried": lift})
    return scene.model_copy(update={"radars": radars, "odometry": odometry, "path": path})


def stressed_scans(
    scans: Iterable[Scan], stress: Stress, seed: int, duration_ns: int
) -> Iterator[Scan]:
    """Yield the scans without the frames that a row loses; a scan that lost all stays, empty.

    Parameters
    ----------
    scans
        Of a whole run, nothing lost.
    stress
        Silence, losses and dead radars count.
    seed
        Of the run.
    duration_ns
        Of the run: silence is a part of it.
    """
    begin = _SILENCE_FROM + (_SILENCE_TO - _SILENCE_FROM) * float(
        _uniforms(seed, _SILENCE, 0, 1)[0]
    )
    silent_ns = (begin * duration_ns, (begin + stress.silent_share) * duration_ns)
    for scan in scans:
        silent = silent_ns[0] <= scan.t_ns < silent_ns[1]
        frames = tuple(
            frame
            for frame in scan.frames
            if not silent
            and frame.radar not in stress.dead_radars
            and not _is_dropped(frame, stress.dropped_share, seed)
        )
        yield scan if len(frames) == len(scan.frames) else replace(scan, frames=frames)


def _is_dropped(frame: RadarFrame, share: float, seed: int) -> bool:
    if not share:
        return False
    return float(_uniforms(seed, _DROPPED + frame.radar, frame.counter, 1)[0]) < share


@dataclass(frozen=True, slots=True, kw_only=True)
class OutlierDetector:
    """A front end that gives random ranges now and then, with the looks of the true detection.

    Attributes
    ----------
    detector
        The true front end.
    share
        Of the detections, replaced by ranges uniform between ``min_range_m`` and ``max_range_m``
        with a uniform carrier phase, if they have one; amplitude and predictions stay.
    seed
        Of the run.
    """

    detector: Detector
    share: float
    min_range_m: float
    max_range_m: float
    seed: int

    def detect(self, frame: RadarFrame, range_offset_m: float = 0.0) -> tuple[Detection, ...]:
        """Return the echoes of one frame, some replaced, nearest first."""
        return self.detect_many([frame], [range_offset_m])[0]

    def detect_many(
        self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
    ) -> list[tuple[Detection, ...]]:
        """Return what ``detect`` returns, for each frame with its range offset."""
        found = self.detector.detect_many(frames, offsets_m)
        return [self._mixed(*pair) for pair in zip(frames, found, strict=True)]

    def _mixed(self, frame: RadarFrame, detections: Sequence[Detection]) -> tuple[Detection, ...]:
        block = frame.counter * _BLOCKS_PER_FRAME
        words = _uniforms(self.seed, _OUTLIERS + frame.radar, block, 3 * len(detections))
        span_m = self.max_range_m - self.min_range_m
        mixed = [
            replace(
                detection,
                range_m=self.min_range_m + span_m * where,
                phase_rad=_phase_like(detection, phase),
            )
            if chance < self.share
            else detection
            for detection, (chance, where, phase) in zip(
                detections, words.reshape(-1, 3).tolist(), strict=True
            )
        ]
        return tuple(sorted(mixed, key=lambda detection: detection.range_m))


def _phase_like(detection: Detection, turns: float) -> float:
    known = not math.isnan(detection.phase_rad)
    return math.pi * (2 * turns - 1) if known else math.nan


def _uniforms(seed: int, stream: int, block: int, count: int) -> NDArray[np.float64]:
    """Return numbers in [0, 1), selected by stream and block alone; shape (count,)."""
    philox = np.random.Philox(key=np.array([seed, stream], dtype=np.uint64), counter=block)
    words: NDArray[np.uint64] = philox.random_raw(count)
    return (words >> np.uint64(11)).astype(np.float64) * 2.0**-53
