"""Patches: the frames that one radar takes along 20 to 30 cm of path, to be imaged together.

Over so short a way odometry is good to a fraction of the 20 mm of range in which the phase of an
echo turns once; over a whole room it is not. Radars are never summed together: their phases differ.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from slam.frames import RadarFrame, usable_samples
from slam.front_end.pulse import ModulePulse, PulseModel
from slam.geometry import FieldOfView, Mount, transform
from slam.imaging.back_projection import Aperture
from slam.imaging.range_profiles import (
    ProfileFilter,
    RangeProfiles,
    Samples,
    StaticPart,
    baseband_profiles,
)

Array = NDArray[np.float64]

# How far beyond the end of the field of view bins are kept: the pulse of an echo there
_MARGIN_M = 0.3
# Until the robot has turned, a wall beside its way stands still like the robot itself, so only what
# is nearer than the robot is large is taken for its own; from so many headings on, all.
_ROBOT_M, _TURNED = 0.45, 8
_MOST_SAMPLE = 1e12  # of a frame in any unit; squares of larger ones overflow


def longest_spacing_m(pulse: PulseModel, view: FieldOfView) -> float:
    """Return how far an antenna may go from frame to frame.

    Farther, the phase of an echo at the edge of the beam turns by more than half a period in
    between, and it appears at the other edge, too (grating lobe): lambda / 2 over 2 sin(half beam).

    >>> round(1e3 * longest_spacing_m(PulseModel(), FieldOfView()), 1)
    19.1
    """
    return pulse.wavelength_m / (2 * math.sin(view.opening_rad / 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class PatchRule:
    """How long patches are, and what goes into them."""

    travel_m: float = 0.25  # way of the antenna in a patch; turning counts by the mount's lever
    hop_m: float = 0.125  # way from one patch to the next
    spacing_m: float = 0.0025  # frames that are nearer to the one before are left out
    # Where the robot stood for longer than this, a new patch begins: it may have been moved.
    longest_stand_ns: int = 20_000_000_000
    memory: int = 300  # frames of `StaticPart`


@dataclass(frozen=True, kw_only=True, eq=False)
class Patch:
    """Profiles of one radar along a short way, in the body frame of its middle.

    Attributes
    ----------
    radar
        Index of the mount.
    t_ns
        Shape (n,), int64: session times of the profiles.
    poses
        Shape (n, 3), body poses at these times, in the frame of the patch: that of the body at
        profile ``middle``.
    origin
        Shape (3,), the patch's frame in the frame of the poses that it was made of, which is that
        of odometry or a map.
    cut
        Shape (n, n_bins): which samples of the frames lay at a limit of the module's sampler. None:
        none did.
    """

    radar: int
    mount: Mount
    view: FieldOfView
    t_ns: NDArray[np.int64]
    poses: Array
    middle: int
    origin: Array
    profiles: RangeProfiles
    cut: NDArray[np.bool_] | None = None

    @cached_property
    def aperture(self) -> Aperture:
        """Return antennas and boresights in the frame of the patch."""
        return aperture_of(self.mount, self.view, self.poses)

    def with_poses(self, poses: Array) -> Patch:
        """Return the patch on other poses (n, 3), of any frame, at the same times."""
        origin = poses[self.middle]
        return replace(self, poses=seen_from(origin, poses), origin=origin)


def seen_from(origin: Array, poses: Array) -> Array:
    """Return poses (n, 3) in the frame of one (3,), or each in that of its own row (n, 3)."""
    cosine, sine = np.cos(origin[..., 2]), np.sin(origin[..., 2])
    dx, dy, turn = (poses - origin).T
    turn = (turn + math.pi) % math.tau - math.pi
    return np.column_stack([cosine * dx + sine * dy, cosine * dy - sine * dx, turn])


def aperture_of(mount: Mount, view: FieldOfView, poses: Array) -> Aperture:
    """Return the aperture of one radar at body poses (n, 3), in their frame."""
    cosine, sine = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + cosine * mount.x_m - sine * mount.y_m
    y = poses[:, 1] + sine * mount.x_m + cosine * mount.y_m
    yaw = poses[:, 2] + mount.yaw_rad
    return Aperture(
        antennas_m=np.column_stack([x, y]),
        boresights=np.column_stack([np.cos(yaw), np.sin(yaw)]),
        half_beam_rad=view.opening_rad / 2,
        min_range_m=view.min_range_m,
        max_range_m=view.max_range_m,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedFrame:
    """A frame without counter and radar, as in `RadarFrame`; its samples may be I + jQ."""

    t_ns: int
    samples: Samples
    range_start_m: float
    bin_length_m: float


@dataclass(slots=True, kw_only=True)
class _Look:
    """A frame that waits for its patch."""

    t_ns: int
    pose: Array
    antenna: Array
    samples: Samples
    cut: NDArray[np.bool_]  # as in `Patch`
    range_start_m: float
    way_m: float  # of the antenna since the start


class PatchMaker:
    """Makes the patches of one radar while frames come in.

    ``pulse_of`` returns the module's pulse as it is known now, for a length of bins. ``static`` is
    the part of the samples that stands still with the robot, where it is known beforehand; None:
    it is learnt from the frames.
    """

    def __init__(
        self,
        radar: int,
        mount: Mount,
        view: FieldOfView,
        pulse_of: Callable[[float], ModulePulse],
        rule: PatchRule | None = None,
        *,
        static: StaticPart | None = None,
    ) -> None:
        self.radar, self.mount, self.view = radar, mount, view
        self.rule = rule or PatchRule()
        self._pulse_of = pulse_of
        self._looks: list[_Look] = []
        self._is_known = static is not None
        self._static = static or StaticPart(memory=self.rule.memory)
        self._bins = (0, 0.0, 0.0)  # number, start and length, of which the static part is learnt
        self._filter: tuple[ModulePulse, ProfileFilter] | None = None

    def near(self, frame: RadarFrame | RecordedFrame) -> Samples:
        """Return the samples up to the end of the field of view, 0 for what is none."""
        start_m = frame.range_start_m - self.mount.range_offset_m
        reach = (self.view.max_range_m + _MARGIN_M - start_m) / frame.bin_length_m
        samples = frame.samples[: max(1, math.ceil(reach))]
        own = samples.astype(np.result_type(samples, np.float64))
        return np.where(np.abs(own) < _MOST_SAMPLE, own, 0.0)

    def antenna_at(self, pose: Array) -> Array:
        """Return the antenna, shape (2,), at a body pose."""
        return transform(pose, np.array([self.mount.x_m, self.mount.y_m]))

    def add(self, frame: RadarFrame | RecordedFrame, pose: Array) -> Patch | None:
        """Take a frame and the body pose (3,) when it was taken; return a patch that is complete.

        Poses come from odometry, or any path without jumps. A frame is RF or I/Q. Raises ValueError
        if a number of the pose is not finite.
        """
        if not np.isfinite(pose).all():
            raise ValueError(f"the pose at {frame.t_ns} ns must be finite numbers, not {pose}")
        samples = self.near(frame)
        start_m = frame.range_start_m - self.mount.range_offset_m
        antenna = self.antenna_at(pose)
        bins, before = (samples.size, start_m, frame.bin_length_m), self._bins
        self._bins = bins
        if self._looks and not (
            bins == before and 0 <= frame.t_ns - self._looks[-1].t_ns < self.rule.longest_stand_ns
        ):
            self._looks.clear()
        if not self._is_known:
            if bins != before:
                self._static = StaticPart(memory=self.rule.memory)
            self._static.add(samples, antenna, float(pose[2]))
        way_m = 0.0
        if self._looks:
            last = self._looks[-1]
            step_m = math.dist(antenna, last.antenna)
            if step_m < self.rule.spacing_m:
                return None
            way_m = last.way_m + step_m
        self._looks.append(
            _Look(
                t_ns=frame.t_ns,
                pose=pose,
                antenna=antenna,
                samples=samples,
                cut=_cut(frame, samples.size),
                range_start_m=start_m,
                way_m=way_m,
            )
        )
        if way_m - self._looks[0].way_m < self.rule.travel_m:
            return None
        patch = self._made(frame.bin_length_m)
        keep_m = self._looks[0].way_m + self.rule.hop_m
        self._looks = [look for look in self._looks if look.way_m >= keep_m]
        return patch

    def begin_anew(self) -> None:
        """Forget the frames so far: the way from them to the next ones is not known."""
        self._looks.clear()

    def _made(self, bin_length_m: float) -> Patch:
        looks, static = self._looks, self._static.samples
        rows = np.array([look.samples for look in looks])
        if static is not None:
            if self._static.n_headings < _TURNED:
                near = round((_ROBOT_M - looks[0].range_start_m) / bin_length_m)
                static = np.where(np.arange(static.size) < near, static, 0.0)
            rows = rows - static
        middle_m = 0.5 * (looks[0].way_m + looks[-1].way_m)
        middle = int(np.argmin([abs(look.way_m - middle_m) for look in looks]))
        origin = looks[middle].pose
        cut = np.array([look.cut for look in looks])
        return Patch(
            radar=self.radar,
            mount=self.mount,
            view=self.view,
            t_ns=np.array([look.t_ns for look in looks], dtype=np.int64),
            poses=seen_from(origin, np.array([look.pose for look in looks])),
            middle=middle,
            origin=origin,
            profiles=self._profiles(rows, looks[0].range_start_m, bin_length_m),
            cut=cut if cut.any() else None,
        )

    def _profiles(self, rows: Samples, range_start_m: float, bin_length_m: float) -> RangeProfiles:
        pulse = self._pulse_of(bin_length_m)
        if np.iscomplexobj(rows):
            model = pulse.model
            return baseband_profiles(
                *(rows, range_start_m, bin_length_m),
                carrier_hz=model.carrier_hz,
                sigma_m=model.sigma_m,
            )
        profile_filter = self._filter[1] if self._filter and self._filter[0] is pulse else None
        bins = rows.shape[1], bin_length_m
        if profile_filter is None or (profile_filter.n_bins, profile_filter.bin_length_m) != bins:
            profile_filter = ProfileFilter(pulse, rows.shape[1], bin_length_m)
            self._filter = pulse, profile_filter
        return profile_filter.apply(rows, range_start_m)


def _cut(frame: RadarFrame | RecordedFrame, n_bins: int) -> NDArray[np.bool_]:
    """Return which of the first samples, shape (n_bins,), lie at a limit; none of a recording."""
    samples = frame.samples[:n_bins]
    if isinstance(frame, RecordedFrame):
        return np.zeros(samples.size, dtype=np.bool_)
    return ~(usable_samples(replace(frame, samples=samples)) | np.isnan(samples))
