"""The vendor's packet parser, as the bootloader has it.

It needs no start byte, and its buffer keeps what earlier packets left, which commands that are too
short read on in.

Source: protocol reference 1.2 and 4.12.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from xethru_protocol.wire.codes import BootloaderFraming
from xethru_protocol.wire.framing import (
    END,
    ESCAPE,
    NO_ESCAPE_START,
    START,
    xor,
)

BUFFER_BYTES = 2048
_FAST_START = 0x51  # a deprecated framing, which the parser still knows
_SPECIAL = re.compile(rb"[\x7d-\x7f]")
_NO_ESCAPE_HEADER = 5  # length and reserved


FoundPacket = tuple[memoryview, int] | BootloaderFraming


class PacketParser:
    """The vendor's parser over a buffer of its own, which keeps what earlier packets left in it."""

    def __init__(self, size: int = BUFFER_BYTES) -> None:
        self.buffer = bytearray(size)
        self._length = 0
        self._escaped = self._no_escape = self._fast = False

    def receive(self, data: bytes) -> Iterator[FoundPacket]:
        """Yield what is found: the buffer from a payload on, and its length; or damage."""
        at = 0
        while at < len(data):
            room = len(self.buffer) - self._length
            if not room:
                self._restart()
                self._escaped = False
                at += 1
                yield BootloaderFraming.OUT_OF_BUFFER
            elif self._fast or self._no_escape:
                at += self._put(data[at : at + min(self._missing(), room)])
                if not self._missing():
                    yield self._counted()
                    self._restart()
            elif self._escaped:
                self._escaped = False
                at += self._take(data[at : at + 1])
            elif (special := _SPECIAL.match(data, at)) is not None:
                at += 1
                yield from self._special(special[0][0])
            elif data[at] == _FAST_START and not self._length:
                self._fast = True
            else:
                special = _SPECIAL.search(data, at, at + room)
                end = at + room if special is None else special.start()
                at += self._take(data[at:end])

    def _special(self, byte: int) -> Iterator[FoundPacket]:
        if byte == ESCAPE:
            self._escaped = True
            return
        if byte == START and self._length:
            yield BootloaderFraming.LOST_BYTES
        elif byte == END and not self._length:
            yield BootloaderFraming.INCOMPLETE_PACKET
            return
        elif byte == END:
            payload = self._length - 1
            if START ^ xor(bytes(self.buffer[:payload])) == self.buffer[payload]:
                yield memoryview(self.buffer), payload
            else:
                yield BootloaderFraming.CRC
        self._restart()

    def _take(self, data: bytes) -> int:
        """Append bytes, up to a start of NoEscape framing; returns how many."""
        before = bytes(self.buffer[max(self._length - 3, 0) : self._length])
        first = self.buffer[0] if self._length else data[0]
        found = -1 if first == START else (before + data).find(NO_ESCAPE_START)
        if found < 0:
            return self._put(data)
        taken = self._put(data[: found + len(NO_ESCAPE_START) - len(before)])
        self._restart()
        self._no_escape = True
        return taken

    def _missing(self) -> int:
        """Bytes up to the length, or of the packet that announced it."""
        at = 1 if self._fast else 0
        if self._length < at + 4:
            return at + 4 - self._length
        return self._announced + (6 if self._fast else _NO_ESCAPE_HEADER) - self._length

    @property
    def _announced(self) -> int:
        at = 1 if self._fast else 0
        return int.from_bytes(self.buffer[at : at + 4], "little")

    def _counted(self) -> FoundPacket:
        if self._fast:
            return memoryview(self.buffer), self._length - 1
        return memoryview(self.buffer)[_NO_ESCAPE_HEADER:], self._announced

    def _put(self, data: bytes) -> int:
        self.buffer[self._length : self._length + len(data)] = data
        self._length += len(data)
        return len(data)

    def _restart(self) -> None:
        self._length = 0
        self._fast = self._no_escape = False
        self.buffer[0] = 0
