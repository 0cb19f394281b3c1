"""What a module sent, of a vendor's recording or a wire capture, drawn in Rerun."""

from __future__ import annotations

import select
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.app.view.frames import BLOCK_FRAMES, chart_style, send_bscan, send_charts
from slam.app.view.rerun_recording import DEVICE_TIME, RerunRecording, RowTimes, rr, rrb
from xethru_protocol.cli.recordings import message_line
from xethru_protocol.driver.frames import complex_of
from xethru_protocol.operating_system import one_line
from xethru_protocol.recordings import RecordingFault, read_recording
from xethru_protocol.recordings.formats import message_name, recording_facts, recording_format
from xethru_protocol.recordings.frame_layout import FrameGeometries, FrameLayouts, samples_of
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.table import Response
from xethru_protocol.wire.x4 import BASEBAND_BIN_M, RF_BIN_M

Samples = NDArray[np.float32] | NDArray[np.complex64]

_LINES = 256
"""Lines of the log that are sent together."""
_MOST_FAULTS = 1000
"""That are named in the log; a damaged recording may have one at every byte."""
_MOST_LAYOUTS = 8
"""Of one kind of frame; more are a damaged recording's, and each would be a view of its own."""

_ABOUT = """\
# {name}

{format}{session}. Frames: {kinds}. Ranges are module metres.

* **B-scan**: up to {block} frames, time downwards, range to the right; envelope, the constant part
  removed.
* **Amplitude**, **Phase**: one frame over range [m]; RF samples, or the envelope and phase [rad] of
  complex baseband.
* **Log**: every other message, and what could not be read.

`device_time` counts from the first message, `frame` is the frame's counter, `host_time` the time of
day that was recorded.
"""


def draw(
    path: Path, *, recording_id: str | None, application_id: str, entity_path_prefix: str
) -> Faults:
    """Draw a recording on standard output as it is read; return what could not be read."""
    facts, kind = recording_facts(path), recording_format(path)
    faults = Faults()
    messages = read_recording(path, faults)
    first = next(messages, None)
    # The folder of a vendor's recording is named like its session, its files are not.
    name = path.parent.name if kind == "vendor" and path.is_file() else path.name
    prefix = entity_path_prefix.strip("/")
    prefix = f"{prefix}/" if prefix else ""
    recording = RerunRecording(
        None,
        _blueprint([], prefix),
        recording_id=recording_id or path.name,
        application_id=application_id,
        name=name,
        start_ns=0 if first is None else first[1] or 0,
    )
    drawing = _Drawing(recording, prefix)
    is_closed = select.poll()
    is_closed.register(sys.stdout.fileno(), select.POLLERR)
    for number, (message, t_ns) in enumerate(chain([first] if first else [], messages)):
        drawing.take(message, t_ns)
        faults.name_new(drawing)
        if number % BLOCK_FRAMES == 0 and is_closed.poll(0):
            break  # the viewer is gone
    faults.name_new(drawing)
    drawing.finish()
    about = _ABOUT.format(
        name=one_line(name),
        format="Recording of ModuleConnector" if kind == "vendor" else "Wire capture",
        session=f", session {one_line(facts.session_id)}" if facts.session_id else "",
        kinds=", ".join(f"{count} {entity}" for entity, count in drawing.n_frames.items())
        or "none",
        block=BLOCK_FRAMES,
    )
    document = rr.TextDocument(about, media_type=rr.MediaType.MARKDOWN)
    recording.static(f"{prefix}about", document)
    recording.finish()
    return faults


class Faults:
    """Counts what could not be read, and keeps what the log does not name yet."""

    def __init__(self) -> None:
        self.costly = 0
        self.first: RecordingFault | None = None
        self._named = 0
        self._new: list[RecordingFault] = []

    def __call__(self, fault: RecordingFault) -> None:
        if not fault.minor:
            self.costly += 1
            self.first = self.first or fault
        if self._named < _MOST_FAULTS:
            self._named += 1
            self._new.append(fault)

    def name_new(self, drawing: _Drawing) -> None:
        for fault in self._new:
            drawing.log(str(fault), "WARN")
        self._new.clear()


