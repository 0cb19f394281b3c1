"""Where running emulators leave word of themselves, so that other programs find their ports.

The run directory (`xethru_protocol.ports.run_directory`) holds one ``<pid>.json`` per running
emulator: its ready line with a ``pid`` added; and the ports of those that were given no directory.
What belongs to a process that is gone is stale, and removed by the next emulator that starts.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import stat
import tempfile
from pathlib import Path
from typing import Any

from xethru_protocol.ports import is_running, run_directory

__all__ = ["Announcement", "fresh_port_folder"]

_PORTS = "ports-"


def fresh_port_folder() -> Path:
    """Create an empty directory for the ports of this process."""
    return Path(tempfile.mkdtemp(prefix=f"{_PORTS}{os.getpid()}-", dir=_private_run_directory()))


def _private_run_directory() -> Path | None:
    """Create the folder; None when it cannot be made or belongs to somebody else."""
    folder = run_directory()
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return None
    return folder if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() else None


class Announcement:
    """The entry of this process, until closed.

    Without a usable folder nothing is announced: the ports work all the same.
    """

    def __init__(self, ready: dict[str, Any]) -> None:
        self._path: Path | None = None
        folder = _private_run_directory()
        if folder is None:
            return
        _remove_stale(folder)
        self._path = folder / f"{os.getpid()}.json"
        self.update(ready)

    def update(self, ready: dict[str, Any]) -> None:
        """Say something else from now on; who reads it sees the old word or the new one."""
        if self._path is None:
            return
        with contextlib.suppress(OSError):
            fresh = self._path.with_suffix(".new")
            fresh.write_text(json.dumps({"pid": os.getpid(), **ready}) + "\n")
            fresh.replace(self._path)

    def close(self) -> None:
        """Remove the entry."""
        if self._path is not None:
            with contextlib.suppress(OSError):
                self._path.unlink()
            self._path = None


def _remove_stale(folder: Path) -> None:
    # one that was killed while it wrote leaves a .new
    for entry in (*folder.glob("*.json"), *folder.glob("*.new")):
        if _is_dead(entry.stem):
            with contextlib.suppress(OSError):
                entry.unlink()
    for ports in folder.glob(f"{_PORTS}*"):
        if _is_dead(ports.name.removeprefix(_PORTS).partition("-")[0]):
            shutil.rmtree(ports, ignore_errors=True)


def _is_dead(pid: str) -> bool:
    # What bears no process number is not ours: leave it alone.
    return pid.isdigit() and not is_running(int(pid))
