"""Signals, locks and files that never end."""

import contextlib
import errno
import fcntl
import os
import select
import signal
import subprocess
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from emulator.faults.plan import FaultPlanError, load_plan
from emulator.scene.scene import SceneError, load_scene
from hil_tests.patience import seconds
from slam.app.cli import main
from xethru_protocol.operating_system import (
    Outlet,
    PathInUseError,
    StopFlag,
    StopRequestedError,
    locked,
    read_bounded,
    written_whole,
)

ENDLESS = "/dev/zero"


@pytest.mark.parametrize(
    ("which", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_a_signal_raises_at_the_next_check_only(which: signal.Signals, code: int) -> None:
    with StopFlag() as stop:
        stop.check()
        os.kill(os.getpid(), which)
        with pytest.raises(StopRequestedError, match=f"stopped by {which.name}") as caught:
            stop.check()
    assert caught.value.exit_code == code


def test_while_waiting_a_signal_raises_where_it_arrives() -> None:
    with StopFlag() as stop:
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM)).start()
        with pytest.raises(StopRequestedError), stop.at_once():
            pytest.fail(f"it waited to the end: {threading.Event().wait(seconds(10))}")


_TWICE = """\
import os, sys
from signal import Signals
from xethru_protocol import operating_system
which, operating_system._TWICE_S = Signals[sys.argv[1]], float(sys.argv[2])
with operating_system.StopFlag() as stop:
    os.kill(os.getpid(), which)
    os.kill(os.getpid(), which)
    try:
        stop.check()
    except operating_system.StopRequestedError as stopped:
        sys.exit(stopped.exit_code)
"""


@pytest.mark.parametrize(
    ("which", "after_s", "code"),
    [
        ("SIGINT", "0", -signal.SIGINT),  # whoever waited and asks again wants an end at once
        ("SIGINT", "60", 130),  # a wrapper passed on the one of the terminal
        ("SIGTERM", "0", -signal.SIGTERM),
        ("SIGHUP", "0", 129),  # a terminal that closes sends two
    ],
)
def test_a_second_signal_gets_the_systems_default(which: str, after_s: str, code: int) -> None:
    command = [sys.executable, "-c", _TWICE, which, after_s]
    assert subprocess.run(command, check=False).returncode == code


def test_a_second_signal_gets_the_previous_handler() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    stop = StopFlag("previous")

    def twice() -> None:
        with stop:
            signal.raise_signal(signal.SIGINT)
            assert stop.received is signal.SIGINT
            signal.raise_signal(signal.SIGINT)

    try:
        with pytest.raises(KeyboardInterrupt):
            twice()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_every_signal_ends_an_attached_loop(number: signal.Signals) -> None:
    ended: list[str] = []
    with StopFlag("same") as stop:
        os.kill(os.getpid(), number)
        stop.attach(lambda: ended.append("loop"))
        assert ended == ["loop"]  # for the signal that came before
        os.kill(os.getpid(), number)
        assert ended == ["loop", "loop"]
        stop.detach()
        os.kill(os.getpid(), number)
    assert (stop.requested, len(ended)) == (True, 2)


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
        first = self.received is None
        super().check()
        if first:
            os.kill(os.getpid(), signal.SIGINT)


def test_a_signal_just_after_the_check_is_not_lost() -> None:
    with StopFlagWithASlowCheck() as stop:
        with pytest.raises(StopRequestedError), stop.at_once():
            pytest.fail("must not begin to wait")
        assert not stop._at_once


def test_one_owner_at_a_time_and_no_trace(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("content")
    with locked(tmp_path), locked(file):
        with pytest.raises(PathInUseError), locked(tmp_path):
            pytest.fail("held twice")
        with pytest.raises(PathInUseError), locked(file):
            pytest.fail("held twice")
    with locked(tmp_path), locked(file):
        pass
    assert list(tmp_path.iterdir()) == [file]
    assert file.read_text() == "content"


def test_a_killed_owner_holds_nothing(tmp_path: Path) -> None:
    code = (
        "import pathlib, sys, time\n"
        "from xethru_protocol.operating_system import locked\n"
        "with locked(pathlib.Path(sys.argv[1])): print(flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE
    ) as owner:
        assert owner.stdout is not None
        owner.stdout.readline()
        with pytest.raises(PathInUseError), locked(tmp_path):
            pytest.fail("held twice")
        owner.send_signal(signal.SIGKILL)
    with locked(tmp_path):
        pass


def test_what_is_not_there_is_the_systems_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), locked(tmp_path / "missing"):
        pytest.fail("nothing to hold")


def test_a_file_of_the_most_bytes_is_read_and_one_more_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_bytes(bytes(2 << 20))
    assert len(read_bounded(path, 2 << 20)) == 2 << 20
    with pytest.raises(OSError, match="longer than 1 MiB") as caught:
        read_bounded(path, (2 << 20) - 1)
    assert caught.value.errno == errno.EFBIG


