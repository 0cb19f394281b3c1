"""Faults of the stream of frames: counters, samples, and what an environment adds to samples."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emulator.faults.kind import (
    Context,
    Layer,
    Parameters,
    Piece,
    Pieces,
    Target,
    frame_packet,
    frame_parts,
    kind,
)
from emulator.scene.philox import Rng

_WRAP = 1 << 32
_NS_PER_S = 1_000_000_000


class _Frames(Parameters):
    frames: Annotated[int, Field(ge=1, le=2**31 - 2, description="how many frames")] = 1


class _Copies(Parameters):
    copies: Annotated[int, Field(ge=1, le=1000, description="how many more")] = 1


class _Slower(Parameters):
    percent: Annotated[float, Field(gt=0, le=900, description="how much longer a period is, %")] = (
        10.0
    )


class _Seconds(Parameters):
    seconds: Annotated[float, Field(gt=0, le=86_400, description="how long, s")] = 1.5


class _Level(Parameters):
    level: Annotated[
        float, Field(gt=0, lt=1, description="part of the frame's largest amplitude that is left")
    ] = 0.5


class _DeadBins(Parameters):
    first: Annotated[int, Field(ge=0, le=1535, description="first dead bin")] = 0
    bins: Annotated[int, Field(ge=1, le=1536, description="how many")] = 8


class _Amplitude(Parameters):
    amplitude: Annotated[
        float, Field(ge=-1, le=1, description="what is added, full scale of the DAC is +-1")
    ] = 0.01


def _renumbered(packet: bytes, number: Callable[[int], int]) -> Pieces:
    parts = frame_parts(packet)
    return None if parts is None else [Piece(frame_packet(number(parts.counter), parts.samples))]


def _since_first(counter: int, context: Context) -> int:
    return counter - (counter if context.first_counter is None else context.first_counter)


_BACK = "A counter that goes back looks like a chip that was restarted, which loses nothing."
_CONTENT = "The samples are values that the chip can give; only the scene shows the fault."
_TIMING = "Frames carry no time; only when they arrive shows it."


_CYCLES_PER_BIN = 7.29 / 23.328  # carrier of the pulse over the sampling rate, Hz / Hz


class _Clutter(Parameters):
    bin: Annotated[int, Field(ge=0, le=1535, description="bin of its middle")] = 20
    amplitude: Annotated[float, Field(gt=0, le=1, description="full scale of the DAC is 1")] = 0.05
    bins: Annotated[float, Field(gt=0, le=200, description="standard deviation, bins")] = 4.0


class _Pulses(Parameters):
    pulses: Annotated[int, Field(ge=1, le=1000, description="pulses per frame")] = 5
    amplitude: Annotated[float, Field(gt=0, le=1, description="full scale of the DAC is 1")] = 0.05


class _Fading(Parameters):
    depth_db: Annotated[float, Field(gt=0, le=60, description="deepest, dB")] = 12.0
    period_s: Annotated[float, Field(gt=0, le=3600, description="from fade to fade, s")] = 5.0


def _with_echo(
    packet: bytes, context: Context, echo: Callable[[int], NDArray[np.float64]]
) -> Pieces:
    """Return a frame with something added to its n samples, rounded to values of the chip."""
    parts = frame_parts(packet)
    if parts is None or context.lattice is None or parts.samples.size == 0:
        return None
    seen = parts.samples + echo(parts.samples.size)
    samples = context.lattice.nearest(seen.astype(np.float32))
    return [Piece(frame_packet(parts.counter, samples))]


@kind(Layer.STREAM, Target.FRAME, "frames_lost += frames", _Frames, lasting=True)
def counter_jump(packet: bytes, wanted: _Frames, rng: Rng, context: Context) -> Pieces:
    """The frame counter jumps ahead, and goes on from there."""
    return _renumbered(packet, lambda counter: counter + wanted.frames * context.firings)


@kind(
    Layer.STREAM,
    Target.FRAME,
    "nothing; the counters of the frames show it",
    _Frames,
    lasting=True,
    hidden=_BACK,
)
def counter_back(packet: bytes, wanted: _Frames, rng: Rng, context: Context) -> Pieces:
    """The frame counter jumps back, and goes on from there."""
    return _renumbered(packet, lambda counter: counter - wanted.frames * context.firings)


@kind(Layer.STREAM, Target.FRAME, "nothing; a wrap is no loss", _Frames, lasting=True, hidden=_BACK)
def counter_wrap(packet: bytes, wanted: _Frames, rng: Rng, context: Context) -> Pieces:
    """The frame counter goes on shortly before 2**32, and wraps after some frames."""
    return _renumbered(
        packet, lambda counter: _WRAP - wanted.frames + _since_first(counter, context)
    )


@kind(
    Layer.STREAM,
    Target.FRAME,
    "nothing; the counters of the frames show it",
    _Frames,
    lasting=True,
    hidden=_BACK,
)
def counter_reset(packet: bytes, wanted: _Frames, rng: Rng, context: Context) -> Pieces:
    """The frame counter begins again at 0."""
    return _renumbered(packet, lambda counter: _since_first(counter, context))


@kind(
    Layer.STREAM,
    Target.FRAME,
    "nothing; two frames with one counter show it",
    _Copies,
    hidden="The counter does not move, so no frame is missing.",
)
def duplicate_frame(packet: bytes, wanted: _Copies, rng: Rng, context: Context) -> Pieces:
    """A frame comes again."""
    return [Piece(packet)] * (1 + wanted.copies)


@kind(Layer.STREAM, Target.FRAME, "frames_lost += frames", _Frames, lasting=True)
def missing_frames(packet: bytes, wanted: _Frames, rng: Rng, context: Context) -> Pieces:
    """Frames are missing."""
    return [] if context.packets_since < wanted.frames else [Piece(packet)]


@kind(Layer.STREAM, Target.FRAME, "frames_lost += 2: the counter jumps ahead by one twice")
def reordered_frames(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A frame comes behind the next one."""
    return [Piece(packet, behind=1)]


