"""One run of SLAM over a stream of scans, with observers that see everything on the way."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from slam.app.session import Scan, SessionObserver, Snapshot
from slam.frames import RadarFrame
from slam.pipeline import Slam, StepResult

TruthAt = Callable[[NDArray[np.int64]], NDArray[np.float64]]
"""True poses, shape (n, 3), world frame, at n session times [ns]; NaN where nobody knows."""


def nobody_knows(stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the truth of a run in the real world: NaN, shape (n, 3)."""
    return np.full((len(stamps_ns), 3), np.nan)


class Odometry(Protocol):
    """What tells the wheels' pose."""

    def pose_at(self, t_ns: int) -> NDArray[np.float64]:
        """Return the pose at a session time, shape (3,), odometry frame."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunRecord:
    """What a run leaves behind for its reports.

    Attributes
    ----------
    results, truth
        States of SLAM in time order, and the true pose at each, shape (n_states, 3), world frame;
        NaN where nobody knows.
    world_from_map
        Shape (3,): where the map frame lies in the world; zeros where nobody knows.
    n_frames
        Radar frames used, over all radars.
    start_ns
        Session time of the first scan.
    duration_ns, wall_s
        Session time covered and the time it took.
    wall_spans_m
        Ends of the stretches of wall that answered, shape (k, 2, 2), map frame.
    """

    results: tuple[StepResult, ...]
    truth: NDArray[np.float64]
    world_from_map: NDArray[np.float64]
    n_frames: int
    duration_ns: int
    wall_s: float
    start_ns: int = 0
    wall_spans_m: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2, 2)))


def run_slam(
    scans: Iterable[Scan],
    odometry: Odometry,
    slam: Slam,
    truth_at: TruthAt,
    observers: Sequence[SessionObserver] = (),
    *,
    gains_db: Sequence[float] = (),
) -> RunRecord:
    """Feed scans to SLAM as they come and tell the observers about scans and states.

    A scan that is not `used` is told, and not stepped. BLAS runs on one thread, here as in every
    other path, so that results are the same bits. Truth goes to the observers only; they see
    frames as they came, SLAM sees them less each radar's gain, where `gains_db` tells any.

    Raises
    ------
    OdometryError
        Odometry does not cover the time of a scan.
    """
    results: list[StepResult] = []
    truths: list[NDArray[np.float64]] = []
    counter_at: dict[int, int] = {}
    world_from_map: NDArray[np.float64] | None = None
    start_ns: int | None = None
    n_frames = duration_ns = 0
    started = time.monotonic()

    def take(new: Iterable[StepResult]) -> None:
        for result in new:
            truth = truth_at(np.array([result.t_ns]))[0]
            results.append(result)
            truths.append(truth)
            assert world_from_map is not None
            snapshot = make_snapshot(result, counter_at.pop(result.t_ns), truth, world_from_map)
            for observer in observers:
                observer.on_snapshot(snapshot)

    with threadpool_limits(limits=1):
        for scan in scans:
            for observer in observers:
                observer.on_scan(scan)
            start_ns = scan.t_ns if start_ns is None else start_ns
            duration_ns = scan.t_ns - start_ns
            if not scan.used:
                continue
            if world_from_map is None:
                world_from_map = np.nan_to_num(truth_at(np.array([scan.t_ns]))[0])
            counter_at[scan.t_ns] = scan.counter
            n_frames += len(scan.frames)
            frames = [less_gain(f, gains_db[f.radar]) if gains_db else f for f in scan.frames]
            take(slam.step(frames, odometry.pose_at, scan.t_ns))
        take(slam.flush())
    return RunRecord(
        results=tuple(results),
        truth=np.array(truths).reshape(-1, 3),
        world_from_map=np.zeros(3) if world_from_map is None else world_from_map,
        n_frames=n_frames,
        duration_ns=duration_ns,
        start_ns=start_ns or 0,
        wall_spans_m=slam.wall_spans_m(),
        wall_s=time.monotonic() - started,
    )


def less_gain(frame: RadarFrame, gain_db: float) -> RadarFrame:
    """Return a frame as a radar of no gain would have heard it, cut off where it was cut off."""
    if gain_db == 0.0:
        return frame
    scale = np.float32(10.0 ** (-gain_db / 20.0))
    limits = frame.limits
    if limits is not None:  # as float32, for samples at a limit are compared with it exactly
        low, high = (float(np.float32(limit) * scale) for limit in limits)
        limits = (low, high)
    return replace(frame, samples=frame.samples * scale, limits=limits)


def make_snapshot(
    result: StepResult,
    counter: int,
    truth: NDArray[np.float64],
    world_from_map: NDArray[np.float64],
) -> Snapshot:
    """Reduce a result of the pipeline to what logs and viewers show."""
    belief = result.belief
    rows = range(len(belief.landmark_ids))
    return Snapshot(
        counter=counter,
        t_ns=result.t_ns,
        truth=truth,
        odometry=result.odometry_pose,
        estimate=belief.pose,
        world_from_map=world_from_map,
        pose_covariance=belief.pose_covariance,
        landmark_ids=np.array(belief.landmark_ids, dtype=np.int64),
        landmarks_m=belief.landmarks,
        landmark_covariances_m2=np.array([belief.landmark_covariance(row) for row in rows]).reshape(
            -1, 2, 2
        ),
        nis_per_dof=result.nis_per_dof,
        step=result,
    )
