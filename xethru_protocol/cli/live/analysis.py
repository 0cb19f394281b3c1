"""What live commands show of the frames so far: newest frame, waterfall, Doppler, breathing."""

from __future__ import annotations

import os

# Before numpy is loaded: for matrices of this size, threads of BLAS cost ten times what they do.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from xethru_protocol.cli.live.sources import FrameSource, TimedFrame
from xethru_protocol.cli.output import CommandFailed
from xethru_protocol.processing.clutter import METHODS, ClutterFilter, Method
from xethru_protocol.processing.doppler import SPEED_OF_LIGHT_MPS, RangeDoppler, range_doppler
from xethru_protocol.processing.downconversion import downconvert, line_bins
from xethru_protocol.processing.presence import Presence, PresenceMonitor
from xethru_protocol.processing.vital import Breathing, BreathingMonitor, phase_at

WATERFALL_S = 30.0
_DOPPLER_FRAMES = 64
_CHEST_EVERY_S = 0.5
_LEAST_RATE_HZ = 4.0
_LEAST_BINS = 16
_LONGEST_GAP_S = 0.5
"""A third of the shortest breath: a longer gap without frames begins a new window."""
_LEAST_RF_BINS = 160
"""16 lines of baseband, every 8th bin, and the filter's length."""

Clutter = Method | Literal["none"]
CLUTTERS: tuple[Clutter, ...] = ("none", *METHODS)
Floats = NDArray[np.float32] | NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class VitalAnswer:
    """What is known of a person at a moment.

    Attributes
    ----------
    t_s
        Time of the newest frame, since the first.
    heard_s, window_s
        For how long frames came, and how long a window must be for an answer.
    breathing
        Rate, confidence and range; None: no answer.
    presence
        Whether somebody is there and moves; None: not known yet.
    """

    t_s: float
    heard_s: float
    window_s: float
    breathing: Breathing | None
    presence: Presence | None

    @property
    def text(self) -> str:
        """The answer in words."""
        if self.breathing is not None:
            found = self.breathing
            return (
                f"{found.rate_bpm:.1f} breaths/min at {found.range_m:.2f} m, "
                f"confidence {found.confidence:.2f}"
            )
        return self.no_answer

    @property
    def no_answer(self) -> str:
        """Why there is no rate; empty if there is one."""
        if self.breathing is not None:
            return ""
        there = self.presence
        if there is not None and there.moving:
            return f"no answer: someone moves at {there.range_m:.2f} m"
        if there is not None and not there.present:
            return "nobody"
        if self.heard_s < self.window_s:
            return f"listening: {self.heard_s:.0f} of {self.window_s:.0f} s"
        return "no answer: breathing is not clear"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LiveUpdate:
    """A picture's content at a moment; all arrays are its own.

    Attributes
    ----------
    name, clutter
        Port or recording, and the clutter filter's method.
    t_s, n_frames, n_lost, frame_rate_hz
        Time of the newest frame, frames so far, frames that did not arrive, frames per second.
    carrier_hz
        Centre frequency of the pulse.
    ranges_m
        Shape (n_bins,).
    profile
        Shape (n_bins,): amplitude of the newest frame behind the clutter filter.
    rf_ranges_m, rf
        Newest frame as it came, shape (n_rf_bins,) each; None for baseband.
    waterfall
        Shape (n_rows, n_bins): amplitudes behind the clutter filter, the newest frame in row 0;
        rows of frames that did not come yet are 0.
    waterfall_s
        Time that the rows span.
    doppler
        Range-Doppler map of the newest frames, behind the clutter filter; None at first.
    chest_s, chest_mm
        Displacement of the breathing chest, towards the radar, over time before now; None while
        there is no breathing.
    vital
        Breathing and presence.
    """

    name: str
    clutter: str
    t_s: float
    n_frames: int
    n_lost: int
    frame_rate_hz: float
    carrier_hz: float
    ranges_m: NDArray[np.float64]
    profile: Floats
    rf_ranges_m: NDArray[np.float64] | None
    rf: NDArray[np.float32] | None
    waterfall: NDArray[np.float32]
    waterfall_s: float
    doppler: RangeDoppler | None
    chest_s: NDArray[np.float64] | None
    chest_mm: NDArray[np.float64] | None
    vital: VitalAnswer


