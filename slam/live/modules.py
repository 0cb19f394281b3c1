"""The modules of a rig on ports: who is who, by the modules' own serial numbers.

Which cable ends where does not matter: a module's mount, offset and gain follow its serial number.
A module that is missing, foreign or there twice is refused by name before anything is set.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from slam.geometry import Rig
from slam.library.rig_files import RigFile, RigRadar
from slam.live.errors import AppError
from slam.live.frame_sources import RadarLink, RecordObserver
from xethru_protocol.driver.matching import ProtocolRecord
from xethru_protocol.driver.radar import X4M300, known_ports
from xethru_protocol.transport import find_ports
from xethru_protocol.wire.codes import InfoItem
from xethru_protocol.wire.errors import PortUnavailable, XeThruError
from xethru_protocol.wire.messages import SystemGetInfo


class _OpenModule:
    """A module at a port; what happens on its link is passed on once its radar's name is known."""

    def __init__(self, port: str, observer: RecordObserver, held: ExitStack) -> None:
        self.port = port
        self._observer, self._name = observer, ""
        self._early: list[ProtocolRecord] = []
        with ExitStack() as unless_it_answers:
            try:
                self.driver = X4M300.open(port, observer=self._take)
                unless_it_answers.callback(self.driver.close)
                self.driver.ping()
                request = SystemGetInfo(item=InfoItem.XTID_SSIC_SERIALNUMBER)
                self.serial = self.driver.request(request).text
            except XeThruError as error:
                raise AppError(f"{port}: {error}") from error
            held.push(unless_it_answers.pop_all())

    def name(self, name: str) -> None:
        self._name = name
        for record in self._early:
            self._observer(name, record)

    def _take(self, record: ProtocolRecord) -> None:
        if self._name:
            self._observer(self._name, record)
        else:
            self._early.append(record)


def open_modules(
    rig: RigFile,
    rig_path: str | Path,
    ports: Sequence[str] | None,
    observer: RecordObserver,
    note: Callable[[str], None],
    *,
    odometry_socket: str = "",
) -> tuple[RadarLink, ...]:
    """Open the modules of a rig; the links are in its order.

    Parameters
    ----------
    ports
        Where the modules are; None: at the ports that the rig file names, and, if it does not name
        one for each radar, wherever this machine has modules or running emulators.
    observer
        Gets everything that happens on their links, later on from other threads.
    note
        Gets a line about where each radar was found, and one about the ports that are skipped.
    odometry_socket
        That of an emulator, "" for none: if the ports beside it are those of the rig, other
        programs' ports are not opened.

    Raises
    ------
    AppError
        A module is missing, not in the rig, or found twice, or a named port has no module.
    """
    with ExitStack() as unless_it_works:
        named = (
            tuple(filter(None, (radar.port for radar in rig.radars))) if ports is None else ports
        )
        is_complete = ports is not None or len(named) == len(rig.radars)
        candidates = named if is_complete else (*named, *known_ports())
        if not candidates:
            raise AppError(
                "there are no modules and no running emulators on this machine; "
                "plug the modules in, or name their ports with --ports"
            )
        near = [
            port for port in candidates if odometry_socket and _are_beside(port, odometry_socket)
        ]
        wanted = {radar.serial for radar in rig.radars}
        modules: list[_OpenModule] = []
        passed_over = []
        unopened = []
        for port in dict.fromkeys((*named, *near, *candidates)):
            if near and port not in (*named, *near) and wanted <= {one.serial for one in modules}:
                break
            try:
                module = _OpenModule(port, observer, unless_it_works)
            except AppError as error:
                if port in named:
                    raise
                if isinstance(error.__cause__, PortUnavailable):
                    unopened.append(port)
                else:
                    passed_over.append(f"{port} (no module answers)")
                continue
            modules.append(module)
            if port not in named and module.serial not in wanted:
                passed_over.append(f"{port} (module {module.serial})")
        if passed_over:
            note(f"passed over, not of this rig: {', '.join(passed_over)}")
        if unopened:
            note(f"passed over, in use or not to be opened: {', '.join(unopened)}")
        links = _match(rig, rig_path, modules, named=named, unopened=unopened, note=note)
        kept = {link.driver for link in links}
        for module in modules:
            if module.driver not in kept:
                module.driver.close()
        unless_it_works.pop_all()
    return links


