"""How ``xethru`` ends when its output is closed or full, and what it says when a module hangs."""

import io
import json
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hil_tests.patience import seconds, wait_until
from hil_tests.unit.xethru_protocol.pty_module import PtyModule
from xethru_protocol.cli import main, output
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.operating_system import one_line
from xethru_protocol.recordings import describe_recording
from xethru_protocol.wire.errors import Disconnected, ResponseTimeout

XETHRU = [sys.executable, "-m", "xethru_protocol.cli"]
ACK = '{"framing": "normal", "payload_hex": "10", "message": "ACK", "fields": {}}\n'


def xethru(*arguments: object) -> str:
    """Return the command for a shell; the path of this Python may have blanks."""
    return shlex.join([*XETHRU, *map(str, arguments)])


DECODE = f"printf '7D 10 6D 7E\\n7D 10 6D 7E\\n' | {xethru('decode', '--hex')}"


def shell(command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-o", "pipefail", "-c", command], capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(
    ("redirection", "code", "out", "err"),
    [
        pytest.param("", 0, 2 * ACK, "", marks=pytest.mark.rare),
        (">&-", 1, "", "xethru decode: standard output is closed; nothing can be printed\n"),
        pytest.param("2>&-", 0, 2 * ACK, "", marks=pytest.mark.rare),
        pytest.param(">&- 2>&-", 1, "", "", marks=pytest.mark.rare),
        (
            ">/dev/full",
            1,
            "",
            "xethru decode: standard output cannot be written: No space left on device\n",
        ),
        pytest.param(">/dev/full 2>/dev/full", 1, "", "", marks=pytest.mark.rare),
        ("| head -1", 0, ACK, ""),
        ("-", 0, 2 * ACK, ""),  # a dash is standard input
    ],
)
def test_output_that_takes_nothing(redirection: str, code: int, out: str, err: str) -> None:
    if "/dev/full" in redirection and not os.path.exists("/dev/full"):
        pytest.skip("needs /dev/full")
    result = shell(f"{DECODE} {redirection}")
    assert (result.returncode, result.stdout, result.stderr) == (code, out, err)


def test_errors_that_cannot_be_printed_are_still_errors(tmp_path: Path) -> None:
    for redirection in ("2>&-", "2>/dev/full"):
        result = shell(f"{xethru('ping', '--port', tmp_path / 'none')} {redirection}")
        assert (result.returncode, result.stdout, result.stderr) == (1, "", "")


def test_a_port_is_not_opened_in_place_of_a_closed_stream(tmp_path: Path) -> None:
    """Else what Python itself writes there would go to the module."""
    with PtyModule() as module:
        result = shell(f"{xethru('ping', '--port', module.path)} <&- 2>&-")
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.startswith(f"{module.path}: ready (")


def test_input_that_is_closed() -> None:
    result = shell(f"{xethru('decode')} <&-")
    assert (result.returncode, result.stdout, result.stderr) == (
        *(1, ""),
        "xethru decode: standard input is closed; there is nothing to decode\n",
    )


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize(
    "command",
    [
        "list",
        "info",
        *(pytest.param(n, marks=pytest.mark.rare) for n in ("ping", "stream", "doctor")),
    ],
)
def test_what_cannot_be_printed_is_one_line(command: str) -> None:
    with PtyModule() as module:
        port = () if command == "list" else ("--port", module.path)
        result = shell(f"{xethru(command, *port)} >/dev/full")
        assert module.fps == 0
    text = "standard output cannot be written: No space left on device"
    assert (result.returncode, result.stderr) == (1, f"xethru {command}: {text}\n")


