"""Worker processes and clusters: what they do with signals, and how they fail."""

import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Generator
from pathlib import Path

import pytest

from hil_tests.patience import seconds
from slam.app.cli import main
from slam.app.sweep import workers
from slam.app.sweep.run import make_case, run_case
from slam.app.sweep.workers import _end_workers
from slam.live.errors import AppError

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


def ended(tmp_path: Path, body: str) -> tuple[int, str, str]:
    with started(tmp_path, body) as process:
        output, errors = process.communicate(timeout=LIMIT_S)
    return process.returncode, output, errors


def test_every_worker_begins_with_the_groups_signals_blocked(tmp_path: Path) -> None:
    body = (
        "with worker_results(work, [('mask',)] * 4, 2) as masks:\n"
        "    for mask in masks:\n"
        "        print(*(int(number) for number in mask))\n"
        "print(*(int(one) for one in signal.pthread_sigmask(signal.SIG_BLOCK, ())))\n"
    )
    code, output, errors = ended(tmp_path, body)
    assert (code, errors) == (0, "")
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
    assert ended(tmp_path, body) == (0, "", "")


def test_what_killed_workers_leave_is_removed_without_a_word(tmp_path: Path) -> None:
    body = (
        "from joblib.externals.loky.backend import resource_tracker\n"
        "with worker_results(work, [('pid',)] * 2, 2) as results:\n"
        "    list(results)\n"
        "resource_tracker.register('/gone', 'semlock')\n"
        "print('PYTHONWARNINGS' in os.environ)\n"
    )
    assert ended(tmp_path, body) == (0, "False\n", "")


def test_a_worker_that_dies_breaks_the_results(tmp_path: Path) -> None:
    body = (
        "from concurrent.futures import BrokenExecutor\n"
        "try:\n"
        "    with worker_results(work, [('die',), ('sleep',)], 2) as results:\n"
        "        next(results)\n"
        "except BrokenExecutor:\n"
        "    print('broken')\n"
    )
    assert ended(tmp_path, body) == (0, "broken\n", "")


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
    _end_workers(begun)
    assert bool(told) == is_told
    assert threading.excepthook == told.append


def refused(address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> int:
    """Return the exit code of a sweep on a cluster that cannot be; it is one line on stderr."""
    code = main(["sweep", "--dask", address, "--json", str(tmp_path / "o.json")])
    assert capsys.readouterr().err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
    return code


def test_without_dask_it_is_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert refused("tcp://127.0.0.1:8786", tmp_path, capsys) == 2


@pytest.mark.parametrize("address", ["nowhere", "here://x:1", ""])
def test_an_address_that_is_none_is_2(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed")
    assert refused(address, tmp_path, capsys) == 2


def test_a_scheduler_that_does_not_answer_is_1_in_bounded_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "TIMEOUT_S", 0.5)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        assert refused(f"tcp://127.0.0.1:{taken.getsockname()[1]}", tmp_path, capsys) == 1


def test_somebody_else_at_the_port_is_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "TIMEOUT_S", 2.0)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            client, _ = server.accept()
            with client:
                client.sendall(b"HTTP/1.0 400 Bad Request\r\n\r\n" * 4)

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        assert refused(f"tcp://127.0.0.1:{server.getsockname()[1]}", tmp_path, capsys) == 1
    thread.join(timeout=seconds(5))


def test_a_worker_of_another_version_refuses() -> None:
    with pytest.raises(AppError):
        run_case(make_case("lab", "paper", 0), "of yesterday")
