"""What is in a session: messages of ROS 2, the table of the run, the description of a radar.

The row of a state, float64, in /slam/state::

    n_landmarks, n_nis,
    truth (3), odometry (3), estimate (3), world_from_map (3),
    pose_covariance (9, row by row),
    n_landmarks times: id, x, y, cov_xx, cov_xy, cov_yx, cov_yy,
    n_nis times: NIS per degree of freedom

in the units and frames of `Snapshot`; an unknown truth is NaN. The row of a smoothed run, float64,
in /slam/smoothed, at the time of its last state::

    n_states, n_landmarks,
    n_states times: dt_ns, x, y, heading, covariance (9, row by row),
    n_landmarks times: id, x, y, cov_xx, cov_xy, cov_yx, cov_yy

in the map frame; dt_ns is a time less that of the last state. What led to the state is in
/slam/step, see `slam.app.session.steps`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import AppError
from slam.app.records import RadarInfo, SessionInfo, Snapshot
from slam.app.session.constants import slam_constants
from slam.config import SlamConfig, WheelNoise, load_preset
from slam.geometry import Mount, ReceivedPulse
from slam.results import SmoothedRun
from xethru_protocol.validation import reason_of, shown

_COUNTS = 2
_PER_LANDMARK = 7


def state_row(snapshot: Snapshot) -> NDArray[np.float64]:
    """Return the row of a state, shape (23 + 7 n_landmarks + n_nis,)."""
    n_landmarks, n_nis = len(snapshot.landmark_ids), len(snapshot.nis_per_dof)
    parts = (
        [n_landmarks, n_nis],
        snapshot.truth,
        snapshot.odometry,
        snapshot.estimate,
        snapshot.world_from_map,
        snapshot.pose_covariance.ravel(),
        _landmark_rows(snapshot).ravel(),
        snapshot.nis_per_dof,
    )
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def snapshot_of(counter: int, t_ns: int, row: NDArray[np.float64]) -> Snapshot:
    """Return the state that a row holds.

    Raises
    ------
    ValueError
        The row's length does not fit its first two numbers.
    """
    n_landmarks, n_nis = (int(value) for value in row[:_COUNTS])
    ends = np.cumsum([_COUNTS, 3, 3, 3, 3, 9, _PER_LANDMARK * n_landmarks, n_nis])
    if min(n_landmarks, n_nis) < 0 or ends[-1] != len(row):
        raise ValueError(f"a state of {len(row)} numbers says it has {ends[-1]}")
    _, truth, odometry, estimate, world_from_map, covariance, landmarks, nis, _ = np.split(
        row, ends
    )
    ids, landmarks_m, covariances_m2 = _landmarks_of(landmarks)
    return Snapshot(
        counter=counter,
        t_ns=t_ns,
        truth=truth,
        odometry=odometry,
        estimate=estimate,
        world_from_map=world_from_map,
        pose_covariance=covariance.reshape(3, 3),
        landmark_ids=ids,
        landmarks_m=landmarks_m,
        landmark_covariances_m2=covariances_m2,
        nis_per_dof=tuple(nis.tolist()),
    )


_PER_STATE = 13


def smoothed_row(smoothed: SmoothedRun) -> NDArray[np.float64]:
    """Return the row of a smoothed run, shape (2 + 13 n_states + 7 n_landmarks,)."""
    states = np.column_stack(
        [
            smoothed.t_ns - smoothed.t_ns[-1],
            smoothed.poses,
            smoothed.pose_covariances.reshape(-1, 9),
        ]
    )
    landmarks = _landmark_rows(smoothed)
    head = [float(len(states)), float(len(landmarks))]
    return np.concatenate([head, states.ravel(), landmarks.ravel()])


def smoothed_of(t_ns: int, row: NDArray[np.float64]) -> SmoothedRun:
    """Return the smoothed run that a row holds.

    Raises
    ------
    ValueError
        The row's length does not fit its first two numbers, or one of them is not finite.
    """
    if not np.isfinite(row).all():
        raise ValueError("a smoothed run has numbers that are not finite")
    n_states, n_landmarks = (int(value) for value in row[:_COUNTS])
    ends = np.cumsum([_COUNTS, _PER_STATE * n_states, _PER_LANDMARK * n_landmarks])
    if min(n_states - 1, n_landmarks) < 0 or ends[-1] != len(row):
        raise ValueError(f"a smoothed run of {len(row)} numbers says it has {ends[-1]}")
    _, states, landmarks, _ = np.split(row, ends)
    states = states.reshape(-1, _PER_STATE)
    ids, landmarks_m, covariances_m2 = _landmarks_of(landmarks)
    return SmoothedRun(
        t_ns=t_ns + states[:, 0].astype(np.int64),
        poses=states[:, 1:4],
        pose_covariances=states[:, 4:].reshape(-1, 3, 3),
        landmark_ids=tuple(ids.tolist()),
        landmarks_m=landmarks_m,
        landmark_covariances_m2=covariances_m2,
    )


def _landmark_rows(of: Snapshot | SmoothedRun) -> NDArray[np.float64]:
    """Return id, place and covariance of each landmark, shape (n_landmarks, 7)."""
    return np.column_stack(
        [
            np.asarray(of.landmark_ids, dtype=np.float64),
            of.landmarks_m.reshape(-1, 2),
            of.landmark_covariances_m2.reshape(-1, 4),
        ]
    )


def _landmarks_of(
    numbers: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return ids (n,), places (n, 2) [m] and covariances (n, 2, 2) [m^2] of 7 n numbers."""
    rows = numbers.reshape(-1, _PER_LANDMARK)
    return rows[:, 0].astype(np.int64), rows[:, 1:3], rows[:, 3:].reshape(-1, 2, 2)


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
    return {
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
        )
    except (KeyError, ValueError, TypeError) as error:
        raise AppError(
            f'{path}: metadata "{METADATA_NAME}" cannot be read: {reason_of(error)}'
        ) from None


