"""The bootloader of a module: bytes in, answers out, and the flash it writes.

It has its own parser, which differs from the application's: it reports what it finds damaged. The
flash of the application is assumed to be erased at first and is forgotten with the module; the
emulated firmware does not depend on it. Whether it was left unlocked is kept.

Source: protocol reference 4.12 and 1.2.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from xethru_protocol.wire.codes import (
    BootloaderCode,
    BootloaderFraming,
    BootloaderReply,
    CommandCode,
)
from xethru_protocol.wire.framing import END, ESCAPE, NO_ESCAPE_START, START, xor

PAGE_BYTES = 512
PAGE_COUNT, SMALL_PAGE_COUNT = 3712, 1664
"""What PAGE_CNT answers on a microcontroller with 2 MB and with 1 MB of flash."""
FIRST_PAGE, LAST_PAGE = 128, 3456
ERASED_AT_ONCE = 16
"""Pages; a page whose number is a multiple of it erases as many before it is written."""
BUFFER_BYTES = 2048
WRITTEN = b"\x33"
_PAGES_PER_LOCK = 32
_FIRST_LOCK = FIRST_PAGE // _PAGES_PER_LOCK
_DATA_AT = 5  # of a page in the payload of WRITE_PAGE: behind C0 10, the number and a zero
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


class Bootloader:
    """The bootloader of one module.

    Parameters
    ----------
    core_id
        The microcontroller's own number, 16 characters.
    page_count
        What PAGE_CNT answers.
    unlocked
        Whether an update was not finished before.

    Attributes
    ----------
    started
        Whether START_APP was accepted; the module then starts the application.
    """

    def __init__(
        self, core_id: str, *, page_count: int = PAGE_COUNT, unlocked: bool = False
    ) -> None:
        self._facts: dict[int, bytes] = {
            BootloaderCode.GET_DEVICE_INFO: f"XETHRU OPENBOOTLOADER V:0.1.2 ID:{core_id} ".encode(),
            BootloaderCode.PAGE_SIZE: PAGE_BYTES.to_bytes(2, "little"),
            BootloaderCode.PAGE_CNT: page_count.to_bytes(2, "little"),
        }
        self._unlocked = {_FIRST_LOCK} if unlocked else set[int]()
        self._flash: dict[int, bytes] = {}
        self._first = self._last = 0
        self.power_up()

    @property
    def stays(self) -> bool:
        """Whether the next power-up ends here, because an update was not finished."""
        return _FIRST_LOCK in self._unlocked

    def power_up(self) -> None:
        self.started = False
        self._parser = PacketParser()
        self._may_write = True
        self._checksum = 0
        self._forget_pages()

    def page(self, number: int) -> bytes:
        """Content of a page of the flash."""
        return self._flash.get(number, b"\xff" * PAGE_BYTES)

    def receive(self, data: bytes) -> Iterator[bytes]:
        """Take bytes from the host; yields the payloads of the answers."""
        for found in self._parser.receive(data):
            if self.started:  # everything that follows is ignored
                return
            if isinstance(found, BootloaderFraming):
                yield bytes((BootloaderReply.FRAMING_ERROR, found))
                continue
            payload, length = found
            if payload[0] == CommandCode.XTS_SPC_BOOTLOADER and length > 1:
                answer = self._answer(payload, length)
                if answer is not None:
                    yield answer

    def _answer(self, payload: memoryview, length: int) -> bytes | None:
        command = payload[1]
        if command in self._facts:
            return _success(self._facts[command])
        if command == BootloaderCode.WRITE_PAGE:
            # what is not sent is read from the buffer, whatever is left in it
            page = bytes(payload[_DATA_AT : _DATA_AT + PAGE_BYTES])
            return self._write_page(int.from_bytes(payload[2:4], "big"), page)
        if command == BootloaderCode.START_APP:
            return self._start_app()
        if command == BootloaderCode.ECHO:
            return bytes(payload[1:length])
        self._may_write = False
        return bytes((BootloaderReply.UNKNOWN_COMMAND,))

    def _write_page(self, number: int, data: bytes) -> bytes:
        if FIRST_PAGE <= number <= LAST_PAGE and self._may_write:
            self._first = min(self._first, number)
            self._last = max(self._last, number)
            if number // _PAGES_PER_LOCK in self._unlocked:  # else the flash ignores it
                if number % ERASED_AT_ONCE == 0:
                    for erased in range(number, number + ERASED_AT_ONCE):
                        self._flash.pop(erased, None)
                # writing clears bits, only erasing sets them
                self._flash[number] = bytes(
                    old & new for old, new in zip(self.page(number), data, strict=True)
                )
            return _success(WRITTEN)
        if number == 0:
            self._checksum = int.from_bytes(data[:4], "little")
            if not self._may_write:
                return bytes((BootloaderReply.WRITING_REFUSED,))
            self._unlocked.update(range(_FIRST_LOCK, LAST_PAGE // _PAGES_PER_LOCK + 1))
            return _success()
        if number > LAST_PAGE:
            return bytes((BootloaderReply.PAGE_OUT_OF_BOUNDS,))
        return _success()  # and yet not written

    def _start_app(self) -> bytes | None:
        answer: bytes | None = None
        if self._first <= self._last:
            pages = range(FIRST_PAGE, FIRST_PAGE + self._last - self._first + 1)
            found = sum(sum(self.page(number)) for number in pages) & 0xFFFFFFFF
            if found == self._checksum:
                self._unlocked.difference_update(range(self._last // _PAGES_PER_LOCK + 1))
                self.started = True
                answer = _success()
            else:
                answer = bytes((BootloaderReply.WRONG_CHECKSUM,))
        self._may_write = False
        self._forget_pages()
        return answer

    def _forget_pages(self) -> None:
        self._first, self._last = 0xFFFF, 0


def _success(data: bytes = b"") -> bytes:
    return bytes((BootloaderReply.SUCCESS,)) + data
