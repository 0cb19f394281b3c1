"""Faults of the transaction layer: commands and answers that do not fit each other."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Literal

from pydantic import Field

from emulator.faults.kind import (
    Context,
    Handling,
    Kind,
    Layer,
    Parameters,
    Piece,
    Target,
    command_bytes,
    normal_payload,
    response_bytes,
)
from emulator.scene.philox import Dice
from xethru_protocol.wire.codes import PongCode, ResponseCode, SystemCode
from xethru_protocol.wire.framing import END, ESCAPE, START, encode_normal
from xethru_protocol.wire.messages import Ack, Error, Ping, Pong, System, X4DriverSet

__all__ = ["KINDS"]

_NS_PER_MS = 1_000_000
_LONGEST_WAIT = 20.0  # multiples of the delay that a heavy tail reaches at most


class _Code(Parameters):
    code: Annotated[int, Field(ge=0, le=2**32 - 1, description="error code of the answer")] = 1


class _SystemCode(Parameters):
    code: Annotated[int, Field(ge=0, le=2**32 - 1, description="SYSTEM code")] = (
        SystemCode.XTS_SPRS_BOOTING.value
    )


class _Slow(Parameters):
    delay_ms: Annotated[
        float, Field(ge=0, le=600_000, description="how late the answer is, ms")
    ] = 500.0
    tail: Annotated[
        Literal["fixed", "uniform", "heavy"],
        Field(description="fixed; uniform: 0 ... 2 delays; heavy: Pareto, 1 ... 20 delays"),
    ] = "fixed"


class _Step(Parameters):
    step: Annotated[float, Field(gt=0, le=10, description="step to which values are cut")] = 0.25


def _no_reply(packet: bytes, wanted: Parameters, dice: Dice, context: Context) -> Sequence[Piece]:
    return []


def _slow_reply(packet: bytes, wanted: _Slow, dice: Dice, context: Context) -> Sequence[Piece]:
    factor = 1.0
    if wanted.tail == "uniform":
        factor = 2 * dice.uniform()
    elif wanted.tail == "heavy":
        factor = min((1 - dice.uniform()) ** -0.5, _LONGEST_WAIT)
    return [Piece(packet, delay_ns=round(wanted.delay_ms * factor * _NS_PER_MS), aside=True)]


def _duplicate(packet: bytes, wanted: Parameters, dice: Dice, context: Context) -> Sequence[Piece]:
    return [Piece(packet), Piece(packet)]


def _stale_ack(packet: bytes, wanted: Parameters, dice: Dice, context: Context) -> Sequence[Piece]:
    return [Piece(response_bytes(Ack())), Piece(packet)]


def _late(packet: bytes, wanted: Parameters, dice: Dice, context: Context) -> Sequence[Piece]:
    return [Piece(packet, behind=1)]


def _wrong_reply(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    payload = normal_payload(packet)
    if payload is None or len(payload) < 6 or payload[0] != ResponseCode.XTS_SPR_REPLY:
        return None
    content_id = struct.unpack_from("<I", payload, 2)[0] ^ 0xFFFF
    return [Piece(encode_normal(payload[:2] + struct.pack("<I", content_id) + payload[6:]))]


def _system(packet: bytes, wanted: _SystemCode, dice: Dice, context: Context) -> Sequence[Piece]:
    return [Piece(response_bytes(System(code=wanted.code)) + packet)]


def _not_ready(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    if not isinstance(context.command, Ping):
        return None
    return [Piece(response_bytes(Pong(value=PongCode.XTS_SPRP_NOTREADY)))]


def _nack(packet: bytes, wanted: _Code, dice: Dice, context: Context) -> Handling | None:
    if isinstance(context.command, Ping):
        return None  # PING has no errors
    return Handling(to_host=(Piece(response_bytes(Error(code=wanted.code))),))


def _ack_then_ignore(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> Handling | None:
    if not isinstance(context.command, X4DriverSet):
        return None
    return Handling(to_host=(Piece(response_bytes(Ack())),))


def _ack_quantised(packet: bytes, wanted: _Step, dice: Dice, context: Context) -> Handling | None:
    command = context.command
    if not isinstance(command, X4DriverSet):
        return None
    value = command.value
    if isinstance(value, float):
        cut = replace(command, value=_cut(value, wanted.step))
    elif isinstance(value, tuple) and all(isinstance(part, float) for part in value):
        ends = [_cut(float(part), wanted.step) for part in value]
        cut = replace(command, value=(ends[0], ends[1]))
    else:
        return None
    data = command_bytes(cut)
    return None if data == packet else Handling(to_module=data, command=cut)


def _cut(value: float, step: float) -> float:
    return round(value / step) * step


def _command_lost(packet: bytes, wanted: Parameters, dice: Dice, context: Context) -> Handling:
    return Handling()


def _command_damaged(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> Handling | None:
    """Replace the checksum: the module then says nothing, like the firmware."""
    if packet[-3] == ESCAPE:
        return None
    right = packet[-2]
    wrong = [code for code in range(256) if code not in (right, START, END, ESCAPE)]
    return Handling(to_module=packet[:-2] + bytes((wrong[dice.below(len(wrong))], END)))


def _row(  # noqa: PLR0917 - the columns of a table
    name: str,
    target: Target,
    summary: str,
    counted: str,
    effect: Callable[..., Sequence[Piece] | Handling | None],
    parameters: type[Parameters] = Parameters,
    *,
    lasting: bool = False,
    hidden: str = "",
) -> Kind:
    return Kind(
        name=name,
        layer=Layer.TRANSACTION,
        target=target,
        summary=summary,
        counted=counted,
        effect=effect,  # type: ignore[arg-type]  # the target says which of the three it is
        parameters=parameters,
        lasting=lasting,
        hidden=hidden,
    )


KINDS = (
    _row(
        "nack",
        Target.COMMAND,
        "The module refuses a command with a code, and does not carry it out.",
        "1 DeviceError of the code",
        _nack,
        _Code,
    ),
    _row(
        "no_reply",
        Target.REPLY,
        "The module carries a command out, and its answer is lost.",
        "1 ResponseTimeout",
        _no_reply,
    ),
    _row(
        "slow_reply",
        Target.REPLY,
        "An answer is late; frames pass it.",
        "beyond the time limit 1 ResponseTimeout and, when it comes, 1 stray; else nothing",
        _slow_reply,
        _Slow,
    ),
    _row(
        "duplicate_ack",
        Target.REPLY,
        "An answer comes twice.",
        "1 stray",
        _duplicate,
    ),
    _row(
        "stale_ack",
        Target.REPLY,
        "The ACK of an earlier command comes before the answer.",
        "1 stray",
        _stale_ack,
    ),
    _row(
        "late_reply",
        Target.REPLY,
        "An answer comes behind the next one.",
        "1 ResponseTimeout and 1 stray",
        _late,
    ),
    _row(
        "wrong_reply",
        Target.REPLY,
        "A REPLY carries the content id of another question.",
        "1 ResponseTimeout and 1 stray",
        _wrong_reply,
    ),
    _row(
        "system_message",
        Target.PACKET,
        "A SYSTEM message comes in mid-session.",
        "BOOTING: 1 reboot",
        _system,
        _SystemCode,
    ),
    _row(
        "not_ready",
        Target.REPLY,
        "The module answers PING with 'not ready'.",
        "1 PONG 'not ready'",
        _not_ready,
    ),
    _row(
        "ack_then_ignore",
        Target.COMMAND,
        "The module acknowledges an X4 setting and does not change it.",
        "1 RemoteProtocolError where the setting is read back and differs",
        _ack_then_ignore,
    ),
    _row(
        "ack_quantised",
        Target.COMMAND,
        "The module acknowledges an X4 setting and sets it to a step of its own.",
        "1 RemoteProtocolError or warning where it is read back",
        _ack_quantised,
        _Step,
    ),
    _row(
        "command_lost",
        Target.COMMAND,
        "A command does not reach the module.",
        "1 ResponseTimeout",
        _command_lost,
    ),
    _row(
        "command_damaged",
        Target.COMMAND,
        "A command reaches the module with a wrong checksum.",
        "1 ResponseTimeout; the module says nothing",
        _command_damaged,
    ),
)
