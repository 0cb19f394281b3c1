"""What a module sent, of a vendor's recording or a wire capture, drawn in Rerun."""

from __future__ import annotations

import select
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.app.view.frames import BLOCK_FRAMES, chart_style, send_bscan, send_charts
from slam.app.view.rerun_recording import DEVICE_TIME, RerunRecording, RowTimes, rr, rrb
from xethru_protocol.cli.recordings import message_line
from xethru_protocol.operating_system import one_line
from xethru_protocol.recordings import RecordingFault, read_recording
from xethru_protocol.recordings.formats import recording_facts, recording_format
from xethru_protocol.recordings.loading import RadarArrays, load
from xethru_protocol.recordings.recorded_messages import NO_TIME_NS
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
    """Draw a recording on standard output: its log, then its frames.

    Return what could not be read.
    """
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
    log = _Log(recording, f"{prefix}log")
    for message, t_ns in chain([first] if first else [], messages):
        log.take(message, t_ns)
        faults.name_new(log)
    faults.name_new(log)
    n_frames = _draw_frames(path, recording, prefix, log)
    log.send()
    about = _ABOUT.format(
        name=one_line(name),
        format="Recording of ModuleConnector" if kind == "vendor" else "Wire capture",
        session=f", session {one_line(facts.session_id)}" if facts.session_id else "",
        kinds=", ".join(f"{count} {entity}" for entity, count in n_frames.items()) or "none",
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

    def name_new(self, log: _Log) -> None:
        for fault in self._new:
            log.add(str(fault), "WARN")
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


class _Log:
    """Sends every message that is no frame as a line."""

    def __init__(self, recording: RerunRecording, entity: str) -> None:
        self._recording, self._entity = recording, entity
        self._lines: list[tuple[str, str]] = []
        self._stamps = RowTimes()
        self._t_ns: int | None = None
        self._counter = 0

    def take(self, message: Response, t_ns: int | None) -> None:
        """Log one message; one without a time is shown at that of the message before."""
        if t_ns is not None:
            if self._t_ns is None:
                self._recording.epoch_ns = t_ns
            self._t_ns = t_ns
        match message:
            case m.DataFloat(content_id=0, info=counter):
                self._counter = counter
            case m.BasebandIq() | m.BasebandAp() | m.RadarMessage():
                self._counter = message.counter
            case _:
                self.add(message_line(message, with_samples=False), "INFO", t_ns)

    def add(self, text: str, level: str, t_ns: int | None = None) -> None:
        # Before any time is known: 0 is before the epoch, where the view begins.
        self._stamps.add(self._t_ns or 0, self._counter, t_ns)
        self._lines.append((one_line(text), level))
        if len(self._lines) == _LINES:
            self.send()

    def send(self) -> None:
        if self._lines:
            texts, levels = zip(*self._lines, strict=True)
            columns = rr.TextLog.columns(text=list(texts), level=list(levels))
            self._recording.rows(self._entity, self._stamps, columns)
        self._lines, self._stamps = [], RowTimes()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Frames:
    """Frames of one kind and layout, and where they are drawn."""

    entity: str
    arrays: RadarArrays

    @property
    def charts(self) -> tuple[str, ...]:
        return ("amplitude", "phase") if self.arrays.kind == "iq" else ("amplitude",)


def _draw_frames(path: Path, recording: RerunRecording, prefix: str, log: _Log) -> dict[str, int]:
    """Draw the frames of each kind and layout; return how many, by their entities."""
    is_closed = select.poll()
    is_closed.register(sys.stdout.fileno(), select.POLLERR)
    drawn: list[_Frames] = []
    for frames in _frames_of(path, prefix, log):
        drawn.append(frames)
        recording.arrange(_blueprint(drawn, prefix))
        for _ in _draw_blocks(recording, frames, log):
            if is_closed.poll(0):
                break  # the viewer is gone
    return {each.entity: each.arrays.n_frames for each in drawn}


def _draw_blocks(recording: RerunRecording, frames: _Frames, log: _Log) -> Iterator[None]:
    """Draw frames block by block, and yield behind each."""
    arrays, is_complex = frames.arrays, frames.arrays.kind == "iq"
    ranges_m, counted_from = arrays.ranges_m, ""
    if ranges_m is None:
        ranges_m = (BASEBAND_BIN_M if is_complex else RF_BIN_M) * np.arange(float(arrays.n_bins))
        counted_from = " from the first bin"
        log.add(
            f"DATA FLOAT: where the first of {arrays.n_bins} bins lies is not recorded; "
            "ranges are counted from it",
            "WARN",
        )
    bar_m = float(np.ptp(ranges_m[:2])) or 1.0
    for chart in frames.charts:
        style = chart_style(abscissa=ranges_m.astype(np.float32), bar_m=bar_m)
        recording.static(f"{frames.entity}/{chart}", style)
    last_ns = 0  # before the epoch, where the view begins
    for block in arrays.blocks(BLOCK_FRAMES):
        samples = block.iq if is_complex else block.rf
        assert samples is not None
        assert block.counter is not None
        stamps = RowTimes()
        times_ns = [NO_TIME_NS] * block.n_frames if block.t_ns is None else block.t_ns.tolist()
        for t_ns, counter in zip(times_ns, block.counter.tolist(), strict=True):
            is_known = t_ns != NO_TIME_NS
            last_ns = t_ns if is_known else last_ns
            stamps.add(last_ns, counter, t_ns if is_known else None)
        values = [samples.real] if not is_complex else [np.abs(samples), np.angle(samples)]
        charts = dict(zip(frames.charts, values, strict=True))
        send_charts(recording, frames.entity, stamps, charts)
        picture = bscan(samples)
        send_bscan(
            recording,
            frames.entity,
            stamps,
            picture,
            lasted_ns=stamps.t_ns[-1] - stamps.t_ns[0],
            ends_m=(float(ranges_m[0]), float(ranges_m[-1])),
            brightest=_brightest(picture),
            counted_from=counted_from,
        )
        yield


def _frames_of(path: Path, prefix: str, log: _Log) -> Iterator[_Frames]:
    """Yield the frames of each kind and layout; those of too many are left out."""
    kinds: Counter[str] = Counter()
    radars = load(path, lambda fault: None).radars.values()  # faults are in the log already
    for arrays in chain.from_iterable(radar.parts for radar in radars):
        found = arrays.frames
        if not found.n_bins:
            continue
        kinds[found.message] += 1
        number = kinds[found.message]
        if number > _MOST_LAYOUTS:
            if number == _MOST_LAYOUTS + 1:
                log.add(f"{found.message}: frames of further layouts are not drawn", "WARN")
            continue
        if found.kind is None:  # drawn as it came
            as_rf = replace(found, kind="rf")
            arrays = RadarArrays(arrays.name, partial(tuple, (as_rf,)), str(path))
        name = found.message.lower().replace(" ", "_")
        yield _Frames(entity=f"{prefix}{name}{f'_{number}' if number > 1 else ''}", arrays=arrays)


def _brightest(picture: NDArray[np.float32]) -> float:
    """Return the value that all but one in a thousand lie below, of those that are numbers."""
    known = picture[np.isfinite(picture)]
    return max(float(np.quantile(known, 0.999)), 1e-12) if len(known) else 1.0


def _blueprint(drawn: Sequence[_Frames], prefix: str) -> rrb.Blueprint:
    """Return the layout: B-scans, below them the newest frame, beside them the log."""
    scans: list[rrb.View] = []
    charts: list[rrb.View] = []
    for block in drawn:
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
    beside = rrb.Vertical(rrb.Tabs(*scans), rrb.Tabs(*charts), row_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Horizontal(beside, texts, column_shares=[3, 2]) if scans else texts,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=DEVICE_TIME),
        auto_views=False,
    )
