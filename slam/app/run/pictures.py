"""Pictures of a run: style, ellipses, the map."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import wrap
from typing import Any

import matplotlib
import matplotlib.colors
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import NDArray
from PIL import Image

from slam.app.errors import naming
from slam.app.run.radar_image import RoomPicture
from slam.app.run.runner import LinkState, RunRecord, States
from slam.app.run.summary import Summary
from slam.geometry import between, compose, transform
from slam.imaging.room import LEVEL_DB
from slam.live.odometry_track import NS_PER_S
from slam.live.session_records import SessionInfo, Snapshot
from xethru_protocol.operating_system import each_line, written_whole

# What is drawn alike differs also for those who see two colours only.
TRUTH, ODOMETRY, ESTIMATE, LANDMARK = "#9aa0a8", "#e08a2c", "#1f6fd0", "#c2255c"
SMOOTHED = "#0a9d7e"
LINK_COLOURS = {
    LinkState.SETTING_UP: "#9fc9e8",
    LinkState.STREAMING: "#0072b2",
    LinkState.FRAMES_LOST: "#f0c000",
    LinkState.SILENT: "#cc79a7",
    LinkState.FAULT: "#d04500",
    LinkState.ENDED: "#444a52",
}
INK, PALE_INK, GRID = "#20242a", "#6a707a", "#eceef1"
_PALETTE = 256

# The same picture on every machine: no user style, no font that may be missing.
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 10.0,
    "axes.edgecolor": "#c8ccd2",
    "axes.labelcolor": "#40444c",
    "xtick.color": "#40444c",
    "ytick.color": "#40444c",
}


@contextmanager
def picture(
    path: Path, *, width_in: float, height_in: float, dpi: int = 100, title: str = ""
) -> Iterator[Figure]:
    """Give a figure to draw in, and write it as a PNG file at the end, with its folder.

    Its colours are cut to a palette of 256, which makes the file a third of the size. No software
    version or date goes into it: the same figure gives the same bytes.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(width_in, height_in), dpi=dpi, layout="constrained", facecolor="white"
        )
        FigureCanvasAgg(figure)
        if title:
            figure.suptitle(title, fontsize=11, color=INK, x=0.01, ha="left")
        yield figure
        _make_ready(figure)
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png")
        with Image.open(drawn) as colours:
            few = colours.convert("RGB").quantize(_PALETTE, dither=Image.Dither.NONE)
        with naming(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with written_whole(path) as fresh:
                few.save(fresh, format="png", optimize=True)


NARROW_IN = 4.4
"""Width of a picture for a telephone; one that is this narrow has its legend below."""


def svg_of(
    draw: Callable[..., None], *arguments: object, height_in: float, width_in: float = 9.5
) -> str:
    """Return what `draw(figure, *arguments)` draws as an SVG, the same for the same arguments."""
    with matplotlib.rc_context(STYLE | {"svg.hashsalt": "xethru-hil"}):
        figure = Figure(figsize=(width_in, height_in), layout="constrained", facecolor="white")
        FigureCanvasSVG(figure)
        draw(figure, *arguments)
        _make_ready(figure)
        drawn = io.StringIO()
        figure.savefig(drawn, format="svg", metadata={"Date": None, "Creator": None})
    return drawn.getvalue()


def _make_ready(figure: Figure) -> None:
    """Write out control characters in names from a file, and lay the axes out.

    No font has those characters. A layout changes the limits of axes of equal scale, and so their
    tick labels, which take more or less room: the second one allows for that, and `savefig` does
    the last.
    """
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        if not text.get_text().isprintable():
            text.set_text(each_line(text.get_text()))
    for _ in range(2):
        figure.draw_without_rendering()


def label(
    axes: Axes,
    title: str,
    x_label: str,
    y_label: str,
    *,
    fontsize: float = 10,
    pad: float | None = None,
) -> None:
    """Give a panel its title, its axes' names with units, and a pale grid."""
    axes.set_title(title, loc="left", fontsize=fontsize, color=INK, pad=pad)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(length=0)


def note(
    axes: Axes,
    text: str,
    at: tuple[float, float],
    offset_points: tuple[float, float],
    colour: str,
    **more: Any,  # noqa: ANN401 - of annotate
) -> None:
    """Write a small text beside a point."""
    options: dict[str, Any] = {"textcoords": "offset points", "fontsize": 8.5, "color": colour}
    axes.annotate(text, at, xytext=offset_points, **(options | more))


_HOLLOW = {"markerfacecolor": "none"}


def _mark(
    axes: Axes,
    points_m: NDArray[np.float64],
    marker: object,
    size: float,
    colour: str,
    **more: Any,  # noqa: ANN401 - of plot
) -> None:
    """Draw a marker at each point, shape (n, 2) or (2,)."""
    options: dict[str, Any] = {"marker": marker, "markersize": size, "color": colour}
    axes.plot(*np.reshape(points_m, (-1, 2)).T, linestyle="none", **(options | more))


# Chi-square quantile for two degrees of freedom, in closed form.
CHI2_95_TWO_DOF = -2.0 * math.log(1.0 - 0.95)


def ellipse_95(
    center_m: NDArray[np.float64],
    covariance_m2: NDArray[np.float64],
    n_points: int = 33,
    *,
    enlarged: float = 1.0,
) -> NDArray[np.float64]:
    """Return the closed 95 % contour of a planar Gaussian, shape (n_points, 2).

    The first point is repeated at the end. The root of the covariance comes from the eigenvectors,
    so a singular one gives a line. `enlarged` is a factor of both axes.

    >>> outline = ellipse_95(np.zeros(2), np.diag([4.0, 1.0]), n_points=5)
    >>> np.abs(outline).max(axis=0).round(3)
    array([4.895, 2.448])
    """
    variances, axes = np.linalg.eigh(covariance_m2)
    angle_rad = np.linspace(0.0, 2.0 * np.pi, n_points)
    circle = np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1)
    half_axes_m = enlarged * np.sqrt(CHI2_95_TWO_DOF * np.maximum(variances, 0.0))
    return np.asarray(center_m + (circle * half_axes_m) @ axes.T)


