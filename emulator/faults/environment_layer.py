"""Faults of the environment, as far as they can be made of samples; the scene does the rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emulator.faults.dice import Dice
from emulator.faults.kind import Context, Kind, Layer, Parameters, Piece, Target
from emulator.faults.packets import frame_packet, frame_parts

__all__ = ["KINDS"]

_NS_PER_S = 1_000_000_000
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
    del dice
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
    del dice
    parts = frame_parts(packet)
    if parts is None or context.lattice is None:
        return None
    phase = (context.now_ns - context.since_ns) / _NS_PER_S / wanted.period_s
    loss_db = wanted.depth_db * (1 - math.cos(2 * math.pi * phase)) / 2
    faded = parts.samples * np.float32(10 ** (-loss_db / 20))
    return [Piece(frame_packet(parts.counter, context.lattice.nearest(faded)))]


def _row(
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


KINDS = (
    _row("strong_clutter", "A strong reflector stands in one place.", _added(_clutter), _Clutter),
    _row("interference", "Every frame has pulses at random bins.", _added(_rain), _Rain),
    _row("fading", "All echoes fade and come back.", _fading, _Fading),
)
