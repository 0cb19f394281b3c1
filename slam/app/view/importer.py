"""The command `rerun-importer-xethru`: vendor recordings and wire captures in the Rerun viewer.

Rerun calls every executable of that prefix on PATH with each file that its user opens, and reads
what it draws from its standard output. Exit code 66 means "not mine", so nothing heavy is imported
before that is known.
"""

from __future__ import annotations

import argparse
import select
import signal
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import EXIT_FAILED, EXIT_USAGE, AppError
from xethru_protocol.recordings import RecordingError, RecordingFault, read_recording
from xethru_protocol.recordings.formats import message_name, recording_facts, recording_format
from xethru_protocol.recordings.frame_layout import FrameGeometries, FrameLayouts
from xethru_protocol.recordings.vendor.layouts import META_NAME
from xethru_protocol.recordings.wire_capture import SUFFIX, read_note
from xethru_protocol.system import STDERR, STDOUT, flush_streams, one_line, open_closed_streams
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.rows import Response
from xethru_protocol.wire.x4 import BASEBAND_BIN_M, RF_BIN_M

if TYPE_CHECKING:
    from slam.app.view.rerun_recording import Recording, Stamps, rrb

Samples = NDArray[np.float32] | NDArray[np.complex64]

INCOMPATIBLE = 66
"""Exit code by which Rerun learns that a file is for other importers."""

_BLOCK_FRAMES = 128
"""Frames of one B-scan; as many are held before they are sent."""
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


def main(argv: Sequence[str] | None = None) -> int:
    """Draw a recording on standard output as Rerun asks for it; return the exit code."""
    open_closed_streams()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    options = _parser().parse_known_args(argv)[0]
    path = Path(options.path)
    if not _is_ours(path):
        return INCOMPATIBLE
    if STDOUT.is_terminal:
        return _end(
            "the drawing is for the Rerun viewer, not for a terminal; "
            f"open the recording with it: rerun {path}",
            EXIT_USAGE,
        )
    try:
        with np.errstate(all="ignore"):  # samples of a damaged recording may be anything
            faults = _draw(path, options)
    except (RecordingError, AppError) as error:
        return _end(str(error), EXIT_FAILED)
    if faults.first is not None:
        more = f", and {faults.costly - 1} more, see its log" if faults.costly > 1 else ""
        return _end(f"{path}: damaged; {_fault_text(faults.first)}{more}", EXIT_FAILED)
    return 0


def _end(text: str, code: int) -> int:
    """Print why the command fails; return its exit code."""
    STDERR.write_soon(f"rerun-importer-xethru: {one_line(text)}\n")
    flush_streams()
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rerun-importer-xethru",
        description="Draws a recording of ModuleConnector or a wire capture (.xtwire) for the "
        "Rerun viewer, which calls this by itself when such a file is opened: rerun FILE.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "path", help="a recording's folder, its meta file, a data file, or *.xtwire"
    )
    parser.add_argument("--application-id", default="xethru-hil", help="recommended by the viewer")
    parser.add_argument("--recording-id", help="recommended by the viewer")
    parser.add_argument("--entity-path-prefix", default="", help="what all entities are put under")
    ignored = parser.add_argument_group("accepted, without effect: a recording has its own times")
    for flag in ("--static", "--timeless"):
        ignored.add_argument(flag, action="store_true", help=argparse.SUPPRESS)
    for name in ("--opened-application-id", "--opened-recording-id", "--time", "--sequence"):
        ignored.add_argument(name, action="append", help=argparse.SUPPRESS)
    for name in ("--time_sequence", "--time_duration_nanos", "--time_timestamp_nanos"):
        ignored.add_argument(name, action="append", help=argparse.SUPPRESS)
    return parser


def _is_ours(path: Path) -> bool:
    """Return whether a path is a recording that no importer of Rerun's own reads."""
    if path.suffix == SUFFIX and path.is_file():
        return True  # if its head is damaged, it is for us to say so
    try:
        if path.is_dir():
            return any(path.glob("xethru_*")) or (path / META_NAME).exists()
        return recording_format(path) in {"vendor", "wire"}
    except (RecordingError, OSError):
        return False


def _fault_text(fault: RecordingFault) -> str:
    return f"{fault.file}: {fault.reason} (at byte {fault.offset})"


