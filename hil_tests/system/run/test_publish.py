"""What other programs get of a run while it happens: lines by UDP and file, topics by WebSocket.

A recorded session is replayed in real time or faster; what arrives is compared with its results.
"""

import asyncio
import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from hil_tests.patience import seconds
from hil_tests.system.recorded_session import record_session
from hil_tests.unit.slam.app.sessions import run
from slam.app.run.replay import recorded_source
from slam.app.run.runner import execute
from slam.live.session.reader import open_session
from slam.live.session.state_rows import smoothed_row, state_row, step_row
from slam.live.session_records import Scan, SessionObserver, Snapshot
from slam.results import SmoothedRun
from xethru_protocol.operating_system import StopFlag

pytestmark = pytest.mark.slow

MODULES = "XETHRU_FOXGLOVE_MODULES"
CLIENT = Path(__file__).with_name("foxglove_client.mjs")
WANTED = (
    *("/radar/front_left/frame", "/radar/front_left/info", "/estimate/pose", "/landmarks"),
    *("/tf", "/tf_static", "/odom", "/session/info", "/landmarks/markers"),
)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("publish") / "session.mcap"
    record_session(path, "robust")
    return path


def states_of(session: Path) -> dict[int, Snapshot]:
    records = open_session(session).records()
    return {record.t_ns: record for record in records if isinstance(record, Snapshot)}


def map_of(lines: list[dict[str, Any]]) -> dict[int, tuple[list[float], list[float]]]:
    """Return position and covariance of every landmark after some lines, as a receiver has them."""
    found: dict[int, tuple[list[float], list[float]]] = {}
    for line in lines:
        if line["reset"]:
            found.clear()
        for id_ in line["removed"]:
            del found[id_]
        for one in line["landmarks"]:
            found[one["id"]] = one["position"], one["covariance"]
    return found


def check(lines: list[dict[str, Any]], session: Path) -> None:
    """Compare lines with the recorded states, to the last bit."""
    states = states_of(session)
    own = [line for line in lines if line["kind"] == "state"]
    assert [line["t_ns"] for line in own] == [*states]
    for count, (line, state) in enumerate(zip(own, states.values(), strict=True), 1):
        assert line["pose"] == state.estimate.tolist()
        assert line["covariance"] == state.pose_covariance.ravel().tolist()
        assert line["lost"] is False
        if count % 20 and count != len(own):
            continue
        assert map_of(own[:count]) == {
            id_: (place, np.ravel(spread).tolist())
            for id_, place, spread in zip(
                state.landmark_ids.tolist(),
                state.landmarks_m.tolist(),
                state.landmark_covariances_m2,
                strict=True,
            )
        }
    assert len({line["map"] for line in lines}) == 1
    (path,) = (line for line in lines if line["kind"] == "smoothed")
    assert [row[0] for row in path["path"]] == [*states]
    assert (path["first"], path["states"]) == (0, len(states))


def test_lines_are_the_states_of_the_run_and_keep_its_rate(
    session: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """On standard output they stand alone."""
    file = tmp_path / "lines.jsonl"
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4_000_000)
    receiver.bind(("127.0.0.1", 0))
    receiver.settimeout(0.0)
    port = receiver.getsockname()[1]
    places = (f"jsonl:{file}", f"udp://127.0.0.1:{port}", "jsonl:-")
    sinks = [word for place in places for word in ("--publish", place)]
    states = [*states_of(session)]
    began_s = time.monotonic()
    more = ("--out", tmp_path / "again", "--rate", "20")
    code, out, err = run(capfd, "replay", session, *more, *sinks)
    assert code == 0, err
    assert time.monotonic() - began_s > (states[-1] - states[0]) / 1e9 / 20
    assert out == file.read_text()
    lines = [json.loads(line) for line in out.splitlines()]
    check(lines, session)
    assert "recorded states came again, to the last bit, and so did the smoothed path" in err
    assert "SLAM ATE" in err
    n_lines = len(lines)
    for kind, n_places in (("jsonl", 2), ("udp", 1)):
        rows = [line.split() for line in err.splitlines() if line.startswith(f"to {kind} ")]
        assert [row[2] for row in rows] == [str(n_lines)] * n_places
    with receiver:
        datagrams = []
        while True:
            try:
                datagrams.append(receiver.recv(70_000))
            except BlockingIOError:
                break
    assert all(data.endswith(b"\n") and len(data) < 65_507 for data in datagrams)
    assert len(datagrams) > 20  # the buffer may be too small for all
    received = [json.loads(data) for data in datagrams if json.loads(data)["kind"] == "state"]
    by_time = {line["t_ns"]: line for line in lines if line["kind"] == "state"}
    assert all(line["pose"] == by_time[line["t_ns"]]["pose"] for line in received)
    assert sum(line["reset"] for line in received) > 1


@contextmanager
def served(session: Path, out: Path, *, rate: float) -> Iterator[int]:
    """Replay a session in another process that serves it to Foxglove; yield the port."""
    pytest.importorskip("foxglove", reason="foxglove-sdk is in the extra foxglove")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "slam.app.cli", "replay", str(session), "--out", str(out)]
    options = ["--rate", str(rate), "--publish", f"foxglove:{port}"]
    with subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield port
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=seconds(10))
            assert process.returncode == 128 + signal.SIGINT, err
        finally:
            process.kill()


