"""Detections of the paper's authors' MATLAB files as a session, and a session's as such a file.

One row per collected state:

======  ===============  ========================================================================
odom    (n, 3)           pose by the wheels: x, y [mm], heading [rad]
obsLHS  (n, m, 2)        fixes of the two left radars: distance [mm], bearing [rad], from the body's
obsRHS  (n, m, 2)        origin and counter-clockwise from forward; of the right ones, unwrapped to
                         pi and more; rows of zeros are empty
R1..R4  (n, n_bins)      raw frames of the four radars; rows of zeros are missing
======  ===============  ========================================================================

Three more variables, which their programs ignore and ours write::

    t       (n, 1)   session time of the state [s]
    mounts  (4, 3)   of the radars: x, y [mm], boresight [rad], body frame
    bins    (4, 2)   of the radars: range of the first bin, and length of one [mm], without what the
                     module measures too long

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
from scipy.io import loadmat, savemat

from slam.app.convert.imported_head import imported_info, imported_radar
from slam.app.convert.rosbag import authors_rig, rig_of
from slam.app.errors import naming
from slam.app.session.writer import SessionLog
from slam.config import SlamConfig
from slam.frames import RadarFrame
from slam.front_end import make_detector
from slam.geometry import Mount, RadarPair, Rig
from slam.live.errors import AppError, OdometryError
from slam.live.frame_sources import recorded_frame
from slam.live.odometry_track import NS_PER_S, OdometryTrack, TumSample
from slam.live.session.reader import RecordedSession, describe_kind
from slam.live.session_records import RadarInfo, Scan
from slam.paper.trilateration import Trilaterator
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.validation import reason_of
from xethru_protocol.wire.x4 import TRUE_PER_MODULE_METRE

_MM = 1e-3
_POSE_UNITS = np.array([_MM, _MM, 1.0])
_FEWEST_FIXES = 5  # that the authors' programs have room for
_RADARS = range(1, 5)

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
    frames
        Raw frames by the number of the radar, 1 to 4, shape (n, n_bins), float32; zeros: none.
    stamps_s
        Shape (n,), ascending; None if not in the file.
    mounts
        Shape (4, 3): x [m], y [m], boresight [rad], body frame; None if not in the file.
    bins_m
        Shape (4, 2): range of the first bin and length of one, true metres; None if not in the
        file.
    """

    odometry: Array
    left: tuple[Array, ...]
    right: tuple[Array, ...]
    frames: dict[int, NDArray[np.float32]]
    stamps_s: Array | None = None
    mounts: Array | None = None
    bins_m: Array | None = None


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
    frames = {
        number: _variable(path, table, f"R{number}", (None,), n_states).astype(np.float32)
        for number in _RADARS
        if f"R{number}" in table
    }
    stamps_s = _variable(path, table, "t", (1,), n_states)[:, 0] if "t" in table else None
    if stamps_s is not None and not np.all(np.diff(stamps_s) > 0):
        raise AppError(f"{path}: t must go forward from state to state")
    mounts = _variable(path, table, "mounts", (3,), 4) if "mounts" in table else None
    bins = _variable(path, table, "bins", (2,), 4) if "bins" in table else None
    if bins is not None and not np.all(bins[:, 1] > 0):
        raise AppError(f"{path}: bins must have a length above zero")
    return MatDrive(
        stamps_s=stamps_s,
        mounts=None if mounts is None else mounts * _POSE_UNITS,
        bins_m=None if bins is None else bins * _MM,
        odometry=odometry * _POSE_UNITS,
        left=tuple(map(_points_of, left)),
        right=tuple(map(_points_of, right)),
        frames=frames,
    )


def write_mat(path: Path, drive: MatDrive) -> None:
    """Write a file that `read_mat`, MATLAB and Octave read."""
    table: dict[str, Any] = {
        "odom": drive.odometry / _POSE_UNITS,
        "obsLHS": _polar_of(drive.left, unwrapped=False),
        "obsRHS": _polar_of(drive.right, unwrapped=True),
    }
    table |= {f"R{number}": rows for number, rows in drive.frames.items()}
    if drive.stamps_s is not None:
        table["t"] = drive.stamps_s[:, np.newaxis]
    if drive.mounts is not None:
        table["mounts"] = drive.mounts / _POSE_UNITS
    if drive.bins_m is not None:
        table["bins"] = drive.bins_m / _MM
    with naming(path):
        path.open("wb").close()  # savemat's own error would not name the reason
        savemat(path, table, appendmat=False, do_compression=True)


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


def _polar_of(states: tuple[Array, ...], *, unwrapped: bool) -> Array:
    most = max([_FEWEST_FIXES, *map(len, states)])
    table = np.zeros((len(states), most, 2))
    for row, points in zip(table, states, strict=True):
        if len(points):
            x, y = points.T
            bearing = np.arctan2(y, x)
            row[: len(points), 0] = np.hypot(x, y) / _MM
            row[: len(points), 1] = bearing % math.tau if unwrapped else bearing
    return table


# The authors' later robot: 18 cm from the middle to the side, 21 cm between the radars of a side.
MAT_RIG = authors_rig(0.105, 0.18)
# As their programs label bins: from zero, 143 of them in 92 cm.
_BIN_M = 0.92 / 143
_SAME_RANGE_M = 1e-4
# The authors collect a state after this much of odometry, in either.
_STEP_M2, _STEP_RAD = 20e-6, 2e-3