def half_axes_95_m(covariances_m2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the half axes of the 95 % ellipses of covariances (n, 2, 2): (n, 2), short and long.

    >>> half_axes_95_m(np.diag([4.0, 1.0])[None]).round(3)
    array([[2.448, 4.895]])
    """
    variances = np.linalg.eigvalsh(covariances_m2)
    return np.asarray(np.sqrt(CHI2_95_TWO_DOF * np.maximum(variances, 0.0)))


_TYPICAL_PART, _LARGEST_PART = 0.03, 0.1
"""Of the size of a map: how long an ellipse's half axis may be drawn."""
_MOST_ENLARGED = 1000


def enlargement(covariances_m2: NDArray[np.float64], extent_m: float) -> int:
    """Return by how much ellipses are enlarged so that they can be seen: 1, 2, 5, 10 .. 1000.

    It is the largest of these at which the half axes of the covariances, shape (n, 2, 2), have a
    median below 3 % of the map's size, and none is longer than 10 % of it.

    >>> enlargement(np.diag([1e-6, 1e-6])[None], extent_m=4.0)
    20
    """
    if not len(covariances_m2):
        return 1
    half_axes_m = half_axes_95_m(covariances_m2)[:, 1]
    fits = min(
        part * extent_m / max(float(half_axis_m), 1e-9)
        for part, half_axis_m in (
            (_TYPICAL_PART, np.median(half_axes_m)),
            (_LARGEST_PART, half_axes_m.max()),
        )
    )
    steps = [digit * 10**power for power in range(3) for digit in (1, 2, 5)] + [_MOST_ENLARGED]
    return max([step for step in steps if step <= fits], default=1)


def ellipse_text(enlarged: int) -> str:
    """Return what a legend calls ellipses that are enlarged so many times.

    >>> ellipse_text(1), ellipse_text(20)
    ('95 % ellipse', '95 % ellipse, enlarged 20 x')
    """
    return "95 % ellipse" if enlarged == 1 else f"95 % ellipse, enlarged {enlarged} x"


def extent_m(*points_m: NDArray[np.float64]) -> float:
    """Return the longer side of the box around points, shape (n, 2) each; 0 if there are none."""
    known = np.concatenate([np.reshape(some, (-1, 2)) for some in points_m])
    return float(np.ptp(known, axis=0).max()) if len(known) else 0.0


def rotate_covariances(
    heading_rad: float, covariances_m2: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Turn covariances, shape (n, 2, 2), by a heading, as when changing the frame they are in."""
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    return np.asarray(rotation @ covariances_m2 @ rotation.T)


def draw_map(figure: Figure, info: SessionInfo, record: RunRecord, summary: Summary | None) -> None:
    """Draw the map of a run; without `summary`, no truth is drawn.

    Estimate and odometry are drawn where they began, at the robot's first pose, without the
    alignment that the ATE uses: drift is shown unaligned.
    """
    states, last = record.states, record.last
    assert last is not None  # whoever draws a map has a state
    place, truth = last.world_from_map, states.truth
    estimate = transform(place, states.estimate[:, :2])
    odom_place = place if summary is not None else _world_from_odom(record)
    odometry = transform(odom_place, states.odometry[:, :2])
    has_truth = summary is not None
    is_narrow = figure.get_figwidth() <= NARROW_IN
    grid = None if is_narrow else figure.add_gridspec(2, 2, width_ratios=_WIDTHS)
    axes = figure.add_subplot() if grid is None else figure.add_subplot(grid[:, 0])
    axes.set_aspect("equal", adjustable="datalim")
    for number, line in enumerate(info.outlines_m):
        name = "wall or box" if number == 0 else None
        axes.plot(*line.T, color=INK, linewidth=1.6, alpha=0.45, label=name)
    wide = 1.1 if has_truth else 4.0  # nothing else lies below the estimate
    axes.plot(*odometry.T, color=ODOMETRY, linewidth=wide, alpha=0.9, label="wheel odometry")
    if summary is not None:
        axes.plot(*truth[:, :2].T, color=TRUTH, linewidth=4.0, alpha=0.6, label="true path")
    axes.plot(*estimate.T, color=ESTIMATE, linewidth=1.7, label="radar SLAM")
    _draw_smoothed(axes, record)
    _draw_start(axes, truth[0] if summary is not None else _first_pose(record))
    _draw_robot(axes, compose(place, states.estimate[-1]))
    if len(info.true_landmarks_m):
        looks = {"markeredgewidth": 1.4, "label": "true landmark", "zorder": 4}
        _mark(axes, info.true_landmarks_m, "+", 11, "#30343b", **looks)
    for number, ends_m in enumerate(last.wall_spans_m):
        name = "estimated wall" if number == 0 else None
        axes.plot(*transform(place, ends_m).T, color=LANDMARK, linewidth=2.0, label=name)
    outlined = [transform(place, last.landmarks_m), estimate, info.true_landmarks_m]
    _draw_landmarks(axes, last, extent_m(*outlined, *info.outlines_m))
    axes.margins(0.06)
    title, remark = _title_and_remark(info, summary, states)
    if is_narrow:
        title, remark = (
            "\n".join(line for part in text.split("\n") for line in wrap(part, n_letters))
            for text, n_letters in ((title, _TITLE_LETTERS), (remark, _REMARK_LETTERS))
        )
    n_lines = remark.count("\n") + 1
    label(axes, title, "x [m]", "y [m]", fontsize=10 if is_narrow else 11, pad=12 + 12 * n_lines)
    note(axes, remark, (0.0, 1.0), (0.0, 8.0), PALE_INK, xycoords="axes fraction")
    if grid is None:
        figure.legend(
            loc="outside lower left", ncols=2, frameon=False, handlelength=1.4, columnspacing=1.0
        )
        return
    beside = figure.add_subplot(grid[0, 1])
    beside.axis("off")
    lines = axes.get_legend_handles_labels()
    beside.legend(*lines, loc="upper left", borderaxespad=0.0, frameon=False, handlelength=1.6)
    _draw_distances(figure.add_subplot(grid[1, 1]), record, estimate, odometry, has_truth)


_TITLE_LETTERS, _REMARK_LETTERS = 44, 58
"""Of a line of a narrow picture."""
_WIDTHS = (2.6, 1.0)
"""Of the map, and of the legend with the panel of distances below it."""


def _draw_distances(
    axes: Axes,
    record: RunRecord,
    estimate: NDArray[np.float64],
    odometry: NDArray[np.float64],
    has_truth: bool,
) -> None:
    """Draw how far the paths are from the truth, or else from the estimate, over time.

    On the map they lie on each other. Paths have shape (n, 2), world frame.
    """
    states, smoothed = record.states, record.whole_smoothed
    times_s = (states.t_ns - record.start_ns) / NS_PER_S
    paths = [(ODOMETRY, odometry)]
    if has_truth:
        paths.append((ESTIMATE, estimate))
    if smoothed is not None:
        paths.append((SMOOTHED, transform(record.world_from_map, smoothed.poses[:, :2])))
    reference = states.truth[:, :2] if has_truth else estimate
    tops = []
    for colour, path in paths:
        distances_mm = 1e3 * np.linalg.norm(path - reference, axis=1)
        known_mm = distances_mm[np.isfinite(distances_mm)]
        tops.append(float(np.percentile(known_mm, 99)) if len(known_mm) else 0.0)
        axes.plot(times_s, distances_mm, color=colour, linewidth=0.9)
    what = "error" if has_truth else "from radar SLAM"
    label(axes, f"{what} [mm]", "time [s]", "", fontsize=8.5)
    axes.tick_params(labelsize=8)
    axes.xaxis.label.set_fontsize(8.5)
    axes.set_xlim(0.0, max(float(times_s[-1]), 1e-3))
    # beside the truth the wheels leave the panel, where the others would be lines at its bottom
    axes.set_ylim(0.0, max(1.3 * max(tops[1:] if has_truth else tops), 1.0))


def _title_and_remark(
    info: SessionInfo, summary: Summary | None, states: States
) -> tuple[str, str]:
    simulated = " (simulated)" if info.simulated else ""
    if summary is None:
        title = (
            f"{info.scene}, preset {info.preset}{simulated}: "
            f"{states.driven_m:.1f} m driven, no truth to compare with"
        )
        origin = (
            "where the first run on the map began" if info.map_json else "the robot's first pose"
        )
        remark = f"map frame: the origin is {origin}"
    else:
        seed = "" if summary.seed is None else f", seed {summary.seed}"
        title = (
            f"{summary.scene}, preset {summary.preset}{seed}{simulated}: "
            f"ATE {1e3 * summary.ate_rmse_m:.1f} mm, "
            f"{summary.ate_ratio:.2f} of odometry's {1e3 * summary.odometry_ate_rmse_m:.1f} mm"
        )
        remark = (
            "drawn from the start pose, while the ATE is after SE(2) alignment; "
            f"last state {1e3 * summary.final_error_m:.0f} mm off"
        )
        if summary.smoothed_ate_rmse_m is not None:
            ate_mm, share = 1e3 * summary.smoothed_ate_rmse_m, summary.smoothed_ate_ratio
            remark = (
                f"smoothed at the end: ATE {ate_mm:.1f} mm, {share:.2f} of odometry's\n{remark}"
            )
    return title, remark


def _draw_start(axes: Axes, pose: NDArray[np.float64]) -> None:
    looks = {"markeredgewidth": 1.6, "label": "start", "zorder": 7}
    _mark(axes, pose[:2], "o", 11, "#30343b", **_HOLLOW, **looks)


def _draw_smoothed(axes: Axes, record: RunRecord) -> None:
    smoothed, place = record.smoothed, record.world_from_map
    if smoothed is None:
        return
    path = transform(place, smoothed.poses[:, :2])
    axes.plot(*path.T, color=SMOOTHED, linewidth=1.1, label="smoothed at the end")
    if len(smoothed.landmark_ids):
        looks = {"markeredgewidth": 1.2, "label": "smoothed landmark", "zorder": 5}
        points = transform(place, smoothed.landmarks_m)
        _mark(axes, points, "D", 8, SMOOTHED, **_HOLLOW, **looks)


def _draw_robot(axes: Axes, pose: NDArray[np.float64]) -> None:
    triangle = (3, 0, np.degrees(pose[2]) - 90.0)
    rim = {"markeredgecolor": "white", "markeredgewidth": 0.8}
    _mark(axes, pose[:2], triangle, 10, ESTIMATE, **rim, label="last pose", zorder=8)


def _draw_landmarks(axes: Axes, last: Snapshot, map_extent_m: float) -> None:
    """Draw landmarks, and their and the robot's ellipses, which are enlarged to be visible."""
    place = last.world_from_map
    here = transform(place, last.estimate[:2])[None]
    points = transform(place, last.landmarks_m).reshape(-1, 2)
    covariances = rotate_covariances(
        place[2],
        np.concatenate([last.landmark_covariances_m2, last.pose_covariance[None, :2, :2]]),
    )
    enlarged = enlargement(covariances, map_extent_m)
    outlines = [
        ellipse_95(*pair, enlarged=enlarged)
        for pair in zip(np.concatenate([points, here]), covariances, strict=True)
    ]
    axes.add_collection(
        PolyCollection(
            outlines,
            facecolors=[(*matplotlib.colors.to_rgb(LANDMARK), 0.14)] * len(points)
            + [(*matplotlib.colors.to_rgb(ESTIMATE), 0.14)],
            edgecolors=[LANDMARK] * len(points) + [ESTIMATE],
            linewidths=1.2,
            zorder=3,
        )
    )
    if not len(points):
        return
    _mark(axes, points, "o", 3.6, LANDMARK, label="estimated landmark", zorder=6)
    # the legend's own sample: a collection of two colours has none
    filled = {"markerfacecolor": (*matplotlib.colors.to_rgb(LANDMARK), 0.14)}
    looks = {"markeredgecolor": LANDMARK, "markeredgewidth": 1.2, "label": ellipse_text(enlarged)}
    _mark(axes, np.zeros((0, 2)), "o", 11, LANDMARK, **filled, **looks)


def draw_image(
    figure: Figure, image: RoomPicture, info: SessionInfo | None, name: str = ""
) -> None:
    """Draw a radar image with the path that it was made along.

    Of a session also what is truly there, if the image is in the frame of the world; else `name` is
    that of the recording.
    """
    title = f"{name}: what its radar saw"
    if info is not None:
        simulated = " (simulated)" if info.simulated else ""
        title = f"{info.scene}{simulated}: what {len(info.radars)} radars see of the room"
    grid, is_narrow = image.room.grid, figure.get_figwidth() <= NARROW_IN
    axes = figure.add_subplot(aspect="equal", facecolor=_OUT_OF_VIEW)
    right, top = grid.x_m + grid.columns * grid.cell_m, grid.y_m + grid.rows * grid.cell_m
    shown = axes.imshow(
        np.ma.masked_less(LEVEL_DB * (image.room.levels - 100.0), -100 * LEVEL_DB),
        origin="lower",
        extent=(grid.x_m, right, grid.y_m, top),
        cmap="inferno",
        interpolation="nearest",
    )
    axes.plot(
        *image.path.poses[:, :2].T, color=_PATH, linewidth=0.8, label=f"path: {image.path.name}"
    )
    if info is not None and image.path.frame == "world":
        for number, line in enumerate(info.outlines_m):
            called = "true wall or box" if number == 0 else None
            axes.plot(*line.T, color=_IN_IMAGE, linewidth=0.7, label=called)
        if len(info.true_landmarks_m):
            looks = {"markeredgewidth": 0.8, "label": "true landmark"}
            _mark(axes, info.true_landmarks_m, "o", 11, _IN_IMAGE, **_HOLLOW, **looks)
    axes.set_xlim(grid.x_m, right)
    axes.set_ylim(grid.y_m, top)
    if is_narrow:
        title = "\n".join(wrap(title, _TITLE_LETTERS))
    label(axes, title, "x [m]", "y [m]", fontsize=10 if is_narrow else 11)
    axes.grid(visible=False)
    figure.colorbar(shown, ax=axes, shrink=0.7, label="below the brightest [dB]")
    figure.legend(loc="outside lower left", ncols=3, frameon=False, handlelength=1.4)


_OUT_OF_VIEW, _PATH, _IN_IMAGE = "#d8dbe0", "#4aa8ff", "#35e08a"
"""Of a radar image: what no radar had in view, the path, and what is truly there."""


def _world_from_odom(record: RunRecord) -> NDArray[np.float64]:
    """Return the place of odometry's frame such that it begins where SLAM does, shape (3,).

    A robot's odometry begins anywhere, as it runs before we listen; that of a demo at its start. It
    is laid on the first state whose place on the map was known.
    """
    states = record.states
    first = int(np.argmax(~states.lost))
    pose = compose(record.world_from_map, states.estimate[first])
    return compose(pose, between(states.odometry[first], np.zeros(3)))


def _first_pose(record: RunRecord) -> NDArray[np.float64]:
    return compose(record.world_from_map, record.states.estimate[0])
