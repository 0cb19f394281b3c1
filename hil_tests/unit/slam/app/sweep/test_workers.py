"""Worker processes: deaf to the signals of their group from the start, gone with their parent."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Generator
from pathlib import Path

import pytest

from hil_tests.patience import seconds
from slam.app.sweep.workers import _throw_away

LIMIT_S = seconds(15)
OUTLASTS_S = 10 * LIMIT_S

SCRIPT = f"""\
import os, signal, sys, time
from slam.app.sweep.workers import worker_results

def work(task):
    if task == "mask":
        return sorted(signal.pthread_sigmask(signal.SIG_BLOCK, ()))
    if task == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if task == "sleep":
        time.sleep({OUTLASTS_S})
    return os.getpid()

if __name__ == "__main__":
"""


def started(tmp_path: Path, body: str) -> subprocess.Popen[str]:
    """Start a fresh interpreter, where nothing of multiprocessing runs yet."""
    script = tmp_path / "main.py"
    script.write_text(SCRIPT + "".join(f"    {line}\n" for line in body.splitlines()))
    return subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
    )


def test_every_worker_begins_with_the_groups_signals_blocked(tmp_path: Path) -> None:
    body = (
        "with worker_results(work, [('mask',)] * 4, 2) as masks:\n"
        "    for mask in masks:\n"
        "        print(*(int(number) for number in mask))\n"
        "print(*(int(one) for one in signal.pthread_sigmask(signal.SIG_BLOCK, ())))\n"
    )
    with started(tmp_path, body) as process:
        output, errors = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, errors) == (0, "")
    blocked = sorted((signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
    *workers, parent = output.split("\n")[:-1]
    assert workers == [" ".join(str(int(number)) for number in blocked)] * 4
    assert parent == "", "the parent itself hears signals again"


@pytest.mark.skipif(sys.platform != "linux", reason="the parent's death is a signal on Linux only")
def test_no_worker_survives_a_killed_parent(tmp_path: Path) -> None:
    body = (
        "with worker_results(work, [('pid',), ('sleep',), ('sleep',)], 2) as results:\n"
        "    print(next(results), flush=True)\n"
        f"    time.sleep({OUTLASTS_S})\n"
    )
    with started(tmp_path, body) as process:
        assert process.stdout is not None
        assert process.stdout.readline().strip().isdigit()
        process.kill()
        # every worker holds these pipes: they end when the last of them has, or this times out
        process.communicate(timeout=LIMIT_S)


def test_work_that_is_thrown_away_ends_at_once_and_without_a_word(tmp_path: Path) -> None:
    body = (
        "with worker_results(work, [('sleep',)] * 20, 2) as results:\n"
        "    pass\n"
        "with worker_results(work, [('pid',)] + [('sleep',)] * 20, 2) as results:\n"
        "    next(results)\n"
    )
    with started(tmp_path, body) as process:
        output, errors = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, output, errors) == (0, "", "")


def test_what_killed_workers_leave_is_removed_without_a_word(tmp_path: Path) -> None:
    body = (
        "from joblib.externals.loky.backend import resource_tracker\n"
        "with worker_results(work, [('pid',)] * 2, 2) as results:\n"
        "    list(results)\n"
        "resource_tracker.register('/gone', 'semlock')\n"
        "print('PYTHONWARNINGS' in os.environ)\n"
    )
    with started(tmp_path, body) as process:
        output, errors = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, output, errors) == (0, "False\n", "")


def test_a_worker_that_dies_breaks_the_results(tmp_path: Path) -> None:
    body = (
        "from concurrent.futures import BrokenExecutor\n"
        "try:\n"
        "    with worker_results(work, [('die',), ('sleep',)], 2) as results:\n"
        "        next(results)\n"
        "except BrokenExecutor:\n"
        "    print('broken')\n"
    )
    with started(tmp_path, body) as process:
        output, errors = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, output, errors) == (0, "broken\n", "")


@pytest.mark.parametrize(
    ("thread", "error", "is_told"),
    [
        ("ExecutorManagerThread", KeyError(3), False),
        ("ExecutorManagerThread", ValueError(3), True),
        ("somebody else", KeyError(3), True),
    ],
)
def test_only_the_managers_search_for_lost_work_is_silent(
    thread: str, error: Exception, is_told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", told.append)

    def crash() -> None:
        raise error

    def results() -> Generator[int, None, None]:
        try:
            yield 1
        finally:  # as joblib: the thread is joined before close returns
            manager = threading.Thread(target=crash, name=thread)
            manager.start()
            manager.join()

    begun = results()
    next(begun)
    _throw_away(begun)
    assert bool(told) == is_told
    assert threading.excepthook == told.append
