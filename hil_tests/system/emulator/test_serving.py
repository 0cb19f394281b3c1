"""Modules that come back, keep their state, hang on a UART or behind a proxy; faults, control."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hil_tests.bench.virtual_time import counters_of
from hil_tests.device.emulator_process import emulator, open_radar
from hil_tests.paths import FIXTURES
from hil_tests.patience import seconds, wait_until
from hil_tests.unit.full_disk import child_on_full_disk
from xethru_protocol.cli import main
from xethru_protocol.driver.files import FileName
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.recordings.wire_capture import read_chunks
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, RespirationState
from xethru_protocol.wire.errors import ResponseTimeout, XeThruError

pytestmark = pytest.mark.slow

SHORT = RawConfig(frame_area_m=(0.4, 1.0), iterations=4)
MEDIUM = RawConfig(frame_area_m=(0.4, 5.0))
FILE = FileName(file_type=0x80000001, identifier=7)
CTL = (sys.executable, "-m", "emulator.cli", "ctl")
TIMER_HZ_AT_17 = 17.049379
"""What the chip's timer makes of FPS 17, measured. Protocol reference 9.6."""


@pytest.mark.rare
def test_the_usual_rate_is_what_a_uart_carries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Protocol reference 10: at 115200 baud 2.0 frames of 1431 bins, 7.8 of 181 baseband bins."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with emulator("serve", "--bare", "--link", "uart") as served:
        for options, rate in (([], "1 frames/s"), (["--baseband"], "6 frames/s")):
            assert main(["stream", "--port", served.paths[0], "--count", "3", *options]) == 0
            printed = capsys.readouterr()
            counters = [json.loads(line)["counter"] for line in printed.out.splitlines()]
            assert counters == list(range(counters[0], counters[0] + 3))
            assert printed.err.startswith(f"xethru: {rate} instead of 17: the line carries ")
            assert "not stopped" not in printed.err


@pytest.fixture
def scenario(tmp_path: Path) -> str:
    """Return a scenario that takes 3 frames out of the stream, twice."""
    path = tmp_path / "gaps.toml"
    path.write_text(
        '[[fault]]\nkind = "missing_frames"\nevery = 10\ncount = 2\nparameters = { frames = 3 }\n'
    )
    return str(path)


@pytest.mark.rare
def test_an_x4m200_is_served() -> None:
    with (
        emulator("serve", "visitor", "--model", "x4m200", "--option", "bad_value=clamp") as served,
        open_radar(served.paths[0]) as radar,
    ):
        assert radar.info().order_code == "X4M200"
        message = radar.read_message(m.RespStatus, seconds(5))
        assert message.state == RespirationState.INITIALIZING


def test_driver_goes_on_when_its_emulator_comes_back(tmp_path: Path) -> None:
    links = tmp_path / "links"
    serve = ("serve", "--bare", "--serial", "100000000000", "--link-dir", links)
    with emulator(*serve) as first:
        radar = open_radar(first.paths[0], reconnect_s=15.0)
        geometry = radar.configure_raw(MEDIUM)
        radar.start(17.0)
        before = radar.read_frame()
        first.end(signal.SIGKILL)  # no goodbye, and links that lead nowhere
    with emulator(*serve) as second, radar:
        assert second.serials == first.serials
        while (frame := radar.read_frame()).stream == 0:
            before = frame
        assert radar.reconnects == 1
        assert frame.geometry == geometry
        assert frame.samples.shape == (716,)  # Protocol reference 9.4
        away_s = (frame.arrival_ns - before.arrival_ns) * 1e-9
        assert radar.frames_lost == max(round(away_s * TIMER_HZ_AT_17) - 1, 0)
        assert radar.statistics.off_lattice_samples == 0


@pytest.mark.rare
def test_bare_modules_have_serial_numbers_of_their_own(tmp_path: Path) -> None:
    """Two emulators on one machine, one that is given numbers, one that keeps them."""
    two = ("serve", "--bare", "--count", "2")
    with emulator(*two) as one, emulator(*two) as other:
        assert len({*one.serials, *other.serials}) == 4
        with open_radar(one.paths[1]) as radar:
            assert radar.info().serial_number == one.serials[1]
    with emulator("serve", "lab", "--serial", "000000000007") as given:
        assert given.serials == tuple(f"{number:012d}" for number in range(7, 11))
    (tmp_path / "100000012301.json").touch()  # of the second module
    with emulator(*two, "--state-dir", tmp_path) as kept:
        assert kept.serials == ("100000012300", "100000012301")
    with emulator(*two, "--state-dir", tmp_path, "--serial", "202611260001") as given:
        assert given.serials == ("202611260001", "202611260002")
    with emulator(*two, "--state-dir", tmp_path) as again:
        assert again.serials == given.serials


