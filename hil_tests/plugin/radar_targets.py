"""Radar targets: each opens lines to one radar under test and lists what that radar can do.

A `WireTap` keeps what passes over these lines.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hil_tests.device.emulator_process import Served, emulator
from hil_tests.paths import FIXTURES
from hil_tests.plugin.power import PowerCommand, PowerError
from hil_tests.plugin.radar_specs import RadarArgument, RadarKind
from xethru_protocol.driver.radar import X4M300, known_ports
from xethru_protocol.recordings.wire_capture import Way
from xethru_protocol.transport import Transport, capacity_bytes_per_s, find_ports, open_line
from xethru_protocol.wire.codes import POWER_UP_BAUD
from xethru_protocol.wire.errors import XeThruError

if TYPE_CHECKING:
    from emulator.scene.scene import Scene

MOST_BYTES = 32 << 20  # of one test, some five minutes of frames; then the oldest go


@dataclass(frozen=True, slots=True)
class WireBytes:
    """Bytes from the module (``rx``) or the host (``tx``), and the driver's clock [ns].

    Packets may begin and end anywhere in them.
    """

    way: Way
    data: bytes
    t_ns: int


class WireTap:
    """What passed over the lines to one radar, oldest first.

    ``started_unix_ns`` and ``started_ns`` are wall clock and driver's clock at one moment.
    ``forgotten_bytes`` counts what was dropped from the beginning.
    """

    def __init__(self, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.clock_ns = clock_ns
        self.started_unix_ns = time.time_ns()
        self.started_ns = clock_ns()
        self.forgotten_bytes = 0
        self._kept: deque[WireBytes] = deque()
        self._bytes = 0

    @property
    def passed(self) -> tuple[WireBytes, ...]:
        return tuple(self._kept)

    def note(self, way: Way, data: bytes) -> None:
        self._kept.append(WireBytes(way, data, self.clock_ns()))
        self._bytes += len(data)
        while self._bytes > MOST_BYTES:
            size = len(self._kept.popleft().data)
            self._bytes -= size
            self.forgotten_bytes += size

    def around(self, transport: Transport) -> TappedTransport:
        return TappedTransport(transport, self)


class TappedTransport:
    """A line that notes what passes; every other attribute is the line's own."""

    def __init__(self, line: Transport, tap: WireTap) -> None:
        self._line, self._tap = line, tap

    @property
    def name(self) -> str:
        return self._line.name

    def read(self, timeout_s: float) -> bytes:
        data = self._line.read(timeout_s)
        if data:
            self._tap.note("rx", data)
        return data

    def write(self, data: bytes) -> None:
        self._tap.note("tx", bytes(data))
        self._line.write(data)

    def close(self) -> None:
        self._line.close()

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - capacity and baud rate, where a line has them
        return getattr(self._line, name)


CAPABILITIES: Mapping[str, str] = {
    "settings": "a recording that is played takes none",
    "profiles": "bare XEP firmware has none",
    "presence": "an X4M300 has this profile; X4M200 and X4M210 have respiration",
    "files": "a file system that answers",
    "unplug": "only emulated ones can be unplugged by a program",
    "power": "--hil-power-cmd CMD switches the power of a real one",
    "faults": "only emulated radars have faults",
    "known_range": "nothing of known range is in view; --radar emu:lab, or /dev/...?known_range=M",
    "uart": "USB, tcp:// and pseudo-terminals have no baud rate",
    "virtual_time": "waiting must cost nothing",
}
"""What a test may require of a radar, and why one may lack it; ``?has=`` adds others."""

_UART_BYTES_PER_S = POWER_UP_BAUD / 10
_EMPTY_ROOM_RADARS = 4
_SEEN_COSINE, _CLEAR_COSINE = 0.42, 0.57  # 65 deg off boresight, 55 deg
_NEAR_M, _FAR_M = 0.4, 2.0
_ALONE_M = 0.2  # two echoes overlap below; an envelope's standard deviation is 5 cm


