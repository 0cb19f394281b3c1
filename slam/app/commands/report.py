"""`uwb-slam report`: a recorded session as one HTML page that any browser opens."""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from slam.app.errors import naming
from slam.app.rig.echo_arcs import bscan_picture, n_shown_bins
from slam.app.run.output import mm_text, print_text, run_rows, summary_rows
from slam.app.run.pictures import (
    ESTIMATE,
    LANDMARK,
    LINK_COLOURS,
    NARROW_IN,
    ODOMETRY,
    PALE_INK,
    SMOOTHED,
    draw_image,
    draw_map,
    label,
    svg_of,
)
from slam.app.run.radar_image import NoImageError, path_of, session_image
from slam.app.run.replay import play, refuse_overwriting
from slam.app.run.result_files import REPORT
from slam.app.run.runner import LinkChange, LinkState, LinkStates, RunRecord
from slam.app.run.summary import (
    POSE_DOF,
    StateNumbers,
    Summary,
    bands_95,
    smoothed_errors,
    state_numbers,
    summarise,
    world_from_odom,
)
from slam.frames import RadarFrame
from slam.geometry import transform
from slam.library.evaluation import LANDMARK_MATCH_M
from slam.live.errors import AppError
from slam.live.odometry_track import NS_PER_S
from slam.live.session.reader import RecordedSession, open_session
from slam.live.session_records import LogLine, Scan, SessionInfo, SessionObserver, Snapshot
from slam.robust.solver.growing_arrays import PackedRows
from xethru_protocol.operating_system import StopFlag, each_line, one_line, written_whole

_KEPT_WARNINGS = 200


_Smoothed = tuple[NDArray[np.float64], NDArray[np.float64]]
"""See `smoothed_errors`."""


_ECHO_ROWS = 800
"""Most frames of a radar in the report: of a longer drive every second, every fourth and so on."""
_GREYS = 32
"""Of a B-scan: noise in all 256 would make the page twice as large."""


class _Echoes:
    """Collects frames by radar, their near samples only, so many that a picture shows them."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._step = 1
        self._n_scans = 0
        self._rows: dict[int, list[RadarFrame]] = {}

    def on_scan(self, scan: Scan) -> None:
        if self._n_scans % self._step == 0:
            for frame in scan.frames:
                n_bins = n_shown_bins(len(frame.samples), frame.range_start_m, frame.bin_length_m)
                kept = replace(frame, samples=frame.samples[:n_bins].copy())
                self._rows.setdefault(frame.radar, []).append(kept)
            if max(map(len, self._rows.values()), default=0) >= _ECHO_ROWS:
                self._step *= 2
                self._rows = {radar: rows[::2] for radar, rows in self._rows.items()}
        self._n_scans += 1

    def write(self, page: _Page, record: RunRecord) -> None:
        page.heading("Echoes")
        if not self._rows:
            page.note("The session holds no frames.")
            return
        page.note(
            "What the radars received, their constant part removed; bright is strong, from -62 to "
            "-30 dB of full scale. A target that the robot passes is a curved line."
        )
        page.picture(
            "B-scan of each radar: echoes over time and range",
            self._draw,
            record,
            height_in=0.6 + 1.5 * len(self._rows),
            narrow_height_in=0.6 + 1.5 * len(self._rows),
        )

    def _draw(self, figure: Figure, record: RunRecord) -> None:
        panels = figure.subplots(len(self._rows), 1, sharex=True, squeeze=False).ravel()
        for axes, (radar, rows) in zip(panels, sorted(self._rows.items()), strict=True):
            newest = rows[-1]
            alike = [row for row in rows if row.samples.shape == newest.samples.shape]
            picture = bscan_picture(
                np.stack([row.samples for row in alike]), newest.range_start_m, newest.bin_length_m
            )
            ends_s = _seconds(record, [alike[0].t_ns, alike[-1].t_ns])
            first_m, step_m = newest.range_start_m, newest.bin_length_m
            axes.imshow(
                picture.T // (256 // _GREYS),
                aspect="auto",
                origin="lower",
                cmap="viridis",
                vmin=0,
                vmax=_GREYS - 1,
                extent=(*ends_s, first_m + step_m, first_m + step_m * picture.shape[1]),
            )
            label(axes, self._names[radar], "", "range [m]")
            axes.grid(visible=False)
        panels[-1].set_xlabel(_TIME)


class _ReportData(SessionObserver):
    """Collects what the report of a run shows.

    Attributes
    ----------
    links, changes
        The links, and every change of their states.
    warnings, n_warnings
        The first warnings of the log, and how many there were.
    """

    def __init__(self, info: SessionInfo) -> None:
        self.links = LinkStates(info.radars)
        self.echoes = _Echoes([radar.name for radar in info.radars])
        self.changes: list[LinkChange] = []
        self.warnings: list[LogLine] = []
        self.n_warnings = 0
        self._end_ns = 0
        self._rows = PackedRows(np.dtype(np.float64), len(StateNumbers._fields))
        self._odom: NDArray[np.float64] | None = None

    def on_scan(self, scan: Scan) -> None:
        self._end_ns = scan.t_ns
        self.echoes.on_scan(scan)
        self.changes += self.links.on_scan(scan)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        if self._odom is None:
            self._odom = world_from_odom(snapshot)
        self._rows.append(state_numbers(snapshot, self._odom))

    def on_log(self, line: LogLine) -> None:
        self.changes += self.links.on_log(line)
        if line.warning:
            self.n_warnings += 1
            if len(self.warnings) < _KEPT_WARNINGS:
                self.warnings.append(line)

    def close(self) -> None:
        self.changes += self.links.end(self._end_ns)

    def numbers(self) -> StateNumbers:
        return StateNumbers(*self._rows.rows.T)


def _seconds(record: RunRecord, t_ns: ArrayLike) -> NDArray[np.float64]:
    """Return session times as times since the first scan; what was before it counts as 0."""
    return np.asarray(np.maximum(np.asarray(t_ns) - record.start_ns, 0) / NS_PER_S)


_MOST_COLUMNS = 5
"""Of a table that is one on narrow screens, too; others become a block per row."""

_STYLE = """\
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; color: #20242a; background: #fff;
       max-width: 62rem; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.6rem; margin: 0 0 .2rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #dfe3e8; }
