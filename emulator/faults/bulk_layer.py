"""Faults of the frame layer that hit radar frames: their header, their samples, their framing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emulator.faults.dice import Dice
from emulator.faults.kind import Context, Kind, Layer, Parameters, Piece, Target
from emulator.faults.packets import PacketClass, frame_packet, frame_parts, response_bytes
from xethru_protocol.messages import Ack
from xethru_protocol.packets import (
    MAX_NORMAL_BYTES,
    NO_ESCAPE_HEADER_BYTES,
    NO_ESCAPE_START,
    encode_normal,
)

__all__ = ["KINDS"]


class _Cut(Parameters):
    keep: Annotated[int, Field(ge=1, le=65_535, description="bytes that are sent")] = 3


class _Samples(Parameters):
    samples: Annotated[int, Field(ge=1, le=1536, description="how many samples")] = 1


class _Bins(Parameters):
    more: Annotated[int, Field(ge=-1536, le=1536, description="bins more than asked for")] = -1


class _Length(Parameters):
    more: Annotated[
        int, Field(ge=-65_535, le=65_535, description="what is added to the length field")
    ] = 1


def _truncated(packet: bytes, wanted: _Cut, dice: Dice, context: Context) -> Sequence[Piece] | None:
    del dice, context
    return None if wanted.keep >= len(packet) else [Piece(packet[: wanted.keep])]


def _spoiled(
    spoil: Callable[[NDArray[np.float32], Context], NDArray[np.float32] | None],
) -> Callable[[bytes, _Samples, Dice, Context], Sequence[Piece] | None]:
    """Return an effect that replaces some samples of a frame."""

    def effect(
        packet: bytes, wanted: _Samples, dice: Dice, context: Context
    ) -> Sequence[Piece] | None:
        parts = frame_parts(packet)
        if parts is None or parts.samples.size < wanted.samples:
            return None
        places: set[int] = set()
        while len(places) < wanted.samples:
            places.add(dice.below(parts.samples.size))
        chosen = sorted(places)
        samples = parts.samples.copy()
        spoiled = spoil(samples[chosen], context)
        if spoiled is None:
            return None
        samples[chosen] = spoiled
        return [Piece(frame_packet(parts.counter, samples))]

    return effect


def _constant(
    value: float,
) -> Callable[[NDArray[np.float32], Context], NDArray[np.float32]]:
    return lambda samples, context: np.full_like(samples, value)


def _between_values(samples: NDArray[np.float32], context: Context) -> NDArray[np.float32] | None:
    if context.lattice is None:
        return None
    # between two chip counters, whatever the sample was
    half = np.float32(context.lattice.quantum / context.lattice.tap_sum / 2)
    inside = np.where(samples + half > np.float32(context.lattice.highest), -half, half)
    return (samples + inside).astype(np.float32)


def _another_value(samples: NDArray[np.float32], context: Context) -> NDArray[np.float32] | None:
    if context.lattice is None:
        return None
    middle = np.float32((context.lattice.lowest + context.lattice.highest) / 2)
    quarter = np.float32((context.lattice.highest - context.lattice.lowest) / 4)
    return context.lattice.nearest(np.where(samples > middle, samples - quarter, samples + quarter))


def _wrong_bins(packet: bytes, wanted: _Bins, dice: Dice, context: Context) -> list[Piece] | None:
    del dice, context
    parts = frame_parts(packet)
    if parts is None or wanted.more == 0 or parts.samples.size + wanted.more < 1:
        return None
    return [
        Piece(
            frame_packet(parts.counter, np.resize(parts.samples, parts.samples.size + wanted.more))
        )
    ]


def _wrong_length(
    packet: bytes, wanted: _Length, dice: Dice, context: Context
) -> list[Piece] | None:
    del dice, context
    if not packet.startswith(NO_ESCAPE_START) or wanted.more == 0:
        return None
    length = len(packet) - NO_ESCAPE_HEADER_BYTES + wanted.more
    if not 0 <= length < 1 << 32:
        return None
    return [Piece(NO_ESCAPE_START + length.to_bytes(4, "little") + packet[8:])]


def _inside_frame(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> list[Piece] | None:
    del wanted, dice
    if context.packet_class is not PacketClass.FRAME:
        return None
    middle = len(packet) // 2
    return [Piece(packet[:middle] + response_bytes(Ack()) + packet[middle:])]


def _normal_framed(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> list[Piece] | None:
    del wanted, dice, context
    payload = packet[NO_ESCAPE_HEADER_BYTES:]
    if not packet.startswith(NO_ESCAPE_START) or not 0 < len(payload) < MAX_NORMAL_BYTES:
        return None
    return [Piece(encode_normal(payload))]


def _row(  # noqa: PLR0917 - the columns of a table
    name: str,
    summary: str,
    counted: str,
    effect: Callable[..., Sequence[Piece] | None],
    parameters: type[Parameters] = Parameters,
    hidden: str = "",
) -> Kind:
    return Kind(
        name=name,
        layer=Layer.FRAME,
        target=Target.FRAME,
        summary=summary,
        counted=counted,
        effect=effect,
        parameters=parameters,
        hidden=hidden,
    )


KINDS = (
    _row(
        "truncated_frame",
        "Only the first bytes of a radar frame are sent.",
        "1 frame lost, 1 fault; the next frame's first bytes are taken for samples",
        _truncated,
        _Cut,
    ),
    _row(
        "nan_samples",
        "Samples of a frame are no numbers.",
        "off_lattice_samples = samples",
        _spoiled(_constant(float("nan"))),
        _Samples,
    ),
    _row(
        "infinite_samples",
        "Samples of a frame are infinite.",
        "off_lattice_samples = samples",
        _spoiled(_constant(float("inf"))),
        _Samples,
    ),
    _row(
        "denormal_samples",
        "Samples of a frame are denormal numbers.",
        "off_lattice_samples = samples",
        _spoiled(_constant(1e-40)),
        _Samples,
    ),
    _row(
        "off_lattice_samples",
        "Samples lie between two values that the chip can give.",
        "off_lattice_samples = samples",
        _spoiled(_between_values),
        _Samples,
    ),
    _row(
        "in_range_samples",
        "Samples are replaced by other values that the chip can give.",
        "nothing",
        _spoiled(_another_value),
        _Samples,
        hidden="NoEscape packets carry no checksum, and the new values are as good as the old.",
    ),
    _row(
        "wrong_bin_count",
        "A frame has another number of bins than the settings make.",
        "1 frame discarded, 1 frame lost",
        _wrong_bins,
        _Bins,
    ),
    _row(
        "wrong_length",
        "The length of a NoEscape packet contradicts its content.",
        "1 fault 'implausible NoEscape header', 1 frame lost",
        _wrong_length,
        _Length,
    ),
    _row(
        "packet_inside_frame",
        "An ACK stands inside a frame.",
        "1 fault, 4 junk bytes; the frame's later samples are shifted by one",
        _inside_frame,
    ),
    _row(
        "normal_framed",
        "A frame comes in Normal framing.",
        "nothing",
        _normal_framed,
        hidden="A host must accept both framings for every message.",
    ),
)
