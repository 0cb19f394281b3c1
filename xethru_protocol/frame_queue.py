"""Frames of one stream in order of arrival: fitted to the geometry, losses counted."""

from collections import deque

from xethru_protocol.dialogue import FrameMessage
from xethru_protocol.frames import Frame, FrameGeometry, Samples, baseband, rf_or_baseband
from xethru_protocol.messages import BasebandIq, DataFloat

_COUNTER_WRAP = 1 << 32


class FrameQueue:
    """Frames that came and were not taken yet.

    Attributes
    ----------
    geometry
        Where the bins of radar frames lie; None: not known yet, radar frames are discarded.
    lost
        Frames missing by the counters of those that came.
    discarded
        Data messages that are no frame of this geometry.
    last_counter
        Counter of the newest frame of this stream; None before the first.
    """

    def __init__(self) -> None:
        self.geometry: FrameGeometry | None = None
        self.lost = 0
        self.discarded = 0
        self._frames: deque[Frame] = deque()
        self.last_counter: int | None = None
        self._baseband_geometry: FrameGeometry | None = None

    def __len__(self) -> int:
        """Count the frames that wait."""
        return len(self._frames)

    def pop(self) -> Frame:
        """Take the oldest frame."""
        return self._frames.popleft()

    def new_stream(self) -> None:
        """Forget the frames that wait and their counters: what comes now follows on nothing."""
        self._frames.clear()
        self.last_counter = None

    def take(self, message: FrameMessage, arrival_ns: int) -> None:
        """Queue a message's frame, or count the message as discarded."""
        if isinstance(message, BasebandIq):
            self._take_baseband(message, arrival_ns)
        else:
            self._take_radar_frame(message, arrival_ns)

    def _take_radar_frame(self, message: DataFloat, arrival_ns: int) -> None:
        geometry = self.geometry
        samples = None if geometry is None else rf_or_baseband(message, geometry)
        if geometry is None or samples is None:
            self.discarded += 1
            return
        self._queue(message.info, samples, geometry, arrival_ns)

    def _take_baseband(self, message: BasebandIq, arrival_ns: int) -> None:
        geometry = FrameGeometry(
            range_start_m=message.range_offset_m,
            bin_length_m=message.bin_length_m,
            n_bins=message.num_bins,
            downconversion=True,
        )
        if geometry != self._baseband_geometry:
            self._baseband_geometry = geometry
        self._queue(message.counter, baseband(message), self._baseband_geometry, arrival_ns)

    def _queue(
        self, counter: int, samples: Samples, geometry: FrameGeometry, arrival_ns: int
    ) -> None:
        if self.last_counter is not None:
            missing = (counter - self.last_counter - 1) % _COUNTER_WRAP
            if missing < _COUNTER_WRAP // 2:  # else it went back: the chip was restarted
                self.lost += missing
        self.last_counter = counter
        self._frames.append(
            Frame(counter=counter, samples=samples, geometry=geometry, arrival_ns=arrival_ns)
        )
