"""What is on its way to the host: pieces with their times, in order unless one steps aside."""

from __future__ import annotations

import heapq
from collections.abc import Iterable

from emulator.faults.kind import Piece
from emulator.faults.packets import PacketClass

__all__ = ["LineQueue"]


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
        """Whether anything waits."""
        return bool(self._heap or self._held)

    def put(self, pieces: Iterable[Piece], packet_class: PacketClass, now_ns: int) -> None:
        """Add what became of one packet; those that wait for others of its class come nearer."""
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
        """Return what is due next."""
        if not self._heap or self._heap[0][0] > now_ns:
            return None
        data = heapq.heappop(self._heap)[2]
        self.waiting_bytes -= len(data)
        return data

    def wake_ns(self) -> int | None:
        """Return when the next piece is due; None if none has a time."""
        return self._heap[0][0] if self._heap else None

    def clear(self) -> None:
        """Forget everything: the line is gone."""
        self._heap.clear()
        self._held.clear()
        self._aside_due_ns.clear()
        self._last_due_ns = 0
        self.waiting_bytes = 0

    def _push(self, due_ns: int, data: bytes) -> None:
        heapq.heappush(self._heap, (due_ns, self._next, data))
        self._next += 1
