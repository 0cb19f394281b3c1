"""`uwb-slam calibrate`: offsets, mounts, gains and pulses from a recorded drive past reflectors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, StrictFloat
from threadpoolctl import threadpool_limits

from emulator.scene.scene import Scene, SceneError, load_scene
from slam.app.errors import UsageError
from slam.app.rig.rig_files import rounded_pulse, write_rig
from slam.app.run.output import print_progress, print_text
from slam.calibration.calibration import Calibration, Drive, calibrate, make_drive
from slam.calibration.observability import (
    OFFSET_LIMIT_M,
    GainEstimate,
    WeakDirection,
    estimate_gains,
    poor_drive,
    unseen_reflectors,
    weak_directions,
)
from slam.calibration.tracks import UNASSIGNED, RangeSet
from slam.config import FrontEnd, SlamConfig, override
from slam.frames import Detection, RadarFrame
from slam.front_end.matched_filter import MatchedFilterDetector
from slam.front_end.pulse_estimation import PulseEstimator
from slam.geometry import Rig
from slam.library.rig_files import RigFile, RigRadar, RigWheels
from slam.live.errors import AppError
from slam.live.odometry_track import OdometryTrack, TumSample
from slam.live.session.reader import RecordedSession, open_session
from xethru_protocol.operating_system import StopFlag, json_text, one_line
from xethru_protocol.transport import is_network_port
from xethru_protocol.validation import load_toml

Array = NDArray[np.float64]
_Place = Annotated[StrictFloat, Field(allow_inf_nan=False)]

_FRONT_END = override(
    SlamConfig(),
    {
        "detection.front_end": FrontEnd.JOINT.value,
        # The antennas' leakage ends before; rods are followed farther than preset `paper` maps.
        "detection.min_range_m": 0.3,
        "detection.max_range_m": 2.5,
    },
)
_YAW_LIMIT_DEG = 2.0
_GAIN_LIMIT_DB = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _CalibrationReport:
    drive: Drive
    calibration: Calibration
    gains: GainEstimate
    weak: tuple[WeakDirection, ...]
    poor: tuple[str, ...]
    pulses: PulseEstimator


def run_calibrate(
    stop: StopFlag,
    *,
    session: Path,
    reflectors: str | None,
    truth: str | None,
    rig: Path | None,
    as_json: bool,
) -> None:
    """Calibrate from a session file and print the table; write the rig file if asked for."""
    known = None if reflectors is None else _read_reflectors(reflectors)
    scene = None if truth is None else _scene(truth)
    recorded = open_session(session, stop)
    # refuse what can be refused before minutes of work
    _planted(recorded.rig, scene)
    if rig is not None:
        _check_rig_place(rig, session)
        if not all(radar.serial for radar in recorded.info.radars):
            raise AppError(
                f"{session}: does not say which modules measured, and a rig file names each by its "
                "serial number; leave --rig out"
            )
    detector = _detector_of(recorded, stop)
    report = _report_of(_drive_of(recorded, detector, stop), known, detector.estimator)
    if recorded.cut_at_byte is not None:
        cut = f"{session}: cut at byte {recorded.cut_at_byte}; read up to there"
        print_progress(cut)
    planted = _planted(report.drive.rig, scene)
    try:
        if rig is not None:
            write_rig(rig, _rig_file(recorded, report))
    finally:  # behind the file, which no output can cost; and also if it cannot be written
        if as_json:
            print_text(json_text(_facts(report, planted), indent=2, allow_nan=False))
        else:
            print_text("\n".join(one_line(line) for line in _lines(report, planted)))


def _detector_of(session: RecordedSession, stop: StopFlag) -> MatchedFilterDetector:
    """Return a detector that has estimated the modules' pulses from all frames of a session."""
    detector = MatchedFilterDetector(_FRONT_END, [mount.pulse for mount in session.rig.mounts])
    for record in session.records():
        if isinstance(record, RadarFrame):
            stop.check()
            detector.learn(record)
    return detector


def _drive_of(session: RecordedSession, detector: MatchedFilterDetector, stop: StopFlag) -> Drive:
    """Detect the echoes of a session."""
    samples: list[TumSample] = []
    detections: list[Detection] = []
    has_frame = False
    for record in session.records():
        if isinstance(record, RadarFrame):
            stop.check()
            has_frame = True
            detections += [each for each in detector.detect(record) if not each.saturated]
        elif isinstance(record, TumSample):
            samples.append(record)
    if not has_frame:
        raise AppError(f"{session.path}: holds no radar frame; record a longer drive")
    if len(samples) < 2:
        raise AppError(f"{session.path}: holds no odometry to speak of; record a longer drive")
    track = OdometryTrack(samples)
    stamps_ns = [sample.t_ns for sample in track]
    return make_drive(
        session.rig,
        np.array(stamps_ns, dtype=np.int64),
        np.array([track.pose_at(t_ns) for t_ns in stamps_ns]),
        RangeSet.of(detections),
    )


