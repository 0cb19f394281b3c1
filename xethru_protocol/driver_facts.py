"""What both drivers tell without asking the module."""

from xethru_protocol.conversation import Listener, RawListener
from xethru_protocol.core import RadarCore
from xethru_protocol.frames import FrameGeometry
from xethru_protocol.statistics import LinkStatistics


class DriverFacts:
    """Counters and settings of one driver.

    Attributes
    ----------
    raw_listener
        Called with ``"rx"`` or ``"tx"``, the bytes as they went over the line, and the driver's
        time [ns]; None: nobody.
    """

    def __init__(self, core: RadarCore) -> None:
        self.raw_listener: RawListener | None = None
        self._core = core

    @property
    def port(self) -> str:
        """Where the module is; after a reconnect perhaps not where it was."""
        return self._core.path

    @property
    def warnings(self) -> list[str]:
        """What was asked of the module although it is likely to fail, or went wrong quietly.

        The last 1000, oldest first; whoever has shown them may clear the list.
        """
        return self._core.warnings

    @property
    def listener(self) -> Listener | None:
        """Called with every message from the module, frames included, and its arrival [ns]."""
        return self._core.conversation.listener

    @listener.setter
    def listener(self, listener: Listener | None) -> None:
        self._core.conversation.listener = listener

    @property
    def geometry(self) -> FrameGeometry | None:
        """Where the bins of the radar frames lie; None before `configure_raw`."""
        return self._core.frames.geometry

    @geometry.setter
    def geometry(self, geometry: FrameGeometry | None) -> None:
        self._core.frames.geometry = geometry

    @property
    def statistics(self) -> LinkStatistics:
        """What came over the line and what was wrong with it, since the driver was opened."""
        return self._core.statistics

    @property
    def frames_lost(self) -> int:
        """Frames missing by the counters of those that came."""
        return self._core.statistics.frames_lost

    @property
    def frames_dropped(self) -> int:
        """Frames that came, but left a full queue unread."""
        return self._core.frames.dropped

    @property
    def frames_discarded(self) -> int:
        """Data that are no frame of the geometry, such as frames of older settings."""
        return self._core.frames.discarded

    @property
    def messages_dropped(self) -> int:
        """Profile messages that came, but left a full queue unread."""
        return self._core.messages_dropped

    @property
    def fault_count(self) -> int:
        """Damaged places seen on the line."""
        return self._core.conversation.fault_count

    @property
    def stray_count(self) -> int:
        """Answers seen that belong to no request."""
        return self._core.conversation.stray_count

    @property
    def reboots(self) -> int:
        """SYSTEM BOOTING messages seen."""
        return self._core.conversation.reboots

    @property
    def reconnects(self) -> int:
        """Times the module vanished and was found again."""
        return self._core.reconnects
