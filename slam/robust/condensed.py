"""What poses told that are kept no longer, by landmark id: the log's prior."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.robust.problem import Prior
from slam.robust.symmetric import Array, Indices


class Condensed:
    """A prior whose landmarks have ids, so that the map may change under it.

    Parameters
    ----------
    prior
        Of the first pose kept, its calibration, the offsets and the landmarks.
    landmark_ids
        Of its landmarks, in order.
    """

    def __init__(self, prior: Prior, landmark_ids: Sequence[int]) -> None:
        self._prior = prior
        self._ids = list(landmark_ids)

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """Return the ids of the landmarks it tells something of."""
        return tuple(self._ids)

    def of(self, landmark_ids: Sequence[int], n_walls: int = 0) -> Prior:
        """Return the prior of a map: landmarks it does not know have no information.

        The last ``n_walls`` of the ids are walls'.

        Raises
        ------
        ValueError
            A landmark it does know is not in the map: it should have been dropped or renamed.
        """
        if missing := set(self._ids) - set(landmark_ids):
            raise ValueError(f"the prior tells of landmarks that the map lacks: {sorted(missing)}")
        prior, head = self._prior, self._head
        place = {id_: row for row, id_ in enumerate(landmark_ids)}
        at = np.concatenate([np.arange(head), _columns([place[i] for i in self._ids], head)])
        size = head + 2 * len(landmark_ids)
        information = np.zeros((size, size))
        information[np.ix_(at, at)] = prior.information
        gradient, mean = np.zeros(size), np.zeros(size)
        gradient[at], mean[at] = prior.gradient, prior.mean
        return Prior(information=information, gradient=gradient, mean=mean, n_walls=n_walls)

    def rename(self, gone: int, kept: int) -> None:
        """Let what is known of one landmark be of another, to which it is the same point.

        With l_gone = l_kept their errors differ by a constant: e_gone = e_kept + d,
        d = mean_kept - mean_gone.
        """
        if gone not in self._ids:
            return
        if kept not in self._ids:
            self._ids[self._ids.index(gone)] = kept
            return
        prior = self._prior
        into, from_ = self._at(kept), self._at(gone)
        d = np.zeros(len(prior.mean))
        d[from_] = prior.mean[into] - prior.mean[from_]
        gradient = prior.gradient + prior.information @ d
        information = prior.information.copy()
        information[into] += information[from_]
        information[:, into] += information[:, from_]
        gradient[into] += gradient[from_]
        self._keep(gone, information, gradient)

    def drop(self, landmark_id: int) -> None:
        """Marginalise a landmark."""
        if landmark_id not in self._ids:
            return
        prior, at = self._prior, self._at(landmark_id)
        gain = prior.information[:, at] @ np.linalg.pinv(prior.information[np.ix_(at, at)])
        information = prior.information - gain @ prior.information[at]
        gradient = prior.gradient - gain @ prior.gradient[at]
        self._keep(landmark_id, (information + information.T) / 2, gradient)

    @property
    def _head(self) -> int:
        return len(self._prior.mean) - 2 * len(self._ids)

    def _at(self, landmark_id: int) -> Indices:
        return _columns([self._ids.index(landmark_id)], self._head)

    def _keep(self, gone: int, information: Array, gradient: Array) -> None:
        keep = np.delete(np.arange(len(gradient)), self._at(gone))
        self._prior = Prior(
            information=information[np.ix_(keep, keep)],
            gradient=gradient[keep],
            mean=self._prior.mean[keep],
        )
        self._ids.remove(gone)


def _columns(rows: Sequence[int], head: int) -> Indices:
    first = head + 2 * np.array(rows, dtype=np.intp)
    return np.stack([first, first + 1], axis=-1).ravel()
