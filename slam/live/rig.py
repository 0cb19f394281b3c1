"""The modules of a robot as an iterator of scans."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from queue import Empty
from typing import Literal, Self, TypeAlias, get_args

from slam.geometry import Mount, Rig
from slam.library.rig_files import RigFile, load_rig
from slam.live.arrival_clock import ArrivalClock
from slam.live.errors import RadarSilentError
from slam.live.frame_sources import (
    RadarLink,
    RigSource,
    less_gain,
    radar_frame,
    sampler_limits,
)
from slam.live.modules import open_modules, open_ports
from slam.live.odometry_track import NS_PER_S
from slam.live.session_records import RadarInfo, Scan
from slam.live.ticks import SETTLE_S, Inbox, SourceEvent, TickAssembler, reading
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.matching import ProtocolRecord
from xethru_protocol.operating_system import StopFlag

TimeBase: TypeAlias = Literal["arrival", "counter"]

_POLL_S = 0.05
_MOST_TICKS = 2**62
_LOG = logging.getLogger("slam.live")


class _NoOdometry:
    """In place of odometry, which the loop around a rig has: no scan waits for it."""

    ended = False

    def covers(self, t_ns: int) -> bool:
        return True

    def is_known(self, t_ns: int) -> bool:
        return True


class LiveRig:
    """Modules that stream, one scan after the other; made by `open_rig`.

    Iterating yields a `Scan` for each frame period, once all radars that answer have sent its
    frames, until the block ends. `t_ns` is the time of its newest frame. Frames are in true metres
    and without the gains of the rig file. A radar that falls silent is looked for, and missing in
    scans until it is back; both are logged (``slam.live``). It can be iterated once.

    Attributes
    ----------
    rig
        What `Slam` takes: as it was given, or a mount at the body's origin for each port.
    radars
        What the modules answered: serial number, range axis, frame rate.
    """

    def __init__(
        self,
        links: Sequence[RadarLink],
        rig: Rig | RigFile,
        config: RawConfig,
        fps: int,
        time_base: TimeBase,
    ) -> None:
        self.rig = rig
        self._links = tuple(links)
        self._source = RigSource(links)
        self._limits = sampler_limits(config)
        with ExitStack() as unless_it_works:
            unless_it_works.callback(self._source.close)
            self._source.start(config, fps)
            unless_it_works.pop_all()
        self.radars = self._source.radars
        if time_base == "counter":
            self._scans = self._source.scans(_MOST_TICKS, StopFlag())
        else:
            self._scans = self._arriving()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the radars and close their ports; doing so again does nothing."""
        self._scans.close()
        self._source.close()

    def __iter__(self) -> Iterator[Scan]:
        last_ns = -math.inf
        for scan in self._scans:
            last_ns = max(last_ns, *(frame.t_ns for frame in scan.frames))
            frames = tuple(less_gain(one, self._links[one.radar].gain_db) for one in scan.frames)
            yield replace(scan, t_ns=int(last_ns), frames=frames)

    def _arriving(self) -> Generator[Scan]:
        inbox = Inbox()
        arrivals = _Arrivals(self.radars, self._limits)
        with reading(self._links, inbox):
            while True:
                with suppress(Empty):
                    arrivals.take(inbox.get(timeout=_POLL_S))
                    while True:
                        arrivals.take(inbox.get_nowait())
                while (scan := arrivals.next_scan(time.monotonic_ns())) is not None:
                    if scan.used:
                        yield scan


