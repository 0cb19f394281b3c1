"""What state each radar's link is in, told from its frames and its log: for lanes and tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum

from slam.app.session import LogLine, RadarInfo, Scan


class LinkState(StrEnum):
    """One of the states a lane shows."""

    SETTING_UP = "setting up"
    STREAMING = "streaming"
    FRAMES_LOST = "frames lost"
    SILENT = "silent"
    FAULT = "fault"
    ENDED = "ended"


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkChange:
    """From `t_ns` of session time on, a radar's link is in this state."""

    t_ns: int
    radar: str
    state: LinkState


@dataclass(slots=True, kw_only=True)
class LinkCount:
    """What came and what did not, of one radar.

    Attributes
    ----------
    frames, lost, faults
        Frames that came; counters missing between them; warnings in the log of its link.
    last_counter, last_t_ns
        Of its newest frame; None before the first.
    longest_gap
        Most frames lost in a row.
    state
        What its lane shows now; None before anything was heard.
    """

    frames: int = 0
    lost: int = 0
    faults: int = 0
    last_counter: int | None = None
    last_t_ns: int | None = None
    longest_gap: int = 0
    state: LinkState | None = None


@dataclass(slots=True)
class LinkLanes:
    """Follows the links of all radars.

    Parameters
    ----------
    radars
        In the order of the frames' radar index.
    """

    radars: tuple[RadarInfo, ...]
    counts: dict[str, LinkCount] = field(init=False)

    def __post_init__(self) -> None:
        """Start with nothing heard."""
        self.counts = {radar.name: LinkCount() for radar in self.radars}

    def on_scan(self, scan: Scan) -> Iterator[LinkChange]:
        """Yield the changes that one tick brings; a radar without a frame in it is silent.

        What SLAM did not use holds late frames, too, and tells nothing of the radars not in it.
        """
        frames = {frame.radar: frame for frame in scan.frames}
        for index, radar in enumerate(self.radars):
            count = self.counts[radar.name]
            frame = frames.get(index)
            if frame is None:
                if scan.used:
                    yield from self._change(radar.name, scan.t_ns, LinkState.SILENT)
                continue
            before = count.last_counter
            gap = 0 if before is None else max(frame.counter - before - 1, 0)
            count.frames += 1
            count.lost += gap
            count.longest_gap = max(count.longest_gap, gap)
            count.last_counter, count.last_t_ns = frame.counter, frame.t_ns
            state = LinkState.FRAMES_LOST if gap else LinkState.STREAMING
            yield from self._change(radar.name, frame.t_ns, state)

    def on_log(self, line: LogLine) -> Iterator[LinkChange]:
        """Yield the change that a line of the log brings, if any."""
        count = self.counts.get(line.radar)
        if count is None:
            return  # a line about something else than a radar
        if line.warning:
            count.faults += 1
            yield from self._change(line.radar, line.t_ns, LinkState.FAULT)
        elif count.state is None:
            yield from self._change(line.radar, line.t_ns, LinkState.SETTING_UP)

    def end(self, t_ns: int) -> Iterator[LinkChange]:
        """Yield the end of every lane."""
        for radar in self.radars:
            yield from self._change(radar.name, t_ns, LinkState.ENDED)

    def _change(self, radar: str, t_ns: int, state: LinkState) -> Iterator[LinkChange]:
        count = self.counts[radar]
        if count.state is not state:
            count.state = state
            yield LinkChange(t_ns=t_ns, radar=radar, state=state)
