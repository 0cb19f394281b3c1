"""Frames of one stream in order of arrival: fitted to the geometry, losses counted, bounded.

A radar frame carries float32 values, but the chip counts in integers and the firmware multiplies
each count by one quantum. So only few of all float32 values can be true, and a damaged sample is
nearly always not among them (Protocol reference 9.7). That holds for radar frames as the chip's
driver sends them; what a profile filters before it sends it (BASEBAND_IQ of a real recording) is
on no lattice.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from xethru_protocol.wire.errors import LocalProtocolError
from xethru_protocol.wire.framing import LinkStatistics
from xethru_protocol.wire.messages import BasebandIq, DataFloat
from xethru_protocol.wire.x4 import TRUE_PER_MODULE_METRE, Normalisation

# Sum of the absolute filter taps of the first I set, by TXCENTERFREQUENCY.
_TAP_SUMS: Final = {3: 306, 4: 316}

# Two float32 roundings lie between a counter and its sample: together less than 2 counts.
_NEIGHBOURS: Final = (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0)

# From a counter to its sample and back are six roundings of at most 2**-25 each, relative to the
# largest number among them. Together they are less than half a counter up to this one.
_SURE: Final = 1 << 21

Float32s = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Lattice:
    """The float32 values that counters of one setting become, by the firmware's arithmetic.

    RF: ``counter * quantum - dac_offset`` for the counters 0 ... ``max_counter``. Baseband:
    ``counter * quantum`` for sums of counters weighted by taps of total 0, so from
    ``-max_counter`` to ``max_counter``; the firmware has multiplied the quantum by 1 / ``tap_sum``
    before. Q is sent with the opposite sign, which is the same set.
    Every step rounds to float32; a compiler may have fused RF's product and difference, so the
    value rounded once is accepted, too.

    ``scale`` is the number of counters per unit of a sample; ``lowest`` and ``highest`` are the
    ends of the range. The first three are arrays without axes, since numpy computes faster with
    them than with numbers.
    """

    quantum: Float32s
    dac_offset: Float32s
    scale: Float32s
    tap_sum: int
    min_counter: int
    max_counter: int
    lowest: float
    highest: float

    @classmethod
    def of(
        cls,
        *,
        iterations: int,
        pulses_per_step: int,
        dac_min: int,
        dac_max: int,
        dac_step: int,
        downconversion: bool,
        tx_center_frequency: int,
    ) -> "Lattice":
        """Lattice of a radar with these settings.

        Raises `LocalProtocolError` if they count nothing, or no filter is known for the band.

        >>> lattice = Lattice.of(
        ...     iterations=16, pulses_per_step=300, dac_min=949, dac_max=1100, dac_step=0,
        ...     downconversion=False, tx_center_frequency=3)
        >>> lattice.off_lattice(np.array([-0.07421875, 0.0, 0.0742, 0.1], np.float32))
        2
        """
        if min(iterations, pulses_per_step, dac_max - dac_min + 1) < 1:
            raise LocalProtocolError("a chip with these settings counts nothing")
        if downconversion and tx_center_frequency not in _TAP_SUMS:
            raise LocalProtocolError(
                f"no filter is known for centre frequency {tx_center_frequency}"
            )
        unit = Normalisation.of(
            iterations=iterations,
            pulses_per_step=pulses_per_step,
            dac_min=dac_min,
            dac_max=dac_max,
            dac_step=dac_step,
        )
        tap_sum = _TAP_SUMS[tx_center_frequency] if downconversion else 1
        # all positive taps see the most and all negative ones nothing, or the reverse
        largest = unit.max_counter * tap_sum // 2 if downconversion else unit.max_counter
        smallest = -largest if downconversion else 0
        offset = 0.0 if downconversion else unit.dac_offset
        quantum = np.float32(unit.quantum) * (np.float32(1.0) / np.float32(tap_sum))
        unbounded = cls(
            quantum=np.array(quantum),
            dac_offset=np.array(offset, np.float32),
            scale=np.array(np.float32(1.0) / quantum),
            tap_sum=tap_sum,
            min_counter=smallest,
            max_counter=largest,
            lowest=-math.inf,
            highest=math.inf,
        )
        lowest, highest = unbounded._values(np.array([smallest, largest], np.float32))
        return replace(unbounded, lowest=float(lowest), highest=float(highest))

    def off_lattice(self, samples: Float32s) -> int:
        """Count the values as sent, shape (n,), that no counter can give: also NaN, infinities.

        If they are more than half, it is at least so many: those of counters beyond 2**21, which
        take long to judge, are left out then.
        """
        if samples.size == 0:
            return 0
        # half the time of min() and max(); behind a NaN both are its
        low, high = samples[samples.argmin()], samples[samples.argmax()]
        if low >= self.lowest and high <= self.highest:
            # Nearly every frame is whole: one rounding to the lattice and back proves it. Bytes
            # take a fourth of array_equal's time; a -0.0, which differs from 0.0 there, is judged
            # below.
            counters = self._counters(samples)
            values = self._values(counters)
            if values.tobytes() == samples.tobytes():
                return 0
            return self._count_off(samples, counters, values == samples)
        with np.errstate(invalid="ignore"):  # comparing with a signalling NaN
            in_range = samples[(samples >= self.lowest) & (samples <= self.highest)]
        return samples.size - in_range.size + self.off_lattice(in_range)

    def nearest(self, samples: Float32s) -> Float32s:
        """Return what the chip gives for finite samples, shape (n,), by the nearest counter."""
        counters = np.rint((samples + self.dac_offset) * self.scale)
        counters = np.clip(counters, self.min_counter, self.max_counter).astype(np.float32)
        return self._values(counters)

    def _counters(self, samples: Float32s) -> Float32s:
        """Find each sample's counter in float32: the nearest, or one beside it."""
        counters = samples + self.dac_offset
        counters *= self.scale
        np.rint(counters, out=counters)
        return counters

    def _values(self, counters: Float32s) -> Float32s:
        """Compute the samples of counters; each step rounds to float32, as in the firmware."""
        values = counters * self.quantum
        if self.tap_sum == 1:
            values -= self.dac_offset
        return values

    def _fused(self, counters: Float32s | NDArray[np.float64]) -> Float32s:
        """Compute RF samples of counters, rounded once: as one instruction for both steps does."""
        exact = counters.astype(np.float64)
        exact *= float(self.quantum)
        exact -= float(self.dac_offset)
        return exact.astype(np.float32)

    def _count_off(self, samples: Float32s, counters: Float32s, on: NDArray[np.bool_]) -> int:
        """Count samples between the ends of the range that are not known to be ``on`` it."""
        if self.tap_sum == 1:
            on |= self._fused(counters) == samples
        off = samples.size - int(np.count_nonzero(on))
        if off == 0 or self.max_counter <= _SURE:
            return off
        doubtful = ~on & (np.abs(counters) > _SURE)
        unsure = int(np.count_nonzero(doubtful))
        if 2 * (off - unsure) > samples.size:  # they cannot change the result
            return off - unsure
        return off - self._count_neighbours(samples[doubtful])

    def _count_neighbours(self, samples: Float32s) -> int:
        """Count samples that a counter near the most likely one gives, or the fused arithmetic."""
        scale = 1.0 / float(self.quantum)
        middle: NDArray[np.float64] = np.rint(
            (samples.astype(np.float64) + float(self.dac_offset)) * scale
        )
        # Beyond 2**24 the firmware's float32 skips counters.
        spacing = np.maximum(np.spacing(np.abs(middle).astype(np.float32)), np.float32(1.0))
        found = np.zeros(samples.shape, np.bool_)
        for steps in (0.0, *_NEIGHBOURS):
            exact = np.rint(middle + steps * spacing)
            valid = (exact >= self.min_counter) & (exact <= self.max_counter)
            counters = exact.astype(np.float32)
            if self.tap_sum == 1:
                found |= valid & (self._fused(counters) == samples)
            found |= valid & (self._values(counters) == samples)
        return int(np.count_nonzero(found))


