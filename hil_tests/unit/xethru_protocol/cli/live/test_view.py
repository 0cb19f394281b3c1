"""``xethru view`` and ``xethru vital``: closed forms, an emulated person, what goes wrong."""

import json
import os
import pty
import re
import signal
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator import emulated_port
from hil_tests.paths import FIXTURES
from hil_tests.patience import seconds, wait_until
from hil_tests.system.terminal import in_terminal
from hil_tests.unit.xethru_protocol.pty_module import PtyModule, Said
from hil_tests.unit.xethru_protocol.scripted import PlainModule
from xethru_protocol.cli import main
from xethru_protocol.cli.arguments import parse
from xethru_protocol.cli.live.analysis import Clutter, LiveAnalysis, VitalAnswer
from xethru_protocol.cli.live.sources import open_source
from xethru_protocol.optional_packages import install_command
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting

Capture = pytest.CaptureFixture[str]
XETHRU = [sys.executable, "-m", "xethru_protocol.cli"]
FRAME_RATE_HZ = 17.0
RANGES_M = np.arange(0.4, 5.0, 0.0514)
CARRIERS_HZ = {3: 7.29e9, 4: 8.748e9}  # by TXCENTERFREQUENCY: protocol reference 9.2
PULSE_M = 0.12
NOISE = 1e-4


def target(range_m: NDArray[np.float64], tx_center_frequency: int = 3) -> NDArray[np.complex64]:
    """Echo of amplitude 0.01 at a range per frame, shape (n_frames, n_bins), and noise."""
    wavelength_m = 299_792_458 / CARRIERS_HZ[tx_center_frequency]
    away = RANGES_M[np.newaxis] - range_m[:, np.newaxis]
    phase = np.exp(-4j * np.pi * range_m[:, np.newaxis] / wavelength_m)
    echo: NDArray[np.complex128] = 0.01 * np.exp(-((away / PULSE_M) ** 2)) * phase
    return (echo + noise(len(range_m))).astype(np.complex64)


def noise(n_frames: int) -> NDArray[np.complex128]:
    random = np.random.default_rng(7)
    shape = n_frames, len(RANGES_M)
    parts: NDArray[np.complex128] = random.standard_normal((*shape, 2)).view(np.complex128)
    return NOISE * parts[..., 0]


def times_s(duration_s: float) -> NDArray[np.float64]:
    return np.arange(round(duration_s * FRAME_RATE_HZ)) / FRAME_RATE_HZ


def breathing(
    duration_s: float, *, range_m: float = 1.5, rate_bpm: float = 15.0
) -> NDArray[np.float64]:
    """Range of a chest that moves by 8 mm."""
    return range_m + 4e-3 * np.sin(2 * np.pi * rate_bpm / 60 * times_s(duration_s))


def recording(path: Path, iq: NDArray[np.complex64], tx_center_frequency: int = 3) -> Path:
    settings = json.dumps({"TXCENTERFREQUENCY": tx_center_frequency})
    np.savez(path, iq=iq, ranges_m=RANGES_M, frame_rate_hz=FRAME_RATE_HZ, settings=settings)
    return path


