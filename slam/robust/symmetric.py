"""A covariance that changes in place: one triangle is stored, low-rank changes touch it seldom.

A change of low rank reads and writes the whole triangle and computes next to nothing with it, so
in a large map memory is what it costs. Changes of large matrices are therefore kept as factors,

    P = L + A B^T + B A^T - G G^T,

L the stored triangle, and carried out together: many changes, one pass. Columns and blocks, which
are all that a step of the filter reads, come out as if that had been done.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyr2, dsyr2k, dsyrk

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Up to this size the triangle lies in a core's cache: a pass is cheaper than putting it off.
_PROMPT_SIZE = 500
# How much is put off of either kind: so little that carrying it out takes no longer than a step
# may (n = 1000), and with four updates a step both fall due together in one step of 165.
_MOST_GRAMS, _MOST_PAIRS = 44, 15
# Large matrices grow within spare rows. Not a power of two, columns would share cache sets.
_SPARE, _ODD = 128, 8


class SymmetricMatrix:
    """A symmetric matrix of which the lower triangle is stored, columns first.

    A rank-k change costs one pass over the triangle (BLAS ``dsyrk``, ``dsyr2``), or a share of
    one; nothing is copied, and symmetry cannot be lost because there is no second triangle.

    Parameters
    ----------
    full
        shape (m, m); only its lower triangle is read.
    """

    __slots__ = ("_first", "_grams", "_lower", "_n_grams", "_n_pairs", "_second", "_size")

    def __init__(self, full: Array) -> None:
        self._store(np.asarray(full, dtype=np.float64), len(full))

    def _store(self, part: Array, size: int) -> None:
        """Take a square part for the first rows and columns of ``size`` ones; nothing put off."""
        room = size if size <= _PROMPT_SIZE else _room(size)
        self._lower: Array = np.zeros((room, room), order="F")
        self._lower[: len(part), : len(part)] = part
        self._size = size
        most_grams, most_pairs = (0, 0) if self._is_prompt else (_MOST_GRAMS, _MOST_PAIRS)
        self._grams: Array = np.zeros((room, most_grams), order="F")
        self._first: Array = np.zeros((room, most_pairs), order="F")
        self._second: Array = np.zeros((room, most_pairs), order="F")
        self._n_grams = self._n_pairs = 0

    @property
    def _is_prompt(self) -> bool:
        return len(self._lower) <= _PROMPT_SIZE

    @property
    def size(self) -> int:
        """Return m."""
        return self._size

    def columns(self, at: Indices) -> Array:
        """Return columns as they are in the full matrix, shape (m, k)."""
        m, lower = self._size, self._lower
        # Rows together: small maps keep their bits, whatever is put off for large ones.
        result: Array = np.ascontiguousarray(lower[:m, at])
        for place, column in enumerate(at.tolist()):
            result[:column, place] = lower[column, :column]
        if self._n_grams or self._n_pairs:
            result += self._put_off(slice(0, m), at)
        return result

    def block(self, at: Indices) -> Array:
        """Return the principal submatrix of some indices, shape (k, k), full."""
        part = self._lower[np.ix_(at, at)]
        result = np.where(at[:, None] < at[None, :], part.T, part)
        if self._n_grams or self._n_pairs:
            result += self._put_off(at, at)
        return result

    def entries(self, rows: Indices, columns: Indices) -> Array:
        """Return single entries, shape (k,) for rows and columns of shape (k,)."""
        low, high = np.minimum(rows, columns), np.maximum(rows, columns)
        result: Array = self._lower[high, low]
        if self._n_pairs:
            first, second = self._first[:, : self._n_pairs], self._second[:, : self._n_pairs]
            result += np.einsum("ij,ij->i", first[rows], second[columns])
            result += np.einsum("ij,ij->i", second[rows], first[columns])
        if self._n_grams:
            grams = self._grams[:, : self._n_grams]
            result -= np.einsum("ij,ij->i", grams[rows], grams[columns])
        return result

    def full(self) -> Array:
        """Return a full copy, shape (m, m), symmetric bit for bit."""
        self._carry_out()
        lower = np.tril(self._lower[: self._size, : self._size])
        return np.asarray(lower + np.tril(lower, -1).T)

    def add_products(self, a: Array, b: Array) -> None:
        """Add ``a b^T + b a^T``; a and b have shape (m,)."""
        if self._is_prompt:
            self._lower = dsyr2(1.0, a, b, a=self._lower, lower=1, overwrite_a=1)
        else:
            self._put_off_pairs(a, b)

    def subtract_gram(self, W: Array) -> None:
        """Subtract ``W W^T``, W of shape (m, k)."""
        k = W.shape[1]
        if self._is_prompt:
            self._subtract_now(np.asfortranarray(W))
            return
        if self._n_grams + k > _MOST_GRAMS:
            self._carry_out_grams()
        if k > _MOST_GRAMS:
            tall = np.zeros((len(self._lower), k), order="F")
            tall[: self._size] = W
            self._subtract_now(tall)
            return
        self._grams[: self._size, self._n_grams : self._n_grams + k] = W
        self._n_grams += k

    def subtract_gains(self, K: Array, PHt: Array, S: Array) -> None:
        """Subtract ``K H P + P H^T K^T - K S K^T``: an update in Joseph's form.

        K has shape (m, k), PHt = P H^T too, S = H P H^T + R shape (k, k). An error of the gain
        enters squared, so nearly noiseless updates keep the matrix positive.
        """
        other = PHt - 0.5 * (K @ S)
        if self._is_prompt:
            self._add_pairs_now(np.asfortranarray(-K), np.asfortranarray(other))
        else:
            for column in range(K.shape[1]):
                self._put_off_pairs(-K[:, column], other[:, column])

    def add_diagonal(self, at: slice, values: Sequence[float]) -> None:
        """Add variances to neighbouring diagonal entries."""
        for index, value in zip(range(at.start, at.stop), values, strict=True):
            self._lower[index, index] += value

    def replace_columns(self, at: slice, columns: Array) -> None:
        """Set neighbouring columns, and so their rows; shape (m, k), its own block symmetric."""
        for factors in (self._grams, self._first, self._second):
            factors[at] = 0.0
        begin, end, m = at.start, at.stop, self._size
        self._lower[at, :begin] = columns[:begin].T
        for index in range(begin, end):
            self._lower[index:m, index] = columns[index:, index - begin]

    def grow(self, cross: Array, corner: Array) -> None:
        """Append k rows: ``cross`` (m, k) is their covariance with the rest, ``corner`` (k, k)."""
        m, k = cross.shape
        if self._is_prompt or m + k > len(self._lower):
            self._carry_out()
            self._store(self._lower[:m, :m], m + k)
        self._lower[m : m + k, :m] = cross.T
        self._lower[m : m + k, m : m + k] = corner
        self._size = m + k

    def keep(self, at: Indices) -> None:
        """Marginalise all but some indices, which must increase; what stays, stays bit for bit."""
        self._carry_out()
        self._store(self._lower[np.ix_(at, at)], len(at))

    def _put_off(self, rows: Indices | slice, at: Indices) -> Array:
        """Return rows and columns of the changes put off."""
        first, second = self._first[:, : self._n_pairs], self._second[:, : self._n_pairs]
        grams = self._grams[:, : self._n_grams]
        products = first[rows] @ second[at].T + second[rows] @ first[at].T
        return np.asarray(products - grams[rows] @ grams[at].T)

    def _put_off_pairs(self, a: Array, b: Array) -> None:
        if self._n_pairs == _MOST_PAIRS:
            self._carry_out_pairs()
        self._first[: self._size, self._n_pairs] = a
        self._second[: self._size, self._n_pairs] = b
        self._n_pairs += 1

    def _carry_out(self) -> None:
        """Make the stored triangle the matrix."""
        self._carry_out_grams()
        self._carry_out_pairs()

    def _carry_out_grams(self) -> None:
        if self._n_grams:
            self._subtract_now(self._grams[:, : self._n_grams])
        self._n_grams = 0

    def _carry_out_pairs(self) -> None:
        if self._n_pairs:
            self._add_pairs_now(self._first[:, : self._n_pairs], self._second[:, : self._n_pairs])
        self._n_pairs = 0

    def _subtract_now(self, W: Array) -> None:
        self._lower = dsyrk(-1.0, W, beta=1.0, c=self._lower, lower=1, overwrite_c=1)

    def _add_pairs_now(self, a: Array, b: Array) -> None:
        self._lower = dsyr2k(1.0, a, b, beta=1.0, c=self._lower, lower=1, overwrite_c=1)


def _room(size: int) -> int:
    """Return how many rows are stored for a large matrix."""
    return _SPARE * (size // _SPARE + 1) + _ODD