def test_a_file_survives_the_emulator(tmp_path: Path) -> None:
    content = bytes(range(256)) * 3
    serve = ("serve", "--bare", "--state-dir", tmp_path)
    with emulator(*serve) as served:
        with open_radar(served.paths[0]) as radar:
            radar.files.write(FILE.file_type, FILE.identifier, content)
        assert served.end() == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"first_serial", f"{served.serials[0]}.json"}
    with emulator(*serve) as served, open_radar(served.paths[0]) as radar:
        assert radar.files.find(FILE.file_type) == (FILE,)
        assert radar.files.read(FILE.file_type, FILE.identifier) == content
        radar.files.delete(FILE.file_type, FILE.identifier)
        assert not radar.files.find(FILE.file_type)


@pytest.mark.rare
def test_without_a_state_dir_nothing_is_kept() -> None:
    for _ in range(2):
        with emulator("serve", "--bare") as served, open_radar(served.paths[0]) as radar:
            assert not radar.files.find(FILE.file_type)
            radar.files.write(FILE.file_type, FILE.identifier, b"x")


def test_the_speed_must_fit_and_can_be_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with emulator("serve", "--bare", "--link", "uart") as served:
        path = served.paths[0]
        with X4M300.open(path, baudrate=57600) as deaf, pytest.raises(ResponseTimeout):
            deaf.ping()
        with X4M300.open(path) as radar:
            assert radar.ping() is PongCode.XTS_SPRP_READY
            radar.set_baud_rate(921600)
            radar.configure_raw(MEDIUM)
            radar.start(17.0)
            counters = [frame.counter for frame in radar.frames(8)]
            assert counters == list(range(counters[0], counters[0] + 8)), "716 bins fit"
            # back at 115200, from where the driver takes it again
            radar.reset(wait=True, timeout_s=seconds(15))
            assert radar.ping() is PongCode.XTS_SPRP_READY


@pytest.mark.parametrize("by", ["pty", pytest.param("tcp", marks=pytest.mark.rare)])
def test_no_byte_changes_without_a_fault_and_the_capture_holds_them_all(
    by: str, tmp_path: Path
) -> None:
    wire = tmp_path / "line.xtwire"
    passed: dict[str, bytes] = {"rx": b"", "tx": b""}

    def heard(direction: str, data: bytes, t_ns: int) -> None:
        passed[direction] += data

    with (
        emulator("serve", "--bare", "--tcp", "0") as module,
        emulator(
            *("proxy", "--wire", str(wire), "--port"),
            module.paths[0] if by == "pty" else f"tcp://127.0.0.1:{module.tcp_ports[0]}",
        ) as proxy,
    ):
        with open_radar(proxy.paths[0]) as radar:
            radar.raw_listener = heard
            radar.configure_raw(SHORT)
            radar.start(50.0)
            frames = list(radar.frames(50))
            assert radar.statistics.clean
        assert len(frames) == 50
    captured = {"rx": b"", "tx": b""}
    for chunk in read_chunks(wire):
        captured[chunk.way] += chunk.data
    assert captured["tx"] == passed["tx"]
    assert passed["rx"] in captured["rx"]  # what came before we listened is there, too


