"""Which landmarks are believed in: a score that hits raise and misses lower."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from slam.robust.parameters import MapRule


@dataclass(slots=True)
class _Record:
    score: float = 0.0
    hits: int = 0


class Existence:
    """Scores of all landmarks by id, and which pairs were seen whole in common frames.

    Parameters
    ----------
    rule
        Steps and limits.
    """

    def __init__(self, rule: MapRule) -> None:
        self._rule = rule
        self._records: dict[int, _Record] = {}
        self._together: dict[tuple[int, int], int] = {}

    def hit(self, landmark_id: int, frames: int = 1) -> None:
        """Count frames that hit a landmark; a new id begins here."""
        record = self._records.setdefault(landmark_id, _Record())
        record.score = min(record.score + frames * self._rule.hit, self._rule.most)
        record.hits += frames

    def miss(self, landmark_id: int) -> None:
        """Count a frame that should have hit a landmark and did not."""
        self._records[landmark_id].score -= self._rule.miss

    def lost(self) -> list[int]:
        """Return the ids of landmarks that are believed in no longer."""
        return [id_ for id_, record in self._records.items() if record.score < self._rule.least]

    def hits(self, landmark_id: int) -> int:
        """Return the number of frames that hit a landmark."""
        return self._records[landmark_id].hits

    def is_reported(self, landmark_id: int) -> bool:
        """Tell whether a landmark was hit often enough to be shown."""
        return self._records[landmark_id].hits >= self._rule.report_hits

    def forget(self, landmark_id: int) -> None:
        """Drop all that is known of a landmark."""
        self._records.pop(landmark_id, None)
        for pair in [pair for pair in self._together if landmark_id in pair]:
            del self._together[pair]

    def seen_whole(self, landmark_ids: Iterable[int]) -> None:
        """Count a frame in which each of these was seen by both radars of a pair."""
        ids = sorted(landmark_ids)
        for place, first in enumerate(ids):
            for second in ids[place + 1 :]:
                key = (first, second)
                self._together[key] = self._together.get(key, 0) + 1

    def are_apart(self, first: int, second: int) -> bool:
        """Tell whether two landmarks were seen whole together, and so are two.

        Only whole sightings count: of two copies of one target, each can be given one of its two
        ranges, and they would veto their own merge.
        """
        key = (min(first, second), max(first, second))
        return self._together.get(key, 0) >= self._rule.apart_frames

    def merge(self, kept: int, gone: int) -> None:
        """Let one landmark take over what is known of another."""
        into, other = self._records[kept], self._records[gone]
        into.score = min(max(into.score, 0.0) + max(other.score, 0.0), self._rule.most)
        into.hits += other.hits
        for (first, second), count in list(self._together.items()):
            if gone in (first, second):
                third = second if first == gone else first
                if third != kept:
                    key = (min(kept, third), max(kept, third))
                    self._together[key] = self._together.get(key, 0) + count
        self.forget(gone)