@pytest.fixture(scope="module")
def at_rest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record 75 s of somebody who breathes 15 times a minute at 1.5 m."""
    path = tmp_path_factory.mktemp("rest") / "rest.npz"
    return recording(path, target(breathing(75)))


def answers_of(path: Path, capsys: Capture) -> list[dict[str, object]]:
    assert main(["vital", str(path), "--rate", "0", "--json"]) == 0
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_breathing_is_found_when_the_window_is_full(at_rest: Path, capsys: Capture) -> None:
    answers = answers_of(at_rest, capsys)
    assert [round(float(str(answer["t_s"]))) for answer in answers] == list(range(75))
    early, late = answers[:60], answers[61:]
    assert all(answer["rate_bpm"] is None for answer in early)
    assert str(early[30]["no_answer"]).startswith("listening: 30 of 60 s")
    for answer in late:
        assert answer["rate_bpm"] == pytest.approx(15.0, abs=0.5)
        assert answer["distance_m"] == pytest.approx(1.5, abs=0.06)
        assert (answer["present"], answer["moving"], answer["no_answer"]) == (True, False, None)


def test_a_damaged_frame_is_left_out(tmp_path: Path, capsys: Capture) -> None:
    iq = target(breathing(65))
    iq[900, 3] = np.nan
    found = answers_of(recording(tmp_path / "damaged.npz", iq), capsys)[-1]
    assert found["rate_bpm"] == pytest.approx(15.0, abs=0.5)
    assert found["present"] is True
    assert main(["view", "--terminal", str(tmp_path / "damaged.npz"), "--rate", "0"]) == 0
    assert ", 1 lost" in capsys.readouterr().out


def test_a_gap_begins_a_new_window(tmp_path: Path, capsys: Capture) -> None:
    iq, t_s = target(breathing(100)), times_s(100)
    arrived = (t_s < 65) | (t_s > 70)
    path = tmp_path / "gap.npz"
    t_ns = (1e9 * t_s).astype(np.int64)
    np.savez(path, iq=iq[arrived], t_ns=t_ns[arrived], ranges_m=RANGES_M, frame_rate_hz=17.0)
    answers = answers_of(path, capsys)
    before = [one for one in answers if 61 < float(str(one["t_s"])) < 65]
    after = [one for one in answers if float(str(one["t_s"])) > 70]
    assert all(one["rate_bpm"] == pytest.approx(15.0, abs=0.5) for one in before)
    assert {one["rate_bpm"] for one in after} == {None}
    assert str(after[-1]["no_answer"]) == "listening: 29 of 60 s"


def test_nobody_has_no_rate(tmp_path: Path, capsys: Capture) -> None:
    path = recording(tmp_path / "empty.npz", noise(len(times_s(65))).astype(np.complex64))
    answers = answers_of(path, capsys)
    assert {answer["rate_bpm"] for answer in answers} == {None}
    assert [answer["no_answer"] for answer in answers[-3:]] == ["nobody"] * 3


def test_one_who_walks_has_no_rate(tmp_path: Path, capsys: Capture) -> None:
    there = 2.5 + 1.5 * np.sin(2 * np.pi * 0.1 * times_s(65))
    answers = answers_of(recording(tmp_path / "walk.npz", target(there)), capsys)
    assert {answer["rate_bpm"] for answer in answers} == {None}
    assert all(
        str(answer["no_answer"]).startswith("no answer: someone moves") for answer in answers[20:]
    )


def test_the_lines_of_vital_are_plain_where_no_terminal_is(at_rest: Path, capsys: Capture) -> None:
    assert main(["vital", str(at_rest), "--rate", "0", "--window", "20", "--count", "500"]) == 0
    *_, last = capsys.readouterr().out.splitlines()
    assert last.startswith("   29.0 s  ")
    assert " breaths/min at 1." in last
    assert ", confidence " in last


def test_every_frame_of_an_emulated_module_counts(tmp_path: Path, capsys: Capture) -> None:
    """A person at 1.8 m from the module's own scene, through a pseudo-terminal."""
    scene = tmp_path / "rest.toml"
    visitor = (FIXTURES / "scenes" / "visitor.toml").read_text()
    for before, now in (
        ("waypoints_m = [[5.5, 0.1], [1.5, 0.1]]", "waypoints_m = [[1.8, 0.1]]"),
        ('walk = "to_and_fro"\n', ""),
        ("enters_s = 130.0", "enters_s = 0.0"),
    ):
        assert before in visitor
        visitor = visitor.replace(before, now)
    scene.write_text(visitor)
    with emulated_port(scene, "--pace", "asap") as port:
        assert main(["vital", "--port", port, "--json", "--count", "1100"]) == 0
    *_, last = map(json.loads, capsys.readouterr().out.splitlines())
    # 1100 frames at the chip's 17.04938 frames/s, the first at 0; an answer a second
    assert last["t_s"] == pytest.approx(64, abs=1 / 17)
    assert last["rate_bpm"] == pytest.approx(15.0, abs=0.5)  # breaths_per_min of the scene
    assert last["distance_m"] == pytest.approx(1.81, abs=0.1)  # from the radar at y = 0.3 m