@pytest.mark.rare  # seconds: a replay in another process
def test_a_client_of_foxglove_gets_frames_pose_and_landmarks(session: Path, tmp_path: Path) -> None:
    modules, node = os.environ.get(MODULES), shutil.which("node")
    if not modules or node is None:
        pytest.skip(f"needs node, and {MODULES}, see CONTRIBUTING.md")
    with served(session, tmp_path, rate=2) as port:
        client = subprocess.run(
            [node, str(CLIENT), modules, str(port), *WANTED],
            capture_output=True,
            text=True,
            timeout=seconds(10),
            check=False,
        )
    assert client.returncode == 0, client.stderr
    found = json.loads(client.stdout)
    state = states_of(session)[int(found["/estimate/pose"]["t_ns"])]
    pose = found["/estimate/pose"]["message"]["pose"]
    assert [pose["pose"]["position"][axis] for axis in "xy"] == state.estimate[:2].tolist()
    assert np.reshape(pose["covariance"], (6, 6))[:2, :2].tolist() == (
        state.pose_covariance[:2, :2].tolist()
    )
    scans = open_session(session).scans()
    t_ns = int(found["/radar/front_left/frame"]["t_ns"])
    (samples,) = (frame.samples for one in scans for frame in one.frames[:1] if frame.t_ns == t_ns)
    assert found["/radar/front_left/frame"]["message"]["data"] == samples.tolist()
    assert found["/landmarks"]["type"] == "sensor_msgs/msg/PointCloud2"
    assert found["/landmarks"]["message"]["width"] > 0


@pytest.mark.rare  # as above
def test_who_comes_late_gets_what_is_latched_at_once(session: Path, tmp_path: Path) -> None:
    websocket = pytest.importorskip("tornado.websocket", reason="tornado is in the extra dask")
    with served(session, tmp_path, rate=1) as port:
        found = asyncio.run(_subscribed(websocket.websocket_connect, port, {"/tf_static"}))
        (first,) = found.values()
        # both were sent before the first subscriber, and do not come again
        found = asyncio.run(
            _subscribed(websocket.websocket_connect, port, {"/tf_static", "/session/info"})
        )
    assert found["/tf_static"][0] >= first[0]
    store = get_typestore(Stores.ROS2_HUMBLE)
    links: Any = store.deserialize_cdr(found["/tf_static"][1], "tf2_msgs/msg/TFMessage")
    assert {link.child_frame_id for link in links.transforms} >= {
        f"radar_{radar.name}" for radar in open_session(session).info.radars
    }
    info: Any = store.deserialize_cdr(found["/session/info"][1], "std_msgs/msg/String")
    assert json.loads(info.data)["scene"] == open_session(session).info.scene


async def _subscribed(
    connect: Callable[..., Any], port: int, topics: set[str]
) -> dict[str, tuple[int, bytes]]:
    """Return time and bytes of the first message of each topic."""
    while True:
        try:
            client = await connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"])
            break
        except OSError:  # it does not listen yet
            await asyncio.sleep(0.05)
    found: dict[str, tuple[int, bytes]] = {}
    names: dict[int, str] = {}
    while found.keys() != topics:
        message = await asyncio.wait_for(client.read_message(), seconds(10))
        if isinstance(message, str):
            said = json.loads(message)
            for channel in said.get("channels", ()):
                if channel["topic"] in topics:
                    names[channel["id"]] = channel["topic"]
                    one = {"id": channel["id"], "channelId": channel["id"]}
                    ask = json.dumps({"op": "subscribe", "subscriptions": [one]})
                    await client.write_message(ask)
        elif message[0] == 1:
            _, id_, t_ns = struct.unpack("<BIQ", message[:13])
            found.setdefault(names[id_], (t_ns, message[13:]))
    client.close()
    while await asyncio.wait_for(client.read_message(), seconds(10)) is not None:
        pass
    return found


class Unchanged(SessionObserver):
    """Keeps what a run hands over, and what that held when it came."""

    def __init__(self) -> None:
        self.kept: list[tuple[Callable[[], bytes], bytes]] = []

    def _keep(self, content: Callable[[], bytes]) -> None:
        self.kept.append((content, content()))

    def on_scan(self, scan: Scan) -> None:
        self._keep(lambda: b"".join(frame.samples.tobytes() for frame in scan.frames))

    def on_snapshot(self, snapshot: Snapshot) -> None:
        step, spans_m = snapshot.step, snapshot.wall_spans_m
        assert step is not None
        self._keep(lambda: state_row(snapshot).tobytes() + step_row(step, spans_m).tobytes())

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        self._keep(lambda: smoothed_row(smoothed).tobytes())


@pytest.mark.parametrize("preset", ["robust", pytest.param("paper", marks=pytest.mark.rare)])
def test_what_sinks_get_is_not_changed_later(preset: str, tmp_path: Path) -> None:
    """They read it in their own time, in their own threads."""
    record_session(tmp_path / "session.mcap", preset)
    unchanged = Unchanged()
    execute(recorded_source(open_session(tmp_path / "session.mcap"), StopFlag()), [unchanged])
    assert len(unchanged.kept) > 100
    assert all(content() == before for content, before in unchanged.kept)
