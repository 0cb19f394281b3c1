"""The file system and its errors. Protocol reference 4.10, 4.11 and 5.1."""

import pytest

from emulator.chip.chip import Refusal
from emulator.module.memory import FileSystem
from emulator.module.settings import DeviceOptions
from hil_tests.unit.emulator.doubles import BareHost, host_of
from xethru_protocol.wire import messages as m

SECOND = 1_000_000_000
USER = 0x80000000
KEY = {"file_type": USER, "identifier": 1}
MISSING = {"file_type": USER, "identifier": 2}


def with_file(host: BareHost, *, is_open: bool) -> None:
    assert host.ask(m.CreateFile(**KEY, length=100)) == m.Ack()
    if not is_open:
        assert host.ask(m.CloseFile(**KEY)) == m.Ack()


ERRORS: list[tuple[bool, m.Command[m.Response], int]] = [
    (True, m.CreateFile(**KEY, length=5), 2),
    (False, m.CreateFile(**KEY, length=5), 3),
    (False, m.CreateFile(**MISSING, length=0x48001), 9),
    (True, m.OpenFile(**KEY), 2),
    (False, m.OpenFile(**MISSING), 5),
    (False, m.SetFileData(**KEY, offset=0, data=b"x"), 6),
    (True, m.SetFileData(**KEY, offset=100, data=b"x"), 0x21),
    (True, m.SetFileData(**KEY, offset=0xFFFFFFFF, data=b"x"), 0x21),
    (False, m.CloseFile(**KEY), 6),
    (False, m.CloseFile(**MISSING), 6),
    (False, m.GetFileLength(**MISSING), 5),
    (False, m.GetFileData(**KEY, offset=0, length=1), 6),
    (True, m.GetFileData(**KEY, offset=1, length=100), 0x21),
    (True, m.DeleteFile(**KEY), 2),
    (False, m.DeleteFile(**MISSING), 5),
    (False, m.FormatFilesystem(key=0x427F00C8), 1),
]


@pytest.mark.parametrize(("is_open", "command", "code"), ERRORS)
def test_errors(host: BareHost, is_open: bool, command: m.Command[m.Response], code: int) -> None:
    with_file(host, is_open=is_open)
    assert host.ask(command) == m.Error(code=code)
    assert host.ask(m.GetFileLength(**KEY)) == m.ReplyInt(values=(100,)), "nothing changed"


def test_a_new_file_is_open_and_erased(host: BareHost) -> None:
    with_file(host, is_open=True)
    reply = host.ask(m.GetFileData(**KEY, offset=0, length=100))
    assert reply == m.ReplyByte(values=b"\xff" * 100)
    assert host.ask(m.SetFileData(**KEY, offset=98, data=b"ab")) == m.Ack()
    reply = host.ask(m.GetFileData(**KEY, offset=97, length=3))
    assert reply == m.ReplyByte(values=b"\xffab")


def test_ten_files_may_be_open(host: BareHost) -> None:
    for identifier in range(10):
        assert host.ask(m.CreateFile(file_type=USER, identifier=identifier, length=1)) == m.Ack()
    eleventh = m.CreateFile(file_type=USER, identifier=10, length=1)
    assert host.ask(eleventh) == m.Error(code=11)
    host.command(m.CloseFile(file_type=USER, identifier=0), eleventh)
    assert host.ask(m.OpenFile(file_type=USER, identifier=0)) == m.Error(code=11)


def test_twenty_files_exist(host: BareHost) -> None:
    for identifier in range(20):
        key = {"file_type": USER, "identifier": identifier}
        host.command(m.CreateFile(**key, length=1), m.CloseFile(**key))
    assert host.ask(m.CreateFile(file_type=USER, identifier=99, length=1)) == m.Error(code=9)
    assert host.ask(m.SearchFileType(file_type=USER)) == m.ReplyInt(values=tuple(range(20)))


@pytest.mark.parametrize(
    ("options", "storage"),
    [(DeviceOptions(storage_bytes=0x18000), 0x18000), (DeviceOptions(), 0x48000)],
)
def test_all_files_together_fill_the_storage(options: DeviceOptions, storage: int) -> None:
    host = host_of(options)
    assert host.ask(m.CreateFile(**KEY, length=storage - 10)) == m.Ack()
    assert host.ask(m.CreateFile(**MISSING, length=11)) == m.Error(code=9)
    assert host.ask(m.CreateFile(**MISSING, length=10)) == m.Ack()
    third = m.CreateFile(file_type=USER, identifier=3, length=1)
    assert host.ask(third) == m.Error(code=9)
    assert host.ask(m.FormatFilesystem(key=0x427F00C9)) == m.Ack(), "open files too"
    assert host.ask(m.FindAllFiles()) == m.ReplyInt(values=())


