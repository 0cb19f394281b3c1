"""Settings of a profile: detection zone, sensitivity, band, LED, noise map, messages.

`ProfileSettings` is what commands change and what a running profile obeys. Values out of range
raise `Refusal` or are clamped, as the options say.

Source: protocol reference 4.4 to 4.7.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from emulator.options import DeviceOptions
from emulator.outputs import set_output, without_volatile
from emulator.refusal import Refusal
from xethru_protocol import x4
from xethru_protocol.codes import LedMode, NoiseMapControl, OutputFeature, TxCenterFrequency

__all__ = ["ZONE_LIMITS_M", "ZONE_SIZE_M", "ProfileSettings", "snapped_zone"]

ZONE_LIMITS_M = (0.40, 9.40)
"""Smallest start and largest end of a detection zone, module metres."""
ZONE_SIZE_M = (0.20, 9.00)
"""Smallest and largest size of a detection zone, module metres."""
MAX_SENSITIVITY = 9
_NOISE_MAP_BITS = (
    NoiseMapControl.NO_DEFAULT | NoiseMapControl.ADAPTIVE | NoiseMapControl.IGNORE_STORED
)
_GRID_TOLERANCE = 1e-3
"""Part of a grid step: float32 values that were read back are on the grid."""


def snapped_zone(start_m: float, end_m: float) -> tuple[float, float]:
    """Return a zone widened to the grid of the baseband bins, module metres.

    Examples
    --------
    >>> [round(limit_m, 6) for limit_m in snapped_zone(0.4, 5.0)]
    [0.385761, 5.015391]
    """
    step_m, origin_m = x4.BASEBAND_BIN_M, x4.DEFAULT_OFFSET_M
    first = math.floor((start_m - origin_m) / step_m + _GRID_TOLERANCE)
    last = math.ceil((end_m - origin_m) / step_m - _GRID_TOLERANCE)
    return origin_m + first * step_m, origin_m + last * step_m


@dataclass(slots=True, kw_only=True)
class ProfileSettings:
    """What one profile is set to; as shipped unless told otherwise.

    Attributes
    ----------
    zone_m
        Actual detection zone, start and end, on the grid [module metres].
    sensitivity
        0...9.
    tx_center_frequency
        Band: 3 low, 4 high.
    led
        `LedMode`.
    noise_map_control
        `NoiseMapControl` bits.
    noise_map_interval_min
        Interval at which the noise map is stored, 0 for never [min].
    outputs
        Control bits by message id; what is off is absent.
    debug_outputs
        The same for the debug line.
    """

    zone_m: tuple[float, float] = snapped_zone(*ZONE_LIMITS_M)
    sensitivity: int = 5
    tx_center_frequency: int = int(TxCenterFrequency.LOW_BAND)
    led: int = int(LedMode.FULL)
    noise_map_control: int = int(_NOISE_MAP_BITS)
    noise_map_interval_min: int = 0
    outputs: dict[int, int] = field(default_factory=lambda: {int(OutputFeature.PRESENCE_SINGLE): 1})
    debug_outputs: dict[int, int] = field(default_factory=dict)

    @classmethod
    def shipped(cls, options: DeviceOptions) -> ProfileSettings:
        """Return the settings a module leaves the factory with."""
        return cls(outputs={int(options.default_output): 1})

    def copy(self) -> ProfileSettings:
        """Return settings that change independently."""
        return replace(self, outputs=dict(self.outputs), debug_outputs=dict(self.debug_outputs))

    def after_reset(self) -> ProfileSettings:
        """Return a copy without the messages that every reset switches off."""
        return replace(
            self,
            outputs=without_volatile(self.outputs),
            debug_outputs=without_volatile(self.debug_outputs),
        )

    def set_zone(self, start_m: float, end_m: float, options: DeviceOptions) -> None:
        """Choose the zone; what was read back of a zone may be written again."""
        if not (math.isfinite(start_m) and math.isfinite(end_m)):
            raise Refusal(options.bad_value_error)
        lowest_m, highest_m = snapped_zone(*ZONE_LIMITS_M)
        tolerance_m = _GRID_TOLERANCE * x4.BASEBAND_BIN_M
        if abs(start_m - lowest_m) < tolerance_m:
            start_m = ZONE_LIMITS_M[0]
        if abs(end_m - highest_m) < tolerance_m:
            end_m = ZONE_LIMITS_M[1]
        start_m = _checked(start_m, *ZONE_LIMITS_M, options)
        end_m = _checked(end_m, *ZONE_LIMITS_M, options)
        if options.bad_value == "clamp":
            end_m = max(end_m, start_m)
            start_m = min(start_m, ZONE_LIMITS_M[1] - ZONE_SIZE_M[0])
            end_m = max(end_m, start_m + ZONE_SIZE_M[0])
        elif not ZONE_SIZE_M[0] - tolerance_m <= end_m - start_m:
            raise Refusal(options.bad_value_error)
        self.zone_m = snapped_zone(start_m, end_m)

    def set_sensitivity(self, value: int, options: DeviceOptions) -> None:
        """Choose the sensitivity, 0...9."""
        self.sensitivity = int(_checked(value, 0, MAX_SENSITIVITY, options))

    def set_band(self, value: int, options: DeviceOptions) -> None:
        """Choose the band, 3 or 4."""
        lowest, highest = TxCenterFrequency.LOW_BAND, TxCenterFrequency.HIGH_BAND
        self.tx_center_frequency = int(_checked(value, lowest, highest, options))

    def set_led(self, value: int, options: DeviceOptions) -> None:
        """Choose what the LED shows, 0...2."""
        self.led = int(_checked(value, LedMode.OFF, LedMode.FULL, options))

    def set_noise_map_control(self, control: int) -> None:
        """Choose where the noise map comes from; unknown bits are not kept."""
        self.noise_map_control = int(control & _NOISE_MAP_BITS)

    def set_output(self, feature: int, control: int) -> None:
        """Switch a message, and with it those it excludes."""
        self.outputs = set_output(self.outputs, feature, control)

    def set_debug_output(self, feature: int, control: int) -> None:
        """Switch a message of the debug line, and with it those it excludes."""
        self.debug_outputs = set_output(self.debug_outputs, feature, control)


def _checked(value: float, lowest: float, highest: float, options: DeviceOptions) -> float:
    """Return a value within limits, or what the options say of one outside.

    Limits are met in float32: 9.4 arrives as 9.3999996185.
    """
    tolerance = 1e-6 * max(abs(highest), 1.0)
    if lowest - tolerance <= value <= highest + tolerance:
        return min(max(value, lowest), highest)
    if options.bad_value == "clamp":
        return min(max(value, lowest), highest)
    raise Refusal(options.bad_value_error)
