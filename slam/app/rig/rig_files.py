"""Rig files as commands read and write them: those of shipped scenes by name, too."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from emulator.scene.scene import Scene, SceneError, UnknownSceneError, load_scene
from emulator.scene.toml_files import is_name
from slam.app.errors import UsageError, naming
from slam.config import ConfigError
from slam.geometry import ReceivedPulse
from slam.library import rig_files
from slam.library.rig_files import RigFile, RigPulse, RigRadar, RigWheels
from slam.live.errors import AppError
from xethru_protocol.operating_system import written_whole

_DECIMALS = 4


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
    try:
        return rig_files.load_rig(rig)
    except ConfigError as error:
        with suppress(SceneError):
            load_scene(rig)
            raise AppError(
                f"{rig}: is a scene; copy its [[radars]] into a rig file, and its [odometry] "
                "without rate_hz as [wheels]"
            ) from None
        raise AppError(str(error)) from None


def rounded_pulse(pulse: ReceivedPulse) -> RigPulse:
    """Return what a rig file keeps of a pulse: four decimals."""
    return RigPulse(
        step_m=round(pulse.step_m, 6),
        relative_error=round(pulse.relative_error, _DECIMALS),
        real=tuple(round(value, _DECIMALS) for value in pulse.real),
        imaginary=tuple(round(value, _DECIMALS) for value in pulse.imaginary),
    )


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
