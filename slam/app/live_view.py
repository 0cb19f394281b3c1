"""A session seen while it happens: a viewer of our own or somebody's, told of everything.

A viewer is never waited for and never missed: if it is closed in the middle, the run goes on.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

from slam.app.session import LogLine, Scan, SessionInfo, SessionObserver, Snapshot
from slam.app.view_targets import SERVE_WEB, SPAWN

_FLUSH_S = 0.5
"""Longest time that a frame waits for others to be shown with it."""
_POLL_S = 0.1


class LiveView:
    """Gives an observer that shows a run, while it is entered.

    Parameters
    ----------
    where
        `spawn`: a window; `serve-web`: a page for a browser; else the `rerun+http://` address of a
        viewer that listens already.
    check
        Called again and again while waiting; may raise to stop.
    files
        Recordings that a viewer of our own opens at once.
    is_replay
        What is shown happened before: when it comes says nothing.
    """

    def __init__(
        self, where: str, check: Callable[[], None], *files: Path, is_replay: bool = False
    ) -> None:
        self._where, self._check, self._files = where, check, files
        self._is_replay, self._has_shown = is_replay, bool(files)
        self._stack = ExitStack()
        self._url, self._web_url = where, ""
        self._has_ended: Callable[[], bool] = lambda: False

    def __enter__(self) -> Self:
        """Start the viewer, where it is ours.

        Raises
        ------
        AppError
            It cannot be started, or nothing listens at the address given.
        """
        from slam.app.rerun_viewer import (  # late, see module text
            ViewerKind,
            ViewerProcess,
            require_listening,
        )

        if self._where in {SPAWN, SERVE_WEB}:
            kind = ViewerKind.WEB if self._where == SERVE_WEB else ViewerKind.WINDOW
            with ExitStack() as starting:
                viewer = starting.enter_context(ViewerProcess(kind, *self._files))
                viewer.wait_until_ready(self._check)
                self._stack = starting.pop_all()
            self._url, self._has_ended = viewer.url, lambda: viewer.has_ended
            if kind is ViewerKind.WEB:
                self._web_url = viewer.web_url
                _say(f"watch at {self._web_url}")
        else:
            require_listening(self._url)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End a viewer that serves a browser; a window stays open, however what it shows ended."""
        if self._has_shown:
            self._stack.close()
        else:
            self._stack.__exit__(kind, error, trace)

    def observer(self, info: SessionInfo) -> SessionObserver:
        """Return what shows a run; to be closed like every other."""
        from slam.app.rerun_recording import ViewerTarget  # half a second, as in the run
        from slam.app.rerun_view import RerunView

        self._has_shown = True
        view = RerunView(
            ViewerTarget(url=self._url),
            info,
            flush_s=_FLUSH_S,
            time_of_day_ns=None if self._is_replay else time.time_ns,
        )
        return _WhileWatched(view, self._has_ended)

    def keep_serving(self) -> None:
        """Keep a page for the browser until a signal comes; a window needs nothing."""
        if not self._web_url:
            return
        _say(f"the view stays at {self._web_url} until Ctrl-C")
        while not self._has_ended():
            self._check()
            time.sleep(_POLL_S)


class _WhileWatched(SessionObserver):
    """Passes everything on until the viewer is gone."""

    def __init__(self, view: SessionObserver, has_ended: Callable[[], bool]) -> None:
        self._view, self._has_ended = view, has_ended
        self._is_watched = True

    def on_scan(self, scan: Scan) -> None:
        """Pass on a scan; notice once that nobody looks."""
        if self._is_watched and self._has_ended():
            self._is_watched = False
            _say("the viewer was closed; the run goes on without it")
        if self._is_watched:
            self._view.on_scan(scan)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Pass on a state."""
        if self._is_watched:
            self._view.on_snapshot(snapshot)

    def on_log(self, line: LogLine) -> None:
        """Pass on a line."""
        if self._is_watched:
            self._view.on_log(line)

    def close(self) -> None:
        """Send the last rows; a viewer that is gone takes none, which harms nobody."""
        self._view.close()


def _say(text: str) -> None:
    sys.stderr.write(f"uwb-slam: {text}\n")
    sys.stderr.flush()
