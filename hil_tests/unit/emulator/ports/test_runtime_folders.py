"""Folders of an emulator: its sockets, its announcement, what a module keeps over restarts."""

import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from emulator.chip import Pace
from emulator.ports import runtime_folders
from emulator.ports.pty import LinkError
from emulator.ports.runtime_folders import DirectoryMemory, announcement, fresh_port_folder
from emulator.x4m300 import radar_device
from hil_tests.unit.emulator.doubles import IDENTITY, BareHost, RampSource
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import FORMAT_KEY, OutputFeature, SensorMode

LONG = "long" * 30


def test_a_short_folder_holds_its_socket(tmp_path: Path) -> None:
    short = Path("/run/links")
    with contextlib.ExitStack() as cleanup:
        assert (
            runtime_folders.socket_path(short, cleanup, "odometry.sock") == short / "odometry.sock"
        )


def test_where_links_and_tmpdir_are_long_the_socket_is_short_and_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / LONG).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / LONG))
    with contextlib.ExitStack() as cleanup:
        path = runtime_folders.socket_path(tmp_path / LONG, cleanup, "odometry.sock")
        assert len(os.fsencode(path)) <= 100
        assert path.parent.stat().st_mode & 0o077 == 0, "nobody else's business"
        assert list((tmp_path / LONG).iterdir()) == []
    assert not path.parent.exists()


def test_nowhere_short_enough_is_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtime_folders, "LONGEST_SOCKET_PATH", 10)
    with (
        contextlib.ExitStack() as cleanup,
        pytest.raises(LinkError, match=r"too long for the odometry socket.*shorter --link-dir"),
    ):
        runtime_folders.socket_path(tmp_path, cleanup, "odometry.sock")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "xethru"


def dead_pid() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_an_announcement_is_the_ready_line_with_a_pid_until_closed(folder: Path) -> None:
    with contextlib.ExitStack() as cleanup:
        announcement(cleanup)({"ready": True, "devices": []})
        (entry,) = folder.iterdir()
        assert entry.name == f"{os.getpid()}.json"
        assert json.loads(entry.read_text()) == {"pid": os.getpid(), "ready": True, "devices": []}
        assert folder.stat().st_mode & 0o077 == 0, "nobody else's business"
    assert list(folder.iterdir()) == []


def test_what_dead_emulators_left_is_removed_and_nothing_else(folder: Path) -> None:
    pid = dead_pid()
    mine = fresh_port_folder()
    (folder / f"{pid}.json").write_text("{}")
    (folder / f"{pid}.new").write_text("killed while it wr")
    (folder / f"ports-{pid}-abc").mkdir()
    (folder / f"ports-{pid}-abc" / "radar_1").symlink_to("/dev/pts/99999")
    (folder / "notes.json").write_text("{}")
    with contextlib.ExitStack() as cleanup:
        announcement(cleanup)({})
        assert sorted(path.name for path in folder.iterdir()) == sorted(
            [f"{os.getpid()}.json", "notes.json", mine.name]
        )


def test_without_a_usable_folder_nothing_is_announced(folder: Path) -> None:
    folder.write_text("a file is in the way")
    with contextlib.ExitStack() as cleanup:
        announcement(cleanup)({})
    assert folder.read_text() == "a file is in the way"


PRESENCE_2 = 0x014D4AB8
STOP = m.SetMode(mode=SensorMode.XTID_SM_STOP)
RUN = m.SetMode(mode=SensorMode.XTID_SM_RUN)
LOAD = m.LoadApp(profile_id=PRESENCE_2)
USER = 0x80000001


def start(directory: Path, warnings: list[str] | None = None) -> BareHost:
    """Begin as a new process, to which nothing is left of the last one but the directory."""
    lines: list[str] = [] if warnings is None else warnings
    memory = DirectoryMemory(directory, IDENTITY.serial, lines.append)
    return BareHost(radar_device(IDENTITY, RampSource(), Pace.ASAP, memory=memory))


def sensitivity(host: BareHost) -> int:
    reply = host.ask(m.GetSensitivity())
    assert isinstance(reply, m.ReplyInt)
    return reply.values[0]


def test_settings_are_saved_when_the_profile_starts(tmp_path: Path) -> None:
    """8.2: changes made but never run are lost at power-off."""
    host = start(tmp_path)
    host.command(STOP, LOAD, m.SetSensitivity(sensitivity=7))
    host = start(tmp_path)
    assert host.ask(m.GetMode()) == m.ReplyByte(values=b"\x13"), "it was in STOP, and stays"
    assert host.ask(LOAD) == m.Ack()
    assert sensitivity(host) == 5
    host.command(m.SetSensitivity(sensitivity=7), RUN)
    host = start(tmp_path)
    assert host.ask(m.GetMode()) == m.ReplyByte(values=b"\x01")
    assert sensitivity(host) == 7


