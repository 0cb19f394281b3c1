"""Where radar frames come from: drivers on ports or in process, grouped into scans.

Here, and nowhere else, module metres become true metres: the module computes with light at
3.0e8 m/s, echoes travel at 299 792 458 m/s.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from typing import Literal, Self, cast

import numpy as np
from numpy.typing import NDArray

from slam.frames import RadarFrame
from slam.geometry import Mount
from slam.live.errors import AppError, RadarSilentError
from slam.live.odometry_track import NS_PER_S
from slam.live.session_records import RadarInfo, Scan
from xethru_protocol.driver.frames import Frame
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.matching import ProtocolRecord
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.wire.errors import Disconnected, ResponseTimeout, XeThruError
from xethru_protocol.wire.x4 import (
    FIRST_COUNTER,
    TRUE_PER_MODULE_METRE,
    Normalisation,
    frame_time_ns,
)

SILENCE_S = 5.0
_POLL_S = 0.25


StreamBegins = Callable[[str], int]
"""Returns where the newest stream of a radar, by its name, begins in scene time [ns].

Without the radar's start skew. AppError if that cannot be had.
"""
RecordObserver = Callable[[str, ProtocolRecord], None]
"""Gets a radar's name and what happened on its link."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RadarLink:
    """An open driver and what it is called: its mount on the robot, its port, its serial number.

    `start_skew_ns` is the session time of its first frame, 0 or later; `gain_db` as in `RadarInfo`.
    """

    mount: Mount
    port: str
    serial: str
    driver: X4M300
    start_skew_ns: int = 0
    gain_db: float = 0.0

    @contextmanager
    def naming(self) -> Iterator[None]:
        """Turn an error of the driver into an AppError that names the radar."""
        try:
            yield
        except XeThruError as error:
            raise AppError(f"radar {self.mount.name} at {self.port}: {error}") from error


def sampler_limits(config: RawConfig) -> tuple[float, float]:
    """Return the smallest and the largest value of a raw RF sample, normalised units.

    What the counter's ends are as float32 on the wire, so that samples can be compared with them
    exactly. Protocol reference 9.7.

    >>> sampler_limits(RawConfig(dac_min=949, dac_max=1100))
    (-0.07421875, 0.07421875)
    """
    scale = Normalisation.of(
        iterations=config.iterations,
        pulses_per_step=config.pulses_per_step,
        dac_min=config.dac_min,
        dac_max=config.dac_max,
        dac_step=config.dac_step,
    )
    largest = np.float32(scale.max_counter) * np.float32(scale.quantum)
    return -scale.dac_offset, float(largest - np.float32(scale.dac_offset))


def radar_frame(
    radar: int,
    frame: Frame,
    t_ns: int,
    *,
    limits: tuple[float, float] | None = None,
) -> RadarFrame:
    """Turn a driver's frame into one for SLAM, of true metres.

    `radar` is its index in the rig, `t_ns` the session time at which the frame was taken, `limits`
    those of the sampler, see `RadarFrame`.
    """
    return RadarFrame(
        radar=radar,
        t_ns=t_ns,
        counter=frame.counter,
        # raw RF was configured, so they are real; RadarFrame refuses anything else
        samples=cast(NDArray[np.float32], frame.samples),
        range_start_m=frame.geometry.range_start_m * TRUE_PER_MODULE_METRE,
        bin_length_m=frame.geometry.bin_length_m * TRUE_PER_MODULE_METRE,
        limits=limits,
        stream=frame.stream,
    )


def less_gain(frame: RadarFrame, gain_db: float) -> RadarFrame:
    """Return a frame as a radar without gain would give it, with its limits scaled, too."""
    if gain_db == 0.0:
        return frame
    scale = np.float32(10.0 ** (-gain_db / 20.0))
    limits = frame.limits
    if limits is not None:  # as float32, for samples at a limit are compared with it exactly
        low, high = (float(np.float32(limit) * scale) for limit in limits)
        limits = (low, high)
    return replace(frame, samples=frame.samples * scale, limits=limits)


def recorded_frame(
    radar: int,
    info: RadarInfo,
    samples: NDArray[np.float32],
    *,
    t_ns: int,
    counter: int,
    limits: tuple[float, float] | None = None,
    stream: int = 0,
) -> RadarFrame:
    """Return a frame for SLAM, of true metres, of a radar as it is described in a file.

    ValueError if the radar was set to another number of samples.
    """
    if len(samples) != info.n_bins:
        raise ValueError(f"{len(samples)} samples, but the radar was set to {info.n_bins}")
    return RadarFrame(
        radar=radar,
        t_ns=t_ns,
        counter=counter,
        samples=samples,
        range_start_m=info.range_start_m * TRUE_PER_MODULE_METRE,
        bin_length_m=info.bin_length_m * TRUE_PER_MODULE_METRE,
        limits=limits,
        stream=stream,
    )


def whole_periods(start_skew_ns: int, rate_hz: float) -> int:
    """Return how many whole frame periods a radar started late.

    >>> whole_periods(190_000_000, 5.0), whole_periods(200_000_000, 5.0)
    (0, 1)
    """
    nearly = int(start_skew_ns * rate_hz / NS_PER_S)  # rounded, so it may be one off
    fitting = (n for n in (nearly + 1, nearly) if frame_time_ns(n, rate_hz) <= start_skew_ns)
    return next(fitting, nearly - 1)


