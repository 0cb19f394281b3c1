"""How serve starts and ends, whatever happens around it; the signals are in `system/ends`."""

import json
import shlex
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hil_tests.device.emulator_process import emulator, open_radar
from hil_tests.patience import seconds, wait_until
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.codes import PongCode

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def announcements(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "xethru"


def lines_of(path: str | None, most: int) -> list[str]:
    assert path is not None
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(seconds(10))
        client.connect(path)
        data = b""
        while data.count(b"\n") < most and (chunk := client.recv(65536)):
            data += chunk
    return data.decode().splitlines()


def test_its_links_and_its_announcement_are_there_while_it_runs(
    tmp_path: Path, announcements: Path
) -> None:
    links = tmp_path / "links"
    with emulator("serve", "smoke", "--link-dir", links) as served:
        assert served.odometry is not None
        assert sorted(path.name for path in links.iterdir()) == sorted(
            [*served.names, "control.sock", "odometry.sock"]
        )
        (announced,) = announcements.glob("*.json")
        assert json.loads(announced.read_text())["pid"] == served.process.pid
        assert served.end() == 0
    assert not links.exists()
    assert list(announcements.iterdir()) == []


def test_a_signal_while_streaming_ends_it_too() -> None:
    with (
        emulator("serve", "smoke", "--pace", "asap") as served,
        open_radar(served.paths[0]) as driver,
    ):
        driver.configure_raw()
        driver.start(5.0)
        driver.read_frame()
        assert served.end() == 0
        assert not Path(served.paths[0]).parent.exists()


def test_a_killed_emulator_is_succeeded_by_the_next(tmp_path: Path, announcements: Path) -> None:
    links = tmp_path / "links"
    arguments = ("serve", "smoke", "--link-dir", links)
    with emulator(*arguments) as first:
        first.end(signal.SIGKILL)
    assert len(list(links.iterdir())) == 6, "a killed process cleans nothing up"
    with emulator(*arguments) as second:
        for path in second.paths:
            with open_radar(path) as driver:
                assert driver.ping() is PongCode.XTS_SPRP_READY
        assert len(list(announcements.glob("*.json"))) == 1
        assert lines_of(second.odometry, 1)
        assert second.end() == 0
    assert list(links.iterdir()) == [], "the folder was not ours to remove"


def test_a_closed_stdout_does_not_matter(tmp_path: Path) -> None:
    serve = [sys.executable, "-m", "emulator.cli", "serve", "--bare"]
    command = shlex.join([*serve, "--link-dir", str(tmp_path / "l")])
    with subprocess.Popen(["sh", "-c", f"exec {command} >&-"]) as process:
        port = tmp_path / "l" / "radar_1"
        wait_until(port.is_symlink, process)
        with open_radar(str(port)) as driver:
            driver.ping()  # the loop runs
        process.terminate()
        assert process.wait(seconds(10)) == 0
    assert not (tmp_path / "l").exists()


@pytest.mark.parametrize("pace", [pytest.param("asap", marks=pytest.mark.rare), "realtime"])
def test_a_host_killed_while_streaming_is_followed_by_another(pace: str) -> None:
    host = (
        "import sys\n"
        "from xethru_protocol.driver.radar import X4M300\n"
        "radar = X4M300.open(sys.argv[1])\n"
        "radar.configure_raw()\n"
        "radar.start(17.0)\n"
        "radar.read_frame()\n"
        "print('streaming', flush=True)\n"
        "while True: radar.read_frame()\n"
    )
    with emulator("serve", "smoke", "--pace", pace) as served:
        with subprocess.Popen(
            [sys.executable, "-c", host, served.paths[0]], stdout=subprocess.PIPE, text=True
        ) as first:
            assert first.stdout is not None
            assert first.stdout.readline() == "streaming\n"
            first.kill()
        time.sleep(0.3)
        with open_radar(served.paths[0]) as second:
            second.configure_raw(RawConfig(downconversion=True))
            second.start(17.0)
            frames = list(second.frames(5))
        assert {len(frame.samples) for frame in frames} == {181}
        assert served.end() == 0


@pytest.mark.rare
def test_bare_serves_stock_modules_without_odometry() -> None:
    with emulator("serve", "--bare", "--count", "3") as served:
        assert served.odometry is None
        assert len(set(served.serials)) == 3
        for path, serial in zip(served.paths, served.serials, strict=True):
            with open_radar(path) as driver:
                info = driver.info()
                assert (info.serial_number, info.mode) == (serial, "RUN")


def test_odometry_comes_whole_under_asap_and_in_time_under_realtime() -> None:
    with emulator("serve", "smoke", "--pace", "asap") as served:
        whole = lines_of(served.odometry, 10**9)
    assert len(whole) > 1000
    with emulator("serve", "smoke") as served:
        first = lines_of(served.odometry, 4)
        elapsed_s = (time.monotonic_ns() - served.scene_time_zero_ns) / 1e9
    assert first == whole[: len(first)]
    assert elapsed_s >= float(first[-1].split()[0])


@pytest.mark.rare
def test_a_long_link_directory_still_gets_a_socket(tmp_path: Path) -> None:
    links = tmp_path / ("long" * 20)
    with emulator("serve", "smoke", "--pace", "asap", "--link-dir", links) as served:
        assert served.odometry is not None
        assert lines_of(served.odometry, 1)
        assert served.end() == 0
    assert not Path(served.odometry).parent.exists()


def test_tcp_ports_are_told_and_reach_the_same_modules(announcements: Path) -> None:
    arguments = ("serve", "--bare", "--count", "2", "--tcp", "0")
    with emulator(*arguments) as served:
        (word,) = announcements.glob("*.json")
        for told in json.loads(word.read_text())["devices"]:
            with X4M300.open(f"tcp://127.0.0.1:{told['tcp']}") as driver:
                assert driver.info().serial_number == told["serial"]
        assert served.end() == 0
