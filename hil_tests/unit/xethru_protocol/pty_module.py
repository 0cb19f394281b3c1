"""A scripted module behind a real pseudo-terminal, for programs that open a port."""

import os
import pty
import select
import threading
import tty
from collections.abc import Sequence
from types import TracebackType
from typing import Self

from hil_tests.unit.xethru_protocol.scripted import PlainModule, frame
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NEED_DATA


class PtyModule:
    """Answers like `PlainModule`; streams frames 0, 1, 2 ... while FPS is positive."""

    def __init__(self) -> None:
        self.received: list[m.Message] = []
        self.fps = 0.0
        self._plain = PlainModule()
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
        os.close(self._master)
        os.close(self._slave)

    def _serve(self) -> None:
        module = Connection(Role.MODULE)
        out = bytearray()
        counter = 0
        while not self._stop.is_set():
            readable, writable, _ = select.select(
                [self._master], [self._master] if out else [], [], 0.005
            )
            if readable:
                module.receive_data(os.read(self._master, 4096))
                while (event := module.next_event()) is not NEED_DATA:
                    assert isinstance(event, m.Message)
                    out += b"".join(map(module.send, self._answer(event)))
            if writable:
                del out[: os.write(self._master, out)]
            if self.fps > 0 and not out:
                out += module.send(frame(counter))
                counter += 1

    def _answer(self, command: m.Message) -> Sequence[m.Message]:
        self.received.append(command)
        if isinstance(command, m.X4DriverSet) and command.setting is X4Setting.FPS:
            assert isinstance(command.value, float)
            self.fps = command.value
        return [answer for answer in self._plain(command) if isinstance(answer, m.Message)]
