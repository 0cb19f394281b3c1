"""``xethru`` with a module: output, exit codes, and how it ends."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hil_tests.unit.xethru_protocol.pty_module import PtyModule, stock
from xethru_protocol.cli import main
from xethru_protocol.cli.module import setting_text
from xethru_protocol.recordings import RecordingWriter
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting
from xethru_protocol.wire.messages import X4Value

XETHRU = [sys.executable, "-m", "xethru_protocol.cli"]


def stopped(module: PtyModule) -> bool:
    stop = m.X4DriverSet(setting=X4Setting.FPS, value=0.0)
    return module.received[-2:] == [stop, m.SetMode(mode=SensorMode.XTID_SM_STOP)]


def lines_of(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_stream_prints_one_object_per_frame_and_stops_the_module(
    module: PtyModule, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["stream", "--port", module.path, "--count", "3"]) == 0
    frames = lines_of(capsys)
    assert [frame["counter"] for frame in frames] == [0, 1, 2]
    assert list(frames[0]) == ["counter", "t_ns", "bins", "range_start_m", "bin_length_m"]
    assert frames[0]["bins"] == 1431
    assert stopped(module)
    area = m.X4DriverSet(
        setting=X4Setting.FRAMEAREA, value=(0.20000000298023224, 9.399999618530273)
    )
    assert area in module.received


def test_stream_with_samples(module: PtyModule, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stream", "--port", module.path, "--count", "2", "--samples"]) == 0
    assert lines_of(capsys)[1]["samples"] == [1.0] * 1431


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.rare), (None, 0)],
    ids=["SIGINT", "SIGTERM", "its reader leaves"],
)
def test_stream_ends_cleanly(module: PtyModule, number: signal.Signals | None, code: int) -> None:
    command = [*XETHRU, "stream", "--port", module.path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert json.loads(process.stdout.readline())["counter"] == 0
        if number is None:
            process.stdout.close()
        else:
            process.send_signal(number)
            process.stdout.read()
        assert process.stderr.read() == b""
        assert process.wait() == code
    assert stopped(module)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ((-4.114211e-05, 9.950666427612305), "0 ... 9.9507"),  # what a module has after power-up
        (17.048640251159668, "17.0486"),
        (0.18, "0.18"),
        (10.0, "10"),
        (None, "-"),
        (7, "7"),
    ],
)
def test_settings_are_shown_to_a_tenth_of_a_millimetre(value: X4Value | None, text: str) -> None:
    assert setting_text(value) == text


def test_ping_and_info(module: PtyModule, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ping", "--port", module.path]) == 0
    assert capsys.readouterr().out.startswith(f"{module.path}: ready (")
    assert main(["info", "--port", module.path, "--json"]) == 0
    (info,) = lines_of(capsys)
    assert info["serial_number"] == "123456789012"
    assert info["mode"] == "MANUAL"
    assert info["x4"]["FRAMEBINCOUNT"] == 1431


def test_reset_sends_that_and_nothing_else(module: PtyModule) -> None:
    assert main(["reset", "--port", module.path]) == 0
    assert module.received == [m.ModReset()]


def emulated_ports(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    assert main(["list", "--json"]) == 0
    (found,) = lines_of(capsys)
    return [port for port in found["ports"] if port["kind"] == "emulated"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder in which emulators are registered."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "xethru").mkdir(mode=0o700)
    return tmp_path / "xethru"


def test_list_shows_running_emulators_only(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = folder / "left"
    port.touch()
    here = {"path": str(port), "name": "left", "serial": "42", "tcp": 5000}
    gone = {"path": str(folder / "gone"), "name": "gone", "serial": "43", "tcp": None}
    running = {"ready": True, "pid": 1, "devices": [here, gone]}
    (folder / "1.json").write_text(json.dumps(running))
    (folder / "2.json").write_text(json.dumps(running | {"pid": 1 << 22}))  # above any pid
    (folder / "3.json").write_text("{")
    for number, pid in enumerate(["1e999", str(1 << 70), "-1", "0"], start=4):
        word = json.dumps(running | {"pid": "PID"}).replace('"PID"', pid)
        (folder / f"{number}.json").write_text(word)
    about = {"kind": "emulated", "description": "emulated left", "serial": "42"}
    also = {"tcp": 5000, "uart": False}
    assert emulated_ports(capsys) == [{"path": str(port), **about, **also}]


def announce(folder: Path, name: str = "left") -> None:
    (folder / "left").touch()
    device = {"path": str(folder / "left"), "name": name, "serial": name, "tcp": None}
    (folder / "1.json").write_text(json.dumps({"pid": 1, "devices": [device]}))


@pytest.mark.parametrize(
    "whose", ["group may write", "others may write", "of another user", "link"]
)
def test_a_run_directory_that_is_not_ours_alone_is_not_believed(
    whose: str, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    announce(folder)
    assert len(emulated_ports(capsys)) == 1
    match whose:
        case "group may write":
            folder.chmod(0o770)
        case "others may write":
            folder.chmod(0o1777)
        case "link":
            folder.rename(folder.with_name("elsewhere"))
            folder.symlink_to(folder.with_name("elsewhere"))
        case _:
            other = folder.stat().st_uid + 1
            monkeypatch.setattr("xethru_protocol.transport.os.getuid", lambda: other)
    assert emulated_ports(capsys) == []
    assert main(["doctor"]) == 1
    assert "is not this user's alone" in " ".join(capsys.readouterr().out.split())


HOSTILE = "\x1b]0;owned\x07\x1b[2J\r\n\x7f\x9b31m"


def test_no_control_character_of_others_reaches_the_terminal(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names in the run directory, strings of a module, names in a recording."""
    announce(folder, HOSTILE)
    recording = tmp_path / "recording"
    with RecordingWriter(recording, session_id=HOSTILE) as writer:
        writer.write(m.DataString(content_id=1, info=2, text=HOSTILE), 1_700_000_000 * 10**9)
    with PtyModule(stock(firmware_id=HOSTILE, version=HOSTILE)) as module:
        for command in (
            ["list"],
            ["doctor"],
            ["doctor", "--port", module.path],
            ["info", "--port", module.path],
            ["dump", str(recording)],
        ):
            main(command)
            printed = capsys.readouterr()
            for line in (printed.out + printed.err).split("\n"):
                assert line.isprintable(), command
            assert main([*command, "--json"]) in (0, 1)
            shown = capsys.readouterr().out
            assert shown.isascii()
            assert "\x7f" not in shown
            objects = [json.loads(line) for line in shown.splitlines()]
            assert any(HOSTILE in text for text in _strings(objects)), command


def _strings(value: Any) -> Iterator[str]:  # noqa: ANN401 - any JSON value
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _strings(item)


@pytest.mark.parametrize(
    "path", ["x" * 5000, "\0", "\ud800", "a\nb"], ids=["long", "NUL", "surrogate", "line end"]
)
def test_list_passes_over_what_can_be_no_path(
    path: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    device = {"path": path, "name": "left", "serial": "42"}
    (folder / "1.json").write_text(json.dumps({"pid": 1, "devices": [device]}))
    (folder / "2.json").write_text("[" * 100_000)
    assert emulated_ports(capsys) == []


def test_rate_at_which_no_sweep_ends_is_refused_with_the_values(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with PtyModule() as module:
        assert main(["stream", "--port", module.path, "--fps", "1000", "--count", "1"]) == 1
        assert not [
            one for one in module.received if isinstance(one, m.X4DriverSet) and one.value == 1000
        ]
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    for value in ("1000 frames/s", "16 iterations", "300 pulses", "152 thresholds", "20.8/s"):
        assert value in captured.err
