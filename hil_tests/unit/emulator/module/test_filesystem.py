"""The file system and its errors. Protocol reference 4.10, 4.11 and 5.1."""

from collections.abc import Callable

import pytest

from emulator.chip.chip import Refusal
from emulator.module.memory import FileKey, FileSystem, StoredFile
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
    (False, m.CreateFile(**MISSING, length=34 * 8192), 9),  # the table, two files, 33 blocks left
    (False, m.CreateFile(**MISSING, length=0), 12),
    (False, m.CreateFile(**KEY, length=0), 12),
    (True, m.OpenFile(**KEY), 2),
    (False, m.OpenFile(**MISSING), 5),
    (False, m.SetFileData(**KEY, offset=0, data=b"x"), 6),
    (True, m.SetFileData(**KEY, offset=100, data=b"x"), 0x21),
    (True, m.SetFileData(**KEY, offset=0xFFFFFF00, data=b"x"), 0x21),
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


def user(identifier: int) -> FileKey:
    return USER, identifier


def refused(call: Callable[..., object], *arguments: object) -> int:
    with pytest.raises(Refusal) as refusal:
        call(*arguments)
    return int(refusal.value.code)


def test_ten_files_may_be_open_and_that_is_checked_before_all_but_the_file_itself() -> None:
    """4.11: order of checks of CREATE, OPEN and DELETE, which needs a free handle, too."""
    files = FileSystem(0x48000)
    for identifier in range(10):
        files.create(user(identifier), 1)
    for length in (0, 1, 1 << 31):
        assert refused(files.create, user(0), length) == 2
        assert refused(files.create, user(10), length) == 11
    files.close(user(0))
    files.create(user(10), 1)
    assert refused(files.create, user(0), 1) == 11, "although it exists"
    assert refused(files.open, user(0)) == 11
    assert refused(files.delete, user(0)) == 11
    assert refused(files.open, user(99)) == 5
    assert refused(files.delete, user(99)) == 5
    assert refused(files.delete, user(1)) == 2
    files.close(user(1))
    assert refused(files.create, user(0), 0) == 12, "length 0 before: exists"
    assert refused(files.create, user(0), 1) == 3


def test_twenty_files_exist() -> None:
    files = FileSystem(0x48000)
    for identifier in range(20):
        files.create(user(identifier), 1)
        files.close(user(identifier))
    assert refused(files.create, user(99), 1) == 9
    assert files.names() == [user(identifier) for identifier in range(20)]


@pytest.mark.parametrize(("storage", "blocks"), [(0x18000, 11), (0x48000, 35)])
def test_files_take_whole_blocks_behind_the_table(storage: int, blocks: int) -> None:
    """4.11: 8192 bytes each; the first block is the table. 35 of them hold more than 20 files."""
    files = FileSystem(storage)
    for identifier in range(min(blocks, 19)):
        files.create(user(identifier), 1)
        files.close(user(identifier))
    left = blocks - min(blocks, 19)
    assert refused(files.create, user(99), left * 8192 + 1) == 9
    if left:
        files.create(user(99), left * 8192)
        assert files.length(user(99)) == left * 8192, "the length that was asked for"
    assert files.length(user(0)) == 1


def test_files_are_listed_in_the_order_of_the_flash_and_fill_its_first_gap() -> None:
    """4.11: they never move; a new one that fits a gap is listed in the middle."""
    files = FileSystem(0x48000)
    for identifier, blocks in enumerate((1, 2, 1, 3)):
        files.create(user(identifier), blocks * 8192)
        files.close(user(identifier))
    files.delete(user(1))
    files.create(user(7), 2 * 8192 + 1)  # one block too long for the gap
    files.create(user(8), 8193)
    assert files.names() == [user(identifier) for identifier in (0, 8, 2, 3, 7)]
    assert [file.offset for file in files.contents] == [block * 8192 for block in (0, 1, 3, 4, 7)]
    assert FileSystem(0x48000, files.contents).contents == files.contents


def test_the_first_file_is_not_checked_against_the_storage() -> None:
    """4.11; nor is what follows, since the room behind it is negative, counted without sign.

    The vendor's xfs.c and xtfile.c, compiled, answer so.
    """
    files = FileSystem(0x18000)
    files.create(user(0), 0x60000)
    assert files.length(user(0)) == 0x60000
    files.create(user(1), 8192)
    assert files.names() == [user(0), user(1)]
    files.write(user(0), 0x5FFFF, b"x")
    assert files.read(user(0), 0x5FFFF, 1) == b"\xff", "no flash is there"
    files.write(user(0), 0, b"x")
    assert files.read(user(0), 0, 2) == b"x\xff"
    files.format(0x427F00C9)
    files.create(user(0), 0xFFFFFFFF)
    assert len(files.read(user(0), 0, 0xFFFFFFFF)) < 0x18000


