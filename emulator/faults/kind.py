"""What a kind of fault is: one row of the catalogue, and what its effect gets and returns.

Effects are pure but for the `Rng` they are given. There are three sorts, by what they touch:

- of a packet to the host: ``(packet, parameters, rng, context) -> pieces``;
- of a command to the module: ``(packet, parameters, rng, context) -> Handling``;
- of a moment: ``(parameters, rng) -> actions``.

None instead of a result means that there was nothing to spoil; the fault then waits for a packet
that suits it, and nothing is written to the truth log.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from emulator.scene.philox import Rng
from emulator.scene.toml_files import Table
from xethru_protocol.driver.frames import Lattice
from xethru_protocol.wire.codes import ElementType, ResponseCode
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import (
    ESCAPE,
    NO_ESCAPE_HEADER_BYTES,
    NO_ESCAPE_START,
    START,
    unescape,
)
from xethru_protocol.wire.messages import Command, DataFloat, Response

RfSamples = NDArray[np.float32]

COUNTERS = 1 << 32  # after the last follows 0
NS_PER_MS = 1_000_000
SEEN_IN_TIMES = "nothing; the arrival times show it"
NO_TIME_IN_FRAMES = "Frames carry no time; only when they arrive shows it."

_FRAME = struct.Struct("<4sIxBBIII")
_REPLIES = frozenset(
    {
        ResponseCode.XTS_SPR_PONG,
        ResponseCode.XTS_SPR_ACK,
        ResponseCode.XTS_SPR_REPLY,
        ResponseCode.XTS_SPR_ERROR,
    }
)


class PacketClass(Enum):
    """What a packet from the module is."""

    FRAME = "frame"
    """A radar frame, RF or baseband. Protocol reference 6.1."""
    REPLY = "reply"
    """ACK, ERROR, PONG or REPLY: answers a command. Protocol reference 3."""
    SYSTEM = "system"
    """BOOTING, READY and the like. Protocol reference 5."""
    DATA = "data"
    """Anything else: profile output, strings, and bytes that are not a packet."""


def classify(packet: bytes) -> PacketClass:
    """Return what a packet is, by its first bytes.

    >>> classify(bytes.fromhex("7D 10 6D 7E"))
    <PacketClass.REPLY: 'reply'>
    """
    if packet.startswith(NO_ESCAPE_START):
        return PacketClass.FRAME if frame_counter(packet) is not None else PacketClass.DATA
    if len(packet) < 4 or packet[0] != START:
        return PacketClass.DATA
    code = packet[2] if packet[1] == ESCAPE else packet[1]
    if code in _REPLIES:
        return PacketClass.REPLY
    return PacketClass.SYSTEM if code == ResponseCode.XTS_SPR_SYSTEM else PacketClass.DATA


def frame_counter(packet: bytes) -> int | None:
    """Return the counter of a radar frame; None for anything else."""
    if len(packet) < _FRAME.size:
        return None
    magic, length, code, kind, content_id, counter, count = _FRAME.unpack_from(packet)
    is_frame = (
        magic == NO_ESCAPE_START
        and (code, kind, content_id) == (ResponseCode.XTS_SPR_DATA, ElementType.XTS_SPRD_FLOAT, 0)
        and len(packet) == NO_ESCAPE_HEADER_BYTES + length == _FRAME.size + 4 * count
    )
    return counter if is_frame else None


def frame_samples(packet: bytes) -> RfSamples:
    """Return the samples of a radar frame, shape (n,), read-only."""
    return np.frombuffer(packet, "<f4", offset=_FRAME.size)


def frame_packet(counter: int, samples: RfSamples) -> bytes:
    """Return a radar frame in NoEscape framing; the counter wraps at 2**32."""
    return response_bytes(DataFloat(info=counter % COUNTERS, values=samples))


def normal_payload(packet: bytes) -> bytes | None:
    """Return the unescaped payload of a Normal packet; None for anything else."""
    if len(packet) < 4 or packet[0] != START:
        return None
    return unescape(packet[1:-1])[:-1]


def response_bytes(message: Response) -> bytes:
    return Connection(Role.MODULE).send(message)


def command_bytes(command: Command[Response]) -> bytes:
    return Connection(Role.HOST).send(command)


class Layer(Enum):
    """Where in the catalogue a kind stands."""

    BYTE = "byte"
    FRAME = "frame"
    TRANSACTION = "transaction"
    STREAM = "stream"
    DEVICE = "device"
    TIME = "time"
    ENVIRONMENT = "environment"


class Target(Enum):
    """What a kind waits for."""

    PACKET = "any packet from the module"
    FRAME = "a radar frame"
    REPLY = "the answer to a command"
    COMMAND = "a command to the module"
    MOMENT = "a moment"


class Parameters(Table):
    """Parameters of a kind."""


@dataclass(frozen=True, slots=True)
class Piece:
    """Bytes for the host.

    Attributes
    ----------
    delay_ns
        How much later than without the fault. What comes after keeps its place behind it.
    aside
        Whether later packets of other classes may pass while it waits.
    behind
        How many later packets of its class go first.
    """

    data: bytes
    delay_ns: int = 0
    aside: bool = False
    behind: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Context:
    """What an effect is given beside the packet.

    Attributes
    ----------
    since_ns
        When the fault fired last (now, if it fires with this packet), ns.
    firings
        How often it has fired, this time included; at least 1.
    packets_since
        Packets it has seen since it fired; 0 for the one with which it fired.
    first_counter
        Counter of the frame with which it fired last; None if that was not a frame.
    command
        The command itself, or the one that a reply answers; None if unknown.
    previous_frame
        The radar frame before this one, as the module sent it; None before the first.
    lattice
        Values that samples can have under the settings seen so far; None: not known.
    """

    now_ns: int = 0
    since_ns: int = 0
    firings: int = 1
    packets_since: int = 0
    first_counter: int | None = None
    command: Command[Response] | None = None
    previous_frame: bytes | None = None
    lattice: Lattice | None = None


@dataclass(frozen=True, slots=True)
class Handling:
    """The result of a fault on a command.

    Attributes
    ----------
    to_module
        What the module gets.
    command
        The command that this is; None if the module will not answer it.
    to_host
        What the host gets at once.
    """

    to_module: bytes = b""
    command: Command[Response] | None = None
    to_host: tuple[Piece, ...] = ()


@dataclass(frozen=True, slots=True)
class Restart:
    """The module restarts without having been asked."""

    delay_ns: int = 0
    reason: str = "watchdog"


@dataclass(frozen=True, slots=True)
class Unplug:
    """The port vanishes for a while; the module restarts when it is back.

    ``part_of_frame`` of the next frame is sent before, 0 ... 1; 0: the port vanishes at once.
    """

    away_ns: int
    part_of_frame: float = 0.0


@dataclass(frozen=True, slots=True)
class SendToModule:
    """The module carries out a command that no host sent, and does not answer it."""

    command: Command[Response]


Pieces = Sequence[Piece] | None
Action = Restart | Unplug | SendToModule
PacketEffect = Callable[[bytes, Any, Rng, Context], Pieces]
CommandEffect = Callable[[bytes, Any, Rng, Context], Handling | None]
MomentEffect = Callable[[Any, Rng], Sequence[Action]]
Effect = PacketEffect | CommandEffect | MomentEffect
Again = Literal["", "adds", "ends"]
EffectT = TypeVar("EffectT", bound=Callable[..., Any])


def changed_frame(packet: bytes, change: Callable[[RfSamples], RfSamples | None]) -> Pieces:
    """Return a radar frame with other samples.

    None for anything else, for a frame without samples, and if ``change`` returns None.
    """
    counter = frame_counter(packet)
    if counter is None or not frame_samples(packet).size:
        return None
    samples = change(frame_samples(packet))
    return None if samples is None else [Piece(frame_packet(counter, samples))]


@dataclass(frozen=True, slots=True, kw_only=True)
class KindOfFault:
    """One row of the catalogue.

    Attributes
    ----------
    name
        In scenario files and in the truth log.
    counted
        What an X4M300 driver counts for each one injected.
    lasting
        Whether, once fired, it acts on all later packets too.
    again
        What another injection of a lasting fault does: "adds" to the last one, or waits until that
        "ends" by itself; "" if it means nothing, so that one due at every opportunity is injected
        once.
    hidden
        Why the counters of a driver cannot show it; empty if they do.
    """

    name: str
    layer: Layer
    target: Target
    summary: str
    counted: str
    effect: Effect
    parameters: type[Parameters]
    lasting: bool
    again: Again
    hidden: str


ENTERED: list[KindOfFault] = []
"""All kinds; `emulator.faults.kinds` puts them in order."""


@dataclass(frozen=True, slots=True)
class Catalogued:
    """Enters effects of one layer that wait for the same into the catalogue, as a decorator.

    An effect's name and the first line of its docstring describe the kind.
    """

    layer: Layer
    target: Target

    def __call__(
        self,
        counted: str,
        parameters: type[Parameters] = Parameters,
        *,
        lasting: bool = False,
        again: Again = "",
        hidden: str = "",
    ) -> Callable[[EffectT], EffectT]:
        def enter(effect: EffectT) -> EffectT:
            row = KindOfFault(
                name=effect.__name__,
                layer=self.layer,
                target=self.target,
                summary=(effect.__doc__ or "").partition("\n")[0],
                counted=counted,
                effect=effect,
                parameters=parameters,
                lasting=lasting,
                again=again,
                hidden=hidden,
            )
            ENTERED.append(row)
            return effect

        return enter