def test_pictures_follow_each_other_where_no_terminal_is(at_rest: Path, capsys: Capture) -> None:
    arguments = ["view", str(at_rest), "--rate", "0", "--terminal", "--count", "400"]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    heads = re.findall(r"^([\d.]+) s, \d+ frames, 17.0/s, clutter mean, /", printed, re.MULTILINE)
    # every 10 s of its 23.5 s, and at the end
    assert heads == ["10.0", "20.0", "23.5"]
    assert "\x1b" not in printed


@pytest.mark.parametrize("clutter", ["none", "mean", "exponential", "svd"])
def test_clutter_goes_and_the_chest_stays(clutter: str, tmp_path: Path) -> None:
    iq = target(breathing(30))
    iq[:, 60:63] += np.complex64(0.05)  # a wall at 3.5 m, five times as strong
    path = recording(tmp_path / "wall.npz", iq)
    arguments = parse(["view", str(path), "--rate", "0", "--clutter", clutter])
    with open_source(arguments) as source:
        analysis = LiveAnalysis(source, clutter=clutter, window_s=20.0)  # type: ignore[arg-type]  # a str
        for frame in source.frames:
            analysis.take(frame)
        update = analysis.update()
    newest_s = update.waterfall[:170].mean(axis=0)
    strongest_m = update.ranges_m[np.argmax(newest_s)]
    assert strongest_m == pytest.approx(3.5 if clutter == "none" else 1.5, abs=0.06)
    assert update.waterfall.shape == (510, len(update.ranges_m))  # 30 s
    assert update.doppler is not None
    assert update.chest_mm is not None
    # 8 mm from end to end
    assert np.ptp(update.chest_mm) == pytest.approx(8.0, rel=0.1)


def test_a_switched_filter_is_that_of_all_frames_shown(tmp_path: Path) -> None:
    """Behind 10 s of frames a switch from one gives the picture of the other.

    They are more than the 64 frames that a filter looks back on.
    """
    iq = target(breathing(10))
    iq[:, 60:63] += np.complex64(0.05)
    path = recording(tmp_path / "wall.npz", iq)
    arguments = parse(["view", str(path), "--rate", "0"])

    def analysis_of(clutter: Clutter) -> LiveAnalysis:
        with open_source(arguments) as source:
            analysis = LiveAnalysis(source, clutter=clutter, window_s=20.0)
            for frame in source.frames:
                analysis.take(frame)
            return analysis

    switched = analysis_of("none")
    after_none: tuple[Clutter, ...] = ("mean", "exponential", "svd", "none")
    for clutter in after_none:
        switched.switch_clutter()
        shown, expected = switched.update(), analysis_of(clutter).update()
        assert shown.clutter == expected.clutter
        np.testing.assert_array_equal(shown.waterfall, expected.waterfall)
        np.testing.assert_array_equal(shown.profile, expected.profile)


def test_a_key_takes_the_next_clutter_filter(at_rest: Path, tmp_path: Path) -> None:
    """And the terminal shows what is typed again when the command has ended."""
    size = {"TERM": "xterm-256color", "LC_ALL": "C.UTF-8", "LINES": "24", "COLUMNS": "80"}
    arguments = ["view", at_rest, "--terminal", "--rate", "0.5"]
    with in_terminal(
        "xethru_protocol.cli", arguments, tmp_path / "crashes", environment=size
    ) as command:
        assert command.echoes()
        command.read_until(lambda: b"clutter mean" in command.printed)
        assert not command.echoes()
        command.press(b"c")
        command.read_until(lambda: b"clutter exponential" in command.printed)
        command.press(b"xcc")
        command.read_until(lambda: b"clutter none" in command.printed)
        command.process.send_signal(signal.SIGINT)
        command.read_until(lambda: command.process.poll() is not None)
        assert command.echoes()
        assert command.tracebacks == ""


