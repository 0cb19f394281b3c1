"""One test session at a radar at a time, also between workers and users: flock on a file."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import re
import tempfile
from pathlib import Path

__all__ = ["PortBusyError", "PortLock"]

_ANYBODY = 0o666
_LONGEST_NAME = 200  # file systems take 255


class PortBusyError(Exception):
    """Another test session has the radar; the message says which process."""


class PortLock:
    """The right to talk to a radar, until released or until this process ends.

    Keyed on the device behind links, so ``/dev/serial/by-id/...`` and ``/dev/ttyACM0`` are the same
    radar. The file stays behind; the lock does not.

    Parameters
    ----------
    target
        A path of a port, or any other name of a radar, such as an address.

    Raises
    ------
    PortBusyError
        If somebody else has it.
    OSError
        If the lock file cannot be opened, or is a link.
    """

    def __init__(self, target: str) -> None:
        device = os.path.realpath(target) if target.startswith("/") else target
        folder = Path(tempfile.gettempdir()) / "xethru-hil-locks"
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            folder.chmod(0o777)  # other users lock here, too
        name = re.sub(r"[^0-9A-Za-z.]+", "_", device).strip("_")
        if len(name) > _LONGEST_NAME:
            name = hashlib.blake2b(device.encode(errors="surrogateescape")).hexdigest()
        path = folder / f"{name}.lock"
        self._descriptor = _open(path)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            owner = os.read(self._descriptor, 20).decode().strip() or "unknown"
            self.release()
            if owner == str(os.getpid()):
                raise PortBusyError(
                    f"{target} is in this session twice, under two names; name each radar once"
                ) from None
            raise PortBusyError(
                f"{target} is being tested by another session (process {owner}); wait for it, or "
                "end it"
            ) from None
        with contextlib.suppress(OSError):  # another user's file: locked all the same
            os.ftruncate(self._descriptor, 0)
            os.write(self._descriptor, f"{os.getpid()}\n".encode())

    def release(self) -> None:
        """Let others have it; calling it again does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def _open(path: Path) -> int:
    """Return a descriptor of a lock file that anybody may open.

    Never of what a link leads to: where anybody may write, it could lead to a file of ours.
    """
    flags = os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | flags, _ANYBODY)
    except PermissionError:
        return os.open(path, os.O_RDONLY | flags)  # enough for flock
    with contextlib.suppress(OSError):
        os.fchmod(descriptor, _ANYBODY)  # whatever the umask
    return descriptor
