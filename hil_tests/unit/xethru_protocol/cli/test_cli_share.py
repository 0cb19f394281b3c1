"""``xethru share``: two programs at one module behind a pseudo-terminal."""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from hil_tests.patience import seconds
from hil_tests.unit.xethru_protocol.both_drivers import DriverOn
from hil_tests.unit.xethru_protocol.emulated import EmulatedModule
from hil_tests.unit.xethru_protocol.pty_module import PtyModule
from xethru_protocol.cli import main
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import encode
from xethru_protocol.wire.codes import SensorMode, X4Setting
from xethru_protocol.wire.errors import (
    DeviceError,
    Disconnected,
    LocalProtocolError,
    ResponseTimeout,
)
from xethru_protocol.wire.framing import encode_normal

XETHRU = [sys.executable, "-m", "xethru_protocol.cli"]


class Share:
    """The program, at a port of this machine."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self.process = process
        ready = self.line()
        assert ready["ready"] is True
        self.url: str = ready["tcp"]

    def line(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        found: dict[str, Any] = json.loads(self.process.stdout.readline())
        return found

    def end(self, number: int = signal.SIGINT) -> int:
        self.process.send_signal(number)
        return self.process.wait(timeout=seconds(10))


@contextmanager
def shared(port: str) -> Iterator[Share]:
    command = [*XETHRU, "share", "--port", port, "--tcp", "0", "--json"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield Share(process)
        finally:
            process.kill()


@pytest.fixture
def share(module: PtyModule) -> Iterator[Share]:
    with shared(module.path) as share:
        yield share


def test_frames_that_do_not_come_cannot_be_taken(driver_on: DriverOn) -> None:
    module = EmulatedModule()
    (commander, _), (listener, _) = driver_on(module), driver_on(module)
    with pytest.raises(LocalProtocolError):  # mode STOP
        listener.attach()
    geometry = commander.configure_raw()
    with pytest.raises(LocalProtocolError):  # frame rate 0
        listener.attach()
    commander.start(5)
    assert listener.attach() == geometry
    listener.close()  # stops nothing
    assert module.received[-1] == m.X4DriverGet(setting=X4Setting.FPS)
    commander.close()


def count(radar: X4M300, n_frames: int) -> list[int]:
    return [frame.counter for frame in radar.frames(n_frames, timeout_s=seconds(5))]


def test_a_listener_gets_the_frames_of_the_one_that_commands(
    share: Share, module: PtyModule, capsys: pytest.CaptureFixture[str]
) -> None:
    with X4M300.open(share.url) as commander, X4M300.open(share.url) as listener:
        geometry = commander.configure_raw()
        rate_hz = commander.start(17)
        first = count(commander, 3)
        assert listener.attach() == geometry
        assert listener.description["rate_hz"] == rate_hz
        settings = listener.description["settings"]
        assert settings.items() >= commander.description["settings"].items()
        seen = count(listener, 20)
        assert seen == list(range(seen[0], seen[0] + 20))
        behind = count(commander, seen[-1] - first[-1])
        assert behind == list(range(first[-1] + 1, seen[-1] + 1))
        n_commands = len(module.received)
        with pytest.raises(DeviceError, match="BUSY"):
            listener.configure_raw()
        listener.close()
        assert all(
            isinstance(one, m.Ping | m.SystemGetInfo) for one in module.received[n_commands:]
        )
        assert main(["stream", "--port", share.url, "--attach", "--count", "3"]) == 0
        assert len(capsys.readouterr().out.splitlines()) == 3
        assert main(["stream", "--port", share.url, "--count", "3"]) == 1
        assert "be stopped" not in capsys.readouterr().err
        assert count(commander, 3)
    assert module.received[-1] == m.SetMode(mode=SensorMode.XTID_SM_STOP)
    assert share.end() == 0


def test_a_listener_that_is_left_with_other_settings_says_so(share: Share) -> None:
    with X4M300.open(share.url) as commander, X4M300.open(share.url) as listener:
        commander.configure_raw()
        commander.start(17)
        listener.attach()
        assert count(listener, 1)
        commander.x4.dac_min = 950
        with pytest.raises(ResponseTimeout):
            list(listener.frames(200, timeout_s=0.5))
        assert listener.geometry is None
        assert any("attach again" in text for text in listener.warnings)
        assert listener.attach() is not None
        assert count(listener, 1)


def test_another_commands_when_the_first_has_left(share: Share) -> None:
    with X4M300.open(share.url) as first:
        first.configure_raw()
        with X4M300.open(share.url) as second:
            with pytest.raises(DeviceError):
                second.configure_raw()
            first.close()
            assert share.line()["lost"] == 0
            second.configure_raw()
            second.start(17)
            assert count(second, 3)


@pytest.mark.slow
def test_a_program_that_does_not_read_loses_frames_and_the_other_none(share: Share) -> None:
    host, port = share.url.removeprefix("tcp://").split(":")
    with socket.socket() as slow, X4M300.open(share.url) as quick:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
        slow.connect((host, int(port)))
        quick.configure_raw()
        quick.start(17)
        seen = count(quick, 800)  # 4.6 MB, and 1 MB is kept
        assert seen == list(range(seen[0], seen[0] + 800))
        name = "{}:{}".format(*slow.getsockname())
        slow.close()
        left = share.line()
    assert left["left"] == name
    assert left["lost"] > 0
    assert share.line()["lost"] == 0
    assert share.end(signal.SIGTERM) == 0


def test_a_program_that_goes_in_the_middle_of_a_command(share: Share, module: PtyModule) -> None:
    host, port = share.url.removeprefix("tcp://").split(":")
    with X4M300.open(share.url) as stays:
        stays.configure_raw()
        n_commands = len(module.received)
        with socket.create_connection((host, int(port))) as goes:
            goes.sendall(bytes.fromhex("7D 01 AE EA"))  # half of a PING
        assert share.line()["messages"] == 0
        stays.start(17)
        assert count(stays, 3)
    assert not any(isinstance(one, m.UnknownMessage) for one in module.received[n_commands:])


def test_a_program_that_asks_much_and_breaks_off_leaves_no_word_on_stderr(share: Share) -> None:
    host, port = share.url.removeprefix("tcp://").split(":")
    for _ in range(20):
        with socket.create_connection((host, int(port))) as goes:
            goes.sendall(encode_normal(encode(m.Ping())) * 3000)
            goes.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    with socket.create_connection((host, int(port))) as last:
        name = "{}:{}".format(*last.getsockname())
    while share.line()["left"] != name:  # those that go before they are taken have no line
        pass
    assert share.end() == 0
    assert share.process.stderr is not None
    assert share.process.stderr.read() == ""


@pytest.mark.slow
def test_the_module_is_unplugged_and_comes_back(tmp_path: Path) -> None:
    link = tmp_path / "module"
    with (
        PtyModule(link=link) as first,
        shared(str(link)) as share,
        X4M300.open(share.url) as radar,
    ):
        radar.configure_raw()
        radar.start(17)
        assert count(radar, 3)
        first.__exit__()
        with pytest.raises(Disconnected):
            count(radar, 200)
        assert share.line()["left"]
        with pytest.raises(Disconnected), X4M300.open(share.url) as early:
            early.ping()
        with PtyModule(link=link):
            assert share.process.stderr is not None
            lines = [share.process.stderr.readline() for _ in range(2)]
            assert lines[-1].endswith("is back\n")
            with X4M300.open(share.url) as again:
                again.configure_raw()
                again.start(17)
                assert count(again, 3)
        assert share.end() == 0


def test_a_port_that_is_in_use_is_named(
    module: PtyModule, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["share", "--port", module.path, "--tcp", str(port)]) == 1
    assert f":{port}" in capsys.readouterr().err
    assert os.path.exists(module.path)


@pytest.mark.parametrize(
    "line",
    [
        "share --port P --tcp 65536",
        "stream --port P --attach --fps 5",
        "record --port P --out x.mcap --attach --profile none",
        "view FILE --attach",
    ],
)
def test_what_cannot_be_is_wrong_usage(line: str) -> None:
    with pytest.raises(SystemExit) as end:
        main(line.split())
    assert end.value.code == 2
