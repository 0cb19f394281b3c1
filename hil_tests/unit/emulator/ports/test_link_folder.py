"""Where the odometry socket goes when paths are long."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

import pytest

from emulator.ports import folders as link_folder
from emulator.ports.pty import LinkError

LONG = "long" * 30


def test_a_short_folder_holds_its_socket(tmp_path: Path) -> None:
    short = Path("/run/links")
    with contextlib.ExitStack() as cleanup:
        assert link_folder.socket_path(short, cleanup, "odometry.sock") == short / "odometry.sock"


def test_where_links_and_tmpdir_are_long_the_socket_is_short_and_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / LONG).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / LONG))
    with contextlib.ExitStack() as cleanup:
        path = link_folder.socket_path(tmp_path / LONG, cleanup, "odometry.sock")
        assert len(os.fsencode(path)) <= 100
        assert path.parent.stat().st_mode & 0o077 == 0, "nobody else's business"
        assert list((tmp_path / LONG).iterdir()) == []
    assert not path.parent.exists()


def test_nowhere_short_enough_is_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link_folder, "LONGEST_SOCKET_PATH", 10)
    with (
        contextlib.ExitStack() as cleanup,
        pytest.raises(LinkError, match=r"too long for the odometry socket.*shorter --link-dir"),
    ):
        link_folder.socket_path(tmp_path, cleanup, "odometry.sock")
