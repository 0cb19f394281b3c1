"""Faults of the stream of frames: counters, samples, and what an environment adds to samples."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from pydantic import Field

from emulator.chip.chip import NS_PER_S
from emulator.faults.kind import (
    COUNTERS,
    NO_TIME_IN_FRAMES,
    SEEN_IN_TIMES,
    Catalogued,
    Context,
    Layer,
    Parameters,
    Piece,
    Pieces,
    RfSamples,
    Target,
    changed_frame,
    frame_counter,
    frame_packet,
    frame_samples,
)
from emulator.scene.philox import Rng
from xethru_protocol.wire.x4 import FIRST_COUNTER

of_frame = Catalogued(Layer.STREAM, Target.FRAME)
of_packet = Catalogued(Layer.STREAM, Target.PACKET)
of_environment = Catalogued(Layer.ENVIRONMENT, Target.FRAME)

_CYCLES_PER_BIN = 7.29 / 23.328  # carrier of the pulse over the sampling rate, Hz / Hz


class _FrameCount(Parameters):
    frames: int = Field(1, ge=1, le=2**31 - 2, description="how many frames")


class _Copies(Parameters):
    copies: int = Field(1, ge=1, le=1000, description="how many more")


class _Slower(Parameters):
    percent: float = Field(10.0, gt=0, le=900, description="how much longer a period is, %")


class _Seconds(Parameters):
    seconds: float = Field(1.5, gt=0, le=86_400, description="how long, s")


class _ClippingLevel(Parameters):
    level: float = Field(
        0.5, gt=0, lt=1, description="part of the frame's largest amplitude that is left"
    )


class _DeadBins(Parameters):
    first: int = Field(0, ge=0, le=1535, description="first dead bin")
    bins: int = Field(8, ge=1, le=1536, description="how many")


class _Amplitude(Parameters):
    amplitude: float = Field(
        0.01, ge=-1, le=1, description="what is added, full scale of the DAC is +-1"
    )


class _Clutter(Parameters):
    bin: int = Field(20, ge=0, le=1535, description="bin of its middle")
    amplitude: float = Field(0.05, gt=0, le=1, description="full scale of the DAC is 1")
    bins: float = Field(4.0, gt=0, le=200, description="standard deviation, bins")


class _Pulses(Parameters):
    pulses: int = Field(5, ge=1, le=1000, description="pulses per frame")
    amplitude: float = Field(0.05, gt=0, le=1, description="full scale of the DAC is 1")


class _Fading(Parameters):
    depth_db: float = Field(12.0, gt=0, le=60, description="deepest, dB")
    period_s: float = Field(5.0, gt=0, le=3600, description="from fade to fade, s")


_BACK = "A counter that goes back looks like a chip that was restarted, which loses nothing."
_CONTENT = "The samples are values that the chip can give; only the scene shows the fault."


def _renumbered(packet: bytes, number: Callable[[int], int]) -> Pieces:
    counter = frame_counter(packet)
    if counter is None:
        return None
    return [Piece(frame_packet(number(counter), frame_samples(packet)))]


def _since_first(counter: int, context: Context) -> int:
    return counter - (counter if context.first_counter is None else context.first_counter)


def _distorted(
    packet: bytes, context: Context, distort: Callable[[RfSamples], RfSamples]
) -> Pieces:
    """Return a frame with other samples, rounded to values of the chip."""
    lattice = context.lattice
    if lattice is None:
        return None
    return changed_frame(packet, lambda samples: lattice.nearest(distort(samples)))


@of_frame("frames_lost += frames", _FrameCount, lasting=True, again="adds")
def counter_jump(packet: bytes, wanted: _FrameCount, rng: Rng, context: Context) -> Pieces:
    """The frame counter jumps ahead, and goes on from there."""
    return _renumbered(packet, lambda counter: counter + wanted.frames * context.firings)


@of_frame(
    "nothing; the counters of the frames show it",
    _FrameCount,
    lasting=True,
    again="adds",
    hidden=_BACK,
)
def counter_back(packet: bytes, wanted: _FrameCount, rng: Rng, context: Context) -> Pieces:
    """The frame counter jumps back, and goes on from there."""
    return _renumbered(packet, lambda counter: counter - wanted.frames * context.firings)


@of_frame("nothing; a wrap is not a loss", _FrameCount, lasting=True, hidden=_BACK)
def counter_wrap(packet: bytes, wanted: _FrameCount, rng: Rng, context: Context) -> Pieces:
    """The frame counter goes on shortly before 2**32, and wraps after some frames."""
    return _renumbered(
        packet, lambda counter: COUNTERS - wanted.frames + _since_first(counter, context)
    )


@of_frame("nothing; the counters of the frames show it", _FrameCount, lasting=True, hidden=_BACK)
def counter_reset(packet: bytes, wanted: _FrameCount, rng: Rng, context: Context) -> Pieces:
    """The frame counter begins again at 1, as after INIT."""
    return _renumbered(packet, lambda counter: FIRST_COUNTER + _since_first(counter, context))


@of_frame(
    "nothing; two frames with one counter show it",
    _Copies,
    hidden="The counter does not move, so no frame is missing.",
)
def duplicate_frame(packet: bytes, wanted: _Copies, rng: Rng, context: Context) -> Pieces:
    """A frame comes again."""
    return [Piece(packet)] * (1 + wanted.copies)


@of_frame("frames_lost += frames", _FrameCount, lasting=True, again="ends")
def missing_frames(packet: bytes, wanted: _FrameCount, rng: Rng, context: Context) -> Pieces:
    """Frames are missing."""
    return [] if context.packets_since < wanted.frames else [Piece(packet)]


@of_frame("frames_lost += 2: the counter jumps ahead by one twice")
def reordered_frames(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A frame comes behind the next one."""
    return [Piece(packet, behind=1)]


