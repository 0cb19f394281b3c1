"""The X4's registers: reset values, plain storage, and the ones that are the settings.

A coupled register is computed from the chip's settings when read and changes them when written,
so PIF 35h *is* the number of iterations. All others keep what was written until INIT.

Source: protocol reference 4.9, table of X4 registers and of chip reset values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from emulator.settings import ChipSettings
from xethru_protocol import x4
from xethru_protocol.codes import X4Setting

__all__ = ["COUPLED", "Coupling", "Registers"]

_RESET = {
    X4Setting.SPIREGISTER: "01:FF 02:01 03:02 04:AA 06:01 10:04 14:02 1A:01",
    X4Setting.PIFREGISTER: (
        "0E:80 0F:02 18:BF 19:01 1B:03 21:01 2A:01 2C:10 2D:10 2F:14 30:FF 31:07 34:20 35:0A "
        "37:01 3A:01 3B:C0 3E:19 4A:48 4C:0C 4D:66 4F:05 52:04 5A:03 5B:90 5D:01 5E:01 5F:60 "
        "61:07 62:01 64:80 65:30 66:07 67:01 69:80 6A:E0 6B:12 6C:41 6D:11 72:80 73:30 75:10 "
        "76:53 78:50 7A:53 7B:48"
    ),
    X4Setting.XIFREGISTER: "",
}
_DRIVER_DEFAULTS = {
    X4Setting.SPIREGISTER: {},
    X4Setting.PIFREGISTER: {106: 96, 115: 16, 73: 8, 45: 16, 67: 1, 14: 128},
    X4Setting.XIFREGISTER: {3: 63, 4: 15, 1: 0},
}
"""What the driver writes at INIT, without the registers coupled to settings."""
READ_ONLY = frozenset({(X4Setting.SPIREGISTER, address) for address in range(4)})
"""Constants and chip ids."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Coupling:
    """A register that holds part of a setting, as its value and back."""

    read: Callable[[ChipSettings], int]
    write: Callable[[ChipSettings, int], ChipSettings]


def _with_high(value: int, byte: int) -> int:
    return byte << 8 | value & 0xFF


def _with_low(value: int, byte: int) -> int:
    return value & 0xFF00 | byte


def _with_low_3(value: int, byte: int) -> int:
    return value & 0x7F8 | byte & 7


def _ignored(settings: ChipSettings, byte: int) -> ChipSettings:
    """Leave alone what follows from other settings: bytes per counter, and the receive delay.

    Assumed: the reference says what they hold, not what writing them does to the frames.
    """
    del byte
    return settings


def _area(settings: ChipSettings) -> x4.FrameArea:
    return x4.frame_area(
        settings.start_m,
        settings.end_m,
        settings.offset_m,
        downconversion=settings.downconversion != 0,
    )


# fmt: off
COUPLED: dict[int, Coupling] = {
    0x2C: Coupling(read=lambda s: s.prf_div,
                   write=lambda s, b: replace(s, prf_div=max(b, 4))),
    0x2E: Coupling(read=lambda s: s.pulses_per_step >> 8,
                   write=lambda s, b: replace(s, pulses_per_step=_with_high(s.pulses_per_step, b))),
    0x2F: Coupling(read=lambda s: s.pulses_per_step & 0xFF,
                   write=lambda s, b: replace(s, pulses_per_step=_with_low(s.pulses_per_step, b))),
    0x30: Coupling(read=lambda s: s.dac_max >> 3,
                   write=lambda s, b: replace(s, dac_max=b << 3 | s.dac_max & 7)),
    0x31: Coupling(read=lambda s: s.dac_max & 7,
                   write=lambda s, b: replace(s, dac_max=_with_low_3(s.dac_max, b))),
    0x32: Coupling(read=lambda s: s.dac_min >> 3,
                   write=lambda s, b: replace(s, dac_min=b << 3 | s.dac_min & 7)),
    0x33: Coupling(read=lambda s: s.dac_min & 7,
                   write=lambda s, b: replace(s, dac_min=_with_low_3(s.dac_min, b))),
    0x34: Coupling(read=lambda s: 0x20 | s.dac_step,
                   write=lambda s, b: replace(s, dac_step=b & 3)),
    0x35: Coupling(read=lambda s: s.iterations,
                   write=lambda s, b: replace(s, iterations=b)),
    0x65: Coupling(read=lambda s: s.tx_center_frequency << 4,
                   write=lambda s, b: replace(s, tx_center_frequency=4 if b >> 4 & 7 == 4 else 3)),
    0x75: Coupling(read=lambda s: 0x10 | s.tx_power << 5,
                   write=lambda s, b: replace(s, tx_power=b >> 5 & 3)),
    0x0F: Coupling(read=lambda s: int(s.downconversion != 0),
                   write=lambda s, b: replace(s, downconversion=b & 1)),
    0x1B: Coupling(read=lambda s: 6 if s.downconversion else 3,
                   write=_ignored),
    0x42: Coupling(read=lambda s: _area(s).rx_wait,
                   write=_ignored),
}
"""PIF registers that are settings, by address."""
# fmt: on


class Registers:
    """The stored bytes of the three register spaces, as INIT leaves them."""

    def __init__(self) -> None:
        self._bytes = {space: _parse(text) for space, text in _RESET.items()}
        for space, values in _DRIVER_DEFAULTS.items():
            self._bytes[space].update(values)

    def read(self, space: X4Setting, address: int, settings: ChipSettings) -> int:
        """Return one register; addresses without a known value read 0."""
        coupling = COUPLED.get(address) if space is X4Setting.PIFREGISTER else None
        if coupling is not None:
            return coupling.read(settings)
        return self._bytes[space].get(address, 0)

    def write(
        self, space: X4Setting, address: int, value: int, settings: ChipSettings
    ) -> ChipSettings:
        """Write one register; return the settings it leaves."""
        coupling = COUPLED.get(address) if space is X4Setting.PIFREGISTER else None
        if coupling is not None:
            return coupling.write(settings, value)
        if (space, address) not in READ_ONLY:
            self._bytes[space][address] = value
        return settings


def _parse(text: str) -> dict[int, int]:
    pairs = (item.split(":") for item in text.split())
    return {int(address, 16): int(value, 16) for address, value in pairs}
