"""Modules on ports, and the radars of a rig file: who is who, by the modules' own serial numbers.

Which cable ends where does not matter: a module's mount, offset and gain follow its serial number.
A module that is missing, foreign or there twice is refused by name before anything is set.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from slam.app.errors import AppError
from slam.app.rig_file import RigFile, RigRadar
from slam.app.sources import RadarLink
from xethru_protocol.codes import InfoItem
from xethru_protocol.driver import X4M300, ProtocolRecord, known_ports
from xethru_protocol.errors import XeThruError
from xethru_protocol.messages import SystemGetInfo
from xethru_protocol.ports import find_ports

NamedObserver = Callable[[str, ProtocolRecord], None]
"""Gets a radar's name, and what happened on its link."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Module:
    port: str
    serial: str
    driver: X4M300
    link_log: _LinkLog


class _LinkLog:
    """Passes on what happens on a link, once it is known whose it is."""

    def __init__(self, observer: NamedObserver) -> None:
        self._observer = observer
        self._name: str | None = None
        self._early: list[ProtocolRecord] = []

    def take(self, record: ProtocolRecord) -> None:
        if self._name is None:
            self._early.append(record)
        else:
            self._observer(self._name, record)

    def name(self, name: str) -> None:
        self._name = name
        for record in self._early:
            self._observer(name, record)


def open_rig(
    rig: RigFile,
    rig_path: Path,
    ports: Sequence[str] | None,
    observer: NamedObserver,
    note: Callable[[str], None],
) -> tuple[RadarLink, ...]:
    """Open the modules of a rig.

    Parameters
    ----------
    rig, rig_path
        The rig file.
    ports
        Where the modules are; None: wherever this machine has modules or running emulators.
    observer
        Told of everything on their links, from other threads later on.
    note
        Told where every radar was found, and which ports were passed over.

    Returns
    -------
    Links in the order of the rig.

    Raises
    ------
    AppError
        A module is missing, is in no rig, is there twice, or a port that was named is none; one
        line that names it.
    """
    with ExitStack() as unless_it_works:
        candidates = known_ports() if ports is None else ports
        if not candidates:
            raise AppError(
                "there are no modules and no running emulators on this machine; "
                "plug the modules in, or name their ports with --ports"
            )
        modules = []
        for port in dict.fromkeys(candidates):
            try:
                module = _ask(port, observer, unless_it_works)
            except AppError as error:
                if ports is not None:
                    raise
                note(f"passed over: {error}")
                continue
            modules.append(module)
        links = _match(rig, rig_path, modules, is_named=ports is not None, note=note)
        kept = {link.driver for link in links}
        for module in modules:
            if module.driver not in kept:
                module.driver.close()
        unless_it_works.pop_all()
    return links


def are_emulated(links: Sequence[RadarLink]) -> bool:
    """Return whether any of these modules is a running emulator's, as far as emulators tell."""
    emulated = {os.path.realpath(port.path) for port in find_ports() if port.kind == "emulated"}
    return any(os.path.realpath(link.port) in emulated for link in links)


def _ask(port: str, observer: NamedObserver, unless_it_works: ExitStack) -> _Module:
    """Open a port and ask the module behind it for its serial number."""
    link_log = _LinkLog(observer)
    try:
        driver = X4M300.open(port, observer=link_log.take)
        unless_it_works.callback(driver.close)
        request = SystemGetInfo(item=InfoItem.XTID_SSIC_SERIALNUMBER)
        driver.ping()
        serial = driver.request(request).text
    except XeThruError as error:
        raise AppError(f"{port}: {error}") from None
    return _Module(port=port, serial=serial, driver=driver, link_log=link_log)


def _match(
    rig: RigFile,
    rig_path: Path,
    modules: Sequence[_Module],
    *,
    is_named: bool,
    note: Callable[[str], None],
) -> tuple[RadarLink, ...]:
    by_serial: dict[str, _Module] = {}
    for module in modules:
        twin = by_serial.setdefault(module.serial, module)
        if twin is not module:
            raise AppError(
                f"two modules have the serial number {module.serial}, at {twin.port} and "
                f"{module.port}; are these two names of one port, or a module's copy?"
            )
    wanted = {radar.serial for radar in rig.radars}
    foreign = [module for module in modules if module.serial not in wanted]
    missing = [radar for radar in rig.radars if radar.serial not in by_serial]
    if missing:
        raise AppError(_missing_text(rig_path, missing, foreign, modules))
    for module in foreign:
        text = f"the module at {module.port} has serial number {module.serial}"
        if is_named:
            raise AppError(
                f"{text}, which {rig_path} does not name; leave the port out or add the radar"
            )
        note(f"passed over: {text}, which {rig_path} does not name")
    links = []
    for radar, mount in zip(rig.radars, rig.rig.mounts, strict=True):
        module = by_serial[radar.serial]
        module.link_log.name(radar.name)
        note(f"radar {radar.name}: serial number {radar.serial}, at {module.port}")
        links.append(
            RadarLink(
                mount=mount,
                port=module.port,
                serial=radar.serial,
                driver=module.driver,
                gain_db=float(radar.gain_db),
            )
        )
    return tuple(links)


def _missing_text(
    rig_path: Path,
    missing: Sequence[RigRadar],
    foreign: Sequence[_Module],
    modules: Sequence[_Module],
) -> str:
    named = ", ".join(f"{radar.name} (serial number {radar.serial})" for radar in missing)
    are = "radar" if len(missing) == 1 else "radars"
    text = f"{rig_path}: {are} {named} not found"
    if not modules:
        return f"{text}: no module answered"
    looked = ", ".join(f"{module.serial} at {module.port}" for module in modules)
    if foreign:
        stranger = ", ".join(f"{module.serial} at {module.port}" for module in foreign)
        return (
            f"{text}; instead there is {stranger}: "
            "if a module was replaced, write its serial number into the rig file"
        )
    return f"{text}; there are {looked}: is it plugged in?"
