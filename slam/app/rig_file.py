"""Rig files: the radars of a robot with mounts, range offsets and gains, as TOML.

What `uwb-slam calibrate --rig` writes and `load_rig` reads back. Lengths in true metres, body frame
x forward and y left, yaw in degrees counter-clockwise from forward; `range_offset_m` is what the
module measures too long, `phase_offset_deg` what it adds to an echo's carrier phase
(`Mount.phase_offset_rad`; no command estimates it), `gain_db` how much louder it hears than the
mean of the rig. `uwb-slam run --rig` reads it and finds each radar by its module's serial number.
"""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StrictFloat, StrictInt, ValidationError

from emulator.bounded_file import read_bounded
from slam.app.errors import AppError, naming
from slam.geometry import Mount, Rig
from slam.robust.parameters import WheelNoise

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
    """How the robot's odometry errs, as its data sheet or a test drive tells; see `WheelNoise`.

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
        """Return what SLAM is told."""
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
        """Return the mounts; gains play no part in them."""
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