def _report_of(drive: Drive, known_m: Array | None, pulses: PulseEstimator) -> _CalibrationReport:
    """Calibrate, and find out what the drive does not determine."""
    with threadpool_limits(limits=1):
        calibration = calibrate(drive, known_m=known_m)
        names = [mount.name for mount in drive.rig.mounts]
        return _CalibrationReport(
            drive=drive,
            calibration=calibration,
            gains=estimate_gains(drive, calibration),
            weak=weak_directions(calibration, names),
            poor=poor_drive(drive, calibration)
            + unseen_reflectors(calibration, 0 if known_m is None else len(known_m)),
            pulses=pulses,
        )


class _Reflector(BaseModel):
    model_config = ConfigDict(extra="forbid")

    x_m: _Place
    y_m: _Place
    name: str = ""


class _Reflectors(BaseModel):
    """A file of places, or a scene, whose keys are other ones."""

    reflectors: tuple[_Reflector, ...] | None = None


def _read_reflectors(name: str) -> Array:
    """Return known reflectors, shape (k, 2) [m], from a TOML file or a scene.

    The file holds `[[reflectors]]` tables with x_m and y_m, in a frame in which the robot starts
    at the origin and looks along x, to about 10 cm and 6 degrees.
    """
    path, file = Path(name), _Reflectors()
    if path.suffix == ".toml" and path.is_file():
        file = load_toml(_Reflectors, path, source=name, what="reflectors", error=AppError)
    places = _scene(name).targets if file.reflectors is None else file.reflectors
    return np.array([(one.x_m, one.y_m) for one in places]).reshape(-1, 2)


def _rig_file(session: RecordedSession, report: _CalibrationReport) -> RigFile:
    """Return the calibrated rig as a file; what the drive does not determine stays as it was."""
    is_known = report.calibration.offset_sigmas_m <= OFFSET_LIMIT_M
    radars = []
    for index, radar in enumerate(session.info.radars):
        shift = report.calibration.mount_shifts_m[index] if is_known[index] else np.zeros(2)
        pulse = report.pulses.pulse(index)
        has_gain = report.gains.gain_sigmas_db[index] <= _GAIN_LIMIT_DB
        radars.append(
            RigRadar(
                name=radar.name,
                serial=radar.serial,
                x_m=radar.x_m + float(shift[0]),
                y_m=radar.y_m + float(shift[1]),
                yaw_deg=math.degrees(radar.yaw_rad),
                range_offset_m=float(report.calibration.offsets_m[index])
                if is_known[index]
                else radar.range_offset_m,
                phase_offset_deg=math.degrees(radar.phase_offset_rad),
                gain_db=float(report.gains.gains_db[index]) if has_gain else radar.gain_db,
                port=radar.port if is_network_port(radar.port) else None,
                pulse=None if pulse is None else rounded_pulse(pulse),
            )
        )
    wheels = RigWheels.of(session.wheels) if session.info.wheels else RigWheels()
    return RigFile(radars=tuple(radars), wheels=wheels)


def _check_rig_place(rig: Path, session: Path) -> None:
    """Refuse a rig file that cannot be written, or that would replace the session."""
    if rig.exists() and rig.samefile(session):
        raise UsageError(f"--rig: {rig} is the session itself; name another file")
    if rig.is_dir():
        raise UsageError(f"--rig: {rig} is a folder; name a file")
    if not rig.parent.is_dir():
        raise UsageError(f"--rig: there is no folder {rig.parent} to write into")


def _scene(name: str) -> Scene:
    try:
        return load_scene(name)
    except SceneError as error:
        raise UsageError(str(error)) from None


def _planted(rig: Rig, scene: Scene | None) -> Mapping[str, tuple[float, float]]:
    """Return planted offset [m] and gain less the mean [dB] of each radar of the rig."""
    if scene is None:
        return {}
    specs = {radar.name: radar for radar in scene.radars}
    unknown = [mount.name for mount in rig.mounts if mount.name not in specs]
    if unknown:
        raise UsageError(f"--truth: scene {scene.name} has no radar {unknown[0]}")
    mean_db = float(np.mean([specs[mount.name].gain_db for mount in rig.mounts]))
    return {
        mount.name: (specs[mount.name].range_offset_m, specs[mount.name].gain_db - mean_db)
        for mount in rig.mounts
    }


