"""Recordings as arrays: `load` gives frames, times and ranges of any recording.

The frames of a radar are a matrix with one row per frame: float32 RF amplitudes or complex64
baseband. Every way in which a module sends baseband becomes I + jQ with the sign as sent (Protocol
reference 6.1, 7.1, 7.5): all I then all Q of a radar frame, BASEBAND_IQ, BASEBAND_AP as amplitude *
exp(j phase), RADAR_BASEBAND_FLOAT, and Q15, whose integers are multiplied by the scaling factor.
RADAR_RF holds counts of the chip.

Nothing is read before the first question. Then a file is read once for what describes its frames,
12 bytes each, and again for the samples: all of them by `RadarArrays.iq`, a part at a time by
`RadarArrays.blocks`.
"""

import math
from array import array
from collections import ChainMap, Counter
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np
import numpy.typing as npt

from xethru_protocol.driver.frames import FrameGeometry
from xethru_protocol.driver.link import CONFIG_SETTINGS
from xethru_protocol.recordings.array_files import (
    DTYPES,
    FrameKind,
    Frames,
    Samples,
    Settings,
    is_array_file,
    read_array_file,
)
from xethru_protocol.recordings.formats import (
    message_name,
    read_recording,
    recording_content,
    refuse_name,
)
from xethru_protocol.recordings.frame_layout import (
    FrameGeometries,
    FrameLayout,
    FrameLayouts,
    FrameMessage,
    samples_of,
)
from xethru_protocol.recordings.recorded_messages import (
    MODULE_METRES,
    NO_TIME_NS,
    FaultHandler,
    RecordingError,
    RecordingFault,
    report,
)
from xethru_protocol.validation import shown
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.messages import BasebandAp, BasebandIq, DataFloat, RadarMessage
from xethru_protocol.wire.x4 import TRUE_PER_MODULE_METRE, real_frame_rate

_BLOCK = 1024


