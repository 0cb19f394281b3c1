"""Rig files, and the modules on ports: who is who, by the modules' own serial numbers.

A rig file is what `uwb-slam calibrate --rig` writes and `load_rig` reads back. Lengths in true
metres, body frame x forward and y left, yaw in degrees counter-clockwise from forward;
`range_offset_m` is what the module measures too long, `phase_offset_deg` what it adds to an echo's
carrier phase (`Mount.phase_offset_rad`; no command estimates it), `gain_db` how much stronger its
echoes are than the mean of the rig.

A module whose pulse differs from that of the data sheet has a table `pulse` after its other keys:
`real` and `imaginary`, samples of the pulse's complex envelope, `step_m` of range apart, the middle
one where an echo's range is and about 1; `relative_error`, the norm of their error over their own.

    [radars.pulse]
    step_m = 0.0388
    relative_error = 0.02
    real = [0.0, 0.061, 0.332, 0.761, 1.0, 0.782, 0.351, 0.08, 0.003]
    imaginary = [0.0, 0.0, 0.01, 0.003, 0.0, -0.012, -0.01, 0.009, 0.0]

Which cable ends where does not matter: a module's mount, offset and gain follow its serial number.
A module that is missing, foreign or there twice is refused by name before anything is set.
`port` is for a module that is not found by itself, such as one at `tcp://HOST:PORT`.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, StrictFloat, model_validator

from emulator.scene.scene import Scene, SceneError, UnknownSceneError, load_scene
from emulator.scene.toml_files import SerialNumber, Table, is_name, load_table
from slam.app.errors import AppError, UsageError, naming
from slam.app.rig.frame_sources import RadarLink, RecordObserver
from slam.config import WheelNoise
from slam.geometry import Mount, ReceivedPulse, Rig
from xethru_protocol.driver.matching import ProtocolRecord
from xethru_protocol.driver.radar import X4M300, known_ports
from xethru_protocol.operating_system import written_whole
from xethru_protocol.transport import find_ports
from xethru_protocol.wire.codes import InfoItem
from xethru_protocol.wire.errors import PortUnavailable, XeThruError
from xethru_protocol.wire.messages import SystemGetInfo

_Sigma = Annotated[StrictFloat, Field(ge=0, le=10, allow_inf_nan=False)]
_Sample = Annotated[StrictFloat, Field(ge=-2, le=2)]
_Envelope = Annotated[tuple[_Sample, ...], Field(min_length=5, max_length=201)]
_Number = Annotated[StrictFloat, Field(ge=-1000, le=1000, allow_inf_nan=False)]
_DECIMALS = 4
# Least height of the middle of a pulse, as a share of its largest sample
_LEAST_MIDDLE = 0.7


class RigPulse(Table):
    """The pulse that a module receives, where it is not that of the data sheet; `ReceivedPulse`."""

    step_m: Annotated[StrictFloat, Field(ge=1e-3, le=0.05)]
    relative_error: Annotated[StrictFloat, Field(ge=0, lt=1)]
    real: _Envelope
    imaginary: _Envelope

    @model_validator(mode="after")
    def _is_a_pulse(self) -> Self:
        received = self.received
        heights = list(map(math.hypot, received.real, received.imaginary))
        middle = heights[len(heights) // 2]
        if middle < _LEAST_MIDDLE * max(*heights, 1.0):
            raise ValueError(
                "the middle sample must be about 1, where the pulse is high; "
                f"it is {middle:.3g} of at most {max(heights):.3g}"
            )
        return self

    @classmethod
    def rounded(cls, pulse: ReceivedPulse) -> Self:
        """Return what a rig file keeps of a pulse: four decimals."""
        return cls(
            step_m=round(pulse.step_m, 6),
            relative_error=round(pulse.relative_error, _DECIMALS),
            real=tuple(round(value, _DECIMALS) for value in pulse.real),
            imaginary=tuple(round(value, _DECIMALS) for value in pulse.imaginary),
        )

    @property
    def received(self) -> ReceivedPulse:
        return ReceivedPulse(**self.model_dump())


class RigRadar(Table):
    """One radar: who it is, where it sits, what is known of its errors."""

    name: Annotated[str, Field(min_length=1, max_length=80)]
    serial: SerialNumber
    x_m: _Number
    y_m: _Number
    yaw_deg: _Number
    range_offset_m: _Number = 0.0
    phase_offset_deg: _Number = 0.0
    gain_db: _Number = 0.0
    port: Annotated[str, Field(min_length=1, max_length=300)] | None = None
    pulse: RigPulse | None = None


class RigWheels(Table):
    """How the robot's odometry errs, from its data sheet or a test drive; see `WheelNoise`.

    The keys are those of a scene's table ``odometry``. White noise grows with the square root of
    the way and with the angle turned; the three other standard deviations are of errors that stay.
    """

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
            along_m_per_sqrt_m=self.along_sigma_m_per_sqrt_m,
            across_m_per_sqrt_m=self.across_sigma_m_per_sqrt_m,
            heading_rad_per_sqrt_m=self.heading_sigma_rad_per_sqrt_m,
            heading_rad_per_rad=self.heading_sigma_rad_per_rad,
            scale_sigma=self.scale_sigma,
            turn_scale_sigma=self.turn_scale_sigma,
            curvature_sigma_rad_per_m=self.curvature_sigma_rad_per_m,
        )


class RigFile(Table):
    """The whole file: one `[[radars]]` table per radar, and `[wheels]` where more is known."""

    radars: Annotated[tuple[RigRadar, ...], Field(min_length=1, max_length=64)]
    wheels: RigWheels = RigWheels()

    @property
    def rig(self) -> Rig:
        return Rig(
            mounts=tuple(
                Mount(
                    name=radar.name,
                    x_m=radar.x_m,
                    y_m=radar.y_m,
                    yaw_rad=math.radians(radar.yaw_deg),
                    range_offset_m=radar.range_offset_m,
                    phase_offset_rad=math.radians(radar.phase_offset_deg),
                    pulse=None if radar.pulse is None else radar.pulse.received,
                )
                for radar in self.radars
            )
        )


def rig_file_of(scene: Scene) -> RigFile:
    """Return the rig file of a scene's robot: what its user would write from a data sheet.

    Mounts are nominal and wheels as specified; the modules' own errors, and what was drawn for a
    run, stay unknown.
    """
    radars = tuple(
        RigRadar(
            name=radar.name,
            serial=radar.serial,
            x_m=radar.x_m,
            y_m=radar.y_m,
            yaw_deg=radar.yaw_deg,
        )
        for radar in scene.radars
    )
    keys = set(RigWheels.model_fields)  # the same keys
    return RigFile(radars=radars, wheels=RigWheels(**scene.odometry.model_dump(include=keys)))


def load_rig(rig: str | Path) -> RigFile:
    """Read a rig file, or take that of a shipped scene's robot by the name of the scene.

    A string without a path separator and without ``.toml`` is a name.

    Raises
    ------
    UsageError
        No scene of this name ships with the package.
    AppError
        One line with file, key and what is allowed.
    """
    if is_name(rig):
        try:
            return rig_file_of(load_scene(rig))
        except UnknownSceneError as error:
            raise UsageError(f"--rig {error}") from None
        except SceneError as error:
            raise AppError(str(error)) from None
    found = load_table(RigFile, rig, folder="rigs", what="rig", error=AppError, unknown=AppError)
    for key in ("name", "serial"):
        values = [getattr(radar, key) for radar in found.radars]
        twice = sorted({value for value in values if values.count(value) > 1})
        if twice:
            raise AppError(f"{rig}: radars.{key}: must be unique, {twice[0]} is used twice")
    return found


def write_rig(path: Path, rig: RigFile) -> None:
    """Write a rig file that `load_rig` reads back with the same floats."""
    tables = []
    for radar in rig.radars:
        tables.append(_toml("[[radars]]", radar.model_dump(exclude_none=True, exclude={"pulse"})))
        if radar.pulse is not None:
            tables.append(_toml("[radars.pulse]", radar.pulse.model_dump()))
    if rig.wheels != RigWheels():
        tables.append(_toml("[wheels]", rig.wheels.model_dump()))
    with naming(path), written_whole(path) as fresh:
        fresh.write_text("\n\n".join(tables) + "\n", encoding="utf-8")


def _toml(header: str, values: Mapping[str, object]) -> str:
    # a JSON string of these names is a TOML string
    return "\n".join([header, *(f"{key} = {json.dumps(value)}" for key, value in values.items())])


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


def open_rig(
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
