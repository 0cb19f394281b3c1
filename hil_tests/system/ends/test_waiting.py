"""Commands that wait: for a pipe, a silent module, or a terminal that takes no more text.

Every command of every program is in a table, with what it waits for. A signal ends it.
"""

import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import cache
from pathlib import Path

import pytest

import emulator.cli
import slam.app.cli
import xethru_protocol.cli
from hil_tests.system.ends.programs import (
    CTRL_C,
    EMULATOR,
    UWB_SLAM,
    XETHRU,
    Program,
    check_nothing_is_left,
    started,
)
from hil_tests.system.recorded_session import record_session
from hil_tests.system.terminal import Command

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc (Linux)"),
]

CTRL_S = b"\x13"
MAINS = {UWB_SLAM: slam.app.cli.main, XETHRU: xethru_protocol.cli.main, EMULATOR: emulator.cli.main}

# Words in capitals are replaced: PIPE, which nobody else opens; SILENT, a port without a module;
# DEAF, a socket that nobody reads; SESSION; TRACK, a TUM file; OUT, a new name.
# The last column says whether it is the terminal that the command waits for.
ROWS = [
    (UWB_SLAM, "demo --scene PIPE --out OUT", False),
    (UWB_SLAM, "run --rig PIPE --odometry -", False),
    (UWB_SLAM, "sweep --scene PIPE --json OUT", False),
    (UWB_SLAM, "evaluate PIPE TRACK", False),
    (UWB_SLAM, "evaluate TRACK TRACK", True),
    (UWB_SLAM, "benchmark plaza --data OUT", True),
    (UWB_SLAM, "calibrate SESSION --rig PIPE", False),
    (UWB_SLAM, "calibrate SESSION --reflectors PIPE", False),
    (UWB_SLAM, "report SESSION --out PIPE", False),
    (UWB_SLAM, "report SESSION --out OUT", True),
    (UWB_SLAM, "view SESSION --out OUT", True),
    (UWB_SLAM, "replay SESSION --out OUT", True),
    (UWB_SLAM, "repair SESSION --out OUT", True),
    (UWB_SLAM, "convert SESSION OUT", True),
    (UWB_SLAM, "image SESSION --path odometry --out OUT", True),
    (UWB_SLAM, "map show PIPE", False),
    (XETHRU, "list", True),
    *((XETHRU, f"{name} --port SILENT", False) for name in ("doctor", "ping", "info", "reset")),
    (XETHRU, "stream --port SILENT", False),
    (XETHRU, "view --port SILENT --terminal", False),
    (XETHRU, "vital --port SILENT", False),
    (XETHRU, "record --port SILENT --out OUT", False),
    (XETHRU, "flash --port SILENT --yes PIPE", False),
    (XETHRU, "share --port SILENT --tcp 0", True),
    (XETHRU, "dump SESSION", True),
    (XETHRU, "convert SESSION OUT.mcap", True),
    (XETHRU, "export kaitai", True),
    (XETHRU, "legacy PIPE", False),
    (XETHRU, "decode PIPE", False),
    (EMULATOR, "serve PIPE", False),
    (EMULATOR, "serve smoke --truth PIPE", False),
    (EMULATOR, "serve smoke", True),
    (EMULATOR, "play SESSION", True),
    (EMULATOR, "proxy --port SILENT", True),
    (EMULATOR, "ctl DEAF state", False),
    (EMULATOR, "faults", True),
    (EMULATOR, "options", True),
]
DEFAULT = {"evaluate PIPE TRACK-SIGINT", "serve smoke-SIGTERM", "ping --port SILENT-SIGTERM"}
CASES = [
    (row, ending, f"{row[1]}-{ending}")
    for row in ROWS
    # Ctrl-C also lets a terminal go on
    for ending in (("SIGTERM",) if row[2] else ("SIGTERM", "SIGINT"))
]
TABLE = [
    pytest.param(row, ending, marks=() if name in DEFAULT else pytest.mark.rare, id=name)
    for row, ending, name in CASES
]


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Callable[[Path], Path]]]:
    folder = tmp_path_factory.mktemp("waiting")
    track = folder / "track.tum"

    @cache
    def session() -> Path:
        record_session(folder / "session.mcap", "paper")
        return folder / "session.mcap"

    track.write_text("".join(f"{row}.0 {row} 0 0 0 0 0 1\n" for row in range(9)))
    with ExitStack() as stack:
        ends = os.openpty()
        for descriptor in ends:
            stack.callback(os.close, descriptor)
        deaf = stack.enter_context(socket.socket(socket.AF_UNIX))
        deaf.bind(str(folder / "deaf"))
        deaf.listen()
        yield {
            "PIPE": pipe_in,
            "SILENT": lambda place: Path(os.ttyname(ends[1])),
            "DEAF": lambda place: folder / "deaf",
            "SESSION": lambda place: session(),
            "TRACK": lambda place: track,
            "OUT": lambda place: place / "new",
            "OUT.mcap": lambda place: place / "new.mcap",
        }


def pipe_in(folder: Path) -> Path:
    os.mkfifo(folder / "pipe")
    return folder / "pipe"


def wait_until_it_waits(command: Command) -> None:
    """Return when the main thread is asleep, and stays so without using the processor."""
    seen: list[Sequence[str]] = []

    def rests() -> bool:
        process = command.process.pid
        row = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        seen.append((row[0], row[11], row[12]))  # state, ticks of user and system
        return seen[-1][0] == "S" and len(seen) > 20 and len(set(seen[-20:])) == 1

    command.read_until(rests)


@pytest.mark.parametrize(("row", "ending"), TABLE)
def test_a_command_that_waits_is_ended_by_a_signal(
    row: tuple[str, str, bool],
    ending: str,
    words: dict[str, Callable[[Path], Path]],
    tmp_path: Path,
) -> None:
    module, line, is_terminal = row
    (folder := tmp_path / "out").mkdir()
    arguments = [words[word](folder) if word in words else word for word in line.split()]
    program = Program(module=module, arguments=lambda out: arguments)
    which = signal.Signals[ending]
    with started(program, tmp_path, folder) as command:
        if is_terminal:
            command.press(CTRL_S)
        wait_until_it_waits(command)
        if ending == "SIGINT":
            command.press(CTRL_C)
        else:
            command.process.send_signal(which)
        ended_s = time.monotonic()
        code = command.process.wait(timeout=60)
        command.read()
    assert not command.tracebacks
    serves = line.split()[0] in {"serve", "play", "proxy", "share"}
    # by the signal itself: after the program gave its handlers back, or where it has none
    assert code in ({0} if serves else {128 + which, -which}), f"{time.monotonic() - ended_s:.1f} s"
    check_nothing_is_left(tmp_path, folder)
    assert not list(folder.rglob(".unfinished*"))


@pytest.mark.parametrize("module", MAINS)
def test_every_command_is_in_the_table(module: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        MAINS[module](["--help"])
    commands = re.findall(r"(?m)^    ([a-z]+)(?:$| )", capsys.readouterr().out)
    assert set(commands) == {line.split()[0] for program, line, _ in ROWS if program == module}
