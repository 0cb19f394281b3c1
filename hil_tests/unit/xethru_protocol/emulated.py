"""The emulated module's answers for a scripted line: no boot, no streams, no delays."""

from collections.abc import Sequence

from emulator.chip.chip import Chip
from emulator.module.commands import answer
from emulator.module.memory import FileKey, Identity
from emulator.module.settings import DeviceOptions
from emulator.module.state import Module
from hil_tests.unit.emulator.doubles import RampSource
from hil_tests.unit.xethru_protocol.scripted import ScriptedTransport
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import FORMAT_KEY, FileType, SensorMode
from xethru_protocol.wire.versions import firmware_named

STORAGE = 0x18000


class EmulatedModule:
    """A stopped module that notes its commands."""

    def __init__(self, *, stopped: bool = True, firmware: str = "sensor") -> None:
        options = DeviceOptions(storage_bytes=STORAGE, firmware=firmware)
        identity = Identity(serial="123456789012").with_firmware(firmware_named(firmware))
        self.module = Module(identity, Chip(RampSource()), options)
        if stopped:
            answer(self.module, m.SetMode(mode=SensorMode.XTID_SM_STOP))
        self.module.files.format(FORMAT_KEY)
        self.received: list[m.Message] = []
        self.fail_at: int | None = None  # offset at which a file fails with code 12
        self.run_errors: list[int] = []  # with which it refuses the next RUN commands

    @property
    def files(self) -> dict[FileKey, bytes]:
        return {file.key: file.data for file in self.module.files.contents}

    @property
    def open(self) -> set[FileKey]:
        return self.module.files._open

    def leave_crash_dump(self, content: bytes) -> None:
        self.module.files.replace((FileType.CRASH_DUMP, 0), content)

    def __call__(self, command: m.Message) -> Sequence[m.Message | bytes]:
        self.received.append(command)
        match command:
            case m.SetFileData(offset=at) | m.GetFileData(offset=at) if at == self.fail_at:
                return [m.Error(code=12)]
            case m.SetMode(mode=SensorMode.XTID_SM_RUN) if self.run_errors:
                return [m.Error(code=self.run_errors.pop(0))]
        reply = answer(self.module, command)
        return [] if reply is None else [reply]


Emulated = tuple[X4M300, ScriptedTransport, EmulatedModule]
