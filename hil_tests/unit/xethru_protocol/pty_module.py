"""Scripted modules behind real pseudo-terminals, for programs that open a port."""

import contextlib
import json
import os
import pty
import select
import termios
import threading
import tty
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

from hil_tests.unit.xethru_protocol.scripted import PlainModule, frame
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
    return []


class PtyModule:
    """A module behind a pseudo-terminal; it streams frames 0, 1, 2 ... while FPS is positive.

    ``answer`` is what it answers to each command, by default as `PlainModule`; b"" unplugs it. It
    hears only at ``baudrate`` (a ``termios.B...``), sends ``unasked`` again and again, and
    ``echoes`` what it gets. ``link`` is another name of the port until the module is unplugged.
    """

    def __init__(
        self,
        answer: Answer | None = None,
        *,
        baudrate: int | None = None,
        unasked: Said | None = None,
        echoes: bool = False,
        link: Path | None = None,
    ) -> None:
        self.received: list[m.Message] = []
        self.fps = 0.0
        self._answer = PlainModule() if answer is None else answer
        self._baudrate = baudrate
        self._unasked = unasked
        self._echoes = echoes
        self._link = link
        self._module = Connection(Role.MODULE)
        self._out = bytearray()
        self._frames = 0
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        if link is not None:
            link.symlink_to(self.path)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *reason: object) -> None:
        self._stop.set()
        self._thread.join()
        self._unplug()

    def _serve(self) -> None:
        while not self._stop.is_set() and self._master >= 0:
            if select.select([self._master], [], [], 0.005)[0]:
                self._hear(os.read(self._master, 4096))
            elif self._unasked is not None and not self._out:
                self._say(self._unasked)
            if self.fps > 0 and not self._out:
                self._say(frame(self._frames))
                self._frames += 1
            if self._master >= 0:
                with contextlib.suppress(BlockingIOError):  # the host does not read
                    while self._out:
                        del self._out[: os.write(self._master, self._out)]

    def _hear(self, data: bytes) -> None:
        if self._echoes:
            self._out += data
            return
        if self._baudrate not in (None, termios.tcgetattr(self._master)[4]):
            return
        self._module.receive_data(data)
        while (event := self._module.next_event()) is not NEED_DATA:
            assert isinstance(event, m.Message)
            self.received.append(event)
            if isinstance(event, m.X4DriverSet) and event.setting is X4Setting.FPS:
                assert isinstance(event.value, float)
                self.fps = event.value
            for said in self._answer(event):
                self._say(said)

    def _say(self, said: Said) -> None:
        if said == b"":
            self._unplug()
        else:
            self._out += said if isinstance(said, bytes) else self._module.send(said)

    def _unplug(self) -> None:
        if self._master >= 0:
            if self._link is not None:
                self._link.unlink()
            os.close(self._master)
            os.close(self._slave)
            self._master = -1


class PtyMachine:
    """Ports ``folder/name`` at which modules come and go.

    `known_ports` finds them as it finds those of an emulator: ``runtime`` is what
    ``XDG_RUNTIME_DIR`` names.
    """

    def __init__(self, runtime: Path) -> None:
        self._folder = runtime / "ports"
        self._folder.mkdir()
        (runtime / "xethru").mkdir(mode=0o700)
        names = ("home", "decoy", "elsewhere")
        devices = [{"path": self.path(name), "name": name, "serial": "?"} for name in names]
        announced = json.dumps({"pid": os.getpid(), "devices": devices})
        (runtime / "xethru" / f"{os.getpid()}.json").write_text(announced)
        self._cleanup = contextlib.ExitStack()
        self._plugged: dict[str, PtyModule] = {}

    def path(self, name: str) -> str:
        """Where a port is, or would be."""
        return str(self._folder / name)

    def plug(self, name: str, serial: str) -> None:
        module = PtyModule(PlainModule(serial), link=self._folder / name)
        self._plugged[name] = self._cleanup.enter_context(module)

    def unplug(self, name: str) -> None:
        self._plugged.pop(name).__exit__()

    def received(self, name: str) -> list[m.Message]:
        return list(self._plugged[name].received)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *reason: object) -> None:
        self._cleanup.close()
