"""What a session says about itself: one table of text for the run, one JSON text per radar."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields
from pathlib import Path

import numpy as np

from slam.app.errors import AppError
from slam.app.session import RadarInfo, SessionInfo
from slam.config import SlamConfig

METADATA_NAME = "xethru-hil session"
"""Of the table in the file."""

LENGTH_UNIT = "module metres, c = 3.0e8 m/s"
"""Of a radar's range_start_m and bin_length_m in its text; its mount is in true metres."""

FORMAT = 2
"""Of the file; format 1 was never released."""


def session_table(info: SessionInfo) -> dict[str, str]:
    """Return the table of a run; floats in it are those of the run to the last bit."""
    return {
        "format": str(FORMAT),
        "scene": info.scene,
        "preset": info.preset,
        "seed": "" if info.seed is None else str(info.seed),
        "simulated": json.dumps(info.simulated),
        "time_base": info.time_base,
        "has_detections": json.dumps(info.has_detections),
        "started_unix_ns": "" if info.started_unix_ns is None else str(info.started_unix_ns),
        "true_landmarks_m": json.dumps(info.true_landmarks_m.tolist()),
        "outlines_m": json.dumps([line.tolist() for line in info.outlines_m]),
        "config": info.config_json,
        "wheels": json.dumps(dict(info.wheels)),
        "versions": json.dumps(dict(info.versions)),
    }


def settings_text(config: SlamConfig) -> str:
    """Return SLAM's settings for `SessionInfo.config_json`.

    `SlamConfig.model_validate_json` reads them back the same; pydantic's own text has null for
    infinity, which is not.
    """
    return json.dumps(config.model_dump(mode="json"))


def radar_text(radar: RadarInfo) -> str:
    """Return what a session says of a radar."""
    return json.dumps(asdict(radar) | {"length_unit": LENGTH_UNIT})


def check_format(path: Path, table: Mapping[str, str]) -> None:
    """Check that this version reads the file's format.

    Raises
    ------
    AppError
        The file is of another format; one line.
    """
    number = table.get("format", "1")
    if number == str(FORMAT):
        return
    remedy = "record the session again" if number == "1" else "a newer xethru-hil wrote it"
    raise AppError(
        f"{path}: a session of format {number}; this version reads format {FORMAT}; {remedy}"
    )


def read_session_table(
    path: Path, table: Mapping[str, str], radars: tuple[RadarInfo, ...]
) -> SessionInfo:
    """Read the table of a run back; what older files did not say has its default.

    Raises
    ------
    AppError
        The table makes no sense; one line with the file.
    """
    try:
        seed, started = table["seed"], table.get("started_unix_ns", "")
        return SessionInfo(
            scene=table["scene"],
            preset=table["preset"],
            seed=int(seed) if seed else None,
            radars=radars,
            true_landmarks_m=np.array(
                json.loads(table["true_landmarks_m"]), dtype=np.float64
            ).reshape(-1, 2),
            versions=json.loads(table["versions"]),
            config_json=table.get("config", ""),
            wheels=json.loads(table.get("wheels", "{}")),
            outlines_m=tuple(
                np.array(line, dtype=np.float64).reshape(-1, 2)
                for line in json.loads(table.get("outlines_m", "[]"))
            ),
            simulated=bool(json.loads(table.get("simulated", "true"))),
            time_base=table.get("time_base", "counter"),
            has_detections=bool(json.loads(table.get("has_detections", "false"))),
            started_unix_ns=int(started) if started else None,
        )
    except (KeyError, ValueError, TypeError) as error:
        raise AppError(f"{path}: metadata {METADATA_NAME!r} cannot be read: {error!r}") from None


def read_radar_text(path: Path, topic: str, text: str) -> RadarInfo:
    """Read what a session says of a radar.

    Raises
    ------
    AppError
        The text makes no sense, or its lengths are in another unit; one line with file and topic.
    """
    try:
        facts = json.loads(text)
        unit = facts["length_unit"]
        known = {
            field.name: facts[field.name] for field in fields(RadarInfo) if field.name in facts
        }
    except (ValueError, TypeError, KeyError) as error:
        raise AppError(f"{path}: {topic} cannot be read: {error!r}") from None
    missing = [
        field.name
        for field in fields(RadarInfo)
        if known.get(field.name) is None
        and field.default is MISSING
        and field.default_factory is MISSING
    ]
    if missing:
        raise AppError(f"{path}: {topic} does not tell {', '.join(missing)}")
    if unit != LENGTH_UNIT:
        raise AppError(f"{path}: {topic}: lengths in {unit!r}, expected {LENGTH_UNIT!r}")
    return RadarInfo(**known)
