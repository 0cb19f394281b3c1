"""What happens on the radars' links, as lines of a session."""

from __future__ import annotations

from slam.app.session import LogLine, Scan, SessionObserver
from xethru_protocol.driver import ProtocolRecord


class LinkLog(SessionObserver):
    """Stamps what the drivers report with session time and passes it on, once someone listens."""

    def __init__(self) -> None:
        self._t_ns = 0
        self._waiting: list[LogLine] = []
        self._listeners: tuple[SessionObserver, ...] = ()

    def attach(self, *listeners: SessionObserver) -> None:
        """Pass on what was said so far, and everything from now on."""
        self._listeners = listeners
        waiting, self._waiting = self._waiting, []
        for line in waiting:
            self._tell(line)

    def on_record(self, radar: str, record: ProtocolRecord) -> None:
        """Take one command, answer, SYSTEM message or fault of a radar's link."""
        text = f"{record.direction} {record.summary}"
        self.say(radar, text, warning=record.direction == "fault")

    def say(self, who: str, text: str, *, warning: bool) -> None:
        """Pass on a line about a radar, the odometry or the run itself."""
        line = LogLine(t_ns=self._t_ns, radar=who, warning=warning, text=text)
        if self._listeners:
            self._tell(line)
        else:
            self._waiting.append(line)

    def on_scan(self, scan: Scan) -> None:
        """Keep session time."""
        self._t_ns = scan.t_ns

    def _tell(self, line: LogLine) -> None:
        for listener in self._listeners:
            listener.on_log(line)
