"""What the threads of a run put into its inbox, in virtual time: clocks drift, lines delay."""

import heapq
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from queue import Empty

import numpy as np

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.module.memory import Identity
from emulator.ports.sockets import stamp_ns
from emulator.scene.scene import Scene
from emulator.scene.wheels import scene_odometry
from emulator.x4m300 import radar_device
from slam.app.rig.emulated import FRAME_RATE_HZ, RAW_CONFIG, rig_of
from slam.app.run.live_source import LiveLog
from slam.live.frame_sources import RadarLink, RigSource
from slam.live.session_records import RadarInfo
from slam.live.ticks import Inbox, SourceEvent
from xethru_protocol.driver.radar import X4M300

NS_PER_S = 1_000_000_000
SEED = 3
JITTER_MS = 16.0


@dataclass(frozen=True)
class Timed:
    """An event and when it comes, virtual host time."""

    t_ns: int
    event: SourceEvent


@dataclass(frozen=True)
class Drive:
    """A scene as four radars and wheels told it."""

    scene: Scene
    infos: tuple[RadarInfo, ...]
    events: list[Timed]

    def arrivals_ns(self) -> dict[tuple[int, int], int]:
        """When each frame came, virtual host time, by radar and counter."""
        events = (row.event for row in self.events)
        return {(e[1], e[2].counter): e[2].arrival_ns for e in events if e[0] == "frame"}


def drive_through(scene: Scene) -> Drive:
    end_s = scene.trajectory().duration_ns / NS_PER_S
    infos, events = radar_events(scene, SEED, end_s, delays(1, JITTER_MS))
    return Drive(scene, infos, events + odometry_events(scene, SEED, delays(2, JITTER_MS)))


class VirtualInbox(Inbox):
    """An inbox whose events come when virtual time reaches them; waiting takes none."""

    def __init__(self, events: list[Timed]) -> None:
        super().__init__()
        self._heap = [(row.t_ns, number, row.event) for number, row in enumerate(events)]
        heapq.heapify(self._heap)
        self.now_ns = 0
        self.n_frames = 0  # that were taken out

    def clock_ns(self) -> int:
        return self.now_ns

    def get_nowait(self) -> SourceEvent:
        if not self._heap or self._heap[0][0] > self.now_ns:
            raise Empty
        event = heapq.heappop(self._heap)[2]
        self.n_frames += event[0] == "frame"
        return event

    def get(self, block: bool = True, timeout: float | None = None) -> SourceEvent:
        assert timeout is not None
        end_ns = self.now_ns + round(timeout * NS_PER_S)
        if not self._heap or self._heap[0][0] > end_ns:
            self.now_ns = end_ns
            raise Empty
        self.now_ns = max(self.now_ns, self._heap[0][0])
        return self.get_nowait()


class Words(LiveLog):
    def __init__(self) -> None:
        super().__init__()
        self.said: list[tuple[str, str]] = []

    def log(self, subject: str, text: str, *, warning: bool) -> None:
        self.said.append((subject, text))

    def about(self, who: str) -> str:
        return " | ".join(text for name, text in self.said if name == who)


def drifting(scene: Scene, ppm: tuple[float, ...], skew_ms: tuple[float, ...]) -> Scene:
    radars = [
        radar.model_copy(update={"clock_ppm": each, "start_skew_ms": skew})
        for radar, each, skew in zip(scene.radars, ppm, skew_ms, strict=True)
    ]
    return scene.model_copy(update={"radars": tuple(radars)})


def radar_events(
    scene: Scene, seed: int, end_s: float, delay_ns: Callable[[], int]
) -> tuple[tuple[RadarInfo, ...], list[Timed]]:
    """Let every radar of a scene stream in its own virtual time until `end_s`, frames delayed."""
    links, lines = [], []
    for index, (radar, mount) in enumerate(zip(scene.radars, rig_of(scene).mounts, strict=True)):
        source = echo_source(scene, index, seed)
        identity = Identity(serial=radar.serial)
        device = radar_device(identity, source, Pace.REALTIME, clock=radar.clock)
        line = LoopbackTransport(device)
        driver = X4M300(line, clock=line.clock_ns)
        links.append(RadarLink(mount=mount, port=line.name, serial=radar.serial, driver=driver))
        lines.append(line)
    events = []
    with RigSource(links) as rig:
        rig.start(RAW_CONFIG, FRAME_RATE_HZ)
        for radar_index, link in enumerate(links):
            last_ns = 0
            for frame in link.driver.frames(timeout_s=5.0):
                if frame.arrival_ns > end_s * NS_PER_S:
                    break
                # a line keeps the order of what it delays
                last_ns = max(frame.arrival_ns + delay_ns(), last_ns + 1)
                late = replace(frame, arrival_ns=last_ns)
                events.append(Timed(last_ns, ("frame", radar_index, late)))
    return rig.radars, events


def odometry_events(scene: Scene, seed: int, delay_ns: Callable[[], int]) -> list[Timed]:
    """Return the lines of a scene's odometry, each a while after its stamp; then the end."""
    events, last_ns = [], 0
    for text in scene_odometry(scene, seed):
        last_ns = max(stamp_ns(text) + delay_ns(), last_ns + 1)
        events.append(Timed(last_ns, ("odometry line", text, last_ns)))
    return [*events, Timed(last_ns, ("odometry end", ""))]


def delays(seed: int, most_ms: float) -> Callable[[], int]:
    """Return delays like those of USB: anything up to `most_ms`, now and then five times more."""
    generator = np.random.default_rng(seed)

    def draw() -> int:
        factor = 5.0 if generator.random() < 0.02 else 1.0
        return math.floor(generator.uniform(0.0, most_ms * factor * 1e6))

    return draw


def straight_odometry(duration_s: float, rate_hz: float = 20.0) -> Iterator[tuple[int, str]]:
    """Yield (stamp [ns], TUM line) of a robot that drives 5 cm/s along x."""
    for number in range(int(duration_s * rate_hz) + 1):
        t_s = number / rate_hz
        yield round(t_s * NS_PER_S), f"{t_s:.9f} {0.05 * t_s!r} 0.0 0 0 0 0.0 1.0"
