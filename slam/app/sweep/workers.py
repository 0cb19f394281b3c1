"""Workers of a sweep: processes here, or a Dask cluster.

Ctrl-C and a closing terminal reach the whole process group. Only the parent answers; it ends its
workers itself. So every worker begins with these signals blocked, before its interpreter runs a
first line: a handler of its own would come too late for one that is caught while it starts.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any, TypeVar, cast

import joblib
from joblib.externals.loky.backend import resource_tracker as loky_tracker

from slam.app.errors import UsageError
from slam.live.errors import AppError
from xethru_protocol.operating_system import signal_at_parents_death

_LEFT_TO_THE_PARENT = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}

TIMEOUT_S = 10.0
"""How long a scheduler may take to answer, and then a first worker to be there."""

_Result = TypeVar("_Result")


@contextmanager
def worker_results(
    function: Callable[..., _Result], tasks: Sequence[tuple[object, ...]], n_workers: int
) -> Iterator[Iterator[_Result]]:
    """Start worker processes and hand out the results in the order of the tasks.

    At least one task; ``function``, importable by name, is called with the members of each. Leaving
    the block kills workers that are still at it.
    """
    calls = (joblib.delayed(function)(*task) for task in tasks)
    with (
        _signals_left_to_the_parent(),
        joblib.parallel_config("loky", initializer=_belong_to, initargs=(os.getpid(),)),
    ):
        parallel = joblib.Parallel(n_jobs=min(n_workers, len(tasks)), return_as="generator")
        results = cast("Generator[_Result, None, None]", parallel(calls))
    try:
        yield results
    finally:
        _end_workers(results)


def _end_workers(results: Generator[_Result, None, None]) -> None:
    """End the workers, without joblib's messages about the work that is lost."""
    before = threading.excepthook

    def silent_about_lost_work(crash: threading.ExceptHookArgs) -> None:
        # loky's manager forgets all tasks, kills the workers, and may then look for a task that
        # it had not yet handed out; it then ends, as it should.
        thread = crash.thread.name if crash.thread else ""
        if not (crash.exc_type is KeyError and thread == "ExecutorManagerThread"):
            before(crash)

    threading.excepthook = silent_about_lost_work
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "[0-9]+ tasks", UserWarning)
            results.close()
    finally:
        threading.excepthook = before


@contextmanager
def _signals_left_to_the_parent() -> Iterator[None]:
    """Block signals for this thread, and for processes and threads that it starts, which inherit.

    Blocked and not ignored, so that one that comes meanwhile reaches the parent afterwards. The
    thread in which joblib replaces workers later inherits it, too.
    """
    # Python 3.11's tracker unblocks SIGINT and SIGTERM when it is first needed, that is, when the
    # first worker is about to start. One that runs already does not.
    _start_trackers()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _LEFT_TO_THE_PARENT)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_trackers() -> None:
    """Start the processes that remove what killed workers leave behind, without warnings.

    They would warn on stderr about each semaphore that is left or was removed before.
    """
    before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, (before, "ignore:resource_tracker")))
    try:
        resource_tracker.ensure_running()
        loky_tracker.ensure_running()
    finally:
        if before is None:
            del os.environ["PYTHONWARNINGS"]
        else:
            os.environ["PYTHONWARNINGS"] = before


def _belong_to(parent: int) -> None:
    """Make this worker die with its parent, also when that is killed; Linux only."""
    end_with_parent = signal_at_parents_death(signal.SIGKILL)
    if end_with_parent is not None:
        end_with_parent()
    if os.getppid() != parent:  # it died before we asked
        os._exit(1)


@contextmanager
def dask_results(
    function: Callable[..., _Result], tasks: Sequence[tuple[object, ...]], address: str
) -> Iterator[Iterator[_Result]]:
    """Hand tasks to the Dask scheduler at an address like "tcp://10.0.0.5:8786"; results in order.

    ``function``, importable by name on every worker, is called with the members of each of the
    tasks, of which there is at least one. Leaving the block cancels what is not done.

    Raises UsageError if the address is invalid, ModuleNotFoundError without Dask, AppError if no
    scheduler or no worker answers there; AppError while results are awaited if the scheduler goes
    away or a task takes down every worker that it is given to.
    """
    client = _connect(address)
    futures: list[Any] = []
    try:
        futures += [client.submit(function, *task, pure=False) for task in tasks]
        yield _in_order(futures, address)
    finally:
        client.cancel(futures, force=True)
        client.close(timeout=TIMEOUT_S)


def _connect(address: str) -> Any:  # noqa: ANN401 - Dask is optional
    import distributed  # heavy, and an extra

    # what goes wrong becomes one line of ours
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        client: Any = cast(Any, distributed.Client)(address, timeout=TIMEOUT_S)
    except ValueError as error:
        raise UsageError(f"--dask {address}: {error}; write it as tcp://HOST:PORT") from None
    except (OSError, MemoryError):  # MemoryError: something answers, in another language
        raise AppError(
            f"--dask {address}: no Dask scheduler answers there; start one with `dask scheduler`"
        ) from None
    try:
        client.wait_for_workers(1, timeout=TIMEOUT_S)
    except TimeoutError:
        client.close(timeout=TIMEOUT_S)
        raise AppError(
            f"--dask {address}: the scheduler has no worker; start some with "
            f"`dask worker {address}`"
        ) from None
    return client


def _in_order(futures: Sequence[Any], address: str) -> Iterator[Any]:
    from distributed import KilledWorker

    for future in futures:
        try:
            yield future.result()
        except KilledWorker:
            raise AppError(f"--dask {address}: a run took down several workers") from None
        except CancelledError:
            raise AppError(f"--dask {address}: the scheduler has gone") from None
        except ImportError as error:
            raise AppError(
                f"--dask {address}: a worker cannot import {error.name}; install xethru-hil there, "
                "with the same extras"
            ) from None
        future.release()
