"""A session in Rerun, in a window, a browser, a file or a picture."""

from __future__ import annotations

SPAWN, SERVE_WEB, CONNECT = "spawn", "serve-web", "connect"
DEFAULT_VIEWER_URL = "rerun+http://127.0.0.1:9876/proxy"
"""Where a viewer started as `rerun` listens."""
