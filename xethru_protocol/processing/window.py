"""The newest frames of a stream, and when they are looked at again."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Window:
    """The newest frames, for what is computed from a window of them now and then.

    Attributes
    ----------
    n_frames
        Frames of a window.
    """

    def __init__(
        self, n_bins: int, frame_rate_hz: float, *, window_s: float, every_s: float
    ) -> None:
        check_rate(frame_rate_hz)
        for name, seconds in (("window_s", window_s), ("every_s", every_s)):
            if not 0 < seconds < math.inf:
                raise ValueError(f"{name} {seconds:g}: must be above 0")
        self.n_frames = math.ceil(window_s * frame_rate_hz)
        self._every = max(round(every_s * frame_rate_hz), 1)
        # twice, so that the newest window is one piece
        self._ring = np.zeros((2 * self.n_frames, n_bins), dtype=np.complex64)
        self._taken = 0

    def clear(self) -> None:
        self._taken = 0

    def add(self, iq_frame: ArrayLike) -> NDArray[np.complex64] | None:
        """Take one frame, shape (n_bins,); return the window if it is due, else None.

        It is due when it is first full, and then every ``every_s``. The array is a view that later
        frames overwrite.
        """
        frame = np.asarray(iq_frame)
        if frame.shape != self._ring.shape[1:]:
            raise ValueError(f"a frame of shape {frame.shape}: must be {self._ring.shape[1:]}")
        place = self._taken % self.n_frames
        self._ring[place] = self._ring[place + self.n_frames] = frame
        self._taken += 1
        beyond = self._taken - self.n_frames
        if beyond < 0 or beyond % self._every:
            return None
        return self._ring[place + 1 : place + 1 + self.n_frames]


def check_rate(frame_rate_hz: float) -> None:
    """Raise `ValueError` for an impossible frame rate."""
    if not 0 < frame_rate_hz < math.inf:
        raise ValueError(f"frame_rate_hz {frame_rate_hz:g}: must be above 0")


def checked(
    iq: ArrayLike, ranges_m: ArrayLike
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Return frames and ranges as arrays of double precision.

    ValueError if they do not fit each other, or for NaN and infinities among the frames.
    """
    frames = np.asarray(iq)
    ranges = np.asarray(ranges_m, dtype=np.float64)
    if frames.ndim != 2 or not np.iscomplexobj(frames) or frames.shape[1:] != ranges.shape:
        raise ValueError(
            f"frames of shape {frames.shape} and type {frames.dtype}: must be complex, one row per "
            f"frame, with a bin for each of the {ranges.size} ranges"
        )
    damaged = len(frames) - int(np.isfinite(frames).all(axis=1).sum())
    if damaged:
        raise ValueError(
            f"{damaged} of {len(frames)} frames hold NaN or infinities; leave these frames out"
        )
    return frames.astype(np.complex128), ranges
