"""Map files: what a run knows of its surroundings, as JSON that a person can read.

Numbers are written as Python's ``repr`` has them, so what is read is what was written, to the last
bit. ``landmarks``, ``walls`` and ``radars`` are a row each; ``unknowns`` names them again in the
order of ``covariance``, the lower triangle of the covariance of all of them together, map frame,
additive errors. ``made`` says what made the map, and is for people.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError

from slam.config import ConfigError
from slam.geometry import MOST_M
from slam.results import SavedMap
from xethru_protocol.operating_system import read_bounded, written_whole

FORMAT, VERSION = "xethru-hil map", 1
_MOST_BYTES = 1 << 28
_FRAME = "metres and radians; x, y and heading of the robot were 0 where the first run began"
# What rounding may take from a variance, as a share of the largest one
_ROUNDING = 1e-9
_DIGEST_BYTES = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class MapFile:
    """A map file: the map, and where it is from.

    ``world_from_map`` is the pose of the map frame in the world of an emulated scene, or where the
    truth is known otherwise; None where it is not.
    """

    map: SavedMap
    made: Mapping[str, str] = field(default_factory=dict)
    world_from_map: tuple[float, float, float] | None = None

    @property
    def id(self) -> str:
        """Return sixteen digits that another map does not have."""
        text = json.dumps(asdict(self.map)).encode()
        return hashlib.blake2b(text, digest_size=_DIGEST_BYTES).hexdigest()


_FILE = TypeAdapter(MapFile)


def map_text(file: MapFile) -> str:
    """Return the text of a map file."""
    head = {"format": FORMAT, "version": VERSION, "id": file.id, "frame": _FRAME}
    tables = head | {"made": dict(file.made), "world_from_map": file.world_from_map}
    tables |= asdict(file.map)
    lines = []
    for key, value in tables.items():
        text = json.dumps(value, allow_nan=False)
        if isinstance(value, tuple) and value and not isinstance(value[0], float | str):
            rows = [json.dumps(row, allow_nan=False) for row in value]
            text = "[\n  " + ",\n  ".join(rows) + "\n ]"
        lines.append(f' "{key}": {text}')
    return "{\n" + ",\n".join(lines) + "\n}\n"


def parse_map(text: str, source: str) -> MapFile:
    """Read the text of a map file; ``source`` begins the message of an error.

    Raises
    ------
    ConfigError
        It is not a map, is damaged, or a newer version wrote it; one line.
    """
    try:
        tables = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{source}: is not JSON, or is cut or damaged: {error}") from None
    if not isinstance(tables, dict) or tables.get("format") != FORMAT:
        raise ConfigError(
            f"{source}: is not a map of xethru-hil; uwb-slam run, demo and replay write one "
            "with --save-map"
        )
    if tables.get("version") != VERSION:
        raise ConfigError(
            f"{source}: is a map of version {tables.get('version')}, and this xethru-hil reads "
            f"version {VERSION}; a newer one wrote it"
        )
    try:
        file = _FILE.validate_python({**tables, "map": tables})
        _check(file)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"][1:])) or "map"
        raise ConfigError(f"{source}: is damaged: {place}: {first['msg']}") from None
    except ValueError as error:
        raise ConfigError(f"{source}: is damaged: {error}") from None
    return file


def _check(file: MapFile) -> None:
    """Raise ValueError for a number that is not finite, and parts that do not fit together."""
    if not all(abs(number) <= MOST_M for number in _numbers(asdict(file))):
        raise ValueError(f"all numbers must be finite, and at most {MOST_M:g}")
    saved = file.map
    ids = [one.id for one in saved.features]
    if len(set(ids)) < len(ids) or max(ids, default=-1) >= saved.next_id:
        raise ValueError("ids of landmarks and walls must differ, and be less than next_id")
    if len({radar.name for radar in saved.radars}) < len(saved.radars):
        raise ValueError("names of radars must differ")
    needed = [f"{axis} {one.id}" for one in saved.landmarks for axis in "xy"]
    needed += [f"{axis} {one.id}" for one in saved.walls for axis in ("phi", "d")]
    labels = [one.label for one in saved.landmarks if one.label is not None]
    if len(set(labels)) < len(labels):
        raise ValueError("labels of landmarks must differ")
    if any(one.added_sigma_m < 0.0 or one.hits < 0 for one in saved.features):
        raise ValueError("added_sigma_m and hits must not be negative")
    if any(abs(cell) > MOST_M for one in saved.walls for cell in one.cells):
        raise ValueError(f"cells must be at most {MOST_M:g}")
    names = set(saved.unknowns)
    if len(names) < len(saved.unknowns) or not names.issuperset(needed):
        raise ValueError("unknowns must name x and y of each landmark and phi and d of each wall")
    if [len(row) for row in saved.covariance] != list(range(1, len(saved.unknowns) + 1)):
        raise ValueError("covariance must have as many rows as unknowns, of 1, 2, 3 ... numbers")
    values = np.linalg.eigvalsh(saved.full_covariance())
    if len(values) and values[0] < -_ROUNDING * values[-1]:
        raise ValueError("covariance has a negative variance")


def _numbers(part: object) -> Iterator[float]:
    """Yield the numbers with a decimal point; ids and counts may be of any size."""
    if isinstance(part, float):
        yield part
    elif isinstance(part, Mapping | tuple):
        for one in part.values() if isinstance(part, Mapping) else part:
            yield from _numbers(one)


def load_map(path: str | Path) -> MapFile:
    """Read a map file.

    Raises
    ------
    ConfigError
        It cannot be read, or `parse_map` refuses it.
    """
    try:
        text = read_bounded(Path(path), _MOST_BYTES).decode()
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the map: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise ConfigError(
            f"{path}: is not a map of xethru-hil, but bytes of another kind"
        ) from None
    return parse_map(text, str(path))


def save_map(path: str | Path, file: MapFile) -> None:
    """Write a map file whole: who reads it finds the one before, or all of this one.

    Raises
    ------
    OSError
        It cannot be written.
    """
    with written_whole(Path(path)) as fresh:
        fresh.write_text(map_text(file), encoding="ascii")
