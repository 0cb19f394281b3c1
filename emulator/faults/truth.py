"""The truth log: every fault that was injected, so that what was detected can be held against it.

JSON lines, one object per fault: ``t_ns`` (device time), ``radar``, ``kind``, ``parameters``,
``counter`` (of the last radar frame, null before the first), ``offset`` (bytes sent to the host
before the packet that it hit).
"""

from __future__ import annotations

import json
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

__all__ = ["Injected", "TruthLog"]

_KEPT = 100_000  # records in memory; a log on disk has no such end


@dataclass(frozen=True, slots=True, kw_only=True)
class Injected:
    """One injected fault; see the module for the fields."""

    t_ns: int
    radar: str
    kind: str
    parameters: Mapping[str, Any]
    counter: int | None
    offset: int


class TruthLog:
    """What was injected, in order.

    Parameters
    ----------
    write
        Called with every record as a line of JSON, line end included; None: kept in memory only.

    Attributes
    ----------
    records
        The last 100 000.
    counts
        How often each kind was injected.
    """

    def __init__(self, write: Callable[[str], object] | None = None) -> None:
        self._write = write
        self.records: deque[Injected] = deque(maxlen=_KEPT)
        self.counts: Counter[str] = Counter()

    def note(self, injected: Injected) -> None:
        """Add a record."""
        self.records.append(injected)
        self.counts[injected.kind] += 1
        if self._write is not None:
            self._write(json.dumps(asdict(injected), separators=(",", ":")) + "\n")
