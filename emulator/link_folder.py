"""Where an emulator's links and sockets go: a directory that serves one running emulator."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from emulator.link import LinkError
from emulator.path_lock import PathInUseError, locked
from emulator.run_directory import fresh_port_folder

__all__ = ["link_folder", "socket_path"]

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
                with contextlib.suppress(OSError):  # somebody else uses it too
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
