"""Serial transport on pseudo-terminals."""

import os
import pty
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from xethru_protocol.errors import Disconnected, PortUnavailable
from xethru_protocol.transport import SerialTransport


class Line:
    """A pty: ``master`` is the module's end, ``path`` the port."""

    def __init__(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self._open = [self.master, slave]

    def unplug(self) -> None:
        while self._open:
            os.close(self._open.pop())


@pytest.fixture
def line() -> Iterator[Line]:
    line = Line()
    yield line
    line.unplug()


def test_bytes_go_both_ways(line: Line) -> None:
    port = SerialTransport(line.path)
    os.write(line.master, bytes(range(256)))
    assert port.read(1.0) == bytes(range(256))
    assert port.read(0.0) == b""
    port.write(b"\x7d\x10\x6d\x7e")
    assert os.read(line.master, 99) == b"\x7d\x10\x6d\x7e"
    assert port.name == line.path
    port.close()


def test_one_program_at_a_time(line: Line) -> None:
    port = SerialTransport(line.path)
    with pytest.raises(PortUnavailable, match=f"port {line.path} is in use by another program"):
        SerialTransport(line.path)
    port.close()
    SerialTransport(line.path).close()


def test_unplugged_port_is_disconnected_and_can_be_closed(line: Line) -> None:
    port = SerialTransport(line.path)
    line.unplug()
    with pytest.raises(Disconnected, match="was disconnected"):
        port.read(1.0)
    with pytest.raises(Disconnected, match="was disconnected"):
        port.write(b"\x00")
    port.close()
    port.close()
    with pytest.raises(Disconnected, match="was closed"):
        port.read(0.0)


def test_missing_port_says_where_to_look(tmp_path: Path) -> None:
    with pytest.raises(PortUnavailable, match=r"there is no port .*/radar; 'xethru list'"):
        SerialTransport(str(tmp_path / "radar"))


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_is_no_port_is_called_so(tmp_path: Path, kind: str) -> None:
    path = tmp_path
    if kind == "file":
        path = tmp_path / "notes.txt"
        path.write_text("hello")
    with pytest.raises(PortUnavailable, match="is not a serial port"):
        SerialTransport(str(path))
