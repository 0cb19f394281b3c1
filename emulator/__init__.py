"""An X4M300 to any program that opens its pty, playing back echo scenes.

::

    from emulator import emulated_port
    from xethru_protocol import X4M300

    with emulated_port("lab") as port, X4M300.open(port) as radar:
        radar.configure_raw()
        radar.start(17)
        frame = radar.read_frame()
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from xethru_protocol.operating_system import signal_at_parents_death

__all__ = ["control", "emulated_port"]

_END_LIMIT_S = 10.0


@contextmanager
def emulated_port(scene: str | Path | None = None, *options: str) -> Iterator[str]:
    """Run ``xethru-emulator serve`` until the block ends; yield the port of its first module.

    The ports of the scene's other modules are beside it, under the names that the scene gives them.

    Parameters
    ----------
    scene
        Name or TOML file; None: an empty room with one module.
    options
        More options of the command, such as ``"--pace", "asap"``.

    Raises
    ------
    RuntimeError
        If the emulator does not start; it has written the reason to stderr.
    """
    what = "--bare" if scene is None else os.fspath(scene)
    with running("serve", what, *options) as (_, ready):
        yield ready["devices"][0]["path"]


@contextmanager
def running(*arguments: str | Path) -> Iterator[tuple[subprocess.Popen[str], dict[str, Any]]]:
    """Run ``xethru-emulator`` until the block ends; yield its process and its ready line.

    Raises
    ------
    RuntimeError
        If it does not start; it has written the reason to stderr.
    """
    # -P: a folder "emulator" where the user happens to stand must not come first
    command = [sys.executable, "-P", "-m", "emulator.cli", *map(str, arguments)]
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        process_group=0,  # Ctrl-C ends the block, which stops the module before it goes away
        preexec_fn=signal_at_parents_death(signal.SIGTERM),
    ) as process:
        assert process.stdout is not None
        try:
            ready = process.stdout.readline()
            if not ready:
                raise RuntimeError(f"the emulator did not start: exit code {process.wait()}")
            yield process, json.loads(ready)
        finally:
            process.terminate()
            try:
                process.wait(_END_LIMIT_S)
            except subprocess.TimeoutExpired:
                process.kill()


def control(port: str | Path, request: str) -> dict[str, Any]:
    """Ask a running emulator for what ``xethru-emulator ctl`` does; return its answer.

    ``control(port, "unplug 2")`` unplugs for two seconds, ``control(port, "fault add stall
    seconds=1.5")`` adds a fault, and ``control(port, "state")["radars"]`` is what every module of
    the emulator does. A request is for all of them.

    Raises
    ------
    ValueError
        If there is no such request, or the emulator refuses it.
    OSError
        If no emulator has the port.
    """
    from emulator.cli import ask, request_of, socket_of

    path = socket_of(Path(port))
    try:
        answer: dict[str, Any] = json.loads(ask(path, request_of(request.split())))
    except OSError as error:
        raise OSError(
            error.errno, f"no emulator answers: {error.strerror or error}", str(path)
        ) from None
    if not answer["ok"]:
        raise ValueError(answer["error"])
    return answer
