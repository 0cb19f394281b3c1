"""A covariance that changes in place: one triangle is stored, low-rank changes touch it once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyr2, dsyr2k, dsyrk

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class SymmetricMatrix:
    """A symmetric matrix of which the lower triangle is stored, columns first.

    A rank-k change costs one pass over the triangle (BLAS ``dsyrk``, ``dsyr2``), nothing is
    copied, and symmetry cannot be lost because there is no second triangle.

    Parameters
    ----------
    full
        shape (m, m); only its lower triangle is read.
    """

    __slots__ = ("_lower",)

    def __init__(self, full: Array) -> None:
        self._lower: Array = np.array(full, dtype=np.float64, order="F")

    @property
    def size(self) -> int:
        """Return m."""
        return int(self._lower.shape[0])

    def columns(self, at: Indices) -> Array:
        """Return columns as they are in the full matrix, shape (m, k)."""
        lower = self._lower
        above = np.arange(lower.shape[0])[:, None] < at[None, :]
        return np.where(above, lower[at, :].T, lower[:, at])

    def block(self, at: Indices) -> Array:
        """Return the principal submatrix of some indices, shape (k, k), full."""
        part = self._lower[np.ix_(at, at)]
        mirrored = self._lower.T[np.ix_(at, at)]
        return np.where(at[:, None] < at[None, :], mirrored, part)

    def diagonal(self) -> Array:
        """Return a copy of the diagonal, shape (m,)."""
        return np.array(self._lower.diagonal())

    def full(self) -> Array:
        """Return a full copy, shape (m, m), symmetric bit for bit."""
        lower = np.tril(self._lower)
        return np.asarray(lower + np.tril(lower, -1).T)

    def add_products(self, a: Array, b: Array) -> None:
        """Add ``a b^T + b a^T``; a and b have shape (m,)."""
        self._lower = dsyr2(1.0, a, b, a=self._lower, lower=1, overwrite_a=1)

    def subtract_gram(self, W: Array) -> None:
        """Subtract ``W W^T``, W of shape (m, k)."""
        self._lower = dsyrk(
            -1.0, np.asfortranarray(W), beta=1.0, c=self._lower, lower=1, overwrite_c=1
        )

    def subtract_gains(self, K: Array, PHt: Array, S: Array) -> None:
        """Subtract ``K H P + P H^T K^T - K S K^T``: an update in Joseph's form.

        K has shape (m, k), PHt = P H^T too, S = H P H^T + R shape (k, k). An error of the gain
        enters squared, so nearly noiseless updates keep the matrix positive.
        """
        other = PHt - 0.5 * (K @ S)
        self._lower = dsyr2k(
            -1.0,
            np.asfortranarray(K),
            np.asfortranarray(other),
            beta=1.0,
            c=self._lower,
            lower=1,
            overwrite_c=1,
        )

    def add_diagonal(self, at: slice, values: Sequence[float]) -> None:
        """Add variances to neighbouring diagonal entries."""
        for index, value in zip(range(at.start, at.stop), values, strict=True):
            self._lower[index, index] += value

    def replace_columns(self, at: slice, columns: Array) -> None:
        """Set neighbouring columns, and so their rows; shape (m, k), its own block symmetric."""
        begin, end = at.start, at.stop
        self._lower[at, :begin] = columns[:begin].T
        for index in range(begin, end):
            self._lower[index:, index] = columns[index:, index - begin]

    def grow(self, cross: Array, corner: Array) -> None:
        """Append k rows: ``cross`` (m, k) is their covariance with the rest, ``corner`` (k, k)."""
        m, k = cross.shape
        grown = np.zeros((m + k, m + k), order="F")
        grown[:m, :m] = self._lower
        grown[m:, :m] = cross.T
        grown[m:, m:] = corner
        self._lower = grown

    def keep(self, at: Indices) -> None:
        """Marginalise all but some indices, which must increase; what stays, stays bit for bit."""
        self._lower = np.asfortranarray(self._lower[np.ix_(at, at)])