class _Faults:
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
            drawing.log(_fault_text(fault), "WARN")
        self._new.clear()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Axis:
    """Where the samples of one kind of frame lie [module metres]."""

    entity: str
    start_m: float
    bin_m: float
    n_bins: int
    is_complex: bool
    is_placed: bool = True  # the range of the first bin is known

    @property
    def ranges_m(self) -> NDArray[np.float64]:
        return self.start_m + self.bin_m * np.arange(self.n_bins, dtype=np.float64)


@dataclass(slots=True, kw_only=True)
class _Waiting:
    """Frames of one axis that are sent together, as arrays of shape (n_bins,)."""

    axis: _Axis
    stamps: Stamps
    samples: list[Samples] = field(default_factory=list)


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


class _Drawing:
    """Sends messages to Rerun: frames in blocks, everything else as lines of a log."""

    def __init__(self, recording: Recording, prefix: str) -> None:
        from slam.app.view.rerun_recording import Stamps

        self._recording = recording
        self._prefix = f"{prefix.strip('/')}/" if prefix.strip("/") else ""
        self._new_stamps = Stamps
        self._layouts, self._geometries = FrameLayouts(), FrameGeometries()
        self._undecided: dict[int, _Waiting] = {}
        self._waiting: dict[tuple[object, ...], _Waiting] = {}
        self._kinds: Counter[str] = Counter()
        self._lines: list[tuple[str, str]] = []
        self._line_stamps = Stamps()
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
            case m.DataFloat(content_id=0):
                self._counter = message.info
                self._take_float(message, t_ns)
            case m.BasebandIq() | m.BasebandAp() | m.RadarMessage():
                self._counter = message.counter
                self._take_placed(message, t_ns)
            case _:
                from xethru_protocol.cli.recordings import message_line

                self.log(message_line(message, with_samples=False), "INFO", t_ns)

    def log(self, text: str, level: str, t_ns: int | None = None) -> None:
        self._stamp(self._line_stamps, t_ns)
        self._lines.append((one_line(text), level))
        if len(self._lines) == _LINES:
            self._send_lines()

    def finish(self) -> None:
        for length in list(self._undecided):
            self._decide(length)
        for waiting in self._waiting.values():
            self._send(waiting)
        self._send_lines()

    def _stamp(self, stamps: Stamps, t_ns: int | None) -> None:
        # Before any time is known: 0 is before the epoch, where the view begins.
        stamps.add(self._t_ns or 0, self._counter, t_ns)

    def _take_float(self, message: m.DataFloat, t_ns: int | None) -> None:
        """Hold frames until the recording shows whether their values are RF or I and Q."""
        geometry = self._geometries.of(message)
        length = len(message.values)
        if geometry is not None:
            self._decide(length)
            place = (geometry.range_start_m, geometry.bin_length_m)
            self._add_float(message.values, geometry.downconversion, place, t_ns)
            return
        if length not in self._undecided:
            if len(self._undecided) == _MOST_LAYOUTS:
                self._decide(next(iter(self._undecided)))
            unknown = _Axis(entity="", start_m=0.0, bin_m=0.0, n_bins=length, is_complex=False)
            self._undecided[length] = _Waiting(axis=unknown, stamps=self._new_stamps())
        waiting = self._undecided[length]
        self._stamp(waiting.stamps, t_ns)
        waiting.samples.append(message.values)
        if len(waiting.samples) == _BLOCK_FRAMES:
            self._decide(length)

    def _decide(self, length: int) -> None:
        """Send the frames of so many values that wait, by what the recording shows of them."""
        waiting = self._undecided.pop(length, None)
        if waiting is None:
            return
        layout = self._layouts.layouts()[length]
        is_complex = bool(layout.downconversion)
        target = self._axis("DATA FLOAT", length, is_complex, None)
        if target is None:
            return
        for row, values in enumerate(waiting.samples):
            stamps = waiting.stamps.at([row])
            self._hold(target, _complex_of(values.real) if is_complex else values, stamps)

    def _add_float(
        self,
        values: NDArray[np.float32],
        is_complex: bool,
        place: tuple[float, float],
        t_ns: int | None,
    ) -> None:
        target = self._axis("DATA FLOAT", len(values), is_complex, place)
        if target is not None:
            stamps = self._new_stamps()
            self._stamp(stamps, t_ns)
            self._hold(target, _complex_of(values) if is_complex else values, stamps)

    def _take_placed(
        self, message: m.BasebandIq | m.BasebandAp | m.RadarMessage, t_ns: int | None
    ) -> None:
        samples: Samples
        match message:
            case m.BasebandAp():
                samples = (message.amplitude * np.exp(1j * message.phase)).astype(np.complex64)
            case m.BasebandIq():
                samples = (message.i + 1j * message.q).astype(np.complex64)
            case m.RadarBasebandFloat() | m.RadarBasebandQ15():
                samples = message.iq
            case m.RadarRf() | m.RadarRfNormalized():
                samples = message.samples.astype(np.float32)
            case _:
                raise AssertionError(message)
        place = (message.range_offset_m, message.bin_length_m)
        is_complex = np.iscomplexobj(samples)
        target = self._axis(message_name(message), len(samples), is_complex, place)
        if target is not None:
            stamps = self._new_stamps()
            self._stamp(stamps, t_ns)
            self._hold(target, samples, stamps)

    def _axis(
        self, name: str, n_values: int, is_complex: bool, place: tuple[float, float] | None
    ) -> _Waiting | None:
        """Return where frames of one kind and layout wait; None if it has too many layouts."""
        if not n_values:
            return None  # a frame without samples
        key = (name, n_values, is_complex, place)
        if key in self._waiting:
            return self._waiting[key]
        self._kinds[name] += 1
        if self._kinds[name] > _MOST_LAYOUTS:
            if self._kinds[name] == _MOST_LAYOUTS + 1:
                self.log(f"{name}: frames of further layouts are not drawn", "WARN")
            return None
        number = f"_{self._kinds[name]}" if self._kinds[name] > 1 else ""
        entity = self._prefix + name.lower().replace(" ", "_") + number
        n_bins = n_values // 2 if name == "DATA FLOAT" and is_complex else n_values
        if place is None:
            start_m, bin_m = 0.0, BASEBAND_BIN_M if is_complex else RF_BIN_M
            self.log(
                f"{name}: where the first of {n_bins} bins lies is not recorded; "
                "ranges are counted from it",
                "WARN",
            )
        else:
            start_m, bin_m = place
        axis = _Axis(
            entity=entity,
            start_m=start_m,
            bin_m=bin_m,
            n_bins=n_bins,
            is_complex=is_complex,
            is_placed=place is not None,
        )
        self._waiting[key] = _Waiting(axis=axis, stamps=self._new_stamps())
        self._announce(axis)
        return self._waiting[key]

    def _announce(self, axis: _Axis) -> None:
        """Send what holds for all frames of an axis, and make room for them."""
        from slam.app.view.layers import chart_style

        labels_m = axis.ranges_m.astype(np.float32)
        for chart in ("amplitude", "phase") if axis.is_complex else ("amplitude",):
            style = chart_style(abscissa=labels_m, bar_m=abs(axis.bin_m) or 1.0)
            self._recording.static(f"{axis.entity}/{chart}", style)
        self._recording.arrange(_blueprint([w.axis for w in self._waiting.values()], self._prefix))

    def _hold(
        self,
        waiting: _Waiting,
        samples: Samples,
        stamps: Stamps,
    ) -> None:
        waiting.stamps.add(stamps.t_ns[0], stamps.counters[0], stamps.host_ns[0])
        waiting.samples.append(samples)
        if len(waiting.samples) == _BLOCK_FRAMES:
            self._send(waiting)

    def _send(self, waiting: _Waiting) -> None:
        from slam.app.view.layers import chart_values
        from slam.app.view.rerun_recording import rr

        if not waiting.samples:
            return
        axis, stamps = waiting.axis, waiting.stamps
        samples: NDArray[Any] = np.stack(waiting.samples)
        sizes = np.full(len(samples), axis.n_bins)
        charts = {"amplitude": samples}
        if axis.is_complex:
            charts = {"amplitude": np.abs(samples), "phase": np.angle(samples)}
        for chart, values in charts.items():
            flat = np.ascontiguousarray(values, dtype=np.float32).ravel()
            column = chart_values("BarChart:values", flat, sizes)
            self._recording.rows(f"{axis.entity}/{chart}", stamps, [column])
        lasted_s = (stamps.t_ns[-1] - stamps.t_ns[0]) * 1e-9
        low_m, high_m = axis.ranges_m[[0, -1]].tolist()
        after = "" if axis.is_placed else " from the first bin"
        names = (f"time {lasted_s:.1f} s", f"range {low_m:.2f} .. {high_m:.2f} m{after}")
        picture = bscan(samples)
        scan = rr.Tensor(picture, dim_names=names, value_range=(0.0, _brightest(picture)))
        self._recording.row(f"{axis.entity}/bscan", stamps.at([0]), scan)
        self.n_frames[axis.entity] += len(samples)
        waiting.stamps, waiting.samples = self._new_stamps(), []

    def _send_lines(self) -> None:
        from slam.app.view.rerun_recording import rr

        if self._lines:
            texts, levels = zip(*self._lines, strict=True)
            columns = rr.TextLog.columns(text=list(texts), level=list(levels))
            self._recording.rows(f"{self._prefix}log", self._line_stamps, columns)
        self._lines, self._line_stamps = [], self._new_stamps()