def test_a_pipe_is_read_to_its_end(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=pipe.write_bytes, args=(b"x" * 100_000,))
    writer.start()
    assert read_bounded(pipe) == b"x" * 100_000
    writer.join()


@pytest.mark.skipif(not Path(ENDLESS).exists(), reason=f"no {ENDLESS} here")
def test_what_never_ends_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SceneError):
        load_scene(ENDLESS)
    with pytest.raises(FaultPlanError):
        load_plan(ENDLESS)
    assert main(["demo", "--scene", ENDLESS, "--out", str(tmp_path)]) == 1
    assert "longer than" in capsys.readouterr().err


def test_a_file_is_the_old_one_until_the_new_one_is_whole(tmp_path: Path) -> None:
    result = tmp_path / "map.png"
    result.write_text("before")
    with written_whole(result) as fresh:
        assert fresh.suffix == ".png"  # what writes pictures goes by it
        fresh.write_text("af")
        assert result.read_text() == "before"
        fresh.write_text("after")
    assert result.read_text() == "after"
    assert list(tmp_path.iterdir()) == [result]


@pytest.mark.parametrize(
    "ending", [OSError(errno.ENOSPC, "disk full"), StopRequestedError(signal.SIGTERM), ValueError()]
)
def test_what_ends_the_writing_leaves_the_old_file_and_no_half_one(
    ending: BaseException, tmp_path: Path
) -> None:
    result = tmp_path / "summary.json"

    def write() -> None:
        with written_whole(result) as fresh:
            fresh.write_text("half of it")
            raise ending

    for before in ([], [result]):
        with pytest.raises(type(ending)):
            write()
        assert list(tmp_path.iterdir()) == before
        result.write_text("before")
    assert result.read_text() == "before"


def test_the_next_writer_replaces_what_a_killed_one_left(tmp_path: Path) -> None:
    result = tmp_path / "out.json"
    code = (
        "import os, pathlib, sys\n"
        "from xethru_protocol.operating_system import written_whole\n"
        "with written_whole(pathlib.Path(sys.argv[1])) as fresh:\n"
        "    fresh.write_text('a long text of a killed process')\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(result)], timeout=seconds(20))
    assert not result.exists()
    with written_whole(result) as fresh:
        fresh.write_text("new")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("out.json", "new")]


def test_two_do_not_write_one_file_at_a_time(tmp_path: Path) -> None:
    result = tmp_path / "out.json"
    with written_whole(result) as fresh:
        fresh.write_text("first")
        with pytest.raises(OSError, match="another process is writing it"), written_whole(result):
            pytest.fail("both write")
    assert result.read_text() == "first"


def test_what_is_printed_is_not_lost_where_the_result_goes_to_the_same_file(tmp_path: Path) -> None:
    code = (
        "import pathlib\n"
        "from xethru_protocol.operating_system import written_whole\n"
        "with written_whole(pathlib.Path('/dev/stdout')) as fresh:\n"
        "    fresh.open('a').write('result\\n')\n"
        "print('the table behind it')\n"
    )
    printed = tmp_path / "printed"
    with printed.open("a") as stream:
        command = [sys.executable, "-c", code]
        subprocess.run(command, stdout=stream, timeout=seconds(20), check=True)
    assert printed.read_text() == "result\nthe table behind it\n"
    assert list(tmp_path.iterdir()) == [printed]


def test_a_lock_that_came_as_its_holder_moved_the_file_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result, fresh = tmp_path / "out.json", tmp_path / ".unfinished.out.json"
    real_lock = fcntl.flock

    def lock_late(descriptor: int, operation: int) -> None:
        if fresh.exists():
            fresh.replace(result)  # the other process is done just now
        real_lock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", lock_late)
    with pytest.raises(OSError, match="another process is writing it"), written_whole(result):
        pytest.fail("what is written now has no lock")


def test_links_stay_links_and_what_is_no_file_is_written_to_itself(tmp_path: Path) -> None:
    target, link, pipe = (tmp_path / name for name in ("target", "link", "pipe"))
    link.symlink_to(target)
    with written_whole(link) as fresh:
        fresh.write_text("through the link")
    assert link.is_symlink()
    assert target.read_text() == "through the link"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        with written_whole(pipe) as fresh:
            fresh.write_text("to the reader")
        assert os.read(reader, 100) == b"to the reader"
    finally:
        os.close(reader)
    assert pipe.is_fifo()


def write_to_a_pipe(pipe: Path) -> None:
    with written_whole(pipe) as fresh:
        fresh.write_text("nobody reads it")


def print_to_a_pipe(pipe: Path) -> None:
    keep = os.open(pipe, os.O_RDWR)  # so that no end is missing, and nobody reads
    with os.fdopen(keep, "w") as stream, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", stream)
        Outlet("stdout", 1).write("x" * (1 << 20))