def test_what_the_firmware_writes_itself_needs_room_too() -> None:
    files = FileSystem(4 * 8192, [StoredFile(type=1, identifier=0, data=bytes(60))])
    files.replace((2, 0), bytes(8193))
    with pytest.raises(Refusal):
        files.replace((2, 0), bytes(2 * 8192 + 1))
    assert files.length((2, 0)) == 8193
    with pytest.raises(Refusal):
        files.replace((3, 0), bytes(1))
    files.replace((2, 0), b"short")
    files.replace((3, 0), bytes(1))
    assert files.get((2, 0)) == b"short"


def test_a_new_module_has_a_parameter_file(host: BareHost) -> None:
    """16: the vendor's recorder opens type 037DD98C, identifier 0, and reads it."""
    key = {"file_type": 0x037DD98C, "identifier": 0}
    assert host.ask(m.SearchFileType(file_type=0x037DD98C)) == m.ReplyInt(values=(0,))
    assert host.ask(m.OpenFile(**key)) == m.Ack()
    reply = host.ask(m.GetFileLength(**key))
    assert isinstance(reply, m.ReplyInt)
    (length,) = reply.values
    reply = host.ask(m.GetFileData(**key, offset=0, length=length))
    assert isinstance(reply, m.ReplyByte)
    assert b"emulated" in reply.values
    assert host.ask(m.CloseFile(**key)) == m.Ack()
    assert host_of(DeviceOptions(firmware="xep")).ask(m.FindAllFiles()) == m.ReplyInt(values=())


def test_find_all_lists_types_then_identifiers(host: BareHost) -> None:
    created = m.CreateFile(file_type=0x80000005, identifier=7, length=1)
    assert host.ask(created) == m.Ack()
    types = (0x037DD98C, 0x80000005 - (1 << 32))
    assert host.ask(m.FindAllFiles()) == m.ReplyInt(values=(*types, 0, 7))
    assert host.ask(m.SearchFileType(file_type=0x80000005)) == m.ReplyInt(values=(7,))
    assert host.ask(m.SearchFileType(file_type=0x80000006)) == m.ReplyInt(values=())
    assert host.ask(m.FormatFilesystem(key=0x427F00C9)) == m.Ack(), "open files too"
    assert host.ask(m.FindAllFiles()) == m.ReplyInt(values=())


def test_deleting_takes_a_tenth_of_a_second_and_commands_wait(host: BareHost) -> None:
    with_file(host, is_open=False)
    host.send(m.DeleteFile(**KEY))
    assert host.hear() == []
    host.send(m.Ping())
    assert host.at(SECOND // 10 - 1) == []
    assert host.device.wake_ns(host.now_ns) == SECOND // 10
    assert host.at(SECOND // 10) == [m.Ack(), m.Pong(value=0xAAEEAEEA)]


def test_a_reply_longer_than_the_build_buffer_arrives_truncated(host: BareHost) -> None:
    """1.1: 8000 bytes including escapes; FF needs none, 7D does."""
    assert host.ask(m.CreateFile(**KEY, length=6000)) == m.Ack()
    reply = host.ask(m.GetFileData(**KEY, offset=0, length=6000))
    assert isinstance(reply, m.ReplyByte)
    assert len(reply.values) == 6000
    for offset in range(0, 6000, 1000):
        assert host.ask(m.SetFileData(**KEY, offset=offset, data=b"\x7d" * 1000)) == m.Ack()
    host.send(m.GetFileData(**KEY, offset=0, length=6000))
    packet = host.device.next_packet(0)
    assert packet is not None
    assert len(packet) == 8000
    assert host.ask(m.Ping()) == m.Pong(value=0xAAEEAEEA)


def test_crash_dump(host: BareHost) -> None:
    """4.10; a crash leaves a file of its own type."""
    length = m.GetCrashDumpLength()
    assert host.ask(length) == m.ReplyInt(content_id=0x61, values=(0,))
    assert host.ask(m.ClearCrashDump()) == m.Ack(), "also if none"
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
    assert host.ask(m.SearchFileType(file_type=0x04554D50)) == m.ReplyInt(values=(0,))
    assert host.ask(m.ClearCrashDump()) == m.Ack()
    assert host.ask(length) == m.ReplyInt(content_id=0x61, values=(0,))