class TargetError(Exception):
    """A radar that is not available; the message is one line with the remedy."""


@dataclass(frozen=True, slots=True)
class InjectedFault:
    """One fault that a test has armed at an emulated radar.

    `injected` returns how often it took effect so far; `clear` ends it.
    """

    radar: str
    kind: str
    keys: Mapping[str, Any]
    injected: Callable[[], int]
    clear: Callable[[], object]

    def __str__(self) -> str:
        return " ".join([self.kind, *(f"{key}={value}" for key, value in self.keys.items())])


class RadarTarget(ABC):
    """How one radar under test is reached, and its capabilities.

    The base of radars of your own, too: a subclass has `open_line`, and what else it can do.
    ``capabilities`` names what tests may require, ``description`` is shown in the summary,
    ``serial_number`` is what the module reported, empty before. ``bytes_per_s`` is the
    capacity of the line, infinite but on a UART; ``scene_text`` the scene file of an emulated
    radar; ``lock_target`` the name to lock against other sessions (None: no other process can
    reach the radar).
    """

    scene_text: str | None = None
    lock_target: str | None = None

    def __init__(self, spec: RadarArgument, capabilities: frozenset[str], description: str) -> None:
        self.spec = spec
        self.capabilities = capabilities | spec.has
        self.description = description
        self.bytes_per_s = math.inf
        self.serial_number = ""
        self.clock_ns: Callable[[], int] = time.monotonic_ns
        self.sleep: Callable[[float], None] = time.sleep

    @property
    def virtual(self) -> bool:
        """Whether time passes only while a driver waits for the module."""
        return "virtual_time" in self.capabilities

    def known_ranges_m(self, t_ns: int) -> Sequence[float]:
        """Return true ranges of reflectors that stand alone, at a time of `clock_ns` [m].

        Empty where none is in view; `known_range` is the capability.
        """
        return () if self.spec.known_range_m is None else (self.spec.known_range_m,)

    def explore(self) -> None:  # noqa: B027 - most targets know it without asking
        """Complete the capabilities; called once, after locking."""

    def begin_test(self) -> None:  # noqa: B027 - an optional hook
        """Prepare the radar; called before each test."""

    @abstractmethod
    def open_line(self, path: str | None = None, baudrate: int = POWER_UP_BAUD) -> Transport:
        """Return an open line; ``path`` is where a driver looks for a module that vanished."""

    def candidates(self) -> Sequence[str]:
        """Where a module that vanished may come back."""
        return ()

    def driver(self, line: Transport, tap: WireTap, *, reconnect_s: float = 0.0) -> X4M300:
        """Return a driver on an open line, with the target's clock; new lines are tapped."""
        return X4M300(
            line,
            clock=self.clock_ns,
            reconnect_s=reconnect_s,
            open_port=lambda path, baudrate: tap.around(self.open_line(path, baudrate)),
            candidates=self.candidates,
            sleep=self.sleep,
        )

    def unplug(self, seconds: float) -> None:
        """Take the port away and bring it back after ``seconds``; the module restarts."""
        raise TargetError(f"{self.spec.name} cannot be unplugged by a program")

    def cut_power(self, seconds: float) -> None:
        """Take the power away for ``seconds``; return when it is back, or will come by itself."""
        raise TargetError(
            f"{self.spec.name} has no power to switch; --hil-power-cmd names the command"
        )

    def inject(self, kind: str, keys: Mapping[str, Any]) -> InjectedFault:
        """Arm a fault; keys as of `emulator.faults.plan.fault_spec`."""
        raise TargetError(f"{self.spec.name} takes no faults: it is not emulated")

    def close(self) -> None:  # noqa: B027 - an optional hook
        """Release processes and ports."""


