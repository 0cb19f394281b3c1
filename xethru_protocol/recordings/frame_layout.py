"""What the values of radar frames are: RF, or complex baseband.

A frame does not say it (Protocol reference 6.1), and recordings of the vendor's format hold no
settings. What can be known: a module that was asked for its bin count gave it; more values than two
for each of 188 baseband bins, or an odd number of them, are RF (9.4). Else it is inferred from the
frames themselves. The chip samples RF at 3.2 values per period of its carrier, so that neighbours
differ about as much as they are large; white noise does so, too. Baseband bins are filtered to the
pulse's bandwidth and neighbours are alike, in the first half of the values (I) and in the second
(Q). Each pair of neighbours counts the same, so that one near bin that outshines all others does
not decide.
"""

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from xethru_protocol.driver.frames import FrameGeometry, complex_of
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.messages import (
    REGISTERS,
    BasebandAp,
    BasebandIq,
    DataFloat,
    RadarBasebandFloat,
    RadarBasebandQ15,
    RadarMessage,
    RadarRf,
    RadarRfNormalized,
    ReplyByte,
    ReplyFloat,
    ReplyInt,
)
from xethru_protocol.wire.table import Response

_MOST_BASEBAND_BINS = 188  # Protocol reference 9.4
_ENOUGH_FRAMES = 64
_FEWEST_BINS = 8  # fewer do not show whether a frame is smooth
# 0 for equal neighbours, 1 for independent ones. Emulated RF frames have 0.99 to 1.2, emulated and
# real baseband 0.2 to 0.6.
_SMOOTH, _ROUGH = 0.72, 0.85


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameLayout:
    """What frames with a number of ``values`` are.

    ``downconversion`` is None where that is not known; ``inferred``: it is a conclusion from the
    frames' content and may be wrong.
    """

    values: int
    downconversion: bool | None
    inferred: bool = False

    @property
    def bins(self) -> int | None:
        if self.downconversion is None:
            return None
        return self.values // 2 if self.downconversion else self.values

    def __str__(self) -> str:
        """Describe it.

        >>> str(FrameLayout(values=182, downconversion=True, inferred=True))
        'probably 91 complex baseband bins'
        """
        if self.downconversion is None:
            return f"{self.values} values, RF or complex baseband"
        kind = "complex baseband" if self.downconversion else "RF"
        return f"{'probably ' if self.inferred else ''}{self.bins} {kind} bins"