class RadarArrays:
    """Frames of one radar as arrays.

    A frame's number is its row in every array. Where a recording holds frames of several layouts,
    since the frame area was changed or different messages were recorded, `parts` has one entry for
    each, and the arrays of the whole raise `RecordingError`.
    """

    def __init__(self, name: str, find: Callable[[], Sequence[Frames]], nothing: str) -> None:
        self.name = name
        self._find = find
        self._nothing = nothing

    @cached_property
    def _all(self) -> tuple[Frames, ...]:
        return tuple(self._find())

    @property
    def frames(self) -> Frames:
        """What the arrays are made of; RecordingError without frames, and for several layouts."""
        if len(self._all) == 1:
            return self._all[0]
        if not self._all:
            raise RecordingError(f"{self._nothing} holds no radar frames")
        listed = "; ".join(f"{frames.n_frames} of {frames.about}" for frames in self._all[:4])
        more = "" if len(self._all) <= 4 else f"; and {len(self._all) - 4} other layouts"
        raise RecordingError(
            f"{self._nothing} holds frames of {len(self._all)} layouts, which have no common "
            f"array: {listed}{more}; choose one: parts[0], parts[1] ..."
        )

    def __repr__(self) -> str:
        parts = ", ".join(f"{frames.n_frames} frames of {frames.about}" for frames in self._all)
        return f"<RadarArrays {self.name}: {parts or 'no frames'}>"

    @property
    def parts(self) -> tuple["RadarArrays", ...]:
        """The frames of each layout, in the order of their first frames."""
        return tuple(_of(self.name, frames, self._nothing) for frames in self._all)

    @property
    def kind(self) -> FrameKind | None:
        """``"rf"`` or ``"iq"``; None where it is not known, or there are no frames."""
        return self.frames.kind if self._all else None

    @property
    def n_frames(self) -> int:
        return sum(frames.n_frames for frames in self._all)

    @property
    def n_bins(self) -> int:
        """Bins of a frame; 0 without frames."""
        return self.frames.n_bins if self._all else 0

    @cached_property
    def _samples(self) -> Samples:
        try:
            (whole,) = self._blocks(max(self.n_frames, 1))
        except MemoryError:
            raise RecordingError(
                f"{self._nothing}: its {self.n_frames} frames do not fit into memory; read them by "
                "blocks()"
            ) from None
        return whole

    def _of_kind(self, kind: FrameKind) -> Samples | None:
        found = self.frames.kind
        if found is None:
            raise RecordingError(
                f"{self._nothing}: its frames of {self.frames.n_bins} values may be RF or complex "
                "baseband; say which: load(path, downconversion=True or False)"
            )
        return self._samples if found == kind else None

    @property
    def rf(self) -> npt.NDArray[np.float32] | None:
        """RF amplitudes, shape (n_frames, n_bins), float32; None of baseband."""
        return self._of_kind("rf")

    @property
    def iq(self) -> npt.NDArray[np.complex64] | None:
        """Complex baseband, shape (n_frames, n_bins), complex64; None of RF."""
        return self._of_kind("iq")

    @property
    def counter(self) -> npt.NDArray[np.uint32] | None:
        """Frame counters, shape (n_frames,); None if unknown."""
        return self.frames.counter

    @property
    def t_ns(self) -> npt.NDArray[np.int64] | None:
        """Times of arrival, shape (n_frames,), ns since 1970; None if none is known.

        A session of ``uwb-slam`` has session time, which is that of its odometry.

        A single unknown time is the least int64, which is NaT in ``t_ns.view("datetime64[ns]")``.
        """
        return self.frames.t_ns

    @property
    def ranges_m(self) -> npt.NDArray[np.float64] | None:
        """Range of each bin, shape (n_bins,) [module metres], as on the wire; None if unknown."""
        return self.frames.ranges_m

    @property
    def true_ranges_m(self) -> npt.NDArray[np.float64] | None:
        """Range of each bin, shape (n_bins,) [m], by the speed of light; None if unknown.

        The firmware takes 3.0e8 m/s for light, so what it gives is 0.07 % too long. Protocol
        reference 9.1.
        """
        ranges_m = self.ranges_m
        return None if ranges_m is None else ranges_m * TRUE_PER_MODULE_METRE

    @property
    def settings(self) -> Settings:
        """Settings of the chip by their names in `X4Setting`, as far as they are known.

        FRAMEAREA and FRAMEBINCOUNT are the module's answers.
        """
        return self.frames.settings if self._all else {}

    @cached_property
    def frame_rate_hz(self) -> float | None:
        """Frames per second: by the setting FPS, else by times and counters; None if unknown.

        The setting is the module's answer to GET FPS in a capture of its bytes, or the rate in the
        description of an MCAP file or a file of arrays; it gives the rate of the chip's timer
        (Protocol reference 9.6). The driver asks as soon as frames come, so the answer holds for
        the frames before it, too. Without a setting, or with answers that differ, the rate is the
        slope of a line through the times over the counter, along the longest run of rising
        counters. It is the rate of arrival, which an emulated module at ``--pace asap`` or a host
        that fell behind makes different from the radar's.
        """
        frames = self.frames
        if frames.frame_rate_hz is not None:
            return frames.frame_rate_hz
        return _rate_hz(frames.t_ns, frames.counter)

    def blocks(self, n_frames: int = _BLOCK) -> Iterator["RadarArrays"]:
        """Yield the frames in parts of ``n_frames``, the last one shorter, each in memory.

        For recordings that are larger than memory: the file is read as the parts are taken.
        """
        if n_frames < 1:
            raise RecordingError(f"a block needs a frame, not {n_frames}")
        if not self._all:
            return
        frames = self.frames
        if frames.kind is None:
            self._of_kind("iq")  # which raises
        begin = 0
        for samples in self._blocks(n_frames):
            rows = slice(begin, begin + len(samples))
            begin = rows.stop
            block = replace(
                frames,
                chunks=partial(iter, (samples,)),
                n_frames=len(samples),
                counter=None if frames.counter is None else frames.counter[rows],
                t_ns=None if frames.t_ns is None else frames.t_ns[rows],
                frame_rate_hz=self.frame_rate_hz,
            )
            made = _of(self.name, block, self._nothing)
            made._samples = samples
            yield made

    def _blocks(self, n_frames: int) -> Iterator[Samples]:
        """Yield arrays of ``n_frames`` rows, the last one shorter; one of none without frames."""
        frames = self.frames
        assert frames.kind is not None, "asked before"
        left = frames.n_frames
        block: Samples = np.empty((min(n_frames, left), frames.n_bins), DTYPES[frames.kind])
        filled = 0
        for chunk in frames.chunks():
            at = 0
            while at < len(chunk) and left:
                taken = min(len(chunk) - at, len(block) - filled)
                block[filled : filled + taken] = chunk[at : at + taken]
                at += taken
                filled += taken
                left -= taken
                if filled == len(block):
                    yield block
                    filled = 0
                    block = np.empty((min(n_frames, left), frames.n_bins), block.dtype)
            if not left:
                break
        if left:
            raise RecordingError(f"{self._nothing} has changed since it was loaded; load it again")
        if not frames.n_frames:
            yield block


