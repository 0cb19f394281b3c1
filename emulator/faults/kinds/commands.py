"""Faults of the transaction layer: commands and answers that do not fit each other."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Literal

from pydantic import Field

from emulator.faults.kind import (
    NS_PER_MS,
    Catalogued,
    Context,
    Handling,
    Layer,
    Parameters,
    Piece,
    Pieces,
    Target,
    command_bytes,
    normal_payload,
    response_bytes,
)
from emulator.scene.philox import Rng
from xethru_protocol.wire.codes import PongCode, ResponseCode, SystemCode
from xethru_protocol.wire.framing import END, ESCAPE, START, encode_normal
from xethru_protocol.wire.messages import Ack, Error, Ping, Pong, System, X4DriverSet

of_command = Catalogued(Layer.TRANSACTION, Target.COMMAND)
of_reply = Catalogued(Layer.TRANSACTION, Target.REPLY)
of_packet = Catalogued(Layer.TRANSACTION, Target.PACKET)

_LONGEST_WAIT = 20.0  # multiples of the delay that a heavy tail reaches at most


class _Code(Parameters):
    code: int = Field(1, ge=0, le=2**32 - 1, description="error code of the answer")


class _SentSystemCode(Parameters):
    code: int = Field(
        SystemCode.XTS_SPRS_BOOTING.value, ge=0, le=2**32 - 1, description="SYSTEM code"
    )


class _Slow(Parameters):
    delay_ms: float = Field(500.0, ge=0, le=600_000, description="how late the answer is, ms")
    tail: Literal["fixed", "uniform", "heavy"] = Field(
        "fixed", description="fixed; uniform: 0 ... 2 delays; heavy: Pareto, 1 ... 20 delays"
    )


class _RoundingStep(Parameters):
    step: float = Field(0.25, gt=0, le=10, description="step to which values are cut")


def _cut(value: float, step: float) -> float:
    return round(value / step) * step


@of_command("1 DeviceError of the code", _Code)
def nack(packet: bytes, wanted: _Code, rng: Rng, context: Context) -> Handling | None:
    """The module refuses a command with a code, and does not carry it out."""
    if isinstance(context.command, Ping):
        return None  # PING has no errors
    return Handling(to_host=(Piece(response_bytes(Error(code=wanted.code))),))


@of_reply("1 ResponseTimeout")
def no_reply(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """The module carries a command out, and its answer is lost."""
    return []


@of_reply(
    "beyond the time limit 1 ResponseTimeout and, when it comes, 1 stray; else nothing", _Slow
)
def slow_reply(packet: bytes, wanted: _Slow, rng: Rng, context: Context) -> Pieces:
    """An answer is late; frames pass it."""
    factor = 1.0
    if wanted.tail == "uniform":
        factor = 2 * rng.uniform()
    elif wanted.tail == "heavy":
        factor = min((1 - rng.uniform()) ** -0.5, _LONGEST_WAIT)
    return [Piece(packet, delay_ns=round(wanted.delay_ms * factor * NS_PER_MS), aside=True)]


@of_reply("1 stray")
def duplicate_ack(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """An answer comes twice."""
    return [Piece(packet), Piece(packet)]


@of_reply("1 stray")
def stale_ack(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """The ACK of an earlier command comes before the answer."""
    return [Piece(response_bytes(Ack())), Piece(packet)]


@of_reply("1 ResponseTimeout and 1 stray")
def late_reply(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """An answer comes behind the next one."""
    return [Piece(packet, behind=1)]


@of_reply("1 RemoteProtocolError and 1 stray")
def wrong_reply(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A REPLY carries the content id of another question."""
    payload = normal_payload(packet)
    if payload is None or len(payload) < 6 or payload[0] != ResponseCode.XTS_SPR_REPLY:
        return None
    content_id = struct.unpack_from("<I", payload, 2)[0] ^ 0xFFFF
    return [Piece(encode_normal(payload[:2] + struct.pack("<I", content_id) + payload[6:]))]


@of_packet("BOOTING: 1 reboot", _SentSystemCode)
def system_message(packet: bytes, wanted: _SentSystemCode, rng: Rng, context: Context) -> Pieces:
    """A SYSTEM message comes in mid-session."""
    return [Piece(response_bytes(System(code=wanted.code)) + packet)]


@of_reply("1 PONG 'not ready'")
def not_ready(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """The module answers PING with 'not ready'."""
    if not isinstance(context.command, Ping):
        return None
    return [Piece(response_bytes(Pong(value=PongCode.XTS_SPRP_NOTREADY)))]


@of_command("1 RemoteProtocolError where the setting is read back and differs")
def ack_then_ignore(
    packet: bytes, wanted: Parameters, rng: Rng, context: Context
) -> Handling | None:
    """The module acknowledges an X4 setting and does not change it."""
    if not isinstance(context.command, X4DriverSet):
        return None
    return Handling(to_host=(Piece(response_bytes(Ack())),))


@of_command("1 RemoteProtocolError or warning where it is read back", _RoundingStep)
def ack_quantised(
    packet: bytes, wanted: _RoundingStep, rng: Rng, context: Context
) -> Handling | None:
    """The module acknowledges an X4 setting and sets it to a step of its own."""
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


@of_command("1 ResponseTimeout")
def command_lost(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Handling:
    """A command does not reach the module."""
    return Handling()


@of_command("1 ResponseTimeout; the module does not answer")
def command_damaged(
    packet: bytes, wanted: Parameters, rng: Rng, context: Context
) -> Handling | None:
    """A command reaches the module with a wrong checksum."""
    if packet[-3] == ESCAPE:
        return None
    right = packet[-2]
    wrong = [code for code in range(256) if code not in (right, START, END, ESCAPE)]
    return Handling(to_module=packet[:-2] + bytes((wrong[rng.below(len(wrong))], END)))
