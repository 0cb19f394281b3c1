"""What a kind of fault is: one row of the catalogue, and what its effect gets and returns.

Effects are pure but for the `Dice` they are handed. There are three sorts, by what they touch:

- of a packet to the host: ``(packet, parameters, dice, context) -> pieces``;
- of a command to the module: ``(packet, parameters, dice, context) -> Handling``;
- of a moment: ``(parameters, dice) -> actions``.

None instead of a result says that there was nothing to spoil; the fault then waits for a packet
that suits it, and nothing is written to the truth log.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from pydantic import BaseModel, ConfigDict

from emulator.faults.dice import Dice
from emulator.faults.packets import PacketClass
from xethru_protocol.lattice import Lattice
from xethru_protocol.messages import Command, Response

__all__ = [
    "Action",
    "CommandEffect",
    "Context",
    "Handling",
    "Kind",
    "Layer",
    "MomentEffect",
    "PacketEffect",
    "Parameters",
    "Piece",
    "Restart",
    "SayToModule",
    "Target",
    "Unplug",
]


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


class Parameters(BaseModel):
    """Parameters of a kind: frozen, and an unknown one is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(frozen=True, slots=True)
class Piece:
    """Bytes for the host.

    Attributes
    ----------
    data
        What to send.
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
    """What an effect knows beside the packet.

    Attributes
    ----------
    now_ns
        Time, ns.
    since_ns
        When the fault fired last (now, if it fires with this packet), ns.
    firings
        How often it has fired, this time included; at least 1.
    packets_since
        Packets it has seen since it fired; 0 for the one with which it fired.
    first_counter
        Counter of the frame with which it fired last; None if it was no frame.
    packet_class
        What the packet is.
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
    packet_class: PacketClass = PacketClass.DATA
    command: Command[Response] | None = None
    previous_frame: bytes | None = None
    lattice: Lattice | None = None


@dataclass(frozen=True, slots=True)
class Handling:
    """What becomes of a command.

    Attributes
    ----------
    to_module
        What the module gets to hear.
    command
        The command that this is; None if the module will not answer it.
    to_host
        What the host hears at once.
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
class SayToModule:
    """The module carries out a command that no host sent, and does not answer it."""

    command: Command[Response]


Action = Restart | Unplug | SayToModule
PacketEffect = Callable[[bytes, Any, Dice, Context], Sequence[Piece] | None]
CommandEffect = Callable[[bytes, Any, Dice, Context], Handling | None]
MomentEffect = Callable[[Any, Dice], Sequence[Action]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """One row of the catalogue.

    Attributes
    ----------
    name
        As scenario files and the truth log call it.
    layer
        Where it stands.
    target
        What it waits for.
    summary
        What happens, in a sentence.
    counted
        What an X4M300 driver counts for each one injected.
    parameters
        Model of its parameters.
    effect
        What it does.
    lasting
        Whether, once fired, it acts on all later packets too.
    hidden
        Why the counters of a driver cannot show it; empty if they do.
    """

    name: str
    layer: Layer
    target: Target
    summary: str
    counted: str
    effect: PacketEffect | CommandEffect | MomentEffect
    parameters: type[Parameters] = Parameters
    lasting: bool = False
    hidden: str = ""