def test_a_profile_that_was_loaded_and_not_run_does_not_start(tmp_path: Path) -> None:
    """8.2: the module was not in RUN."""
    assert start(tmp_path).ask(m.GetMode()) == m.ReplyByte(values=b"\x01"), "as shipped"
    start(tmp_path).command(LOAD)
    assert start(tmp_path).ask(m.GetMode()) == m.ReplyByte(values=b"\x13")


def test_presence_outputs_are_kept_and_the_others_are_off(tmp_path: Path) -> None:
    """4.7, last column."""
    host = start(tmp_path)
    wanted = [
        OutputFeature.PRESENCE_MOVINGLIST,
        OutputFeature.BASEBAND_IQ,
        OutputFeature.PULSEDOPPLER_FLOAT,
        OutputFeature.NOISEMAP_BYTE,
    ]
    on = [m.OutputSetControl(feature=feature, control=1) for feature in wanted]
    host.command(STOP, LOAD, *on, RUN)
    host = start(tmp_path)
    controls = [host.ask(m.OutputGetControl(feature=feature)) for feature in wanted]
    assert controls == [m.ReplyInt(values=(bits,)) for bits in (1, 0, 0, 0)]


def test_files_survive(tmp_path: Path) -> None:
    host = start(tmp_path)
    key = {"file_type": USER, "identifier": 3}
    content = bytes(range(256))
    host.command(m.CreateFile(**key, length=300), m.SetFileData(**key, offset=10, data=content))
    host = start(tmp_path)
    assert host.ask(m.GetFileData(**key, offset=0, length=1)) == m.Error(code=6), "closed now"
    assert host.ask(m.OpenFile(**key)) == m.Ack()
    reply = host.ask(m.GetFileData(**key, offset=0, length=300))
    assert reply == m.ReplyByte(values=b"\xff" * 10 + content + b"\xff" * 34)
    assert host.ask(m.FormatFilesystem(key=FORMAT_KEY)) == m.Ack()
    assert start(tmp_path).ask(m.FindAllFiles()) == m.ReplyInt(values=())


def test_modules_do_not_share_a_state(tmp_path: Path) -> None:
    host = start(tmp_path)
    assert host.ask(m.StoreNoiseMap()) == m.Ack()
    assert [path.name for path in tmp_path.iterdir()] == [f"{IDENTITY.serial}.json"]


def with_outputs(text: str, outputs: object) -> str:
    document = json.loads(text)
    document["profiles"][0]["outputs"] = outputs
    return json.dumps(document)


BROKEN: dict[str, Callable[[str], str]] = {
    "empty": lambda text: "",
    "cut": lambda text: text[: len(text) // 2],
    "not text": lambda text: "\x00\xff",
    "of another module": lambda text: text.replace(IDENTITY.serial, "999999999999"),
    "of another version": lambda text: text.replace('"version": 1', '"version": 2'),
    "another document": lambda text: json.dumps({"radar": "?"}),
    "impossible sensitivity": lambda text: text.replace('"sensitivity": 5', '"sensitivity": 12'),
    "infinite zone": lambda text: re.sub(r"9\.4392\d*", "Infinity", text),
    "outputs as a number": lambda text: with_outputs(text, 5),
    "outputs without pairs": lambda text: with_outputs(text, [[[], 1]]),
    "damaged file": lambda text: text.replace('"base64": "', '"base64": "\u00e4'),
}


@pytest.mark.parametrize("damage", BROKEN)
def test_a_broken_state_gives_one_line_and_a_fresh_module(tmp_path: Path, damage: str) -> None:
    host = start(tmp_path)
    host.command(STOP, LOAD, RUN, m.StoreNoiseMap(), STOP)
    path = tmp_path / f"{IDENTITY.serial}.json"
    before = path.read_text()
    path.write_text(BROKEN[damage](before))
    assert path.read_text() != before
    warnings: list[str] = []
    host = start(tmp_path, warnings)
    assert len(warnings) == 1
    assert str(path) in warnings[0]
    assert "\n" not in warnings[0]
    assert host.ask(m.GetMode()) == m.ReplyByte(values=b"\x01"), "as shipped: it runs"
    assert host.ask(STOP) == m.Ack()
    assert start(tmp_path, warnings).ask(m.GetMode()) == m.ReplyByte(values=b"\x13")
    assert len(warnings) == 1, "the broken state was replaced"


def test_a_directory_that_takes_no_files_is_a_warning(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    warnings: list[str] = []
    host = start(blocked / "below", warnings)
    assert host.ask(STOP) == m.Ack()
    assert "is not kept" in warnings[-1]


def test_a_crash_while_writing_leaves_the_old_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = start(tmp_path)
    assert host.ask(STOP) == m.Ack()

    def fails(source: Path, target: Path) -> None:
        raise OSError(5, "power cut")

    monkeypatch.setattr(os, "replace", fails)
    host.command(LOAD, RUN)
    monkeypatch.undo()
    warnings: list[str] = []
    assert start(tmp_path, warnings).ask(m.GetMode()) == m.ReplyByte(values=b"\x13")
    assert warnings == []
    assert len(list(tmp_path.iterdir())) == 1, "nothing half written stays"
