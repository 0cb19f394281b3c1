"""One module: the state that commands act on, and what it keeps over a reset.

Source: protocol reference 4, 8.2 and 8.5.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from emulator.chip.chip import NS_PER_S, Chip, Refusal
from emulator.module.bootloader import PAGE_COUNT, SMALL_PAGE_COUNT, Bootloader
from emulator.module.memory import (
    ERASED,
    FileSystem,
    Identity,
    Memory,
    SavedState,
    StoredFile,
)
from emulator.module.modes import ModeMachine, ModuleState, Start
from emulator.module.pins import IoPins
from emulator.module.settings import DeviceOptions, ProfileSettings
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import (
    POWER_UP_BAUD,
    ErrorCode,
    FileType,
    PresenceDirection,
    PresenceState,
    TraceLevel,
)
from xethru_protocol.wire.versions import firmware_named

CRASH_DUMP = (int(FileType.CRASH_DUMP), 0)
PARAMETER_FILE = (int(FileType.PARAMETER_FILE), 0)
SHIPPED_PARAMETERS = b"; an emulated module computes its profile without stored parameters\n"
"""Content of the parameter file, which a host finds and copies; assumed."""
NOISE_MAPS = ((int(FileType.NOISEMAP_SLOW), 0), (int(FileType.NOISEMAP_FAST), 0))
NS_PER_MIN = 60 * NS_PER_S
SAFE_MODE_FAULTS = 10
"""Consecutive faults that start safe mode."""
BOOTLOADER_FAULTS = 15
"""Faults that are still answered with safe mode; the next one ends in the bootloader."""
WATCHDOG_MEMORY_NS = 300 * NS_PER_S
"""Time without fault after which the count of consecutive faults is cleared (8.5)."""
NOISE_MAP_STORE_NS = NS_PER_S // 10
"""How long a noise map takes to store; another store meanwhile is refused (4.4)."""
APP_START_NS = NS_PER_S // 10
"""From the answer to START_APP to the start of the application."""
LARGE_STORAGE = 0x48000
"""File storage of a microcontroller with 2 MB of flash."""
ACK_WAIT_NS = NS_PER_S // 2
"""From the ACK of some commands to what they do. Protocol reference 3."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PendingRestart:
    """A restart that is due, at a time (as after a fault) or half a second after the ACK (None)."""

    into_bootloader: bool = False
    at_ns: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Wait:
    """A wait inside a command, in which no other is carried out. Protocol reference 3."""

    duration_ns: int
    before_reply: bool = False


def _placeholder_noise_maps() -> tuple[bytes, bytes]:
    return b"\x00" * 64, b"\x00" * 64


def _as_shipped(identity: Identity, options: DeviceOptions) -> SavedState:
    """Return the flash of a new module: the profile layer has put a parameter file there."""
    kind, identifier = PARAMETER_FILE
    parameters = StoredFile(type=kind, identifier=identifier, data=SHIPPED_PARAMETERS)
    return SavedState(
        serial=identity.serial,
        start="RUN",
        profile_id=options.product.profiles[0],
        profiles=[],
        files=[] if firmware_named(options.firmware).sensor is None else [parameters],
        parameter_file_name="",
        certification=False,
    )


