"""The radars' links in Rerun: the log, a lane of states, lost frames, a marker for every fault."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np

from slam.app.link_lanes import LinkChange, LinkLanes, LinkState
from slam.app.rerun_recording import Recording, Stamps, part
from slam.app.rerun_sdk import rr
from slam.app.session import LogLine, RadarInfo, Scan
from slam.app.view_style import FAULT_RGB, RADAR_RGB

_STATE_COLOURS = {
    LinkState.SETTING_UP: 0x5B6B8CFF,
    LinkState.STREAMING: 0x2E8B57FF,
    LinkState.FRAMES_LOST: 0xE0A030FF,
    LinkState.SILENT: 0x8C5A2BFF,
    LinkState.FAULT: 0xD03A3AFF,
    LinkState.ENDED: 0x444A52FF,
}


class LinkLayer:
    """Collects lines and changes of state, and sends them in blocks.

    Lines come at any time, also from the threads that read the ports; all else is of one thread.
    """

    def __init__(self, recording: Recording, radars: Sequence[RadarInfo]) -> None:
        self._recording = recording
        self._lanes = LinkLanes(tuple(radars))
        self._heard: deque[LogLine] = deque()
        self._changes: list[tuple[LinkChange, int, int | None]] = []
        self._losses: dict[str, tuple[Stamps, list[int]]] = {
            radar.name: (Stamps.none(), []) for radar in radars
        }
        self._counter = self._t_ns = 0
        self._host_ns: int | None = None
        for index, radar in enumerate(radars):
            states = rr.StateConfiguration(
                values=[str(state) for state in _STATE_COLOURS],
                colors=list(_STATE_COLOURS.values()),
            )
            recording.static(f"link/state/{part(radar.name)}", states)
            line = rr.SeriesLines(
                colors=RADAR_RGB[index % len(RADAR_RGB)],
                names=f"{radar.name}: lost",
                widths=1.5,
                interpolation_mode=rr.components.InterpolationMode.StepAfter,
            )
            recording.static(f"link/lost/{part(radar.name)}", line)
            marker = rr.SeriesPoints(
                colors=FAULT_RGB, markers="cross", names=f"{radar.name}: fault", marker_sizes=5.0
            )
            recording.static(f"link/faults/{part(radar.name)}", marker)

    def on_scan(self, scan: Scan, host_ns: int | None) -> None:
        """Take the frames of one tick: who sent, who lost."""
        self._follow_log()
        self._counter, self._t_ns, self._host_ns = scan.counter, scan.t_ns, host_ns
        before = {name: count.lost for name, count in self._lanes.counts.items()}
        self._note(self._lanes.on_scan(scan))
        for name, count in self._lanes.counts.items():
            stamps, values = self._losses[name]
            # A step, so also where it starts; a line that never moves needs its ends only.
            if count.lost != before[name] or count.frames == 1:
                stamps.add(scan.t_ns, scan.counter, host_ns)
                values.append(count.lost)

    def on_log(self, line: LogLine) -> None:
        """Take a line about the link."""
        self._heard.append(line)

    def send(self) -> None:
        """Send what waits."""
        self._follow_log()
        changes, self._changes = self._changes, []
        for radar in self._lanes.radars:
            stamps = Stamps.none()
            states = []
            for change, counter, host_ns in changes:
                if change.radar == radar.name:
                    stamps.add(change.t_ns, counter, host_ns)
                    states.append(str(change.state))
            if states:
                columns = rr.StateChange.columns(state=states)
                self._recording.rows(f"link/state/{part(radar.name)}", stamps, columns)
            losses, values = self._losses[radar.name]
            self._losses[radar.name] = Stamps.none(), []
            if values:
                scalars = rr.Scalars.columns(scalars=np.array(values, dtype=np.float64))
                self._recording.rows(f"link/lost/{part(radar.name)}", losses, scalars)

    def finish(self) -> None:
        """Send what waits, and end every lane."""
        self._follow_log()
        self._note(self._lanes.end(self._t_ns))
        for name, count in self._lanes.counts.items():
            stamps, values = self._losses[name]
            stamps.add(self._t_ns, self._counter, self._host_ns)
            values.append(count.lost)
        self.send()

    def _note(self, changes: Iterable[LinkChange]) -> None:
        self._changes += [(change, self._counter, self._host_ns) for change in changes]

    def _follow_log(self) -> None:
        """Send the lines that came meanwhile, and let the lanes follow them."""
        lines = []
        while self._heard:  # not a swap: another thread may add while this runs
            lines.append(self._heard.popleft())
        for line in lines:
            self._note(self._lanes.on_log(line))
        for name in dict.fromkeys(line.radar for line in lines):
            self._send_lines(name, [line for line in lines if line.radar == name])

    def _send_lines(self, name: str, lines: Sequence[LogLine]) -> None:
        stamps = self._stamps_of(lines)
        columns = rr.TextLog.columns(
            text=[line.text for line in lines],
            level=["WARN" if line.warning else "INFO" for line in lines],
        )
        self._recording.rows(f"link/log/{part(name)}", stamps, columns)
        faults = [line for line in lines if line.warning]
        if faults and name in self._lanes.counts:
            # The number of the fault, so that a burst of them is a steep stair.
            last = self._lanes.counts[name].faults
            numbers = np.arange(last - len(faults) + 1, last + 1, dtype=np.float64)
            scalars = rr.Scalars.columns(scalars=numbers)
            self._recording.rows(f"link/faults/{part(name)}", self._stamps_of(faults), scalars)

    def _stamps_of(self, lines: Sequence[LogLine]) -> Stamps:
        stamps = Stamps.none()
        for line in lines:
            stamps.add(line.t_ns, self._counter, self._host_ns)
        return stamps