def _of(name: str, frames: Frames, nothing: str) -> RadarArrays:
    return RadarArrays(name, lambda: (frames,), nothing)


def _rate_hz(
    t_ns: npt.NDArray[np.int64] | None, counter: npt.NDArray[np.uint32] | None
) -> float | None:
    if t_ns is None:
        return None
    known = t_ns != NO_TIME_NS
    times = t_ns[known]
    if counter is None:
        counts = np.arange(len(times), dtype=np.float64)
    else:
        counts = counter[known].astype(np.float64)
        falls = np.flatnonzero(np.diff(counts) <= 0) + 1
        ends = np.concatenate([[0], falls, [len(counts)]])
        longest = int(np.argmax(np.diff(ends)))
        run = slice(ends[longest], ends[longest + 1])
        times, counts = times[run], counts[run]
    if len(times) < 2:
        return None
    seconds = (times - times[0]) * 1e-9
    seconds -= seconds.mean()
    counts = counts - counts.mean()
    slope_s = float(seconds @ counts / (counts @ counts))
    return 1 / slope_s if slope_s > 0 else None


@dataclass(frozen=True, slots=True, kw_only=True)
class TextColumn:
    """Lines of another sensor, recorded beside the radars: ``lines[k]`` came at ``t_ns[k]``.

    ``t_ns`` has shape (n,), ns since 1970, on the clock of the frames.
    """

    name: str
    t_ns: npt.NDArray[np.int64]
    lines: tuple[str, ...]

    @property
    def values(self) -> npt.NDArray[np.float64] | None:
        """Numbers of the lines, shape (n,), or (n, k) where a line has k > 1; None if not numeric.

        They are separated by commas, semicolons or blanks. A line with other content, such as a
        title or a line that was cut, has NaN; where most are such, the column is not numeric.

        >>> TextColumn(name="belt", t_ns=np.arange(3), lines=("v", "1.5", "2")).values
        array([nan, 1.5, 2. ])
        """
        rows = [_numbers(line) for line in self.lines]
        lengths = Counter(len(row) for row in rows if row)
        if not lengths:
            return None
        width, count = lengths.most_common(1)[0]
        if 2 * count < len(rows):
            return None
        nothing = (math.nan,) * width
        table = np.array([row if len(row) == width else nothing for row in rows], np.float64)
        return table[:, 0] if width == 1 else table


def _numbers(line: str) -> tuple[float, ...]:
    """Return the numbers of a line; none if it holds anything else."""
    try:
        return tuple(map(float, line.replace(",", " ").replace(";", " ").split()))
    except ValueError:
        return ()


