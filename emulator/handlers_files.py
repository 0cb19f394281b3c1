"""Handlers of the file system and of the crash dump, which is a file.

Source: protocol reference 4.10 and 4.11.
"""

from __future__ import annotations

from emulator.handler_table import answers
from emulator.module import CRASH_DUMP, Module
from emulator.refusal import Refusal
from xethru_protocol import messages as m
from xethru_protocol.codes import DirCode, ErrorCode


def _signed(value: int) -> int:
    return value - (1 << 32) if value >> 31 else value


@answers(m.SearchFileType)
def _search(module: Module, command: m.SearchFileType) -> m.Response:
    found = (identifier for kind, identifier in module.files.names() if kind == command.file_type)
    return m.ReplyInt(values=tuple(_signed(identifier) for identifier in found))


@answers(m.FindAllFiles)
def _find_all(module: Module, command: m.FindAllFiles) -> m.Response:
    keys = module.files.names()
    types = [kind for kind, _ in keys]
    identifiers = [identifier for _, identifier in keys]
    return m.ReplyInt(values=tuple(_signed(value) for value in types + identifiers))


@answers(m.CreateFile)
def _create(module: Module, command: m.CreateFile) -> m.Response:
    module.files.create((command.file_type, command.identifier), command.length)
    module.save()
    return m.Ack()


@answers(m.OpenFile)
def _open(module: Module, command: m.OpenFile) -> m.Response:
    module.files.open((command.file_type, command.identifier))
    return m.Ack()


@answers(m.SetFileData)
def _write(module: Module, command: m.SetFileData) -> m.Response:
    module.files.write((command.file_type, command.identifier), command.offset, command.data)
    module.save()
    return m.Ack()


@answers(m.CloseFile)
def _close(module: Module, command: m.CloseFile) -> m.Response:
    module.files.close((command.file_type, command.identifier))
    return m.Ack()


@answers(m.GetFileLength)
def _length(module: Module, command: m.GetFileLength) -> m.Response:
    return m.ReplyInt(values=(module.files.length((command.file_type, command.identifier)),))


@answers(m.GetFileData)
def _read(module: Module, command: m.GetFileData) -> m.Response:
    key = command.file_type, command.identifier
    return m.ReplyByte(values=module.files.read(key, command.offset, command.length))


@answers(m.DeleteFile)
def _delete(module: Module, command: m.DeleteFile) -> m.Response:
    module.files.delete((command.file_type, command.identifier))
    module.reply_delay_ns = module.options.file_delete_ns
    module.save()
    return m.Ack()


@answers(m.FormatFilesystem)
def _format(module: Module, command: m.FormatFilesystem) -> m.Response:
    module.files.format(command.key)
    module.save()
    return m.Ack()


@answers(m.GetCrashDumpLength)
def _crash_dump_length(module: Module, command: m.GetCrashDumpLength) -> m.Response:
    dump = module.files.get(CRASH_DUMP) or b""
    return m.ReplyInt(content_id=DirCode.XTS_SDC_GET_CRASH_DUMP_LENGTH, values=(len(dump),))


@answers(m.ClearCrashDump)
def _clear_crash_dump(module: Module, command: m.ClearCrashDump) -> m.Response:
    if module.files.is_open(CRASH_DUMP):
        raise Refusal(ErrorCode.XTS_SPRE_BUSY)
    if module.files.get(CRASH_DUMP) is not None:
        module.files.delete(CRASH_DUMP)
        module.save()
    return m.Ack()


@answers(m.GetCrashDump)
def _crash_dump(module: Module, command: m.GetCrashDump) -> m.Response:
    dump = module.files.get(CRASH_DUMP)
    if dump is None:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    end = command.offset + command.length
    if end > len(dump):
        raise Refusal(ErrorCode.XTS_SPRE_USER)
    content_id = DirCode.XTS_SDC_GET_CRASH_DUMP
    return m.ReplyByte(content_id=content_id, values=dump[command.offset : end])