class _Arrivals:
    """Makes scans of frames by time base `arrival`; it reads no clock."""

    def __init__(self, radars: Sequence[RadarInfo], limits: tuple[float, float] | None) -> None:
        self._radars, self._limits = radars, limits
        self._clocks = [ArrivalClock(radar.rate_hz) for radar in radars]
        period_ns = round(NS_PER_S / radars[0].rate_hz)
        self._ticks = TickAssembler(len(radars), period_ns, _NoOdometry())
        self._heard = set[int]()
        self._ready_ns: int | None = None
        self._warned = 0  # scans that were not used when that was last logged

    def take(self, event: SourceEvent) -> None:
        match event:
            case "frame", radar, frame:
                self._heard.add(radar)
                t_ns = self._clocks[radar].stamp_ns(frame.counter, frame.arrival_ns, frame.stream)
                made = radar_frame(radar, frame, t_ns, limits=self._limits)
                self._ticks.take(made, frame.arrival_ns, frame.arrival_ns)
            case "lost", radar, trouble:
                self._ticks.alive.discard(radar)
                _LOG.warning("radar %s: %s", self._radars[radar].name, trouble)
            case "back", radar, port:
                self._ticks.alive.add(radar)
                _LOG.warning("radar %s is back, at %s", self._radars[radar].name, port)

    def next_scan(self, now_ns: int) -> Scan | None:
        """Return the next scan if it is complete; RadarSilentError if none can be expected."""
        if text := self._ticks.silence(now_ns):
            raise RadarSilentError(text)
        if self._ticks.start_ns is None:
            if self._ready_ns is None and self._ticks.alive <= self._heard:
                self._ready_ns = now_ns
            if self._ready_ns is None or now_ns - self._ready_ns < SETTLE_S * NS_PER_S:
                return None
            self._ticks.begin(now_ns)
        scan = self._ticks.next_scan(now_ns)
        if self._ticks.n_unused >= max(2 * self._warned, 1):
            self._warned = self._ticks.n_unused
            _LOG.warning(
                "%d scans came too late, or waited too long for this program; an emulator that "
                "does not keep time needs time_base='counter'",
                self._warned,
            )
        return scan


def open_rig(
    rig: str | Path | RigFile | Rig | None = None,
    ports: Sequence[str] | None = None,
    *,
    fps: int = 5,
    frame_area_m: tuple[float, float] = (0.2, 9.4),
    time_base: TimeBase = "arrival",
) -> LiveRig:
    """Open the modules of a robot, set them up for raw frames and start them.

    Parameters
    ----------
    rig
        A rig file, or its path: modules are found by their serial numbers. Or the mounts, with the
        port of each in their order; None: any modules, for programs that need no mounts.
    ports
        Where the modules are, ``/dev/ttyACM0`` or ``tcp://HOST:PORT``. None: of a rig file, those
        that it names, else wherever this machine has modules or running emulators.
    fps
        Frames per second of each radar.
    frame_area_m
        First and last range, module metres.
    time_base
        ``"arrival"``: times are this machine's `time.monotonic_ns`, from when frames arrive.
        ``"counter"``: from the frames' counters, the first at 0; for an emulator that does not
        keep time (``--pace asap``).

    Raises
    ------
    ConfigError
        The rig file cannot be used.
    AppError
        A module is missing, not in the rig, found twice, or does not answer; one line with the
        remedy.
    """
    if time_base not in get_args(TimeBase):
        raise ValueError(f"time_base is {time_base!r}; there are {', '.join(get_args(TimeBase))}")
    if isinstance(ports, str):
        raise ValueError(f"ports is a text; give a list, as [{ports!r}]")
    if isinstance(rig, str | Path):
        path, rig = rig, load_rig(rig)
    else:
        path = "the rig"
    if isinstance(rig, RigFile):
        links = open_modules(rig, path, ports, _log_faults, _LOG.info)
    elif not ports:
        raise ValueError("mounts do not say where their modules are; give ports, or a rig file")
    else:
        rig = rig or Rig([Mount(x_m=0.0, y_m=0.0, yaw_rad=0.0) for _ in ports])
        if len(rig.mounts) != len(ports):
            raise ValueError(f"{len(ports)} ports for {len(rig.mounts)} mounts; give one for each")
        links = open_ports(rig, ports, _log_faults)
    return LiveRig(links, rig, RawConfig(frame_area_m=frame_area_m), fps, time_base)


def _log_faults(radar: str, record: ProtocolRecord) -> None:
    if record.direction == "fault":
        _LOG.warning("radar %s: %s", radar, record.summary)
