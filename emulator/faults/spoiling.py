"""One fault and one packet, which may be in pieces already by other faults."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from emulator.faults.armed import Armed, Opportunity
from emulator.faults.kind import Context, PacketEffect, Piece
from emulator.faults.packets import PacketClass
from emulator.faults.watch import Watch

__all__ = ["spoiled_pieces"]


def spoiled_pieces(
    armed: Armed,
    pieces: Sequence[Piece],
    opportunity: Opportunity,
    watch: Watch,
    now_ns: int,
    *,
    fires: bool,
) -> Sequence[Piece] | None:
    """Return the pieces with a fault in them; None if it found nothing to spoil."""
    context = Context(
        now_ns=now_ns,
        since_ns=now_ns if fires else armed.since_ns,
        firings=armed.firings + fires,
        packets_since=0 if fires else armed.packets_since + 1,
        first_counter=watch.counter if fires else armed.first_counter,
        packet_class=cast("PacketClass", opportunity.packet_class),
        command=opportunity.command,
        previous_frame=watch.previous_frame,
        lattice=watch.lattice,
    )
    effect = cast("PacketEffect", armed.kind.effect)
    result: list[Piece] = []
    applied = False
    for piece in pieces:
        spoiled = effect(piece.data, armed.parameters, armed.dice, context)
        applied |= spoiled is not None
        result += [
            Piece(
                part.data,
                delay_ns=piece.delay_ns + part.delay_ns,
                aside=piece.aside or part.aside,
                behind=piece.behind + part.behind,
            )
            for part in ([Piece(piece.data)] if spoiled is None else spoiled)
        ]
    return result if applied else None
