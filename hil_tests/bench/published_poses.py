"""How late poses are at the sinks of `uwb-slam run --publish`, and what each sink costs.

`python -m hil_tests.bench.published_poses` serves scenes in real time through pseudo-terminals,
maps them with `uwb-slam run`, and receives what it publishes by UDP, standard output, Foxglove's
WebSocket and ROS 2, all in one run, on loopback. A row of its table is a scene, a rate of frames
and a sink: the time from the arrival of a scan's last frame to its pose at the receiver; and the
same from the arrival of the last thing that the scan waited for, which may be a line of odometry,
as poses are interpolated. Odometry is sent 50 times a second. Then come the processor share of the
sink's threads, those of its library, too; that of the whole process; and the load of the machine
over one minute. Some poses come 40 ms later by WebSocket: the server's library leaves small
messages to Nagle's algorithm, and they wait for the acknowledgement of the one before.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from emulator import running
from hil_tests.paths import FIXTURES
from hil_tests.system.installation import LOOPBACK
from slam.app.cli import main as uwb_slam
from slam.app.odometry.live import LiveOdometry
from slam.live.odometry_track import TumSample
from slam.live.session import cdr
from slam.live.session.reader import RecordedSession, open_session

ODOMETRY_HZ = 50.0
NS_PER_S = 1_000_000_000
SETTLED_NS = 5 * NS_PER_S
"""Session time at the beginning of a run that is not counted: kernels are loaded then."""
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_LIBRARY_THREADS = {
    "tokio": "foxglove",
    **dict.fromkeys(("recv", "tev", "gc", "dq.", "fsm", "lease"), "ros2"),
}
"""Beginnings of the names of threads, by the sink that they belong to."""

Received = dict[int, int]
"""Time of day [ns] at which the pose of a session time [ns] came."""


def say(line: str) -> None:
    sys.stdout.write(line.rstrip() + "\n")
    sys.stdout.flush()


def receive_udp(port: int, received: Received) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", port))
        while True:
            note_line(receiver.recv(70_000), received)


def note_line(line: bytes, received: Received) -> None:
    now_ns = time.time_ns()
    state = json.loads(line)
    if state["kind"] == "state":
        received.setdefault(state["t_ns"], now_ns)


async def receive_foxglove(port: int, received: Received) -> None:
    from tornado.websocket import websocket_connect

    while True:
        try:
            url = f"ws://127.0.0.1:{port}"
            client = await websocket_connect(url, subprotocols=["foxglove.sdk.v1"])
            break
        except OSError:  # the run has not opened it yet
            await asyncio.sleep(0.1)
    poses = None
    while (message := await client.read_message()) is not None:
        now_ns = time.time_ns()
        if isinstance(message, str):
            channels = json.loads(message).get("channels", ())
            ids = [{"id": one["id"], "channelId": one["id"]} for one in channels]
            poses = next((one["id"] for one in channels if one["topic"] == "/estimate"), poses)
            if ids:  # to all topics, as a viewer does
                await client.write_message(json.dumps({"op": "subscribe", "subscriptions": ids}))
        elif message[0] == 1:
            _, channel, t_ns = struct.unpack("<BIQ", message[:13])
            if channel == poses:
                received.setdefault(t_ns, now_ns)


def receive_ros2(received: Received) -> None:
    """Note when poses came, by the time of ROS."""
    from slam.app.odometry.dds import Ros2Domain

    take = Ros2Domain().reader("/uwb_slam/pose", cdr.POSE_WITH_COVARIANCE, reliable=True)
    while True:
        for data in take(1.0):
            now_ns = time.time_ns()
            pose = cdr.pose_sample(cdr.deserialise(data, cdr.POSE_WITH_COVARIANCE))
            received.setdefault(pose.t_ns, now_ns)


def in_thread(function: Callable[..., object], *arguments: object) -> threading.Thread:
    thread = threading.Thread(target=function, args=arguments, daemon=True)
    thread.start()
    return thread


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as free:
        free.bind(("127.0.0.1", 0))
        port: int = free.getsockname()[1]
        return port


@contextmanager
def served(scene: str, folder: Path) -> Iterator[Mapping[str, Any]]:
    """Serve a shipped scene whose odometry comes more often; yield the ready line."""
    text = (FIXTURES / "scenes" / f"{scene}.toml").read_text()
    changed = text.replace("rate_hz = 5.0", f"rate_hz = {ODOMETRY_HZ}")
    assert changed != text
    (folder / f"{scene}.toml").write_text(changed)
    ports = ("--pace", "realtime", "--link-dir", folder / "ports")
    with running("serve", folder / f"{scene}.toml", *ports) as (process, ready):
        yield ready
        process.terminate()
        process.wait()


def measure(scene: str, fps: int, seconds: int) -> None:
    """Map a scene for some seconds, and print a row for each sink."""
    received: dict[str, Received] = {"udp": {}, "jsonl": {}, "foxglove": {}, "ros2": {}}
    udp, web = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
    with tempfile.TemporaryDirectory() as name, served(scene, Path(name)) as ready:
        folder = Path(name)
        in_thread(receive_udp, udp, received["udp"])
        in_thread(lambda: asyncio.run(receive_foxglove(web, received["foxglove"])))
        in_thread(receive_ros2, received["ros2"])
        sinks = (f"udp://127.0.0.1:{udp}", "jsonl:-", f"foxglove:{web}", "ros2")
        command = [sys.executable, "-m", "hil_tests.bench.published_poses", "--child", name]
        command += ["run", "--rig", scene, "--odometry", ready["odometry"], "--fps", str(fps)]
        command += ["--ports", *(device["path"] for device in ready["devices"])]
        command += ["--out", str(folder / "out"), "--duration", str(seconds)]
        command += [word for sink in sinks for word in ("--publish", sink)]
        with (
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run,
            (folder / "err").open("wb") as errors,
        ):
            assert run.stdout is not None
            assert run.stderr is not None
            in_thread(lambda: errors.writelines(run.stderr or ()))
            for line in run.stdout:
                note_line(line, received["jsonl"])
        assert run.returncode == 0, (folder / "err").read_text()
        notes = json.loads((folder / "notes.json").read_text())
        session = open_session(folder / "out" / "session.mcap")
        needed = _inputs(session, notes["odometry"])
    offset_ns = session.info.started_unix_ns or 0
    received["ros2"] = {t_ns - offset_ns: came_ns for t_ns, came_ns in received["ros2"].items()}
    load = os.getloadavg()[0]
    for kind, poses in received.items():
        known = [(poses[t_ns], *needed[t_ns]) for t_ns in poses if t_ns in needed]
        came, frame, last = np.array(known, dtype=np.int64).T
        columns = [_milliseconds(came - since) for since in (frame, last)]
        share = f"{100 * notes['share'].get(kind, 0.0):.1f} %"
        whole = f"{100 * notes['share']['process']:.0f} %"
        row = (scene, str(fps), kind, str(len(came)), *columns, share, whole, f"{load:.1f}")
        say("  ".join(cell.ljust(width) for cell, width in zip(row, WIDTHS, strict=True)))


def _milliseconds(spans_ns: np.ndarray) -> str:
    p50, p99, most = (np.percentile(spans_ns, share) / 1e6 for share in (50, 99, 100))
    return f"{p50:5.1f} {p99:6.1f} {most:6.1f}"


def _inputs(
    session: RecordedSession, odometry: Sequence[tuple[int, int]]
) -> dict[int, tuple[int, int]]:
    """Return when the last frame and the last input of each scan came, time of day [ns]."""
    stamps_ns, came_ns = np.array(odometry, dtype=np.int64).T
    needed: dict[int, tuple[int, int]] = {}
    start_ns = None
    for scan in session.scans():
        start_ns = scan.t_ns if start_ns is None else start_ns
        if not scan.used or not scan.host_ns or scan.t_ns - start_ns < SETTLED_NS:
            continue
        last_ns = max(scan.t_ns, *(frame.t_ns for frame in scan.frames))
        line = int(np.searchsorted(stamps_ns, last_ns))
        frame_ns = max(scan.host_ns)
        needed[scan.t_ns] = frame_ns, max(frame_ns, int(came_ns[min(line, len(came_ns) - 1)]))
    return needed


def child(folder: Path, command: Sequence[str]) -> int:
    """Run the command here; note when odometry came, and the processor time of each thread."""
    odometry: list[tuple[int, int]] = []
    take = LiveOdometry.take
    unix_ns = time.time_ns() - time.monotonic_ns()

    def noted(self: LiveOdometry, line: str, arrival_ns: int) -> tuple[TumSample | None, str]:
        sample, warning = take(self, line, arrival_ns)
        if sample is not None:
            odometry.append((sample.t_ns, arrival_ns + unix_ns))
        return sample, warning

    LiveOdometry.take = noted  # type: ignore[method-assign]  # watched
    used_s: dict[str, dict[int, float]] = {}
    began_s, ended_s = time.monotonic(), threading.Event()

    def watch() -> None:
        while not ended_s.wait(0.5):
            for name, thread, seconds in _threads():
                used_s.setdefault(name, {})[thread] = seconds

    in_thread(watch)
    code = uwb_slam(command)
    ended_s.set()
    lasted_s = time.monotonic() - began_s
    share = {name: sum(threads.values()) / lasted_s for name, threads in used_s.items()}
    share["process"] = time.process_time() / lasted_s
    (folder / "notes.json").write_text(json.dumps({"odometry": odometry, "share": share}))
    return code


def _threads() -> Iterator[tuple[str, int, float]]:
    """Yield the kind of sink, the id and the processor time of threads that publish [s]."""
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    for path in Path("/proc/self/task").iterdir():
        name, rest = (path / "stat").read_text().partition("(")[2].rsplit(")", 1)
        own = names.get(int(path.name), "")
        if own.startswith("publish "):
            kind = own.removeprefix("publish ").partition(":")[0]
        else:
            known = (sink for begin, sink in _LIBRARY_THREADS.items() if name.startswith(begin))
            kind = next(known, "")
        if not kind:
            continue
        user, system = rest.split()[11:13]
        yield kind, int(path.name), (int(user) + int(system)) / _TICKS_PER_S


COLUMNS = (
    *("scene", "fps", "sink", "poses", "ms after frame", "ms after all input"),
    *("sink's core", "process", "load"),
)
WIDTHS = (6, 3, 8, 5, 20, 20, 11, 7, 4)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", nargs="+", default=["lab", "store"])
    parser.add_argument("--fps", type=int, nargs="+", default=[5, 20])
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--child", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    os.environ |= {"CYCLONEDDS_URI": LOOPBACK, "ROS_DOMAIN_ID": "99"}
    if arguments.child:
        return child(Path(arguments.child[0]), arguments.child[1:])
    say("  ".join(cell.ljust(width) for cell, width in zip(COLUMNS, WIDTHS, strict=True)))
    say(" " * 26 + "p50    p99    max".ljust(22) + "p50    p99    max")
    for scene in arguments.scene:
        for fps in arguments.fps:
            measure(scene, fps, arguments.seconds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