def _brightest(picture: NDArray[np.float32]) -> float:
    """Return the value that all but one in a thousand lie below, of those that are numbers."""
    known = picture[np.isfinite(picture)]
    return max(float(np.quantile(known, 0.999)), 1e-12) if len(known) else 1.0


def _complex_of(values: NDArray[np.float32]) -> NDArray[np.complex64]:
    """Return the baseband of a radar frame: all I, then all Q."""
    i, q = np.split(values, 2)
    return (i + 1j * q).astype(np.complex64)


def _blueprint(axes: Sequence[_Axis], prefix: str) -> rrb.Blueprint:
    """Return the layout: B-scans, below them the newest frame, beside them the log."""
    from slam.app.view.rerun_recording import DEVICE_TIME, rrb

    scans: list[rrb.View] = []
    charts: list[rrb.View] = []
    for axis in axes:
        name = axis.entity.removeprefix(prefix)
        scans.append(
            rrb.TensorView(
                name=f"B-scan {name}: time down, range [m] right",
                origin=f"/{axis.entity}/bscan",
                view_fit="fill",
                scalar_mapping=rrb.TensorScalarMapping(colormap="viridis", gamma=0.6),
            )
        )
        for chart, unit in (("amplitude", ""), ("phase", " [rad]")):
            if chart == "amplitude" or axis.is_complex:
                origin = f"/{axis.entity}/{chart}"
                title = f"{chart.capitalize()}{unit} {name} over range [m]"
                charts.append(rrb.BarChartView(name=title, origin=origin))
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


