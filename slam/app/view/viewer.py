"""A session shown while it happens, in a viewer that is started here or runs already.

The viewer is not started by Rerun's own `spawn`, since that listens to the whole network. If a
viewer is closed in the middle, the run goes on without it.
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
from contextlib import ExitStack
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import quote, urlsplit

from slam.app.errors import AppError
from slam.app.records import LogLine, Scan, SessionInfo, SessionObserver, Snapshot
from slam.app.run.output import note
from slam.app.view import SERVE_WEB, SPAWN
from slam.results import SmoothedRun
from xethru_protocol.extras import install_command
from xethru_protocol.system import StopFlag, signal_at_parents_death

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
    """Where a viewer draws; the value is its command line."""

    WINDOW = ("--hide-welcome-screen", "--expect-data-soon")
    WEB = ("--serve-web",)
    HEADLESS = ("--headless", "--hide-welcome-screen", "--window-size", "1360x812")


class ViewerProcess:
    """Runs a viewer while it is entered, with files opened at once; a window may be left open."""

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
        return self._process is None or self._process.poll() is not None

    def __enter__(self) -> Self:
        """Start the process; AppError if there is no viewer or no display for its window."""
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
            # Ctrl-C ends this process only; a window stays
            start_new_session=True,
            preexec_fn=signal_at_parents_death(signal.SIGTERM) if is_ours else None,
        )
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """End the process, unless it is a window, which the user closes."""
        process = self._process
        if process is None:
            return
        if self._kind is ViewerKind.WINDOW and error is None:
            process.returncode = process.poll() or 0  # left open, and without a ResourceWarning
            return
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=_END_LIMIT_S)
            return
        process.kill()
        process.wait()

    def wait_until_ready(self, stop: StopFlag) -> None:
        """Wait until the viewer takes recordings; AppError if it ends or does not in time."""
        give_up = time.monotonic() + _START_LIMIT_S
        ports = [self._port] + ([self._web_port] if self._kind is ViewerKind.WEB else [])
        for port in ports:
            while not _listens(port):
                stop.check()
                self.require_alive()
                if time.monotonic() > give_up:
                    raise AppError(f"the Rerun viewer did not listen within {_START_LIMIT_S:g} s")
                time.sleep(_POLL_S)
        if self._kind is not ViewerKind.WEB:
            settled = time.monotonic() + _SETTLE_S
            while time.monotonic() < settled:
                stop.check()
                self.require_alive()
                time.sleep(_POLL_S)

    def require_alive(self, ending_s: float = 0.0) -> None:
        """Raise AppError if the viewer has ended, or does so within this time."""
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout=ending_s)
        if self.has_ended:
            raise AppError(
                "the Rerun viewer ended at once: a Vulkan driver is missing; install one such as "
                "Mesa's lavapipe, which needs no graphics card (Debian: mesa-vulkan-drivers), "
                "or let a browser show it (--rerun serve-web, view --web)"
            )


def require_listening(url: str) -> None:
    """Require that a viewer listens at a `rerun+http://` address; AppError if none does."""
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
    """Return the viewer that came with the SDK, and so has the same version."""
    found = importlib.util.find_spec("rerun_cli")
    if found is not None and found.origin:
        for name in ("Rerun.app/Contents/MacOS/Rerun", "rerun"):
            path = Path(found.origin).parent / name
            if path.is_file():
                return path
    raise AppError(f"the Rerun viewer is not installed: {install_command('view')}")


def _environment(kind: ViewerKind) -> dict[str, str]:
    environment = dict(os.environ) | {"RERUN_APP_ONLY": "true"}
    environment.pop("RUST_LOG", None)
    if kind is ViewerKind.HEADLESS and not any(os.environ.get(v) for v in _DRIVER_VARIABLES):
        # the software driver by name: pictures then look the same with every card
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


_FLUSH_S = 0.5
"""Longest time that a frame waits for others to be shown with it."""
_VIEW_POLL_S = 0.1


class LiveView:
    """A viewer, while it is entered; `observer` shows a run in it.

    Parameters
    ----------
    where
        `spawn`: a window; `serve-web`: a page for a browser; else the `rerun+http://` address of a
        running viewer.
    files
        Recordings that a viewer started here opens at once.
    is_replay
        Whether the run happened before, so that the time of arrival has no meaning.
    """

    def __init__(self, where: str, stop: StopFlag, *files: Path, is_replay: bool = False) -> None:
        self._where, self._stop, self._files = where, stop, files
        self._is_replay, self._has_shown = is_replay, bool(files)
        self._stack = ExitStack()
        self._url, self._web_url = where, ""
        self._has_ended: Callable[[], bool] = lambda: False

    def __enter__(self) -> Self:
        """Start the viewer; AppError if it cannot be started, or nothing listens at the address."""
        if self._where in {SPAWN, SERVE_WEB}:
            kind = ViewerKind.WEB if self._where == SERVE_WEB else ViewerKind.WINDOW
            with ExitStack() as starting:
                viewer = starting.enter_context(ViewerProcess(kind, *self._files))
                viewer.wait_until_ready(self._stop)
                self._stack = starting.pop_all()
            self._url, self._has_ended = viewer.url, lambda: viewer.has_ended
            if kind is ViewerKind.WEB:
                self._web_url = viewer.web_url
                note(f"watch at {self._web_url}")
        else:
            require_listening(self._url)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End a viewer that serves a browser; a window stays open if a run was shown in it."""
        if self._has_shown:
            kind = error = trace = None
        self._stack.__exit__(kind, error, trace)

    def observer(self, info: SessionInfo) -> SessionObserver:
        """Return an observer that shows a run."""
        from slam.app.view.panels import RerunView  # loads Rerun, half a second

        self._has_shown = True
        view = RerunView(
            self._url,
            info,
            flush_s=_FLUSH_S,
            time_of_day_ns=None if self._is_replay else time.time_ns,
        )
        return _WhileWatched(view, self._has_ended)

    def keep_serving(self) -> None:
        """Serve a page for the browser until a signal comes; a window needs nothing."""
        if not self._web_url:
            return
        note(f"the view stays at {self._web_url} until Ctrl-C")
        while not self._has_ended():
            self._stop.check()
            time.sleep(_VIEW_POLL_S)


class _WhileWatched(SessionObserver):
    """Passes everything on until the viewer has ended."""

    def __init__(self, view: SessionObserver, has_ended: Callable[[], bool]) -> None:
        self._view, self._has_ended = view, has_ended
        self._is_watched = True

    def on_scan(self, scan: Scan) -> None:
        if self._is_watched and self._has_ended():
            self._is_watched = False
            note("the viewer was closed; the run goes on without it")
        if self._is_watched:
            self._view.on_scan(scan)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        if self._is_watched:
            self._view.on_snapshot(snapshot)

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        if self._is_watched:
            self._view.on_smoothed(smoothed)

    def on_log(self, line: LogLine) -> None:
        if self._is_watched:
            self._view.on_log(line)

    def close(self) -> None:
        self._view.close()
