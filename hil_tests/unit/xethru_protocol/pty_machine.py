"""Scripted modules behind pseudo-terminals that are plugged and unplugged while a test runs."""

import contextlib
import json
import os
import pty
import select
import threading
import tty
from pathlib import Path
from types import TracebackType
from typing import Self

from hil_tests.unit.xethru_protocol.scripted import PlainModule, frame
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NEED_DATA

_TICK_S = 0.005


class _Plugged:
    """One module and its pty; streams frames 0, 1, 2 ... while FPS is positive."""

    def __init__(self, link: Path, serial: str) -> None:
        self.received: list[m.Message] = []
        self._plain = PlainModule(serial)
        self._link = link
        self._fps = 0.0
        self._counter = 0
        self._out = bytearray()
        self._connection = Connection(Role.MODULE)
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        link.symlink_to(os.ttyname(self._slave))

    def serve(self) -> None:
        self._connection.receive_data(os.read(self.master, 4096))
        while (event := self._connection.next_event()) is not NEED_DATA:
            assert isinstance(event, m.Message)
            self.received.append(event)
            if isinstance(event, m.X4DriverSet) and event.setting is X4Setting.FPS:
                assert isinstance(event.value, float)
                self._fps = event.value
            for answer in self._plain(event):
                assert isinstance(answer, m.Message)
                self._out += self._connection.send(answer)

    def tick(self) -> None:
        if self._fps > 0 and not self._out:
            self._out += self._connection.send(frame(self._counter))
            self._counter += 1
        with contextlib.suppress(BlockingIOError):
            while self._out:
                del self._out[: os.write(self.master, self._out)]

    def vanish(self) -> None:
        self._link.unlink()
        os.close(self.master)
        os.close(self._slave)


class PtyMachine:
    """Ports ``folder/name``; `known_ports` finds them, as it finds those of an emulator.

    Parameters
    ----------
    runtime
        What ``XDG_RUNTIME_DIR`` names.
    """

    def __init__(self, runtime: Path) -> None:
        self.runtime = runtime
        self._folder = runtime / "ports"
        self._plugged: dict[str, _Plugged] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve)

    def path(self, name: str) -> str:
        """Where a port is, or would be."""
        return str(self._folder / name)

    def plug(self, name: str, serial: str) -> None:
        """Put a module behind a port."""
        with self._lock:
            self._plugged[name] = _Plugged(self._folder / name, serial)

    def unplug(self, name: str) -> None:
        """Let a port vanish."""
        with self._lock:
            self._plugged.pop(name).vanish()

    def received(self, name: str) -> list[m.Message]:
        """Commands a plugged module got."""
        with self._lock:
            return list(self._plugged[name].received)

    def __enter__(self) -> Self:
        """Begin to answer."""
        self._folder.mkdir()
        names = ("home", "decoy", "elsewhere")
        devices = [{"path": self.path(name), "name": name, "serial": "?"} for name in names]
        (self.runtime / "xethru").mkdir()
        word = self.runtime / "xethru" / f"{os.getpid()}.json"
        word.write_text(json.dumps({"pid": os.getpid(), "devices": devices}))
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Unplug everything."""
        self._stop.set()
        self._thread.join()
        for plugged in self._plugged.values():
            plugged.vanish()

    def _serve(self) -> None:
        while not self._stop.wait(_TICK_S):
            with self._lock:
                by_master = {plugged.master: plugged for plugged in self._plugged.values()}
                for master in select.select(list(by_master), [], [], 0)[0]:
                    by_master[master].serve()
                for plugged in by_master.values():
                    plugged.tick()