@pytest.mark.parametrize("tx_center_frequency", [3, 4])
def test_lengths_and_speeds_are_those_of_the_carrier(
    tmp_path: Path, tx_center_frequency: int
) -> None:
    """The chest moves by 8 mm, what creeps by 2 cm/s, at either centre frequency."""
    creeping = 3.5 - 0.02 * times_s(25)
    iq = target(breathing(25), tx_center_frequency) + target(creeping, tx_center_frequency)
    path = recording(tmp_path / "high.npz", iq, tx_center_frequency)
    arguments = parse(["view", str(path), "--rate", "0"])
    with open_source(arguments) as source:
        analysis = LiveAnalysis(source, clutter="mean", window_s=20.0)
        for frame in source.frames:
            analysis.take(frame)
        update = analysis.update()
    assert update.chest_mm is not None
    assert np.ptp(update.chest_mm) == pytest.approx(8.0, rel=0.05)
    assert update.doppler is not None
    where = np.argmin(np.abs(update.ranges_m - creeping[-32]))
    power = update.doppler.power[:, where]
    found_mps = power @ update.doppler.velocities_mps / power.sum()
    assert found_mps == pytest.approx(0.02, abs=0.001)


def test_an_unknown_centre_frequency_is_one_line(tmp_path: Path, capsys: Capture) -> None:
    path = recording(tmp_path / "a.npz", noise(30).astype(np.complex64), 5)
    assert main(["view", "--terminal", str(path), "--rate", "0"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "TXCENTERFREQUENCY 5" in line


def test_a_terminal_is_drawn_in_place(at_rest: Path) -> None:
    master, slave = pty.openpty()
    drawn = bytearray()

    def read() -> None:
        with suppress(OSError):  # the other end is closed
            while part := os.read(master, 65536):
                drawn.extend(part)

    reader = threading.Thread(target=read)
    reader.start()
    environment = {"TERM": "xterm-256color", "LC_ALL": "C.UTF-8", "LINES": "24", "COLUMNS": "80"}
    command = [*XETHRU, "view", str(at_rest), "--rate", "0", "--count", "400", "--terminal"]
    done = subprocess.run(
        command,
        stdout=slave,
        stderr=subprocess.PIPE,
        env=os.environ | environment,
        check=False,
    )
    os.close(slave)
    reader.join(seconds(5))
    os.close(master)
    assert (done.returncode, done.stderr) == (0, b"")
    text = drawn.decode()
    assert text.startswith("\x1b[?25l\x1b[2J\x1b[H")
    assert "\x1b[?25h" in text
    assert "▀" in text
    last = text.rpartition("\x1b[H")[2]
    assert last.count("\r\n") == 23 + 1  # and one behind the picture


@pytest.mark.parametrize(
    ("options", "part"),
    [
        ([], "name a recording, or the --port of a module"),
        (["rec", "--port", "p"], "not both"),
        (["rec", "--web", "--terminal"], "not allowed with argument"),
        (["rec", "--memory", "1000"], '"1000" must be like 500MB or 2GB'),
        (["rec", "--rate", "-1"], '"-1" must be a number from 0 on'),
        (["rec", "--window", "5"], '"5" must be seconds, from 20 to 600'),
        (["rec", "--clutter", "median"], "invalid choice"),
        (["--port", "p", "--frame-area", "5", "1"], "START must be smaller than END"),
        (["--port", "p", "--radar", "left"], "--radar and --rate are for a recording"),
        (["--port", "p", "--rate", "2"], "--radar and --rate are for a recording"),
    ],
)
def test_wrong_usage(options: list[str], part: str, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as wrong:
        sys.exit(main(["view", *options]))
    assert wrong.value.code == 2
    assert part in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("command", [["view", "--terminal"], ["vital"]])
def test_what_cannot_be_shown_is_one_line(
    command: list[str], at_rest: Path, tmp_path: Path, capsys: Capture
) -> None:
    few = recording(tmp_path / "few.npz", noise(30).astype(np.complex64))
    with np.load(few) as arrays:
        np.savez(tmp_path / "no_ranges.npz", iq=arrays["iq"], frame_rate_hz=17.0)
        np.savez(tmp_path / "no_rate.npz", iq=arrays["iq"], ranges_m=arrays["ranges_m"])
        np.savez(
            tmp_path / "narrow.npz",
            iq=arrays["iq"][:, :9],
            ranges_m=arrays["ranges_m"][:9],
            frame_rate_hz=17.0,
        )
    for name, options, part in (
        ("none", [], "there is no recording"),
        ("no_ranges.npz", [], "add its --frame-area START END"),
        ("no_rate.npz", [], "add --fps F"),
        ("narrow.npz", [], "take a longer --frame-area"),
        ("few.npz", ["--fps", "2"], "breathing needs 4 (--fps)"),
        ("few.npz", ["--radar", "left"], "names none"),
    ):
        assert main([*command, str(tmp_path / name), "--rate", "0", *options]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"xethru {command[0]}: ")
        assert part in line
    given = ["--frame-area", "0.4", "4.95", "--rate", "0"]
    assert main([*command, str(tmp_path / "no_ranges.npz"), *given]) == 0


def test_an_unplugged_module_is_one_line(capsys: Capture) -> None:
    plain = PlainModule()

    def answer(command: m.Message) -> Sequence[Said]:
        """Vanish when frames begin."""
        match command:
            case m.X4DriverSet(setting=X4Setting.FPS, value=value) if value:
                return [b""]
        return plain(command)

    for command in (["view", "--terminal"], ["vital"]):
        with PtyModule(answer) as module:
            assert main([*command, "--port", module.path]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"xethru {command[0]}: {module.path}")


def test_a_signal_stops_the_module(tmp_path: Path) -> None:
    with PtyModule() as module:
        command = [*XETHRU, "vital", "--port", module.path]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert b"listening" in process.stdout.readline()
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=seconds(10))
        assert (process.returncode, errors) == (130, b"")
        assert module.fps == 0


def test_a_missing_viewer_is_named(
    at_rest: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setitem(sys.modules, "rerun_cli", None)
    assert main(["view", str(at_rest)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"xethru view: the Rerun viewer is not installed: {install_command('live')}"


def test_without_a_display_other_ways_are_named(
    at_rest: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    pytest.importorskip("rerun_cli")
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    assert main(["view", str(at_rest)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "--web shows it in a browser, --terminal as text" in line


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc (Linux)")
@pytest.mark.parametrize(
    "ends_by", [pytest.param("a signal", marks=pytest.mark.rare), "its viewer"]
)
def test_a_browser_is_served_until_the_end(ends_by: str, at_rest: Path) -> None:
    pytest.importorskip("rerun_cli")
    command = [*XETHRU, "view", str(at_rest), "--web"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        url = process.stderr.readline().split()[-1]
        assert url.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(url, timeout=seconds(10)) as page:
            assert b"wasm" in page.read()
        (viewer,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        if ends_by == "a signal":
            process.send_signal(signal.SIGINT)
        else:
            os.kill(int(viewer), signal.SIGTERM)
        assert process.stderr.read() == ""
        assert process.wait(timeout=seconds(10)) == (130 if ends_by == "a signal" else 0)
    wait_until(lambda: not Path(f"/proc/{viewer}").exists())


LISTENING = VitalAnswer(t_s=59.0, heard_s=59.0, window_s=60.0, breathing=None, presence=None)


def test_a_full_window_without_a_rate_is_not_waited_for() -> None:
    full, longer = (replace(LISTENING, t_s=t_s, heard_s=t_s) for t_s in (60.0, 61.0))
    assert full.text == longer.text != LISTENING.text