def read_radar_text(path: Path, topic: str, text: str) -> RadarInfo:
    """Read the description of a radar in a session.

    Raises
    ------
    AppError
        The text makes no sense, or its lengths are in another unit.
    """
    try:
        facts = json.loads(text)
        unit = facts["length_unit"]
        known = {
            field.name: facts[field.name] for field in fields(RadarInfo) if field.name in facts
        }
        if (pulse := known.get("pulse")) is not None:
            samples = {key: tuple(map(float, pulse[key])) for key in ("real", "imaginary")}
            known["pulse"] = ReceivedPulse(**(pulse | samples))
    except (ValueError, TypeError, KeyError) as error:
        raise AppError(f"{path}: {topic} cannot be read: {reason_of(error)}") from None
    missing = [
        field.name
        for field in fields(RadarInfo)
        if field.default is MISSING and known.get(field.name) is None
    ]
    if missing:
        raise AppError(f"{path}: {topic} lacks {', '.join(missing)}")
    if unit != LENGTH_UNIT:
        raise AppError(f"{path}: {topic}: lengths in {shown(unit)}, must be in {LENGTH_UNIT}")
    return RadarInfo(**known)


def imported_info(
    source: Path,
    radars: tuple[RadarInfo, ...],
    preset: str,
    *,
    time_base: str,
    has_detections: bool = False,
) -> SessionInfo:
    """Return the head of a session made of a file; it is named after the file."""
    return SessionInfo(
        scene=source.resolve().stem,
        preset=preset,
        seed=None,
        radars=radars,
        true_landmarks_m=np.zeros((0, 2)),
        versions={},
        config_json=settings_text(load_preset(preset)),
        constants=slam_constants(),
        wheels=asdict(WheelNoise()),
        simulated=False,
        time_base=time_base,
        has_detections=has_detections,
    )


def imported_radar(
    mount: Mount, *, range_start_m: float, bin_length_m: float, n_bins: int, rate_hz: float
) -> RadarInfo:
    """Return a radar with unknown serial number, port and settings; module metres."""
    return RadarInfo(
        name=mount.name,
        serial="",
        port="",
        x_m=mount.x_m,
        y_m=mount.y_m,
        yaw_rad=mount.yaw_rad,
        range_offset_m=mount.range_offset_m,
        range_start_m=range_start_m,
        bin_length_m=bin_length_m,
        n_bins=n_bins,
        rate_hz=rate_hz,
        settings={},
        phase_offset_rad=mount.phase_offset_rad,
        pulse=mount.pulse,
    )
