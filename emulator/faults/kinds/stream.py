"""Faults of the environment, as far as they can be made of samples; the scene does the rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emulator.faults.kind import (
    Context,
    Kind,
    Layer,
    Parameters,
    Piece,
    Target,
    frame_packet,
    frame_parts,
)
from emulator.scene.philox import Dice

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


def _renumbered(
    number: Callable[[int, int, Context], int],
) -> Callable[[bytes, _Frames, Dice, Context], Sequence[Piece] | None]:
    def effect(
        packet: bytes, wanted: _Frames, dice: Dice, context: Context
    ) -> Sequence[Piece] | None:
        parts = frame_parts(packet)
        if parts is None:
            return None
        counter = number(parts.counter, wanted.frames, context)
        return [Piece(frame_packet(counter, parts.samples))]

    return effect


def _since_first(counter: int, context: Context) -> int:
    return counter - (counter if context.first_counter is None else context.first_counter)


def _duplicate(packet: bytes, wanted: _Copies, dice: Dice, context: Context) -> Sequence[Piece]:
    return [Piece(packet)] * (1 + wanted.copies)


def _missing(packet: bytes, wanted: _Frames, dice: Dice, context: Context) -> Sequence[Piece]:
    return [] if context.packets_since < wanted.frames else [Piece(packet)]


def _reorder(packet: bytes, wanted: Parameters, dice: Dice, context: Context) -> Sequence[Piece]:
    return [Piece(packet, behind=1)]


def _slower(packet: bytes, wanted: _Slower, dice: Dice, context: Context) -> Sequence[Piece]:
    delay_ns = round((context.now_ns - context.since_ns) * wanted.percent / 100)
    return [Piece(packet, delay_ns=delay_ns)]


def _stall(packet: bytes, wanted: _Seconds, dice: Dice, context: Context) -> Sequence[Piece]:
    end_ns = context.since_ns + round(wanted.seconds * _NS_PER_S)
    return [Piece(packet, delay_ns=max(end_ns - context.now_ns, 0))]


def _saturated(
    packet: bytes, wanted: _Level, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    parts = frame_parts(packet)
    if parts is None or context.lattice is None or parts.samples.size == 0:
        return None
    limit = wanted.level * np.abs(parts.samples).max()
    clipped = context.lattice.nearest(np.clip(parts.samples, -limit, limit))
    return [Piece(frame_packet(parts.counter, clipped))]


def _dead_bins(
    packet: bytes, wanted: _DeadBins, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    parts = frame_parts(packet)
    if parts is None or wanted.first >= parts.samples.size:
        return None
    samples = parts.samples.copy()
    # stuck at a value that the chip can give
    samples[wanted.first : wanted.first + wanted.bins] = samples[wanted.first]
    return [Piece(frame_packet(parts.counter, samples))]


def _dc_step(
    packet: bytes, wanted: _Amplitude, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    parts = frame_parts(packet)
    if parts is None or context.lattice is None:
        return None
    moved = context.lattice.nearest(parts.samples + np.float32(wanted.amplitude))
    return [Piece(frame_packet(parts.counter, moved))]


def _stale(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    parts = frame_parts(packet)
    before = None if context.previous_frame is None else frame_parts(context.previous_frame)
    if parts is None or before is None or before.samples.size != parts.samples.size:
        return None
    return [Piece(frame_packet(parts.counter, before.samples))]


def _row(
    name: str,
    summary: str,
    counted: str,
    effect: Callable[..., Sequence[Piece] | None],
    parameters: type[Parameters] = Parameters,
    *,
    target: Target = Target.FRAME,
    lasting: bool = False,
    hidden: str = "",
) -> Kind:
    return Kind(
        name=name,
        layer=Layer.STREAM,
        target=target,
        summary=summary,
        counted=counted,
        effect=effect,
        parameters=parameters,
        lasting=lasting,
        hidden=hidden,
    )


_BACK = "A counter that goes back looks like a chip that was restarted, which loses nothing."
_CONTENT = "The samples are such as the chip can give; only who looks at the scene can tell."
_TIMING = "Frames carry no time; only their arrival shows it, to who looks at it."

KINDS = (
    _row(
        "counter_jump",
        "The frame counter jumps ahead, and goes on from there.",
        "frames_lost += frames",
        _renumbered(lambda counter, frames, context: counter + frames * context.firings),
        _Frames,
        lasting=True,
    ),
    _row(
        "counter_back",
        "The frame counter jumps back, and goes on from there.",
        "nothing; the counters of the frames show it",
        _renumbered(lambda counter, frames, context: counter - frames * context.firings),
        _Frames,
        lasting=True,
        hidden=_BACK,
    ),
    _row(
        "counter_wrap",
        "The frame counter goes on shortly before 2**32, and wraps after some frames.",
        "nothing; a wrap is no loss",
        _renumbered(
            lambda counter, frames, context: _WRAP - frames + _since_first(counter, context)
        ),
        _Frames,
        lasting=True,
        hidden=_BACK,
    ),
    _row(
        "counter_reset",
        "The frame counter begins again at 0.",
        "nothing; the counters of the frames show it",
        _renumbered(lambda counter, frames, context: _since_first(counter, context)),
        lasting=True,
        parameters=_Frames,
        hidden=_BACK,
    ),
    _row(
        "duplicate_frame",
        "A frame comes again.",
        "nothing; two frames with one counter show it",
        _duplicate,
        _Copies,
        hidden="The counter does not move, so no frame is missing.",
    ),
    _row(
        "missing_frames",
        "Frames are missing.",
        "frames_lost += frames",
        _missing,
        _Frames,
        lasting=True,
    ),
    _row(
        "reordered_frames",
        "A frame comes behind the next one.",
        "frames_lost += 2: the counter jumps ahead by one twice",
        _reorder,
    ),
    _row(
        "slow_rate",
        "Frames come at a lower rate than was asked for.",
        "nothing; the arrival times show it",
        _slower,
        _Slower,
        lasting=True,
        hidden=_TIMING,
    ),
    _row(
        "stall",
        "Nothing comes for a while, then all at once.",
        "nothing; the arrival times show it, and ResponseTimeout if someone waits for less",
        _stall,
        _Seconds,
        target=Target.PACKET,
        lasting=True,
        hidden=_TIMING,
    ),
    _row(
        "saturation",
        "The amplitudes of a frame are clipped.",
        "nothing",
        _saturated,
        _Level,
        hidden=_CONTENT,
    ),
    _row(
        "dead_bins",
        "Bins of a frame are stuck at one value.",
        "nothing",
        _dead_bins,
        _DeadBins,
        hidden=_CONTENT,
    ),
    _row(
        "dc_step",
        "All samples are moved by the same amount from now on.",
        "nothing",
        _dc_step,
        _Amplitude,
        lasting=True,
        hidden=_CONTENT,
    ),
    _row(
        "stale_frame",
        "A frame carries the samples of the one before.",
        "nothing",
        _stale,
        hidden=_CONTENT,
    ),
)


_CYCLES_PER_BIN = 7.29 / 23.328  # carrier of the pulse over the sampling rate, Hz / Hz


class _Clutter(Parameters):
    bin: Annotated[int, Field(ge=0, le=1535, description="bin of its middle")] = 20
    amplitude: Annotated[float, Field(gt=0, le=1, description="full scale of the DAC is 1")] = 0.05
    bins: Annotated[float, Field(gt=0, le=200, description="standard deviation, bins")] = 4.0


class _Rain(Parameters):
    pulses: Annotated[int, Field(ge=1, le=1000, description="pulses per frame")] = 5
    amplitude: Annotated[float, Field(gt=0, le=1, description="full scale of the DAC is 1")] = 0.05


class _Fading(Parameters):
    depth_db: Annotated[float, Field(gt=0, le=60, description="deepest, dB")] = 12.0
    period_s: Annotated[float, Field(gt=0, le=3600, description="from fade to fade, s")] = 5.0


def _clutter(n: int, wanted: _Clutter, dice: Dice) -> NDArray[np.float64]:
    bins = np.arange(n) - wanted.bin
    envelope = np.exp(-0.5 * (bins / wanted.bins) ** 2)
    wave: NDArray[np.float64] = (
        wanted.amplitude * envelope * np.cos(2 * math.pi * _CYCLES_PER_BIN * bins)
    )
    return wave


def _rain(n: int, wanted: _Rain, dice: Dice) -> NDArray[np.float64]:
    pulses = np.zeros(n)
    for _ in range(wanted.pulses):
        pulses[dice.below(n)] += wanted.amplitude * (2 * dice.below(2) - 1)
    return pulses


def _added(
    wave: Callable[..., NDArray[np.float64]],
) -> Callable[[bytes, Parameters, Dice, Context], Sequence[Piece] | None]:
    """Return an effect that adds something to the samples, as the chip would have seen it."""

    def effect(
        packet: bytes, wanted: Parameters, dice: Dice, context: Context
    ) -> Sequence[Piece] | None:
        parts = frame_parts(packet)
        if parts is None or context.lattice is None or parts.samples.size == 0:
            return None
        seen = parts.samples + wave(parts.samples.size, wanted, dice)
        samples = context.lattice.nearest(seen.astype(np.float32))
        return [Piece(frame_packet(parts.counter, samples))]

    return effect


def _fading(packet: bytes, wanted: _Fading, dice: Dice, context: Context) -> Sequence[Piece] | None:
    parts = frame_parts(packet)
    if parts is None or context.lattice is None:
        return None
    phase = (context.now_ns - context.since_ns) / _NS_PER_S / wanted.period_s
    loss_db = wanted.depth_db * (1 - math.cos(2 * math.pi * phase)) / 2
    faded = parts.samples * np.float32(10 ** (-loss_db / 20))
    return [Piece(frame_packet(parts.counter, context.lattice.nearest(faded)))]


def _environment_row(
    name: str,
    summary: str,
    effect: Callable[..., Sequence[Piece] | None],
    parameters: type[Parameters],
) -> Kind:
    return Kind(
        name=name,
        layer=Layer.ENVIRONMENT,
        target=Target.FRAME,
        summary=summary,
        counted="nothing",
        effect=effect,
        parameters=parameters,
        lasting=True,
        hidden="The samples are such as the chip can give; only who looks at the scene can tell.",
    )


ENVIRONMENT_KINDS = (
    _environment_row(
        "strong_clutter", "A strong reflector stands in one place.", _added(_clutter), _Clutter
    ),
    _environment_row(
        "interference", "Every frame has pulses at random bins.", _added(_rain), _Rain
    ),
    _environment_row("fading", "All echoes fade and come back.", _fading, _Fading),
)
