"""Modules with one thing wrong, behind real pseudo-terminals."""

import os
import pty
import select
import termios
import threading
import tty
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NEED_DATA

Said = m.Message | bytes
Answer = Callable[[m.Message], Sequence[Said]]

READY, NOT_READY, SAFE_MODE = 0xAAEEAEEA, 0xAEEAEEAA, 0xFFEEFEEF
RUN, STOP, IDLE, MANUAL = 0x01, 0x13, 0x11, 0x12
PRESENCE_2 = 0x014D4AB8


def stock(
    *,
    pong: int = READY,
    order_code: str | None = "X4M300",
    firmware_id: str = "Annapurna",
    version: str = "1.6.8",
    mode: int | None = RUN,
    profile: int | None = PRESENCE_2,
    tx_power: int = 2,
) -> Answer:
    """Answers of a module as it comes from the factory, but for what a test changes.

    None stands for ERROR 1, as firmware answers that does not know a question.
    """
    texts = {1: order_code, 2: firmware_id, 3: version, 6: "123456789012"}

    def answer(command: m.Message) -> Sequence[Said]:
        reply: m.Message | None = None
        match command:
            case m.Ping():
                reply = m.Pong(value=pong)
            case m.SystemGetInfo(item=item):
                text = texts.get(item)
                if text is not None:
                    reply = m.ReplyString(content_id=0x58, info=item, text=text)
            case m.GetMode():
                if mode is not None:
                    reply = m.ReplyByte(values=bytes([mode]))
            case m.GetProfileId():
                if profile is not None:
                    reply = m.ReplyInt(values=(profile,))
            case m.X4DriverGet(setting=X4Setting.TXPOWER):
                reply = m.ReplyByte(content_id=X4Setting.TXPOWER, values=bytes([tx_power]))
        return [m.Error(code=1) if reply is None else reply]

    return answer


def silent(command: m.Message) -> Sequence[Said]:
    """Answer nothing."""
    return []


class SickModule:
    """A module behind a pseudo-terminal.

    Parameters
    ----------
    answer
        What it says to each command; b"" unplugs it.
    baudrate
        The only rate at which it hears (a ``termios.B...``); None: every one.
    unasked
        Said again and again.
    echoes
        Whether it sends back what it gets, and nothing else.
    """

    def __init__(
        self,
        answer: Answer,
        *,
        baudrate: int | None = None,
        unasked: Said | None = None,
        echoes: bool = False,
    ) -> None:
        self.received: list[m.Message] = []
        self._answer = answer
        self._baudrate = baudrate
        self._unasked = unasked
        self._echoes = echoes
        self._module = Connection(Role.MODULE)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> Self:
        """Begin to answer."""
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Unplug."""
        self._stop.set()
        self._thread.join()
        self._unplug()

    def _serve(self) -> None:
        while not self._stop.is_set() and self._master >= 0:
            readable, _, _ = select.select([self._master], [], [], 0.005)
            if readable:
                self._hear(os.read(self._master, 4096))
            elif self._unasked is not None:
                self._say(self._unasked)

    def _hear(self, data: bytes) -> None:
        if self._echoes:
            self._say(data)
            return
        if self._baudrate not in (None, termios.tcgetattr(self._master)[4]):
            return
        self._module.receive_data(data)
        while (event := self._module.next_event()) is not NEED_DATA:
            assert isinstance(event, m.Message)
            self.received.append(event)
            for said in self._answer(event):
                self._say(said)

    def _say(self, said: Said) -> None:
        data = said if isinstance(said, bytes) else self._module.send(said)
        if not data:
            self._unplug()
            return
        try:
            os.write(self._master, data)
        except BlockingIOError:  # nobody reads
            return

    def _unplug(self) -> None:
        if self._master >= 0:
            os.close(self._master)
            os.close(self._slave)
            self._master = -1
