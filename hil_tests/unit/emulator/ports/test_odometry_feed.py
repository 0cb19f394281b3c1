"""Odometry lines on a unix socket, at once or when due."""

import errno
import selectors
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from emulator.chip import Pace
from emulator.ports.pty import LinkError
from emulator.ports.sockets import MOST_ODOMETRY_CLIENTS, OdometryFeed, stamp_ns

LINES = tuple(f"{index}.500000000 0.1 0.2 0 0 0 0.0 1.0" for index in range(5))
SECOND = 1_000_000_000


class Loop:
    """Just enough of a loop to serve one feed at a chosen time."""

    def __init__(self, feed: OdometryFeed) -> None:
        self.feed = feed
        self.selector = selectors.DefaultSelector()
        feed.register(self.selector)

    def turn(self, now_ns: int, times: int = 1) -> None:
        for _ in range(times):
            for key, events in self.selector.select(0.01):
                key.data(events, now_ns)
            self.feed.advance(now_ns)

    def is_idle(self) -> bool:
        return self.selector.select(0) == []

    def connect(self) -> socket.socket:
        client = socket.socket(socket.AF_UNIX)
        client.connect(str(self.feed.path))
        client.setblocking(False)
        return client


def received(client: socket.socket) -> bytes:
    try:
        return client.recv(1 << 20)
    except BlockingIOError:
        return b"(nothing)"


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path
    assert list(tmp_path.iterdir()) == [], "the socket is gone"


@pytest.fixture
def asap(folder: Path) -> Iterator[Loop]:
    feed = OdometryFeed(folder / "o", LINES, Pace.ASAP)
    yield Loop(feed)
    feed.close()


@pytest.fixture
def loop(folder: Path) -> Iterator[Loop]:
    feed = OdometryFeed(folder / "o", LINES, Pace.REALTIME)
    yield Loop(feed)
    feed.close()


def test_asap_gives_everything_at_once_and_closes(asap: Loop) -> None:
    for _ in range(2):  # every client gets all lines from the first one
        with asap.connect() as client:
            asap.turn(0)
            assert received(client) == "".join(f"{line}\n" for line in LINES).encode()
            assert received(client) == b""


