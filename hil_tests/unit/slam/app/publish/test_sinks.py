"""A run goes on whatever its sinks do: blocked, failing or gone; what they lose is counted."""

import threading
from collections.abc import Iterator
from typing import cast

import pytest

from hil_tests.patience import wait_until
from hil_tests.unit.slam.app.sessions import feed, session_info, snapshot
from slam.app.errors import UsageError
from slam.app.publish import SINKS, SinkKind
from slam.app.publish.sinks import MOST_EVENTS, Publishing, Sink, make_sink
from slam.live.errors import AppError
from slam.live.session_records import SessionInfo, Snapshot

ENTERED, RELEASED = threading.Event(), threading.Event()
MADE: list["ListSink"] = []


class ListSink(Sink):
    """Keeps what it gets, and does what its text says."""

    def __init__(self, text: str) -> None:
        if text == "refused":
            raise UsageError("no such list")
        self.text = text
        self.got: list[object] = []
        MADE.append(self)

    def open(self) -> None:
        if self.text == "taken":
            raise AppError("the port is taken")
        self.got.append("open")

    def begin(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        self.got.append(("begin", info.scene, start_ns, bool(map_id)))
        if self.text == "cannot begin":
            raise OSError(5, "Input/output error")

    def on_snapshot(self, snapshot: Snapshot) -> None:
        if self.text == "blocked":
            ENTERED.set()
            RELEASED.wait(15.0)
        if self.text == "failing":
            raise ConnectionResetError(104, "Connection reset by peer")
        if self.text == "once" and snapshot.counter == 0:
            raise RuntimeError("a bug")
        self.got.append(snapshot.counter)

    def close(self) -> None:
        self.got.append("close")


class Lines(list[str]):
    """Takes the lines that are logged about a run."""

    def __call__(self, subject: str, text: str, *, warning: bool) -> None:
        assert (subject, warning) == ("run", True)
        self.append(text)


@pytest.fixture(autouse=True)
def _kind_list(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr("slam.app.publish.sinks.CLOSE_S", 15.0)
    kind = SinkKind(f"{__name__}:ListSink", "")
    monkeypatch.setitem(cast(dict[str, SinkKind], SINKS), "list", kind)
    MADE.clear()
    ENTERED.clear()
    RELEASED.clear()
    yield
    RELEASED.set()


def publish(*specs: str, n_states: int) -> tuple[Publishing, Lines]:
    """Publish so many scans and states, a few at a time, and end the run."""
    lines = Lines()
    with Publishing(specs) as publishing:
        publishing.begin(session_info(), lines, start_ns=7)
        feed(publishing, n_states)
        last = publishing.queued[-1]
        wait_until(lambda: last.n_sent + last.n_failed + last.n_dropped == n_states)
        publishing.take(snapshot(n_states))
    return publishing, lines


def counts(publishing: Publishing) -> list[tuple[int, int, int]]:
    return [(each.n_sent, each.n_dropped, each.n_failed) for each in publishing.queued]


def test_a_sink_gets_every_state_in_order_between_begin_and_close() -> None:
    publishing, lines = publish("list:", n_states=20)
    (sink,) = MADE
    assert sink.got == ["open", ("begin", "made_up", 7, True), *range(21), "close"]
    assert counts(publishing) == [(21, 0, 0)]  # scans and log lines are not for it
    assert lines == []
    ((kind, sent, _),) = publishing.rows()
    assert (kind, sent) == ("to list", "21")


def test_a_blocked_sink_loses_the_oldest_and_holds_up_neither_the_run_nor_its_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("slam.app.publish.sinks.CLOSE_S", 0.2)
    n_states = 3 * MOST_EVENTS
    publishing, lines = publish("list:blocked", "list:", n_states=n_states)
    blocked, other = MADE
    assert counts(publishing)[0] == (0, n_states + 1, 0)
    assert [sum(each) for each in counts(publishing)] == [n_states + 1] * 2
    assert sum("list:blocked" in line for line in lines) == 1
    # what it gets when it goes on is the state it was blocked in at most
    RELEASED.set()
    wait_until(lambda: blocked.got[-1] == "close")
    assert blocked.got[2:] == [0, "close"]
    assert other.got[-1] == "close"


def test_the_newest_states_are_those_that_stay() -> None:
    n_states = 2 * MOST_EVENTS
    lines = Lines()
    with Publishing(["list:blocked"]) as publishing:
        publishing.begin(session_info(), lines)
        publishing.take(snapshot(0))
        assert ENTERED.wait(15.0)
        for counter in range(1, n_states):
            publishing.take(snapshot(counter))
        RELEASED.set()
    assert MADE[0].got[2:-1] == [0, *range(n_states - MOST_EVENTS, n_states)]
    assert counts(publishing) == [(MOST_EVENTS + 1, MOST_EVENTS - 1, 0)]


@pytest.mark.parametrize(
    ("text", "n_sent", "n_failed"), [("failing", 0, 11), ("once", 10, 1), ("cannot begin", 0, 11)]
)
def test_failures_are_counted_and_logged_once(text: str, n_sent: int, n_failed: int) -> None:
    publishing, lines = publish(f"list:{text}", n_states=10)
    assert counts(publishing) == [(n_sent, 0, n_failed)]
    assert len(lines) == 1
    assert MADE[0].got[-1] == "close"


def test_nothing_is_opened_where_a_spec_is_wrong() -> None:
    for wrong in ("list:refused", "lists:x", "list:", ""):
        with pytest.raises(UsageError) as raised:
            Publishing(["list:", wrong])
        assert wrong in str(raised.value)
    assert all(sink.got == [] for sink in MADE)


def test_what_was_opened_is_closed_where_another_sink_cannot_be() -> None:
    with pytest.raises(AppError, match="the port is taken"), Publishing(["list:", "list:taken"]):
        raise AssertionError
    assert [sink.got for sink in MADE] == [["open", "close"], []]


def test_what_was_opened_is_closed_where_no_run_began() -> None:
    with pytest.raises(AppError, match="no module"), Publishing(["list:"]):
        raise AppError("no module")
    assert MADE[0].got == ["open", "close"]


def test_a_missing_package_is_reported_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = SinkKind("no_such_package.sink:Sink", "")
    monkeypatch.setitem(cast(dict[str, SinkKind], SINKS), "other", kind)
    with pytest.raises(ModuleNotFoundError):
        make_sink("other:")