@pytest.mark.parametrize("wait", [read_bounded, write_to_a_pipe, print_to_a_pipe])
def test_a_signal_ends_the_wait_for_a_pipe(wait: Callable[[Path], object], tmp_path: Path) -> None:
    os.mkfifo(pipe := tmp_path / "pipe")
    soon = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGTERM))
    with StopFlag() as stop:
        soon.start()
        with pytest.raises(StopRequestedError) as stopped:
            wait(pipe)
    assert stopped.value.exit_code == 143
    assert stop.received is signal.SIGTERM
    assert StopFlag.entered is None


@contextlib.contextmanager
def terminal_as_stderr() -> Iterator[tuple[int, Outlet]]:
    """Put a real terminal in place of standard error; give its other end and the outlet."""
    master, slave = os.openpty()
    tty.setraw(slave)
    with os.fdopen(slave, "w") as stream, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stderr", stream)
        yield master, Outlet("stderr", slave)
    with contextlib.suppress(OSError):  # closed by the test
        os.close(master)


def test_a_terminal_that_is_gone_takes_nothing_and_raises_nothing() -> None:
    with terminal_as_stderr() as (master, outlet):
        outlet.write("before")
        assert (os.read(master, 100), outlet.failure) == (b"before", None)
        os.close(master)
        for write in (outlet.write, outlet.write_soon, outlet.offer):
            write("after")
            assert outlet.failure is not None
            assert outlet.failure.errno == errno.EIO


@pytest.mark.parametrize("line_length", [7, 79, 1000])
def test_a_terminal_that_blocks_is_not_waited_for(line_length: int) -> None:
    """Nobody reads it until all is written, so this would hang. What is kept comes in order."""
    n = 200_000 // line_length
    with terminal_as_stderr() as (master, outlet):
        for number in range(n):
            outlet.offer(f"{number:>{line_length}}")
        for number in range(50):
            outlet.write_soon(f"warning {number}\n")
        outlet.offer("left out")
        received = b""
        while b"warning 49\n" not in received:
            if select.select([master], [], [], 0.0)[0]:
                received += os.read(master, 65536)
            outlet.write_soon("")
    shown, first, warnings = received.partition(b"warning 0\n")
    numbers = [int(number) for number in shown.split()]
    # each whole, and in order; the system may make room for a few when others were left out
    assert len(shown) == len(numbers) * line_length
    assert numbers == sorted(set(numbers))
    assert 1000 < len(shown) < n * line_length
    assert (first + warnings).decode() == "".join(f"warning {n}\n" for n in range(50))


def test_a_stopped_terminal_gets_no_progress_and_then_its_warnings() -> None:
    """As after Ctrl-S and Ctrl-Q."""
    with terminal_as_stderr() as (master, outlet):
        assert sys.stderr is not None
        termios.tcflow(sys.stderr, termios.TCOOFF)
        outlet.offer("progress")
        outlet.write_soon("warning\n")
        termios.tcflow(sys.stderr, termios.TCOON)
        outlet.offer("progress again")
        expected = b"warning\nprogress again"
        received = b""
        while len(received) < len(expected):
            received += os.read(master, 100)
    assert received == expected


def test_a_pipe_that_nobody_reads_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    read_end, write_end = os.pipe()
    with os.fdopen(read_end, "rb") as reader:
        with os.fdopen(write_end, "w") as stream:
            monkeypatch.setattr(sys, "stderr", stream)
            outlet = Outlet("stderr", write_end)
            for _ in range(3000):
                outlet.offer("x" * 99 + "\n")
            outlet.write_soon("warning\n")
            shown = os.read(read_end, 1 << 20)
            outlet.write("")
            monkeypatch.undo()
        assert set(shown.decode().splitlines()) == {"x" * 99}
        assert reader.read().splitlines()[-1] == b"warning"


def test_a_reader_that_has_ended_is_told_from_other_failures(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    with os.fdopen(write_end, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        outlet = Outlet("stdout", write_end)
        outlet.write("a result")
        assert isinstance(outlet.failure, BrokenPipeError)
        monkeypatch.undo()
    assert outlet.failure is None  # of the stream that is standard output now


@pytest.mark.parametrize(("exit_code", "expected"), [(None, 143), (0, 0)])
@pytest.mark.parametrize("is_early", [False, True])
def test_a_signal_during_imports_ends_the_process_whatever_they_catch(
    exit_code: int | None, expected: int, is_early: bool
) -> None:
    """As numpy does, which makes an ImportError of any error in its C code."""
    kill = "os.kill(os.getpid(), signal.SIGTERM)\n"
    code = (
        "import os, signal\n"
        "from xethru_protocol.operating_system import StopFlag\n"
        "with StopFlag() as stop:\n"
        f"    {kill if is_early else ''}\n"
        f"    with stop.leaving({exit_code}, program='xethru'):\n"
        "        try:\n"
        f"            {kill}\n"
        "        except BaseException as error:\n"
        "            raise ImportError('cannot import') from error\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (expected, "xethru: stopped by SIGTERM\n")