def test_realtime_gives_each_line_when_due(folder: Path) -> None:
    zero_ns = 40 * SECOND
    feed = OdometryFeed(folder / "o", LINES, Pace.REALTIME, scene_time_zero_ns=zero_ns)
    loop = Loop(feed)
    with loop.connect() as client:
        loop.turn(zero_ns)
        assert received(client) == b"(nothing)"
        assert feed.wake_ns(zero_ns) == zero_ns + SECOND // 2
        loop.turn(zero_ns + SECOND // 2)
        assert received(client) == f"{LINES[0]}\n".encode()
        loop.turn(zero_ns + SECOND)
        assert received(client) == b"(nothing)"
        loop.turn(zero_ns + 60 * SECOND)
        assert received(client).count(b"\n") == 4
        assert received(client) == b""
    assert feed.wake_ns(0) is None
    feed.close()


def test_a_client_that_hangs_up_or_never_reads_disturbs_no_other(folder: Path) -> None:
    many = tuple(f"{index}.000000000 {'0' * 100} 0 0 0 0 0 1" for index in range(20_000))
    feed = OdometryFeed(folder / "o", many, Pace.ASAP)
    loop = Loop(feed)
    rude, stuck = loop.connect(), loop.connect()
    loop.turn(0)
    rude.close()
    loop.turn(0, times=5)
    with loop.connect() as client:
        data = b""
        while chunk := received(client):
            data += b"" if chunk == b"(nothing)" else chunk
            loop.turn(0)
        assert data.count(b"\n") == 20_000
    stuck.close()
    loop.turn(0)
    feed.close()


def test_a_client_that_only_stops_speaking_still_listens(loop: Loop) -> None:
    with loop.connect() as client:
        loop.turn(0)
        client.shutdown(socket.SHUT_WR)
        loop.turn(0, times=3)
        assert loop.is_idle(), "nothing keeps the loop busy"
        loop.turn(60 * SECOND)
        assert received(client).count(b"\n") == len(LINES)
        assert received(client) == b""


def test_a_client_that_is_gone_is_dropped_with_the_next_line(loop: Loop) -> None:
    loop.connect().close()
    loop.turn(0, times=3)
    loop.turn(SECOND)
    assert loop.feed.wake_ns(SECOND) is None


def test_one_client_too_many_is_sent_away(loop: Loop) -> None:
    clients = []
    for _ in range(MOST_ODOMETRY_CLIENTS + 1):
        clients.append(loop.connect())
        loop.turn(0)
    assert received(clients[-1]) == b""
    assert {received(client) for client in clients[:-1]} == {b"(nothing)"}
    for client in clients:
        client.close()
    loop.turn(SECOND)
    with loop.connect() as later:
        loop.turn(SECOND)
        assert received(later).count(b"\n") == 1


class OutOfDescriptors:
    """A listener whose process has none left, until told otherwise."""

    def __init__(self, listener: socket.socket) -> None:
        self.listener = listener
        self.exhausted = True

    def fileno(self) -> int:
        return self.listener.fileno()

    def accept(self) -> tuple[socket.socket, object]:
        if self.exhausted:
            raise OSError(errno.EMFILE, "Too many open files")
        return self.listener.accept()

    def close(self) -> None:
        self.listener.close()


@pytest.mark.parametrize("after", ["a while", "a client left"])
def test_without_descriptors_the_loop_rests(
    folder: Path, monkeypatch: pytest.MonkeyPatch, after: str
) -> None:
    feed = OdometryFeed(folder / "o", LINES, Pace.REALTIME)
    listener = OutOfDescriptors(feed._listener)
    monkeypatch.setattr(feed, "_listener", listener)
    loop = Loop(feed)
    listener.exhausted = False
    with loop.connect() as early:
        loop.turn(0)
        listener.exhausted = True
        with loop.connect() as late:
            loop.turn(0)
            assert loop.is_idle(), "nothing keeps the loop busy"
            assert feed.wake_ns(0) is not None
            loop.turn(1)
            assert loop.is_idle()
            listener.exhausted = False
            if after == "a client left":
                early.close()
                now_ns = SECOND // 2  # a line falls due and finds it gone
                loop.turn(2)
            else:
                now_ns = SECOND
            loop.turn(now_ns, times=3)
            assert received(late) == f"{LINES[0]}\n".encode()
    feed.close()


def test_a_socket_somebody_replaced_is_not_removed(folder: Path) -> None:
    first = OdometryFeed(folder / "o", LINES, Pace.ASAP)
    second = OdometryFeed(folder / "o", LINES, Pace.ASAP)
    first.close()
    loop = Loop(second)
    with loop.connect() as client:
        loop.turn(0)
        assert received(client).count(b"\n") == len(LINES)
    second.close()


def test_a_stale_socket_is_replaced_and_a_file_is_not(tmp_path: Path) -> None:
    stale = tmp_path / "stale"
    with socket.socket(socket.AF_UNIX) as leftover:
        leftover.bind(str(stale))
    OdometryFeed(stale, LINES, Pace.ASAP).close()
    precious = tmp_path / "notes"
    precious.write_text("keep me")
    with pytest.raises(LinkError):
        OdometryFeed(precious, LINES, Pace.ASAP)
    assert precious.read_text() == "keep me"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.000000000", 0),
        ("12.000000001", 12_000_000_001),
        ("3", 3 * SECOND),
        ("3.5", 3_500_000_000),
    ],
)
def test_stamps_are_exact(text: str, expected: int) -> None:
    assert stamp_ns(f"{text} 0 0 0 0 0 0 1") == expected
