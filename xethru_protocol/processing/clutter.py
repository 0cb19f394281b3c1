"""Clutter removal: what stands still is subtracted, what moves stays.

Every method looks back only, so frame by frame and all at once give the same numbers, and the first
frames have less to look back on. A frame with a NaN makes results NaN: under ``exponential`` its
own only, behind which the average begins anew; under ``svd`` those of a window, under ``mean``
those of two at most. With x_t the frame and y_t what is returned:

``mean``
    ``y_t = x_t - (x_t-w+1 + ... + x_t) / w``, the mean of the newest w = ``window`` frames. All
    that changes slower than the window goes.
``exponential``
    ``c_t = c_t-1 + alpha (x_t - c_t-1)``, ``c_0 = x_0``, ``y_t = x_t - c_t``: a high-pass of first
    order, called loop-back filter in Zetik et al., "Detection and localization of persons behind
    obstacles using M-sequence through-the-wall radar", Proc. SPIE 6210 (2006).
``svd``
    The newest w frames are the rows of a matrix, ``X = U S V*``. The parts of the ``components``
    greatest singular values are what stands still, and what of it wobbles as one, such as a drift
    of all gains: ``y_t`` is the last row of ``X - sum_k u_k s_k v_k*``. Nezirovic, Yarovoy and
    Ligthart, "Signal processing for improved detection of trapped victims using UWB radar", IEEE
    Trans. Geosci. Remote Sens. 48 (2010) 2005. Someone who moves much, and in few bins, can be
    among them: take few components. A frame with a NaN or an infinity becomes NaN, and counts as 0
    for the others.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

Method = Literal["mean", "exponential", "svd"]
METHODS: tuple[Method, ...] = get_args(Method)

_Values = NDArray[Any]  # float64 or complex128


class ClutterFilter:
    """Removes clutter from frames as they come.

    Parameters
    ----------
    method
        ``mean``, ``exponential`` or ``svd``, as the module's docstring defines them.
    window
        Frames that ``mean`` and ``svd`` look back on, the newest one included.
    alpha
        Weight of the newest frame under ``exponential``, above 0 and at most 1. The time constant
        is ``1 / alpha`` frames.
    components
        Singular values that ``svd`` takes for clutter.

    Raises
    ------
    ValueError
        For an unknown method or an argument out of its range.
    """

    def __init__(
        self, method: Method = "mean", *, window: int = 64, alpha: float = 0.02, components: int = 1
    ) -> None:
        if method not in METHODS:
            raise ValueError(f"method {method!r}: must be one of {', '.join(METHODS)}")
        if window < 2:
            raise ValueError(f"window {window}: must be at least 2 frames")
        if not 0 < alpha <= 1:
            raise ValueError(f"alpha {alpha:g}: must be above 0 and at most 1")
        if not 0 < components < window:
            raise ValueError(f"components {components}: must be from 1 to the window less 1")
        self.method: Method = method
        self._window = window
        self._alpha = alpha
        self._components = components
        self._filtered = {
            "mean": self._less_mean,
            "exponential": self._less_exponential,
            "svd": self._less_components,
        }[method]
        self.reset()

    def reset(self) -> None:
        """Forget all frames, as when the radar was moved."""
        self._taken = 0
        self._state: _Values | None = None  # running sum, average, or products of frames
        self._rows: _Values | None = None  # newest frames, in a ring

    def update(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Take one frame, shape (n_bins,), or several, (n_frames, n_bins); return them filtered.

        Shape and type stay. Frames with another number of bins than before raise `ValueError`.
        """
        values = np.asarray(frames)
        single = values.ndim == 1
        rows: _Values = np.atleast_2d(values).astype(
            np.complex128 if np.iscomplexobj(values) else np.float64
        )
        if self._rows is None:
            self._rows = np.zeros((self._window, rows.shape[1]), dtype=rows.dtype)
        if rows.shape[1] != self._rows.shape[1]:
            raise ValueError(
                f"frames of {rows.shape[1]} bins after frames of {self._rows.shape[1]}: "
                "reset the filter"
            )
        filtered = np.empty(rows.shape, dtype=values.dtype)
        for number, row in enumerate(rows):
            filtered[number] = self._filtered(row, self._rows)
            self._taken += 1
        return filtered[0] if single else filtered

    def _less_mean(self, row: _Values, ring: _Values) -> _Values:
        place = self._taken % self._window
        if self._state is None or place == 0:
            # now and then from the frames themselves, lest rounding or a NaN stay for ever
            ring[place] = row
            self._state = ring.sum(axis=0)
        else:
            self._state += row - ring[place]
            ring[place] = row
        return row - self._state / min(self._taken + 1, self._window)

    def _less_exponential(self, row: _Values, ring: _Values) -> _Values:
        if self._state is None:
            self._state = row.copy()
        # begins anew behind a NaN, which would stay for ever
        self._state = np.where(np.isfinite(self._state), self._state, row)
        self._state += self._alpha * (row - self._state)
        return row - self._state

    def _less_components(self, row: _Values, ring: _Values) -> _Values:
        place = self._taken % self._window
        ring[place] = row
        if self._state is None:
            self._state = np.zeros((self._window, self._window), dtype=ring.dtype)
        # products of all frames: their eigenvectors are the left singular vectors
        with np.errstate(invalid="ignore", over="ignore"):
            products = ring @ row.conj()
        is_finite = bool(np.isfinite(products).all())
        if not is_finite:  # no eigenvectors exist while the frame is in the window
            ring[place] = 0
            products = np.zeros_like(products)
        self._state[:, place] = products
        self._state[place] = products.conj()
        if not is_finite:
            return np.full_like(row, np.nan)
        taken = min(self._taken + 1, self._window)
        if not np.isfinite(self._state[:taken, :taken]).all():
            return np.full_like(row, np.nan)  # a frame of the window has no eigenvalues
        _, vectors = np.linalg.eigh(self._state[:taken, :taken])
        clutter = vectors[:, -self._components :]
        stands: _Values = (clutter[place] @ clutter.conj().T) @ ring[:taken]
        return row - stands


def remove_clutter(
    frames: NDArray[Any],
    method: Method = "mean",
    *,
    window: int = 64,
    alpha: float = 0.02,
    components: int = 1,
) -> NDArray[Any]:
    """Return frames without what stands still, shape and type as given, (n_frames, n_bins).

    Parameters and errors are those of `ClutterFilter`, which gives the same numbers frame by frame.
    """
    return ClutterFilter(method, window=window, alpha=alpha, components=components).update(frames)
