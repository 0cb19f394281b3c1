"""Files of a module, by both drivers. Protocol reference 4.11, 16 (chunks of 256 bytes)."""

import re
from collections.abc import Sequence

import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn
from hil_tests.unit.xethru_protocol.emulated import Emulated, EmulatedModule
from xethru_protocol.driver.files import FileName
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import FORMAT_KEY, FileType
from xethru_protocol.wire.errors import (
    DeviceError,
    Disconnected,
    LocalProtocolError,
    RemoteProtocolError,
)

USER = 0x80000001
CONTENT = bytes(range(256)) * 2 + b"the end"


def test_file_is_written_in_chunks_and_read_back(emulated: Emulated) -> None:
    radar, _, module = emulated
    radar.files.write(USER, 7, CONTENT)
    assert module.files[USER, 7] == CONTENT
    assert module.open == set()
    assert (
        module.received
        == [
            m.SystemGetInfo(item=7),  # old firmware has no files (17)
            m.CreateFile(file_type=USER, identifier=7, length=519),
            m.SetFileData(file_type=USER, identifier=7, offset=0, data=CONTENT[:256]),
            m.SetFileData(file_type=USER, identifier=7, offset=256, data=CONTENT[256:512]),
            m.SetFileData(file_type=USER, identifier=7, offset=512, data=b"the end"),
            m.CloseFile(file_type=USER, identifier=7, commit=1),
        ]
    )
    assert radar.files.read(USER, 7) == CONTENT
    assert module.open == set()
    assert module.received[-4:-1] == [
        m.GetFileData(file_type=USER, identifier=7, offset=0, length=256),
        m.GetFileData(file_type=USER, identifier=7, offset=256, length=256),
        m.GetFileData(file_type=USER, identifier=7, offset=512, length=7),
    ]


def test_no_packet_of_a_file_looks_like_a_noescape_start(emulated: Emulated) -> None:
    """Protocol reference 1.2, the recommendations: never send 7C7C7C7C in a Normal packet."""
    radar, _, module = emulated
    sent: list[bytes] = []
    radar.raw_listener = lambda direction, data, _: sent.append(data) if direction == "tx" else None
    for last in range(256):  # one of them gives the packet the checksum 7C
        content = b"ab" + b"|" * 6 + bytes((last,)) + b"|||"
        radar.files.write(USER, 1, content)
        assert module.files[USER, 1] == content
        radar.files.delete(USER, 1)
    assert len(sent) > 256 * 4
    for packet in sent:
        assert b"||||" not in re.sub(rb"\x7f(.)", rb"\1", packet, flags=re.DOTALL)
    with pytest.raises(LocalProtocolError, match="CREATE_NEW_FILE has four bytes 7C in a row"):
        radar.files.write(USER, 0x7C7C7C7C, b"x")


def test_progress_is_reported_at_the_start_and_after_each_chunk(driver_on: DriverOn) -> None:
    radar, _ = driver_on(EmulatedModule())
    told: list[tuple[int, int]] = []
    radar.files.write(USER, 1, CONTENT, on_progress=lambda *at: told.append(at))
    radar.files.read(USER, 1, on_progress=lambda *at: told.append(at))
    assert told == [(0, 519), (256, 519), (512, 519), (519, 519)] * 2


def test_an_empty_file_is_refused_before_the_module_does(driver_on: DriverOn) -> None:
    """4.11: CREATE with length 0 is error 12, an unknown failure."""
    module = EmulatedModule()
    radar, _ = driver_on(module)
    with pytest.raises(LocalProtocolError, match="80000001/1 must have at least one byte"):
        radar.files.write(USER, 1, b"")
    assert not any(isinstance(command, m.CreateFile) for command in module.received)


def test_files_are_listed_found_and_deleted(driver_on: DriverOn) -> None:
    radar, _ = driver_on(EmulatedModule())
    assert radar.files.find_all() == ()
    radar.files.write(USER, 1, b"a")
    radar.files.write(FileType.PARAMETER_FILE, 0, b"b")
    radar.files.write(USER, 0xFFFFFFFF, b"c")
    assert set(radar.files.find_all()) == {
        FileName(file_type=USER, identifier=1),
        FileName(file_type=FileType.PARAMETER_FILE, identifier=0),
        FileName(file_type=USER, identifier=0xFFFFFFFF),
    }
    assert radar.files.find(USER) == (
        FileName(file_type=USER, identifier=1),
        FileName(file_type=USER, identifier=0xFFFFFFFF),
    )
    radar.files.delete(USER, 1)
    assert radar.files.find(USER) == (FileName(file_type=USER, identifier=0xFFFFFFFF),)
    assert str(radar.files.find(USER)[0]) == "80000001/4294967295"


