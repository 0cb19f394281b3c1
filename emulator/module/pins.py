"""The IO pins: what each is set up as, what drives it, and the level it shows.

Levels are electrical: 1 is high. As shipped all pins are disabled, and their control is not saved:
every reset restores that (assumed; the reference names only messages as kept).

Source: protocol reference 4.8 and 5.1.
"""

from __future__ import annotations

from dataclasses import dataclass

from emulator.chip.chip import Refusal
from xethru_protocol.wire.codes import (
    IoPin,
    IoPinError,
    IoPinFeature,
    IoPinSetup,
    PresenceDirection,
    PresenceState,
)

SENSOR_PINS = tuple(pin for pin in IoPin if IoPin.IO1 <= pin <= IoPin.IO6)
XEP_PINS = tuple(pin for pin in IoPin if pin is not IoPin.ALL)
_SENSOR_FEATURES = frozenset(IoPinFeature) - {IoPinFeature.BREATHING}
"""A presence profile sees no breathing."""
_ALL_SETUP_BITS = sum(IoPinSetup)


@dataclass(frozen=True, slots=True, kw_only=True)
class PinControl:
    """What a host asked of a pin."""

    setup: int = 0
    feature: int = int(IoPinFeature.DISABLE)


_LOW_WHEN_ACTIVE = int(IoPinSetup.OUTPUT | IoPinSetup.PUSH_PULL | IoPinSetup.ACTIVE_LOW)
_DATASHEET: dict[int, PinControl] = {
    IoPin.IO1: PinControl(setup=_LOW_WHEN_ACTIVE, feature=int(IoPinFeature.PRESENCE)),
    IoPin.IO2: PinControl(setup=_LOW_WHEN_ACTIVE, feature=int(IoPinFeature.NO_PRESENCE)),
}
"""Functions of feature DEFAULT; the other pins are unused inputs."""


class IoPins:
    """The pins of one module; the base firmware has more, but nothing drives them."""

    def __init__(self, *, base_firmware: bool = False) -> None:
        self._base_firmware = base_firmware
        self.presence: int = int(PresenceState.NO_PRESENCE)
        self.movement = False
        self.reset()

    def reset(self) -> None:
        self._controls: dict[int, PinControl] = {}
        self._values: dict[int, int] = {}

    def follow(self, presence: int, direction: int) -> None:
        """Take over what the running profile reports."""
        self.presence = presence
        self.movement = presence == PresenceState.PRESENCE and direction != PresenceDirection.STILL

    def set_control(self, pin: int, setup: int, feature: int) -> None:
        """Set what a pin does, or raise `Refusal`; pin 0 is all."""
        pins = self._pins(pin)
        if self._base_firmware:
            if feature != IoPinFeature.PASSIVE:
                raise Refusal(IoPinError.WRONG_PIN)  # the firmware has one error for both
            setup = int(IoPinSetup.OUTPUT | IoPinSetup.PUSH_PULL) if setup else 0
        elif feature not in _SENSOR_FEATURES:
            raise Refusal(IoPinError.FUNCTION_NOT_AVAILABLE)
        elif setup & ~_ALL_SETUP_BITS:
            raise Refusal(IoPinError.MODE_NOT_SUPPORTED)
        for each in pins:
            self._controls[each] = PinControl(setup=setup, feature=feature)
            self._values[each] = 0

    def control(self, pin: int) -> PinControl:
        return self._controls.get(self._pins(pin)[0], PinControl())

    def set_value(self, pin: int, value: int) -> None:
        """Drive a passive output; on any other pin it shows when the pin becomes one."""
        for each in self._pins(pin):
            self._values[each] = int(value != 0)

    def value(self, pin: int) -> int:
        if pin == IoPin.ALL:
            raise Refusal(IoPinError.WRONG_PIN)
        (each,) = self._pins(pin)
        control = self._controls.get(each, PinControl())
        if control.feature == IoPinFeature.DEFAULT:
            control = _DATASHEET.get(each, PinControl())
        driven = control.feature != IoPinFeature.DISABLE and control.setup & IoPinSetup.OUTPUT
        if not driven:
            return int(bool(control.setup & IoPinSetup.PULL_UP))
        active = self._active(control.feature, each)
        return int(active != bool(control.setup & IoPinSetup.ACTIVE_LOW))

    def levels(self) -> int:
        """Return the levels of IO1...IO6 as bits, IO1 lowest."""
        return sum(self.value(pin) << (pin - IoPin.IO1) for pin in SENSOR_PINS)

    def _active(self, feature: int, pin: int) -> bool:
        if feature == IoPinFeature.PRESENCE:
            return self.presence == PresenceState.PRESENCE
        if feature == IoPinFeature.NO_PRESENCE:
            return self.presence == PresenceState.NO_PRESENCE
        if feature == IoPinFeature.MOVEMENT:
            return self.movement
        return bool(self._values.get(pin, 0))

    def _pins(self, pin: int) -> list[int]:
        known: tuple[int, ...] = XEP_PINS if self._base_firmware else SENSOR_PINS
        if pin == IoPin.ALL and not self._base_firmware:
            return list(known)
        if pin not in known:
            raise Refusal(IoPinError.WRONG_PIN)
        return [pin]
