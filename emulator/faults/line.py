"""What passes a port: pieces on their way to the host, and which answer belongs to which command.

Reads only; the bytes go their own way.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterable

from emulator.faults.kind import PacketClass, Piece, frame_counter, response_bytes
from xethru_protocol.driver.frames import Lattice
from xethru_protocol.wire.codec import decode_command
from xethru_protocol.wire.codes import SystemCode, X4Setting
from xethru_protocol.wire.errors import LocalProtocolError
from xethru_protocol.wire.framing import Direction, NeedData, Packet, PacketReader
from xethru_protocol.wire.messages import Command, Response, System, X4DriverInit, X4DriverSet


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


_MOST_PENDING = 64  # a module takes no more commands than it can answer
BOOTING = response_bytes(System(code=SystemCode.XTS_SPRS_BOOTING))
_LATTICE_SETTINGS = {
    X4Setting.ITERATIONS: "iterations",
    X4Setting.PULSESPERSTEP: "pulses_per_step",
    X4Setting.DACMIN: "dac_min",
    X4Setting.DACMAX: "dac_max",
    X4Setting.DACSTEP: "dac_step",
    X4Setting.DOWNCONVERSION: "downconversion",
    X4Setting.TXCENTERFREQUENCY: "tx_center_frequency",
}


class Watch:
    """What passed one port so far.

    Attributes
    ----------
    counter
        Of the last radar frame; None before the first.
    previous_frame
        The radar frame before the last one, as bytes.
    """

    def __init__(self) -> None:
        self.counter: int | None = None
        self.previous_frame: bytes | None = None
        self._frame: bytes | None = None
        self._settings: dict[str, int] = {}
        self._lattice: Lattice | None = None
        self._pending: deque[tuple[Command[Response], bool]] = deque(maxlen=_MOST_PENDING)
        self._reader = PacketReader(Direction.FROM_HOST)
        self._unjudged = bytearray()

    @property
    def lattice(self) -> Lattice | None:
        """Values that samples have under the settings seen; None while one is not known."""
        if self._lattice is None and len(self._settings) == len(_LATTICE_SETTINGS):
            values = dict(self._settings)
            downconversion = bool(values.pop("downconversion"))
            try:
                self._lattice = Lattice.of(**values, downconversion=downconversion)
            except LocalProtocolError:
                self._settings.clear()  # until others are set
        return self._lattice

    @property
    def incomplete_command(self) -> bytes:
        """Bytes from the host that are not judged yet."""
        return bytes(self._unjudged)

    def host_pieces(self, data: bytes) -> list[tuple[bytes, Command[Response] | None]]:
        """Cut bytes of the host into commands and others; an incomplete command waits for more.

        With each piece comes the command that it is, None for damaged ones.
        """
        self._unjudged += data
        self._reader.receive_data(data)
        pieces = []
        while not isinstance(found := self._reader.next_packet(), NeedData):
            end = len(self._unjudged) - self._reader.buffered
            piece = bytes(self._unjudged[:end])
            del self._unjudged[:end]
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
        elif packet == BOOTING:
            self.restarted()

    def restarted(self) -> None:
        self._pending.clear()
        self._settings.clear()
        self._lattice = None
