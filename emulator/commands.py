"""What a module answers to each command: one row per command.

To add a command, write a function ``(module, command) -> response`` under ``@answers(Command)``;
raise `Refusal` for an ERROR. Commands without a row get ERROR 1, as the firmware does.

Source: protocol reference 3, 4 and 5.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from emulator.chip import Chip
from emulator.identity import Identity
from emulator.modes import ModeMachine
from emulator.options import DeviceOptions
from emulator.profile_settings import ProfileSettings
from emulator.refusal import Refusal
from xethru_protocol import messages as m
from xethru_protocol.codes import DirCode, ErrorCode, PongCode, X4Setting

__all__ = ["HANDLERS", "Module", "answer", "answers"]

LONGEST_READ = 4096
"""Register bytes one READ may ask for; the firmware checks nothing, its reply buffer would end."""


class Module:
    """The state of one X4M300 that commands act on.

    Attributes
    ----------
    identity
        What it says about itself.
    chip
        Its radar chip.
    modes
        Its mode machine.
    options
        How it answers what the reference leaves open.
    profile
        Settings of the loaded profile.
    reset_requested
        True once MOD_RESET was acknowledged; whoever keeps the time restarts the module.
    """

    def __init__(
        self, identity: Identity, chip: Chip, options: DeviceOptions | None = None
    ) -> None:
        self.identity = identity
        self.chip = chip
        self.options = options or DeviceOptions()
        self.profile = ProfileSettings.shipped(self.options)
        self.modes = ModeMachine()
        self.reset_requested = False

    def power_up(self) -> None:
        """Restart: chip defaults, and the mode the module was left in."""
        self.chip.init()
        self.modes.power_up()
        self.reset_requested = False


Handler = Callable[[Module, Any], m.Response]
HANDLERS: dict[type[m.Message], Handler] = {}
HandlerT = TypeVar("HandlerT", bound=Handler)


def answers(command: type[m.Command[Any]]) -> Callable[[HandlerT], HandlerT]:
    """Enter a handler into the table."""

    def enter(handler: HandlerT) -> HandlerT:
        HANDLERS[command] = handler
        return handler

    return enter


def answer(module: Module, command: m.Message) -> m.Response:
    """Carry out one command and return its reply; never raises on anything a host can send."""
    handler = HANDLERS.get(type(command))
    if handler is None:
        return m.Error(code=ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    try:
        return handler(module, command)
    except Refusal as refusal:
        return m.Error(code=refusal.code)


@answers(m.Ping)
def _ping(module: Module, command: m.Ping) -> m.Response:
    return m.Pong(value=PongCode.XTS_SPRP_READY)


@answers(m.ModReset)
def _reset(module: Module, command: m.ModReset) -> m.Response:
    module.reset_requested = True
    return m.Ack()


@answers(m.SetMode)
def _set_mode(module: Module, command: m.SetMode) -> m.Response:
    module.modes.set_mode(command.mode)
    return m.Ack()


@answers(m.GetMode)
def _get_mode(module: Module, command: m.GetMode) -> m.Response:
    return m.ReplyByte(values=bytes([module.modes.mode]))


@answers(m.LoadApp)
def _load_app(module: Module, command: m.LoadApp) -> m.Response:
    module.modes.load_profile(command.profile_id)
    return m.Ack()


@answers(m.GetProfileId)
def _get_profile_id(module: Module, command: m.GetProfileId) -> m.Response:
    return m.ReplyInt(values=(module.modes.profile_id,))


@answers(m.SystemGetInfo)
def _system_get_info(module: Module, command: m.SystemGetInfo) -> m.Response:
    text = module.identity.info(command.item)
    if text is None:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    return m.ReplyString(content_id=DirCode.XTS_SDC_SYSTEM_GET_INFO, info=command.item, text=text)


@answers(m.SetBaudRate)
def _set_baud_rate(module: Module, command: m.SetBaudRate) -> m.Response:
    return m.Ack()  # USB ignores the rate


@answers(m.X4DriverInit)
def _x4_init(module: Module, command: m.X4DriverInit) -> m.Response:
    module.chip.init()
    return m.Ack()


@answers(m.X4DriverSet)
def _x4_set(module: Module, command: m.X4DriverSet) -> m.Response:
    module.chip.set(command.setting, command.value)
    return m.Ack()


_BYTE_REPLIES = frozenset(
    {
        X4Setting.DOWNCONVERSION,
        X4Setting.DACSTEP,
        X4Setting.TXCENTERFREQUENCY,
        X4Setting.TXPOWER,
        X4Setting.PRFDIV,
    }
)


@answers(m.X4DriverGet)
def _x4_get(module: Module, command: m.X4DriverGet) -> m.Response:
    setting = command.setting
    if command.address is not None:
        byte = module.chip.read_register(setting, command.address)
        return m.ReplyByte(content_id=setting, values=bytes([byte]))
    value = module.chip.get(setting)
    if isinstance(value, tuple):
        return m.ReplyFloat(content_id=setting, values=(float(value[0]), float(value[1])))
    if isinstance(value, float):
        return m.ReplyFloat(content_id=setting, values=(value,))
    if setting in _BYTE_REPLIES:
        return m.ReplyByte(content_id=setting, values=bytes([value]))
    return m.ReplyInt(content_id=setting, values=(value,))


@answers(m.X4DriverWrite)
def _x4_write(module: Module, command: m.X4DriverWrite) -> m.Response:
    _check_block_access(command.setting)
    # Assumed: consecutive registers, wrapping at 256; the reference names only the first.
    for address, byte in enumerate(command.values, start=command.address):
        module.chip.write_register(command.setting, address, byte)
    return m.Ack()


@answers(m.X4DriverRead)
def _x4_read(module: Module, command: m.X4DriverRead) -> m.Response:
    _check_block_access(command.setting)
    if command.length > LONGEST_READ:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    addresses = range(command.address, command.address + command.length)  # as in WRITE
    values = bytes(module.chip.read_register(command.setting, address) for address in addresses)
    return m.ReplyByte(content_id=command.setting, values=values)


def _check_block_access(setting: X4Setting) -> None:
    if setting is not X4Setting.SPIREGISTER:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