class InProcessTarget(RadarTarget):
    """A module in this process, in virtual time; a fresh one for every test."""

    def __init__(self, spec: RadarArgument) -> None:
        self._scene, self.scene_text = _scene(spec), _scene_text(spec)
        able = frozenset(CAPABILITIES) - {"uart", "known_range"}
        super().__init__(
            spec,
            able | ({"known_range"} if _is_open_space(self._scene) else set()),
            f"emulated in this process, virtual time, {spec.target or 'an empty room'}",
        )
        self._index = _index_of(spec, [radar.name for radar in self._scene.radars])
        self.begin_test()

    def begin_test(self) -> None:
        """Make a new module, so that no test sees what an earlier one left."""
        from emulator.chip import Pace
        from emulator.echo.echo import echo_source
        from emulator.module.memory import Identity
        from emulator.module.settings import STOCK_MODEL, DeviceOptions
        from emulator.x4m300 import radar_device
        from hil_tests.faulty import FaultyLine

        radar = self._scene.radars[self._index]
        options = DeviceOptions(model=radar.model or STOCK_MODEL, firmware=self.spec.firmware)
        device = radar_device(
            Identity(serial=radar.serial, order_code=options.product.order_code),
            echo_source(self._scene, self._index, self.spec.seed),
            Pace.REALTIME,
            clock=radar.clock,
            options=options,
        )
        self._line = FaultyLine(device)
        self.clock_ns = self._line.clock_ns
        self.sleep = self._line.sleep

    def open_line(self, path: str | None = None, baudrate: int = POWER_UP_BAUD) -> Transport:
        from hil_tests.faulty import PATH

        return self._line.open(path or PATH, baudrate)

    def candidates(self) -> Sequence[str]:
        return self._line.ports()

    def known_ranges_m(self, t_ns: int) -> Sequence[float]:
        return _ranges_in_view(self._scene, self._index, t_ns)

    def unplug(self, seconds: float) -> None:
        self._line.device.unplug(self._line.clock_ns(), round(seconds * 1e9))

    cut_power = unplug  # it has its power from the port

    def inject(self, kind: str, keys: Mapping[str, Any]) -> InjectedFault:
        from emulator.faults.plan import FaultPlanError, fault_spec

        device = self._line.device
        try:
            number = device.add(fault_spec(kind, **keys))
        except FaultPlanError as error:
            raise TargetError(str(error)) from None
        armed = device.armed[-1]
        return InjectedFault(
            self.spec.name, kind, keys, lambda: armed.injected, lambda: device.clear(number)
        )


