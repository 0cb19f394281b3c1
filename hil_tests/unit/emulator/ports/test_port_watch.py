"""Who opens and closes a port: told once for the first host and once for the last."""

from __future__ import annotations

import os
import selectors
from collections.abc import Iterator
from pathlib import Path

import pytest

from emulator.ports.pty import PortWatch

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


def test_a_close_of_somebody_who_was_there_before_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "port").touch()
    early = os.open(tmp_path / "port", os.O_RDWR)
    bench = Bench(tmp_path / "port")
    if not bench.watch.works:
        os.close(early)
        pytest.skip("this system does not tell who opens a file")
    os.close(early)
    assert bench.told() == []
    os.close(bench.open())
    assert [what for what, _ in bench.told()] == ["opened", "closed"]
    bench.selector.close()
    bench.watch.close()


def test_a_path_that_is_not_there_is_not_watched(tmp_path: Path) -> None:
    watch = PortWatch(str(tmp_path / "none"), opened=print, closed=print)
    assert not watch.works
    watch.close()