@kind(
    Layer.STREAM,
    Target.FRAME,
    "nothing; the arrival times show it",
    _Slower,
    lasting=True,
    hidden=_TIMING,
)
def slow_rate(packet: bytes, wanted: _Slower, rng: Rng, context: Context) -> Pieces:
    """Frames come at a lower rate than was asked for."""
    delay_ns = round((context.now_ns - context.since_ns) * wanted.percent / 100)
    return [Piece(packet, delay_ns=delay_ns)]


@kind(
    Layer.STREAM,
    Target.PACKET,
    "nothing; the arrival times show it, and ResponseTimeout if someone waits for less",
    _Seconds,
    lasting=True,
    hidden=_TIMING,
)
def stall(packet: bytes, wanted: _Seconds, rng: Rng, context: Context) -> Pieces:
    """Nothing comes for a while, then all at once."""
    end_ns = context.since_ns + round(wanted.seconds * _NS_PER_S)
    return [Piece(packet, delay_ns=max(end_ns - context.now_ns, 0))]


@kind(Layer.STREAM, Target.FRAME, "nothing", _Level, hidden=_CONTENT)
def saturation(packet: bytes, wanted: _Level, rng: Rng, context: Context) -> Pieces:
    """The amplitudes of a frame are clipped."""
    parts = frame_parts(packet)
    if parts is None or context.lattice is None or parts.samples.size == 0:
        return None
    limit = wanted.level * np.abs(parts.samples).max()
    clipped = context.lattice.nearest(np.clip(parts.samples, -limit, limit))
    return [Piece(frame_packet(parts.counter, clipped))]


@kind(Layer.STREAM, Target.FRAME, "nothing", _DeadBins, hidden=_CONTENT)
def dead_bins(packet: bytes, wanted: _DeadBins, rng: Rng, context: Context) -> Pieces:
    """Bins of a frame are stuck at one value."""
    parts = frame_parts(packet)
    if parts is None or wanted.first >= parts.samples.size:
        return None
    samples = parts.samples.copy()
    # stuck at a value that the chip can give
    samples[wanted.first : wanted.first + wanted.bins] = samples[wanted.first]
    return [Piece(frame_packet(parts.counter, samples))]


@kind(Layer.STREAM, Target.FRAME, "nothing", _Amplitude, lasting=True, hidden=_CONTENT)
def dc_step(packet: bytes, wanted: _Amplitude, rng: Rng, context: Context) -> Pieces:
    """All samples are moved by the same amount from now on."""
    parts = frame_parts(packet)
    if parts is None or context.lattice is None:
        return None
    moved = context.lattice.nearest(parts.samples + np.float32(wanted.amplitude))
    return [Piece(frame_packet(parts.counter, moved))]


@kind(Layer.STREAM, Target.FRAME, "nothing", hidden=_CONTENT)
def stale_frame(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A frame carries the samples of the one before."""
    parts = frame_parts(packet)
    before = None if context.previous_frame is None else frame_parts(context.previous_frame)
    if parts is None or before is None or before.samples.size != parts.samples.size:
        return None
    return [Piece(frame_packet(parts.counter, before.samples))]


@kind(Layer.ENVIRONMENT, Target.FRAME, "nothing", _Clutter, lasting=True, hidden=_CONTENT)
def strong_clutter(packet: bytes, wanted: _Clutter, rng: Rng, context: Context) -> Pieces:
    """A strong reflector stands in one place."""

    def clutter(n: int) -> NDArray[np.float64]:
        bins = np.arange(n) - wanted.bin
        envelope = np.exp(-0.5 * (bins / wanted.bins) ** 2)
        wave: NDArray[np.float64] = (
            wanted.amplitude * envelope * np.cos(2 * math.pi * _CYCLES_PER_BIN * bins)
        )
        return wave

    return _with_echo(packet, context, clutter)


@kind(Layer.ENVIRONMENT, Target.FRAME, "nothing", _Pulses, lasting=True, hidden=_CONTENT)
def interference(packet: bytes, wanted: _Pulses, rng: Rng, context: Context) -> Pieces:
    """Every frame has pulses at random bins."""

    def pulses(n: int) -> NDArray[np.float64]:
        samples = np.zeros(n)
        for _ in range(wanted.pulses):
            samples[rng.below(n)] += wanted.amplitude * (2 * rng.below(2) - 1)
        return samples

    return _with_echo(packet, context, pulses)


@kind(Layer.ENVIRONMENT, Target.FRAME, "nothing", _Fading, lasting=True, hidden=_CONTENT)
def fading(packet: bytes, wanted: _Fading, rng: Rng, context: Context) -> Pieces:
    """All echoes fade and come back."""
    parts = frame_parts(packet)
    if parts is None or context.lattice is None:
        return None
    phase = (context.now_ns - context.since_ns) / _NS_PER_S / wanted.period_s
    loss_db = wanted.depth_db * (1 - math.cos(2 * math.pi * phase)) / 2
    faded = parts.samples * np.float32(10 ** (-loss_db / 20))
    return [Piece(frame_packet(parts.counter, context.lattice.nearest(faded)))]
