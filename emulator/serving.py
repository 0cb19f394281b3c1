"""What ``serve`` and ``play`` put together: devices, ports, socket, loop; and how they end."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from emulator.chip import Pace
from emulator.device import Device, radar_device
from emulator.echo.echo import echo_source
from emulator.faults.faulty_device import FaultyDevice, wrap
from emulator.faults.kind import InnerDevice
from emulator.faults.plan import FaultPlan, FaultPlanError, TruthLog, load_plan
from emulator.module.memory import Identity, Memory
from emulator.module.settings import DeviceOptions
from emulator.playback import PlayOptions, PlayStream, played_radars
from emulator.ports.control import Control, ControlSocket
from emulator.ports.folders import Announcement, link_folder, socket_path
from emulator.ports.module_ports import DevicePorts, LinkOptions, NamedDevice, open_ports
from emulator.ports.odometry import OdometryFeed
from emulator.ports.proxy import ModuleLine, open_module
from emulator.ports.pty import LinkError, PortWatch
from emulator.ports.server import Server, Service
from emulator.scene.scene import Scene, SceneError, UnknownSceneError, empty_room, load_scene
from emulator.scene.wheels import scene_odometry
from xethru_protocol.recordings import RecordingError
from xethru_protocol.recordings.wire_capture import Way, WireCapture
from xethru_protocol.system import StopFlag


class FaultBench:
    """Wraps radars, writes one truth log, offers one control socket.

    Parameters
    ----------
    plan
        None: no faults until somebody asks for some.
    truth
        File of the truth log, made anew; None: kept in memory only.
    cleanup
        Closes what was opened.
    zero_ns
        Device time from which the scenario counts.

    Raises
    ------
    LinkError
        When the truth log cannot be written.
    """

    def __init__(
        self,
        plan: FaultPlan | None,
        truth: Path | None,
        cleanup: contextlib.ExitStack,
        *,
        zero_ns: int,
    ) -> None:
        self._plan = FaultPlan() if plan is None else plan
        self._zero_ns = zero_ns
        self._cleanup = cleanup
        self.devices: dict[str, FaultyDevice] = {}
        self.truth = TruthLog()
        if truth is not None:
            try:
                # by lines: whoever follows the file sees a fault when it is injected
                stream = cleanup.enter_context(truth.open("w", buffering=1, encoding="utf-8"))
            except OSError as error:
                raise LinkError(f"{truth}: cannot write the truth log: {error.strerror}") from error
            self.truth = TruthLog(stream.write)

    def wrap(self, device: InnerDevice, name: str) -> FaultyDevice:
        faulty = wrap(device, name, self._plan, self.truth, zero_ns=self._zero_ns)
        self.devices[name] = faulty
        return faulty

    def check_names(self) -> None:
        """Raise `FaultPlanError` if the plan names a radar that is not there."""
        for index, spec in enumerate(self._plan.fault):
            for name in spec.radar:
                if name not in self.devices:
                    raise FaultPlanError(
                        f"fault[{index}].radar: no radar is called {name!r}; "
                        f"there are {', '.join(self.devices)}"
                    )

    def control(self, path: Path, players: Mapping[str, PlayStream] | None = None) -> ControlSocket:
        """Open the control socket; `LinkError` if it cannot be had."""
        offered = ControlSocket(path, Control(self.devices, players))
        self._cleanup.callback(offered.close)
        return offered


SOCKET_NAME = "odometry.sock"
CONTROL_NAME = "control.sock"
PROXY_NAME = "proxy"


class CannotServeError(Exception):
    """The emulator could not start; the message is one line with the remedy.

    Attributes
    ----------
    exit_code
        1 when the thing failed, 2 when it was called wrongly.
    """

    def __init__(self, message: str, *, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code = exit_code


def serve(
    scene: str | int,
    seed: int,
    pace: Pace,
    link_dir: Path | None,
    stop: StopFlag,
    *,
    links: LinkOptions,
    faults: Path | str | None = None,
    truth: Path | None = None,
    memory: Callable[[str], Memory] | None = None,
) -> None:
    """Emulate the radars of a scene until a signal asks for the end.

    Parameters
    ----------
    scene
        Name or path of a scene, or the number of modules in an empty room.
    seed
        Of receiver noise and odometry.
    pace
        Which clock drives the modules.
    link_dir
        Where the links appear; a fresh directory if None.
    stop
        Ends it, also before it has begun.
    links
        What leads to the modules.
    faults
        Name or path of a fault scenario; None: no faults until the control socket adds some.
    truth
        File that gets a line for every injected fault; None: none.
    memory
        Returns where the module with a serial number keeps its flash; None: nowhere.

    Raises
    ------
    CannotServeError
        When scene, fault scenario or ports cannot be had.
    """
    with contextlib.ExitStack() as cleanup:
        try:
            bare = isinstance(scene, int)
            loaded = empty_room(scene) if isinstance(scene, int) else load_scene(scene)
            folder = cleanup.enter_context(link_folder(link_dir))
            zero_ns = time.monotonic_ns()
            plan = None if faults is None else load_plan(faults)
            bench = FaultBench(plan, truth, cleanup, zero_ns=zero_ns)
            options = _device_options(links)
            devices = _radar_devices(loaded, seed, pace, zero_ns, options, bench, memory)
            bench.check_names()
            control = bench.control(socket_path(folder, cleanup, CONTROL_NAME))
            feed = None
            if not bare:
                feed = OdometryFeed(
                    socket_path(folder, cleanup, SOCKET_NAME),
                    scene_odometry(loaded, seed),
                    pace,
                    scene_time_zero_ns=zero_ns,
                )
                cleanup.callback(feed.close)
            ports = open_ports(devices, folder, links, cleanup)
        except UnknownSceneError as error:
            raise CannotServeError(str(error), exit_code=2) from error
        except (SceneError, LinkError, FaultPlanError) as error:
            raise CannotServeError(str(error)) from error
        services: list[Service] = [control] if feed is None else [feed, control]
        ready = _ready_line(ports, zero_ns, None if feed is None else feed.path, control.path)
        _run(ports, services, ready, stop, cleanup)


def play(
    recording: Path,
    options: PlayOptions,
    link_dir: Path | None,
    *,
    warn: Callable[[str], None],
    stop: StopFlag,
) -> None:
    """Play a recording, each radar at a port of its own, until a signal asks for the end.

    Parameters
    ----------
    recording
        Anything that `read_recording` takes.
    options
        How it is played.
    link_dir
        Where the links appear; a fresh directory if None.
    warn
        Called with one line about a part of the recording that cannot be read; the rest plays.
    stop
        Ends it, also before it has begun.

    Raises
    ------
    CannotServeError
        When the recording cannot be read or the port not be had.
    """
    with contextlib.ExitStack() as cleanup:
        try:
            radars = played_radars(
                recording,
                options,
                on_fault=lambda fault: warn(f"{fault.file}: {fault.reason}; the rest is played"),
                warn=warn,
            )
            folder = cleanup.enter_context(link_folder(link_dir))
            bench = FaultBench(None, None, cleanup, zero_ns=time.monotonic_ns())
            devices = [
                NamedDevice(
                    name=one.name, serial=one.serial, device=bench.wrap(one.device, one.name)
                )
                for one in radars
            ]
            players = {radar.name: radar.stream for radar in radars}
            control = bench.control(socket_path(folder, cleanup, CONTROL_NAME), players)
            ports = open_ports(devices, folder, LinkOptions(), cleanup)
        except (RecordingError, LinkError) as error:
            raise CannotServeError(str(error)) from error
        watches = [
            PortWatch(
                os.fspath(folder / radar.name),
                opened=radar.device.port_opened,
                closed=radar.device.port_closed,
            )
            for radar in radars
        ]
        for watch in watches:
            cleanup.callback(watch.close)
        ready = _ready_line(ports, time.monotonic_ns(), None, control.path)
        _run(ports, [*watches, control], ready, stop, cleanup)


def proxy(
    port: Path,
    baud: int,
    link_dir: Path | None,
    stop: StopFlag,
    *,
    faults: Path | str | None,
    truth: Path | None,
    wire: Path | None,
) -> None:
    """Put faults on the line of a real module until a signal asks for the end.

    Parameters
    ----------
    port
        Of the module.
    baud
        Of a UART; USB has none.
    link_dir, stop, faults, truth
        As for `serve`.
    wire
        New file for a capture of what passes the module's port; None: none.

    Raises
    ------
    CannotServeError
        When the module's port, the scenario or our own port cannot be had, or the module vanishes.
    """
    lost = False

    def gone() -> None:
        nonlocal lost
        lost = True
        stop.request()

    with contextlib.ExitStack() as cleanup:
        try:
            capture = None
            if wire is not None:
                capture = cleanup.enter_context(WireCapture(wire, {"port": os.fspath(port)}))

            def tap(direction: Way, data: bytes) -> None:
                if capture is not None:
                    capture.write(direction, data, time.time_ns())

            zero_ns = time.monotonic_ns()
            plan = None if faults is None else load_plan(faults)
            bench = FaultBench(plan, truth, cleanup, zero_ns=zero_ns)
            module = ModuleLine(open_module(port, baud), tap, gone)
            cleanup.callback(module.close)
            faulty = bench.wrap(module, PROXY_NAME)
            bench.check_names()
            folder = cleanup.enter_context(link_folder(link_dir))
            control = bench.control(socket_path(folder, cleanup, CONTROL_NAME))
            named = NamedDevice(
                name=PROXY_NAME, serial="", device=faulty, present=faulty.port_present
            )
            ports = open_ports([named], folder, LinkOptions(), cleanup)
        except (RecordingError, LinkError, FaultPlanError) as error:
            raise CannotServeError(str(error)) from error
        ready = _ready_line(ports, zero_ns, None, control.path)
        _run(ports, [module, control], ready, stop, cleanup)
    if lost:
        raise CannotServeError(f"{port}: the module's port vanished")


def _device_options(links: LinkOptions) -> DeviceOptions:
    stays = links.port_on_reset == "stay"
    return DeviceOptions(port_on_reset="stay" if stays else "vanish")


def _radar_devices(  # noqa: PLR0917 - what makes a radar
    scene: Scene,
    seed: int,
    pace: Pace,
    zero_ns: int,
    options: DeviceOptions,
    bench: FaultBench,
    memory: Callable[[str], Memory] | None,
) -> list[NamedDevice]:
    made = []
    for index, radar in enumerate(scene.radars):
        device = radar_device(
            Identity(serial=radar.serial),
            echo_source(scene, index, seed),
            pace,
            scene_time_zero_ns=zero_ns,
            clock=radar.clock,
            options=options,
            memory=None if memory is None else memory(radar.serial),
        )
        faulty = bench.wrap(device, radar.name)
        made.append(
            NamedDevice(
                name=radar.name,
                serial=radar.serial,
                device=faulty,
                start_skew_ns=radar.clock.skew_ns,
                present=faulty.port_present,
                uart_baud=partial(_uart_baud, device),
            )
        )
    return made


def _uart_baud(device: Device) -> int:
    return device.module.uart_baudrate


def _ready_line(
    ports: DevicePorts, zero_ns: int, odometry: Path | None, control: Path | None = None
) -> dict[str, object]:
    return {
        "ready": True,
        "scene_time_zero_ns": zero_ns,
        "odometry": None if odometry is None else os.fspath(odometry),
        "control": None if control is None else os.fspath(control),
        "devices": ports.entries(),
    }


def _run(
    ports: DevicePorts,
    services: Sequence[Service],
    ready: dict[str, object],
    stop: StopFlag,
    cleanup: contextlib.ExitStack,
) -> None:
    if stop.requested:
        return  # nobody shall learn of ports that go away at once
    server = Server(ports.ports, [*services, *ports.services])
    cleanup.callback(server.close)
    stop.attach(server.stop)
    cleanup.callback(stop.detach)  # a second signal must not reach a loop that is being closed
    announcement = Announcement(ready)
    cleanup.callback(announcement.close)
    ports.moved = lambda: announcement.update({**ready, "devices": ports.entries()})
    _say_ready(ready)
    server.run()


def _say_ready(ready: dict[str, object]) -> None:
    if sys.stdout is None:  # started with stdout closed: serve without a word
        return
    try:
        sys.stdout.write(json.dumps(ready, separators=(",", ":")) + "\n")
        sys.stdout.flush()
    except OSError as error:
        # nobody will ever learn our ports; and the interpreter must not try to flush again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise CannotServeError(f"stdout: cannot write the ready line: {error.strerror}") from error
