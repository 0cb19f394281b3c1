"""Ports as links: published atomically, raw from the start, removed at the end; who opens them."""

import os
import select
import selectors
import termios
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from emulator.ports.pty import LinkError, PortWatch, PtyLink
from hil_tests.patience import seconds


@pytest.fixture
def flushes() -> list[str]:
    return []


@pytest.fixture
def link(tmp_path: Path, flushes: list[str]) -> Iterator[PtyLink]:
    with closing(PtyLink(tmp_path / "radar", flushed=lambda: flushes.append("flushed"))) as made:
        yield made


@pytest.fixture
def host(link: PtyLink) -> Iterator[int]:
    opened = os.open(link.path, os.O_RDWR | os.O_NOCTTY)
    yield opened
    os.close(opened)


def is_ready(file: int | PtyLink) -> bool:
    return bool(select.select([file], [], [], seconds(5))[0])


@pytest.mark.parametrize("flushed", [None, lambda: None])
def test_every_byte_passes_unchanged_for_a_client_that_sets_nothing_up(
    tmp_path: Path, flushed: Callable[[], None] | None
) -> None:
    every_byte = bytes(range(256))
    with closing(PtyLink(tmp_path / "radar", flushed=flushed)) as link:
        client = os.open(link.path, os.O_RDWR | os.O_NOCTTY)
        assert link.write(memoryview(every_byte)) == 256
        heard = b""
        while len(heard) < 256 and is_ready(client):
            heard += os.read(client, 256)
        assert heard == every_byte
        os.write(client, every_byte)
        heard = b""
        while len(heard) < 256 and is_ready(link):
            heard += link.read()
        assert heard == every_byte
        assert link.read() == b"", "nothing is echoed"
        os.close(client)


def test_a_flush_of_output_is_reported(link: PtyLink, flushes: list[str], host: int) -> None:
    termios.tcflush(host, termios.TCOFLUSH)
    assert is_ready(link)
    assert link.read() == b""
    assert flushes == ["flushed"]


def test_the_speed_of_the_hosts_terminal_is_known(link: PtyLink, host: int) -> None:
    for constant, baud in ((termios.B9600, 9600), (termios.B921600, 921600)):
        attributes = termios.tcgetattr(host)
        attributes[4] = attributes[5] = constant
        termios.tcsetattr(host, termios.TCSANOW, attributes)
        assert link.host_baud() == baud


def test_the_line_stays_raw_over_reopening(link: PtyLink) -> None:
    for _ in range(2):
        client = os.open(link.path, os.O_RDWR | os.O_NOCTTY)
        local_modes = termios.tcgetattr(client)[3]
        os.close(client)
        assert not local_modes & (termios.ECHO | termios.ICANON)


def test_a_full_line_takes_nothing_and_does_not_block(link: PtyLink) -> None:
    block, taken = memoryview(bytes(65536)), 0
    # the kernel moves bytes on between its buffers: room may appear once more, not for ever
    for _ in range(200):
        taken += link.write(block)
    assert 4096 <= taken < 65536


def test_dangling_and_foreign_links_are_replaced_files_are_not(tmp_path: Path) -> None:
    dangling, precious = tmp_path / "radar", tmp_path / "notes"
    dangling.symlink_to("/dev/pts/99999")
    precious.write_text("keep me")
    with closing(PtyLink(dangling)) as link:
        assert dangling.resolve() == Path(link.terminal)
        with pytest.raises(LinkError):
            PtyLink(precious)
    assert not dangling.is_symlink()
    assert precious.read_text() == "keep me"
    assert list(tmp_path.iterdir()) == [precious], "no leftovers"


def test_a_link_somebody_replaced_is_not_removed(tmp_path: Path) -> None:
    path = tmp_path / "radar"
    with closing(PtyLink(path)), closing(PtyLink(path)):
        pass
    assert not path.is_symlink()
    first = PtyLink(path)
    second = PtyLink(path)
    first.close()
    assert path.resolve() == Path(second.terminal)
    second.close()
    second.close()
    assert not path.is_symlink()


def test_a_missing_folder_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(LinkError):
        PtyLink(tmp_path / "missing" / "radar")


NOW_NS = 12345


class Bench:
    """A watched file, which tells of opens and closes as a terminal does."""

    def __init__(self, path: Path) -> None:
        path.touch()
        self.path = path
        self.events: list[tuple[str, int]] = []
        self.watch = PortWatch(
            str(path),
            opened=lambda now_ns: self.events.append(("opened", now_ns)),
            closed=lambda now_ns: self.events.append(("closed", now_ns)),
        )
        self.selector = selectors.DefaultSelector()
        self.watch.register(self.selector)

    def told(self) -> list[tuple[str, int]]:
        """Return what was told since the last call; the kernel queues events at once."""
        for key, events in self.selector.select(0):
            key.data(events, NOW_NS)
        told, self.events = self.events, []
        return told

    def open(self) -> int:
        return os.open(self.path, os.O_RDWR)


@pytest.fixture
def early(tmp_path: Path) -> int:
    """Return a descriptor of somebody who has the port open before it is watched."""
    return os.open(tmp_path / "port", os.O_RDWR | os.O_CREAT)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path / "port")
    if not made.watch.works:
        pytest.skip("this system does not tell who opens a file")
    yield made
    made.selector.close()
    made.watch.close()


def test_the_first_open_and_the_last_close_are_reported(bench: Bench) -> None:
    assert bench.told() == []
    first = bench.open()
    assert bench.told() == [("opened", NOW_NS)]
    second = bench.open()
    assert bench.told() == []
    os.close(first)
    assert bench.told() == []
    os.close(second)
    assert bench.told() == [("closed", NOW_NS)]


def test_a_host_between_two_looks_is_reported_in_order(bench: Bench) -> None:
    os.close(bench.open())
    assert bench.told() == [("opened", NOW_NS), ("closed", NOW_NS)]


def test_a_close_of_somebody_who_was_there_before_changes_nothing(
    tmp_path: Path, early: int, bench: Bench
) -> None:
    os.close(early)
    assert bench.told() == []
    os.close(bench.open())
    assert [what for what, _ in bench.told()] == ["opened", "closed"]


def test_a_path_that_is_not_there_is_not_watched(tmp_path: Path) -> None:
    watch = PortWatch(str(tmp_path / "none"), opened=print, closed=print)
    assert not watch.works
    watch.close()
