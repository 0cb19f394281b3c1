"""Images while driving: frames and poses in, patches with their points and walls out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from slam.config import SlamConfig, WheelNoise
from slam.frames import RadarFrame
from slam.front_end.pulse import ModulePulse, nominal_pulse
from slam.front_end.pulse_estimation import PulseEstimator, module_pulse
from slam.geometry import FieldOfView, Rig
from slam.imaging.patches import Patch, PatchMaker, PatchRule
from slam.imaging.points import PatchLine, PatchPoint, PointRule, lines_of, points_of
from slam.imaging.reflectors import separated

Array = NDArray[np.float64]
PoseAt = Callable[[int], Array]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImagedPatch:
    """A patch, and what stands in it."""

    patch: Patch
    points: tuple[PatchPoint, ...]
    lines: tuple[PatchLine, ...]


class Imager:
    """Makes the patches of all radars of a rig while frames come in.

    ``wheels`` is how its odometry errs, for covariances. With ``pulses``, which a detector fills
    (`slam.front_end.matched_filter`), patches are made with the pulse of each module as it is known
    by then; else with that of its mount, or the nominal one.
    """

    def __init__(
        self,
        config: SlamConfig,
        rig: Rig,
        wheels: WheelNoise | None = None,
        pulses: PulseEstimator | None = None,
        rule: PatchRule | None = None,
    ) -> None:
        limits = config.detection
        self.point_rule = PointRule(wheels=wheels or WheelNoise())
        self._learns = pulses is not None
        self._nominal = nominal_pulse(config.matched_filter)
        self._pulses = pulses or PulseEstimator(
            self._nominal.model, [mount.pulse for mount in rig.mounts]
        )
        self._known: dict[tuple[int, float], tuple[object, ModulePulse]] = {}
        view = FieldOfView(
            opening_rad=config.trilateration.field_of_view_rad,
            min_range_m=limits.min_range_m,
            max_range_m=limits.max_range_m,
        )
        self._makers = [
            PatchMaker(radar, mount, view, partial(self._pulse, radar), rule)
            for radar, mount in enumerate(rig.mounts)
        ]

    def step(self, frames: Sequence[RadarFrame], pose_at: PoseAt) -> tuple[ImagedPatch, ...]:
        """Take the frames of one scan and return the patches that they complete.

        ``pose_at`` returns the body pose (3,) at a session time, of odometry or a path without
        jumps.
        """
        made = [self._makers[frame.radar].add(frame, pose_at(frame.t_ns)) for frame in frames]
        return tuple(self._imaged(patch) for patch in made if patch is not None)

    def begin_anew(self) -> None:
        """Let no patch hold frames of before and after now, as the way between them is unknown."""
        for maker in self._makers:
            maker.begin_anew()

    def _imaged(self, patch: Patch) -> ImagedPatch:
        rule = self.point_rule
        if self._learns and not self._has_learned(patch.radar):
            # What another pulse than the nominal one leaves may look like a second echo, and to
            # take it for one moves the first: by 7 mm under the stress `pulse`, until it is learnt.
            separation = replace(
                rule.separation,
                beside_m=rule.unlearned_beside_m,
                beside_share=rule.unlearned_beside_share,
            )
            rule = replace(rule, beside_m=rule.unlearned_beside_m, separation=separation)
        reflectors = separated(patch, rule.separation)
        return ImagedPatch(
            patch=patch,
            points=points_of(patch, reflectors, rule),
            lines=lines_of(patch, reflectors, rule),
        )

    def _has_learned(self, radar: int) -> bool:
        """Return whether echoes have shown the pulse of a radar, or that it is the nominal one."""
        pulses = self._pulses
        return pulses.pulse(radar) is not None or pulses.estimate(None) is not None

    def _pulse(self, radar: int, bin_length_m: float) -> ModulePulse:
        received = self._pulses.pulse(radar)
        if received is None:
            return self._nominal
        before, pulse = self._known.get((radar, bin_length_m), (None, self._nominal))
        if before is not received:
            pulse = module_pulse(received, self._nominal.model, bin_length_m)
            self._known[radar, bin_length_m] = received, pulse
        return pulse
