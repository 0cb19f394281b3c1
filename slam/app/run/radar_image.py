"""The radar image of a run: while it is driven, and of all that a session or a recording holds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from slam.app.run.runner import Odometry, RunRecord
from slam.frames import RadarFrame
from slam.front_end.pulse import ModulePulse, PulseModel
from slam.front_end.pulse_estimation import module_pulse
from slam.geometry import FieldOfView, Mount, between, compose
from slam.imaging.patches import Patch, PatchMaker, PatchRule, RecordedFrame
from slam.imaging.range_profiles import StaticPart
from slam.imaging.room import RoomImage
from slam.library.pose_track import PoseTrack
from slam.live.errors import AppError
from slam.live.frame_sources import less_gain
from slam.live.odometry_track import MOST_GAP_NS, NS_PER_S, OdometryTrack
from slam.live.session.reader import RecordedSession
from slam.live.session_records import (
    RadarImage,
    Scan,
    SessionInfo,
    SessionObserver,
    Snapshot,
)

Array = NDArray[np.float64]

REACH_M = 2.0
"""How far radars are looked at by default: farther than SLAM does, which needs single echoes."""
_LIVE_CELL_M = 0.025  # echoes are 2 to 4 cm wide
_OPENING_RAD = math.radians(76.0)  # to -4 dB of the beam
_RULE = PatchRule(hop_m=PatchRule().travel_m)  # what overlaps shows little more
_STOOD_M = 0.02  # less far apart, two poses are of a robot that stood meanwhile
_FAR_M = 1e7  # farther away no pole or origin of a map is
_WHOLE = 1 << 60  # frames in the memory of a static part: all
_EVERY_NS, _EVERY_SHARE = 5 * NS_PER_S, 20
"""An image is given out so often, in a long run ever rarer: when a twentieth of it has passed."""


def _maker(
    radar: int,
    mount: Mount,
    model: PulseModel,
    reach_m: float = REACH_M,
    static: StaticPart | None = None,
) -> PatchMaker:
    """Return what makes the patches of one radar, with the pulse of its rig file, if any."""
    nominal = ModulePulse(model=model, error=0.0)

    @cache
    def pulse_of(bin_length_m: float) -> ModulePulse:
        return nominal if mount.pulse is None else module_pulse(mount.pulse, model, bin_length_m)

    view = FieldOfView(opening_rad=_OPENING_RAD, max_range_m=reach_m)
    return PatchMaker(radar, mount, view, pulse_of, _RULE, static=static)


def _model(info: SessionInfo) -> PulseModel:
    usual = PulseModel()
    return PulseModel(
        carrier_hz=info.setting("matched_filter", "carrier_hz", usual.carrier_hz),
        bandwidth_hz=info.setting("matched_filter", "bandwidth_hz", usual.bandwidth_hz),
    )


class NoImageError(AppError):
    """There is nothing to make an image of; the message does not name the file."""


class RollingImage(SessionObserver):
    """Images a run while it is driven: a patch for every 25 cm of each radar's way, once.

    Poses within a patch are the wheels'; a patch is placed by the estimate when it is complete, and
    stays there. Those of a robot that is lost are left out.

    Parameters
    ----------
    outlets
        Get the image so far, every 5 s at first, later ever rarer, and at the end.
    is_late
        Whether SLAM is behind the radars: patches that are complete then are left out.

    Attributes
    ----------
    n_patches, n_left_out
        How many are in the image, and how many are not since SLAM was late.
    """

    def __init__(
        self,
        info: SessionInfo,
        odometry: Odometry,
        outlets: Sequence[SessionObserver],
        *,
        is_late: Callable[[], bool] = lambda: False,
    ) -> None:
        self._gains_db = [radar.gain_db for radar in info.radars]
        self._makers = [
            _maker(index, radar.mount, _model(info)) for index, radar in enumerate(info.radars)
        ]
        self._odometry, self._outlets, self._is_late = odometry, outlets, is_late
        self._patches: list[Patch] = []
        self._room = RoomImage(cell_m=_LIVE_CELL_M)
        self._first_ns: int | None = None
        self._next_ns = self._newest_ns = 0
        self._n_given = 0
        self.n_patches = self.n_left_out = 0

    def on_scan(self, scan: Scan) -> None:
        if not scan.used:
            return
        for frame in scan.frames:
            pose = self._odometry.pose_at(frame.t_ns)
            own = less_gain(frame, self._gains_db[frame.radar])
            if (patch := self._makers[frame.radar].add(own, pose)) is not None:
                self._patches.append(patch)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self._newest_ns = snapshot.t_ns
        if self._first_ns is None:
            self._first_ns = snapshot.t_ns
        patches, self._patches = self._patches, []
        if snapshot.step is not None and snapshot.step.is_lost:
            return
        map_from_odom = compose(snapshot.estimate, between(snapshot.odometry, np.zeros(3)))
        for patch in patches:
            if self._is_late():
                self.n_left_out += 1
            else:
                self._room.add(patch, compose(map_from_odom, patch.origin))
                self.n_patches += 1
        if snapshot.t_ns >= self._next_ns:
            lasted_ns = snapshot.t_ns - self._first_ns
            self._next_ns = snapshot.t_ns + max(_EVERY_NS, lasted_ns // _EVERY_SHARE)
            self._give_out()

    def close(self) -> None:
        self._give_out()

    def _give_out(self) -> None:
        if self.n_patches == self._n_given:
            return
        self._n_given = self.n_patches
        image = RadarImage(t_ns=self._newest_ns, grid=self._room.grid, levels=self._room.levels)
        for outlet in self._outlets:
            outlet.take(image)


class ImagePath:
    """The path that an image is made along.

    It is known from its first to its last pose, but for gaps in which the robot has moved.

    Parameters
    ----------
    name, frame
        What the path is, and in which frame it, and the image, are: "world", "map", "odom", or ""
        where that is not known.
    t_ns, poses
        Shape (n,), and (n, 3).
    wheels
        Of a path that jumps from pose to pose: odometry, which patches are made by.
    """

    def __init__(
        self,
        name: str,
        frame: str,
        t_ns: NDArray[np.int64],
        poses: Array,
        wheels: OdometryTrack | None = None,
    ) -> None:
        self.name, self.frame, self.t_ns, self.poses = name, frame, t_ns, poses
        self._wheels, self._track = wheels, PoseTrack(may_restart=False)
        for stamp_ns, pose in zip(t_ns.tolist(), poses.tolist(), strict=True):
            self._track.add(stamp_ns, pose)
        steps_m = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        self._is_gap = (np.diff(t_ns) > MOST_GAP_NS) & (steps_m > _STOOD_M)

    def is_known(self, t_ns: int) -> bool:
        """Return whether the pose at a time is known."""
        after = int(np.searchsorted(self.t_ns, t_ns))
        if after in (0, len(self.t_ns)):
            return bool(t_ns in (self.t_ns[0], self.t_ns[-1]))
        return not self._is_gap[after - 1]

    def moves_at(self, t_ns: int) -> Array:
        """Return a pose (3,) that does not jump, in whichever frame."""
        return (self._wheels or self._track).pose_at(t_ns)

    def place_at(self, t_ns: int) -> Array:
        """Return the pose (3,) by the path."""
        if self._wheels is None:
            return self._track.pose_at(t_ns)
        row = max(int(np.searchsorted(self.t_ns, t_ns, side="right")) - 1, 0)
        before = self._wheels.pose_at(int(self.t_ns[row]))
        return compose(self.poses[row], between(before, self._wheels.pose_at(t_ns)))


def path_of(
    record: RunRecord, odometry: OdometryTrack, info: SessionInfo, name: str | None = None
) -> ImagePath:
    """Return a path of a run by name: smoothed, estimate or odometry; None: the first that it has.

    In the frame of the world where that is known, else of the map. The wheels' path is laid on the
    first state that is not lost, and stays in their own frame if there is none. NoImageError if
    there is no such path.
    """
    states, smoothed = record.states, record.smoothed
    name = name or ("smoothed" if smoothed else "estimate" if len(states) else "odometry")
    place, wheels = np.zeros(3), None
    frame = "world" if info.is_world_known else "map"
    if info.is_world_known:
        place = record.world_from_map
    if name == "odometry":
        t_ns = np.array([sample.t_ns for sample in odometry])
        poses = np.array([odometry.pose_at(at_ns) for at_ns in t_ns.tolist()])
        if len(found := np.flatnonzero(~states.lost)):
            begin = between(states.odometry[found[0]], np.zeros(3))
            place = compose(place, compose(states.estimate[found[0]], begin))
        else:
            place, frame = np.zeros(3), "odom"
    elif name == "smoothed" and smoothed is not None:
        t_ns, poses = smoothed.t_ns, smoothed.poses
    elif name == "estimate" and len(states):
        if states.lost.all():
            raise NoImageError(
                "the robot was lost all the time, so path estimate has no pose; take `uwb-slam "
                "image --path odometry`"
            )
        t_ns, poses, wheels = states.t_ns, states.estimate, odometry
        t_ns, poses = t_ns[~states.lost], poses[~states.lost]
    else:
        raise NoImageError(f"there is no path {name}: replay the session, or take another --path")
    return ImagePath(name, frame, t_ns, np.array([compose(place, one) for one in poses]), wheels)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RoomPicture:
    """The image of all frames along a path.

    `n_frames` are all of them, `n_placed` those of times at which the path is known.
    """

    room: RoomImage
    path: ImagePath
    n_frames: int
    n_placed: int
    n_patches: int


def image_of(
    frames: Callable[[], Iterable[tuple[int, RadarFrame | RecordedFrame]]],
    mounts: Sequence[Mount],
    path: ImagePath,
    room: RoomImage,
    *,
    model: PulseModel,
    reach_m: float = REACH_M,
) -> RoomPicture:
    """Image frames, each with the index of its mount; they are read twice.

    First for what stands still with the robot, then for patches. NoImageError if they show nothing.
    """
    away_m = max(np.abs(path.poses[:, :2]).max(), *(max(abs(m.x_m), abs(m.y_m)) for m in mounts))
    if away_m > _FAR_M:
        raise NoImageError(f"a mount, or a pose of path {path.name}, is {away_m:.4g} m away")
    statics = [StaticPart(memory=_WHOLE) for _ in mounts]
    makers = [
        _maker(index, mount, model, reach_m, static)
        for index, (mount, static) in enumerate(zip(mounts, statics, strict=True))
    ]
    n_frames = n_placed = n_patches = 0
    times_ns = [*path.t_ns[[0, -1]].tolist(), math.inf, -math.inf]
    for radar, frame in frames():
        n_frames += 1
        times_ns[2:] = min(times_ns[2], frame.t_ns), max(times_ns[3], frame.t_ns)
        if path.is_known(frame.t_ns):
            n_placed += 1
            pose, maker = path.moves_at(frame.t_ns), makers[radar]
            statics[radar].add(maker.near(frame), maker.antenna_at(pose), float(pose[2]))
    if not n_frames:
        raise NoImageError("holds no frames")
    if not n_placed:
        since, until, first, last = (at_ns / NS_PER_S for at_ns in times_ns)
        raise NoImageError(
            f"frames are of {first:.3f} to {last:.3f} s, and path {path.name} is of {since:.3f} to "
            f"{until:.3f} s, so it places none of them; give a path by the clock of the frames"
        )
    for radar, frame in frames():
        if path.is_known(frame.t_ns):
            patch = makers[radar].add(frame, path.moves_at(frame.t_ns))
            if patch is not None:
                room.add(patch, path.place_at(int(patch.t_ns[patch.middle])))
                n_patches += 1
    if not np.nan_to_num(room.values).any():
        raise NoImageError(
            f"path {path.name}: its {n_patches} patches show nothing of the area; a patch takes "
            f"{_RULE.travel_m:g} m of way"
        )
    return RoomPicture(
        room=room, path=path, n_frames=n_frames, n_placed=n_placed, n_patches=n_patches
    )


def session_image(
    session: RecordedSession,
    path: ImagePath,
    room: RoomImage | None = None,
    *,
    reach_m: float = REACH_M,
) -> RoomPicture:
    """Image the frames of a session; see `image_of`."""
    return image_of(
        lambda: ((frame.radar, frame) for frame in session.frames()),
        [radar.mount for radar in session.info.radars],
        path,
        room or RoomImage(),
        model=_model(session.info),
        reach_m=reach_m,
    )
