"""A module's file system in memory, written from Protocol reference 4.11 and 5.1."""

import struct
from collections.abc import Sequence

from hil_tests.unit.xethru_protocol.scripted import READY
from xethru_protocol.wire import messages as m

Name = tuple[int, int]
STORAGE = 0x18000
MOST_FILES, MOST_OPEN = 20, 10


class FileModule:
    """A module that keeps files; every command and its numbers are noted."""

    def __init__(self) -> None:
        self.files: dict[Name, bytearray] = {}
        self.open: set[Name] = set()
        self.crash_dump = b""
        self.received: list[m.Message] = []
        self.fail_at: int | None = None  # offset at which data commands fail with code 12

    def __call__(  # noqa: PLR0911 - one return per command
        self, command: m.Message
    ) -> Sequence[m.Message | bytes]:
        self.received.append(command)
        match command:
            case m.Ping():
                return [READY]
            case m.FindAllFiles():
                types = [name[0] for name in self.files]
                return [_ints(*types, *(name[1] for name in self.files))]
            case m.SearchFileType(file_type=kind):
                return [_ints(*(name[1] for name in self.files if name[0] == kind))]
            case m.GetCrashDumpLength():
                return [m.ReplyInt(content_id=0x61, values=(len(self.crash_dump),))]
            case m.GetCrashDump(offset=offset, length=length):
                part = self.crash_dump[offset : offset + length]
                return [m.ReplyByte(content_id=0x63, values=part)]
            case m.ClearCrashDump():
                self.crash_dump = b""
                return [m.Ack()]
            case m.FormatFilesystem(key=key):
                if key != 0x427F00C9:
                    return [m.Error(code=1)]
                self.files.clear()
                return [m.Ack()]
        return [self._one_file(command)]

    def _one_file(self, command: m.Message) -> m.Response:  # noqa: PLR0911 - one return per command
        name = (getattr(command, "file_type", -1), getattr(command, "identifier", -1))
        match command:
            case m.CreateFile(length=length):
                return self._create(name, length)
            case m.GetFileLength():
                known = name in self.files
                return _ints(len(self.files[name])) if known else m.Error(code=5)
            case m.OpenFile():
                if name in self.open:
                    return m.Error(code=2)
                return self._enter(name)
            case m.DeleteFile():
                if name in self.open:
                    return m.Error(code=2)
                return m.Ack() if self.files.pop(name, None) is not None else m.Error(code=5)
        return self._open_file(name, command) if name in self.open else m.Error(code=6)

    def _open_file(self, name: Name, command: m.Message) -> m.Response:
        content = self.files[name]
        match command:
            case m.CloseFile():
                self.open.discard(name)
                return m.Ack()
            case m.SetFileData(offset=offset) | m.GetFileData(offset=offset) if (
                offset == self.fail_at
            ):
                return m.Error(code=12)
            case m.SetFileData(offset=offset, data=data) if offset + len(data) <= len(content):
                content[offset : offset + len(data)] = data
                return m.Ack()
            case m.GetFileData(offset=offset, length=length) if offset + length <= len(content):
                return m.ReplyByte(values=bytes(content[offset : offset + length]))
        return m.Error(code=0x21)

    def _create(self, name: Name, length: int) -> m.Response:
        if name in self.files:
            return m.Error(code=3)
        if len(self.files) >= MOST_FILES:
            return m.Error(code=9)
        if length + sum(map(len, self.files.values())) > STORAGE:
            return m.Error(code=9)
        self.files[name] = bytearray(b"\xff" * length)
        return self._enter(name)

    def _enter(self, name: Name) -> m.Response:
        if name not in self.files:
            return m.Error(code=5)
        if len(self.open) >= MOST_OPEN:
            return m.Error(code=11)
        self.open.add(name)
        return m.Ack()


def _ints(*values: int) -> m.ReplyInt:
    # the wire's integers are signed: 80000000h arrives as -2**31
    signed = struct.unpack(f"<{len(values)}i", struct.pack(f"<{len(values)}I", *values))
    return m.ReplyInt(values=signed)
