"""The chip of a module that plays recorded radar frames: it tells of them, not of what was set.

A host sets a frame area, reads back what the module made of it, and takes only frames of that
size. While a recording plays, its frames are what they are, so the read-back must be theirs.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from emulator.chip import Chip
from emulator.echo import echo_source
from emulator.scene import empty_room
from xethru_protocol import x4
from xethru_protocol.codes import X4Setting
from xethru_protocol.messages import DataFloat, ReplyFloat, Response, X4Value

__all__ = ["FrameSurvey", "PlayedChip", "PlayedFrames"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayedFrames:
    """What a recording tells of its radar frames.

    Attributes
    ----------
    n_values
        float32 values per frame: bins of RF, or twice the bins of baseband.
    area_m
        Frame area as the recorded module read it back [module metres]; None if nobody asked it.
    """

    n_values: int
    area_m: tuple[float, float] | None


class FrameSurvey:
    """Looks for radar frames among the messages of a recording."""

    def __init__(self) -> None:
        self._sizes: Counter[int] = Counter()
        self._area_m: tuple[float, float] | None = None

    def look_at(self, message: Response) -> None:
        """Look at the next message."""
        if isinstance(message, DataFloat) and message.content_id == 0:
            self._sizes[message.values.size] += 1
        elif (
            isinstance(message, ReplyFloat)
            and message.content_id == X4Setting.FRAMEAREA
            and len(message.values) == 2
        ):
            self._area_m = message.values[0], message.values[1]

    def found(self) -> PlayedFrames | None:
        """Return what was found; of several sizes the most frequent counts. None: no frames.

        The area is the last one the host of the recording asked for.
        """
        if not self._sizes:
            return None
        return PlayedFrames(n_values=self._sizes.most_common(1)[0][0], area_m=self._area_m)


class PlayedChip(Chip):
    """A chip whose frames come from a recording.

    It takes every setting. FRAMEBINCOUNT answers the recorded frames' bins, RF or baseband as
    DOWNCONVERSION was set, since a frame does not say which it is (protocol reference 6.1).
    FRAMEAREA answers the recorded area, if known, else the requested start and as many bins.
    """

    def __init__(self, frames: PlayedFrames) -> None:
        self._frames = frames
        super().__init__(echo_source(empty_room(), 0, 0))

    def get(self, setting: X4Setting) -> X4Value:
        """Return what GET answers, or raise `Refusal` for a setting without getter."""
        downconverted = bool(self.settings.downconversion)
        n_bins = self._frames.n_values // 2 if downconverted else self._frames.n_values
        if setting is X4Setting.FRAMEBINCOUNT:
            return n_bins
        if setting is X4Setting.FRAMEAREA:
            if self._frames.area_m is not None:
                return self._frames.area_m
            start_m = self.area.start_m
            bin_m = x4.BASEBAND_BIN_M if downconverted else x4.RF_BIN_M
            end_m = start_m + bin_m * (n_bins - 1 if downconverted else n_bins)
            return start_m, float(np.float32(end_m))
        return super().get(setting)
