"""Lines of JSON by file, pipe and UDP, and the server: readers that go, full disks, taken ports."""

import json
import os
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil_tests.patience import seconds, wait_until
from hil_tests.unit.full_disk import full_disk
from hil_tests.unit.slam.app.session.test_viewer_topics import Kept
from hil_tests.unit.slam.app.sessions import (
    FRAME_NS,
    run,
    scan,
    session_info,
    smoothed_run,
    snapshot,
)
from hil_tests.unit.slam.live.session.test_state_rows import robust_state
from slam.app.errors import UsageError
from slam.app.publish.json_lines import LineMaker
from slam.app.publish.sinks import Publishing, make_sink
from slam.app.publish.udp import MOST_BYTES
from slam.app.session.viewer_topics import Drawings
from slam.live.errors import AppError
from slam.live.session_records import Snapshot


def with_landmarks(counter: int, n_landmarks: int) -> Snapshot:
    """Return a state whose landmarks, their numbers no short decimals, are all new."""
    rng = np.random.default_rng(counter)
    return replace(
        snapshot(counter),
        landmark_ids=np.arange(n_landmarks) + 1000 * counter,
        landmarks_m=rng.normal(size=(n_landmarks, 2)),
        landmark_covariances_m2=rng.normal(size=(n_landmarks, 2, 2)),
    )


def read(lines: Iterator[bytes]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in lines]


def test_a_line_has_what_changed_since_the_one_before() -> None:
    maker = LineMaker("m")
    state = snapshot(1)
    (first,) = read(maker.state(state))
    assert first == {
        "kind": "state",
        "map": "m",
        "t_ns": FRAME_NS,
        "pose": state.estimate.tolist(),
        "covariance": [1e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 1e-5],
        "lost": False,
        "lagged": [],
        "reset": True,
        "removed": [],
        "landmarks": [
            {"id": 3, "position": [1.01, 0.5], "covariance": [4e-4, 0.0, 0.0, 1e-4]},
            {"id": 8, "position": [-0.5, 2.02], "covariance": [2e-4, 1e-4, 1e-4, 2e-4]},
        ],
    }
    (same,) = read(maker.state(snapshot(2)))
    assert (same["landmarks"], same["removed"], same["reset"]) == ([], [], False)
    moved = replace(snapshot(3), landmark_ids=np.array([8, 9]))  # 3 went, 9 came, 8 is where 3 was
    (changed,) = read(maker.state(moved))
    assert [one["id"] for one in changed["landmarks"]] == [8, 9]
    assert changed["removed"] == [3]


def test_a_robot_that_is_lost_is_lost() -> None:
    state = robust_state(5)
    assert state.step is not None
    assert state.step.report is not None
    for lost in (False, True):
        step = replace(state.step, report=replace(state.step.report, lost=lost))
        (line,) = read(LineMaker("m").state(replace(state, step=step)))
        assert line["lost"] is lost


def test_lagged_poses_are_in_the_line_of_the_state_with_which_they_are_final() -> None:
    state = with_landmarks(1, 3000)
    state = replace(state, step=robust_state(state.t_ns).step)
    first, second, *others = read(LineMaker("m", MOST_BYTES).state(state))
    pose = [0.1, -0.2, 3.0]
    assert first["lagged"] == [[state.t_ns - 60, *pose], [state.t_ns - 40, *pose]]
    assert all(line["lagged"] == [] for line in [second, *others])


