"""Odometry from everything that carries text: the same lines, an end that is noticed."""

from __future__ import annotations

import os
import pty
import socket
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hil_tests.patience import seconds
from slam.app.errors import OdometryError, UsageError
from slam.app.odometry.live import LineSource, SourceKind, parse_source, read_lines

LINES = ["0.1 0 0 0 0 0 0 1", "# a comment", "0.2 0 0 0 0 0 0 1"]
TEXT = "\n".join(LINES).encode()


def lines_of(source: LineSource, count: int | None = None) -> list[str]:
    """Read to the end, or until `count` lines came."""
    got: list[str] = []
    for text, arrival_ns in read_lines(source, lambda: False):
        assert arrival_ns > 0
        got.append(text)
        if len(got) == count:
            break
    return got


@pytest.fixture
def threads() -> Iterator[Callable[[Callable[[], object]], None]]:
    started: list[threading.Thread] = []

    def start(work: Callable[[], object]) -> None:
        started.append(threading.Thread(target=work))
        started[-1].start()

    yield start
    for thread in started:
        thread.join(timeout=seconds(5))
        assert not thread.is_alive()


def test_a_file(tmp_path: Path) -> None:
    (path := tmp_path / "drive.tum").write_bytes(TEXT)
    source = parse_source(str(path))
    assert source.kind is SourceKind.FILE
    assert not source.is_live
    assert lines_of(source) == LINES


def test_a_fifo_waits_for_its_writer_and_ends_with_it(
    tmp_path: Path, threads: Callable[[Callable[[], object]], None]
) -> None:
    os.mkfifo(path := tmp_path / "fifo")
    source = parse_source(str(path))
    assert source.kind is SourceKind.FIFO
    threads(lambda: path.write_bytes(TEXT))
    assert lines_of(source) == LINES


@pytest.mark.parametrize("prefix", ["unix:", ""])
def test_a_unix_socket(
    prefix: str, tmp_path: Path, threads: Callable[[Callable[[], object]], None]
) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(path := str(tmp_path / "s"))
        listener.listen()
        threads(lambda: serve(listener))
        source = parse_source(prefix + path)
        assert source.kind is SourceKind.UNIX
        assert lines_of(source) == LINES


def test_a_tcp_socket(threads: Callable[[Callable[[], object]], None]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        threads(lambda: serve(listener))
        port = listener.getsockname()[1]
        assert lines_of(parse_source(f"tcp://127.0.0.1:{port}")) == LINES


def serve(listener: socket.socket) -> None:
    connection, _ = listener.accept()
    with connection:
        for byte in TEXT:  # however they are cut
            connection.sendall(bytes([byte]))


def test_a_serial_port_and_its_unplugging() -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    name = os.ttyname(slave)
    source = parse_source(f"serial:{name}@57600")
    assert source == LineSource(kind=SourceKind.SERIAL, place=name, number=57600)
    assert parse_source(name).kind is SourceKind.SERIAL
    lines = read_lines(source, lambda: False)
    timer = threading.Timer(0.2, lambda: os.write(master, TEXT + b"\n"))
    timer.start()
    try:
        assert [next(lines)[0] for _ in LINES] == LINES
        os.close(master)
        with pytest.raises(OdometryError, match="was disconnected"):
            next(lines)
    finally:
        timer.join()
        os.close(slave)


def test_bytes_that_are_no_lines_end_it(tmp_path: Path) -> None:
    (path := tmp_path / "image").write_bytes(bytes(range(1, 10)) * 10_000)
    with pytest.raises(OdometryError, match="bytes without a line end; TUM text is expected"):
        lines_of(LineSource(kind=SourceKind.FILE, place=str(path)))


def test_it_stops_when_it_is_told_to(tmp_path: Path) -> None:
    os.mkfifo(path := tmp_path / "silent")
    asked = iter([False, True])
    assert list(read_lines(parse_source(str(path)), lambda: next(asked))) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("tcp://host", "must be tcp://HOST:PORT"),
        ("tcp:host:5", "must be tcp://HOST:PORT"),
        ("tcp://h:99999", "must be tcp://HOST:PORT"),
        ("serial:@9600", "must be serial:PORT or serial:PORT@BAUD"),
        ("serial:/dev/x@fast", "must be serial:PORT or serial:PORT@BAUD"),
        ("nowhere", "nowhere: No such file or directory; give one of -, a file"),
        ("/", "is no source of text"),
    ],
)
def test_what_is_no_source_is_refused_in_one_line(text: str, words: str) -> None:
    with pytest.raises(UsageError) as refused:
        parse_source(text)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_source_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(OdometryError, match=r"odometry from unix socket .*: No such file"):
        lines_of(parse_source(f"unix:{tmp_path}/none"))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(OdometryError, match=f"TCP socket 127.0.0.1:{port}: Connection refused"):
        lines_of(parse_source(f"tcp://127.0.0.1:{port}"))


@pytest.mark.parametrize(
    "text",
    [f"tcp://h:{'9' * 5000}", "tcp://h:²", f"serial:p@{'9' * 5000}", "serial:p@²", "serial:p@0"],
)
def test_numbers_that_are_none_are_wrong_usage(text: str) -> None:
    with pytest.raises(UsageError, match="must be"):
        parse_source(text)


@pytest.mark.parametrize("host", ["a..б", "a" * 300 + "б", "a\udcffb"])
def test_what_is_no_name_of_a_host_is_one_line(host: str) -> None:
    with pytest.raises(OdometryError, match="is no name of a host"):
        lines_of(parse_source(f"tcp://{host}:1"))
