"""The modes of an X4M300 written down from chapter 8 of the protocol reference, and nothing else.

Small on purpose, and knowing nothing of the emulator: which mode a module is in, which profile is
loaded, what it answers to a command group, and what it remembers. Codes are those of chapter 8.3
and, where that says [INF], the documented defaults of the emulator's options.
"""

from __future__ import annotations

from dataclasses import dataclass, field

PRESENCE_2 = 0x014D4AB8
RUN, IDLE, MANUAL, STOP, REG = 0x01, 0x11, 0x12, 0x13, 0x50
SILENCE = "silence"
OK = "ok"
APP_INVALID, COMMAND_FAILED, NOT_RECOGNIZED = 0x20, 0x21, 0x01
Verdict = str | int
VOLATILE = (0x0C, 0x0D, 0x10, 0x11, 0x12, 0x13)
DEFAULT_OUTPUTS = {0x723BFA1E: 1}


@dataclass
class Settings:
    sensitivity: int = 5
    band: int = 3
    outputs: dict[int, int] = field(default_factory=lambda: dict(DEFAULT_OUTPUTS))

    def copy(self) -> Settings:
        return Settings(self.sensitivity, self.band, dict(self.outputs))


class ModuleModel:
    def __init__(self) -> None:
        self.mode = RUN
        self.loaded = True
        self.starts_running = True
        self.now = Settings()
        self.flash = Settings()
        self.faults = 0

    @property
    def safe(self) -> bool:
        return self.faults >= 10

    @property
    def bootloader(self) -> bool:
        return self.faults > 15

    def reset(self) -> None:
        """8.2: the module comes back as it was left, without what was never run."""
        self.now = self.flash.copy()
        for feature in VOLATILE:
            self.now.outputs.pop(feature, None)
        self.mode = MANUAL if self.safe else RUN if self.starts_running else STOP
        self.loaded = self.mode == RUN

    def fault(self) -> None:
        self.faults += 1
        self.reset()

    def host_reset(self) -> None:
        self.faults = 0
        self.reset()

    def set_mode(self, mode: int) -> Verdict:
        """8.3, upper table."""
        if self.safe or mode not in (RUN, IDLE, MANUAL, STOP, REG):
            return NOT_RECOGNIZED
        if mode in (RUN, IDLE) and not self.loaded:
            return APP_INVALID
        self.mode = mode
        if mode == RUN:
            self.starts_running = True
            self.flash = self.now.copy()
        if mode == STOP:
            self.starts_running = False
        if mode not in (RUN, IDLE):
            self.loaded = False
        return OK

    def load(self, profile_id: int) -> Verdict:
        if self.safe:
            return NOT_RECOGNIZED
        if profile_id != PRESENCE_2:
            return APP_INVALID
        self.mode, self.loaded, self.starts_running = STOP, True, False
        return OK

    def may_set(self) -> Verdict:
        """8.3, lower table: row of the profile settings."""
        if self.safe:
            return NOT_RECOGNIZED
        if self.mode in (RUN, IDLE, MANUAL, REG):
            return COMMAND_FAILED
        return OK if self.loaded else NOT_RECOGNIZED

    def may_get(self, *, observed_silent: bool) -> Verdict:
        """Row of the profile GETs; 4.4 says which stay silent."""
        if self.safe:
            return NOT_RECOGNIZED
        if self.loaded:
            return OK
        return SILENCE if observed_silent else NOT_RECOGNIZED

    def may_output(self, feature: int) -> Verdict:
        """Row of OUTPUT control."""
        if self.safe:
            return NOT_RECOGNIZED
        if self.mode == RUN:
            return OK if feature in VOLATILE else COMMAND_FAILED
        if self.mode in (MANUAL, REG):
            return COMMAND_FAILED
        return OK if self.loaded else NOT_RECOGNIZED

    def set_output(self, feature: int, bits: int) -> None:
        """4.7: exclusions."""
        outputs = self.now.outputs
        if feature in (0x0C, 0x0D):
            outputs.pop(0x0C, None)
            outputs.pop(0x0D, None)
            if bits & 1:
                outputs[feature] = 1
        elif feature in VOLATILE:
            rival = {0x10: 0x11, 0x11: 0x10, 0x12: 0x13, 0x13: 0x12}[feature]
            outputs[feature] = bits & 3
            outputs[rival] = outputs.get(rival, 0) & ~(bits & 3)
        else:
            outputs[feature] = bits & 1