@dataclass(slots=True)
class FrameLayouts:
    """Gathers what shows the layout of the frames of a recording, message by message.

    ``downconversion`` is what the caller knows about all of them; None: nothing.
    """

    downconversion: bool | None = None
    _frames: dict[int, list[npt.NDArray[np.float32]]] = field(default_factory=dict)
    _answered: dict[int, bool] = field(default_factory=dict)  # by number of values
    _bin_count: int | None = None
    _counts: Counter[int] = field(default_factory=Counter)

    def take(self, message: Response) -> None:
        match message:
            case ReplyInt(content_id=X4Setting.FRAMEBINCOUNT, values=(count,)):
                self._bin_count = count
            case DataFloat(content_id=0, values=values):
                length = len(values)
                self._counts[length] += 1
                if _is_rf(length):
                    return
                if self._bin_count is not None and length in (self._bin_count, 2 * self._bin_count):
                    self._answered[length] = length != self._bin_count
                kept = self._frames.setdefault(length, [])
                if len(kept) < _ENOUGH_FRAMES:
                    kept.append(values)

    def layouts(self) -> dict[int, FrameLayout]:
        """Return the layouts by number of values, the most frequent first."""
        return {length: self._layout(length) for length, _ in self._counts.most_common()}

    def _layout(self, length: int) -> FrameLayout:
        if _is_rf(length):
            return FrameLayout(values=length, downconversion=False)
        if self.downconversion is not None:
            return FrameLayout(values=length, downconversion=self.downconversion)
        if length in self._answered:
            return FrameLayout(values=length, downconversion=self._answered[length])
        frames = np.array(self._frames[length], np.float64)
        roughness = _roughness(frames.reshape(len(frames), 2, length // 2))
        if roughness is None or _SMOOTH <= roughness <= _ROUGH:
            return FrameLayout(values=length, downconversion=None)
        return FrameLayout(values=length, downconversion=roughness < _SMOOTH, inferred=True)


FrameMessage = DataFloat | BasebandIq | BasebandAp | RadarMessage
"""A message that holds a frame, DATA FLOAT if its content is 0."""
_SETTINGS = frozenset(X4Setting) - REGISTERS
_PLACES = (X4Setting.FRAMEAREA.name, X4Setting.FRAMEBINCOUNT.name)


class FrameGeometries:
    """Gathers the module's answers about its settings, which say where a frame's bins lie.

    ``answers`` has them by the names of `X4Setting`; FRAMEAREA is (start, end) in module metres.
    """

    def __init__(self) -> None:
        self.answers: dict[str, Any] = {}

    def take(self, message: Response) -> None:
        match message:
            case ReplyByte() | ReplyInt() | ReplyFloat():
                if message.content_id in _SETTINGS and message.values:
                    values = tuple(message.values)
                    name = X4Setting(message.content_id).name
                    self.answers[name] = values[0] if len(values) == 1 else values

    def about(self, frame: FrameMessage) -> dict[str, Any]:
        """Return what is known of a frame, by the names in the info of an MCAP file."""
        geometry = self.of(frame)
        return {
            "range_start_m": None if geometry is None else geometry.range_start_m,
            "bin_length_m": None if geometry is None else geometry.bin_length_m,
            "n_bins": None if geometry is None else geometry.n_bins,
            "settings": {name: self.answers[name] for name in _PLACES if name in self.answers},
        }

    def of(self, frame: FrameMessage) -> FrameGeometry | None:
        """Return where the bins of a frame lie, by the message or the answers; None if unknown."""
        geometry: FrameGeometry | None
        if isinstance(frame, DataFloat):
            geometry = self._answered(len(frame.values))
        else:
            geometry = FrameGeometry(
                range_start_m=frame.range_offset_m,
                bin_length_m=frame.bin_length_m,
                n_bins=frame.num_bins,
                downconversion=not isinstance(frame, RadarRf | RadarRfNormalized),
            )
        is_known = geometry is not None and all(map(math.isfinite, geometry.area_m))
        return geometry if is_known else None

    def _answered(self, n_values: int) -> FrameGeometry | None:
        match tuple(map(self.answers.get, _PLACES)):
            case (start_m, end_m), int(n_bins) if n_values in {n_bins, 2 * n_bins}:
                return FrameGeometry.from_read_back(
                    area_m=(float(start_m), float(end_m)),
                    n_bins=n_bins,
                    downconversion=n_values == 2 * n_bins,
                )
        return None  # they are missing, or of another time


def samples_of(frame: FrameMessage, *, downconversion: bool) -> npt.NDArray[Any]:
    """Return RF or complex baseband, shape (n_bins,); ``downconversion`` is that of DATA FLOAT."""
    match frame:
        case DataFloat(values=values):
            return complex_of(*np.split(values, 2)) if downconversion else values
        case BasebandAp(amplitude=amplitude, phase=phase):
            return complex_of(amplitude * np.cos(phase), amplitude * np.sin(phase))
        case BasebandIq(i=i, q=q):
            return complex_of(i, q)
        case RadarBasebandFloat() | RadarBasebandQ15():
            return frame.iq
        case RadarRf() | RadarRfNormalized():
            return frame.samples.astype(np.float32)
    raise AssertionError(f"no frame: {frame}")


def _is_rf(length: int) -> bool:
    """Whether so many values can be nothing else."""
    return length % 2 == 1 or length > 2 * _MOST_BASEBAND_BINS


def _roughness(halves: npt.NDArray[np.float64]) -> float | None:
    """Mean over neighbours in range of their squared distance, per the sum of their powers.

    ``halves`` has shape (n, 2, bins), I and Q of each frame. None for frames that are too short,
    constant or not finite.
    """
    halves = halves[np.isfinite(halves).all(axis=(1, 2))]
    if halves.shape[2] < _FEWEST_BINS or not len(halves):
        return None
    halves = halves - np.median(halves, axis=2, keepdims=True)
    power = np.square(halves).sum(axis=1)
    power = power[:, 1:] + power[:, :-1]
    step = np.square(np.diff(halves, axis=2)).sum(axis=1)
    return float(np.mean(step[power > 0] / power[power > 0])) if power.any() else None
