"""A session shown while it happens, in a viewer that is started here or runs already.

If a viewer is closed in the middle, the run goes on without it.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import urlsplit

from slam.app.run.output import note
from slam.app.view import SERVE_WEB, SPAWN
from slam.live.errors import AppError
from slam.live.session_records import Event, Scan, SessionInfo, SessionObserver
from xethru_protocol.cli.live import viewer
from xethru_protocol.cli.live.viewer import HERE, ViewerKind
from xethru_protocol.operating_system import StopFlag

_DEFAULT_PORT = 9876
_CONNECT_LIMIT_S = 3.0


class SlamViewerProcess(viewer.ViewerProcess):
    """Runs a viewer; its errors are AppErrors."""

    error = AppError
    extra = "view"
    without_display = (
        "let a browser show it (--rerun serve-web, or of a recorded session view --web), or see "
        "view --out and view --screenshot"
    )
    without_driver = "let a browser show it (--rerun serve-web, view --web)"


def require_listening(url: str) -> None:
    """Require that a viewer listens at a `rerun+http://` address; AppError if none does."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port or _DEFAULT_PORT
    except ValueError:
        raise AppError(f"{url}: is not an address of a viewer") from None
    try:
        socket.create_connection((host, port), timeout=_CONNECT_LIMIT_S).close()
    except OSError as error:
        raise AppError(
            f"{url}: no viewer listens there ({error.strerror or error}); start one with "
            f"`rerun --bind {HERE}`, or let --rerun spawn do it"
        ) from None


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
                process = starting.enter_context(SlamViewerProcess(kind, *self._files))
                process.wait_until_ready(self._stop.check)
                self._stack = starting.pop_all()
            self._url, self._has_ended = process.url, lambda: process.has_ended
            if kind is ViewerKind.WEB:
                self._web_url = process.web_url
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
        from slam.app.view.session_view import RerunView  # loads Rerun, half a second

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

    def take(self, event: Event) -> None:
        if self._is_watched and isinstance(event, Scan) and self._has_ended():
            self._is_watched = False
            note("the viewer was closed; the run goes on without it")
        if self._is_watched:
            self._view.take(event)

    def close(self) -> None:
        self._view.close()