@pytest.mark.rare
def test_a_full_disk_under_the_capture_ends_the_proxy_with_one_line(tmp_path: Path) -> None:
    with emulator("serve", "--bare") as module:
        command = ["proxy", "--port", module.paths[0], "--wire", str(tmp_path / "a.xtwire")]
        with subprocess.Popen(
            [sys.executable, "-m", "emulator.cli", *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **child_on_full_disk(3_000),
        ) as proxy:
            assert proxy.stdout is not None
            ready = json.loads(proxy.stdout.readline())
            with (
                contextlib.suppress(XeThruError),
                open_radar(ready["devices"][0]["path"]) as radar,
            ):
                radar.configure_raw(SHORT)
                radar.start(50.0)
                list(radar.frames(200))
            printed = proxy.communicate(timeout=seconds(30))[1]
    assert proxy.returncode == 1
    assert printed.count("cannot be written") == 1
    assert "Traceback" not in printed


def test_faults_hit_the_line_of_the_module(scenario: str) -> None:
    with (
        emulator("serve", "--bare") as module,
        emulator("proxy", "--port", module.paths[0], "--faults", scenario) as proxy,
        open_radar(proxy.paths[0]) as radar,
    ):
        radar.configure_raw(SHORT)
        radar.start(50.0)
        list(radar.frames(40))
        assert radar.frames_lost == 6
        assert radar.fault_count == 0


@pytest.mark.parametrize(
    "downconversion",
    [pytest.param(False, id="rf"), pytest.param(True, id="baseband", marks=pytest.mark.rare)],
)
def test_three_minutes_lack_no_frame(downconversion: bool) -> None:
    counters = counters_of(180.0, RawConfig(downconversion=downconversion))
    assert len(counters) == pytest.approx(180.0 * TIMER_HZ_AT_17, abs=1.5)
    assert counters == list(range(counters[0], counters[0] + len(counters)))
    assert counters[0] == 1


def ctl(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*CTL, *words], capture_output=True, text=True, check=False)


@pytest.mark.rare  # test_detected.py has every kind of fault in this process
def test_what_the_driver_counts_is_what_the_truth_log_says(tmp_path: Path, scenario: str) -> None:
    truth = tmp_path / "truth.jsonl"
    arguments = ("serve", "--bare", "--faults", scenario, "--truth", truth)
    with emulator(*arguments) as served, open_radar(served.paths[0]) as radar:
        radar.configure_raw(SHORT)
        radar.start(50.0)
        list(radar.frames(30))
        written = [json.loads(line) for line in truth.read_text().splitlines()]
        assert [record["kind"] for record in written] == ["missing_frames"] * 2
        assert radar.frames_lost == sum(record["parameters"]["frames"] for record in written)

        with subprocess.Popen(
            [*CTL, served.paths[0], "fault", "add", "counter_jump", "frames=5"],
            stderr=subprocess.PIPE,
            text=True,
        ) as adding:
            while adding.poll() is None:  # a port that nobody reads overflows
                next(radar.frames(1))
            assert adding.stderr is not None
            assert adding.returncode == 0, adding.stderr.read()
        list(radar.frames(50))
        assert radar.frames_lost == 6 + 5
        state = json.loads(ctl(served.paths[0], "state").stdout)
        (told,) = state["radars"].values()
        assert told["injected"] == {"missing_frames": 2, "counter_jump": 1}
        refused = ctl(served.paths[0], "fault", "add", "crc")
        assert (refused.returncode, refused.stdout) == (1, "")


@pytest.mark.rare
def test_a_playback_is_paused_and_goes_on() -> None:
    recording = FIXTURES / "recordings" / "float"
    with emulator("play", str(recording)) as served:
        for words, paused in ((("pause",), True), (("resume",), False)):
            done = ctl(served.paths[0], *words)
            assert done.returncode == 0, done.stderr
            (told,) = json.loads(ctl(served.paths[0], "state").stdout)["radars"].values()
            assert told["playback"]["paused"] is paused


def test_a_playback_is_unplugged_and_begins_anew() -> None:
    recording = FIXTURES / "recordings" / "float"
    with emulator("play", str(recording), "--loop") as served, contextlib.ExitStack() as hosts:
        port = Path(served.paths[0])

        def is_played() -> bool:
            (told,) = json.loads(ctl(served.paths[0], "state").stdout)["radars"].values()
            return bool(told["playback"]["playing"])

        def open_port() -> None:
            hosts.callback(os.close, os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK))

        open_port()
        wait_until(is_played)
        assert ctl(served.paths[0], "unplug").returncode == 0
        wait_until(lambda: not port.is_symlink())
        wait_until(lambda: not is_played())
        assert ctl(served.paths[0], "plug").returncode == 0
        wait_until(port.is_symlink)
        open_port()
        wait_until(is_played)
