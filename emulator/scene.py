"""Scene files: who stands where, how the robot drives, what its radars and wheels are like.

A scene is TOML that a person reads and writes; ``load_scene`` turns it into frozen, validated
models or one :class:`SceneError` line naming file, key and what is allowed. Lengths are true
metres, angles in the file degrees, amplitudes normalised X4 units (full scale of the 11 bit DAC
is +-1). Nothing here computes echoes or odometry.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, ValidationError, model_validator

from emulator.bounded_file import read_bounded
from emulator.people import PersonSpec
from emulator.scene_tables import (
    CarriedSpec,
    ClutterSpec,
    JitterSpec,
    LeakageSpec,
    MultipathSpec,
    Name,
    NoiseSpec,
    ObjectSpec,
    OdometrySpec,
    PathSpec,
    RadarSpec,
    Table,
    TargetSpec,
    WallSpec,
)
from emulator.trajectory import Trajectory, carried, drive

__all__ = [
    "CarriedSpec",
    "LeakageSpec",
    "NoiseSpec",
    "OdometrySpec",
    "PathSpec",
    "RadarSpec",
    "Scene",
    "SceneError",
    "TargetSpec",
    "UnknownSceneError",
    "empty_room",
    "load_scene",
    "scene_names",
]


LONGEST_DRIVE_S = 24 * 3600
MOST_ODOMETRY_LINES = 500_000
"""A day at the default rate; all lines are computed before the ports open."""

# Beside this package, in the repository and in the wheel alike. Not importlib.resources on the
# name "fixtures": a folder of that name in the user's own project would come first.
_SHIPPED_SCENES = Path(__file__).parent.parent / "fixtures" / "scenes"


class SceneError(ValueError):
    """A scene that cannot be used; the message is one line naming file, key and the remedy."""


class UnknownSceneError(SceneError):
    """A name that is none of the shipped scenes: wrong usage, while a bad file is a failure."""


class Scene(Table):
    """A whole scene. ``environment`` names the preset values a SLAM run should use for it."""

    name: Name
    environment: Literal["lab", "classroom"]
    description: str
    radars: Annotated[tuple[RadarSpec, ...], Field(min_length=1, max_length=64)]
    targets: tuple[TargetSpec, ...] = ()
    people: Annotated[tuple[PersonSpec, ...], Field(max_length=32)] = ()
    walls: Annotated[tuple[WallSpec, ...], Field(max_length=64)] = ()
    objects: Annotated[tuple[ObjectSpec, ...], Field(max_length=64)] = ()
    multipath: MultipathSpec = MultipathSpec()
    path: PathSpec = PathSpec()
    odometry: OdometrySpec = OdometrySpec()
    noise: NoiseSpec = NoiseSpec()
    leakage: LeakageSpec = LeakageSpec()
    clutter: ClutterSpec = ClutterSpec()
    jitter: JitterSpec = JitterSpec()

    @model_validator(mode="after")
    def _names_are_unique(self) -> Scene:
        for key, values in (
            ("radars.name", [radar.name for radar in self.radars]),
            ("radars.serial", [radar.serial for radar in self.radars]),
            ("targets.name", [target.name for target in self.targets]),
            ("people.name", [person.name for person in self.people]),
            ("walls.name", [wall.name for wall in self.walls]),
            ("objects.name", [box.name for box in self.objects]),
        ):
            twice = sorted({value for value in values if values.count(value) > 1})
            if twice:
                raise ValueError(f"{key}: each must be unique, {twice[0]!r} is used twice")
        return self

    @model_validator(mode="after")
    def _ends_some_day(self) -> Scene:
        try:
            duration_s = self.trajectory().duration_ns / 1e9
        except ValueError as error:
            raise ValueError(f"path.carried: {error}") from None
        if duration_s > LONGEST_DRIVE_S:
            raise ValueError(
                f"path: the drive takes {duration_s / 3600:.1f} h, at most "
                f"{LONGEST_DRIVE_S // 3600} h are allowed; drive faster or fewer laps"
            )
        lines = int(duration_s * self.odometry.rate_hz) + 1
        if lines > MOST_ODOMETRY_LINES:
            raise ValueError(
                f"odometry.rate_hz: {lines} lines of odometry in the whole drive, at most "
                f"{MOST_ODOMETRY_LINES} are allowed; lower the rate"
            )
        return self

    def trajectory(self) -> Trajectory:
        """Return the robot's true path, world frame (the start pose is the origin)."""
        path = drive(
            self.path.stops_m(),
            speed_mps=self.path.speed_mps,
            turn_rate_rad_per_s=math.radians(self.path.turn_rate_deg_per_s),
        )
        lift = self.path.carried
        if lift is None:
            return path
        return carried(
            path,
            at_ns=round(lift.at_s * 1e9),
            skips_ns=round(lift.skips_s * 1e9),
            takes_ns=round(lift.takes_s * 1e9),
        )