class CounterTime:
    """Time base `counter`: the ticks and the stamps of one radar's frames, by their counters.

    The counter is the only clock here: what the module's own clock is off by (tens of ppm, tens
    of milliseconds after a quarter of an hour) does not show in it. In another stream, or where it
    begins anew, somebody else must know where in time that stream lies.

    Attributes
    ----------
    last_counter
        Of the newest frame; 0 before the first.
    expected
        The tick of the frame after it.
    """

    def __init__(self, info: RadarInfo, begins: StreamBegins | None) -> None:
        self._info = info
        self._begins = begins
        self._late = whole_periods(info.start_skew_ns, info.rate_hz)
        self._first_index = 0  # frame periods of scene time before counter 1
        self._stream: int | None = None
        self.last_counter = 0
        self.expected = self._late

    def take(self, frame: Frame) -> tuple[int, int]:
        """Return the tick and the session time [ns] of the next frame that came."""
        is_same = self._stream in (None, frame.stream) and frame.counter > self.last_counter
        if not is_same and self._begins is not None:
            begin_ns = self._begins(self._info.name)
            self._first_index = round(begin_ns * self._info.rate_hz / NS_PER_S)
        self._stream, self.last_counter = frame.stream, frame.counter
        index = self._first_index + frame.counter - FIRST_COUNTER
        self.expected = index + self._late + 1
        return index + self._late, self._info.start_skew_ns + frame_time_ns(
            index, self._info.rate_hz
        )


class RigSource:
    """All radars of a robot as one stream of scans, in the order of time.

    `radars` is what the modules answered, after `start`; `lost_frames` counts the frames missing
    between those that arrived, over all radars. With `begins`, a radar that restarts during a run
    is set up anew, and its frames are stamped by where its new stream begins; without, its silence
    ends the run.
    """

    def __init__(self, links: Sequence[RadarLink], begins: StreamBegins | None = None) -> None:
        self._links = self._open_links = tuple(links)
        self._begins = begins
        self.radars: tuple[RadarInfo, ...] = ()
        self._limits: tuple[float, float] | None = None
        self.lost_frames = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the radars and close every driver; doing so again does nothing."""
        open_links, self._open_links = self._open_links, ()
        for link in open_links:
            link.driver.close()

    def listen(self, listener: Callable[[str, Literal["rx", "tx"], bytes, int], None]) -> None:
        """Hand on the bytes of every port: radar, way, bytes, time of the driver's clock [ns]."""
        for link in self._links:
            link.driver.raw_listeners.add(partial(listener, link.mount.name))

    def start(self, config: RawConfig, fps: int) -> None:
        """Configure raw RF on every radar and start all streams; AppError names the radar."""
        geometries, radars = [], []
        for link in self._links:
            with link.naming():
                geometries.append(link.driver.configure_raw(config))
        for link, geometry in zip(self._links, geometries, strict=True):
            with link.naming():
                rate_hz = link.driver.start(fps)
            radars.append(
                RadarInfo(
                    **{each.name: getattr(link.mount, each.name) for each in fields(link.mount)},
                    serial=link.serial,
                    port=link.port,
                    range_start_m=geometry.range_start_m,
                    bin_length_m=geometry.bin_length_m,
                    n_bins=geometry.n_bins,
                    rate_hz=rate_hz,
                    settings=asdict(config),
                    start_skew_ns=link.start_skew_ns,
                    gain_db=link.gain_db,
                )
            )
        self.radars = tuple(radars)
        self._limits = sampler_limits(config)

    def scans(self, end_tick: int, stop: StopFlag) -> Generator[Scan]:
        """Yield the frames of ticks below `end_tick`, one scan per tick; see `Scan`.

        Raises RadarSilentError if a radar sends no frame for 5 s, or its port is gone.
        """
        times = [CounterTime(info, self._begins) for info in self.radars]
        heads: list[tuple[int, RadarFrame] | None] = [None] * len(self._links)
        while True:
            stop.check()
            for radar, head in enumerate(heads):
                if head is None:
                    time_base = times[radar]
                    received = self._next_frame(radar, time_base.last_counter, stop)
                    expected = time_base.expected
                    tick, t_ns = time_base.take(received)
                    self.lost_frames += max(min(tick, end_tick) - expected, 0)
                    heads[radar] = tick, radar_frame(radar, received, t_ns, limits=self._limits)
            waiting = [head for head in heads if head is not None]
            tick = min(tick for tick, _ in waiting)
            if tick >= end_tick:
                return
            frames = tuple(frame for one, frame in waiting if one == tick)
            for frame in frames:
                heads[frame.radar] = None
            t_ns = frame_time_ns(tick, self.radars[frames[0].radar].rate_hz)
            yield Scan(counter=tick, t_ns=t_ns, frames=frames)

    def _next_frame(self, radar: int, last_counter: int, stop: StopFlag) -> Frame:
        link = self._links[radar]
        give_up = time.monotonic() + SILENCE_S
        has_restarted = False
        while True:
            try:
                return link.driver.read_frame(timeout_s=_POLL_S)
            except ResponseTimeout:
                stop.check()
                if time.monotonic() <= give_up:
                    continue
                trouble = f"no frame for {SILENCE_S:g} s"
            except Disconnected as error:
                trouble = str(error)
            if has_restarted or not self._restart(link):
                raise RadarSilentError(
                    f"radar {link.mount.name} at {link.port}: {trouble} after frame {last_counter}"
                ) from None
            has_restarted = True
            give_up = time.monotonic() + SILENCE_S

    def _restart(self, link: RadarLink) -> bool:
        """Set up a radar that went silent, if somebody can say when it goes on."""
        if self._begins is None:
            return False
        try:
            self._begins(link.mount.name)
            link.driver.reconnect()
        except (AppError, XeThruError):
            return False
        return True