class VitalSignsAnalysis:
    """Breathing and presence from frames as they come.

    Attributes
    ----------
    ranges_m
        Where the bins of `take`'s results lie, shape (n_bins,).

    Raises
    ------
    CommandFailed
        Frames too short to be downconverted, or to find anybody in.
    """

    def __init__(self, source: FrameSource, window_s: float) -> None:
        self._source, self._window_s = source, window_s
        self.ranges_m = source.ranges_m
        rate_hz, n_bins = source.frame_rate_hz, len(source.ranges_m)
        if rate_hz < _LEAST_RATE_HZ:
            raise CommandFailed(
                f"{rate_hz:g} frames/s are too few: breathing needs {_LEAST_RATE_HZ:g} (--fps)"
            )
        if n_bins < (_LEAST_BINS if source.is_iq else _LEAST_RF_BINS):
            raise CommandFailed(f"{n_bins} bins are too few: take a longer --frame-area")
        if not source.is_iq:
            center = source.tx_center_frequency
            self.ranges_m = source.ranges_m[line_bins(n_bins, tx_center_frequency=center)]
        carrier_hz = source.carrier_hz
        self._presence = PresenceMonitor(self.ranges_m, rate_hz, carrier_hz=carrier_hz)
        self._breathing = BreathingMonitor(
            self.ranges_m, rate_hz, window_s=window_s, carrier_hz=carrier_hz
        )
        self._heard, self._t_s = 0, 0.0

    def take(self, frame: TimedFrame) -> NDArray[np.complex64]:
        """Take the next frame; return it as complex baseband."""
        if self._source.is_iq:
            iq = np.asarray(frame.samples, dtype=np.complex64)
        else:
            center = self._source.tx_center_frequency
            iq = downconvert(frame.samples[np.newaxis], tx_center_frequency=center)[0]
        if frame.t_s - self._t_s > _LONGEST_GAP_S + 1.0 / self._source.frame_rate_hz:
            self._breathing.reset()
            self._presence.reset()
            self._heard = 0
        self._heard += 1
        self._t_s = frame.t_s
        self._breathing.update(iq)
        self._presence.update(iq)
        return iq

    def answer(self) -> VitalAnswer:
        return VitalAnswer(
            t_s=self._t_s,
            heard_s=self._heard / self._source.frame_rate_hz,
            window_s=self._window_s,
            breathing=self._breathing.breathing,
            presence=self._presence.presence,
        )


class LiveAnalysis:
    """Takes every frame; makes a `LiveUpdate` when one is asked for."""

    def __init__(self, source: FrameSource, *, clutter: Clutter, window_s: float) -> None:
        self._source, self._clutter = source, clutter
        self.vital = VitalSignsAnalysis(source, window_s)
        self._filter = _filter_of(clutter)
        rate_hz, n_bins = source.frame_rate_hz, len(self.vital.ranges_m)
        self._n_rows = max(round(WATERFALL_S * rate_hz), 2)
        # twice, so that the newest rows are always one piece
        self._raw = np.zeros((2 * self._n_rows, n_bins), dtype=np.complex64)
        self._filtered = np.zeros_like(self._raw)
        self._n_frames = 0
        self._newest: TimedFrame | None = None
        self._chest: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._chest_at_s = -_CHEST_EVERY_S

    def take(self, frame: TimedFrame) -> None:
        iq = self.vital.take(frame)
        filtered = iq if self._filter is None else self._filter.update(iq)
        place = self._n_frames % self._n_rows
        for ring, row in ((self._raw, iq), (self._filtered, filtered)):
            ring[place] = ring[place + self._n_rows] = row
        self._n_frames += 1
        self._newest = frame

    def switch_clutter(self) -> None:
        """Take the next of `CLUTTERS`, for the frames that are shown, too."""
        self._clutter = CLUTTERS[(CLUTTERS.index(self._clutter) + 1) % len(CLUTTERS)]
        self._filter = _filter_of(self._clutter)
        for number in range(max(self._n_frames - self._n_rows, 0), self._n_frames):
            place = number % self._n_rows
            iq = self._raw[place]
            filtered = iq if self._filter is None else self._filter.update(iq)
            self._filtered[place] = self._filtered[place + self._n_rows] = filtered

    def update(self) -> LiveUpdate:
        """Return what there is to show; a frame must have come."""
        assert self._newest is not None
        source, vital = self._source, self.vital.answer()
        rows = self._newest_of(self._filtered)
        enough = min(self._n_frames, _DOPPLER_FRAMES)
        chest = self._chest_of(vital.breathing)
        return LiveUpdate(
            name=source.name,
            clutter=self._clutter,
            t_s=self._newest.t_s,
            n_frames=self._n_frames,
            n_lost=source.lost(),
            frame_rate_hz=source.frame_rate_hz,
            carrier_hz=source.carrier_hz,
            ranges_m=self.vital.ranges_m,
            profile=np.abs(rows[-1]),
            rf_ranges_m=None if source.is_iq else source.ranges_m,
            rf=None if source.is_iq else np.array(self._newest.samples.real, dtype=np.float32),
            waterfall=np.abs(rows[::-1]),
            waterfall_s=self._n_rows / source.frame_rate_hz,
            doppler=None
            if enough < 2
            else range_doppler(rows[-enough:], source.frame_rate_hz, carrier_hz=source.carrier_hz),
            chest_s=None if chest is None else chest[0],
            chest_mm=None if chest is None else chest[1],
            vital=vital,
        )

    def _newest_of(self, ring: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Return the rows of the newest frames, the newest last."""
        place = self._n_frames % self._n_rows
        return ring[place : place + self._n_rows]

    def _chest_of(
        self, breathing: Breathing | None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Return times before now and displacement, where one breathes; now and then anew."""
        assert self._newest is not None
        if breathing is None:
            self._chest = None
        elif self._chest is None or self._newest.t_s - self._chest_at_s >= _CHEST_EVERY_S:
            self._chest_at_s = self._newest.t_s
            rows = self._newest_of(self._raw)[-self._n_frames :]
            phase = phase_at(rows, self.vital.ranges_m, breathing.range_m)
            wavelength_mm = 1e3 * SPEED_OF_LIGHT_MPS / self._source.carrier_hz
            millimetres = phase * (wavelength_mm / (4 * np.pi))
            since_s = (np.arange(len(rows)) - len(rows) + 1) / self._source.frame_rate_hz
            self._chest = since_s, millimetres - millimetres.mean()
        return self._chest


def _filter_of(clutter: Clutter) -> ClutterFilter | None:
    return None if clutter == "none" else ClutterFilter(clutter)
