"""Detections of the paper's authors' MATLAB files as a session.

One row per collected state:

======  ===============  ========================================================================
odom    (n, 3)           pose by the wheels: x, y [mm], heading [rad]
obsLHS  (n, m, 2)        fixes of the two left radars: distance [mm], bearing [rad], from the body's
obsRHS  (n, m, 2)        origin and counter-clockwise from forward; of the right ones, unwrapped to
                         pi and more; rows of zeros are empty
======  ===============  ========================================================================

Raw frames, which such a file may hold, too, are not read.

Their fixes are points; SLAM here takes ranges. A fix determines the two ranges it is made of, since
it is where the circles around the two radars of its side meet. A session gets these ranges, each
once, however many fixes share it. Paired again they give the same fixes, and ghosts that the
authors' narrower field of view left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from slam.app.convert.imported_head import imported_info, imported_radar
from slam.app.convert.rosbag import authors_rig
from slam.app.session.writer import SessionLog
from slam.geometry import Mount, RadarPair, Rig
from slam.live.errors import AppError
from slam.live.odometry_track import NS_PER_S, OdometryTrack, TumSample
from slam.live.session.reader import describe_kind
from slam.live.session_records import Scan
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.validation import reason_of

_MM = 1e-3
_POSE_UNITS = np.array([_MM, _MM, 1.0])

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatDrive:
    """What such a file holds.

    Attributes
    ----------
    odometry
        Shape (n, 3): x [m], y [m], heading [rad], odometry frame.
    left, right
        For each state the fixes of that side, shape (k, 2): x [m], y [m], body frame.
    """

    odometry: Array
    left: tuple[Array, ...]
    right: tuple[Array, ...]


def read_mat(path: Path) -> MatDrive:
    """Read a file; raise AppError if it lacks the variables of the module's docstring."""
    try:
        with path.open("rb") as stream:
            table = loadmat(stream)  # type: ignore[arg-type]  # takes files, the stubs know names
    except NotImplementedError:
        raise AppError(
            f"{path}: a MATLAB file of version 7.3; in MATLAB, save it with '-v7'"
        ) from None
    except OSError as error:
        raise AppError(f"{path}: cannot read: {error.strerror or error}") from None
    except Exception as error:  # scipy documents no exceptions for damaged files
        reason = " ".join(reason_of(error).split())
        raise AppError(
            f"{path}: no MATLAB file, or a damaged one{describe_kind(path)}: {reason}"
        ) from None
    odometry = _variable(path, table, "odom", (3,))
    n_states = len(odometry)
    if not n_states:
        raise AppError(f"{path}: odom is empty, there is no state")
    left = _variable(path, table, "obsLHS", (None, 2), n_states)
    right = _variable(path, table, "obsRHS", (None, 2), n_states)
    return MatDrive(
        odometry=odometry * _POSE_UNITS,
        left=tuple(map(_points_of, left)),
        right=tuple(map(_points_of, right)),
    )


