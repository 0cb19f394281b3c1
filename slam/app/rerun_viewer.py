"""A Rerun viewer as a process of its own, reachable from this machine only: window, web, headless.

The viewer is started here rather than by Rerun's own `spawn`, since that listens to the whole
network.
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
from types import TracebackType
from typing import Self
from urllib.parse import quote, urlsplit

from slam.app.errors import AppError
from slam.app.parent_death import signal_at_parents_death

_HERE = "127.0.0.1"
_DEFAULT_PORT = 9876
_CONNECT_LIMIT_S = 3.0
_START_LIMIT_S = 20.0
_SETTLE_S = 0.5
"""A viewer that cannot draw listens at first and ends a moment later."""
_END_LIMIT_S = 5.0
_POLL_S = 0.05

_LAVAPIPE = (Path("/usr/share/vulkan/icd.d"), Path("/usr/local/share/vulkan/icd.d"))
_DRIVER_VARIABLES = ("VK_ICD_FILENAMES", "VK_DRIVER_FILES")


class ViewerKind(Enum):
    """What a viewer shows itself in; the value is its command line."""

    WINDOW = ("--hide-welcome-screen", "--expect-data-soon")
    WEB = ("--serve-web",)
    HEADLESS = ("--headless", "--hide-welcome-screen", "--window-size", "1360x812")


class ViewerProcess:
    """Runs a viewer while it is entered; a window may be left open.

    Parameters
    ----------
    kind
        What it shows itself in.
    files
        Recordings to open at once; none where rows will be sent.
    """

    def __init__(self, kind: ViewerKind, *files: Path) -> None:
        self._kind, self._files = kind, files
        self._process: subprocess.Popen[bytes] | None = None
        self._port, self._web_port = _two_free_ports()

    @property
    def url(self) -> str:
        """Where recordings are sent to."""
        return f"rerun+http://{_HERE}:{self._port}/proxy"

    @property
    def web_url(self) -> str:
        """What a browser opens."""
        return f"http://{_HERE}:{self._web_port}/?url={quote(self.url, safe='')}"

    @property
    def has_ended(self) -> bool:
        """Whether the process is gone, for whatever reason."""
        return self._process is None or self._process.poll() is not None

    def __enter__(self) -> Self:
        """Start the process.

        Raises
        ------
        AppError
            There is no viewer, no display for its window, or no way to draw.
        """
        if self._kind is ViewerKind.WINDOW and sys.platform == "linux":
            _require_display()
        command = [str(executable()), "--bind", _HERE, "--port", str(self._port)]
        command += self._kind.value
        if self._kind is ViewerKind.WEB:
            command += ["--web-viewer-port", str(self._web_port)]
        is_ours = self._kind is not ViewerKind.WINDOW
        self._process = subprocess.Popen(
            [*command, *(str(path) for path in self._files)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=_environment(self._kind),
            # Ctrl-C is for us; a window stays when we end.
            start_new_session=True,
            preexec_fn=signal_at_parents_death(signal.SIGTERM) if is_ours else None,
        )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End the process, unless it is a window: that is the user's to close."""
        process = self._process
        if process is None:
            return
        if self._kind is ViewerKind.WINDOW and error is None:
            process.returncode = (
                process.poll() or 0
            )  # left open, and not a zombie of ours to warn of
            return
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=_END_LIMIT_S)
            return
        process.kill()
        process.wait()

    def wait_until_ready(self, check: Callable[[], None]) -> None:
        """Wait until the viewer takes recordings.

        Parameters
        ----------
        check
            Called again and again; may raise to stop.

        Raises
        ------
        AppError
            It ended, or did not listen in time.
        """
        give_up = time.monotonic() + _START_LIMIT_S
        ports = [self._port] + ([self._web_port] if self._kind is ViewerKind.WEB else [])
        for port in ports:
            while not _listens(port):
                check()
                self._require_alive()
                if time.monotonic() > give_up:
                    raise AppError(f"the Rerun viewer did not listen within {_START_LIMIT_S:g} s")
                time.sleep(_POLL_S)
        if self._kind is not ViewerKind.WEB:
            settled = time.monotonic() + _SETTLE_S
            while time.monotonic() < settled:
                check()
                self._require_alive()
                time.sleep(_POLL_S)

    def _require_alive(self) -> None:
        if self.has_ended:
            raise AppError(
                "the Rerun viewer ended at once: it found no graphics driver; "
                "install Vulkan's software driver (Debian: mesa-vulkan-drivers), "
                "or let a browser show it (--rerun serve-web, view --web)"
            )


def require_listening(url: str) -> None:
    """See that somebody listens at the `rerun+http://` address of a viewer.

    Raises
    ------
    AppError
        Nobody does; names the remedy.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port or _DEFAULT_PORT
    except ValueError:
        raise AppError(f"{url}: is no address of a viewer") from None
    try:
        socket.create_connection((host, port), timeout=_CONNECT_LIMIT_S).close()
    except OSError as error:
        raise AppError(
            f"{url}: no viewer listens there ({error.strerror or error}); start one with "
            f"`rerun --bind {_HERE}`, or let --rerun spawn do it"
        ) from None


def executable() -> Path:
    """Return the viewer that came with the SDK: the same version, whatever is on the path."""
    found = importlib.util.find_spec("rerun_cli")
    folder = Path(found.origin).parent if found is not None and found.origin else None
    names = ("Rerun.app/Contents/MacOS/Rerun", "rerun")
    for name in names:
        if folder is not None and (folder / name).is_file():
            return folder / name
    raise AppError("the Rerun viewer is not installed; `pip install rerun-sdk` brings it")


def _environment(kind: ViewerKind) -> dict[str, str]:
    environment = dict(os.environ) | {"RERUN_APP_ONLY": "true"}
    environment.pop("RUST_LOG", None)
    if kind is ViewerKind.HEADLESS and not any(os.environ.get(v) for v in _DRIVER_VARIABLES):
        # The software driver is asked for by name: pictures then look the same with every card.
        drivers = [path for folder in _LAVAPIPE for path in sorted(folder.glob("lvp_icd*.json"))]
        if drivers:
            environment["VK_ICD_FILENAMES"] = str(drivers[0])
    return environment


def _require_display() -> None:
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise AppError(
            "no display for the viewer's window; let a browser show it (--rerun serve-web, or of a "
            "recorded session view --web), or see view --out and view --screenshot"
        )


def _two_free_ports() -> tuple[int, int]:
    with socket.socket() as one, socket.socket() as other:  # both held, so that they differ
        one.bind((_HERE, 0))
        other.bind((_HERE, 0))
        return int(one.getsockname()[1]), int(other.getsockname()[1])


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(_POLL_S)
        return probe.connect_ex((_HERE, port)) == 0
