"""What a module keeps over resets and restarts of the emulator, and a broken state directory."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from emulator.chip import Pace
from emulator.device import radar_device
from emulator.ports.folders import DirectoryMemory
from hil_tests.unit.emulator.doubles import IDENTITY, BareHost, RampSource
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import FORMAT_KEY, OutputFeature, SensorMode

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


BROKEN: dict[str, Callable[[str], str]] = {
    "empty": lambda text: "",
    "cut": lambda text: text[: len(text) // 2],
    "not text": lambda text: "\x00\xff",
    "of another module": lambda text: text.replace(IDENTITY.serial, "999999999999"),
    "of another version": lambda text: text.replace('"version": 1', '"version": 2'),
    "another document": lambda text: json.dumps({"radar": "?"}),
    "impossible sensitivity": lambda text: text.replace('"sensitivity": 5', '"sensitivity": 12'),
    "infinite zone": lambda text: text.replace("9.43925925925926", "Infinity"),
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
