"""`LiveUpdate`s drawn in Rerun, each in place of the one before, so that nothing grows.

The one module of this package that imports Rerun. Its 2D views have no axes of their own: charts
are drawn in boxes of `_WIDTH` units, y downwards, with ticks as labelled points. All is static in
Rerun's sense but the breathing rate, one number a second.
"""

from __future__ import annotations

import os

# A viewer that was closed is reported by us, not by Rerun's threads.
os.environ.setdefault("RUST_LOG", "off")
# Its allocator keeps freed memory unless this is set before it is loaded.
os.environ.setdefault("MIMALLOC_PURGE_DELAY", "0")

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import ArrayLike, NDArray

from xethru_protocol.cli.live.analysis import LiveUpdate
from xethru_protocol.cli.live.terminal_picture import STEPS, in_decibels, levels, scale_of, ticks_m
from xethru_protocol.processing.doppler import SPEED_OF_LIGHT_MPS

_WIDTH = 1000.0
_LABEL_X = -50.0
_TIME = "time"
_RATE_EVERY_S = 1.0
_ALL_EVERY_S = 5.0
"""What did not change is sent so often, since the server for browsers forgets what is old."""
_MOST_TICKS = 11
_DECAY = 0.98
"""Of a scale from one picture to the next, so that it does not jump."""

Rgb = tuple[int, int, int]
_LABEL_RGB: Rgb = (225, 228, 232)
_RAW_RGB: Rgb = (150, 160, 175)
_PROFILE_RGB: Rgb = (245, 225, 110)
_CHEST_RGB: Rgb = (90, 200, 250)
_GRID_RGB: Rgb = (45, 47, 52)

_ABOUT = """\
# What you see

* **Range** (left): the newest frame above, grey as it came and yellow behind the clutter filter;
  below it the last {seconds:.0f} s, the newest on top. Bright is strong, dark the median of all.
  The filter ({clutter}) removes what stands still. A blue line: where somebody breathes.
* **Range-Doppler**: what moves, by range and radial velocity, approaching above.
* **Chest**: displacement towards the radar where somebody breathes.
* **Breathing rate**: of the last minutes. An estimate for experiments: not a medical device.

Ranges are metres as the module counts them.
"""


class _Box(NamedTuple):
    """Where a chart lies, in units, and what its edges mean."""

    top_y: float
    bottom_y: float
    left: float
    right: float
    top: float
    bottom: float

    def x(self, values: Any) -> Any:  # noqa: ANN401 - a number or an array
        return (values - self.left) / (self.right - self.left) * _WIDTH

    def y(self, values: Any) -> Any:  # noqa: ANN401 - a number or an array
        share = (values - self.top) / (self.bottom - self.top)
        return self.top_y + share * (self.bottom_y - self.top_y)


def blueprint() -> rrb.Blueprint:
    """Return the layout of the views."""
    return rrb.Blueprint(
        rrb.Horizontal(
            _chart("Range", "/range", -300, 770),
            rrb.Vertical(
                rrb.TextDocumentView(name="Now", origin="/now"),
                _chart("Range-Doppler", "/doppler", -40, 480),
                _chart("Chest", "/chest", -30, 380),
                rrb.Tabs(
                    rrb.TimeSeriesView(
                        name="Breathing rate",
                        origin="/breathing",
                        axis_y=rrb.ScalarAxis(range=(0.0, 40.0), zoom_lock=True),
                    ),
                    rrb.TextDocumentView(name="What you see", origin="/about"),
                ),
                row_shares=[6, 11, 9, 6],
            ),
            column_shares=[11, 9],
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=_TIME, play_state="following"),
        auto_views=False,
    )


def _chart(name: str, origin: str, top: float, bottom: float) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        name=name,
        origin=origin,
        background=[12, 12, 14],
        visual_bounds=rrb.VisualBounds2D(x_range=[-95, _WIDTH + 40], y_range=[top, bottom]),
    )


def connect(url: str, name: str) -> rr.RecordingStream:
    """Return a stream to a viewer, with the layout."""
    rr.set_strict_mode(True)
    stream = rr.RecordingStream("xethru", recording_id=f"xethru-{os.getpid()}")
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    stream.connect_grpc(url, default_blueprint=blueprint())
    stream.send_recording_name(name)
    return stream


