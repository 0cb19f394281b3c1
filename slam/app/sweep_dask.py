"""Results of tasks from the workers of a Dask cluster, like `slam.app.workers` from processes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from typing import Any, TypeVar, cast

from slam.app.errors import AppError, UsageError

PATIENCE_S = 10.0
"""How long a scheduler may take to answer, and then a first worker to be there."""

_Result = TypeVar("_Result")


class ClusterLostError(Exception):
    """The scheduler went away, or a task took every worker down that it was given to."""


@contextmanager
def dask_results(
    function: Callable[..., _Result], tasks: Sequence[tuple[object, ...]], address: str
) -> Iterator[Iterator[_Result]]:
    """Hand tasks to a Dask cluster, and hand out the results in the order of the tasks.

    Leaving the block cancels what is not done.

    Parameters
    ----------
    function
        Called with the members of each task; importable by name on every worker.
    tasks
        At least one.
    address
        Of the scheduler, as "tcp://10.0.0.5:8786".

    Raises
    ------
    UsageError
        The address is none, or Dask is not installed.
    AppError
        Nobody answers there, or there is no worker.
    ClusterLostError
        See there; while results are awaited.
    """
    client = _connect(address)
    futures: list[Any] = []
    try:
        futures += [client.submit(function, *task, pure=False) for task in tasks]
        yield _in_order(futures, address)
    finally:
        client.cancel(futures, force=True)
        client.close(timeout=PATIENCE_S)


def _connect(address: str) -> Any:  # noqa: ANN401 - Dask is not there where nobody wants it
    try:
        import distributed  # heavy, and an extra
    except ImportError:
        raise UsageError("--dask: Dask is missing; pip install 'xethru-hil[dask]'") from None
    # what goes wrong becomes one line of ours
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        client: Any = cast(Any, distributed.Client)(address, timeout=PATIENCE_S)
    except ValueError as error:
        raise UsageError(f"--dask {address}: {error}; write it as tcp://HOST:PORT") from None
    except (OSError, MemoryError):  # MemoryError: something answers, in another language
        raise AppError(
            f"--dask {address}: no Dask scheduler answers there; start one with `dask scheduler`"
        ) from None
    try:
        client.wait_for_workers(1, timeout=PATIENCE_S)
    except TimeoutError:
        client.close(timeout=PATIENCE_S)
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
            raise ClusterLostError(f"--dask {address}: a run took down several workers") from None
        except CancelledError:
            raise ClusterLostError(f"--dask {address}: the scheduler has gone") from None
        except ImportError as error:
            raise ClusterLostError(
                f"--dask {address}: a worker cannot import {error.name}; install xethru-hil there"
            ) from None
        future.release()
