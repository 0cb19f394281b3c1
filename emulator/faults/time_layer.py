"""Faults of time, and of a radar within an array: late, drifting, silent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated

from pydantic import Field

from emulator.faults.dice import Dice
from emulator.faults.kind import Context, Kind, Layer, Parameters, Piece, Target

__all__ = ["KINDS"]

_NS_PER_S = 1_000_000_000
_NS_PER_MS = 1_000_000
_NS_PER_US = 1_000


class _Offset(Parameters):
    offset_ms: Annotated[float, Field(ge=0, le=60_000, description="how late, ms")] = 20.0


class _Ppm(Parameters):
    ppm: Annotated[float, Field(gt=0, le=100_000, description="how slow the clock is, ppm")] = 50.0


class _Walk(Parameters):
    sigma_us: Annotated[float, Field(gt=0, le=100_000, description="one step, us")] = 200.0


class _Poll(Parameters):
    period_ms: Annotated[float, Field(gt=0, le=1000, description="from poll to poll, ms")] = 16.0


class _Silence(Parameters):
    seconds: Annotated[float, Field(ge=0, le=86_400, description="how long, s; 0: for ever")] = 0.0


def _offset(packet: bytes, wanted: _Offset, dice: Dice, context: Context) -> Sequence[Piece]:
    del dice, context
    return [Piece(packet, delay_ns=round(wanted.offset_ms * _NS_PER_MS))]


def _drift(packet: bytes, wanted: _Ppm, dice: Dice, context: Context) -> Sequence[Piece]:
    del dice
    delay_ns = round((context.now_ns - context.since_ns) * wanted.ppm * 1e-6)
    return [Piece(packet, delay_ns=delay_ns)]


def _jitter(packet: bytes, wanted: _Walk, dice: Dice, context: Context) -> Sequence[Piece]:
    del context
    # reflected at 0: nothing can be early
    return [Piece(packet, delay_ns=round(abs(dice.walk(wanted.sigma_us)) * _NS_PER_US))]


def _latency(packet: bytes, wanted: _Poll, dice: Dice, context: Context) -> Sequence[Piece]:
    del dice
    period_ns = round(wanted.period_ms * _NS_PER_MS)
    return [Piece(packet, delay_ns=(context.since_ns - context.now_ns) % period_ns)]


def _silent(packet: bytes, wanted: _Silence, dice: Dice, context: Context) -> Sequence[Piece]:
    del dice
    end_ns = context.since_ns + round(wanted.seconds * _NS_PER_S)
    return [] if not wanted.seconds or context.now_ns < end_ns else [Piece(packet)]


def _row(  # noqa: PLR0917 - the columns of a table
    name: str,
    summary: str,
    counted: str,
    effect: Callable[..., Sequence[Piece]],
    parameters: type[Parameters],
    hidden: str = "",
) -> Kind:
    return Kind(
        name=name,
        layer=Layer.TIME,
        target=Target.PACKET,
        summary=summary,
        counted=counted,
        effect=effect,
        parameters=parameters,
        lasting=True,
        hidden=hidden,
    )


_ARRIVAL = "nothing; the arrival times show it"
_TIMING = "Frames carry no time; only their arrival shows it, to who looks at it."

KINDS = (
    _row(
        "start_offset",
        "Everything comes later by the same time.",
        _ARRIVAL,
        _offset,
        _Offset,
        _TIMING,
    ),
    _row(
        "clock_drift",
        "The module's clock is slow.",
        _ARRIVAL,
        _drift,
        _Ppm,
        _TIMING,
    ),
    _row(
        "jitter",
        "Delays wander at random.",
        _ARRIVAL,
        _jitter,
        _Walk,
        _TIMING,
    ),
    _row(
        "usb_latency",
        "The host polls now and then: packets come in batches, at multiples of a period.",
        _ARRIVAL,
        _latency,
        _Poll,
        _TIMING,
    ),
    _row(
        "silent",
        "Nothing comes from the module, though its port is there.",
        "ResponseTimeout where something was waited for; afterwards the frames lost meanwhile",
        _silent,
        _Silence,
    ),
)