@pytest.mark.parametrize(
    ("verb", "arguments", "code", "meaning"),
    [
        ("read", (USER, 9), 5, "file NOT_FOUND"),
        ("length", (USER, 9), 5, "file NOT_FOUND"),
        ("delete", (USER, 9), 5, "file NOT_FOUND"),
        ("write", (USER, 1, b"again"), 3, "file ALREADY_EXISTS"),
        ("write", (USER, 2, bytes(0x18001)), 9, "file FULL"),
        ("format_all", (0x427F00C8,), 1, "file INVALID_PARAMETER"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_refusals_have_the_file_systems_own_meaning(
    emulated: Emulated, verb: str, arguments: tuple[object, ...], code: int, meaning: str
) -> None:
    radar, _, module = emulated
    radar.files.write(USER, 1, b"there")
    with pytest.raises(DeviceError, match=meaning) as caught:
        getattr(radar.files, verb)(*arguments)
    assert caught.value.code == code
    assert module.files == {(USER, 1): b"there"}  # one that exists is not deleted for tidiness
    assert module.open == set()


@pytest.mark.parametrize("verb", ["read", "write"])
def test_file_is_closed_after_a_chunk_failed(emulated: Emulated, verb: str) -> None:
    radar, _, module = emulated
    radar.files.write(USER, 1, CONTENT)
    module.fail_at = 256
    arguments = (USER, 1) if verb == "read" else (USER, 2, CONTENT)
    with pytest.raises(DeviceError, match="file UNKNOWN_FAILURE"):
        getattr(radar.files, verb)(*arguments)
    assert module.open == set()
    assert list(module.files) == [(USER, 1)]  # no half-written file stays
    assert radar.warnings == []


def test_file_is_closed_after_the_users_own_exception(emulated: Emulated) -> None:
    radar, _, module = emulated

    def impatient(done: int, total: int) -> None:
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        radar.files.write(USER, 2, CONTENT, on_progress=impatient)
    assert (module.open, module.files) == (set(), {})


def test_file_another_host_left_open_is_read(emulated: Emulated) -> None:
    radar, _, module = emulated
    key = {"file_type": USER, "identifier": 3}
    for command in (m.CreateFile(**key, length=4), m.SetFileData(**key, offset=0, data=b"left")):
        assert module(command) == [m.Ack()]
    assert radar.files.read(USER, 3) == b"left"
    assert module.open == set()


def test_short_chunk_is_the_modules_fault_and_the_file_is_closed(emulated: Emulated) -> None:
    radar, line, module = emulated
    radar.files.write(USER, 1, CONTENT)

    def short(command: m.Message) -> Sequence[m.Message | bytes]:
        answer = module(command)
        return [m.ReplyByte(values=b"?")] if isinstance(command, m.GetFileData) else answer

    line.answer = short
    with pytest.raises(RemoteProtocolError, match="sent 1 bytes from 0 on, not 256"):
        radar.files.read(USER, 1)
    assert module.open == set()


def test_transfer_is_not_repeated_on_a_new_line(driver_on: DriverOn) -> None:
    module = EmulatedModule()
    radar, line = driver_on(module, reconnect_s=5.0)
    line.gone = True
    with pytest.raises(Disconnected):
        radar.files.write(USER, 1, CONTENT)


def test_format_needs_its_key(emulated: Emulated) -> None:
    radar, _, module = emulated
    radar.files.write(USER, 1, b"x")
    radar.files.format_all(FORMAT_KEY)
    assert module.files == {}


def test_crash_dump_is_read_in_chunks_and_cleared(emulated: Emulated) -> None:
    radar, _, module = emulated
    assert radar.files.crash_dump() == b""
    module.leave_crash_dump(CONTENT)
    told: list[tuple[int, int]] = []
    assert radar.files.crash_dump(lambda *at: told.append(at)) == CONTENT
    assert told[-1] == (519, 519)
    radar.files.clear_crash_dump()
    assert radar.files.crash_dump() == b""
