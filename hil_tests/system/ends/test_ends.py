"""Program by ending by moment: what an ended program leaves is whole, and nothing else is left."""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from hil_tests.device.emulator_process import open_radar
from hil_tests.system.ends.programs import (
    Ending,
    Stage,
    check_nothing_is_left,
    end,
    started,
    wait_for_end,
)
from hil_tests.system.ends.trials import NAMES, run_trials

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc (Linux)"),
]

RARE, THOROUGH = pytest.mark.rare, pytest.mark.thorough
INT, TERM, HANG_UP, NO_HANG_UP = Ending.INT, Ending.TERM, Ending.HANG_UP, Ending.NO_HANG_UP
UNDER_WAY = "under_way"
CTRL_S, CTRL_Q = b"\x13", b"\x11"

# Programs, endings, and moments: seconds after the program has its handlers of signals.
DEFAULT = [
    ("record", NO_HANG_UP, UNDER_WAY),
    ("serve", HANG_UP, UNDER_WAY),
    ("serve", INT, 0.0),
]
SELDOM = [
    ("record", HANG_UP, UNDER_WAY),
    ("serve", TERM, 0.4),
    ("run", HANG_UP, UNDER_WAY),
    ("sweep", INT, UNDER_WAY),
    ("convert", NO_HANG_UP, 0.0),
    ("serve", TERM, 0.05),
    ("serve", INT, 0.2),
    ("serve", INT, 0.8),
]
OTHERS = [
    ("demo", HANG_UP, UNDER_WAY),
    ("run", NO_HANG_UP, UNDER_WAY),
    ("stream", HANG_UP, UNDER_WAY),
    ("stream", NO_HANG_UP, UNDER_WAY),
    ("sweep", HANG_UP, UNDER_WAY),
    *(("serve", ending, UNDER_WAY) for ending in (INT, TERM, NO_HANG_UP)),
    *((name, ending, UNDER_WAY) for name in ("play", "proxy") for ending in (HANG_UP, NO_HANG_UP)),
    *(("serve", TERM, moment_s) for moment_s in (0.0, 0.2, 0.8)),
    *(("serve", INT, moment_s) for moment_s in (0.05, 0.4)),
    *(
        (name, NO_HANG_UP, 0.0)
        for name in ("demo", "sweep", "replay", "report", "view", "calibrate", "repair")
    ),
]
TABLE = [
    pytest.param(*row, marks=marks, id=f"{row[0]}-{row[1].name}-{row[2]}")
    for rows, marks in ((DEFAULT, ()), (SELDOM, RARE), (OTHERS, THOROUGH))
    for row in rows
]


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    with ExitStack() as stack:
        yield Stage(tmp_path_factory.mktemp("stage"), stack, n_sweep_runs=50)


@pytest.mark.parametrize(("name", "ending", "moment"), TABLE)
def test_a_program_that_is_ended_leaves_what_it_should(
    name: str, ending: Ending, moment: str | float, stage: Stage, tmp_path: Path
) -> None:
    program = stage.program(name)
    (folder := tmp_path / "out").mkdir()
    stays = ending is NO_HANG_UP
    with started(program, tmp_path, folder, ignores_hangup=stays) as command:
        if isinstance(moment, str):
            command.read_until(lambda: program.is_under_way(folder, command.printed))
        else:  # before that it is the interpreter that starts, and no program can answer
            command.wait_for_handlers()
            time.sleep(moment)
        at_unix_s = time.time()
        end(command, ending)
        if stays and program.serves:
            answers(folder)
            command.process.terminate()
        ended = wait_for_end(command, folder, ending, at_unix_s)
    assert ended.code in program.codes(ending)
    check_nothing_is_left(tmp_path, folder)
    program.check(ended)
    if stays:
        program.result(folder)


def answers(folder: Path) -> None:
    """Ping a module of an emulator."""
    (link, *_) = (path for path in (folder / "links").iterdir() if path.suffix != ".sock")
    with open_radar(str(link)) as radar:
        radar.ping()


@THOROUGH
def test_a_stopped_terminal_stops_no_demo(stage: Stage, tmp_path: Path) -> None:
    """Ctrl-S holds back what is printed, until Ctrl-Q; the results are there before."""
    (folder := tmp_path / "out").mkdir()
    with started(stage.demo, tmp_path, folder) as command:
        command.wait_for_handlers()
        command.press(CTRL_S)
        command.read_until((folder / "map.png").exists)
        assert command.process.poll() is None, "it waits for the terminal now"
        assert command.printed == b""
        command.press(CTRL_Q)
        ended = wait_for_end(command, folder, None, 0.0)
    assert ended.code == 0
    stage.demo.check(ended)
    stage.demo.result(folder)


@THOROUGH
@pytest.mark.timeout(2000)
@pytest.mark.parametrize("ending", [Ending.KILL, TERM, HANG_UP, Ending.FULL_DISK])
def test_programs_can_be_ended_at_any_time(ending: Ending) -> None:
    findings = run_trials(len(NAMES), 6, endings=[ending])
    assert findings.problems == []
