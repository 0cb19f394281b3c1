"""The emulator as a process of its own, owned by this one: started, watched, always ended."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from slam.app.errors import EmulatorError
from slam.app.parent_death import signal_at_parents_death

READY_LIMIT_S = 30.0
_POLL_S = 0.2
END_LIMIT_S = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class EmulatedDevice:
    """One emulated module, as the ready line names it; `start_skew_ns` is that of its samples."""

    name: str
    path: str
    serial: str
    start_skew_ns: int


class EmulatorProcess:
    """Runs `xethru-emulator serve` in its own process group while it is entered.

    The group keeps Ctrl-C for us: we stop reading first and end the emulator afterwards. It removes
    its links when it ends; if it was killed, we remove them.

    Parameters
    ----------
    scene
        Name or file of the scene.
    seed
        Seed of noise and odometry.

    """

    def __init__(self, scene: str, seed: int) -> None:
        self._scene, self._seed = scene, seed
        self._cleanup = contextlib.ExitStack()
        self.devices: tuple[EmulatedDevice, ...] = ()
        self.odometry_socket = ""
        self._control_socket = ""

    def __enter__(self) -> Self:
        """Start the process; its ports are there after `wait_until_ready`."""
        with self._cleanup:
            self._errors: IO[bytes] = self._cleanup.enter_context(tempfile.TemporaryFile())
            # -P: a folder "emulator" where the user happens to stand must not come first
            command = [sys.executable, "-P", "-m", "emulator.cli", "serve", self._scene]
            command += ["--pace", "asap", "--seed", str(self._seed)]
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                process_group=0,
                preexec_fn=signal_at_parents_death(signal.SIGTERM),
            )
            self._cleanup.callback(self._end)
            self._cleanup = self._cleanup.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Do what `end` does."""
        self.end()

    def end(self) -> None:
        """End the process, by force if it does not listen, and remove its links; only once."""
        self._cleanup.close()

    def ended(self) -> str | None:
        """Return what became of the process if it is gone, else None."""
        try:
            code = self._process.wait(timeout=_POLL_S)
        except subprocess.TimeoutExpired:
            return None
        how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
        return f"the emulator ended {how}{self._last_words()}"

    def wait_until_ready(self, check: Callable[[], None]) -> None:
        """Read the ready line, which names ports and odometry socket.

        Parameters
        ----------
        check
            Called again and again while waiting; may raise to stop.

        Raises
        ------
        EmulatorError
            The process ended, or said nothing in time.
        """
        output = self._process.stdout
        assert output is not None
        line = b""
        give_up = time.monotonic() + READY_LIMIT_S
        while not line.endswith(b"\n"):
            check()
            if time.monotonic() > give_up:
                raise EmulatorError(f"the emulator was not ready after {READY_LIMIT_S:g} s")
            if select.select([output], [], [], _POLL_S)[0]:
                part = os.read(output.fileno(), 65536)
                if not part:
                    raise EmulatorError(self.ended() or "the emulator closed its output")
                line += part
        try:
            ready = json.loads(line)
            self.devices = tuple(
                EmulatedDevice(
                    name=row["name"],
                    path=row["path"],
                    serial=row["serial"],
                    start_skew_ns=row["start_skew_ns"],
                )
                for row in ready["devices"]
            )
            self.odometry_socket = ready["odometry"]
            self._control_socket = ready["control"]
        except (ValueError, KeyError, TypeError):
            raise EmulatorError(f"the emulator's ready line is unknown: {line[:200]!r}") from None

    def _last_words(self) -> str:
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        return f": {said[-1]}" if said else ""

    def _end(self) -> None:
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._process.terminate()
        try:
            self._process.wait(timeout=END_LIMIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._remove_links()

    def _remove_links(self) -> None:
        left = [Path(device.path) for device in self.devices]
        left += [Path(path) for path in (self.odometry_socket, self._control_socket) if path]
        for path in left:
            path.unlink(missing_ok=True)
        for folder in {path.parent for path in left}:
            with contextlib.suppress(OSError):  # gone already, or somebody else uses it
                folder.rmdir()
