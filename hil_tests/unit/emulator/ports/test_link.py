"""Ports as links: published atomically, raw from the start, removed at the end."""

from __future__ import annotations

import os
import select
import termios
from contextlib import closing
from pathlib import Path

import pytest

from emulator.ports.pty import LinkError, PtyLink
from hil_tests.patience import seconds


def read_exactly(descriptor: int, count: int) -> bytes:
    data = b""
    while len(data) < count:
        assert select.select([descriptor], [], [], seconds(5))[0], (
            f"only {len(data)} of {count} bytes"
        )
        data += os.read(descriptor, count - len(data))
    return data


def test_every_byte_passes_unchanged_for_a_client_that_sets_nothing_up(tmp_path: Path) -> None:
    every_byte = bytes(range(256))
    with closing(PtyLink(tmp_path / "radar")) as link:
        client = os.open(link.path, os.O_RDWR | os.O_NOCTTY)
        try:
            assert link.write(memoryview(every_byte)) == 256
            assert read_exactly(client, 256) == every_byte
            os.write(client, every_byte)
            read_exactly_from_link = b""
            while len(read_exactly_from_link) < 256:
                select.select([link], [], [], seconds(5))
                read_exactly_from_link += link.read()
            assert read_exactly_from_link == every_byte
            assert link.read() == b"", "nothing is echoed"
        finally:
            os.close(client)


def test_the_line_stays_raw_over_reopening(tmp_path: Path) -> None:
    with closing(PtyLink(tmp_path / "radar")) as link:
        for _ in range(2):
            client = os.open(link.path, os.O_RDWR | os.O_NOCTTY)
            local_modes = termios.tcgetattr(client)[3]
            os.close(client)
            assert not local_modes & (termios.ECHO | termios.ICANON)


def test_a_full_line_takes_nothing_and_does_not_block(tmp_path: Path) -> None:
    with closing(PtyLink(tmp_path / "radar")) as link:
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
        with pytest.raises(LinkError, match=r"notes: exists and is no link"):
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
    with pytest.raises(LinkError, match=r"radar: cannot publish the port: No such file"):
        PtyLink(tmp_path / "missing" / "radar")