class ProcessTarget(RadarTarget):
    """A module of an emulator that runs in a process of its own, or a recording played there."""

    def __init__(self, spec: RadarArgument) -> None:
        played = spec.kind is RadarKind.REPLAY
        able = {"settings", "profiles", "presence", "files", "unplug", "power", "faults"}
        if spec.line == "uart":
            able.add("uart")
        self._scene = None if played else _scene(spec)
        if self._scene is not None and _is_open_space(self._scene):
            able.add("known_range")
        super().__init__(
            spec,
            frozenset() if played else frozenset(able),
            f"recording {spec.target}, played at a pseudo-terminal"
            if played
            else f"emulated in its own process, {spec.line}, {spec.target or 'an empty room'}",
        )
        if spec.line == "uart":
            self.bytes_per_s = _UART_BYTES_PER_S
        self._cleanup = contextlib.ExitStack()
        arguments = ["play", spec.target] if played else _serve_arguments(spec)
        try:
            self._served: Served = self._cleanup.enter_context(emulator(*arguments))
            self._index = _index_of(spec, self._served.names)
            self.scene_text = None if played else _scene_text(spec)
        except RuntimeError as error:
            raise TargetError(f"--radar {spec.text}: {error}") from None
        except TargetError:
            self._cleanup.close()
            raise

    def open_line(self, path: str | None = None, baudrate: int = POWER_UP_BAUD) -> Transport:
        if self.spec.line == "tcp":
            return open_line(f"tcp://127.0.0.1:{self._served.tcp_ports[self._index]}")
        return open_line(path or self._served.paths[self._index], baudrate)

    def known_ranges_m(self, t_ns: int) -> Sequence[float]:
        if self._scene is None:
            return ()
        scene_ns = t_ns - self._served.scene_time_zero_ns
        return _ranges_in_view(self._scene, self._index, scene_ns)

    def unplug(self, seconds: float) -> None:
        self._ask("unplug", seconds=seconds)

    cut_power = unplug

    def inject(self, kind: str, keys: Mapping[str, Any]) -> InjectedFault:
        from emulator.faults.plan import FaultPlanError, fault_spec

        try:
            fault = fault_spec(kind, **keys)
        except FaultPlanError as error:
            raise TargetError(str(error)) from None
        name = self._served.names[self._index]
        number = self._ask("fault add", fault=fault.model_dump())["ids"][name]

        cleared: list[int] = []

        def injected() -> int:
            if cleared:
                return cleared[0]
            for armed in self._ask("fault list")["faults"][name]:
                if armed["id"] == number:
                    return int(armed["injected"])
            return fault.count  # no longer armed: as often as was asked for

        def clear() -> None:
            cleared.append(injected())
            with contextlib.suppress(TargetError):  # it is over
                self._ask("fault clear", id=number)

        return InjectedFault(self.spec.name, kind, keys, injected, clear)

    def _ask(self, verb: str, **keys: Any) -> dict[str, Any]:  # noqa: ANN401 - JSON
        from emulator.cli import ask

        assert self._served.control is not None
        request = {"verb": verb, "radar": self._served.names[self._index], **keys}
        answer: dict[str, Any] = json.loads(ask(Path(self._served.control), request))
        if not answer["ok"]:
            raise TargetError(str(answer["error"]))
        return answer

    def close(self) -> None:
        self._served.end()
        self._cleanup.close()


class PortTarget(RadarTarget):
    """A module at a port, named or found by its serial number; perhaps a port of the network."""

    def __init__(self, spec: RadarArgument, power: PowerCommand | None = None) -> None:
        path = _port_of(spec.target) if spec.kind is RadarKind.SERIAL_NUMBER else spec.target
        able = {"settings", "profiles", "presence", "files"} | ({"power"} if power else set())
        able |= set() if spec.known_range_m is None else {"known_range"}
        super().__init__(spec, frozenset(able), f"module at {path}")
        self._path, self._power = path, power
        self._is_here = spec.kind is not RadarKind.NETWORK
        # this keeps sessions of this machine apart
        self.lock_target = os.path.realpath(path) if self._is_here else spec.shared_as

    def explore(self) -> None:
        """Find out whether the port is a UART."""
        line = self.open_line()
        self.bytes_per_s = (
            _UART_BYTES_PER_S if self.spec.line == "uart" else capacity_bytes_per_s(line)
        )
        line.close()
        if not math.isinf(self.bytes_per_s):
            self.capabilities |= {"uart"}

    def open_line(self, path: str | None = None, baudrate: int = POWER_UP_BAUD) -> Transport:
        return open_line(path or self._path, baudrate)

    def candidates(self) -> Sequence[str]:
        return known_ports() if self._is_here else ()

    def cut_power(self, seconds: float) -> None:
        if self._power is None:
            super().cut_power(seconds)
            return
        try:
            self._power.cycle(self._path, self.serial_number, seconds, self.sleep)
        except PowerError as error:
            raise TargetError(f"--hil-power-cmd: {error}") from None


def target_of(spec: RadarArgument, power: PowerCommand | None = None) -> RadarTarget:
    """Return the target of a built-in spec; `TargetError` or `PortUnavailable` if it has none."""
    match spec.kind:
        case RadarKind.EMULATED if spec.line == "memory":
            return InProcessTarget(spec)
        case RadarKind.EMULATED | RadarKind.REPLAY:
            return ProcessTarget(spec)
        case RadarKind.OWN:
            raise TargetError(f"--radar {spec.text}: no hook pytest_xethru_radar_target knows it")
        case _:
            return PortTarget(spec, power)