def _ranges_in(
    area_m: tuple[float, float] | None, n_bins: int, kind: FrameKind | None
) -> npt.NDArray[np.float64] | None:
    """Return the range of each bin, shape (n_bins,), by a frame area; None without one."""
    if area_m is None or kind is None:
        return None
    return FrameGeometry.from_read_back(
        area_m=area_m, n_bins=n_bins, downconversion=kind == "iq"
    ).ranges_m


class _ArrayLayout(NamedTuple):
    """What frames with a common array have in common."""

    message: str
    n_values: int
    geometry: FrameGeometry | None


@dataclass(slots=True)
class _FrameColumns:
    settings: dict[str, Any]  # when the first frame came
    fps: set[float] = field(default_factory=set)
    counter: "array[int]" = field(default_factory=lambda: array("I"))
    t_ns: "array[int]" = field(default_factory=lambda: array("q"))


class _Messages:
    """Frames among the messages of one radar of a recording.

    ``area_m`` and ``downconversion`` are as of `load`; ``info`` is what an MCAP file says about the
    radar: see `RecordingContent`.
    """

    def __init__(
        self,
        path: Path,
        radar: str | None,
        info: Mapping[str, Any],
        *,
        area_m: tuple[float, float] | None,
        downconversion: bool | None,
    ) -> None:
        self._path = path
        self._radar = radar
        self._area_m, self._downconversion = area_m, downconversion
        self._info = info if info.get("length_unit") == MODULE_METRES else {}
        self._settings: MutableMapping[str, Any] = {}

    def find(self, on_fault: FaultHandler) -> list[Frames]:
        """Read the recording once for what describes its frames."""
        columns: dict[_ArrayLayout, _FrameColumns] = {}
        layouts = FrameLayouts(self._downconversion)
        for layout, frame, t_ns in self._rows(on_fault, layouts):
            column = columns.get(layout)
            if column is None:
                column = columns[layout] = _FrameColumns(dict(self._settings))
            column.fps.add(self._settings.get(X4Setting.FPS.name, 0.0))
            column.counter.append(frame.info if isinstance(frame, DataFloat) else frame.counter)
            column.t_ns.append(NO_TIME_NS if t_ns is None else t_ns)
        found = layouts.layouts()
        return [self._frames(layout, column, found) for layout, column in columns.items()]

    def _frames(
        self, layout: _ArrayLayout, column: _FrameColumns, found: Mapping[int, FrameLayout]
    ) -> Frames:
        kind: FrameKind | None = "rf" if layout.message.startswith("RADAR_RF") else "iq"
        n_bins, geometry, inferred = layout.n_values, layout.geometry, False
        if layout.message == _RAW:
            raw = found[n_bins]
            if self._downconversion is None and geometry is not None:
                raw = FrameLayout(values=n_bins, downconversion=geometry.downconversion)
            kind = None if raw.downconversion is None else "iq" if raw.downconversion else "rf"
            n_bins, inferred = raw.bins or n_bins, raw.inferred
        ranges_m = _ranges_in(self._area_m, n_bins, kind)
        if ranges_m is None and geometry is not None:
            ranges_m = replace(geometry, n_bins=n_bins).ranges_m
        t_ns = np.array(column.t_ns, np.int64)
        # the first frames come before the answer that gives their rate
        running = {value for value in column.fps if real_frame_rate(value)}
        settings, rate_hz = column.settings, None
        if len(running) == 1:
            (fps,) = running
            settings = settings | {X4Setting.FPS.name: fps}
            rate_hz = real_frame_rate(fps)
        what = {"rf": "RF bins", "iq": "complex bins", None: "values"}[kind]
        return Frames(
            about=f"{n_bins} {what} ({layout.message})",
            kind=kind,
            chunks=lambda: self._chunks(layout, kind),
            n_frames=len(t_ns),
            n_bins=n_bins,
            counter=np.array(column.counter, np.uint32),
            t_ns=t_ns if (t_ns != NO_TIME_NS).any() else None,
            ranges_m=ranges_m,
            frame_rate_hz=rate_hz,
            settings=settings,
            inferred=inferred,
        )

    def _chunks(self, layout: _ArrayLayout, kind: FrameKind | None) -> Iterator[Samples]:
        for found, frame, _ in self._rows(lambda fault: None):
            if found == layout:
                yield samples_of(frame, downconversion=kind == "iq")[np.newaxis]

    def _rows(
        self, on_fault: FaultHandler, layouts: FrameLayouts | None = None
    ) -> Iterator[tuple[_ArrayLayout, FrameMessage, int | None]]:
        geometries = FrameGeometries()
        self._settings = ChainMap(geometries.answers, _settings_of(self._info))
        for message, t_ns in read_recording(self._path, on_fault, radar=self._radar):
            if layouts is not None:
                layouts.take(message)
            geometries.take(message)
            match message:
                case DataFloat(content_id=0, values=values):
                    n_values = len(values)
                    geometry = geometries.of(message) or self._described(n_values)
                case BasebandIq() | BasebandAp() | RadarMessage():
                    n_values, geometry = message.num_bins, geometries.of(message)
                    if isinstance(message, RadarMessage):
                        self._settings[X4Setting.FPS.name] = float(message.frames_per_s)
                case _:
                    continue
            yield _ArrayLayout(message_name(message), n_values, geometry), message, t_ns

    def _described(self, n_values: int) -> FrameGeometry | None:
        """Return where the bins of raw frames lie by the description of the radar."""
        n_bins, start_m, bin_m = map(self._info.get, ("n_bins", "range_start_m", "bin_length_m"))
        if n_bins not in (n_values, n_values / 2) or not (
            _is_length(start_m) and _is_length(bin_m)
        ):
            return None
        return FrameGeometry(
            range_start_m=float(start_m),
            bin_length_m=float(bin_m),
            n_bins=n_bins,
            downconversion=n_bins != n_values,
        )