def bscan(samples: Samples) -> NDArray[np.float32]:
    """Return the envelope of frames without their constant part.

    Both have shape (n_frames, n_bins). A single frame keeps its constant part. The envelope of RF
    is that of its analytic signal.
    """
    moving = samples - samples.mean(axis=0) if len(samples) > 1 else samples
    if not np.iscomplexobj(moving):
        from scipy.signal import hilbert

        analytic: NDArray[np.complex128] = hilbert(moving.real.astype(np.float64), axis=1)
        return np.abs(analytic).astype(np.float32)
    return np.abs(moving).astype(np.float32)


@dataclass(slots=True, kw_only=True)
class _UnsentFrames:
    """Frames of one kind and layout that wait to be sent together.

    Where bins lie [module metres], and whether a frame's values are RF or all I and then all Q, may
    be unknown until the block is sent for the first time: `bin_m` is 0 and `is_complex` None then.
    """

    entity: str
    is_complex: bool | None
    is_placed: bool
    start_m: float = 0.0
    bin_m: float = 0.0
    is_shown: bool = False
    stamps: RowTimes = field(default_factory=RowTimes)
    samples: list[Samples] = field(default_factory=list)

    @property
    def charts(self) -> tuple[str, ...]:
        return ("amplitude", "phase") if self.is_complex else ("amplitude",)


class _Drawing:
    """Sends messages to Rerun: frames in blocks, everything else as lines of a log."""

    def __init__(self, recording: RerunRecording, prefix: str) -> None:
        self._recording = recording
        self._prefix = prefix
        self._layouts, self._geometries = FrameLayouts(), FrameGeometries()
        self._blocks: dict[tuple[object, ...], _UnsentFrames] = {}
        self._kinds: Counter[str] = Counter()
        self._lines: list[tuple[str, str]] = []
        self._line_stamps = RowTimes()
        self._t_ns: int | None = None
        self._counter = 0
        self.n_frames: Counter[str] = Counter()

    def take(self, message: Response, t_ns: int | None) -> None:
        """Draw one message; one without a time is drawn at that of the message before."""
        if t_ns is not None:
            if self._t_ns is None:
                self._recording.epoch_ns = t_ns
            self._t_ns = t_ns
        self._layouts.take(message)
        self._geometries.take(message)
        match message:
            case m.DataFloat(content_id=0, values=values):
                self._counter = message.info
                geometry = self._geometries.of(message)
                if geometry is None:
                    self._add(message, values, None, None, t_ns)
                    return
                place = (geometry.range_start_m, geometry.bin_length_m)
                samples = samples_of(message, downconversion=geometry.downconversion)
                self._add(message, samples, geometry.downconversion, place, t_ns)
            case m.BasebandIq() | m.BasebandAp() | m.RadarMessage():
                self._counter = message.counter
                samples = samples_of(message, downconversion=False)
                place = (message.range_offset_m, message.bin_length_m)
                self._add(message, samples, np.iscomplexobj(samples), place, t_ns)
            case _:
                self.log(message_line(message, with_samples=False), "INFO", t_ns)

    def log(self, text: str, level: str, t_ns: int | None = None) -> None:
        self._stamp(self._line_stamps, t_ns)
        self._lines.append((one_line(text), level))
        if len(self._lines) == _LINES:
            self._send_lines()

    def finish(self) -> None:
        for block in list(self._blocks.values()):
            self._send(block)
        self._send_lines()

    def _stamp(self, stamps: RowTimes, t_ns: int | None) -> None:
        # Before any time is known: 0 is before the epoch, where the view begins.
        stamps.add(self._t_ns or 0, self._counter, t_ns)

    def _add(
        self,
        message: Response,
        samples: Samples,
        is_complex: bool | None,
        place: tuple[float, float] | None,
        t_ns: int | None,
    ) -> None:
        """Add a frame to the block of its kind and layout; frames of too many are left out."""
        if not len(samples):
            return
        name = message_name(message)
        key = (name, len(samples), is_complex, place)
        if key not in self._blocks:
            self._kinds[name] += 1
            if self._kinds[name] > _MOST_LAYOUTS:
                if self._kinds[name] == _MOST_LAYOUTS + 1:
                    self.log(f"{name}: frames of further layouts are not drawn", "WARN")
                return
            number = f"_{self._kinds[name]}" if self._kinds[name] > 1 else ""
            block = _UnsentFrames(
                entity=self._prefix + name.lower().replace(" ", "_") + number,
                is_complex=is_complex,
                is_placed=place is not None,
            )
            if place is not None:
                block.start_m, block.bin_m = place
            self._blocks[key] = block
        block = self._blocks[key]
        self._stamp(block.stamps, t_ns)
        block.samples.append(samples)
        if len(block.samples) == BLOCK_FRAMES:
            self._send(block)

    def _send(self, block: _UnsentFrames) -> None:
        if not block.samples:
            return
        samples: NDArray[Any] = np.stack(block.samples)
        if block.is_complex is None:
            layout = self._layouts.layouts()[samples.shape[1]]
            block.is_complex = bool(layout.downconversion)
        if block.is_complex and not np.iscomplexobj(samples):
            samples = complex_of(*np.split(samples, 2, axis=1))
        ranges_m = self._ranges_m(block, samples.shape[1])
        values = (np.abs(samples), np.angle(samples)) if block.is_complex else (samples,)
        charts = dict(zip(block.charts, values, strict=True))
        send_charts(self._recording, block.entity, block.stamps, charts)
        picture = bscan(samples)
        send_bscan(
            self._recording,
            block.entity,
            block.stamps,
            picture,
            lasted_ns=block.stamps.t_ns[-1] - block.stamps.t_ns[0],
            ends_m=(ranges_m[0], ranges_m[-1]),
            brightest=_brightest(picture),
            counted_from="" if block.is_placed else " from the first bin",
        )
        self.n_frames[block.entity] += len(samples)
        block.stamps, block.samples = RowTimes(), []

    def _ranges_m(self, block: _UnsentFrames, n_bins: int) -> NDArray[np.float64]:
        """Return where bins lie; at the first time, make room for the block's views."""
        if not block.is_placed:
            block.bin_m = BASEBAND_BIN_M if block.is_complex else RF_BIN_M
        ranges_m = block.start_m + block.bin_m * np.arange(n_bins, dtype=np.float64)
        if block.is_shown:
            return ranges_m
        block.is_shown = True
        if not block.is_placed:
            self.log(
                f"DATA FLOAT: where the first of {n_bins} bins lies is not recorded; "
                "ranges are counted from it",
                "WARN",
            )
        for chart in block.charts:
            style = chart_style(abscissa=ranges_m.astype(np.float32), bar_m=abs(block.bin_m) or 1.0)
            self._recording.static(f"{block.entity}/{chart}", style)
        shown = [each for each in self._blocks.values() if each.is_shown]
        self._recording.arrange(_blueprint(shown, self._prefix))
        return ranges_m

    def _send_lines(self) -> None:
        if self._lines:
            texts, levels = zip(*self._lines, strict=True)
            columns = rr.TextLog.columns(text=list(texts), level=list(levels))
            self._recording.rows(f"{self._prefix}log", self._line_stamps, columns)
        self._lines, self._line_stamps = [], RowTimes()


