"""The bootloader of a module: bytes in, answers out, and the flash it writes.

It has its own parser, which differs from the application's: it reports what it finds damaged. The
flash of the application is assumed to be erased at first and is forgotten with the module; the
emulated firmware does not depend on it. Whether it was left unlocked is kept.

Source: protocol reference 4.12 and 1.2.
"""

from __future__ import annotations

from collections.abc import Iterator

from emulator.module.parser import PacketParser
from xethru_protocol.wire.codes import (
    BootloaderCode,
    BootloaderFraming,
    BootloaderReply,
    CommandCode,
)

PAGE_BYTES = 512
PAGE_COUNT, SMALL_PAGE_COUNT = 3712, 1664
"""What PAGE_CNT answers on a microcontroller with 2 MB and with 1 MB of flash."""
FIRST_PAGE, LAST_PAGE = 128, 3456
ERASED_AT_ONCE = 16
"""Pages; a page whose number is a multiple of it erases as many before it is written."""
WRITTEN = b"\x33"
_PAGES_PER_LOCK = 32
_FIRST_LOCK = FIRST_PAGE // _PAGES_PER_LOCK
_DATA_AT = 5  # of a page in the payload of WRITE_PAGE: behind C0 10, the number and a zero


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
