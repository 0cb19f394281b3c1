"""Trajectories as TUM text: `timestamp x y z qx qy qz qw`, seconds and metres, no header.

Stamps are exact: text carries the int64 nanoseconds as a decimal with nine places, and reading
goes through Decimal, so no stamp passes through a float.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import AppError

NS_PER_S = 1_000_000_000
_FIELDS = 8
_MAX_BYTES = 1 << 28
"""Weeks of poses; a longer or endless file is not a trajectory."""
_MAX_STAMP_S = Decimal(2**63) / NS_PER_S
"""Where int64 nanoseconds end; a larger stamp was written in another unit."""


class TumError(AppError):
    """A line is not TUM text; the message names the line and what is expected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TumSample:
    """One line of a planar trajectory, as written: position and the twist of the quaternion."""

    t_ns: int
    x_m: float
    y_m: float
    qz: float
    qw: float

    @property
    def heading_rad(self) -> float:
        """Rotation about the vertical, in (-2 pi, 2 pi]: the twist part of the quaternion.

        >>> TumSample(t_ns=0, x_m=0.0, y_m=0.0, qz=1.0, qw=0.0).heading_rad == math.pi
        True
        """
        return 2.0 * math.atan2(self.qz, self.qw)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """Poses over time.

    Attributes
    ----------
    stamps_ns
        Shape (n,), int64, ascending.
    poses
        Shape (n, 3), float64: x [m], y [m], heading [rad].
    """

    stamps_ns: NDArray[np.int64]
    poses: NDArray[np.float64]


def parse_tum_line(line: str) -> TumSample:
    """Read one TUM line; roll and pitch are ignored, as the robot is planar.

    Raises
    ------
    TumError
        Fewer or more than eight numbers, a number that is not finite, a stamp that cannot be
        seconds, a quaternion without length.

    Examples
    --------
    >>> parse_tum_line("12.000000005 1.5 -2 0 0 0 0 1")
    TumSample(t_ns=12000000005, x_m=1.5, y_m=-2.0, qz=0.0, qw=1.0)
    """
    fields = line.split()
    if len(fields) != _FIELDS:
        raise TumError(
            "expected 8 numbers (timestamp x y z qx qy qz qw), "
            f"found {len(fields)}: {line.strip()!r}"
        )
    try:
        stamp_s = Decimal(fields[0])
        x, y, _z, _qx, _qy, qz, qw = (float(field) for field in fields[1:])
    except (InvalidOperation, ValueError):
        raise TumError(f"not a number in TUM line {line.strip()!r}") from None
    if not stamp_s.is_finite() or not all(map(math.isfinite, (x, y, qz, qw))):
        raise TumError(f"not a finite number in TUM line {line.strip()!r}")
    # copy_abs, as abs would round to the context and overflow on a huge exponent
    if stamp_s.copy_abs() >= _MAX_STAMP_S:
        raise TumError(f"stamps must be seconds, found {fields[0]} in TUM line {line.strip()!r}")
    if qz == 0.0 and qw == 0.0:
        raise TumError(f"quaternion without a heading in TUM line {line.strip()!r}")
    return TumSample(t_ns=round(stamp_s * NS_PER_S), x_m=x, y_m=y, qz=qz, qw=qw)


def format_tum_line(t_ns: int, pose: NDArray[np.float64]) -> str:
    """Write a pose [x m, y m, heading rad] as one TUM line; floats round-trip exactly.

    >>> format_tum_line(1_000_000_001, np.array([0.5, -1.0, 0.0]))
    '1.000000001 0.5 -1.0 0 0 0 0.0 1.0'
    """
    x, y, heading = (float(value) for value in pose)
    sign = "-" if t_ns < 0 else ""
    seconds, rest = divmod(abs(int(t_ns)), NS_PER_S)
    qz, qw = math.sin(heading / 2), math.cos(heading / 2)
    return f"{sign}{seconds}.{rest:09d} {x!r} {y!r} 0 0 0 {qz!r} {qw!r}"


def write_tum(path: Path, trajectory: Trajectory) -> None:
    lines = map(format_tum_line, trajectory.stamps_ns.tolist(), trajectory.poses)
    path.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")


def read_tum(path: Path) -> Trajectory:
    """Read a TUM file; empty lines and lines that begin with `#` are skipped.

    Raises
    ------
    TumError
        The file cannot be read, holds no pose, goes back in time, or has a malformed line.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
        text = content.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise TumError(f"{path}: cannot read: {reason}") from None
    if len(content) > _MAX_BYTES:
        raise TumError(f"{path}: longer than {_MAX_BYTES >> 20} MiB, so it is no trajectory")
    samples = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            samples.append(parse_tum_line(line))
        except TumError as error:
            raise TumError(f"{path}, line {number}: {error}") from None
        if len(samples) > 1 and samples[-1].t_ns <= samples[-2].t_ns:
            raise TumError(f"{path}, line {number}: its time is not after the line before")
    if not samples:
        raise TumError(f"{path}: holds no pose")
    return trajectory_of(samples)


def trajectory_of(samples: Iterable[TumSample]) -> Trajectory:
    rows = [(s.t_ns, s.x_m, s.y_m, s.heading_rad) for s in samples]
    return Trajectory(
        stamps_ns=np.array([row[0] for row in rows], dtype=np.int64),
        poses=np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 3),
    )