def empty_room(count: int = 1) -> Scene:
    """Return a scene of ``count`` stock modules in a room without any reflector.

    The robot stands at the origin; leakage and receiver noise are the defaults.
    """
    return Scene(
        name="empty_room",
        environment="lab",
        description="Stock modules in an empty room.",
        radars=tuple(
            RadarSpec(
                name=f"radar_{index + 1}",
                serial=f"{100_000_000_000 + index:012d}",
                x_m=0.0,
                y_m=0.0,
                yaw_deg=0.0,
            )
            for index in range(count)
        ),
    )


def scene_names() -> tuple[str, ...]:
    """Return the names of the scenes that ship with the package, sorted."""
    return tuple(sorted(path.stem for path in _SHIPPED_SCENES.glob("*.toml")))


def load_scene(path_or_name: str | Path) -> Scene:
    """Return the scene in a TOML file, or a shipped one by its name ("lab").

    A string without a path separator and without ``.toml`` is a name.

    Raises
    ------
    UnknownSceneError
        No scene of this name ships with the package.
    SceneError
        File missing or unreadable, TOML broken, key unknown, or value refused.
    """
    text = str(path_or_name)
    is_name = isinstance(path_or_name, str) and not text.endswith(".toml") and "/" not in text
    if is_name and text not in scene_names():
        raise UnknownSceneError(
            f"{text}: no such scene; known are {', '.join(scene_names())}, "
            "or give the path of a .toml file"
        )
    source = _SHIPPED_SCENES / f"{text}.toml" if is_name else Path(path_or_name)
    try:
        table = tomllib.loads(read_bounded(source).decode())
    except OSError as error:
        raise SceneError(f"{text}: cannot read the scene file: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SceneError(f"{text}: not UTF-8 text at byte {error.start}") from error
    except ValueError as error:  # not TOML, or an integer of thousands of digits
        raise SceneError(f"{text}: not valid TOML: {error}") from error
    except RecursionError as error:
        raise SceneError(f"{text}: brackets are nested too deep for a scene") from error
    try:
        return Scene.model_validate(table)
    except ValidationError as error:
        raise SceneError(f"{text}: {_one_line(error)}") from error


def _one_line(error: ValidationError) -> str:
    """Say the first problem in one line, and how many more there are."""
    found = error.errors(include_url=False)
    # A refused row makes its list too short as well: that is no problem of its own.
    refused = {each["loc"][:depth] for each in found for depth in range(len(each["loc"]))}
    problems = [e for e in found if e["type"] != "too_short" or e["loc"] not in refused]
    first = problems[0]
    location = first["loc"]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    match first["type"]:
        case "extra_forbidden":
            allowed = ", ".join(_allowed_keys(location[:-1]))
            said = f"unknown key; allowed are {allowed}"
        case "tuple_type" if isinstance(first["input"], dict):
            name = location[-1]
            said = f"must be a list of tables; begin each with [[{name}]], not [{name}]"
        case "missing":
            said = "missing; this key is required"
        case "value_error":
            said = str(first["ctx"]["error"])
        case _:
            said = f"{first['msg']}, got {_short(first['input'])}"
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"{key.removeprefix('.')}: {said}{more}" if key else f"{said}{more}"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _allowed_keys(location: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the table at a location, by walking the models' fields."""
    model: type[BaseModel] = Scene
    for part in location:
        if isinstance(part, str):
            model = _table_type(model.model_fields[part].annotation)
    return list(model.model_fields)


def _table_type(annotation: Any) -> type[BaseModel]:  # noqa: ANN401 - any type expression
    """Return the table model inside ``Table`` or ``tuple[Table, ...]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return _table_type(annotation.__args__[0])
