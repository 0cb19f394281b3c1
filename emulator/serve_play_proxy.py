"""What ``serve`` and ``play`` put together: devices, ports, socket, loop; and how they end."""

from __future__ import annotations

import contextlib
import os
import secrets
import time
from argparse import Namespace
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path

from emulator.echo.echo import echo_source
from emulator.echo.people import people_truth
from emulator.faults.faulty_device import FaultyDevice
from emulator.faults.plan import FaultPlan, FaultPlanError, Injected, load_plan
from emulator.module.memory import Identity
from emulator.module.settings import STOCK_MODEL, DeviceOptions
from emulator.playback import played_radars
from emulator.ports.control import Control, ControlSocket
from emulator.ports.event_loop import Server, Service
from emulator.ports.module_ports import DevicePorts, LinkOptions, NamedDevice
from emulator.ports.proxy import ModuleLine
from emulator.ports.pty import LinkError
from emulator.ports.runtime_folders import (
    DirectoryMemory,
    announcement,
    keep_first_serial,
    kept_first_serial,
    link_folder,
    make_state_directory,
    socket_path,
)
from emulator.ports.sockets import OdometryFeed
from emulator.scene.scene import SceneError, empty_room, load_scene
from emulator.scene.wheels import scene_odometry
from emulator.x4m300 import radar_device
from xethru_protocol.operating_system import STDOUT, StopFlag, json_text, waiting
from xethru_protocol.recordings import RecordingError
from xethru_protocol.recordings.wire_capture import WireCapture
from xethru_protocol.transport import is_loopback, open_line
from xethru_protocol.validation import choices, shown
from xethru_protocol.wire.errors import PortUnavailable

SOCKET_NAME = "odometry.sock"
CONTROL_NAME = "control.sock"
PROXY_NAME = "proxy"
FIRST_BARE, BARE_SERIALS = 100_000_000_000, 100
"""Bare modules have serial numbers from it to twice as much; a process has so many of them."""
Warn = Callable[[str], None]
"""Gets a warning in one line."""
EXPECTED = (SceneError, FaultPlanError, LinkError, RecordingError, PortUnavailable)
"""Raised by `serve`, `play` and `proxy`; the message is one line with the remedy."""


def _fault_plan(scenario: str | None, radars: Collection[str]) -> FaultPlan:
    """Return the faults of a scenario; none without one, until the control socket adds some."""
    plan = FaultPlan() if scenario is None else load_plan(scenario)
    for index, spec in enumerate(plan.fault):
        for name in spec.radar:
            if name not in radars:
                raise FaultPlanError(
                    f"fault[{index}].radar: no radar is called {shown(name)}; "
                    f"{choices(name, radars)}"
                )
    return plan


def _truth_log(path: Path | None, cleanup: contextlib.ExitStack) -> Callable[[Injected], object]:
    """Return what writes a fault to a new file as soon as it is injected; nothing without one."""
    if path is None:
        return lambda injected: None
    try:
        with waiting():
            log = cleanup.enter_context(path.open("w", buffering=1, encoding="utf-8"))
    except OSError as error:
        raise LinkError(f"{path}: cannot write the truth log: {error.strerror}") from error
    return lambda injected: log.write(injected.line())


def serve(options: Namespace, stop: StopFlag, warn: Warn) -> None:
    """Emulate the radars of a scene until a signal asks for the end.

    Parameters
    ----------
    options
        Those of the command, as `emulator.cli` parses them; likewise for `play` and `proxy`.
    """
    links = _link_options(options, warn)
    state_dir: Path | None = options.state_dir
    with contextlib.ExitStack() as cleanup:
        if state_dir is not None:
            make_state_directory(state_dir)
        scene = empty_room(options.count) if options.bare else load_scene(options.scene)
        folder = cleanup.enter_context(link_folder(options.link_dir))
        zero_ns = time.monotonic_ns()
        plan = _fault_plan(options.faults, [radar.name for radar in scene.radars])
        note = _truth_log(options.truth, cleanup)
        stays = links.port_on_reset == "stay"
        asked = {"model": options.model, "firmware": options.firmware}
        changes = {"port_on_reset": "stay" if stays else "vanish"} | dict(options.option)
        changes |= {name: value for name, value in asked.items() if value is not None}
        devices, faulty_devices = [], {}
        serials = _serials(options, [radar.serial for radar in scene.radars])
        for index, (radar, serial) in enumerate(zip(scene.radars, serials, strict=True)):
            of_radar = {"model": radar.model or STOCK_MODEL}
            device_options = DeviceOptions.model_validate(of_radar | changes)
            device = radar_device(
                Identity(serial=serial, order_code=device_options.product.order_code),
                echo_source(scene, index, options.seed),
                options.pace,
                scene_time_zero_ns=zero_ns,
                clock=radar.clock,
                options=device_options,
                memory=None if state_dir is None else DirectoryMemory(state_dir, serial, warn),
            )
            faulty = FaultyDevice(device, radar.name, plan, note, zero_ns=zero_ns)
            faulty_devices[radar.name] = faulty
            devices.append(
                NamedDevice(
                    name=radar.name,
                    serial=serial,
                    device=faulty,
                    start_skew_ns=radar.clock.skew_ns,
                    present=faulty.port_present,
                    uart_baud=partial(getattr, device.module, "uart_baudrate"),
                )
            )
        people = partial(people_truth, scene, seed=options.seed)
        control = Control(faulty_devices, people=people, zero_ns=zero_ns)
        feed = None
        if not options.bare:
            feed = OdometryFeed(
                socket_path(folder, cleanup, SOCKET_NAME),
                scene_odometry(scene, options.seed),
                options.pace,
                scene_time_zero_ns=zero_ns,
            )
            cleanup.callback(feed.close)
        ports = DevicePorts(devices, folder, links, cleanup)
        _run(ports, control, [], stop, cleanup, zero_ns=zero_ns, feed=feed)


