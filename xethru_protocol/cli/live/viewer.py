"""The process of a Rerun viewer: a window, a page for a browser, or pictures in memory.

It is not started by Rerun's own ``spawn``, since that listens to the whole network. Rerun itself is
not imported here.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import ClassVar, Self
from urllib.parse import quote

from xethru_protocol.operating_system import signal_at_parents_death
from xethru_protocol.optional_packages import install_command
from xethru_protocol.wire.errors import XeThruError

HERE = "127.0.0.1"
_START_LIMIT_S = 20.0
_SETTLE_S = 0.5
"""A viewer that cannot draw listens at first and ends a moment later."""
_END_LIMIT_S = 5.0
_POLL_S = 0.05
_SERVER_MEMORY = "25MB"

_LAVAPIPE = (Path("/usr/share/vulkan/icd.d"), Path("/usr/local/share/vulkan/icd.d"))
_DRIVER_VARIABLES = ("VK_ICD_FILENAMES", "VK_DRIVER_FILES")


class ViewerError(XeThruError):
    """The Rerun viewer cannot be started, or has ended."""


class ViewerKind(Enum):
    """Where a viewer draws; the value is its command line."""

    WINDOW = ("--hide-welcome-screen", "--expect-data-soon")
    WEB = ("--serve-web",)
    HEADLESS = ("--headless", "--hide-welcome-screen", "--window-size", "1360x812")


class ViewerProcess:
    """Runs a viewer while it is entered, with files opened at once.

    The class attributes are what its owner says of it: the class of errors, the extra that installs
    it, and which options do without a display and without a graphics driver.

    Parameters
    ----------
    stays_open
        Whether a window stays for its user to close it.
    memory_limit
        Most memory of the viewer, such as ``"1GB"``: the oldest data go; and its server keeps only
        the last seconds for browsers that come later. None: Rerun's own limits.
    """

    error: ClassVar[type[Exception]] = ViewerError
    extra: ClassVar[str] = "live"
    without_display: ClassVar[str] = "--web shows it in a browser, --terminal as text"
    without_driver: ClassVar[str] = "--web shows it in a browser, --terminal as text"

    def __init__(
        self,
        kind: ViewerKind,
        *files: Path,
        stays_open: bool = True,
        memory_limit: str | None = None,
    ) -> None:
        self._kind, self._files = kind, files
        self._stays_open = stays_open and kind is ViewerKind.WINDOW
        self._limits = (
            ("--memory-limit", memory_limit, "--server-memory-limit", _SERVER_MEMORY)
            if memory_limit
            else ()
        )
        self._process: subprocess.Popen[bytes] | None = None
        self._port, self._web_port = _two_free_ports()

    @property
    def url(self) -> str:
        """Where recordings are sent to."""
        return f"rerun+http://{HERE}:{self._port}/proxy"

    @property
    def web_url(self) -> str:
        """What a browser opens."""
        return f"http://{HERE}:{self._web_port}/?url={quote(self.url, safe='')}"

    @property
    def has_ended(self) -> bool:
        return self._process is None or self._process.poll() is not None

    @classmethod
    def executable(cls) -> Path:
        """Return the viewer that came with the SDK, and so has the same version."""
        found = importlib.util.find_spec("rerun_cli")
        if found is not None and found.origin:
            for name in ("Rerun.app/Contents/MacOS/Rerun", "rerun"):
                path = Path(found.origin).parent / name
                if path.is_file():
                    return path
        raise cls.error(f"the Rerun viewer is not installed: {install_command(cls.extra)}")

    def __enter__(self) -> Self:
        """Start the process; an error if there is no viewer, or no display for its window."""
        command = [str(self.executable()), "--bind", HERE, "--port", str(self._port)]
        if self._kind is ViewerKind.WINDOW and sys.platform == "linux":
            self._require_display()
        command += self._kind.value
        if self._kind is ViewerKind.WEB:
            command += ["--web-viewer-port", str(self._web_port)]
        self._process = subprocess.Popen(
            [*command, *self._limits, *(str(path) for path in self._files)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=_environment(self._kind),
            # Ctrl-C ends this process only, which ends the viewer if it is not to stay
            start_new_session=True,
            preexec_fn=None if self._stays_open else signal_at_parents_death(signal.SIGTERM),
        )
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """End the process, unless it is a window that stays for its user to close it."""
        process = self._process
        if process is None:
            return
        if self._stays_open and error is None:
            process.returncode = process.poll() or 0  # left open, and without a ResourceWarning
            return
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=_END_LIMIT_S)
            return
        process.kill()
        process.wait()

    def wait_until_ready(self, check: Callable[[], None] = lambda: None) -> None:
        """Wait until the viewer takes recordings; an error if it ends or does not in time.

        ``check`` is called again and again meanwhile, to raise what ends the waiting.
        """
        give_up = time.monotonic() + _START_LIMIT_S
        ports = [self._port] + ([self._web_port] if self._kind is ViewerKind.WEB else [])
        for port in ports:
            while not _listens(port):
                check()
                self.require_alive()
                if time.monotonic() > give_up:
                    raise self.error(f"the Rerun viewer did not listen within {_START_LIMIT_S:g} s")
                time.sleep(_POLL_S)
        if self._kind is not ViewerKind.WEB:
            settled = time.monotonic() + _SETTLE_S
            while time.monotonic() < settled:
                check()
                self.require_alive()
                time.sleep(_POLL_S)

    def require_alive(self, ending_s: float = 0.0) -> None:
        """Raise an error if the viewer has ended, or does so within this time."""
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout=ending_s)
        if self.has_ended:
            raise self.error(
                "the Rerun viewer ended at once: a Vulkan driver is missing; install one such as "
                "Mesa's lavapipe, which needs no graphics card (Debian: mesa-vulkan-drivers); "
                f"or {self.without_driver}"
            )

    def _require_display(self) -> None:
        if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise self.error(f"no display for the viewer's window; {self.without_display}")


def _environment(kind: ViewerKind) -> dict[str, str]:
    # under CI, Rerun sends nothing to its makers
    environment = dict(os.environ) | {"RERUN_APP_ONLY": "true", "CI": "true"}
    environment.pop("RUST_LOG", None)
    if kind is ViewerKind.HEADLESS and not any(os.environ.get(v) for v in _DRIVER_VARIABLES):
        # the software driver by name: pictures then look the same with every card
        drivers = [path for folder in _LAVAPIPE for path in sorted(folder.glob("lvp_icd*.json"))]
        if drivers:
            environment["VK_ICD_FILENAMES"] = str(drivers[0])
    return environment


def _two_free_ports() -> tuple[int, int]:
    with socket.socket() as one, socket.socket() as other:  # both held, so that they differ
        one.bind((HERE, 0))
        other.bind((HERE, 0))
        return int(one.getsockname()[1]), int(other.getsockname()[1])


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(_POLL_S)
        return probe.connect_ex((HERE, port)) == 0
