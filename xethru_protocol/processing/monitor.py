"""Answers from the newest frames of a stream, computed again now and then."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

AnswerT = TypeVar("AnswerT")
Compute = Callable[[NDArray[np.complex64], NDArray[np.float64], float], AnswerT]


class Monitor(Generic[AnswerT]):
    """What is computed of the newest window of frames as they come.

    ``compute`` gets the window, a view that later frames overwrite, the ranges and the frame rate;
    ``newest`` is its latest answer.
    """

    newest: AnswerT | None = None

    def __init__(
        self,
        compute: Compute[AnswerT],
        ranges_m: ArrayLike,
        frame_rate_hz: float,
        *,
        window_s: float,
        every_s: float,
    ) -> None:
        check_rate(frame_rate_hz)
        for name, seconds in (("window_s", window_s), ("every_s", every_s)):
            if not 0 < seconds < math.inf:
                raise ValueError(f"{name} {seconds:g}: must be above 0")
        self._compute = compute
        self._ranges_m: NDArray[np.float64] = np.array(ranges_m, dtype=np.float64)
        self._frame_rate_hz = frame_rate_hz
        self._n_frames = math.ceil(window_s * frame_rate_hz)
        self._every = max(round(every_s * frame_rate_hz), 1)
        # twice, so that the newest window is one piece
        self._ring = np.zeros((2 * self._n_frames, len(self._ranges_m)), dtype=np.complex64)
        self._taken = 0

    def reset(self) -> None:
        """Forget all frames, as when the radar was moved or frames are missing."""
        self._taken = 0
        self.newest = None

    def update(self, iq_frame: ArrayLike) -> AnswerT | None:
        """Take one frame, shape (n_bins,), complex; return the latest answer.

        There is a new one when the window is first full, and then every ``every_s``.
        """
        frame = np.asarray(iq_frame)
        if frame.shape != self._ring.shape[1:]:
            raise ValueError(f"a frame of shape {frame.shape}: must be {self._ring.shape[1:]}")
        place = self._taken % self._n_frames
        self._ring[place] = self._ring[place + self._n_frames] = frame
        self._taken += 1
        beyond = self._taken - self._n_frames
        if beyond >= 0 and beyond % self._every == 0:
            window = self._ring[place + 1 : place + 1 + self._n_frames]
            self.newest = self._compute(window, self._ranges_m, self._frame_rate_hz)
        return self.newest


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
