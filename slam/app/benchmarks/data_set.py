"""A data set as the back end wants it, whatever file it came from."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.config import WheelNoise
from slam.geometry import between, compose

Array = NDArray[np.float64]

_MOST_GAP_NS = 1_000_000_000
"""Between two poses that are farther apart in time the path is not interpolated."""
_STILL_RAD = 1e-9
"""A turn that small counts as zero: the chord is as long as the arc to the last bit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkMeasurement:
    """One landmark seen from a pose."""

    range_m: float
    range_sigma_m: float
    bearing_rad: float | None = None  # in the body frame; None: only the range is measured
    bearing_sigma_rad: float | None = None
    label: int | None = None  # of the landmark, where the sensor gives it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriveStep:
    """A motion, and what is seen at its end."""

    t_ns: int
    # (3,): dx, dy [m], turn [rad] in the body frame of the step before; zero in the first step
    increment: Array
    observations: tuple[LandmarkMeasurement, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Positions:
    """Positions over time: stamps ascending, (n,) [ns], and places (n, 2) [m]."""

    t_ns: NDArray[np.int64]
    xy_m: Array

    def at(self, t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """Return the places at some stamps, (k, 2), interpolated, and where they are known, (k,).

        A place is known at a position, and between two that are at most a second apart.
        """
        after = np.clip(np.searchsorted(self.t_ns, t_ns), 1, len(self.t_ns) - 1)
        first, second = self.t_ns[after - 1], self.t_ns[after]
        is_near = (t_ns == first) | (t_ns == second) | (second - first <= _MOST_GAP_NS)
        known = (t_ns >= first) & (t_ns <= second) & is_near
        # Differences of nanoseconds are whole numbers: no stamp passes through a float.
        share = (t_ns - first) / np.maximum(second - first, 1)
        xy = self.xy_m[after - 1] + share[:, None] * (self.xy_m[after] - self.xy_m[after - 1])
        return xy, known


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """One drive."""

    name: str
    steps: tuple[DriveStep, ...]  # at least two
    truth: Positions
    left_out: int = 0  # observations that the reader left out, such as those of other robots
    # Whether it is worth a try without ids: not if its author has left most observations out
    is_dense: bool = True

    @property
    def t_ns(self) -> NDArray[np.int64]:
        return np.array([step.t_ns for step in self.steps], dtype=np.int64)

    @property
    def n_observations(self) -> int:
        return sum(len(step.observations) for step in self.steps)

    @property
    def has_labels(self) -> bool:
        return any(seen.label is not None for step in self.steps for seen in step.observations)

    @property
    def has_bearings(self) -> bool:
        seen = (one for step in self.steps for one in step.observations)
        return any(one.bearing_rad is not None for one in seen)

    def dead_reckoning(self) -> Array:
        """Return where the increments alone lead, shape (n, 3), from the origin."""
        poses = [np.zeros(3)]
        for step in self.steps[1:]:
            poses.append(compose(poses[-1], step.increment))
        return np.array(poses)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """What is known of robot and sensor before a run: one row per data set, the same for all runs.

    The sensor's own noise is in the observations. ``source`` says where the numbers are from.
    """

    wheels: WheelNoise
    min_range_m: float
    max_range_m: float
    field_of_view_rad: float  # full opening angle, about straight ahead
    detection_probability: float  # that a landmark in view is reported
    clutter: float  # false observations per scan
    # A scan is used if the robot has moved so far since the last one that was, or turned so far
    least_move_m: float
    least_turn_rad: float
    # Largest errors of a pose before the run is solved for again
    shift_m: float
    # Distance within which landmarks are neighbours: they may be one, or be taken for each other
    neighbourhood_m: float
    source: str
    unmapped_per_m2: float = 0.02  # how many landmarks may not be in the map yet
    # Diameter of what is one landmark where there are no ids: the sensor sees any part of it, and
    # cannot tell the parts apart
    extent_m: float = 0.0
    # Share of 15 scans that must hold what is to be a new landmark: small, if nothing else is seen
    new_share: float = 0.6
    # Standard deviations of a motion that the wheels do not report: by a bump
    jump_sigma_m: float = 0.0
    jump_sigma_rad: float = 0.0
    range_offset_sigma_m: float = 0.0  # of the unknown constant error of all ranges
    # Whether it is a laser or a camera: of surfaces, errors do not depend on the side
    is_optical: bool = False
    # Share of the variance of range and bearing that is one error as long as a landmark is in view
    common_share: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DataSet:
    """Drives with one kind of robot and sensor."""

    title: str
    sensor: Sensor
    runs: tuple[Run, ...]


def positions_of(
    t_s: Array, forward_mps: Array, left_mps: Array, turn_radps: Array, at_s: Array
) -> Array:
    """Return poses by dead reckoning at some times, shape (k, 3), from the origin at ``t_s[0]``.

    Velocities in the body frame, (n,) each, hold from their time to the next one; the robot stands
    before the first. With v = (forward, left), a turn w and a time d the step of a body whose
    velocity is constant is (sin wd / (wd) v + (1 - cos wd) / (wd) J v) d, J a quarter turn to the
    left.
    """
    last = max(float(at_s[-1]), float(t_s[-1]))
    steps = _twist_steps(np.diff(np.append(t_s, last)), forward_mps, left_mps, turn_radps)
    heading = np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    x = np.concatenate([[0.0], np.cumsum(c * steps[:, 0] - s * steps[:, 1])])
    y = np.concatenate([[0.0], np.cumsum(s * steps[:, 0] + c * steps[:, 1])])
    i = np.clip(np.searchsorted(t_s, at_s, side="right") - 1, 0, len(t_s) - 1)
    passed = np.maximum(at_s - t_s[i], 0.0)
    part = _twist_steps(passed, forward_mps[i], left_mps[i], turn_radps[i])
    c, s = np.cos(heading[i]), np.sin(heading[i])
    return np.column_stack(
        [
            x[i] + c * part[:, 0] - s * part[:, 1],
            y[i] + s * part[:, 0] + c * part[:, 1],
            heading[i] + part[:, 2],
        ]
    )


def _twist_steps(duration_s: Array, forward: Array, left: Array, turn: Array) -> Array:
    angle = turn * duration_s
    small = np.abs(angle) < _STILL_RAD
    safe = np.where(small, 1.0, angle)
    along = np.where(small, 1.0, np.sin(safe) / safe)
    across = np.where(small, angle / 2, (1.0 - np.cos(safe)) / safe)
    x = (along * forward - across * left) * duration_s
    y = (across * forward + along * left) * duration_s
    return np.column_stack([x, y, angle])


def steps_of(
    keys: Iterable[Hashable],
    t_ns: Iterable[int],
    increments: Iterable[Array],
    seen: Mapping[Any, Sequence[LandmarkMeasurement]],
) -> tuple[DriveStep, ...]:
    """Return the steps of a drive; ``keys`` say which observations are made at the end of each."""
    return tuple(
        DriveStep(t_ns=stamp, increment=increment, observations=tuple(seen.get(key, ())))
        for key, stamp, increment in zip(keys, t_ns, increments, strict=True)
    )


def steps_at(
    at_s: Array, poses: Array, seen: Mapping[float, Sequence[LandmarkMeasurement]]
) -> tuple[DriveStep, ...]:
    """Return the steps to poses (k, 3) at times (k,), with what is seen at exactly these times."""
    return steps_of(at_s.tolist(), nanoseconds(at_s).tolist(), increments_of(poses), seen)


def increments_of(poses: Array) -> list[Array]:
    """Return the motion to each of the poses (k, 3) from the one before; zero for the first."""
    return [np.zeros(3), *(between(a, b) for a, b in pairwise(poses))]


def nanoseconds(seconds: Array) -> NDArray[np.int64]:
    """Return stamps in nanoseconds, to as many decimals as a float of that size has.

    A time since 1970 has six of them.

    >>> nanoseconds(np.array([1248444187.156, 0.127943992614746])).tolist()
    [1248444187156000000, 127943993]
    """
    whole = np.floor(seconds)
    decimals = np.clip(-1 - np.ceil(np.log10(np.spacing(np.maximum(np.abs(seconds), 1.0)))), 0, 9)
    unit = 10.0**decimals
    ticks = np.round((seconds - whole) * unit).astype(np.int64)
    stamps: NDArray[np.int64] = whole.astype(np.int64) * 10**9
    stamps += ticks * (10**9 / unit).astype(np.int64)
    return stamps


def step_times(times_s: Array, first_s: float, last_s: float, most_gap_s: float) -> Array:
    """Return ascending times from first to last: the given ones in there, and others.

    Two of them are at most ``most_gap_s`` apart.
    """
    inside = times_s[(times_s >= first_s) & (times_s <= last_s)]
    ends = np.unique(np.concatenate([inside, [first_s, last_s]]))
    parts: list[Sequence[float] | Array] = [ends]
    gaps = np.diff(ends)
    for start, gap in zip(ends[:-1][gaps > most_gap_s], gaps[gaps > most_gap_s], strict=True):
        n = int(np.ceil(gap / most_gap_s))
        parts.append(start + gap * np.arange(1, n) / n)
    return np.unique(np.concatenate(parts))
