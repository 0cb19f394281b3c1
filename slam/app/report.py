"""`uwb-slam report`: a recorded session as one HTML page that any browser opens."""

from __future__ import annotations

import json
import math
import sys
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from slam.app.errors import AppError, naming
from slam.app.evaluation import summarise
from slam.app.progress import Progress
from slam.app.replay import LostFrames, replay_session, settings_of
from slam.app.report_data import ReportData
from slam.app.report_html import Page
from slam.app.report_table import summary_rows
from slam.app.run_results import has_truth
from slam.app.run_table import run_rows
from slam.app.runner import RunRecord
from slam.app.session import SessionInfo
from slam.app.session_reader import RecordedSession, open_session
from slam.app.stop import StopFlag
from slam.app.summary import Summary
from slam.app.tum import NS_PER_S
from slam.app.view import refuse_overwriting, session_file
from slam.geometry import transform

REPORT_NAME = "report.html"

_MATCH_M = 0.15
"""As far as a landmark may be from the truth that it is of; the metrics' own limit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportOptions:
    """What the command line of `uwb-slam report` says; `out` is beside the session where None."""

    session: Path
    out: Path | None = None


def run_report(options: ReportOptions, stop: StopFlag) -> None:
    """Replay a session and write its report.

    Raises
    ------
    AppError
        The session cannot be replayed, or the page not be written.
    StopRequestedError
        A signal arrived; nothing was written.
    """
    session = open_session(session_file(options.session))
    out = options.out or session.path.with_name(REPORT_NAME)
    refuse_overwriting(session.path, out)
    text = report_text(session, stop)
    with naming(out):
        out.write_text(text, encoding="utf-8")
    sys.stdout.write(f"{out}\n")


def report_text(session: RecordedSession, stop: StopFlag) -> str:
    """Return the report of a session; the same session gives the same text.

    Raises
    ------
    AppError
        The session cannot be replayed, or no state was estimated in it.
    """
    config = settings_of(session)
    data = ReportData(session.info)
    losses = LostFrames(session.info.radars)
    with ExitStack() as stack:
        stack.callback(data.close)
        progress = Progress(session.info, None, lambda: losses.count)
        stack.callback(progress.close)
        record = replay_session(session, [data, losses, progress], stop.check)
    if not record.results:
        raise AppError(f"{session.path}: no state was estimated, the robot did not move")
    info = session.info
    summary = None
    if has_truth(record):
        summary = summarise(
            record,
            scene=info.scene,
            preset=info.preset,
            seed=info.seed,
            rig=session.rig,
            true_landmarks_m=info.true_landmarks_m,
        )
    page = Page(f"{info.scene}, preset {info.preset}" + _seed_text(info))
    page.origin("simulated data" if info.simulated else "measured data")
    page.note(_what_it_is(session, data))
    lag_states = config.window.size - 1
    _write_numbers(page, info, record, summary, lost_frames=losses.count, lag_states=lag_states)
    _write_figures(page, info, record, summary, data)
    _write_landmarks(page, info, record)
    _write_links(page, info, data)
    _write_parameters(page, info)
    return page.text()


def _write_numbers(
    page: Page,
    info: SessionInfo,
    record: RunRecord,
    summary: Summary | None,
    *,
    lost_frames: int,
    lag_states: int,
) -> None:
    page.heading("Numbers")
    driven = run_rows(info, record, lost_frames)
    if summary is None:
        page.note("Nothing true is known of this drive, so no error can be told.")
        page.numbers(driven)
        return
    rows = summary_rows(
        summary, lag_states=lag_states, wall_s=record.wall_s, lost_frames=lost_frames
    )
    judged = [row for row in rows if row[0] != "speed"]  # the replay's, not the run's
    times = [row for row in driven if row[0] in {"time", "driven"}]
    nis = "-" if summary.nis_mean is None else f"{summary.nis_mean:.2f}"
    page.numbers(
        [*times, *judged, ("NIS, mean", nis, "of true associations over their dof; honest is 1")]
    )


def _write_figures(
    page: Page, info: SessionInfo, record: RunRecord, summary: Summary | None, data: ReportData
) -> None:
    # Half a second of matplotlib, and only after a replay that may fail.
    from slam.app.map_picture import map_figure
    from slam.app.picture import svg_of
    from slam.app.report_figures import draw_consistency, draw_errors

    series = data.series()
    page.heading("Map and trajectory")
    page.picture(
        svg_of(
            lambda figure: map_figure(figure, info, record, summary, info.outlines_m),
            width_in=9.5,
            height_in=6.6,
        ),
        "map with paths and landmarks",
    )
    page.heading("Errors over time" if has_truth(record) else "Over time")
    page.picture(
        svg_of(lambda figure: draw_errors(figure, series), width_in=9.5, height_in=4.4),
        "position errors and number of landmarks over time",
    )
    page.heading("Consistency")
    page.note(
        "How far estimates are off by their own measure. An honest filter stays inside the grey "
        "band 95 % of the time; of one run, states are not independent."
    )
    page.picture(
        svg_of(lambda figure: draw_consistency(figure, series), width_in=9.5, height_in=4.4),
        "NIS and NEES over time with their bands",
    )


def _write_landmarks(page: Page, info: SessionInfo, record: RunRecord) -> None:
    belief = record.results[-1].belief
    page.heading("Landmarks")
    if not belief.landmark_ids:
        page.note("None was found.")
        return
    points = transform(record.world_from_map, belief.landmarks)
    rows = []
    for row, (number, point) in enumerate(zip(belief.landmark_ids, points, strict=True)):
        variances = np.linalg.eigvalsh(belief.landmark_covariance(row))
        sigma_m = math.sqrt(max(float(variances[-1]), 0.0))
        cells = [str(number), f"{point[0]:.4f}", f"{point[1]:.4f}", f"{1e3 * sigma_m:.1f}"]
        if len(info.true_landmarks_m):
            off_m = float(np.linalg.norm(info.true_landmarks_m - point, axis=1).min())
            cells.append(f"{1e3 * off_m:.1f}" if off_m <= _MATCH_M else "none within 150")
        rows.append(cells)
    frame = "world" if len(info.true_landmarks_m) else "map"
    names = ["id", f"x [m, {frame}]", f"y [m, {frame}]", "largest sigma [mm]"]
    if len(info.true_landmarks_m):
        names.append("to nearest truth [mm]")
    page.table(names, rows)


def _write_links(page: Page, info: SessionInfo, data: ReportData) -> None:
    from slam.app.picture import svg_of
    from slam.app.report_figures import draw_links

    page.heading("Links")
    rows = []
    for radar in info.radars:
        count = data.lanes.counts[radar.name]
        share = count.lost / max(count.frames + count.lost, 1)
        rows.append(
            [
                radar.name,
                radar.serial,
                radar.port,
                f"{radar.rate_hz:.4f}",
                str(count.frames),
                f"{count.lost} ({100.0 * share:.2f} %)",
                str(count.longest_gap),
                str(count.faults),
            ]
        )
    page.table(
        ["radar", "serial", "port", "frames/s", "frames", "lost", "most in a row", "faults"], rows
    )
    names = [radar.name for radar in info.radars]
    page.picture(
        svg_of(
            lambda figure: draw_links(figure, names, data.changes, data.duration_s),
            width_in=9.5,
            height_in=0.9 + 0.35 * len(names),
        ),
        "state of each link over time",
    )
    if data.warnings:
        lines = [
            f"{data.seconds(line.t_ns):10.3f} s  {line.radar:<14} {line.text}"
            for line in data.warnings
        ]
        more = data.n_warnings - len(lines)
        if more:
            lines.append(f"... and {more} more in the session's log")
        page.details(f"Warnings: {data.n_warnings}", "\n".join(lines))


def _write_parameters(page: Page, info: SessionInfo) -> None:
    page.heading("Parameters")
    page.table(
        ["radar", "x [m]", "y [m]", "boresight [deg]", "range offset [mm]", "from [m]", "bins"],
        [
            [
                radar.name,
                f"{radar.x_m:.4f}",
                f"{radar.y_m:.4f}",
                f"{math.degrees(radar.yaw_rad):.2f}",
                f"{1e3 * radar.range_offset_m:.1f}",
                f"{radar.range_start_m:.4f}",
                str(radar.n_bins),
            ]
            for radar in info.radars
        ],
    )
    page.note("Mounts in the robot's frame: x forward, y left. First bin in module metres.")
    page.settings("SLAM", json.loads(info.config_json or "{}"))
    page.settings("Wheels, as SLAM was told", info.wheels)
    page.settings("Radars", {radar.name: asdict(radar) for radar in info.radars})
    page.settings("Versions of the run", info.versions)


def _what_it_is(session: RecordedSession, data: ReportData) -> str:
    info = session.info
    words = [f"{session.path.name}: {data.duration_s:.1f} s of {len(info.radars)} radars"]
    if info.started_unix_ns is not None:
        began = datetime.fromtimestamp(info.started_unix_ns / NS_PER_S, UTC)
        words.append(f"begun {began:%Y-%m-%d %H:%M:%S} UTC")
    if "xethru-hil" in info.versions:
        words.append(f"xethru-hil {info.versions['xethru-hil']}")
    if session.cut_at_byte is not None:
        words.append(f"cut at byte {session.cut_at_byte}: this is what is left of it")
    return "; ".join(words) + "."


def _seed_text(info: SessionInfo) -> str:
    return "" if info.seed is None else f", seed {info.seed}"
