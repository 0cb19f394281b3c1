"""Rig files, and the modules on ports: who is who, by the modules' own serial numbers.

A rig file is what `uwb-slam calibrate --rig` writes and `load_rig` reads back. Lengths in true
metres, body frame x forward and y left, yaw in degrees counter-clockwise from forward;
`range_offset_m` is what the module measures too long, `phase_offset_deg` what it adds to an echo's
carrier phase (`Mount.phase_offset_rad`; no command estimates it), `gain_db` how much stronger its
echoes are than the mean of the rig.

Which cable ends where does not matter: a module's mount, offset and gain follow its serial number.
A module that is missing, foreign or there twice is refused by name before anything is set.
"""

from __future__ import annotations

import json
import math
import os
import tomllib
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StrictFloat, StrictInt, ValidationError

from slam.app.errors import AppError, naming
from slam.app.rig.sources import RadarLink
from slam.config import WheelNoise
from slam.geometry import Mount, Rig
from xethru_protocol.driver.conversation import ProtocolRecord
from xethru_protocol.driver.radar import X4M300, known_ports
from xethru_protocol.system import read_bounded
from xethru_protocol.transport import find_ports
from xethru_protocol.wire.codes import InfoItem
from xethru_protocol.wire.errors import XeThruError
from xethru_protocol.wire.messages import SystemGetInfo

_Sigma = Annotated[StrictFloat | StrictInt, Field(ge=0, le=10, allow_inf_nan=False)]
_Number = Annotated[StrictFloat | StrictInt, Field(ge=-1000, le=1000, allow_inf_nan=False)]


class RigRadar(BaseModel):
    """One radar: who it is, where it sits, what is known of its errors."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, Field(min_length=1, max_length=80)]
    serial: Annotated[str, Field(pattern=r"^[0-9]{12}$")]
    x_m: _Number
    y_m: _Number
    yaw_deg: _Number
    range_offset_m: _Number = 0.0
    phase_offset_deg: _Number = 0.0
    gain_db: _Number = 0.0


class RigWheels(BaseModel):
    """How the robot's odometry errs, from its data sheet or a test drive; see `WheelNoise`.

    The keys are those of a scene's table ``odometry``. White noise grows with the square root of
    the way and with the angle turned; the three other standard deviations are of errors that stay.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    along_sigma_m_per_sqrt_m: _Sigma = WheelNoise().along_m_per_sqrt_m
    across_sigma_m_per_sqrt_m: _Sigma = WheelNoise().across_m_per_sqrt_m
    heading_sigma_rad_per_sqrt_m: _Sigma = WheelNoise().heading_rad_per_sqrt_m
    heading_sigma_rad_per_rad: _Sigma = WheelNoise().heading_rad_per_rad
    scale_sigma: _Sigma = WheelNoise().scale_sigma
    turn_scale_sigma: _Sigma = WheelNoise().turn_scale_sigma
    curvature_sigma_rad_per_m: _Sigma = WheelNoise().curvature_sigma_rad_per_m

    @property
    def noise(self) -> WheelNoise:
        return WheelNoise(
            along_m_per_sqrt_m=float(self.along_sigma_m_per_sqrt_m),
            across_m_per_sqrt_m=float(self.across_sigma_m_per_sqrt_m),
            heading_rad_per_sqrt_m=float(self.heading_sigma_rad_per_sqrt_m),
            heading_rad_per_rad=float(self.heading_sigma_rad_per_rad),
            scale_sigma=float(self.scale_sigma),
            turn_scale_sigma=float(self.turn_scale_sigma),
            curvature_sigma_rad_per_m=float(self.curvature_sigma_rad_per_m),
        )


class RigFile(BaseModel):
    """The whole file: one `[[radars]]` table per radar, and `[wheels]` where more is known."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    radars: Annotated[tuple[RigRadar, ...], Field(min_length=1, max_length=64)]
    wheels: RigWheels = RigWheels()

    @property
    def rig(self) -> Rig:
        return Rig(
            mounts=tuple(
                Mount(
                    name=radar.name,
                    x_m=float(radar.x_m),
                    y_m=float(radar.y_m),
                    yaw_rad=math.radians(radar.yaw_deg),
                    range_offset_m=float(radar.range_offset_m),
                    phase_offset_rad=math.radians(radar.phase_offset_deg),
                )
                for radar in self.radars
            )
        )


def load_rig(path: Path) -> RigFile:
    """Read a rig file.

    Raises
    ------
    AppError
        One line with file, key and what is allowed.
    """
    try:
        table = tomllib.loads(read_bounded(path).decode())
    except OSError as error:
        raise AppError(f"{path}: cannot read the rig file: {error.strerror or error}") from None
    except ValueError as error:  # neither UTF-8 nor TOML
        raise AppError(f"{path}: not valid TOML: {error}") from None
    except RecursionError:
        raise AppError(f"{path}: no rig file: brackets within brackets without end") from None
    try:
        rig = RigFile.model_validate(table)
    except ValidationError as error:
        raise AppError(f"{path}: {_one_line(error)}") from None
    for key in ("name", "serial"):
        values = [getattr(radar, key) for radar in rig.radars]
        twice = sorted({value for value in values if values.count(value) > 1})
        if twice:
            raise AppError(f"{path}: radars.{key}: must be unique, {twice[0]!r} is used twice")
    return rig


def write_rig(path: Path, rig: RigFile) -> None:
    """Write a rig file that `load_rig` reads back with the same floats.

    Raises
    ------
    AppError
        The file cannot be written.
    """
    tables = []
    for radar in rig.radars:
        # a JSON string of these names is a TOML string
        lines = [f"{key} = {json.dumps(value)}" for key, value in radar.model_dump().items()]
        tables.append("\n".join(["[[radars]]", *lines]))
    if rig.wheels != RigWheels():
        lines = [f"{key} = {json.dumps(value)}" for key, value in rig.wheels.model_dump().items()]
        tables.append("\n".join(["[wheels]", *lines]))
    with naming(path):
        path.write_text("\n\n".join(tables) + "\n", encoding="utf-8")


def _one_line(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    key = "".join(
        f"[{part}]" if isinstance(part, int) else f".{part}"
        for part in first["loc"]
        if part not in ("float", "int")
    ).removeprefix(".")
    if first["type"] == "extra_forbidden":
        tables: dict[str, type[BaseModel]] = {"radars": RigRadar, "wheels": RigWheels}
        model = tables[str(first["loc"][0])] if len(first["loc"]) > 1 else RigFile
        return f"{key}: unknown key; allowed are {', '.join(model.model_fields)}"
    if first["type"] == "missing":
        return f"{key}: missing; this key is required"
    return f"{key}: {first['msg']}, got {first['input']!r}"


NamedObserver = Callable[[str, ProtocolRecord], None]
"""Gets a radar's name, and what happened on its link."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Module:
    port: str
    serial: str
    driver: X4M300
    link_log: _LinkLog


class _LinkLog:
    """Passes on what happens on a link, as soon as the name of its radar is known."""

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
        Gets everything that happens on their links, later on from other threads.
    note
        Gets a line about where each radar was found, and about each port that is skipped.

    Returns
    -------
    Links in the order of the rig.

    Raises
    ------
    AppError
        A module is missing, not in the rig, or found twice, or a named port has no module; one
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
    """Return whether any of these modules is that of a running emulator."""
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