def _variable(
    path: Path,
    table: dict[str, Any],
    name: str,
    ends: tuple[int | None, ...],
    n_states: int | None = None,
) -> Array:
    """Return a variable of shape (n_states, *ends); None stands for any number."""
    wanted = ", ".join("n" if size is None else str(size) for size in (n_states, *ends))
    value = table.get(name)
    if value is None:
        known = ", ".join(sorted(key for key in table if not key.startswith("__"))) or "nothing"
        raise AppError(f"{path}: holds no {name} of shape ({wanted}); it holds {known}")
    fits = (
        isinstance(value, np.ndarray)
        and value.dtype.kind in "fiu"
        and value.ndim == 1 + len(ends)
        and all(
            size in (None, found)
            for size, found in zip((n_states, *ends), value.shape, strict=True)
        )
    )
    if not fits:
        found = getattr(value, "shape", type(value).__name__)
        raise AppError(f"{path}: {name} is {found}, must be numbers of shape ({wanted})")
    numbers = np.asarray(value, dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise AppError(f"{path}: {name} holds NaN or infinity")
    return numbers


def _points_of(rows: Array) -> Array:
    """Return the points of one state's fixes, shape (k, 2) [m], from (m, 2) [mm, rad]."""
    distance_mm, bearing = rows[rows[:, 0] > 0].T
    return _MM * np.column_stack([distance_mm * np.cos(bearing), distance_mm * np.sin(bearing)])


# The authors' later robot: 18 cm from the middle to the side, 21 cm between the radars of a side.
MAT_RIG = authors_rig(0.105, 0.18)
# As their programs label bins: from zero, 143 of them in 92 cm.
_BIN_M = 0.92 / 143
_SAME_RANGE_M = 1e-4


def convert_mat(
    mat: Path,
    out: Path,
    stop: StopFlag,
    *,
    preset: str,
    rig: Rig,
    rate_hz: float,
) -> str:
    """Write the detections and odometry of a file as a session; return a line about it.

    `rate_hz` is of states: such files have no stamps.

    Raises
    ------
    AppError
        The file makes no sense, or the rig has not one pair of radars on each side.
    """
    drive = read_mat(mat)
    pairs = _sides(mat, rig)
    stamps_ns = [round(row * NS_PER_S / rate_hz) for row in range(len(drive.odometry))]
    radars = tuple(
        imported_radar(
            # whatever a module measures too long, it is in the fixes already
            replace(mount, range_offset_m=0.0),
            range_start_m=0.0,
            bin_length_m=_BIN_M,
            n_bins=0,
            rate_hz=rate_hz,
        )
        for mount in rig.mounts
    )
    info = imported_info(mat, radars, preset, time_base="states", has_detections=True)
    poses = [
        TumSample(t_ns=t_ns, x_m=x, y_m=y, qz=math.sin(turn / 2), qw=math.cos(turn / 2))
        for t_ns, (x, y, turn) in zip(stamps_ns, drive.odometry.tolist(), strict=True)
    ]
    log = SessionLog(out, info, OdometryTrack(poses), start_ns=stamps_ns[0])
    n_fixes = n_ranges = 0
    try:
        for row, t_ns in enumerate(stamps_ns):
            stop.check()
            for pair, points in zip(pairs, (drive.left[row], drive.right[row]), strict=True):
                n_fixes += len(points)
                for radar in (pair.first, pair.second):
                    ranges_m = _ranges(points, rig.mounts[radar])
                    n_ranges += len(ranges_m)
                    log.on_detections(radar, t_ns, ranges_m)
            log.on_scan(Scan(counter=row, t_ns=t_ns, frames=()))
    finally:
        log.close()
    return (
        f"{out}: {len(poses)} states with {n_fixes} fixes, made of {n_ranges} ranges; the file has "
        f"no stamps, {rate_hz:g} states/s are assumed"
    )


def _sides(path: Path, rig: Rig) -> tuple[RadarPair, RadarPair]:
    """Return the pair that looks to the left and the one that looks to the right."""
    pairs = rig.pairs()
    left = [pair for pair in pairs if pair.ahead[1] > 0]
    right = [pair for pair in pairs if pair.ahead[1] < 0]
    if len(rig.mounts) != 4 or len(left) != 1 or len(right) != 1:
        raise AppError(
            f"{path}: the authors' layout is of four radars, a pair to the left and one to the "
            f"right; the rig has {len(rig.mounts)}, {len(left)} and {len(right)} such pairs"
        )
    return left[0], right[0]


def _ranges(points: Array, mount: Mount) -> Array:
    """Return the distances of points from a radar, each once, shape (k,) [m], ascending."""
    ranges_m = np.sort(np.hypot(points[:, 0] - mount.x_m, points[:, 1] - mount.y_m))
    new = np.diff(ranges_m, prepend=-math.inf) > _SAME_RANGE_M
    return ranges_m[new]