def open_ports(rig: Rig, ports: Sequence[str], observer: RecordObserver) -> tuple[RadarLink, ...]:
    """Open the module at each port for the mount in its place; AppError if one does not answer."""
    links = []
    with ExitStack() as unless_it_works:
        for mount, port in zip(rig.mounts, ports, strict=True):
            module = _OpenModule(port, observer, unless_it_works)
            module.name(mount.name)
            links.append(
                RadarLink(mount=mount, port=port, serial=module.serial, driver=module.driver)
            )
        unless_it_works.pop_all()
    return tuple(links)


def _are_beside(port: str, other: str) -> bool:
    first, second = (os.path.realpath(os.path.dirname(path) or ".") for path in (port, other))
    return first == second


def are_emulated(links: Sequence[RadarLink]) -> bool:
    """Return whether any of these modules is that of a running emulator."""
    found = [port for port in find_ports() if port.kind == "emulated"]
    emulated = {os.path.realpath(port.path) for port in found}
    here = {f"{host}:{port.tcp}" for port in found for host in ("127.0.0.1", "localhost", "[::1]")}
    return any(
        os.path.realpath(link.port) in emulated or link.port.partition("://")[2] in here
        for link in links
    )


def _match(
    rig: RigFile,
    rig_path: str | Path,
    modules: Sequence[_OpenModule],
    *,
    named: Sequence[str],
    unopened: Sequence[str],
    note: Callable[[str], None],
) -> tuple[RadarLink, ...]:
    wanted = {radar.serial for radar in rig.radars}
    by_serial: dict[str, _OpenModule] = {}
    for module in modules:
        twin = by_serial.setdefault(module.serial, module)
        if twin is not module and module.serial in wanted:
            raise AppError(
                f"two modules have the serial number {module.serial}, at {twin.port} and "
                f"{module.port}: two names of one port, or two emulators of one scene? name the "
                "ports to open with --ports"
            )
    foreign = [module for module in modules if module.serial not in wanted]
    missing = [radar for radar in rig.radars if radar.serial not in by_serial]
    if missing:
        text = _missing_text(rig_path, missing, foreign, modules)
        busy = " (`xethru doctor` says who has the ports that were passed over)" if unopened else ""
        raise AppError(text + busy)
    for module in foreign:
        if module.port in named:
            raise AppError(
                f"the module at {module.port} has serial number {module.serial}, which {rig_path} "
                "does not name; leave the port out or add the radar"
            )
    links = []
    for radar, mount in zip(rig.radars, rig.rig.mounts, strict=True):
        module = by_serial[radar.serial]
        module.name(radar.name)
        note(f"radar {radar.name}: serial number {radar.serial}, at {module.port}")
        links.append(
            RadarLink(
                mount=mount,
                port=module.port,
                serial=radar.serial,
                driver=module.driver,
                gain_db=radar.gain_db,
            )
        )
    return tuple(links)


def _missing_text(
    rig_path: str | Path,
    missing: Sequence[RigRadar],
    foreign: Sequence[_OpenModule],
    modules: Sequence[_OpenModule],
) -> str:
    named = ", ".join(f"{radar.name} (serial number {radar.serial})" for radar in missing)
    are = "radar" if len(missing) == 1 else "radars"
    text = f"{rig_path}: {are} {named} not found"
    if not modules:
        return f"{text}: no module answered"
    found = ", ".join(f"{module.serial} at {module.port}" for module in foreign or modules)
    if not foreign:
        return f"{text}; there are {found}: is it plugged in?"
    return (
        f"{text}; instead there is {found}: "
        "if a module was replaced, write its serial number into the rig file"
    )