class Module:
    """The state of one X4M300.

    Parameters
    ----------
    options
        How it differs from a stock X4M300; not at all if None.
    memory
        Where its flash is kept; None forgets it with the module.

    Attributes
    ----------
    firmware
        Versions of what it plays.
    profile
        Settings of the profile loaded last.
    postprocessing
        Frame post-processing settings by id; kept, without effect on frames.
    i2c
        Bytes last written to each I2C address.
    uart_baudrate
        Rate of its UART; a change takes effect half a second after its ACK.
    trace_level
        How much it reports as DATA STRING.
    certification
        Whether it starts in certification mode.
    noise_maps
        Returns the current noise maps, slow and fast, as bytes; set by what computes them.
    restart
        A restart asked for; the owner of the clock carries it out.
    notices
        Messages to send before the reply.
    wait
        How long the current command keeps others waiting, before or after its reply; None: not.
    asleep
        Whether nothing but a power cycle brings it back.
    """

    def __init__(
        self,
        identity: Identity,
        chip: Chip,
        options: DeviceOptions | None = None,
        memory: Memory | None = None,
    ) -> None:
        self.options = options or DeviceOptions()
        self.firmware = firmware_named(self.options.firmware)
        named = "-" in self.options.firmware
        self.identity = identity.with_firmware(self.firmware) if named else identity
        self.chip = chip
        self._memory = memory
        saved = (None if memory is None else memory.load()) or _as_shipped(identity, self.options)
        self._saved_profiles = {one.profile_id: one for one in saved.profiles}
        start = Start(state=ModuleState[saved.start], profile_id=saved.profile_id)
        profiles = self.options.product.profiles
        if start.profile_id not in profiles:  # of another model
            start = Start(profile_id=int(profiles[0]))
        self.modes = ModeMachine(self.options.product, start)
        self.files = FileSystem(self.options.storage_bytes, saved.files)
        self.certification = saved.certification
        small = self.options.storage_bytes < LARGE_STORAGE
        self.bootloader = Bootloader(
            identity.core_id,
            page_count=SMALL_PAGE_COUNT if small else PAGE_COUNT,
            unlocked=saved.unfinished_update,
        )
        self.parameter_file_name = saved.parameter_file_name
        self.pins = IoPins(base_firmware=self.firmware.sensor is None)
        self._faults = 0  # in a row
        self._last_fault_ns = 0
        self.noise_maps: Callable[[], tuple[bytes, bytes]] = _placeholder_noise_maps
        self.now_ns = 0
        self.restart: PendingRestart | None
        self._baudrate_change: tuple[int, int] | None
        self._sleep_ns: int | None
        self.wait: Wait | None
        self._noise_map_busy_until_ns: int
        self._noise_map_stored_ns: int
        self._power_up_parts(into_bootloader=False)

    @property
    def state(self) -> ModuleState:
        return self.modes.state

    @property
    def base_firmware(self) -> bool:
        """Whether only the base firmware runs: option "xep", or safe mode."""
        return self.state in (ModuleState.XEP, ModuleState.SAFE)

    def power_up(self, *, into_bootloader: bool = False) -> None:
        """Restart: chip defaults, saved settings, and the mode the module was left in."""
        self.chip.power_up()
        self._power_up_parts(into_bootloader=into_bootloader)

    def power_cycle(self, now_ns: int) -> None:
        """Restart at once, as after a power cut, which ends a series of faults."""
        self._faults = 0
        self.restart = PendingRestart(at_ns=now_ns)

    def advance(self, now_ns: int) -> None:
        self.now_ns = now_ns
        if self._baudrate_change is not None and now_ns >= self._baudrate_change[0]:
            self.uart_baudrate = self._baudrate_change[1]
            self._baudrate_change = None
        if self._sleep_ns is not None and now_ns >= self._sleep_ns:
            self.asleep = True
        interval_ns = self.profile.noise_map_interval_min * NS_PER_MIN
        running = self.state is ModuleState.RUN
        if running and interval_ns and now_ns - self._noise_map_stored_ns >= interval_ns:
            with suppress(Refusal):  # no room: the next interval tries again
                self.store_noise_maps()
            self._noise_map_stored_ns = now_ns

    def store_noise_maps(self) -> None:
        """Store the noise maps as files, or raise `Refusal`."""
        if self.now_ns < self._noise_map_busy_until_ns:
            raise Refusal(ErrorCode.XTS_SPRE_BUSY)
        for key, data in zip(NOISE_MAPS, self.noise_maps(), strict=True):
            self.files.replace(key, data or ERASED)  # no file is empty
        self._noise_map_busy_until_ns = self.now_ns + NOISE_MAP_STORE_NS
        self.save()

    def change_baudrate(self, baudrate: int) -> None:
        """Change the UART's rate once the ACK has left; none if it stays as it is."""
        self.wait = Wait(duration_ns=ACK_WAIT_NS)
        self._baudrate_change = (self.now_ns + ACK_WAIT_NS, baudrate)

    def sleep(self) -> None:
        """Stop for good once the ACK has left."""
        self.wait = Wait(duration_ns=ACK_WAIT_NS)
        self._sleep_ns = self.now_ns + ACK_WAIT_NS

    def request_restart(self, *, into_bootloader: bool = False) -> None:
        """Restart as the host commands, which ends a series of faults."""
        self._faults = 0
        self.wait = Wait(duration_ns=ACK_WAIT_NS)
        self.restart = PendingRestart(into_bootloader=into_bootloader)

    def crash(self, reason: str, now_ns: int) -> None:
        """Fail as by a watchdog or a hard fault: leave a crash dump and restart at once."""
        if self.state is ModuleState.BOOTLOADER or self.asleep:
            return
        if now_ns - self._last_fault_ns >= WATCHDOG_MEMORY_NS:
            self._faults = 0
        self._faults += 1
        self._last_fault_ns = now_ns
        dump = f"{reason}\nat {now_ns} ns\nfault {self._faults} in a row\n".encode()
        self.files.close_all()
        with suppress(Refusal):  # no room for a dump: the firmware has nowhere else to put it
            self.files.replace(CRASH_DUMP, dump)
        self.save()
        into_bootloader = self._faults > BOOTLOADER_FAULTS
        self.restart = PendingRestart(into_bootloader=into_bootloader, at_ns=now_ns)
        if into_bootloader:
            self._faults = 0

    def receive_in_bootloader(self, data: bytes) -> list[bytes]:
        """Take bytes that the bootloader answers, and return the payloads of its answers."""
        unfinished = self.bootloader.stays
        answers = list(self.bootloader.receive(data))
        if self.bootloader.started and self.restart is None:
            self.restart = PendingRestart(at_ns=self.now_ns + APP_START_NS)
        if self.bootloader.stays is not unfinished:
            self.save()
        return answers

    def load_profile(self, profile_id: int) -> None:
        """Load a profile with its own last settings, or raise `Refusal`."""
        self.modes.load_profile(profile_id)
        self.profile = self._settings_of(profile_id)
        self.save()

    def set_mode(self, mode: int) -> None:
        """Change the mode, or raise `Refusal`; starting a profile saves its settings."""
        self.modes.set_mode(mode)
        if self.state is ModuleState.RUN:
            self._saved_profiles[self.modes.profile_id] = self.profile.model_copy()
            self._noise_map_stored_ns = self.now_ns
        else:
            self.pins.follow(PresenceState.UNKNOWN, PresenceDirection.STILL)
        self.save()

    def restore_factory_settings(self) -> None:
        self.profile = ProfileSettings.shipped(self.modes.profile_id, self.options)
        self._working[self.modes.profile_id] = self.profile

    def save(self) -> None:
        if self._memory is None:
            return
        self._memory.save(
            SavedState(
                serial=self.identity.serial,
                start=self.modes.start.state.name,
                profile_id=self.modes.start.profile_id,
                profiles=[one.after_reset() for one in self._saved_profiles.values()],
                files=self.files.contents,
                parameter_file_name=self.parameter_file_name,
                certification=self.certification,
                unfinished_update=self.bootloader.stays,
            )
        )

    def trace(self, level: TraceLevel, text: str) -> None:
        """Send a DATA STRING if the trace level includes it."""
        if level <= self.trace_level:
            self.notices.append(m.DataString(text=text))

    def _power_up_parts(self, *, into_bootloader: bool) -> None:
        self.restart = None
        self.notices: list[m.Response] = []
        self.wait = None
        self.asleep = False
        self._sleep_ns = None
        self.uart_baudrate = POWER_UP_BAUD
        self._baudrate_change = None
        self.trace_level: int = TraceLevel.NONE
        self.postprocessing: dict[int, m.PostprocessingValue] = {}
        self.i2c: dict[int, bytes] = {}
        self.i2c_address = 0
        self._noise_map_busy_until_ns = 0
        self._noise_map_stored_ns = self.now_ns
        self.files.close_all()
        self.pins.reset()
        self.bootloader.power_up()
        self._working: dict[int, ProfileSettings] = {}
        self.modes.power_up(self._first_state(into_bootloader))
        self.profile = self._settings_of(self.modes.start.profile_id)

    def _first_state(self, into_bootloader: bool) -> ModuleState | None:
        if into_bootloader or self.bootloader.stays:
            return ModuleState.BOOTLOADER
        if self._faults >= SAFE_MODE_FAULTS:
            return ModuleState.SAFE
        if self.firmware.sensor is None:
            return ModuleState.XEP
        return ModuleState.REG if self.certification else None

    def _settings_of(self, profile_id: int) -> ProfileSettings:
        """Return the settings a profile works with: changed, else saved, else as shipped."""
        if profile_id not in self._working:
            saved = self._saved_profiles.get(profile_id)
            self._working[profile_id] = (
                ProfileSettings.shipped(profile_id, self.options)
                if saved is None
                else saved.after_reset()
            )
        return self._working[profile_id]
