"""`uwb-slam map`: saved maps as a table, as GeoJSON, and two as one."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from slam.app.errors import UsageError, naming
from slam.app.run.output import mm_text, note, print_table, write_json
from slam.config import ConfigError
from slam.library.joining import find_place, join
from slam.library.saved_map import MapFile, load_map, save_map
from slam.live.errors import AppError
from slam.results import SavedMap
from slam.robust.parameters import BranchRule, WallRule
from slam.robust.walls import wall_spans_m
from xethru_protocol.operating_system import StopFlag

_FRAME = (
    "local metres, x and y as in the map; not longitude and latitude, so nothing places it on Earth"
)


def run_map(stop: StopFlag, *, action: str, files: list[Path], out: Path | None = None) -> None:
    """Show a map, convert it, or join two."""
    try:
        maps = [load_map(path) for path in files]
    except ConfigError as error:
        raise UsageError(str(error)) from None
    with stop.leaving(program="uwb-slam"):
        if action == "join" and out is not None:
            _join(files, maps, out)
        elif action == "convert" and out is not None:
            _convert(maps[0].map, out)
        else:
            _show(files[0], maps[0])


def _show(path: Path, file: MapFile) -> None:
    saved = file.map
    made = ", ".join(f"{key} {value}" for key, value in file.made.items())
    sigmas_m = np.sqrt(saved.landmarks_covariance().diagonal().reshape(-1, 2).sum(axis=1))
    rows = [
        [
            f"landmark {one.id}" + ("" if one.label is None else f", beacon {one.label}"),
            f"{one.x_m:.3f}",
            f"{one.y_m:.3f}",
            mm_text(sigma_m),
            mm_text(one.radius_m),
            str(one.hits),
        ]
        for one, sigma_m in zip(saved.landmarks, sigmas_m.tolist(), strict=True)
    ]
    for wall in saved.walls:
        x, y = wall.d_m * math.cos(wall.phi_rad), wall.d_m * math.sin(wall.phi_rad)
        rows.append([f"wall {wall.id}, foot", f"{x:.3f}", f"{y:.3f}", "-", "-", str(wall.hits)])
    header = ["", "x [m]", "y [m]", "+-", "radius", "frames"]
    print_table(f"{path}: map {file.id}" + (f" ({made})" if made else ""), header, rows)
    names = [
        [radar.name, mm_text(radar.range_offset_m), mm_text(radar.offset_m)]
        for radar in saved.radars
    ]
    print_table("ranges are longer by", ["", "rig file", "and found"], names)


def _convert(saved: SavedMap, out: Path) -> None:
    if out.suffix in {".yaml", ".yml", ".pgm"}:
        raise UsageError(
            f"{out}: a grid as nav2 reads it is made of raw frames, which a map does not have: see "
            "`uwb-slam image`; OUT.geojson has landmarks and walls"
        )
    if out.suffix != ".geojson":
        raise UsageError(f"{out}: give a name that ends in .geojson")
    blocks, cell_m = saved.landmarks_covariance(), WallRule().cell_m
    features = []
    for row, one in enumerate(saved.landmarks):
        at = slice(2 * row, 2 * row + 2)
        known = {"radius_m": one.radius_m, "covariance_m2": blocks[at, at].tolist()}
        features.append(_feature(one.id, "landmark", "Point", [one.x_m, one.y_m], **known))
    for wall in saved.walls:
        spans = wall_spans_m(wall, cell_m).tolist()
        features.append(_feature(wall.id, "wall", "MultiLineString", spans))
    write_json(out, {"type": "FeatureCollection", "coordinates_are": _FRAME, "features": features})
    note(f"{out} has {len(features)} features in {_FRAME}")


def _feature(
    id_: int, kind: str, shape: str, coordinates: list[Any], **known: object
) -> dict[str, object]:
    geometry = {"type": shape, "coordinates": coordinates}
    properties = {"kind": kind, **known}
    return {"type": "Feature", "id": id_, "geometry": geometry, "properties": properties}


def _join(files: list[Path], maps: list[MapFile], out: Path) -> None:
    first, second = maps
    try:
        place = find_place(first.map, second.map, BranchRule())
    except ValueError as error:
        raise AppError(f"{files[0]} and {files[1]} are not joined: {error}") from None
    joined = join(first.map, second.map, place)
    made = {"joined": f"{first.id} {second.id}"}
    with naming(out):
        save_map(out, MapFile(map=joined, made=made, world_from_map=first.world_from_map))
    x, y, heading = place.motion.tolist()
    note(
        f"{out} has {len(joined.landmarks)} landmarks: {len(place.pairs)} are in both maps; "
        f"the second begins at {x:.3f} {y:.3f} m, {math.degrees(heading):.2f} degrees in the first"
    )
