"""What describes a session: the table of the run, and each of its radars."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import TypeAdapter, ValidationError

from slam.config import SlamConfig
from slam.live.errors import AppError
from slam.live.session_records import RadarInfo, SessionInfo
from xethru_protocol.validation import reason_of, shown

METADATA_NAME = "xethru-hil session"
SESSION_TOPIC = "/session/info"
"""Latched and repeated: the table of the run as JSON, with the names of its radars."""

GAP_TOPIC = "/session/gap"
"""Where `repair` left something out: a `Gap` as JSON, before what follows it."""

LENGTH_UNIT = "module metres, c = 3.0e8 m/s"
"""Of a radar's range_start_m and bin_length_m; its mount is in true metres."""

FORMAT = 2
"""Format 1 was never released."""


def session_table(info: SessionInfo) -> dict[str, str]:
    """Return the table of a run; floats in it are those of the run to the last bit."""
    rare = {"odometry_covariance": "true"} if info.odometry_covariance else {}
    return rare | {
        "format": str(FORMAT),
        "radars": json.dumps([radar.name for radar in info.radars]),
        "scene": info.scene,
        "preset": info.preset,
        "seed": "" if info.seed is None else str(info.seed),
        "simulated": json.dumps(info.simulated),
        "time_base": info.time_base,
        "has_detections": json.dumps(info.has_detections),
        "started_unix_ns": "" if info.started_unix_ns is None else str(info.started_unix_ns),
        "odometry_clock": info.odometry_clock,
        "true_landmarks_m": json.dumps(info.true_landmarks_m.tolist()),
        "outlines_m": json.dumps([line.tolist() for line in info.outlines_m]),
        "config": info.config_json,
        "wheels": json.dumps(dict(info.wheels)),
        "versions": json.dumps(dict(info.versions)),
        "constants": json.dumps(dict(info.constants)),
        **({"map": info.map_json} if info.map_json else {}),
    }


def settings_text(config: SlamConfig) -> str:
    """Return SLAM's settings for `SessionInfo.config_json`.

    Pydantic's own text has null for infinity, which `SlamConfig.model_validate_json` refuses.
    """
    return json.dumps(config.model_dump(mode="json"))


def radar_text(radar: RadarInfo) -> str:
    return json.dumps(asdict(radar) | {"length_unit": LENGTH_UNIT})


def check_format(path: Path, table: Mapping[str, str]) -> None:
    """Raise AppError if the file is of another format."""
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
    """Read the table of a run; keys that older files lack have their defaults.

    Raises
    ------
    AppError
        The table makes no sense.
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
            constants=json.loads(table.get("constants", "{}")),
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
            odometry_clock=table.get("odometry_clock", ""),
            odometry_covariance=bool(json.loads(table.get("odometry_covariance", "false"))),
            map_json=table.get("map", ""),
        )
    except (KeyError, ValueError, TypeError) as error:
        raise AppError(
            f'{path}: metadata "{METADATA_NAME}" cannot be read: {reason_of(error)}'
        ) from None


_T = TypeVar("_T")


def checked(kind: TypeAdapter[_T], value: object) -> _T:
    """Return what JSON holds as the kind that it must be; ValueError of one line if it is not."""
    try:
        return kind.validate_python(value)
    except ValidationError as error:
        problems = (f"{'.'.join(map(str, each['loc']))}: {each['msg']}" for each in error.errors())
        raise ValueError("; ".join(problems)) from None


_RADAR = TypeAdapter(RadarInfo)


def read_radar_text(path: Path, topic: str, text: str) -> RadarInfo:
    """Read the description of a radar in a session; keys of other versions are ignored.

    Raises
    ------
    AppError
        The text makes no sense, or its lengths are in another unit.
    """
    try:
        facts = json.loads(text)
        if isinstance(facts, dict) and facts.get("x_m") is None:
            raise AppError(
                f"{path}: is a recording of modules and not a session: it does not say where the "
                "radars are mounted; `xethru view` shows it"
            )
        unit = facts["length_unit"]
        radar = checked(_RADAR, facts)
    except (ValueError, TypeError, KeyError) as error:
        raise AppError(f"{path}: {topic} cannot be read: {reason_of(error)}") from None
    if unit != LENGTH_UNIT:
        raise AppError(f"{path}: {topic}: lengths in {shown(unit)}, must be in {LENGTH_UNIT}")
    return radar