p.note { color: #6a707a; margin: .3rem 0 .8rem; }
p.verdict { font-size: 1.1rem; margin: .6rem 0 .3rem; }
p.origin { display: inline-block; padding: .1rem .6rem; border-radius: .6rem; margin: .3rem 0;
           background: #fff3d6; color: #6b4b00; font-weight: 600; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
div.wide { overflow-x: auto; }
th, td { text-align: left; padding: .25rem .9rem .25rem 0; vertical-align: top; }
th { color: #6a707a; font-weight: 500; border-bottom: 1px solid #dfe3e8; }
td.value { font-weight: 600; }
div.wide td, div.wide th, td.value { white-space: nowrap; }
div.wide td:last-child { white-space: normal; overflow-wrap: anywhere; }
img { max-width: 100%; height: auto; display: block; margin: .6rem 0; }
pre { background: #f6f7f9; padding: .8rem; overflow-x: auto; font-size: .82rem; line-height: 1.35; }
details { margin: .5rem 0; }
summary { cursor: pointer; }
@media (max-width: 600px) {
  body { margin: 1rem auto; padding: 0 .9rem; }
  th, td { padding-right: .6rem; }
  h1, p { overflow-wrap: anywhere; }
  div.wide th { white-space: normal; }
  div.cards table, div.cards tbody { display: block; }
  div.cards tr { display: grid; grid-template-columns: repeat(3, 1fr);
                 padding: .25rem 0; border-bottom: 1px solid #dfe3e8; }
  div.cards tr:first-child { display: none; }
  div.cards td { padding: 0 .4rem .1rem 0; white-space: normal; overflow-wrap: anywhere; }
  div.cards td:last-child { grid-column-end: -1; }
  div.cards td::before { content: attr(data-name); display: block; font-size: .75rem;
                        line-height: 1.2; color: #6a707a; }
}
"""


def escape(text: str, *, quote: bool = True) -> str:
    """Return text of a file for HTML, its control characters written out."""
    return html.escape(each_line(text), quote)


class _Page:
    """Collects the parts of a page, in order."""

    def __init__(self, title: str) -> None:
        self._title = escape(title)
        self._parts: list[str] = []

    def heading(self, text: str) -> None:
        self._parts.append(f"<h2>{escape(text)}</h2>")

    def note(self, text: str, kind: str = "note") -> None:
        self._parts.append(f'<p class="{kind}">{escape(text)}</p>')

    def picture(
        self,
        alt: str,
        draw: Callable[..., None],
        *arguments: object,
        height_in: float,
        narrow_height_in: float,
    ) -> None:
        """Add what `draw(figure, *arguments)` draws, drawn anew for narrow screens."""
        wide = svg_of(draw, *arguments, height_in=height_in)
        narrow = svg_of(draw, *arguments, height_in=narrow_height_in, width_in=NARROW_IN)
        self._parts.append(
            f'<picture><source media="(max-width: 600px)" srcset="{_address(narrow)}">'
            f'<img alt="{escape(alt, quote=True)}" src="{_address(wide)}"></picture>'
        )

    def numbers(self, rows: Sequence[tuple[str, str, str]]) -> None:
        """Add rows of name, value and note."""
        lines = [
            f'<tr><td>{escape(name)}</td><td class="value">{escape(value)}</td>'
            f"<td>{escape(note)}</td></tr>"
            for name, value, note in rows
        ]
        self._parts.append(f"<table>{''.join(lines)}</table>")

    def table(self, names: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        head = "".join(f"<th>{escape(name)}</th>" for name in names)
        columns = [escape(name, quote=True) for name in names]
        lines = [
            "".join(
                f'<td data-name="{name}">{escape(cell)}</td>'
                for name, cell in zip(columns, row, strict=True)
            )
            for row in rows
        ]
        self._parts.append(
            f'<div class="wide{" cards" * (len(names) > _MOST_COLUMNS)}">'
            f"<table><tr>{head}</tr>"
            f"{''.join(f'<tr>{line}</tr>' for line in lines)}</table></div>"
        )

    def details(self, summary: str, text: str) -> None:
        """Add text that is shown on demand."""
        self._parts.append(
            f"<details><summary>{escape(summary)}</summary><pre>{escape(text)}</pre></details>"
        )

    def text(self) -> str:
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{self._title}</title>\n<style>\n{_STYLE}</style>\n</head>\n<body>\n"
            f"<h1>{self._title}</h1>\n" + "\n".join(self._parts) + "\n</body>\n</html>\n"
        )


def _address(svg: str) -> str:
    return f"data:image/svg+xml;base64,{base64.b64encode(svg.encode()).decode()}"


def _lines_of(values: Mapping[str, object], prefix: str = "") -> list[str]:
    """Return settings, a line each, values as JSON; nested ones have dotted names."""
    lines = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            lines += _lines_of(value, f"{prefix}{key}.")
        else:
            lines.append(f"{prefix}{key} = {json.dumps(value, ensure_ascii=False)}")
    return lines


_BAND = "#dfe3e8"
_BAR = 0.7
"""Height of a link's bar; 1 is the distance of two."""
_TIME = "time since the first scan [s]"


def _draw_errors(
    figure: Figure, t_s: NDArray[np.float64], numbers: StateNumbers, smoothed: _Smoothed | None
) -> None:
    """Draw the position errors in mm, where the truth is known, and the number of landmarks."""
    has_truth = bool(np.isfinite(numbers.slam_error_m).any())
    panels = figure.subplots(2 if has_truth else 1, 1, sharex=True, squeeze=False).ravel()
    if has_truth:
        axes = panels[0]
        axes.plot(t_s, 1e3 * numbers.odometry_error_m, color=ODOMETRY, label="wheel odometry")
        axes.plot(t_s, 1e3 * numbers.slam_error_m, color=ESTIMATE, label="radar SLAM")
        if smoothed is not None:
            axes.plot(t_s, 1e3 * smoothed[0], color=SMOOTHED, label="smoothed at the end")
        label(axes, "Position error, from the start pose, not aligned", "", "error [mm]")
        axes.set_ylim(bottom=0.0)
        _legend_below(figure, axes)
    panels[-1].step(t_s, numbers.n_landmarks, color=LANDMARK, where="post")
    label(panels[-1], "Landmarks on the map", _TIME, "number [1]")
    panels[-1].set_ylim(bottom=0.0)
    panels[-1].yaxis.set_major_locator(MaxNLocator(integer=True))


def _legend_below(figure: Figure, axes: Axes) -> None:
    """Put the legend of a panel below the figure: inside it would lie over the data."""
    lines, names = axes.get_legend_handles_labels()
    n_columns = 2 if figure.get_figwidth() <= NARROW_IN else len(names)
    figure.legend(lines, names, loc="outside lower left", ncols=n_columns, frameon=False)


def _draw_consistency(
    figure: Figure, t_s: NDArray[np.float64], numbers: StateNumbers, smoothed: _Smoothed | None
) -> None:
    """Draw NIS and NEES over their degrees of freedom, with the 95 % band of each state."""
    has_truth = bool(np.isfinite(numbers.nees_per_dof).any())
    panels = figure.subplots(2 if has_truth else 1, 1, sharex=True, squeeze=False).ravel()
    known = np.isfinite(numbers.nis_dof)
    _draw_band(panels[0], t_s[known], bands_95(numbers.nis_dof[known]))
    panels[0].plot(
        t_s, numbers.nis_per_dof, linestyle="none", marker=".", markersize=2, color=ESTIMATE
    )
    label(panels[0], "NIS of associations inside the gate / dof, 95 % band", "", "NIS / dof [1]")
    _scale(panels[0], numbers.nis_per_dof)
    if has_truth:
        _draw_band(panels[1], t_s, bands_95(np.full(len(t_s), POSE_DOF)))
        lines = [(numbers.nees_per_dof, ESTIMATE, "radar SLAM")]
        if smoothed is not None:
            lines.append((smoothed[1], SMOOTHED, "smoothed at the end"))
        for values, colour, name in lines:
            panels[1].plot(t_s, values, color=colour, linewidth=1.0, label=name)
        _legend_below(figure, panels[1])
        label(panels[1], "NEES of the pose in the start frame / 3, 95 % band", "", "NEES / 3 [1]")
        _scale(panels[1], numbers.nees_per_dof)
    panels[-1].set_xlabel(_TIME)


def _draw_links(
    figure: Figure,
    names: Sequence[str],
    changes: Sequence[LinkChange],
    t_s: NDArray[np.float64],
    end_s: float,
) -> None:
    """Draw a bar per radar, coloured by the state of its link."""
    axes = figure.add_subplot()
    for row, name in enumerate(names):
        times = zip(t_s.tolist(), changes, strict=True)
        own = [(at_s, change.state) for at_s, change in times if change.radar == name]
        ends = [*(at_s for at_s, _ in own[1:]), end_s]
        for (start_s, state), stop_s in zip(own, ends, strict=True):
            if state is not LinkState.ENDED:
                # The shortest state, one lost frame, must stay visible.
                width_s = max(stop_s - start_s, 0.002 * end_s)
                place, height = [(start_s, width_s)], (row - _BAR / 2, _BAR)
                axes.broken_barh(place, height, facecolors=LINK_COLOURS[state])
    axes.set_yticks(range(len(names)), [*map(one_line, names)])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlim(0.0, max(end_s, 1e-3))
    label(axes, "State of each link", _TIME, "")
    axes.grid(visible=False)
    shown = {change.state for change in changes}
    for state, colour in LINK_COLOURS.items():
        if state in shown and state is not LinkState.ENDED:
            axes.plot([], [], linewidth=6, color=colour, label=str(state))
    if figure.get_figwidth() <= NARROW_IN:
        figure.legend(loc="outside lower left", frameon=False, handlelength=1.0, ncols=3)
    else:
        figure.legend(loc="outside right upper", frameon=False, handlelength=1.0)


def _draw_band(axes: Axes, t_s: NDArray[np.float64], bounds: NDArray[np.float64]) -> None:
    axes.fill_between(t_s, bounds[:, 0], bounds[:, 1], color=_BAND, linewidth=0.0)
    axes.axhline(1.0, color=PALE_INK, linewidth=0.6)


def _scale(axes: Axes, values: NDArray[np.float64]) -> None:
    """Limit the axis: single values far above would flatten everything else."""
    known = values[np.isfinite(values)]
    if len(known):
        axes.set_ylim(0.0, max(4.0, 1.2 * float(np.percentile(known, 99))))


def run_report(stop: StopFlag, *, session: Path, out: Path | None) -> None:
    """Write the report of a session; beside the session if `out` is None."""
    recorded = open_session(session, stop)
    page = out or recorded.path.with_name(REPORT)
    refuse_overwriting(recorded.path, page)
    text = _report_text(recorded, stop)
    with naming(page), written_whole(page) as fresh:
        fresh.write_text(text, encoding="utf-8")
    print_text(one_line(str(page)))


def _report_text(session: RecordedSession, stop: StopFlag) -> str:
    """Return the report of a session; the same session gives the same text.

    Raises
    ------
    AppError
        The session cannot be read, or no state was estimated in it.
    """
    data = _ReportData(session.info)
    record = play(session, [data], stop)
    if record.last is None:
        raise AppError(f"{session.path}: no state was estimated, the robot did not move")
    info = session.info
    summary = summarise(record, info, session.rig)
    seed = "" if info.seed is None else f", seed {info.seed}"
    page = _Page(f"{info.scene}, preset {info.preset}{seed}")
    page.note("simulated data" if info.simulated else "measured data", kind="origin")
    page.note(_what_was_done(info, record, data), kind="verdict")
    page.note(_verdict(summary, record), kind="verdict")
    page.note(_what_it_is(session, record))
    if record.last.step is None:
        page.note(
            "It was recorded by a version that did not keep what led to the states, so the report "
            "has no NIS of true associations, no band of the NIS and no walls."
        )
    _write_numbers(page, info, data, record, summary)
    states, whole = record.states, record.whole_smoothed
    t_s = _seconds(record, states.t_ns)
    smoothed = (
        smoothed_errors(whole, states.truth, record.world_from_map)
        if whole is not None and states.has_truth
        else None
    )
    page.heading("Map and trajectory")
    page.picture(
        "map with paths and landmarks",
        draw_map,
        info,
        record,
        summary,
        height_in=6.6,
        narrow_height_in=5.8,
    )
    _write_image(page, session, record)
    page.heading("Errors over time" if record.states.has_truth else "Over time")
    page.picture(
        "position errors and number of landmarks over time",
        _draw_errors,
        t_s,
        data.numbers(),
        smoothed,
        height_in=4.4,
        narrow_height_in=4.6,
    )
    page.heading("Consistency")
    page.note(
        "Errors over their own covariance. A consistent filter stays inside the grey "
        "band 95 % of the time; of one run, states are not independent."
    )
    page.picture(
        "NIS and NEES over time with their bands",
        _draw_consistency,
        t_s,
        data.numbers(),
        smoothed,
        height_in=4.4,
        narrow_height_in=4.4,
    )
    _write_landmarks(page, info, record.last)
    data.echoes.write(page, record)
    _write_links(page, info, data, record)
    _write_parameters(page, info)
    return page.text()


def _write_image(page: _Page, session: RecordedSession, record: RunRecord) -> None:
    if session.info.has_detections:
        return
    page.heading("Radar image")
    try:
        image = session_image(session, path_of(record, session.odometry(), session.info))
    except NoImageError as error:
        page.note(f"There is none: {error}")
        return
    page.note(
        "What the raw frames show, summed with their phases along 25 cm of each radar's way. "
        "Bright is strong; grey was not in view. A wall answers where a radar faces it squarely."
    )
    page.picture(
        "image of the room by its radars",
        draw_image,
        image,
        session.info,
        height_in=7.6,
        narrow_height_in=4.9,
    )


def _write_numbers(
    page: _Page,
    info: SessionInfo,
    data: _ReportData,
    record: RunRecord,
    summary: Summary | None,
) -> None:
    page.heading("Numbers")
    lost_frames = sum(count.lost for count in data.links.counts.values())
    driven = run_rows(info, record, lost_frames)
    if summary is None:
        page.note("The truth of this drive is unknown, so there are no errors.")
        page.numbers(driven)
        return
    lag_states = int(info.setting("window", "size", 1)) - 1
    rows = summary_rows(
        summary, lag_states=lag_states, wall_s=record.wall_s, lost_frames=lost_frames
    )
    judged = [row for row in rows if row[0] != "speed"]  # of reading the session, not of the run
    times = [row for row in driven if row[0] in {"time", "driven"}]
    nis = "-" if summary.nis_mean is None else f"{summary.nis_mean:.2f}"
    page.numbers(
        [*times, *judged, ("NIS, mean", nis, "of true associations over their dof; expected 1")]
    )


def _write_landmarks(page: _Page, info: SessionInfo, last: Snapshot) -> None:
    page.heading("Landmarks")
    if not len(last.landmark_ids):
        page.note("None was found.")
        return
    points = transform(last.world_from_map, last.landmarks_m)
    true_m = np.concatenate([info.true_landmarks_m.reshape(-1, 2), info.corners_m])
    rows = []
    for number, point, covariance in zip(
        last.landmark_ids, points, last.landmark_covariances_m2, strict=True
    ):
        variances = np.linalg.eigvalsh(covariance)
        sigma_m = math.sqrt(max(float(variances[-1]), 0.0))
        cells = [str(number), f"{point[0]:.4f}", f"{point[1]:.4f}", f"{1e3 * sigma_m:.1f}"]
        if len(true_m):
            off_m = float(np.linalg.norm(true_m - point, axis=1).min())
            cells.append(f"{1e3 * off_m:.1f}" if off_m <= LANDMARK_MATCH_M else "none within 150")
        rows.append(cells)
    frame = "world" if len(true_m) else "map"
    names = ["id", f"x [m, {frame}]", f"y [m, {frame}]", "largest sigma [mm]"]
    if len(true_m):
        names.append("to nearest truth [mm]")
    page.table(names, rows)


def _write_links(page: _Page, info: SessionInfo, data: _ReportData, record: RunRecord) -> None:
    page.heading("Links")
    rows = []
    for radar in info.radars:
        count = data.links.counts[radar.name]
        share = count.lost / max(count.frames + count.lost, 1)
        rows.append(
            [
                radar.name,
                radar.serial,
                f"{radar.rate_hz:.4f}",
                str(count.frames),
                f"{count.lost} ({100.0 * share:.2f} %)",
                str(count.longest_gap),
                str(count.faults),
                radar.port,  # last, as it may be so long that the table scrolls
            ]
        )
    page.table(
        ["radar", "serial", "frames/s", "frames", "lost", "most in a row", "faults", "port"], rows
    )
    names = [radar.name for radar in info.radars]
    height_in = 0.9 + 0.35 * len(names)
    page.picture(
        "state of each link over time",
        _draw_links,
        names,
        data.changes,
        _seconds(record, [change.t_ns for change in data.changes]),
        record.duration_ns / NS_PER_S,
        height_in=height_in,
        narrow_height_in=height_in + 0.4,
    )
    if data.warnings:
        lines = [
            f"{_seconds(record, line.t_ns):10.3f} s  {line.radar:<14} {line.text}"
            for line in data.warnings
        ]
        more = data.n_warnings - len(lines)
        if more:
            lines.append(f"... and {more} more in the session's log")
        page.details(f"Warnings: {data.n_warnings}", "\n".join(lines))


def _write_parameters(page: _Page, info: SessionInfo) -> None:
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
    settings: dict[str, Mapping[str, object]] = {
        "SLAM": info.settings,
        "Wheels, as SLAM assumes": info.wheels,
        "Radars": {radar.name: asdict(radar) for radar in info.radars},
        "Versions of the run": info.versions,
    }
    for name, values in settings.items():
        page.details(name, "\n".join(_lines_of(values)))


def _what_was_done(info: SessionInfo, record: RunRecord, data: _ReportData) -> str:
    assert record.last is not None
    lost = sum(count.lost for count in data.links.counts.values())
    faults = sum(count.faults for count in data.links.counts.values())
    return (
        f"A robot drove {record.states.driven_m:.1f} m in "
        f"{record.duration_ns / NS_PER_S:.0f} s; SLAM found {len(record.last.landmark_ids)} "
        f"landmarks in {record.n_frames} frames of {len(info.radars)} radars. "
        f"{lost} frames were lost, and there were {faults} faults on the links."
    )


def _verdict(summary: Summary | None, record: RunRecord) -> str:
    """Return whether SLAM was better than the wheels alone, as far as it can be known."""
    assert record.last is not None
    if summary is None:
        believed_mm = 1e3 * math.sqrt(float(np.trace(record.last.pose_covariance[:2, :2])))
        return (
            "Whether SLAM was better than the wheels is unknown, since no truth was recorded; it "
            f"believes its last position to {believed_mm:.1f} mm."
        )
    better = "better" if summary.ate_rmse_m < summary.odometry_ate_rmse_m else "worse"
    return (
        f"SLAM was {better} than the wheels alone: its RMS error was "
        f"{mm_text(summary.ate_rmse_m)}, theirs {mm_text(summary.odometry_ate_rmse_m)}."
    )


def _what_it_is(session: RecordedSession, record: RunRecord) -> str:
    info = session.info
    lasted_s = record.duration_ns / NS_PER_S
    parts = [f"{session.path.name}: {lasted_s:.1f} s of {len(info.radars)} radars"]
    if info.started_unix_ns is not None:
        first_ns = info.started_unix_ns + record.start_ns
        began = datetime.fromtimestamp(first_ns / NS_PER_S, UTC)
        parts.append(f"begun {began:%Y-%m-%d %H:%M:%S} UTC")
    if info.odometry_clock:
        parts.append(f"odometry clock: {info.odometry_clock}")
    if "xethru-hil" in info.versions:
        parts.append(f"xethru-hil {info.versions['xethru-hil']}")
    if session.cut_at_byte is not None:
        parts.append(f"cut at byte {session.cut_at_byte}: this is what is left of it")
    return "; ".join(parts) + "."
