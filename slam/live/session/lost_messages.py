"""What damage took out of a session, from what is whole around it.

A copy of the head says how many messages come before it, and so does the index at the end. Where
that is what was found, damage took nothing but a copy or an index.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import TypeAlias

from pydantic import TypeAdapter

from slam.live.session.description import checked
from slam.live.session_records import Gap

_SCANS = ("/scan", "/scan_unused")

Newest: TypeAlias = dict[int, tuple[int, int]]
"""Sequence number and time [ns] of a message, by the number of its channel."""


@dataclass(slots=True, kw_only=True)
class _DamagedPlace:
    """Damage, with the last message of each channel before it and the first behind it."""

    at: int
    before: Newest
    behind: Newest = field(default_factory=dict)


@dataclass(slots=True, kw_only=True)
class _MessageCount:
    """How many messages come before some place, and how many were found of each channel."""

    n_before: int
    found: dict[int, int]
    n_places: int


class GapFinder:
    """Takes what a file holds in its order, then returns what it lacks."""

    def __init__(self) -> None:
        self._found: dict[int, int] = {}
        self._newest: Newest = {}
        self._start_ns: int | None = None
        self._places: list[_DamagedPlace] = []
        self._counts: list[_MessageCount] = []
        self._n_places_of_data: int | None = None
        self.n_elsewhere = 0
        """Messages that are missing where nothing is damaged; `gaps` counts them."""

    def damage(self, at: int) -> None:
        self._places.append(_DamagedPlace(at=at, before=dict(self._newest)))

    def message(self, channel: int, sequence: int, t_ns: int) -> None:
        self._start_ns = t_ns if self._start_ns is None else self._start_ns
        self._found[channel] = self._found.get(channel, 0) + 1
        self._n_places_of_data = None
        newest = self._newest.get(channel, (0, t_ns))[1]
        self._newest[channel] = sequence, max(newest, t_ns)
        if self._places:
            self._places[-1].behind.setdefault(channel, (sequence, t_ns))

    def end_data(self) -> None:
        """Take the end of the data: damage behind it loses nothing, if no message follows."""
        self._n_places_of_data = len(self._places)

    def count(self, n_before: int) -> None:
        """Take the number of messages before this place, those of latched channels left out."""
        found = dict(self._found)
        self._counts.append(
            _MessageCount(n_before=n_before, found=found, n_places=len(self._places))
        )

    def gaps(self, topics: Mapping[int, str]) -> dict[int, Gap]:
        """Return the gaps by the bytes at which their damage begins.

        ``topics`` are those of all channels that are not latched.
        """
        return {place.at: self._gap(place, n_lost, topics) for place, n_lost in self._lossy(topics)}

    def _lossy(self, topics: Mapping[int, str]) -> Iterator[tuple[_DamagedPlace, int | None]]:
        """Yield the places that lost something, each with how many messages, if known."""
        n_lost_before = done = self.n_elsewhere = 0
        of_data = self._places[: self._n_places_of_data]
        for count in self._counts:
            places = self._merged(of_data[done : count.n_places], topics)
            n_found = sum(n for channel, n in count.found.items() if channel in topics)
            n_lost = count.n_before - n_found - n_lost_before
            if n_lost > 0:
                yield from ((place, n_lost if len(places) == 1 else None) for place in places)
                self.n_elsewhere += 0 if places else n_lost
            n_lost_before += max(n_lost, 0)
            done = count.n_places
        yield from ((place, None) for place in self._merged(of_data[done:], topics))

    @staticmethod
    def _merged(places: list[_DamagedPlace], topics: Mapping[int, str]) -> list[_DamagedPlace]:
        """Return damage with nothing between it as one place."""
        merged: list[_DamagedPlace] = []
        for place in places:
            if merged and not merged[-1].behind.keys() & topics.keys():
                merged[-1].behind = place.behind
            else:
                merged.append(place)
        return merged

    def _gap(self, place: _DamagedPlace, n_lost: int | None, topics: Mapping[int, str]) -> Gap:
        # log lines may be of any time
        of_time = {number: topic for number, topic in topics.items() if topic != "/log"}
        before = {of_time[n]: row for n, row in place.before.items() if n in of_time}
        behind = {of_time[n]: row for n, row in place.behind.items() if n in of_time}
        frames = {}
        for topic in sorted(before.keys() & behind.keys()):
            n_missing = behind[topic][0] - before[topic][0] - 1
            if topic.endswith("/frame") and n_missing > 0:
                frames[topic.removeprefix("/radar/").removesuffix("/frame")] = n_missing
        last = max((before[topic][0] for topic in _SCANS if topic in before), default=None)
        first = min((behind[topic][0] for topic in _SCANS if topic in behind), default=None)
        scans = None
        if last is not None and first is not None and first - last > 1:
            scans = last + 1, first - 1
        return Gap(
            from_ns=max((t_ns for _, t_ns in before.values()), default=self._start_ns or 0),
            to_ns=min((t_ns for _, t_ns in behind.values()), default=None),
            n_messages=n_lost,
            scans=scans,
            frames=frames,
        )


def gap_json(gap: Gap) -> str:
    return json.dumps(asdict(gap))


_GAP = TypeAdapter(Gap)


def read_gap(text: str) -> Gap:
    """Read a gap; ValueError if it makes no sense."""
    return checked(_GAP, json.loads(text))
