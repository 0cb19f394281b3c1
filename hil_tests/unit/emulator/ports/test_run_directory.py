"""Word of running emulators, and the litter of dead ones."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from emulator.ports.folders import Announcement, fresh_port_folder


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "xethru"


def dead_pid() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_an_announcement_is_the_ready_line_with_a_pid_until_closed(folder: Path) -> None:
    announcement = Announcement({"ready": True, "devices": []})
    (entry,) = folder.iterdir()
    assert entry.name == f"{os.getpid()}.json"
    assert json.loads(entry.read_text()) == {"pid": os.getpid(), "ready": True, "devices": []}
    assert folder.stat().st_mode & 0o077 == 0, "nobody else's business"
    announcement.close()
    announcement.close()
    assert list(folder.iterdir()) == []


def test_what_dead_emulators_left_is_removed_and_nothing_else(folder: Path) -> None:
    pid = dead_pid()
    mine = fresh_port_folder()
    (folder / f"{pid}.json").write_text("{}")
    (folder / f"{pid}.new").write_text("killed while it wr")
    (folder / f"ports-{pid}-abc").mkdir()
    (folder / f"ports-{pid}-abc" / "radar_1").symlink_to("/dev/pts/99999")
    (folder / "notes.json").write_text("{}")
    announcement = Announcement({})
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        [f"{os.getpid()}.json", "notes.json", mine.name]
    )
    announcement.close()


def test_without_a_usable_folder_nothing_is_announced(folder: Path) -> None:
    folder.write_text("a file is in the way")
    Announcement({}).close()
    assert folder.read_text() == "a file is in the way"
