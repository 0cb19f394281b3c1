"""A module with faults as one device; and faults for a test, armed within a block and counted.

While no fault is armed every byte passes unchanged. What happens depends on the bytes, the times
and the seed only.
"""

from __future__ import annotations

import heapq
import zlib
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

from emulator.chip.chip import NS_PER_S
from emulator.faults.kind import (
    Action,
    CommandEffect,
    Context,
    KindOfFault,
    MomentEffect,
    PacketClass,
    PacketEffect,
    Parameters,
    Piece,
    Restart,
    SendToModule,
    Target,
    Unplug,
    classify,
    command_bytes,
    frame_counter,
    response_bytes,
)
from emulator.faults.plan import FaultPlan, FaultSpec, Injected, fault_spec
from emulator.scene.philox import Rng
from emulator.x4m300 import Device, PortDevice
from xethru_protocol.driver.frames import Lattice
from xethru_protocol.wire.codec import decode_command
from xethru_protocol.wire.codes import SystemCode, X4Setting
from xethru_protocol.wire.errors import LocalProtocolError
from xethru_protocol.wire.framing import Direction, NeedData, Packet, PacketReader
from xethru_protocol.wire.messages import (
    Command,
    ModReset,
    Response,
    System,
    X4DriverInit,
    X4DriverSet,
)
from xethru_protocol.wire.table import ROWS, UnknownMessage