def convert_mat(
    mat: Path,
    out: Path,
    stop: StopFlag,
    *,
    preset: str,
    rig: Rig | None,
    rate_hz: float,
) -> str:
    """Write the detections and odometry of a file as a session; return a line about it.

    Without `rig` the mounts are those in the file, or else those of the authors' robot; `rate_hz`
    is of states, for a file without stamps.

    Raises
    ------
    AppError
        The file makes no sense, or the rig has not one pair of radars on each side.
    """
    drive = read_mat(mat)
    if rig is None:
        rig = MAT_RIG if drive.mounts is None else rig_of(drive.mounts.tolist())
    pairs = _sides(mat, rig)
    if drive.stamps_s is None:
        stamps_ns = [round(row * NS_PER_S / rate_hz) for row in range(len(drive.odometry))]
    else:
        stamps_ns = [round(stamp_s * NS_PER_S) for stamp_s in drive.stamps_s.tolist()]
    bins_m = np.array([(0.0, _BIN_M)] * 4)
    if drive.bins_m is not None:
        bins_m = drive.bins_m / TRUE_PER_MODULE_METRE
    radars = tuple(
        imported_radar(
            # whatever a module measures too long, it is in the fixes already
            replace(mount, range_offset_m=0.0),
            range_start_m=start_m,
            bin_length_m=length_m,
            n_bins=drive.frames[number].shape[1] if number in drive.frames else 0,
            rate_hz=rate_hz,
        )
        for number, mount, (start_m, length_m) in zip(
            _RADARS, rig.mounts, bins_m.tolist(), strict=True
        )
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
            log.on_scan(Scan(counter=row, t_ns=t_ns, frames=_frames(drive, radars, row, t_ns)))
    finally:
        log.close()
    result = f"{out}: {len(poses)} states with {n_fixes} fixes, made of {n_ranges} ranges"
    if drive.stamps_s is None:
        result += f"; the file has no stamps, {rate_hz:g} states/s are assumed"
    return result


def write_detections(
    session: RecordedSession, out: Path, config: SlamConfig, stop: StopFlag
) -> str:
    """Write what the front end of `config` finds in a session; return a line about it.

    A state is collected as the authors do: after 4.5 mm or 2 mrad of odometry.

    Raises
    ------
    AppError
        The session is damaged or has no odometry, or the rig has not one pair of radars on each
        side.
    """
    rig = session.rig
    sides = _sides(session.path, rig)
    detector, limits = make_detector(config), config.detection
    trilaterator = Trilaterator(config.trilateration, rig, (limits.min_range_m, limits.max_range_m))
    side_of = {
        index: side
        for index, pair in enumerate(trilaterator.pairs)
        for side, wanted in enumerate(sides)
        if (pair.first, pair.second) == (wanted.first, wanted.second)
    }
    track = session.odometry()
    poses: list[Array] = []
    stamps_s: list[float] = []
    fixes: tuple[list[Array], list[Array]] = ([], [])
    frames: dict[int, list[NDArray[np.float32]]] = {number: [] for number in _RADARS}
    for scan in session.scans():
        stop.check()
        # in the order of counters, whether the state is collected or not: a front end may learn
        offsets = [rig.mounts[frame.radar].range_offset_m for frame in scan.frames]
        found = detector.detect_many(scan.frames, offsets)
        try:
            pose = track.pose_at(scan.t_ns)
        except OdometryError:
            continue
        if poses and not _is_apart(poses[-1], pose):
            continue
        poses.append(pose)
        stamps_s.append(scan.t_ns / NS_PER_S)
        located = trilaterator.locate([one for row in found for one in row], scan.t_ns)
        for side in range(2):
            points = [(fix.x_m, fix.y_m) for fix in located if side_of.get(fix.pair) == side]
            fixes[side].append(np.array(points).reshape(-1, 2))
        of_radar = {frame.radar: frame.samples for frame in scan.frames}
        for number in _RADARS:
            n_bins = session.info.radars[number - 1].n_bins
            frames[number].append(of_radar.get(number - 1, np.zeros(n_bins, dtype=np.float32)))
    if not poses:
        raise AppError(f"{session.path}: holds no scan with odometry")
    drive = MatDrive(
        odometry=np.array(poses),
        left=tuple(fixes[0]),
        right=tuple(fixes[1]),
        frames={number: np.array(rows) for number, rows in frames.items()},
        stamps_s=np.array(stamps_s),
        mounts=np.array([(mount.x_m, mount.y_m, mount.yaw_rad) for mount in rig.mounts]),
        bins_m=TRUE_PER_MODULE_METRE
        * np.array([(radar.range_start_m, radar.bin_length_m) for radar in session.info.radars])
        - [(mount.range_offset_m, 0.0) for mount in rig.mounts],
    )
    write_mat(out, drive)
    n_fixes = sum(map(len, drive.left)) + sum(map(len, drive.right))
    return f"{out}: {len(poses)} states with {n_fixes} fixes"


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


def _frames(
    drive: MatDrive, radars: tuple[RadarInfo, ...], row: int, t_ns: int
) -> tuple[RadarFrame, ...]:
    return tuple(
        recorded_frame(number - 1, radars[number - 1], rows[row], t_ns=t_ns, counter=row)
        for number, rows in sorted(drive.frames.items())
        if rows[row].any()
    )


def _is_apart(before: Array, after: Array) -> bool:
    step = after - before
    turn = math.remainder(float(step[2]), math.tau)
    return bool(step[0] ** 2 + step[1] ** 2 >= _STEP_M2 or abs(turn) >= _STEP_RAD)