class RerunPicture:
    """Draws updates into a stream."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._all_at_s = -_ALL_EVERY_S
        self._rate_at_s = -_RATE_EVERY_S
        self._chest_mm: NDArray[np.float64] | None = None
        self._sent: dict[tuple[str, type], list[Any]] = {}
        self._peaks: dict[str, float] = {}
        self._rate: float | None = None

    def draw(self, update: LiveUpdate) -> None:
        start_m, end_m = float(update.ranges_m[0]), float(update.ranges_m[-1])
        fastest_mps = SPEED_OF_LIGHT_MPS / update.carrier_hz * update.frame_rate_hz / 4
        image = _Box(0, 700, start_m, end_m, 0, -update.waterfall_s)
        doppler = _Box(0, 400, start_m, end_m, fastest_mps, -fastest_mps)
        chest = _Box(0, 300, -update.waterfall_s, 0, 1, -1)
        if update.t_s - self._all_at_s >= _ALL_EVERY_S:
            self._all_at_s = update.t_s
            self._sent.clear()
            self._draw_axes(update, image, doppler, chest)
        self._frame(update, _Box(-280, -20, start_m, end_m, 1, -1))
        self._image("range/waterfall", update.waterfall, image)
        if update.doppler is not None:
            self._image("doppler/image", np.sqrt(update.doppler.power[::-1]), doppler)
        self._breathing(update, image, chest)

    def _draw_axes(self, update: LiveUpdate, image: _Box, doppler: _Box, chest: _Box) -> None:
        about = _ABOUT.format(seconds=update.waterfall_s, clutter=update.clutter)
        self._log("about", rr.TextDocument(about, media_type=rr.MediaType.MARKDOWN))
        ranges = {at: f"{at:g} m" for at in ticks_m(image.left, image.right, _MOST_TICKS)}
        times = {float(-at): f"-{at} s" if at else "now" for at in range(0, round(-chest.left), 10)}
        speeds = {at: f"{at:+g} m/s" if at else "0 m/s" for at in _around_zero(doppler.top)}
        self._axes("range/axes", image, ranges, times)
        self._axes("doppler/axes", doppler, ranges, speeds)
        self._axes("chest/axes", chest, times, {})
        lines = rr.SeriesLines(colors=[_CHEST_RGB], names="breaths/min", widths=2.0)
        self._log("breathing", lines)

    def _axes(
        self, entity: str, box: _Box, below: Mapping[float, str], beside: Mapping[float, str]
    ) -> None:
        """Draw a box, ticks below it and labels on two sides, by the values that they stand for."""
        x, y = [float(box.x(at)) for at in below], [float(box.y(at)) for at in beside]
        places = [[at, box.bottom_y + 28] for at in x] + [[_LABEL_X, at] for at in y]
        self._labels(entity, places, [*below.values(), *beside.values()], _LABEL_RGB)
        lines = [[[at, box.bottom_y], [at, box.bottom_y + 8]] for at in x]
        left, top, right, bottom = 0.0, box.top_y, _WIDTH, box.bottom_y
        lines.append([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]])
        self._log(f"{entity}/lines", rr.LineStrips2D(lines, colors=[_GRID_RGB], radii=0.8))

    def _frame(self, update: LiveUpdate, box: _Box) -> None:
        texts, places, colours = [], [], []
        if update.rf is not None and update.rf_ranges_m is not None:
            peak = self._peak("rf", update.rf)
            heights = box.y(np.clip(update.rf / peak, -1, 1))
            self._line("range/frame/raw", box.x(update.rf_ranges_m), heights, _RAW_RGB, 0.6)
            texts.append(f"as it came, ±{peak:.2g}")
            places.append([720, box.top_y + 10])
            colours.append(_RAW_RGB)
        peak = self._peak("profile", update.profile)
        heights = box.y(np.clip(update.profile / peak, 0, 1))
        self._line("range/frame/profile", box.x(update.ranges_m), heights, _PROFILE_RGB, 1.2)
        texts.append(f"clutter filter {update.clutter}, to {peak:.2g}")
        places.append([720, box.top_y + 50])
        colours.append(_PROFILE_RGB)
        self._labels("range/frame/legend", places, texts, colours)

    def _breathing(self, update: LiveUpdate, image: _Box, chest: _Box) -> None:
        vital = update.vital
        lost = f", {update.n_lost} lost" if update.n_lost else ""
        self._log(
            "now",
            rr.TextDocument(
                f"## {vital.text}\n\n{update.name}: {update.t_s:.0f} s, "
                f"{update.frame_rate_hz:.1f} frames/s{lost}",
                media_type=rr.MediaType.MARKDOWN,
            ),
        )
        if vital.breathing is None:
            for line in ("range/person", "chest/line"):
                self._log(line, rr.LineStrips2D([]))
            for labels in ("range/person/rate", "chest/scale"):
                self._log(labels, rr.Points2D([]))
        else:
            x = float(image.x(vital.breathing.range_m))
            self._line("range/person", [x, x], [image.top_y, image.bottom_y], _CHEST_RGB, 0.7)
            text = f"{vital.breathing.rate_bpm:.1f}/min"
            self._labels("range/person/rate", [[x, image.top_y - 4]], [text], _CHEST_RGB)
        is_new = update.chest_mm is not self._chest_mm
        self._chest_mm = update.chest_mm
        if is_new and update.chest_s is not None and update.chest_mm is not None:
            peak = self._peak("chest", update.chest_mm)
            heights = chest.y(np.clip(update.chest_mm / peak, -1, 1))
            self._line("chest/line", chest.x(update.chest_s), heights, _CHEST_RGB, 1.2)
            sides = [[_LABEL_X, chest.top_y + 10], [_LABEL_X, chest.bottom_y - 10]]
            self._labels("chest/scale", sides, [f"+{peak:.1f} mm", f"-{peak:.1f} mm"], _LABEL_RGB)
        rate = vital.breathing.rate_bpm if vital.breathing else None
        if update.t_s - self._rate_at_s >= _RATE_EVERY_S and (rate or self._rate):
            self._rate_at_s, self._rate = update.t_s, rate
            self._stream.set_time(_TIME, duration=update.t_s)
            self._stream.log("breathing", rr.Scalars([np.nan if rate is None else rate]))
            self._stream.reset_time()

    def _peak(self, name: str, values: NDArray[Any]) -> float:
        now = float(np.abs(values).max(initial=0.0))
        self._peaks[name] = max(now, _DECAY * self._peaks.get(name, 0.0), 1e-12)
        return self._peaks[name]

    def _image(self, entity: str, amplitudes: NDArray[Any], box: _Box) -> None:
        decibels = in_decibels(amplitudes)
        pixels = np.rint(255 * levels(decibels, scale_of(decibels))).astype(np.uint8)
        rows, columns = pixels.shape
        scale = [_WIDTH / columns, (box.bottom_y - box.top_y) / rows, 1.0]
        self._log(entity, rr.Transform3D(scale=scale, translation=[0.0, box.top_y, 0.0]))
        self._log(
            entity,
            rr.DepthImage(pixels, colormap=rr.components.Colormap.Inferno, depth_range=[0, 255]),
        )

    def _line(self, entity: str, x: ArrayLike, y: ArrayLike, colour: Rgb, radius: float) -> None:
        points = np.column_stack([x, y]).astype(np.float32)
        self._log(entity, rr.LineStrips2D([points], colors=[colour], radii=radius))

    def _labels(
        self,
        entity: str,
        places: Sequence[Sequence[float]],
        texts: Sequence[str],
        colours: Rgb | Sequence[Rgb],
    ) -> None:
        self._log(
            entity,
            rr.Points2D(places, labels=texts, colors=colours, radii=0.0, show_labels=True),
        )

    def _log(self, entity: str, what: rr.AsComponents) -> None:
        """Send what replaces the entity's content; if it is the same as before, now and then."""
        content = [batch.as_arrow_array() for batch in what.as_component_batches()]
        key = entity, type(what)
        if self._sent.get(key) != content:
            self._sent[key] = content
            self._stream.log(entity, what, static=True)


def _around_zero(most: float) -> list[float]:
    """Return round values from minus to plus so much, five at most.

    >>> _around_zero(0.17), _around_zero(0.5)
    ([-0.1, 0.0, 0.1], [-0.4, -0.2, 0.0, 0.2, 0.4])
    """
    step = next((step for step in STEPS if most / step < 3), STEPS[-1])
    return [round(step * number, 3) for number in range(-int(most / step), int(most / step) + 1)]