Samples = Float32s | NDArray[np.complex64]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameGeometry:
    """Where the bins of a frame lie, in module metres, from the module's own answers.

    Bin k lies at ``range_start_m + k * bin_length_m``, in RF and in baseband.
    """

    range_start_m: float
    bin_length_m: float
    n_bins: int
    downconversion: bool

    @property
    def ranges_m(self) -> NDArray[np.float64]:
        """Range of each bin, shape (n_bins,) [module metres].

        >>> geometry = FrameGeometry(
        ...     range_start_m=0.5, bin_length_m=0.25, n_bins=3, downconversion=False
        ... )
        >>> geometry.ranges_m.tolist()
        [0.5, 0.75, 1.0]
        """
        return self.range_start_m + np.arange(self.n_bins, dtype=np.float64) * self.bin_length_m

    @property
    def true_ranges_m(self) -> NDArray[np.float64]:
        """Range of each bin, shape (n_bins,) [m].

        The firmware takes 3.0e8 m/s for light, so what it gives is 0.07 % too long. Protocol
        reference 9.1.

        >>> geometry = FrameGeometry(
        ...     range_start_m=3.0, bin_length_m=3.0, n_bins=2, downconversion=False
        ... )
        >>> geometry.true_ranges_m.round(8).tolist()
        [2.99792458, 5.99584916]
        """
        return self.ranges_m * TRUE_PER_MODULE_METRE

    @property
    def area_m(self) -> tuple[float, float]:
        """Frame area as GET FRAMEAREA answers it [module metres]. Protocol reference 9.4."""
        steps = self.n_bins - 1 if self.downconversion else self.n_bins
        return self.range_start_m, self.range_start_m + steps * self.bin_length_m

    @property
    def n_values(self) -> int:
        """Numbers in a radar frame: one per RF bin, I and Q per baseband bin."""
        return 2 * self.n_bins if self.downconversion else self.n_bins

    @property
    def frame_bytes(self) -> int:
        """Bytes of one radar frame on the wire. Protocol reference 1.3, 6.1.

        >>> FrameGeometry(
        ...     range_start_m=0.2, bin_length_m=0.0064, n_bins=1431, downconversion=False
        ... ).frame_bytes
        5747
        """
        return 9 + 14 + 4 * self.n_values

    @classmethod
    def from_read_back(
        cls, *, area_m: tuple[float, float], n_bins: int, downconversion: bool
    ) -> "FrameGeometry":
        """Geometry from the answers to GET FRAMEAREA and GET FRAMEBINCOUNT.

        The area ends at the last bin in baseband, one bin behind it in RF (Protocol reference
        9.4).

        >>> geometry = FrameGeometry.from_read_back(
        ...     area_m=(0.19929012656211853, 9.400678634643555), n_bins=1431, downconversion=False)
        >>> round(geometry.bin_length_m, 8)
        0.00643004
        """
        start, end = area_m
        steps = n_bins - 1 if downconversion else n_bins
        return cls(
            range_start_m=start,
            bin_length_m=(end - start) / steps if steps > 0 else 0.0,
            n_bins=n_bins,
            downconversion=downconversion,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One sweep of the radar.

    ``samples``, shape (geometry.n_bins,): float32 RF amplitudes (read-only, the only copy of
    the received bytes) or complex64 baseband. ``arrival_ns`` is the driver's clock when the
    frame's last byte was read; the frame itself carries only ``counter``. Counters follow on
    each other within a ``stream`` only: streams count from 0, and a new one begins wherever the
    counter may have begun anew (INIT, a restart, a reconnect). Protocol reference 6.1.
    """

    counter: int
    samples: Samples
    geometry: FrameGeometry
    arrival_ns: int
    stream: int = 0

    @property
    def ranges_m(self) -> NDArray[np.float64]:
        """Range of each sample, shape (geometry.n_bins,) [module metres]."""
        return self.geometry.ranges_m

    @property
    def true_ranges_m(self) -> NDArray[np.float64]:
        """Range of each sample, shape (geometry.n_bins,) [m]."""
        return self.geometry.true_ranges_m


def complex_of(i: Float32s, q: Float32s) -> NDArray[np.complex64]:
    """Return I + jQ of equal shapes; parts are kept beside infinities, which 1j * q does not."""
    iq = np.empty(i.shape, np.complex64)
    iq.real = i
    iq.imag = q
    return iq


DEFAULT_FRAMES = 1024  # a minute at 17 frames/s; 6 MB of RF frames
_COUNTER_WRAP = 1 << 32
_ENOUGH = 128  # samples that are judged of a frame behind one that no radar sent, if most are off


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
        Called once per burst of drops: from a first one until the queue was empty again.

    Attributes
    ----------
    geometry
        Where the bins of radar frames lie; None: not known yet, radar frames are discarded.
    lattice
        Which samples radar frames can have; None: not known, nothing is checked.
    rate_hz
        Frames per second that the radar was set to, 0 while it is stopped; None: a profile's.
    dropped
        Frames that came, but left a full queue unread.
    discarded
        Data messages that are not frames of this geometry.
    misfit
        Why the last data message was discarded.
    last_counter
        Counter of the newest frame; None before the first, and where the next follows on nothing.
    stream
        Number of the newest frame's stream.
    """

    def __init__(self, limit: int, statistics: LinkStatistics, warn: Callable[[str], None]) -> None:
        if limit < 1:
            raise LocalProtocolError(f"a frame queue needs room for a frame, not for {limit}")
        self.geometry: FrameGeometry | None = None
        self.lattice: Lattice | None = None
        self.rate_hz: float | None = None
        self.dropped = 0
        self.discarded = 0
        self.misfit = ""
        self.last_counter: int | None = None
        self.stream = 0
        self._limit = limit
        self._statistics = statistics
        self._warn = warn
        self._frames: deque[Frame] = deque()
        self._in_burst = False
        self._gap = (0, 0)  # the last one: counter before it, frames missing in it
        self._not_judged: list[Float32s] = []  # samples of radar frames
        self._off_lattice = False  # more than half of the newest radar frame
        self._restarted = False
        self._outage_hz = 0.0  # rate of the stream that a broken line cut; 0: none was
        # counter and arrival [ns]: of this stream's first frame, of the newest one since `clear`
        self._first: tuple[int, int] | None = None
        self._last: tuple[int, int] | None = None
        self._baseband_geometry: FrameGeometry | None = None

    def __len__(self) -> int:
        return len(self._frames)

    def pop(self) -> Frame:
        frame = self._frames.popleft()
        if not self._frames:
            self._in_burst = False
        return frame

    def clear(self) -> None:
        """Forget the frames that wait: what comes now follows on nothing."""
        self._frames.clear()
        self._in_burst = False
        self._outage_hz = 0.0
        self._last = None
        self.break_off()

    def break_off(self) -> None:
        """Keep the frames that wait, but what comes now does not follow on them."""
        self.last_counter = None
        self._gap = (0, 0)

    def restart(self) -> None:
        """Begin a new stream with the next frame: the chip's counter may begin anew."""
        self._restarted = True
        self.break_off()

    def interrupt(self, rate_hz: float | None = None) -> None:
        """Begin a new stream, as `restart`, and count the frames that are missing before it.

        No counter shows them: their number is the time from the last frame to the next, times
        the frame rate, by default that of the stream that was broken.
        """
        self._outage_hz = rate_hz or self._newest_rate_hz() or self._outage_hz
        self.restart()

    def take(self, message: DataFloat | BasebandIq, arrival_ns: int) -> None:
        """Queue a message's frame, or count the message as discarded."""
        if isinstance(message, BasebandIq):
            self._take_baseband(message, arrival_ns)
        else:
            self._take_radar_frame(message, arrival_ns)

    def _take_radar_frame(self, message: DataFloat, arrival_ns: int) -> None:
        geometry, values = self.geometry, message.values
        # radar frames have content id 0 (Protocol reference 6.1)
        if geometry is None or message.content_id != 0 or values.size != geometry.n_values:
            self._discard(message)
            return
        if self.lattice is not None:
            self._not_judged.append(values)
        n = geometry.n_bins
        samples = complex_of(values[:n], values[n:]) if geometry.downconversion else values
        self._queue(message.info, samples, geometry, arrival_ns)

    def judge(self) -> None:
        """Count the samples off the lattice in what was taken since the last call.

        Many frames at once take half the time, and nearly all of them are whole.
        """
        frames, self._not_judged = self._not_judged, []
        if self.lattice is None or (
            len(frames) > 1
            and not self._off_lattice
            and not self.lattice.off_lattice(np.concatenate(frames))
        ):
            return
        for values in frames:
            self._statistics.off_lattice_samples += self._count_off(self.lattice, values)

    def _count_off(self, lattice: Lattice, values: Float32s) -> int:
        """Count the samples off the lattice; a lower bound where most are."""
        if self._off_lattice:
            off = lattice.off_lattice(values[:_ENOUGH])
            if 2 * off > _ENOUGH:
                return off
        off = lattice.off_lattice(values)
        self._off_lattice = 2 * off > values.size
        return off

    def discard(self, why: str) -> None:
        """Count what came as no frame of this geometry."""
        self.discarded += 1
        self.misfit = why

    def _discard(self, message: DataFloat) -> None:
        if message.content_id != 0:
            why = f"data with content id {message.content_id} came, which radar frames do not have"
        elif self.geometry is None:
            why = (
                f"radar frames of {message.values.size} values come, but where their bins lie is "
                "not known, so they are discarded; call configure_raw(), or attach() if they are "
                "another program's, or set the driver's geometry"
            )
        else:
            why = (
                f"frames of {message.values.size} values come, not of the {self.geometry.n_values} "
                "of configure_raw(); call it again"
            )
        self.discard(why)

    def _take_baseband(self, message: BasebandIq, arrival_ns: int) -> None:
        geometry = FrameGeometry(
            range_start_m=message.range_offset_m,
            bin_length_m=message.bin_length_m,
            n_bins=message.num_bins,
            downconversion=True,
        )
        if geometry != self._baseband_geometry:
            self._baseband_geometry = geometry
        self._queue(
            message.counter, complex_of(message.i, message.q), self._baseband_geometry, arrival_ns
        )

    def _queue(
        self, counter: int, samples: Samples, geometry: FrameGeometry, arrival_ns: int
    ) -> None:
        if self._restarted:
            self._begin_stream(arrival_ns)
        elif self.last_counter is not None:
            self._count_missing(self.last_counter, counter, arrival_ns)
        self.last_counter = counter
        self._last = counter, arrival_ns
        if self._first is None:
            self._first = self._last
        if len(self._frames) >= self._limit:
            self._drop_oldest()
        self._frames.append(
            Frame(
                counter=counter,
                samples=samples,
                geometry=geometry,
                arrival_ns=arrival_ns,
                stream=self.stream,
            )
        )

    def _begin_stream(self, arrival_ns: int) -> None:
        if self._first is not None:  # streams without a frame are not counted
            if self._last is not None:
                away_s = (arrival_ns - self._last[1]) * 1e-9
                self._statistics.frames_lost += max(round(away_s * self._outage_hz) - 1, 0)
            self.stream += 1
        self._first = None
        self._restarted = False
        self._outage_hz = 0.0
        self._gap = (0, 0)

    def _newest_rate_hz(self) -> float:
        """Return the rate of the newest stream: as set, or by its counters; 0 if not known."""
        if self.rate_hz is not None:
            return self.rate_hz
        if self._first is None or self._last is None:
            return 0.0
        (first, first_ns), (last, last_ns) = self._first, self._last
        counted = (last - first) % _COUNTER_WRAP
        return counted * 1e9 / (last_ns - first_ns) if last_ns > first_ns else 0.0

    def _count_missing(self, last: int, counter: int, arrival_ns: int) -> None:
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
        elif counter != last:  # old firmware sends a frame twice at times
            self._begin_stream(arrival_ns)

    def _drop_oldest(self) -> None:
        self._frames.popleft()
        self.dropped += 1
        if not self._in_burst:
            self._in_burst = True
            self._warn(
                f"{self._limit} frames wait unread, so the oldest are dropped; "
                "read them faster or make the queue longer"
            )