def test_what_the_firmware_writes_itself_needs_room_too() -> None:
    files = FileSystem(100, {(1, 0): bytes(60)})
    files.replace((2, 0), bytes(40))
    with pytest.raises(Refusal):
        files.replace((2, 0), bytes(41))
    with pytest.raises(Refusal):
        files.replace((3, 0), bytes(1))
    files.replace((1, 0), bytes(59))
    files.replace((3, 0), bytes(1))
    assert files.free_bytes == 0


def test_find_all_lists_types_then_identifiers(host: BareHost) -> None:
    for kind, identifier in ((0x80000005, 7), (0x037DD98C, 0)):
        assert host.ask(m.CreateFile(file_type=kind, identifier=identifier, length=1)) == m.Ack()
    types = (0x80000005 - (1 << 32), 0x037DD98C)
    assert host.ask(m.FindAllFiles()) == m.ReplyInt(values=(*types, 7, 0))
    assert host.ask(m.SearchFileType(file_type=0x80000005)) == m.ReplyInt(values=(7,))
    assert host.ask(m.SearchFileType(file_type=0x80000006)) == m.ReplyInt(values=())


def test_deleting_takes_a_tenth_of_a_second_and_commands_wait(host: BareHost) -> None:
    with_file(host, is_open=False)
    host.send(m.DeleteFile(**KEY))
    assert host.hear() == []
    assert not host.device.wants_data
    host.send(m.Ping())
    assert host.at(SECOND // 10 - 1) == []
    assert host.device.wake_ns(host.now_ns) == SECOND // 10
    assert host.at(SECOND // 10) == [m.Ack(), m.Pong(value=0xAAEEAEEA)]


def test_a_reply_longer_than_the_build_buffer_arrives_truncated(host: BareHost) -> None:
    """1.1: 8000 bytes including escapes; FF needs none, 7D does."""
    assert host.ask(m.CreateFile(**KEY, length=7000)) == m.Ack()
    reply = host.ask(m.GetFileData(**KEY, offset=0, length=7000))
    assert isinstance(reply, m.ReplyByte)
    assert len(reply.values) == 7000
    for offset in range(0, 7000, 1000):
        assert host.ask(m.SetFileData(**KEY, offset=offset, data=b"\x7d" * 1000)) == m.Ack()
    host.send(m.GetFileData(**KEY, offset=0, length=7000))
    packet = host.device.next_packet(0)
    assert packet is not None
    assert len(packet) == 8000
    assert host.ask(m.Ping()) == m.Pong(value=0xAAEEAEEA)


def test_crash_dump(host: BareHost) -> None:
    """4.10; a crash leaves a file of its own type."""
    length = m.GetCrashDumpLength()
    assert host.ask(length) == m.ReplyInt(content_id=0x61, values=(0,))
    assert host.ask(m.ClearCrashDump()) == m.Ack(), "also if none"
    assert host.ask(m.GetCrashDump(offset=0, length=1)) == m.Error(code=1)
    host.device.module.crash("hard fault", 0)
    host.now_ns = 3 * SECOND
    host.device.advance(host.now_ns)
    assert host.hear(2) == [m.System(code=0x10), m.System(code=0x11)]
    reply = host.ask(length)
    assert isinstance(reply, m.ReplyInt)
    (size,) = reply.values
    dump = host.ask(m.GetCrashDump(offset=0, length=size))
    assert isinstance(dump, m.ReplyByte)
    assert dump.content_id == 0x63
    assert dump.values.startswith(b"hard fault")
    part = host.ask(m.GetCrashDump(offset=5, length=5))
    assert part == m.ReplyByte(content_id=0x63, values=b"fault")
    assert host.ask(m.GetCrashDump(offset=1, length=size)) == m.Error(code=0xA0)
    assert host.ask(m.FindAllFiles()) == m.ReplyInt(values=(0x04554D50, 0))
    assert host.ask(m.ClearCrashDump()) == m.Ack()
    assert host.ask(length) == m.ReplyInt(content_id=0x61, values=(0,))
