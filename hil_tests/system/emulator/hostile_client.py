"""A hostile client beside a well-behaved one, in virtual time.

Two bare modules are served in one loop. One has a host that does everything a host must not, the
other one that reads its frames. Everything follows from the seed.
"""

import gc
import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.module.memory import Identity
from emulator.ports.event_loop import Port, Server
from emulator.scene.scene import empty_room
from emulator.x4m300 import Device, radar_device
from hil_tests.golden.vectors import load, load_hand_made
from hil_tests.unit.emulator.doubles import PairLine
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, SensorMode, X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NeedData, encode_normal
from xethru_protocol.wire.x4 import real_frame_rate

NS_PER_S = 1_000_000_000
STEP_NS = 10_000_000
FPS = 17.0
WARM_UP = 0.25
"""Share of the time after which memory must not grow any more: by then every queue was full."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    actions: dict[str, int]  # what the hostile host did, by name
    sent_bytes: int  # by the hostile host
    faults_seen: int  # damaged packets that its module noticed
    answers: bool  # its module answered a PING after a reset at the end
    counters: list[int]  # of the frames that the well-behaved host got
    frames_due: int
    objects_grown: int  # Python's container objects after the warm-up


class HostileHost:
    """Acts at random moments; what the line does not take is thrown away, half a command or not."""

    def __init__(self, line: PairLine, device: Device, seed: int) -> None:
        self._line = line
        self._device = device
        self._random = random.Random(seed)
        self._commands = [v.wire for v in (*load(), *load_hand_made()) if v.from_host]
        self._payloads = [v.payload for v in (*load(), *load_hand_made()) if v.from_host]
        self._deaf_until_ns = 0
        self._next_ns = 0
        self.actions: Counter[str] = Counter()
        self.sent_bytes = self._now_ns = 0
        self._does: tuple[Callable[[], None], ...] = (
            self._random_bytes,
            self._half_command,
            *(3 * (self._command,)),
            *(3 * (self._damaged_payload,)),
            self._start_streaming,
            self._huge_length,
            self._stop_reading,
            self._open_and_close,
            self._burst,
            self._cut_power,
        )

    def step(self, now_ns: int) -> None:
        self._now_ns = now_ns
        if now_ns >= self._deaf_until_ns:
            self._line.host_read()
        if now_ns >= self._next_ns:
            act = self._random.choice(self._does)
            self.actions[act.__name__.lstrip("_")] += 1
            act()
            self._next_ns = now_ns + round(self._random.expovariate(10.0) * NS_PER_S)

    def _send(self, data: bytes) -> None:
        self.sent_bytes += self._line.host_write(data)

    def _random_bytes(self) -> None:
        self._send(self._random.randbytes(self._random.randrange(1, 5000)))

    def _command(self) -> None:
        self._send(self._random.choice(self._commands))

    def _half_command(self) -> None:
        whole = self._random.choice(self._commands)
        self._send(whole[: self._random.randrange(len(whole))])

    def _damaged_payload(self) -> None:
        """Send a command with wrong arguments under a right checksum."""
        payload = bytearray(self._random.choice(self._payloads) or b"\x01")
        for _ in range(self._random.randrange(1, 4)):
            payload[self._random.randrange(len(payload))] = self._random.choice(
                (0, 1, 0x7F, 0x80, 0xFF, self._random.randrange(256))
            )
        if self._random.random() < 0.2:
            payload = payload[: self._random.randrange(1, len(payload) + 1)]
        self._send(encode_normal(bytes(payload)))

    def _start_streaming(self) -> None:
        line = Connection(Role.HOST)
        fps = self._random.choice((1.0, 17.0, 400.0, 1e6))
        self._send(
            line.send(m.SetMode(mode=SensorMode.XTID_SM_MANUAL))
            + line.send(m.X4DriverSet(setting=X4Setting.FPS, value=fps))
        )

    def _huge_length(self) -> None:
        length = self._random.choice((0xFFFFFFFF, 1 << 31, 1 << 20, 65536))
        self._send(b"\x7c" * 4 + length.to_bytes(4, "little") + b"\x00" + b"\x01" * 100)

    def _stop_reading(self) -> None:
        self._deaf_until_ns = self._now_ns + round(self._random.expovariate(1 / 5.0) * NS_PER_S)

    def _open_and_close(self) -> None:
        for _ in range(self._random.randrange(1, 20)):
            self._device.port_closed(self._now_ns)
            self._device.port_opened(self._now_ns)

    def _cut_power(self) -> None:
        """Wake a module that was sent to sleep or into its bootloader."""
        self._device.module.power_cycle(self._now_ns)

    def _burst(self) -> None:
        self._send(b"".join(self._random.choices(self._commands, k=50)))


class GoodHost:
    def __init__(self, line: PairLine) -> None:
        self._line = line
        self._connection = Connection(Role.HOST)
        self.counters: list[int] = []
        for command in (
            m.SetMode(mode=SensorMode.XTID_SM_MANUAL),
            m.X4DriverInit(),
            m.X4DriverSet(setting=X4Setting.FPS, value=FPS),
        ):
            line.host_write(self._connection.send(command))

    def step(self) -> None:
        while data := self._line.host_read():
            self._connection.receive_data(data)
            while not isinstance(event := self._connection.next_event(), NeedData):
                if isinstance(event, m.DataFloat):
                    self.counters.append(event.info)
                elif not isinstance(event, m.Ack | m.System):
                    raise AssertionError(f"a quiet module said {event}")


class World:
    def __init__(self, paces: tuple[Pace, Pace], seed: int) -> None:
        scene = empty_room(2)
        self.now_ns = 0
        self.lines = [PairLine(), PairLine()]
        self.devices = [
            radar_device(Identity(serial=radar.serial), echo_source(scene, index, seed), pace)
            for index, (radar, pace) in enumerate(zip(scene.radars, paces, strict=True))
        ]
        ports = [Port(line, device) for line, device in zip(self.lines, self.devices, strict=True)]
        self._server = Server(ports, clock_ns=lambda: self.now_ns)
        self._server.turn(longest_wait_s=0)

    def step(self) -> None:
        self.now_ns += STEP_NS
        self._server.turn(longest_wait_s=0)

    def close(self) -> None:
        self._server.close()
        for line in self.lines:
            line.close()

    def answers(self) -> bool:
        """Whether the first module, after its power was cut, answers a PING.

        What it was sent before is still in the line: half a packet of any claimed length may lie
        before the first command, and takes as many bytes to get through.
        """
        self.devices[0].module.power_cycle(self.now_ns)
        line, heard = Connection(Role.HOST), 0
        for _ in range(3000):
            self.lines[0].host_write(line.send(m.Ping()))
            self.step()
            while data := self.lines[0].host_read():
                line.receive_data(data)
                while not isinstance(event := line.next_event(), NeedData):
                    heard += event == m.Pong(value=PongCode.XTS_SPRP_READY)
            if heard >= 3:
                return True
        return False


def run(minutes: float, seed: int, pace: Pace) -> Outcome:
    """Let the two hosts live beside each other; raises whatever the emulator raises.

    The well-behaved host's module is always in real time, by the virtual clock.
    """
    world = World((pace, Pace.REALTIME), seed)
    try:
        hostile = HostileHost(world.lines[0], world.devices[0], seed)
        good = GoodHost(world.lines[1])
        steps = round(minutes * 60 * NS_PER_S / STEP_NS)
        warm = live_objects()
        for step in range(steps):
            hostile.step(world.now_ns)
            world.step()
            good.step()
            if step == int(WARM_UP * steps):
                warm = live_objects()
        grown = live_objects() - warm
        answers = world.answers()
    finally:
        world.close()
    return Outcome(
        actions=hostile.actions,
        sent_bytes=hostile.sent_bytes,
        faults_seen=world.devices[0].faults_seen,
        answers=answers,
        counters=good.counters,
        frames_due=int(steps * STEP_NS * real_frame_rate(FPS) / NS_PER_S),
        objects_grown=grown,
    )


def live_objects() -> int:
    gc.collect()
    return len(gc.get_objects())