def test_numbers_that_json_lacks_are_null() -> None:
    covariance = np.array([[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, 0.0, 1.0]])
    (line,) = read(LineMaker("m").state(replace(snapshot(1), pose_covariance=covariance)))
    assert line["covariance"] == [None, 0.0, 0.0, 0.0, None, 0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize("n_landmarks", [0, 1, 300, 3000])
def test_long_lines_are_split_and_lose_nothing(n_landmarks: int) -> None:
    maker = LineMaker("m" * 12, MOST_BYTES)
    lines = [*maker.state(snapshot(0)), *maker.state(with_landmarks(1, n_landmarks))]
    assert all(len(line) < MOST_BYTES and line.count(b"\n") == 1 for line in lines)
    assert len(lines) >= n_landmarks * 150 // MOST_BYTES
    found = [one["id"] for line in lines[1:] for one in json.loads(line)["landmarks"]]
    assert found == [1000 + k for k in range(n_landmarks)]
    assert [json.loads(line)["reset"] for line in lines] == [True] + [False] * (len(lines) - 1)


def test_a_long_path_is_split_and_loses_nothing() -> None:
    made = smoothed_run(5000)
    lines = [*LineMaker("m", MOST_BYTES).smoothed(made)]
    assert len(lines) > 4
    assert all(len(line) < MOST_BYTES for line in lines)
    parts = [json.loads(line) for line in lines]
    rows = [row for part in parts for row in part["path"]]
    assert [row[0] for row in rows] == made.t_ns.tolist()
    assert [row[1:] for row in rows] == made.poses.tolist()
    firsts = np.cumsum([0, *(len(part["path"]) for part in parts)])
    assert [part["first"] for part in parts] == firsts[:-1].tolist()


def test_all_landmarks_come_again_after_a_time_and_where_session_time_falls() -> None:
    maker = LineMaker("m", repeat_ns=10 * FRAME_NS)
    counters = [100, 101, 109, 110, 111, 5, 6, 14, 15]
    resets = [read(maker.state(snapshot(counter)))[0]["reset"] for counter in counters]
    assert resets == [True, False, False, True, False, True, False, False, True]


def test_drawings_go_on_where_session_time_falls() -> None:
    kept = Kept()
    drawings = Drawings(kept, session_info(), 0)
    for t_s in (1000, 1001, 10, 11):  # every 2 s
        drawings.on_snapshot(replace(snapshot(1), t_ns=t_s * 10**9))
    assert len(kept.messages["/landmarks/markers"]) == 2


class Lines(list[str]):
    def __call__(self, subject: str, text: str, *, warning: bool) -> None:
        self.append(text)


def lines_of(path: Path) -> list[dict[str, Any]]:
    text = path.read_text()
    assert text.endswith("\n")
    return [json.loads(line) for line in text.splitlines()]


def publish(spec: str, counters: range) -> tuple[tuple[int, int, int], list[str]]:
    """Publish states one by one; return the counts of the sink, and what was logged."""
    lines = Lines()
    with Publishing([spec]) as seen:
        seen.begin(session_info(), lines)
        (queued,) = seen.queued
        for count, counter in enumerate(counters):
            wait_until(lambda done=count: queued.n_sent + queued.n_failed == done)  # type: ignore[misc]  # mypy infers no lambda with a default
            seen.take(snapshot(counter))
    return (queued.n_sent, queued.n_dropped, queued.n_failed), lines


def test_another_run_goes_on_behind_the_lines_of_the_one_before(tmp_path: Path) -> None:
    file = tmp_path / "lines.jsonl"
    assert publish(f"jsonl:{file}", range(3)) == ((3, 0, 0), [])
    publish(f"jsonl:{file}", range(2))
    states = lines_of(file)
    assert [one["reset"] for one in states] == [True, False, False, True, False]
    assert len({one["map"] for one in states}) == 2


def test_a_full_disk_cuts_no_line_and_the_next_has_the_whole_map(tmp_path: Path) -> None:
    file = tmp_path / "lines.jsonl"
    lines = Lines()
    with Publishing([f"jsonl:{file}"]) as seen:
        (queued,) = seen.queued
        seen.begin(session_info(), lines)
        with full_disk(1000):
            for counter in range(6):
                seen.take(snapshot(counter))
            wait_until(lambda: queued.n_sent + queued.n_failed == 6)
        for counter in range(6, 8):
            seen.take(snapshot(counter))
    n_sent, n_failed = queued.n_sent, queued.n_failed
    assert n_failed > 0
    assert n_sent + n_failed == 8
    assert len(lines) == 1
    states = lines_of(file)
    assert len(states) == n_sent
    assert [one["reset"] for one in states[-2:]] == [True, False]
    assert len(states[-2]["landmarks"]) == 2


@pytest.mark.parametrize("content", [b"\x89MCAP0\r\n", b"# TUM\n", b"[1]\n"])
def test_no_other_file_is_added_to(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(AppError, match="no lines of JSON"), Publishing([f"jsonl:{tmp_path}/file"]):
        raise AssertionError
    assert (tmp_path / "file").read_bytes() == content


def test_a_file_that_cannot_be_made_is_an_error_before_the_run(tmp_path: Path) -> None:
    for name in ("no/such/folder.jsonl", ""):
        with pytest.raises(AppError), Publishing([f"jsonl:{tmp_path}/{name}"]):
            raise AssertionError


def test_a_pipe_without_reader_costs_nothing_and_one_whose_reader_goes_is_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    got: list[bytes] = []

    def read_two() -> None:
        with pipe.open("rb") as stream:
            got.extend(stream.readline() for _ in range(2))

    reader = threading.Thread(target=read_two)
    lines = Lines()
    with Publishing([f"jsonl:{pipe}"]) as seen:
        (queued,) = seen.queued
        seen.begin(session_info(), lines)
        for counter in range(2):
            seen.take(snapshot(counter))
        assert queued.n_sent == 0
        reader.start()
        reader.join()
        seen.take(snapshot(2))
        wait_until(lambda: queued.n_failed == 1)
        seen.take(snapshot(3))
    assert [json.loads(line)["t_ns"] for line in got] == [0, FRAME_NS]
    assert len(lines) == 1
    monkeypatch.setattr("slam.app.publish.sinks.CLOSE_S", 0.1)
    lines.clear()
    with Publishing([f"jsonl:{pipe}"]) as seen:
        seen.begin(session_info(), lines)
        seen.take(snapshot(0))
    assert seen.queued[0].n_dropped == 1
    os.close(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK))  # lets the thread of the sink go


def test_a_receiver_that_goes_and_comes_again_gets_the_whole_map() -> None:
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", 0))
    receiver.settimeout(10.0)
    address = receiver.getsockname()
    lines = Lines()
    with Publishing([f"udp://127.0.0.1:{address[1]}"]) as seen:
        (queued,) = seen.queued
        seen.begin(session_info(), lines)
        with receiver:
            for counter in range(2):
                seen.take(snapshot(counter))
            first = [json.loads(receiver.recv(MOST_BYTES)) for _ in range(2)]
        for counter in range(2, 6):
            seen.take(snapshot(counter))
        wait_until(lambda: queued.n_sent + queued.n_failed == 6)
        assert queued.n_failed > 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
            again.bind(address)
            again.settimeout(10.0)
            seen.take(snapshot(6))
            later = json.loads(again.recv(MOST_BYTES))
    assert [one["reset"] for one in first] == [True, False]
    assert (later["t_ns"], later["reset"], len(later["landmarks"])) == (6 * FRAME_NS, True, 2)
    assert len(lines) == 1


WRONG = (
    *("jsonl", "jsonl:", "udp", "udp:", "udp://host", "udp://:7", "udp://host:7/x", "udp://h:0"),
    *("udp://h:70000", "udp:h:7", "tcp://h:7", "josnl:-", "foxglove:x", "foxglove:0", "foxglove:"),
    *("foxglove:70000", "foxglove:127.0.0.1", "foxglove::"),
)


@pytest.mark.parametrize("spec", WRONG)
def test_a_wrong_spec_is_wrong_usage_before_anything_is_opened(
    spec: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if spec.startswith("foxglove"):
        pytest.importorskip("foxglove", reason="foxglove-sdk is in the extra foxglove")
    if spec == "foxglove:":  # the default port
        make_sink(spec)
        return
    with pytest.raises(UsageError):
        make_sink(spec)
    out = tmp_path / "out"
    for command in (("demo",), ("replay", tmp_path / "none.mcap")):
        code, printed, _ = run(
            capsys, *command, "--out", out, "--publish", f"jsonl:{tmp_path}/l", "--publish", spec
        )
        assert (code, printed) == (2, "")
    assert [*tmp_path.iterdir()] == []


def test_the_extra_that_is_missing_is_named_before_anything_is_opened(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "slam.app.publish.foxglove", raising=False)
    monkeypatch.setitem(sys.modules, "foxglove", None)
    sinks = ("--publish", f"jsonl:{tmp_path}/lines", "--publish", "foxglove")
    code, printed, err = run(capsys, "demo", "--out", tmp_path / "out", *sinks)
    assert (code, printed) == (2, "")
    assert "[foxglove]" in err
    assert [*tmp_path.iterdir()] == []


def test_a_host_without_address_is_an_error_before_the_run() -> None:
    with pytest.raises(AppError, match=r"host\.invalid"), Publishing(["udp://host.invalid:7"]):
        raise AssertionError


def is_free(port: int) -> bool:
    with socket.socket() as one, suppress(OSError):
        one.bind(("127.0.0.1", port))
        return True
    return False


def test_a_port_in_use_is_an_error_before_the_run() -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk is in the extra foxglove")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(AppError, match=str(port)), Publishing([f"foxglove:{port}"]):
            raise AssertionError
    for _ in range(2):  # a run that is started again has it again
        wait_until(lambda: is_free(port))  # the server lets it go a millisecond after its end
        assert publish(f"foxglove:{port}", range(2)) == ((2, 0, 0), [])


def test_a_viewer_that_never_reads_holds_up_neither_the_run_nor_its_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk is in the extra foxglove")
    monkeypatch.setattr("slam.app.publish.sinks.CLOSE_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    began_s = time.monotonic()
    with Publishing([f"foxglove:{port}"]) as seen, socket.socket() as viewer:
        viewer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        viewer.connect(("127.0.0.1", port))
        viewer.sendall(
            b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
        )
        assert viewer.recv(100).startswith(b"HTTP/1.1 101 ")
        seen.begin(session_info(), Lines())
        (queued,) = seen.queued
        seen.take(snapshot(0))
        wait_until(lambda: queued.n_sent == 1)  # its topics are there
        ids = [{"id": number, "channelId": number} for number in range(1, 50)]
        text = json.dumps({"op": "subscribe", "subscriptions": ids}).encode()
        viewer.sendall(b"\x81\xfe" + struct.pack(">H4x", len(text)) + text)
        for counter in range(1, 1201):
            seen.take(scan(counter))
            if counter % 100 == 0:
                wait_until(lambda sent=counter: queued.n_sent > sent)  # type: ignore[misc]  # mypy infers no lambda with a default
        seen.close()  # the viewer answers no more than it reads
    assert time.monotonic() - began_s < seconds(10)
    assert (queued.n_dropped, queued.n_failed) == (0, 0)