@pytest.mark.parametrize(
    ("number", "before", "code"),
    [
        (signal.SIGINT, signal.SIG_DFL, 130),
        pytest.param(signal.SIGTERM, signal.SIG_DFL, 143, marks=pytest.mark.rare),
        pytest.param(signal.SIGHUP, signal.SIG_DFL, 129, marks=pytest.mark.rare),
        (signal.SIGHUP, signal.SIG_IGN, 0),
    ],
    ids=["SIGINT", "SIGTERM", "SIGHUP", "SIGHUP with nohup"],
)
def test_a_signal_leaves_a_complete_recording_and_a_stopped_module(
    number: signal.Signals, before: signal.Handlers, code: int, tmp_path: Path
) -> None:
    out = tmp_path / "recording"
    command = [*XETHRU, "record", "--out", str(out), "--count", "100", "--json", "--port"]
    with (
        PtyModule() as module,
        subprocess.Popen(
            [*command, module.path],
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            preexec_fn=lambda: signal.signal(signal.SIGHUP, before),
        ) as process,
    ):
        files = "xethru_datafloat_*"
        wait_until(lambda: any(path.stat().st_size for path in out.glob(files)), process)
        process.send_signal(number)
        printed, errors = process.communicate(timeout=seconds(10))
        assert module.fps == 0
    assert (process.returncode, errors) == (code, b"")
    summary = json.loads(printed)
    assert summary["ended_by"] == ("signal" if code else "count")
    assert summary["link"]["frames_lost"] == 0
    kept = describe_recording(out)  # complete: no faults
    assert (kept.faults, kept.messages) == ((), {"DATA FLOAT": summary["messages"]})
    assert summary["messages"] == 100 or code


@pytest.mark.parametrize("name", ["line\nend", "tab\tbell\a", "\udcff\udcfe", "größer ☃"])
def test_odd_names_are_one_readable_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (["ping", "--port"], ["dump"], ["record", "--out", f"{tmp_path}/o", "--port"]):
        assert main([*command, str(tmp_path / name)]) == 1
        printed, errors = capsys.readouterr()
        (line,) = errors.splitlines()
        assert (printed, line.isprintable()) == ("", True)
        assert one_line(name) in line


def test_results_that_the_terminal_has_no_letters_for(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="ascii"))
    output.print_line("größer \udcff")
    assert raw.getvalue() == b"gr\\xf6\\xdfer \\udcff\n"


# --- a module that hangs ------------------------------------------------------------------------


STOP_FAILED = "the module was not stopped: no answer"


class Driver:
    """A driver whose module can be stopped at the end, or not."""

    def __init__(self, *warnings: str, stops: bool = False) -> None:
        self.warnings = list(warnings)
        self.frames_lost = 2
        self.fault_count = 1
        self._stops = stops

    def __enter__(self) -> "Driver":
        return self

    def __exit__(self, *reason: object) -> None:
        if not self._stops:
            self.warnings.append(STOP_FAILED)


LOST = "2 frames lost, 1 damaged place on the line"
SILENT = ResponseTimeout("no frame came")


@pytest.mark.parametrize(
    ("driver", "cause", "raised", "text", "warned"),
    [
        (
            *(Driver(), SILENT, output.CommandFailed),
            *(r"^no frame came \(and it could not be stopp", []),
        ),
        (Driver(), Disconnected("unplugged"), Disconnected, "^unplugged$", []),
        (Driver("slow", stops=True), SILENT, ResponseTimeout, "^no frame came$", ["slow"]),
        (Driver(), KeyboardInterrupt(), KeyboardInterrupt, "^$", [STOP_FAILED, LOST]),
    ],
    ids=["cause first", "a vanished port", "a warning of before", "a warning after a signal"],
)
def test_what_is_reported_of_a_module_that_cannot_be_stopped(
    driver: Driver,
    cause: BaseException,
    raised: type[BaseException],
    text: str,
    warned: list[str],
    *,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(X4M300, "open", lambda port, baudrate: driver)
    with pytest.raises(raised, match=text), output.module_at("port", 115200):
        raise cause
    assert capsys.readouterr().err == "".join(f"xethru: {line}\n" for line in warned)