@of_frame(SEEN_IN_TIMES, _Slower, lasting=True, hidden=NO_TIME_IN_FRAMES)
def slow_rate(packet: bytes, wanted: _Slower, rng: Rng, context: Context) -> Pieces:
    """Frames come at a lower rate than was asked for."""
    delay_ns = round((context.now_ns - context.since_ns) * wanted.percent / 100)
    return [Piece(packet, delay_ns=delay_ns)]


@of_packet(
    f"{SEEN_IN_TIMES}, and ResponseTimeout if someone waits for less",
    _Seconds,
    lasting=True,
    again="ends",
    hidden=NO_TIME_IN_FRAMES,
)
def stall(packet: bytes, wanted: _Seconds, rng: Rng, context: Context) -> Pieces:
    """Nothing comes for a while, then all at once."""
    end_ns = context.since_ns + round(wanted.seconds * NS_PER_S)
    return [Piece(packet, delay_ns=max(end_ns - context.now_ns, 0))]


@of_frame("nothing", _ClippingLevel, hidden=_CONTENT)
def saturation(packet: bytes, wanted: _ClippingLevel, rng: Rng, context: Context) -> Pieces:
    """The amplitudes of a frame are clipped."""

    def clipped(samples: RfSamples) -> RfSamples:
        limit = wanted.level * np.abs(samples).max()
        return np.clip(samples, -limit, limit)

    return _distorted(packet, context, clipped)


@of_frame("nothing", _DeadBins, hidden=_CONTENT)
def dead_bins(packet: bytes, wanted: _DeadBins, rng: Rng, context: Context) -> Pieces:
    """Bins of a frame are stuck at one value."""

    def stuck(samples: RfSamples) -> RfSamples | None:
        if wanted.first >= samples.size:
            return None
        dead = samples.copy()
        # at a value that the chip can give
        dead[wanted.first : wanted.first + wanted.bins] = samples[wanted.first]
        return dead

    return changed_frame(packet, stuck)


@of_frame("nothing", _Amplitude, lasting=True, hidden=_CONTENT)
def dc_step(packet: bytes, wanted: _Amplitude, rng: Rng, context: Context) -> Pieces:
    """All samples are moved by the same amount from now on."""
    return _distorted(packet, context, lambda samples: samples + np.float32(wanted.amplitude))


@of_frame("nothing", hidden=_CONTENT)
def stale_frame(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A frame carries the samples of the one before."""
    before = context.previous_frame
    if before is None or len(before) != len(packet):
        return None
    return changed_frame(packet, lambda samples: frame_samples(before))


@of_environment("nothing", _Clutter, lasting=True, hidden=_CONTENT)
def strong_clutter(packet: bytes, wanted: _Clutter, rng: Rng, context: Context) -> Pieces:
    """A strong reflector stands in one place."""

    def with_clutter(samples: RfSamples) -> RfSamples:
        bins = np.arange(samples.size) - wanted.bin
        envelope = np.exp(-0.5 * (bins / wanted.bins) ** 2)
        wave = wanted.amplitude * envelope * np.cos(2 * math.pi * _CYCLES_PER_BIN * bins)
        return np.asarray(samples + wave, np.float32)

    return _distorted(packet, context, with_clutter)


@of_environment("nothing", _Pulses, lasting=True, hidden=_CONTENT)
def interference(packet: bytes, wanted: _Pulses, rng: Rng, context: Context) -> Pieces:
    """Every frame has pulses at random bins."""

    def with_pulses(samples: RfSamples) -> RfSamples:
        pulses = np.zeros(samples.size)
        for _ in range(wanted.pulses):
            pulses[rng.below(samples.size)] += wanted.amplitude * (2 * rng.below(2) - 1)
        return (samples + pulses).astype(np.float32)

    return _distorted(packet, context, with_pulses)


@of_environment("nothing", _Fading, lasting=True, hidden=_CONTENT)
def fading(packet: bytes, wanted: _Fading, rng: Rng, context: Context) -> Pieces:
    """All echoes fade and come back."""
    phase = (context.now_ns - context.since_ns) / NS_PER_S / wanted.period_s
    loss_db = wanted.depth_db * (1 - math.cos(2 * math.pi * phase)) / 2
    return _distorted(packet, context, lambda samples: samples * np.float32(10 ** (-loss_db / 20)))
