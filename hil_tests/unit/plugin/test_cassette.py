"""Answers are compared byte for byte, but through masks; files that are no cassettes are named."""

from dataclasses import replace
from pathlib import Path

import pytest

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.module.memory import Identity
from emulator.scene.scene import empty_room
from emulator.x4m300 import radar_device
from hil_tests.faulty import PATH, FaultyLine
from hil_tests.plugin.cassette import (
    EMULATED,
    Cassette,
    CassetteError,
    Exchange,
    ask_all,
    differences,
)
from xethru_protocol.wire.codec import decode_command, encode
from xethru_protocol.wire.codes import SensorMode
from xethru_protocol.wire.messages import (
    Ack,
    CreateFile,
    DeleteFile,
    Error,
    FactoryPreset,
    ReplyString,
    SetFileData,
    SetMode,
    StoreNoiseMap,
    SystemGetInfo,
)


def info(text: str, pattern: str | None = r"[0-9]{12}") -> Exchange:
    return Exchange(
        name="serial",
        command=encode(SystemGetInfo(item=6)),
        reply=encode(ReplyString(content_id=0x58, info=6, text=text)),
        masks={} if pattern is None else {"value": pattern},
    )


OTHER_ITEM = encode(ReplyString(content_id=0x58, info=7, text="1" * 12))


@pytest.mark.parametrize(
    ("recorded", "now", "differs"),
    [
        (info("202611210001"), info("100000000000"), False),
        (info("202611210001"), info("none"), True),
        (info("202611210001", None), info("100000000000"), True),
        (info("1" * 12), replace(info("1" * 12), reply=OTHER_ITEM), True),  # not the masked field
        (replace(info("1" * 12), masks={"text": ".*"}), info("2" * 12), True),  # no such field
    ],
)
def test_masked_fields_alone_may_differ_within_their_pattern(
    recorded: Exchange, now: Exchange, differs: bool
) -> None:
    assert bool(differences([recorded], [now])) is differs


@pytest.mark.parametrize("reply", [None, encode(Error(code=1)), encode(Ack())])
def test_silence_and_errors_are_answers(reply: bytes | None) -> None:
    (line,) = differences([info("1" * 12)], [replace(info("1" * 12), reply=reply)])
    assert line.startswith("serial: module REPLY STRING")
    assert not differences([replace(info("x"), reply=reply)], [replace(info("x"), reply=reply)])


def test_a_cassette_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "new" / "module.json"
    silent = replace(info("1" * 12), reply=None)
    Cassette(recorded={"identity": "X"}, exchanges=[info("1" * 12), silent]).write(path)
    read = Cassette.read(path)
    assert read.exchanges == [info("1" * 12), silent]
    assert read.recorded == {"identity": "X"}


@pytest.mark.parametrize("content", ["", "[]", '{"format": 1}', '{"format": 2}', "\xff"])
def test_other_files_are_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "other.json"
    path.write_text(content, "latin-1")
    with pytest.raises(CassetteError, match=r"other\.json"):
        Cassette.read(path)


def test_an_emulator_that_changed_its_mind_is_caught() -> None:
    """Protocol reference 4.10: an X4M300 says so; here, another product answers."""
    recorded = Cassette.read(EMULATED)
    device = radar_device(
        Identity(serial="100000000000", order_code="X4M200"),
        echo_source(empty_room(), 0, 0),
        Pace.REALTIME,
    )
    line = FaultyLine(device)
    with line.radar() as radar:
        radar.request(SetMode(mode=SensorMode.XTID_SM_STOP))
    port = line.open(PATH, 115200)
    (found,) = differences(recorded.exchanges, ask_all(port, line.clock_ns, recorded.exchanges))
    assert found.startswith("info ordercode: module REPLY STRING")


def test_questions_have_names_of_their_own_and_write_no_flash() -> None:
    questions = Cassette.read(EMULATED).exchanges
    assert len({question.name for question in questions}) == len(questions)
    asked = {type(decode_command(question.command)) for question in questions}
    assert not asked & {CreateFile, SetFileData, DeleteFile, StoreNoiseMap, FactoryPreset}
