"""What a run learns beside SLAM's states goes into its session, as long as the disk takes it."""

from __future__ import annotations

from collections.abc import Callable

from slam.app.link_log import LinkLog
from slam.app.run_events import LinkSaid, WireCame
from slam.app.session import LogLine, Scan, SessionObserver, Snapshot
from slam.app.session_file import CannotWriteError
from slam.app.session_log import SessionLog
from slam.app.tum import TumSample


class LoggingListener(SessionObserver):
    """Hands on what a run learns beside scans; keeps odometry until the log is there.

    A log that cannot be written any more is said once, and the run goes on without.

    Attributes
    ----------
    link_log
        Gets what is said about the link.
    log_trouble
        Why the log is not whole; "" where it is.
    """

    def __init__(self) -> None:
        self.link_log = LinkLog()
        self.log_trouble = ""
        self._log: SessionLog | None = None
        self._has_begun = False
        self._early: list[TumSample] = []

    def attach(self, log: SessionLog, *others: SessionObserver) -> None:
        """Begin to write; let the others hear what is said, too."""
        self._log, self._has_begun = log, True
        early, self._early = self._early, []
        for sample in early:
            self.on_odometry(sample)
        self.link_log.attach(self, *others)

    def on_odometry(self, sample: TumSample) -> None:
        """Write a pose of the wheels."""
        if self._has_begun:
            self._write(lambda log: log.on_odometry(sample))
        else:
            self._early.append(sample)

    def on_wire(self, event: WireCame) -> None:
        """Write raw bytes of a port; those that came before the log was there are not kept."""
        self._write(lambda log: log.on_wire(event.radar, event.way, event.data, event.host_ns))

    def on_link(self, event: LinkSaid) -> None:
        """Take a line of a radar's protocol log."""
        self.link_log.on_record(event.radar, event.record)

    def say(self, who: str, text: str, *, warning: bool) -> None:
        """Take what the user should know; `who` is a radar, the odometry or the run."""
        self.link_log.say(who, text, warning=warning)

    def on_scan(self, scan: Scan) -> None:
        """Write a scan."""
        self._write(lambda log: log.on_scan(scan))

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Write a state."""
        self._write(lambda log: log.on_snapshot(snapshot))

    def on_log(self, line: LogLine) -> None:
        """Write a line about the link."""
        self._write(lambda log: log.on_log(line))

    def end_log(self) -> None:
        """Close the log; that its last chunk does not fit is no reason to lose the results."""
        if self._log is None:
            return
        try:
            self._log.close()
        except CannotWriteError as error:
            self.log_trouble = str(error)
        self._log = None

    def _write(self, write: Callable[[SessionLog], None]) -> None:
        if self._log is None:
            return
        try:
            write(self._log)
        except CannotWriteError as error:
            self._log = None
            self.log_trouble = str(error)
            self.say("run", f"{error}; the run goes on and is not recorded", warning=True)
