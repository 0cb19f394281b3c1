"""A fault that waits for its moment: trigger, count and chance."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

from emulator.faults.dice import Dice
from emulator.faults.kind import Kind, Parameters, Target
from emulator.faults.packets import PacketClass
from emulator.faults.plan import FaultSpec
from xethru_protocol.messages import Command, Response
from xethru_protocol.table import ROWS, UnknownMessage

__all__ = ["Armed", "Opportunity"]

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Opportunity:
    """Something that a fault could hit; ``time_ns`` counts from the start of the scenario."""

    time_ns: int
    packet_class: PacketClass | None = None
    counter: int | None = None
    command: Command[Response] | None = None
    to_module: bool = False


class Armed:
    """One fault of one radar.

    Parameters
    ----------
    number
        By which it is cleared again.
    spec
        What it is.
    radar
        Name of the radar: every radar has its own chance.
    seed
        For a fault without its own.

    Attributes
    ----------
    firings
        How often it was injected.
    since_ns, first_counter, packets_since
        Time, frame counter and packets since it was injected last.
    """

    def __init__(self, number: int, spec: FaultSpec, radar: str, seed: int) -> None:
        self.number = number
        self.spec = spec
        self.kind: Kind = spec.row
        self.parameters: Parameters = spec.kind_parameters()
        stream = zlib.crc32(radar.encode()) << 32 | number
        self.dice = Dice(seed if spec.seed is None else spec.seed, stream)
        self.firings = 0
        self.since_ns = 0
        self.first_counter: int | None = None
        self.packets_since = 0
        self._seen = 0

    @property
    def spent(self) -> bool:
        """Whether it has been injected as often as it should."""
        return 0 < self.spec.count <= self.firings

    def over(self, time_ns: int) -> bool:
        """Whether nothing of it is left to come."""
        until_s = self.spec.until_s
        if until_s is not None and time_ns >= round(until_s * NS_PER_S):
            return True
        return self.spent and not self.kind.lasting

    def concerns(self, opportunity: Opportunity) -> bool:
        """Whether it is the sort of thing that the fault hits, now or later."""
        spec = self.spec
        target = self.target
        if opportunity.to_module != (target is Target.COMMAND):
            return False
        if target is Target.MOMENT:
            fits = opportunity.packet_class is None
        elif target is Target.FRAME:
            fits = opportunity.packet_class is PacketClass.FRAME
        elif target is Target.REPLY:
            fits = opportunity.packet_class is PacketClass.REPLY
        elif target is Target.PACKET:
            fits = opportunity.packet_class is not None and spec.packet in (
                "any",
                opportunity.packet_class.value,
            )
        else:
            fits = True
        return fits and (spec.command is None or _is_command(opportunity.command, spec.command))

    @property
    def target(self) -> Target:
        """What it waits for: a moment may be that of a frame or of an answer."""
        spec, target = self.spec, self.kind.target
        if target is not Target.MOMENT:
            return target
        if spec.command is not None:
            return Target.REPLY
        by_frame = spec.frame is not None or spec.every > 1 or spec.probability < 1
        return Target.FRAME if by_frame else Target.MOMENT

    def due(self, opportunity: Opportunity) -> bool:
        """Whether it wants to be injected here; every call counts as one opportunity."""
        spec = self.spec
        if self.spent or opportunity.time_ns < round(spec.at_s * NS_PER_S):
            return False
        if spec.frame is not None and (
            opportunity.counter is None or opportunity.counter < spec.frame
        ):
            return False
        self._seen += 1
        if self._seen % spec.every:
            return False
        return spec.probability >= 1 or self.dice.chance(spec.probability)

    def fired(self, now_ns: int, counter: int | None) -> None:
        """Learn that it was injected."""
        self.firings += 1
        self.since_ns = now_ns
        self.first_counter = counter
        self.packets_since = 0

    def next_ns(self, time_ns: int) -> int | None:
        """Return when time alone makes it due, on the scenario's clock; None if never."""
        if self.target is not Target.MOMENT or self.over(time_ns):
            return None
        return round(self.spec.at_s * NS_PER_S)


def _is_command(command: Command[Response] | None, wanted: str | int) -> bool:
    if command is None:
        return False
    row = ROWS.get(type(command))
    if row is not None:
        return row.name == wanted or row.prefix[0] == wanted
    return isinstance(command, UnknownMessage) and command.code == wanted
