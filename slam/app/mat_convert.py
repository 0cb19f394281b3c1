"""Detections of the paper's authors' MATLAB files as a session, and a session's as such a file.

Their fixes are points; SLAM here takes ranges. A fix says exactly which two ranges it is made of,
since it is where the circles around the two radars of its side meet, so these are what a session
gets: each once, however many fixes share it. Paired again they give the same fixes, and ghosts that
the authors' narrower field of view left out are for the settings of SLAM to judge.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import AppError, OdometryError
from slam.app.imported import SlamSettings, imported_info, imported_radar
from slam.app.mat_file import MatDrive, read_mat, write_mat
from slam.app.odometry import OdometryTrack
from slam.app.session import RadarInfo, Scan
from slam.app.session_log import SessionLog
from slam.app.session_reader import RecordedSession
from slam.app.sources import TRUE_PER_MODULE_METRE
from slam.app.tum import NS_PER_S, TumSample
from slam.config import SlamConfig
from slam.detection import make_detector
from slam.frames import RadarFrame
from slam.geometry import Mount, RadarPair, Rig
from slam.trilateration import Trilaterator

Array = NDArray[np.float64]

# The authors' later robot: 18 cm from the middle to the side, 21 cm between the radars of a side.
MAT_RIG = Rig(
    mounts=(
        Mount(name="UWBradar1", x_m=0.105, y_m=-0.18, yaw_rad=-math.pi / 2),
        Mount(name="UWBradar2", x_m=-0.105, y_m=0.18, yaw_rad=math.pi / 2),
        Mount(name="UWBradar3", x_m=-0.105, y_m=-0.18, yaw_rad=-math.pi / 2),
        Mount(name="UWBradar4", x_m=0.105, y_m=0.18, yaw_rad=math.pi / 2),
    )
)
# As their programs label bins: from zero, 143 of them in 92 cm.
_BIN_M = 0.92 / 143
_SAME_RANGE_M = 1e-4
# The authors collect a state after this much of odometry, in either.
_STEP_M2, _STEP_RAD = 20e-6, 2e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class MatOptions:
    """What such a file may not say: mounts, states per second, settings of SLAM.

    Without ``rig`` the mounts are those in the file, or else those of the authors' robot.
    """

    rig: Rig | None = None
    rate_hz: float = 5.0
    settings: SlamSettings


def convert_mat(mat: Path, out: Path, options: MatOptions, check: Callable[[], None]) -> str:
    """Write the detections and odometry of a file as a session; return in words what was written.

    Raises
    ------
    AppError
        The file makes no sense, or the rig has not one pair of radars on each side.
    """
    drive = read_mat(mat)
    rig = options.rig or _rig_of(drive)
    pairs = _sides(mat, rig)
    stamps_ns = _stamps_ns(drive, options.rate_hz)
    radars = tuple(
        imported_radar(
            # whatever a module measures too long, it is in the fixes already
            replace(mount, range_offset_m=0.0),
            range_start_m=0.0,
            bin_length_m=_BIN_M,
            n_bins=drive.frames[number].shape[1] if number in drive.frames else 0,
            rate_hz=options.rate_hz,
        )
        for number, mount in enumerate(rig.mounts, start=1)
    )
    info = imported_info(mat, radars, options.settings, time_base="states", has_detections=True)
    poses = [
        TumSample(t_ns=t_ns, x_m=x, y_m=y, qz=math.sin(turn / 2), qw=math.cos(turn / 2))
        for t_ns, (x, y, turn) in zip(stamps_ns, drive.odometry.tolist(), strict=True)
    ]
    log = SessionLog(out, info, OdometryTrack(poses), start_ns=stamps_ns[0])
    n_fixes = n_ranges = 0
    try:
        for row, t_ns in enumerate(stamps_ns):
            check()
            for pair, points in zip(pairs, (drive.left[row], drive.right[row]), strict=True):
                n_fixes += len(points)
                for radar in (pair.first, pair.second):
                    ranges_m = _ranges(points, rig.mounts[radar])
                    n_ranges += len(ranges_m)
                    log.on_detections(radar, t_ns, ranges_m)
            log.on_scan(Scan(counter=row, t_ns=t_ns, frames=_frames(drive, radars, row, t_ns)))
    finally:
        log.close()
    said = f"{out}: {len(poses)} states with {n_fixes} fixes, made of {n_ranges} ranges"
    if drive.stamps_s is None:
        said += f"; the file has no stamps, {options.rate_hz:g} states/s are assumed"
    return said


def write_detections(
    session: RecordedSession, out: Path, config: SlamConfig, check: Callable[[], None]
) -> str:
    """Write what the front end of ``config`` finds in a session; return in words what was written.

    A state is collected as the authors do: after 4.5 mm or 2 mrad of odometry.

    Raises
    ------
    AppError
        The session is damaged or has no odometry, the rig has not one pair of radars on each
        side, or the file exists.
    """
    if out.exists():
        raise AppError(f"{out}: exists; choose another name")
    rig = session.rig
    sides = _sides(session.path, rig)
    detector, trilaterator = make_detector(config), Trilaterator(config.trilateration, rig)
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
    frames: dict[int, list[NDArray[np.float32]]] = {number: [] for number in range(1, 5)}
    for scan, _ in session.scans():
        check()
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
        for number in range(1, 5):
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
    """Return the distances of points from a radar, each once, shape (k,), ascending [m]."""
    ranges_m = np.sort(np.hypot(points[:, 0] - mount.x_m, points[:, 1] - mount.y_m))
    new = np.diff(ranges_m, prepend=-math.inf) > _SAME_RANGE_M
    return ranges_m[new]


def _rig_of(drive: MatDrive) -> Rig:
    if drive.mounts is None:
        return MAT_RIG
    return Rig(
        mounts=tuple(
            Mount(name=f"UWBradar{number}", x_m=x, y_m=y, yaw_rad=yaw)
            for number, (x, y, yaw) in enumerate(drive.mounts.tolist(), start=1)
        )
    )


def _stamps_ns(drive: MatDrive, rate_hz: float) -> list[int]:
    if drive.stamps_s is None:
        return [round(row * NS_PER_S / rate_hz) for row in range(len(drive.odometry))]
    return [round(stamp_s * NS_PER_S) for stamp_s in drive.stamps_s.tolist()]


def _frames(
    drive: MatDrive, radars: tuple[RadarInfo, ...], row: int, t_ns: int
) -> tuple[RadarFrame, ...]:
    return tuple(
        RadarFrame(
            radar=number - 1,
            t_ns=t_ns,
            counter=row,
            samples=rows[row],
            range_start_m=0.0,
            bin_length_m=radars[number - 1].bin_length_m * TRUE_PER_MODULE_METRE,
        )
        for number, rows in sorted(drive.frames.items())
        if rows[row].any()
    )


def _is_apart(before: Array, after: Array) -> bool:
    step = after - before
    turn = math.remainder(float(step[2]), math.tau)
    return bool(step[0] ** 2 + step[1] ** 2 >= _STEP_M2 or abs(turn) >= _STEP_RAD)
