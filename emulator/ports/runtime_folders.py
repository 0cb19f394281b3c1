"""Folders of a running emulator: links and sockets, where it announces itself, saved flash.

The run directory (`xethru_protocol.transport.run_directory`) holds one ``<pid>.json`` per running
emulator: its ready line with a ``pid`` added; and the ports of those that were given no directory.
What belongs to a process that is gone is stale, and removed by the next emulator that starts.

A document is replaced as a whole, so that a crash of the emulator leaves the old one or the new
one. What cannot be read is reported in one line and left alone until the module saves; the module
starts as shipped.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from emulator.module.memory import SavedState
from emulator.ports.pty import LinkError
from xethru_protocol.operating_system import PathInUseError, locked
from xethru_protocol.transport import is_private, is_running, run_directory
from xethru_protocol.validation import problem_text, reason_of

_PORTS = "ports-"
_FIRST_SERIAL = "first_serial"  # a file of a directory of states


def fresh_port_folder() -> Path:
    return Path(tempfile.mkdtemp(prefix=f"{_PORTS}{os.getpid()}-", dir=_private_run_directory()))


def _private_run_directory() -> Path | None:
    """Create the folder; None when it cannot be made or is not this user's alone."""
    folder = run_directory()
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError:
        return None
    return folder if is_private(folder) else None


def announcement(cleanup: contextlib.ExitStack) -> Callable[[dict[str, Any]], None]:
    """Return what announces a ready line in the place of the last one, until ``cleanup``.

    Without a usable folder nothing is announced: the ports work all the same.
    """
    folder = _private_run_directory()
    if folder is None:
        return lambda ready: None
    _remove_stale(folder)
    path = folder / f"{os.getpid()}.json"

    def announce(ready: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):
            fresh = path.with_suffix(".new")
            fresh.write_text(json.dumps({"pid": os.getpid(), **ready}) + "\n")
            fresh.replace(path)

    def remove() -> None:
        with contextlib.suppress(OSError):
            path.unlink()

    cleanup.callback(remove)
    return announce


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
    # A name without a process number is not ours: leave it alone.
    return pid.isdigit() and not is_running(int(pid))


LONGEST_SOCKET_PATH = 100  # bytes; Linux takes 107, macOS 103


@contextlib.contextmanager
def link_folder(wanted: Path | None) -> Iterator[Path]:
    """Provide the directory of the links; remove it afterwards if we made it and it is empty.

    A given directory serves one running emulator: a second one would take its names over.
    """
    if wanted is None:
        folder = fresh_port_folder()
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        return
    existed = wanted.exists()
    with contextlib.ExitStack() as held:
        try:
            wanted.mkdir(parents=True, exist_ok=True)
            held.enter_context(locked(wanted))
        except OSError as error:
            raise LinkError(
                f"{wanted}: cannot make the link directory: {error.strerror}"
            ) from error
        except PathInUseError as error:
            raise LinkError(
                f"{wanted}: a running emulator has its links there; choose another --link-dir"
            ) from error
        try:
            yield wanted.absolute()
        finally:
            if not existed:
                with contextlib.suppress(OSError):  # it is used otherwise, too
                    wanted.rmdir()


def socket_path(folder: Path, cleanup: contextlib.ExitStack, name: str) -> Path:
    """Return where a socket goes: among the links, if the kernel takes such a path."""
    path = folder / name
    if _fits(path):
        return path
    for parent in (tempfile.gettempdir(), "/tmp"):  # the former may be as long
        if _fits(Path(parent) / "xethru-12345678" / name):
            with contextlib.suppress(OSError):
                short = Path(tempfile.mkdtemp(prefix="xethru-", dir=parent))
                cleanup.callback(shutil.rmtree, short, ignore_errors=True)
                return short / name
    raise LinkError(
        f"{path}: too long for the {path.stem} socket, {LONGEST_SOCKET_PATH} bytes at most; "
        "choose a shorter --link-dir or TMPDIR"
    )


def _fits(path: Path) -> bool:
    return len(os.fsencode(path)) <= LONGEST_SOCKET_PATH


def make_state_directory(directory: Path) -> None:
    """Make a directory of states; `LinkError` now if nothing could be kept there."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if not os.access(directory, os.R_OK | os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise LinkError(
            f"{directory}: cannot keep state there: {error.strerror}; choose another --state-dir"
        ) from error


def kept_first_serial(directory: Path, block: int) -> int | None:
    """Return the serial number with which earlier bare modules here began; None without any."""
    with contextlib.suppress(OSError, ValueError):
        return int((directory / _FIRST_SERIAL).read_text())
    states = directory.glob(f"1{'[0-9]' * 11}.json")  # all that older versions kept
    return min((int(path.stem) // block * block for path in states), default=None)


def keep_first_serial(directory: Path, first: int) -> None:
    try:
        (directory / _FIRST_SERIAL).write_text(f"{first}\n")
    except OSError as error:
        raise LinkError(f"{directory}: cannot keep serial numbers: {error.strerror}") from error


class DirectoryMemory:
    """Keeps the flash of one module in a directory.

    Parameters
    ----------
    directory
        Where the documents of all modules are; made if it is missing.
    warn
        Called with one line about what cannot be read or written.
    """

    def __init__(self, directory: Path, serial: str, warn: Callable[[str], None]) -> None:
        self._path = directory / f"{serial}.json"
        self._serial = serial
        self._warn = warn
        self._last: SavedState | None = None

    def load(self) -> SavedState | None:
        """Return what was saved; None, after one line, if it is unreadable or another's."""
        try:
            state = SavedState.model_validate_json(self._path.read_bytes())
            if state.serial != self._serial:
                raise ValueError(f"it is of module {state.serial}")
            return state
        except FileNotFoundError:
            return None
        except ValidationError as error:
            reason = problem_text(error.errors(), SavedState)
        except (OSError, ValueError) as error:
            reason = reason_of(error)
        self._warn(f"{self._path}: not the state of this module, which starts new: {reason}")
        return None

    def save(self, state: SavedState) -> None:
        if state == self._last:
            return
        self._last = state
        text = state.model_dump_json(indent=1, by_alias=True)
        unfinished = self._path.with_name(f".{self._path.name}.{os.getpid()}")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            unfinished.write_text(text)
            os.replace(unfinished, self._path)
        except OSError as error:
            self._warn(f"{self._path}: the state of the module is not kept: {reason_of(error)}")
            with contextlib.suppress(OSError):
                unfinished.unlink(missing_ok=True)