def _is_length(value: object) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and math.isfinite(value)


_RAW = "DATA FLOAT"


def _settings_of(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings in the description of a radar, by their names in `X4Setting`.

    A recording has the module's answers, a session the fields of `RawConfig`.
    """
    found = info.get("settings")
    settings: dict[str, Any] = {}
    for name, value in found.items() if isinstance(found, dict) else ():
        setting = CONFIG_SETTINGS.get(name)
        if setting is X4Setting.FRAMEAREA:
            continue  # as it was asked for; where the bins lie is in the description itself
        if setting is None and name in X4Setting.__members__:
            setting = X4Setting[name]
        if setting is not None and value is not None:
            value = int(value) if isinstance(value, bool) else value
            settings[setting.name] = tuple(value) if isinstance(value, list) else value
    rate_hz = info.get("rate_hz")
    if isinstance(rate_hz, int | float) and rate_hz > 0:
        settings[X4Setting.FPS.name] = float(rate_hz)
    return settings


class Recording(RadarArrays):
    """A recording as arrays, made by `load`: those of its only radar, and of each by name.

    Where there are several radars, the arrays of the whole raise `RecordingError`.

    Attributes
    ----------
    path
        As given.
    radars
        By name, in that order; the only radar of a recording without names is ``""``.
    texts
        Lines of other sensors, by the name of their column.
    """

    def __init__(
        self, path: Path, radars: Mapping[str, RadarArrays], texts: Mapping[str, TextColumn]
    ) -> None:
        super().__init__("", lambda: self.radar._all, str(path))
        self.path = path
        self.radars = radars
        self.texts = texts

    def __repr__(self) -> str:
        parts = [*map(repr, self.radars.values()), *(f"text {name}" for name in self.texts)]
        return f"<Recording {self.path}: {', '.join(parts)}>"

    @property
    def radar(self) -> RadarArrays:
        """The only radar; RecordingError if there are several."""
        return self.named(None)

    def named(self, name: str | None) -> RadarArrays:
        """Return a radar by name, the only one for None; RecordingError if there is none such."""
        if not self.radars:
            raise RecordingError(f"{self.path} holds no radar frames")
        names = ", ".join(map(shown, self.radars))
        if name is None:
            if len(self.radars) != 1:
                raise RecordingError(
                    f"{self.path} holds {len(self.radars)} radars, not one: {names}; "
                    "choose one: --radar NAME, in Python .radars[NAME]"
                )
            (name,) = self.radars
        if name not in self.radars:
            refuse_name(self.path, None if any(self.radars) else name)
            raise RecordingError(f"{self.path} holds no radar {shown(name)}; it holds {names}")
        return self.radars[name]

    @cached_property
    def _samples(self) -> Samples:
        return self.radar._samples


def load(
    path: Path | str,
    on_fault: FaultHandler | None = None,
    *,
    area_m: tuple[float, float] | None = None,
    downconversion: bool | None = None,
) -> Recording:
    """Return a recording as arrays, which are read when they are first used.

    What a recording does not say is None in the result, and can be given: where the bins lie, and
    what its frames are.

    Parameters
    ----------
    path
        Any recording that `read_recording` takes, or a file of arrays: ``.csv``, ``.mat`` or
        ``.npz`` with ``iq`` or ``rf`` of shape (n_frames, n_bins), and, if known, ``t_ns``,
        ``counter``, ``ranges_m``, ``frame_rate_hz``.
    on_fault
        Called with what could not be read, such as the end of a file that was cut; the rest is
        read all the same. None: lost messages raise `RecordingError`.
    area_m
        Frame area as the module read it back: range of the first bin, and of the last one of
        baseband or the one behind the last of RF [module metres]. Protocol reference 9.4.
    downconversion
        Whether radar frames are baseband, which recordings of the vendor's format do not say: it
        is inferred from how smooth frames are over range.

    Raises
    ------
    RecordingError
        There is nothing to read here, or, when arrays are first used, the recording is damaged.

    Examples
    --------
    ::

        recording = load("rec")
        power = np.abs(recording.iq).mean(axis=0)
        plt.plot(recording.true_ranges_m, power)
    """
    path = Path(path)
    for limit_m in area_m or ():
        if not math.isfinite(limit_m):
            raise RecordingError(f"a range cannot be {limit_m}")
    if is_array_file(path):

        def find() -> Sequence[Frames]:
            frames = read_array_file(path, on_fault, downconversion=downconversion)
            ranges_m = _ranges_in(area_m, frames.n_bins, frames.kind)
            return [frames if ranges_m is None else replace(frames, ranges_m=ranges_m)]

        return Recording(path, {"": RadarArrays("", find, str(path))}, {})
    content = recording_content(path)
    reported: set[RecordingFault] = set()

    def note(fault: RecordingFault) -> None:
        """Report each fault once: every radar of a file meets all of its faults."""
        if fault in reported:
            return
        reported.add(fault)
        try:
            report(fault, on_fault)
        except RecordingError as error:
            raise RecordingError(f"{error}; load(path, print) reads the rest") from None

    def radar(name: str, info: Mapping[str, Any]) -> RadarArrays:
        messages = _Messages(path, name or None, info, area_m=area_m, downconversion=downconversion)
        return RadarArrays(name, lambda: messages.find(note), str(path))

    radars = {name: radar(name, info) for name, info in sorted(content.radars.items())}
    texts = {
        name: TextColumn(
            name=name,
            t_ns=np.array([t_ns for t_ns, _ in lines], np.int64),
            lines=tuple(line for _, line in lines),
        )
        for name, lines in content.texts.items()
    }
    return Recording(path, radars, texts)