def ports_that_answer() -> tuple[tuple[str, str], ...]:
    """Return path and serial number of every port where a module answers.

    A port that another program has open is skipped: opening it would take bytes from that program.
    """
    from xethru_protocol.cli.port_probe import port_users

    found = []
    for port in find_ports():
        if port_users(port.path):
            continue
        with contextlib.suppress(XeThruError), X4M300.open(port.path) as radar:
            radar.ping(0.5)
            if (serial := radar.info().serial_number) is not None:
                found.append((port.path, serial))
    return tuple(found)


def _port_of(serial: str) -> str:
    for port in find_ports():
        if port.kind == "emulated" and port.serial == serial:
            return port.path  # its emulator publishes the number
    found = ports_that_answer()
    for path, number in found:
        if number == serial:
            return path
    there = ", ".join(f"{number} at {path}" for path, number in found) or "none"
    raise TargetError(f"no module with serial number {serial} answers; those that do: {there}")


def _index_of(spec: RadarArgument, names: Sequence[str]) -> int:
    wanted = spec.options.get("radar")
    if wanted is None:
        return 0
    if wanted not in names:
        raise TargetError(
            f"--radar {spec.text}: no radar is called {wanted!r}; there are {', '.join(names)}"
        )
    return names.index(wanted)


def scene_radars(spec: RadarArgument) -> tuple[str, ...]:
    """Return the names of the radars of an emulated spec's scene; an empty room has four."""
    return tuple(radar.name for radar in _scene(spec).radars)


def _scene(spec: RadarArgument) -> Scene:
    from emulator.scene.scene import SceneError, empty_room, load_scene

    try:
        return load_scene(spec.target) if spec.target else empty_room(_EMPTY_ROOM_RADARS)
    except SceneError as error:
        raise TargetError(f"--radar {spec.text}: {error}") from None


def _is_open_space(scene: Scene) -> bool:
    """Whether targets send the only echoes, and always the same."""
    others = (*scene.walls, *scene.objects, *scene.people, *scene.movers, *scene.other_modules)
    return bool(scene.targets) and not others


def _ranges_in_view(scene: Scene, index: int, scene_ns: int) -> Sequence[float]:
    """Return the ranges of targets near boresight that no other target's echo overlaps [m]."""
    from emulator.echo.paths import viewpoint

    radar = scene.radars[index]
    view = viewpoint(radar, scene.trajectory().poses(np.array([scene_ns])))
    places = np.array([(target.x_m, target.y_m) for target in scene.targets])
    distance_m, cos_angle = (values[0] for values in view.towards(*places.T))
    ranges_m = distance_m - [target.radius_m for target in scene.targets] + radar.range_offset_m
    seen = ranges_m[cos_angle > _SEEN_COSINE]
    alone = [np.sort(np.abs(seen - range_m))[1:2].sum() for range_m in ranges_m]
    wanted = (cos_angle > _CLEAR_COSINE) & (ranges_m > _NEAR_M) & (ranges_m < _FAR_M)
    return [
        float(range_m)
        for range_m, apart_m, ok in zip(ranges_m, alone, wanted, strict=True)
        if ok and (apart_m > _ALONE_M or len(seen) == 1)
    ]


def _serve_arguments(spec: RadarArgument) -> list[str]:
    scene = [spec.target] if spec.target else ["--bare", "--count", str(_EMPTY_ROOM_RADARS)]
    line = {"uart": ["--link", "uart"], "tcp": ["--tcp", "0"]}.get(spec.line, [])
    return ["serve", *scene, "--seed", str(spec.seed), *line]


def _scene_text(spec: RadarArgument) -> str | None:
    """Return the scene file; None for an empty room and for a random one, which its name makes."""
    from emulator.scene.rooms import room_of

    if not spec.target or room_of(spec.target):
        return None
    path = Path(spec.target)
    if path.suffix != ".toml":
        path = FIXTURES / "scenes" / f"{spec.target}.toml"
    return path.read_text("utf-8")