PACKETS_PER_CALL = 32
_RETRY_NS = 10_000_000
"""How much later a call goes on that found only packets to lose: time must pass meanwhile."""
_MOST_PENDING = 64  # a module takes no more commands than it can answer
_BOOTING = response_bytes(System(code=SystemCode.XTS_SPRS_BOOTING))
_LATTICE_SETTINGS = {
    X4Setting.ITERATIONS: "iterations",
    X4Setting.PULSESPERSTEP: "pulses_per_step",
    X4Setting.DACMIN: "dac_min",
    X4Setting.DACMAX: "dac_max",
    X4Setting.DACSTEP: "dac_step",
    X4Setting.DOWNCONVERSION: "downconversion",
    X4Setting.TXCENTERFREQUENCY: "tx_center_frequency",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Opportunity:
    """Something that a fault could hit: a packet to the host, a command to the module, or a moment.

    ``time_ns`` counts from the start of the scenario; ``command`` is that which comes, or which a
    reply answers.
    """

    time_ns: int
    counter: int | None
    packet_class: PacketClass | None = None
    command: Command[Response] | None = None


class Armed:
    """One fault of one radar, each of which has random numbers of its own.

    Parameters
    ----------
    seed
        For a fault without its own.

    Attributes
    ----------
    injected
        How often.
    since_ns, first_counter, packets_since
        Time, frame counter and packets since it was injected last.
    """

    def __init__(self, number: int, spec: FaultSpec, radar: str, seed: int) -> None:
        self.number = number
        self.spec = spec
        self.kind: KindOfFault = spec.row
        self.parameters: Parameters = spec.kind_parameters()
        stream = zlib.crc32(radar.encode()) << 32 | number
        self.rng = Rng(seed if spec.seed is None else spec.seed, stream)
        self.injected = 0
        self.since_ns = 0
        self.first_counter: int | None = None
        self.packets_since = 0
        self._seen = 0

    @property
    def spent(self) -> bool:
        return 0 < self.spec.count <= self.injected

    @property
    def continuous(self) -> bool:
        """Whether it is due at every opportunity."""
        return self.spec.every == 1 and self.spec.probability >= 1

    def over(self, time_ns: int) -> bool:
        until_s = self.spec.until_s
        if until_s is not None and time_ns >= round(until_s * NS_PER_S):
            return True
        return self.spent and not self.kind.lasting

    def concerns(self, opportunity: Opportunity) -> bool:
        """Whether it is the sort of thing that the fault hits, now or later."""
        spec, packet_class = self.spec, opportunity.packet_class
        match self.spec.target:
            case Target.PACKET:
                fits = packet_class is not None and spec.packet in ("any", packet_class.value)
            case Target.FRAME:
                fits = packet_class is PacketClass.FRAME
            case Target.REPLY:
                fits = packet_class is PacketClass.REPLY
            case Target.COMMAND:
                fits = packet_class is None and opportunity.command is not None
            case Target.MOMENT:
                fits = packet_class is None and opportunity.command is None
        return fits and (spec.command is None or _is_command(opportunity.command, spec.command))

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
        return spec.probability >= 1 or self.rng.chance(spec.probability)


def _is_command(command: Command[Response] | None, wanted: str | int) -> bool:
    if command is None:
        return False
    row = ROWS.get(type(command))
    if row is not None:
        return row.name == wanted or wanted in row.opcodes
    return isinstance(command, UnknownMessage) and command.code == wanted


class LineQueue:
    """Pieces that wait for their time, or for others to go first."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, bytes]] = []
        self._held: list[tuple[int, PacketClass, bytes]] = []  # how many go first, of which class
        self._aside_due_ns: dict[PacketClass, int] = {}  # of classes that others may pass
        self._next = 0
        self._last_due_ns = 0
        self.waiting_bytes = 0

    def __bool__(self) -> bool:
        return bool(self._heap or self._held)

    def put(self, pieces: Iterable[Piece], packet_class: PacketClass, now_ns: int) -> None:
        """Add what is left of one packet; those that wait for others of its class come nearer."""
        waiting, self._held = self._held, []
        for piece in pieces:
            self._put(piece, packet_class, now_ns)
        for behind, waits_for, data in waiting:
            if waits_for is not packet_class:
                self._held.append((behind, waits_for, data))
            elif behind > 1:
                self._held.append((behind - 1, waits_for, data))
            else:
                self._push(max(now_ns, self._last_due_ns), data)

    def _put(self, piece: Piece, packet_class: PacketClass, now_ns: int) -> None:
        if not piece.data:
            return
        self.waiting_bytes += len(piece.data)
        if piece.behind:
            self._held.append((piece.behind, packet_class, piece.data))
            return
        due_ns = max(now_ns + piece.delay_ns, self._aside_due_ns.get(packet_class, 0))
        if piece.aside:
            self._aside_due_ns[packet_class] = due_ns
        else:
            due_ns = max(due_ns, self._last_due_ns)
            if packet_class not in self._aside_due_ns:
                self._last_due_ns = due_ns
        self._push(due_ns, piece.data)

    def take(self, now_ns: int) -> bytes | None:
        if not self._heap or self._heap[0][0] > now_ns:
            return None
        data = heapq.heappop(self._heap)[2]
        self.waiting_bytes -= len(data)
        return data

    def wake_ns(self) -> int | None:
        return self._heap[0][0] if self._heap else None

    def clear(self) -> None:
        self._heap.clear()
        self._held.clear()
        self._aside_due_ns.clear()
        self._last_due_ns = 0
        self.waiting_bytes = 0

    def _push(self, due_ns: int, data: bytes) -> None:
        heapq.heappush(self._heap, (due_ns, self._next, data))
        self._next += 1


class Watch:
    """What passed one port so far.

    Attributes
    ----------
    counter
        Of the last radar frame; None before the first.
    previous_frame
        The radar frame before the last one, as bytes.
    unjudged
        Bytes from the host that may become a command.
    """

    def __init__(self) -> None:
        self.counter: int | None = None
        self.previous_frame: bytes | None = None
        self._frame: bytes | None = None
        self._settings: dict[str, int] = {}
        self._lattice: Lattice | None = None
        self._pending: deque[tuple[Command[Response], bool]] = deque(maxlen=_MOST_PENDING)
        self._reader = PacketReader(Direction.FROM_HOST)
        self.unjudged = bytearray()

    @property
    def lattice(self) -> Lattice | None:
        """Values that samples have under the settings seen; None while one is not known."""
        if self._lattice is None and len(self._settings) == len(_LATTICE_SETTINGS):
            values = dict(self._settings)
            downconversion = values.pop("downconversion") == 1
            try:
                self._lattice = Lattice.of(**values, downconversion=downconversion)
            except LocalProtocolError:
                self._settings.clear()  # until others are set
        return self._lattice

    def host_pieces(self, data: bytes) -> list[tuple[bytes, Command[Response] | None]]:
        """Cut bytes of the host into commands and others; an incomplete command waits for more.

        With each piece comes the command that it is, None for damaged ones.
        """
        self.unjudged += data
        self._reader.receive_data(data)
        pieces = []
        while not isinstance(found := self._reader.next_packet(), NeedData):
            end = len(self.unjudged) - self._reader.buffered
            piece = bytes(self.unjudged[:end])
            del self.unjudged[:end]
            command = decode_command(found.payload) if isinstance(found, Packet) else None
            if piece or command is not None:
                pieces.append((piece, command))
        return pieces

    def command_sent(self, command: Command[Response], *, silent: bool = False) -> None:
        """Note that the module got a command; ``silent`` if the host shall not see its answer."""
        self._pending.append((command, silent))
        if isinstance(command, X4DriverInit):
            self._settings.clear()
            self._lattice = None
        elif isinstance(command, X4DriverSet) and isinstance(command.value, int):
            name = _LATTICE_SETTINGS.get(command.setting)
            if name is not None:
                self._settings[name] = command.value
                self._lattice = None

    def answered(self) -> tuple[Command[Response] | None, bool]:
        """Return the command that a reply answers, and whether the host shall not see it."""
        return self._pending.popleft() if self._pending else (None, False)

    def sent(self, packet: bytes, packet_class: PacketClass) -> None:
        if packet_class is PacketClass.FRAME:
            self.previous_frame, self._frame = self._frame, packet
            self.counter = frame_counter(packet)
        elif packet == _BOOTING:
            self.restarted()

    def restarted(self) -> None:
        self._pending.clear()
        self._settings.clear()
        self._lattice = None


class FaultyDevice:
    """A module and its faults, as one device.

    Parameters
    ----------
    inner
        Only asked to reset itself if it is not emulated here, but behind a proxy.
    name
        Of the radar, as scenarios and the truth log call it.
    note
        Called with every fault that is injected.
    zero_ns
        Device time from which the scenario counts.

    Attributes
    ----------
    injected
        How often each kind was injected so far, cleared faults included.
    """

    def __init__(
        self,
        inner: PortDevice,
        name: str,
        plan: FaultPlan,
        note: Callable[[Injected], object] = lambda injected: None,
        *,
        zero_ns: int = 0,
    ) -> None:
        self.inner = inner
        self.name = name
        self.armed: list[Armed] = []
        self.injected: Counter[str] = Counter()
        self._note = note
        self._seed = plan.seed
        self._zero_ns = zero_ns
        self._numbered = 0
        self._watch = Watch()
        self._queue = LineQueue()
        self._actions: list[tuple[int, Action]] = []
        self._sent_bytes = 0
        self._away = False
        self._back_ns: int | None = None
        self._restarting = False  # a module that was asked to reset has not sent BOOTING yet
        self._cut_next: Unplug | None = None
        self._again_ns: int | None = None
        self._passed = 0  # bytes of a half command that the module has already
        for spec in plan.fault:
            if not spec.radar or name in spec.radar:
                self.add(spec)

    # --- faults ---------------------------------------------------------------------------------

    def add(self, spec: FaultSpec) -> int:
        """Arm a fault; return the number by which `clear` knows it."""
        self._numbered += 1
        self.armed.append(Armed(self._numbered, spec, self.name, self._seed))
        return self._numbered

    def clear(self, number: int | None = None) -> int:
        """Disarm one fault, or all; return how many that were."""
        before = len(self.armed)
        self.armed = [armed for armed in self.armed if number not in (None, armed.number)]
        return before - len(self.armed)

    # --- the port -------------------------------------------------------------------------------

    def port_present(self, now_ns: int) -> bool:
        return not self._away and self.inner.port_present(now_ns)

    def unplug(self, now_ns: int, away_ns: int | None = None) -> None:
        """Take the port away, for good or for a while; what was under way is lost."""
        self._away = True
        self._back_ns = None if away_ns is None else now_ns + away_ns
        self._queue.clear()
        self._cut_next = None

    def plug(self, now_ns: int) -> None:
        """Give the port back; the module was without power, so it starts anew."""
        if self._away:
            self._away = False
            self._back_ns = None
            if isinstance(self.inner, Device):
                self.inner.power_cycle(now_ns)
            else:
                self._ask_to_reset(now_ns)

    def restart(self, now_ns: int, reason: str = "watchdog") -> None:
        """Restart the module without having been asked, as after a fault that it counts."""
        self._watch.restarted()
        self._queue.clear()
        if isinstance(self.inner, Device):
            self.inner.crash(reason, now_ns)
        else:
            self._ask_to_reset(now_ns)

    def _ask_to_reset(self, now_ns: int) -> None:
        """Reset a module that is not emulated here; its bytes are dropped until BOOTING."""
        self._restarting = True
        self.inner.receive_data(command_bytes(ModReset()), now_ns)

    # --- from the host --------------------------------------------------------------------------

    @property
    def wants_data(self) -> bool:
        return self.inner.wants_data

    def receive_data(self, data: bytes, now_ns: int) -> None:
        self.advance(now_ns)
        if self._away or self._restarting:
            return
        if isinstance(self.inner, Device) and not self.inner.listens:
            return
        holds = any(armed.spec.target is Target.COMMAND for armed in self.armed)
        begun = self._passed
        for piece, command in self._watch.host_pieces(data):
            fresh, touched = piece[begun:], begun > 0
            begun = max(begun - len(piece), 0)
            if command is not None and holds and not touched:
                self._command(command, piece, now_ns)
                continue
            if command is not None:
                self._watch.command_sent(command)
            if holds:
                self.inner.receive_data(fresh, now_ns)
        rest = bytes(self._watch.unjudged)
        if not holds:
            self.inner.receive_data(data, now_ns)
            begun = len(rest)
        elif begun:  # the module has the start of it already
            self.inner.receive_data(rest[begun:], now_ns)
            begun = len(rest)
        self._passed = begun

    def _command(self, command: Command[Response], data: bytes, now_ns: int) -> None:
        opportunity = Opportunity(
            time_ns=now_ns - self._zero_ns, counter=self._watch.counter, command=command
        )
        for armed in self.armed:
            if not armed.concerns(opportunity) or not armed.due(opportunity):
                continue
            effect = cast("CommandEffect", armed.kind.effect)
            context = Context(now_ns=now_ns, since_ns=now_ns, command=command)
            handling = effect(data, armed.parameters, armed.rng, context)
            if handling is None:
                continue
            self._fired(armed, now_ns)
            if handling.command is not None:
                self._watch.command_sent(handling.command)
            if handling.to_module:
                self.inner.receive_data(handling.to_module, now_ns)
            self._queue.put(handling.to_host, PacketClass.REPLY, now_ns)
            return
        self._watch.command_sent(command)
        self.inner.receive_data(data, now_ns)

    # --- to the host ----------------------------------------------------------------------------

    def advance(self, now_ns: int) -> None:
        if self.armed:
            opportunity = Opportunity(time_ns=now_ns - self._zero_ns, counter=self._watch.counter)
            for armed in self.armed:
                if armed.concerns(opportunity) and armed.due(opportunity):
                    self._start(armed, now_ns)
            self._disarm_what_is_over(now_ns)
        if self._actions:
            due = [action for due_ns, action in self._actions if due_ns <= now_ns]
            self._actions = [entry for entry in self._actions if entry[0] > now_ns]
            for action in due:
                self._act(action, now_ns)
        if self._back_ns is not None and now_ns >= self._back_ns:
            self.plug(now_ns)
        self.inner.advance(now_ns)

    def next_packet(self, now_ns: int) -> bytes | None:
        self._again_ns = None
        if self._away:
            return None
        packet = self._queue.take(now_ns)
        for _ in range(PACKETS_PER_CALL):
            if packet is not None:
                self._sent_bytes += len(packet)
                return packet
            fresh = self.inner.next_packet(now_ns)
            if fresh is None:
                return None
            packet = self._through(fresh, now_ns)
            if self._restarting:
                break
        if packet is not None:
            self._sent_bytes += len(packet)
            return packet
        self._again_ns = now_ns + _RETRY_NS
        return None

    def wake_ns(self, now_ns: int) -> int | None:
        moments = [
            self._zero_ns + round(armed.spec.at_s * NS_PER_S)
            for armed in self.armed
            if armed.spec.target is Target.MOMENT and not armed.over(now_ns - self._zero_ns)
        ]
        candidates = [
            self.inner.wake_ns(now_ns),
            self._again_ns,
            self._back_ns,
            self._queue.wake_ns(),
            *moments,
            *(due_ns for due_ns, _ in self._actions),
        ]
        return min((due_ns for due_ns in candidates if due_ns is not None), default=None)

    def _through(self, packet: bytes, now_ns: int) -> bytes | None:
        """Take one packet through the faults; return bytes to send at once."""
        packet_class = classify(packet)
        command: Command[Response] | None = None
        if self._restarting:
            if packet != _BOOTING:
                return None
            self._restarting = False
        if packet_class is PacketClass.REPLY:
            command, silent = self._watch.answered()
            if silent:
                return None
        self._watch.sent(packet, packet_class)
        if self._cut_next is not None and packet_class is PacketClass.FRAME:
            cut, self._cut_next = self._cut_next, None
            self._actions.append((now_ns, Unplug(cut.away_ns)))
            return packet[: max(round(len(packet) * cut.part_of_frame), 1)]
        if not self.armed and not self._queue:
            return packet
        opportunity = Opportunity(
            time_ns=now_ns - self._zero_ns,
            packet_class=packet_class,
            counter=self._watch.counter,
            command=command,
        )
        self._queue.put(self._spoil(packet, opportunity, now_ns), packet_class, now_ns)
        return self._queue.take(now_ns)

    def _spoil(self, packet: bytes, opportunity: Opportunity, now_ns: int) -> Sequence[Piece]:
        pieces: Sequence[Piece] = [Piece(packet)]
        for armed in self.armed:
            if not armed.concerns(opportunity):
                continue
            fires = armed.due(opportunity)
            lasts = armed.kind.lasting and armed.injected > 0
            if fires and lasts and armed.continuous:
                fires = self._comes_again(armed, pieces, opportunity, now_ns)
            if armed.kind.target is Target.MOMENT:
                if fires:
                    self._start(armed, now_ns)
                continue
            if not fires and not lasts:
                continue
            spoiled = _spoiled(
                armed, pieces, self._context(armed, opportunity, now_ns, fires=fires)
            )
            if spoiled is None:
                continue
            pieces = spoiled
            if fires:
                self._fired(armed, now_ns)
            else:
                armed.packets_since += 1
        self._disarm_what_is_over(now_ns)
        return pieces

    def _comes_again(
        self, armed: Armed, pieces: Sequence[Piece], opportunity: Opportunity, now_ns: int
    ) -> bool:
        """Whether a lasting fault that is always due is injected once more."""
        if armed.kind.again != "ends":
            return armed.kind.again == "adds"
        going_on = self._context(armed, opportunity, now_ns, fires=False)
        return _spoiled(armed, pieces, going_on) in (None, pieces)

    def _context(
        self, armed: Armed, opportunity: Opportunity, now_ns: int, *, fires: bool
    ) -> Context:
        return Context(
            now_ns=now_ns,
            since_ns=now_ns if fires else armed.since_ns,
            firings=armed.injected + fires,
            packets_since=0 if fires else armed.packets_since + 1,
            first_counter=self._watch.counter if fires else armed.first_counter,
            command=opportunity.command,
            previous_frame=self._watch.previous_frame,
            lattice=self._watch.lattice,
        )

    # --- moments --------------------------------------------------------------------------------

    def _disarm_what_is_over(self, now_ns: int) -> None:
        self.armed = [armed for armed in self.armed if not armed.over(now_ns - self._zero_ns)]

    def _start(self, armed: Armed, now_ns: int) -> None:
        effect = cast("MomentEffect", armed.kind.effect)
        self._fired(armed, now_ns)
        for action in effect(armed.parameters, armed.rng):
            delay_ns = action.delay_ns if isinstance(action, Restart) else 0
            self._actions.append((now_ns + delay_ns, action))

    def _act(self, action: Action, now_ns: int) -> None:
        match action:
            case Restart(reason=reason):
                self.restart(now_ns, reason)
            case Unplug() if action.part_of_frame:
                self._cut_next = action
            case Unplug():
                self.unplug(now_ns, action.away_ns)
            case SendToModule(command):
                self._watch.command_sent(command, silent=True)
                self.inner.receive_data(command_bytes(command), now_ns)

    def _fired(self, armed: Armed, now_ns: int) -> None:
        armed.injected += 1
        armed.since_ns = now_ns
        armed.first_counter = self._watch.counter
        armed.packets_since = 0
        self.injected[armed.kind.name] += 1
        self._note(
            Injected(
                t_ns=now_ns,
                radar=self.name,
                kind=armed.kind.name,
                parameters=armed.parameters.model_dump(),
                counter=self._watch.counter,
                offset=self._sent_bytes + self._queue.waiting_bytes,
            )
        )


def _spoiled(armed: Armed, pieces: Sequence[Piece], context: Context) -> Sequence[Piece] | None:
    """Return the pieces with a fault in them; None if it found nothing to spoil."""
    effect = cast("PacketEffect", armed.kind.effect)
    result: list[Piece] = []
    applied = False
    for piece in pieces:
        spoiled = effect(piece.data, armed.parameters, armed.rng, context)
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


@contextmanager
def fault(device: FaultyDevice, kind: str, **keys: Any) -> Iterator[Armed]:  # noqa: ANN401 - validated
    """Arm a fault within a block; it is cleared at its end. Keys and errors as of `fault_spec`."""
    number = device.add(fault_spec(kind, **keys))
    armed = device.armed[-1]
    try:
        yield armed
    finally:
        device.clear(number)