def _draw(path: Path, options: argparse.Namespace) -> _Faults:
    """Draw a recording as it is read; return what could not be read."""
    if path.suffix == SUFFIX:
        read_note(path)  # says what is wrong with a head that is not one
    facts, kind = recording_facts(path), recording_format(path)

    from slam.app.view.rerun_recording import Recording, rr

    faults = _Faults()
    messages = read_recording(path, faults)
    first = next(messages, None)
    # The folder of a vendor's recording is named like its session, its files are not.
    name = path.parent.name if kind == "vendor" and path.is_file() else path.name
    recording = Recording(
        None,
        _blueprint([], ""),
        recording_id=options.recording_id or path.name,
        application_id=options.application_id,
        name=name,
        start_ns=0 if first is None else first[1] or 0,
    )
    drawing = _Drawing(recording, options.entity_path_prefix)
    is_closed = select.poll()
    is_closed.register(sys.stdout.fileno(), select.POLLERR)
    for number, (message, t_ns) in enumerate(chain([first] if first else [], messages)):
        drawing.take(message, t_ns)
        faults.name_new(drawing)
        if number % _BLOCK_FRAMES == 0 and is_closed.poll(0):
            break  # the viewer is gone
    faults.name_new(drawing)
    drawing.finish()
    prefix = options.entity_path_prefix.strip("/")
    about = _ABOUT.format(
        name=one_line(name),
        format="Recording of ModuleConnector" if kind == "vendor" else "Wire capture",
        session=f", session {one_line(facts.session_id)}" if facts.session_id else "",
        kinds=", ".join(f"{count} {entity}" for entity, count in drawing.n_frames.items())
        or "none",
        block=_BLOCK_FRAMES,
    )
    document = rr.TextDocument(about, media_type=rr.MediaType.MARKDOWN)
    recording.static(f"{prefix}/about" if prefix else "about", document)
    recording.finish()
    return faults


if __name__ == "__main__":
    sys.exit(main())
