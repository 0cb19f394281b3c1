"""uwb-slam itself: help is light, wrong usage is 2, signals, and no traceback."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from hil_tests.patience import seconds
from slam.app.cli import main
from slam.app.errors import StopFlag, StopRequestedError
from xethru_protocol.system import locked


@pytest.mark.parametrize(
    ("command", "option", "said"),
    [
        ("demo", "--out", "another run is writing there"),
        ("sweep", "--json", "another sweep is writing there"),
    ],
)
def test_two_runs_into_one_place_are_refused_and_the_first_goes_on(
    command: str, option: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    first = out / "summary.json" if command == "demo" else tmp_path / "out.part"
    first.parent.mkdir(exist_ok=True)
    first.write_text("of the first run")
    with locked(out if command == "demo" else first):
        assert main([command, option, str(out)]) == 1
    text = capsys.readouterr()
    assert said in text.err
    assert (text.out, text.err.count("\n")) == ("", 1)
    assert first.read_text() == "of the first run"


def trajectory(folder: Path) -> str:
    path = folder / "path.tum"
    path.write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n3 1 1 0 0 0 0 1\n")
    return str(path)


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
@pytest.mark.parametrize(("scene", "code"), [("", 0), ("mars", 2)])
def test_a_closed_standard_stream_changes_nothing(
    closed: str, scene: str, code: int, tmp_path: Path
) -> None:
    path = trajectory(tmp_path)
    arguments = f"sweep --json o --scene {scene}" if scene else f"evaluate {path} {path}"
    run = subprocess.run(
        ["sh", "-c", f"exec {sys.executable} -m slam.app.cli {arguments} {closed}"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == code
    assert "Traceback" not in run.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full (Linux)")
def test_output_that_takes_no_more_is_1_and_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "slam.app.cli", "evaluate", *2 * [trajectory(tmp_path)]]
    with Path("/dev/full").open("w") as full:
        run = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (run.returncode, run.stderr) == (1, "uwb-slam: No space left on device\n")


@pytest.mark.parametrize(("which", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_after_a_commands_last_check_counts_too(
    which: signal.Signals,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    interrupted = lambda *_, **__: os.kill(os.getpid(), which)  # noqa: E731
    monkeypatch.setattr("slam.app.run.results.run_evaluate", interrupted)
    assert main(["evaluate", "one.tum", "two.tum"]) == code
    assert capsys.readouterr().err == f"uwb-slam: stopped by {which.name}\n"


def test_a_signal_before_a_command_takes_note_of_signals_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("slam.app.cli._parser", interrupted)
    assert main(["run"]) == 130
    assert capsys.readouterr().err == "uwb-slam: stopped by SIGINT\n"


@pytest.mark.parametrize(
    ("which", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_a_signal_raises_at_the_next_check_only(which: signal.Signals, code: int) -> None:
    with StopFlag() as stop:
        stop.check()
        os.kill(os.getpid(), which)
        done = "work goes on until the check"
        with pytest.raises(StopRequestedError, match=f"stopped by {which.name}") as caught:
            stop.check()
    assert done
    assert caught.value.exit_code == code


def test_while_waiting_a_signal_raises_where_it_arrives() -> None:
    with StopFlag() as stop:
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM)).start()
        with pytest.raises(StopRequestedError), stop.at_once():
            pytest.fail(f"it waited to the end: {threading.Event().wait(seconds(10))}")


def test_a_second_signal_gets_the_systems_default() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopFlag():
        os.kill(os.getpid(), signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) is before


def test_a_closing_terminals_second_hang_up_does_not_end_the_clean_stop() -> None:
    before = signal.getsignal(signal.SIGHUP)
    with StopFlag() as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        os.kill(os.getpid(), signal.SIGHUP)
        with pytest.raises(StopRequestedError):
            stop.check()
    assert signal.getsignal(signal.SIGHUP) is before


def test_nohup_is_respected() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopFlag() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            stop.check()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_signal_before_waiting_begins_is_not_lost() -> None:
    with StopFlag() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(StopRequestedError), stop.at_once():
            pytest.fail("must not begin to wait")


class StopFlagWithASlowCheck(StopFlag):
    """A signal comes just after the check found nothing, where a lost one would go unseen."""

    def check(self) -> None:
        first = self._received is None
        super().check()
        if first:
            os.kill(os.getpid(), signal.SIGINT)


def test_a_signal_just_after_the_check_is_not_lost() -> None:
    with StopFlagWithASlowCheck() as stop:
        with pytest.raises(StopRequestedError), stop.at_once():
            pytest.fail("must not begin to wait")
        assert not stop._at_once