def _facts(
    report: _CalibrationReport, planted: Mapping[str, tuple[float, float]]
) -> dict[str, Any]:
    calibration, gains = report.calibration, report.gains
    radars = []
    for index, mount in enumerate(report.drive.rig.mounts):
        row = {
            "name": mount.name,
            "range_offset_m": float(calibration.offsets_m[index]),
            "range_offset_sigma_m": float(calibration.offset_sigmas_m[index]),
            "mount_shift_m": calibration.mount_shifts_m[index].tolist(),
            "mount_sigma_m": calibration.mount_sigmas_m[index].tolist(),
            "gain_db": float(gains.gains_db[index]),
            "gain_sigma_db": float(gains.gain_sigmas_db[index]),
            "yaw_shift_deg": math.degrees(gains.yaws_rad[index]),
            "yaw_sigma_deg": math.degrees(gains.yaw_sigmas_rad[index]),
            "told": bool(calibration.offset_sigmas_m[index] <= OFFSET_LIMIT_M),
            "pulse_echoes": report.pulses.echoes(index),
            "pulse_stored": report.pulses.pulse(index) is not None,
        }
        if (estimate := report.pulses.estimate(index)) is not None:
            row |= {
                "pulse_off_nominal": report.pulses.off_nominal(estimate),
                "pulse_error": estimate.relative_error,
            }
        if mount.name in planted:
            offset_m, gain_db = planted[mount.name]
            row |= {"planted_offset_m": offset_m, "planted_gain_db": gain_db}
        radars.append(row)
    return {
        "radars": radars,
        "landmarks": len(calibration.landmarks_m),
        "ranges": len(report.drive.ranges),
        "ranges_used": _used(report),
        "residual_rms_m": None if math.isnan(calibration.sigma_m) else calibration.sigma_m,
        "limit_m": OFFSET_LIMIT_M,
        "weak_directions": [
            {
                "sigma_m": weak.sigma_m,
                "direction": weak.direction.tolist(),
                "words": weak.description,
                "remedy": weak.remedy,
            }
            for weak in report.weak
        ],
        "poor_drive": list(report.poor),
    }


def _used(report: _CalibrationReport) -> int:
    return int(np.count_nonzero(report.calibration.landmark != UNASSIGNED))


def _lines(report: _CalibrationReport, planted: Mapping[str, tuple[float, float]]) -> Iterable[str]:
    calibration, gains = report.calibration, report.gains
    fit = "" if math.isnan(calibration.sigma_m) else f", to {1e3 * calibration.sigma_m:.2f} mm rms"
    yield (
        f"{_used(report)} of {len(report.drive.ranges)} ranges fit to "
        f"{len(calibration.landmarks_m)} reflectors{fit}; beside each value its standard deviation"
    )
    head = f"{'radar':<14}{'offset mm':>16}{'mount moved x, y mm':>26}{'gain dB':>16}"
    head += f"{'turned deg':>16}"
    yield head + (f"{'planted mm':>12}{'error mm':>10}" if planted else "")
    for index, mount in enumerate(report.drive.rig.mounts):
        offset, sigma = 1e3 * calibration.offsets_m[index], 1e3 * calibration.offset_sigmas_m[index]
        (dx, dy), (sx, sy) = (
            1e3 * calibration.mount_shifts_m[index],
            1e3 * calibration.mount_sigmas_m[index],
        )
        mark = "?" if sigma > 1e3 * OFFSET_LIMIT_M else " "
        line = f"{mount.name:<14}{f'{offset:+.2f} +- {sigma:.2f}{mark}':>16}"
        line += f"{f'{dx:+.1f} +- {sx:.1f}, {dy:+.1f} +- {sy:.1f}':>26}"
        gain = _with_sigma(gains.gains_db[index], gains.gain_sigmas_db[index], _GAIN_LIMIT_DB)
        turn_deg, spread_deg = (
            math.degrees(gains.yaws_rad[index]),
            math.degrees(gains.yaw_sigmas_rad[index]),
        )
        line += f"{gain:>16}{_with_sigma(turn_deg, spread_deg, _YAW_LIMIT_DEG):>16}"
        if planted:
            truth_mm = 1e3 * planted[mount.name][0]
            line += f"{truth_mm:+12.2f}{offset - truth_mm:+10.2f}"
        yield line
    yield from _pulse_lines(report)
    yield "offset: added to every range; moved, turned: off the nominal rig, the turn as amplitudes"
    yield "show it; gain: over the mean of all radars"
    marked = bool(np.any(calibration.offset_sigmas_m > OFFSET_LIMIT_M))
    if marked:
        yield (
            f"? not known to {1e3 * OFFSET_LIMIT_M:g} mm (one standard deviation): a rig file "
            "keeps the nominal offset and mount"
        )
    yield from report.poor
    if marked:
        yield from dict.fromkeys(weak.description for weak in report.weak)
        for remedy in dict.fromkeys(weak.remedy for weak in report.weak):
            yield f"remedy: {remedy}"


def _pulse_lines(report: _CalibrationReport) -> Iterable[str]:
    pulses = report.pulses
    for index, mount in enumerate(report.drive.rig.mounts):
        estimate = pulses.estimate(index)
        if estimate is None:
            text = f"{pulses.echoes(index)} isolated strong echoes are too few for an estimate"
        else:
            off = f"{100 * pulses.off_nominal(estimate):.1f}"
            text = f"{off} +- {100 * estimate.relative_error:.1f} % off the data sheet's"
        stored = "" if pulses.pulse(index) is None else "; stored in a rig file"
        yield f"pulse of {mount.name}: {text}{stored}"


def _with_sigma(value: float, sigma: float, limit: float) -> str:
    """Return a value with its deviation, or "not seen" if that is above the limit."""
    return f"{value:+.2f} +- {sigma:.2f}" if sigma <= limit else "not seen"