def _brightest(picture: NDArray[np.float32]) -> float:
    """Return the value that all but one in a thousand lie below, of those that are numbers."""
    known = picture[np.isfinite(picture)]
    return max(float(np.quantile(known, 0.999)), 1e-12) if len(known) else 1.0


def _blueprint(blocks: Sequence[_UnsentFrames], prefix: str) -> rrb.Blueprint:
    """Return the layout: B-scans, below them the newest frame, beside them the log."""
    scans: list[rrb.View] = []
    charts: list[rrb.View] = []
    for block in blocks:
        name = block.entity.removeprefix(prefix)
        scans.append(
            rrb.TensorView(
                name=f"B-scan {name}: time down, range [m] right",
                origin=f"/{block.entity}/bscan",
                view_fit="fill",
                scalar_mapping=rrb.TensorScalarMapping(colormap="viridis", gamma=0.6),
            )
        )
        for chart in block.charts:
            unit = " [rad]" if chart == "phase" else ""
            title = f"{chart.capitalize()}{unit} {name} over range [m]"
            charts.append(rrb.BarChartView(name=title, origin=f"/{block.entity}/{chart}"))
    log = rrb.TextLogView(name="Log", origin=f"/{prefix}log")
    about = rrb.TextDocumentView(name="What you see", origin=f"/{prefix}about")
    texts = rrb.Vertical(about, log)
    drawn = rrb.Vertical(rrb.Tabs(*scans), rrb.Tabs(*charts), row_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Horizontal(drawn, texts, column_shares=[3, 2]) if scans else texts,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=DEVICE_TIME),
        auto_views=False,
    )
