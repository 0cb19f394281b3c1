"""Frames of one stream in order of arrival: fitted to the geometry, losses counted, bounded."""

from collections import deque
from collections.abc import Callable

from xethru_protocol.errors import LocalProtocolError
from xethru_protocol.frames import Frame, FrameGeometry, Samples, baseband, rf_or_baseband
from xethru_protocol.lattice import Lattice
from xethru_protocol.messages import BasebandIq, DataFloat
from xethru_protocol.statistics import LinkStatistics

DEFAULT_FRAMES = 1024  # a minute at 17 frames/s; 6 MB of RF frames
_COUNTER_WRAP = 1 << 32


class FrameQueue:
    """Frames that came and were not taken yet.

    A full queue drops its oldest frame for every new one.

    Parameters
    ----------
    limit
        How many frames may wait, at least 1.
    statistics
        Where lost frames and damaged samples are counted.
    warn
        Told once per burst of drops: from a first one until the queue was empty again.

    Attributes
    ----------
    geometry
        Where the bins of radar frames lie; None: not known yet, radar frames are discarded.
    lattice
        Which samples radar frames can have; None: not known, nothing is checked.
    dropped
        Frames that came, but left a full queue unread.
    discarded
        Data messages that are no frame of this geometry.
    last_counter
        Counter of the newest frame of this stream; None before the first.
    """

    def __init__(self, limit: int, statistics: LinkStatistics, warn: Callable[[str], None]) -> None:
        if limit < 1:
            raise LocalProtocolError(f"a frame queue needs room for a frame, not for {limit}")
        self.geometry: FrameGeometry | None = None
        self.lattice: Lattice | None = None
        self.dropped = 0
        self.discarded = 0
        self.last_counter: int | None = None
        self._limit = limit
        self._statistics = statistics
        self._warn = warn
        self._frames: deque[Frame] = deque()
        self._in_burst = False
        self._gap = (0, 0)  # the last one: counter before it, frames missing in it
        self._baseband_geometry: FrameGeometry | None = None

    def __len__(self) -> int:
        """Count the frames that wait."""
        return len(self._frames)

    def pop(self) -> Frame:
        """Take the oldest frame."""
        frame = self._frames.popleft()
        if not self._frames:
            self._in_burst = False
        return frame

    def new_stream(self) -> None:
        """Forget the frames that wait and their counters: what comes now follows on nothing."""
        self._frames.clear()
        self._in_burst = False
        self.break_off()

    def break_off(self) -> None:
        """Keep the frames that wait, but what comes now does not follow on them."""
        self.last_counter = None
        self._gap = (0, 0)

    def take(self, message: DataFloat | BasebandIq, arrival_ns: int) -> None:
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
        if self.lattice is not None:
            self._statistics.off_lattice_samples += self.lattice.off_lattice(message.values)
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
            self._count_missing(self.last_counter, counter)
        self.last_counter = counter
        if len(self._frames) >= self._limit:
            self._drop_oldest()
        self._frames.append(
            Frame(counter=counter, samples=samples, geometry=geometry, arrival_ns=arrival_ns)
        )

    def _count_missing(self, last: int, counter: int) -> None:
        missing = (counter - last - 1) % _COUNTER_WRAP
        if missing < _COUNTER_WRAP // 2:
            self._statistics.frames_lost += missing
            self._gap = (last, missing)
            return
        # It went back: the chip was restarted, or the last counter was damaged. Then this one
        # lies in the gap which that one seemed to make, and one of those before it did come.
        before, gap = self._gap
        inside = (counter - before - 1) % _COUNTER_WRAP
        if 1 <= inside <= gap:
            self._statistics.frames_lost += inside - 1 - gap
        self._gap = (0, 0)

    def _drop_oldest(self) -> None:
        self._frames.popleft()
        self.dropped += 1
        if not self._in_burst:
            self._in_burst = True
            self._warn(
                f"{self._limit} frames wait unread, so the oldest are dropped; "
                "read them faster or make the queue longer"
            )