def _serials(options: Namespace, of_scene: Sequence[str]) -> list[str]:
    """Return the modules' serial numbers; their noise is that of the scene's, whatever they are.

    Bare modules have numbers that no other emulator has, so that a host that looks for one by its
    number finds that one.
    """
    if not options.bare and options.serial is None:
        return list(of_scene)
    first = options.serial
    if first is None:
        first = FIRST_BARE + BARE_SERIALS * secrets.randbelow(FIRST_BARE // BARE_SERIALS)
        if options.state_dir is not None:
            first = kept_first_serial(options.state_dir, BARE_SERIALS) or first
    if options.bare and options.state_dir is not None:
        keep_first_serial(options.state_dir, first)
    return [f"{first + index:012d}" for index in range(len(of_scene))]


def play(options: Namespace, stop: StopFlag, warn: Warn) -> None:
    """Play a recording, each radar at a port of its own, until a signal asks for the end."""
    with contextlib.ExitStack() as cleanup:
        radars = played_radars(
            options.recording,
            rate=options.rate,
            loop=options.loop,
            on_fault=lambda fault: warn(f"{fault.file}: {fault.reason}; the rest is played"),
            warn=warn,
        )
        folder = cleanup.enter_context(link_folder(options.link_dir))
        zero_ns = time.monotonic_ns()
        faulty = {
            one.name: FaultyDevice(one.device, one.name, FaultPlan(), zero_ns=zero_ns)
            for one in radars
        }
        devices = [
            NamedDevice(
                name=one.name,
                serial=one.serial,
                device=faulty[one.name],
                present=faulty[one.name].port_present,
                opened=one.device.port_opened,
                closed=one.device.port_closed,
            )
            for one in radars
        ]
        players = {radar.name: radar.stream for radar in radars}
        control = Control(faulty, players, zero_ns=zero_ns)
        ports = DevicePorts(devices, folder, LinkOptions(), cleanup)
        _run(ports, control, [], stop, cleanup, zero_ns=zero_ns)


def proxy(options: Namespace, stop: StopFlag, warn: Warn) -> None:
    """Put faults on the line of a real module until a signal asks for the end."""
    with contextlib.ExitStack() as cleanup:
        capture = None
        if options.wire is not None:
            capture = cleanup.enter_context(WireCapture(options.wire, {"port": options.port}))
        zero_ns = time.monotonic_ns()
        plan = _fault_plan(options.faults, [PROXY_NAME])
        note = _truth_log(options.truth, cleanup)
        module = ModuleLine(open_line(options.port, options.baud), capture, stop.request)
        cleanup.callback(module.close)
        faulty = FaultyDevice(module, PROXY_NAME, plan, note, zero_ns=zero_ns)
        folder = cleanup.enter_context(link_folder(options.link_dir))
        control = Control({PROXY_NAME: faulty}, zero_ns=zero_ns)
        named = NamedDevice(name=PROXY_NAME, serial="", device=faulty, present=faulty.port_present)
        ports = DevicePorts([named], folder, LinkOptions(), cleanup)
        _run(ports, control, [module], stop, cleanup, zero_ns=zero_ns)
    if not module.port_present(time.monotonic_ns()):
        raise PortUnavailable(f"{options.port}: the module's port vanished")


def _link_options(options: Namespace, warn: Warn) -> LinkOptions:
    if options.tcp is not None and not is_loopback(options.tcp_host):
        warn(f"--tcp-host {options.tcp_host}: everyone who reaches it can command the modules")
    return LinkOptions(
        kind=options.link,
        port_on_reset=options.port_on_reset,
        tcp_base=options.tcp,
        tcp_host=options.tcp_host,
    )


def _run(
    ports: DevicePorts,
    control: Control,
    services: Sequence[Service],
    stop: StopFlag,
    cleanup: contextlib.ExitStack,
    *,
    zero_ns: int,
    feed: OdometryFeed | None = None,
) -> None:
    if stop.requested:
        return  # do not announce ports that go away at once
    control_socket = ControlSocket(socket_path(ports.folder, cleanup, CONTROL_NAME), control)
    cleanup.callback(control_socket.close)
    ready = {
        "ready": True,
        "scene_time_zero_ns": zero_ns,
        "odometry": None if feed is None else os.fspath(feed.path),
        "control": os.fspath(control_socket.path),
        "devices": ports.entries(),
    }
    feeds = [] if feed is None else [feed]
    server = Server(ports.ports, [*feeds, *services, control_socket, *ports.services])
    cleanup.callback(server.close)
    stop.attach(server.stop)
    cleanup.callback(stop.detach)  # a second signal must not reach a loop that is being closed
    announce = announcement(cleanup)
    announce(ready)
    ports.moved = lambda: announce({**ready, "devices": ports.entries()})
    STDOUT.write(json_text(ready, separators=(",", ":")) + "\n")
    if STDOUT.failure is not None:  # ports that were not announced are of no use
        raise LinkError(f"stdout: cannot write the ready line: {STDOUT.failure.strerror}")
    server.run()
