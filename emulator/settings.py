"""Settings of the X4 and the checks its driver makes before it takes one.

Source: protocol reference 4.9, 5.1 and 9.3.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from emulator.downconversion import CHANNELS
from emulator.refusal import Refusal
from xethru_protocol import x4
from xethru_protocol.codes import ErrorCode, X4Error, X4Setting
from xethru_protocol.messages import X4Value

__all__ = ["SETTERS", "ChipSettings", "Setter"]

DAC_LEVELS = 2048


@dataclass(frozen=True, slots=True, kw_only=True)
class ChipSettings:
    """Settings of the X4 as its driver keeps them after INIT. Source: protocol reference 9.3.

    Attributes
    ----------
    fps
        Requested frame rate, float32 value.
    pulses_per_step
        Low 16 bits of what was set.
    iterations
        Low 8 bits of what was set.
    downconversion
        0 for RF frames, anything else for baseband.
    start_m
        Requested frame area start, float32 value, module metres.
    end_m
        Requested frame area end, after shortening to the chip's maximum.
    offset_m
        Frame area offset, float32 value, module metres.
    dac_step
        Exponent of the DAC step, 0...3.
    dac_min
        Lowest DAC level.
    dac_max
        Highest DAC level; may lie below `dac_min`, as in the firmware.
    tx_center_frequency
        3 or 4.
    tx_power
        0 (off)...3.
    prf_div
        Divider of the 243 MHz clock, 4...255.
    """

    fps: float = 0.0
    pulses_per_step: int = 10
    iterations: int = 8
    downconversion: int = 0
    start_m: float = x4.FULL_AREA_M[0]
    end_m: float = x4.FULL_AREA_M[1]
    offset_m: float = float(np.float32(x4.DEFAULT_OFFSET_M))
    dac_step: int = 0
    dac_min: int = 0
    dac_max: int = 2047
    tx_center_frequency: int = 3
    tx_power: int = 2
    prf_div: int = 16


def _number(value: X4Value) -> float:
    if isinstance(value, tuple):
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    return value


def _integer(value: X4Value) -> int:
    return int(_number(value))


def _set_fps(settings: ChipSettings, value: X4Value) -> ChipSettings:
    fps = _number(value)
    # the reference is silent on NaN and infinity; a timer cannot run at either
    return replace(settings, fps=fps if math.isfinite(fps) else 0.0)


def _set_frame_area(settings: ChipSettings, value: X4Value) -> ChipSettings:
    if not isinstance(value, tuple):
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    start_m, end_m = value
    if not (math.isfinite(start_m) and math.isfinite(end_m)) or start_m > end_m:
        raise Refusal(X4Error.FRAME_AREA_END_OUT_OF_SCOPE)
    return replace(settings, start_m=start_m, end_m=end_m)


def _set_offset(settings: ChipSettings, value: X4Value) -> ChipSettings:
    offset_m = _number(value)
    if not math.isfinite(offset_m):
        raise Refusal(X4Error.GENERAL_FAILURE)
    return replace(settings, offset_m=offset_m)


def _set_dac_step(settings: ChipSettings, value: X4Value) -> ChipSettings:
    step = _integer(value) & 0xFF
    if step > 3:
        raise Refusal(X4Error.INVALID_DAC_STEP)
    return replace(settings, dac_step=step)


def _dac_level(value: X4Value) -> int:
    level = _integer(value) & 0xFFFF
    if level >= DAC_LEVELS:
        raise Refusal(X4Error.GENERAL_FAILURE)
    return level


def _set_tx_center_frequency(settings: ChipSettings, value: X4Value) -> ChipSettings:
    if value not in CHANNELS:
        raise Refusal(X4Error.INVALID_TX_CENTER_FREQUENCY)
    return replace(settings, tx_center_frequency=_integer(value))


def _set_tx_power(settings: ChipSettings, value: X4Value) -> ChipSettings:
    if value not in range(4):
        raise Refusal(X4Error.INVALID_TX_POWER)
    return replace(settings, tx_power=_integer(value))


def _set_prf_div(settings: ChipSettings, value: X4Value) -> ChipSettings:
    divider = _integer(value)
    if divider < 4:
        raise Refusal(X4Error.PRF_DIV_TOO_SMALL)
    return replace(settings, prf_div=divider)


Setter = Callable[[ChipSettings, X4Value], ChipSettings]
"""(settings, value) -> changed settings, or `Refusal`."""

SETTERS: dict[X4Setting, Setter] = {
    X4Setting.FPS: _set_fps,
    X4Setting.PULSESPERSTEP: lambda s, v: replace(s, pulses_per_step=_integer(v) & 0xFFFF),
    X4Setting.ITERATIONS: lambda s, v: replace(s, iterations=_integer(v) & 0xFF),
    X4Setting.DOWNCONVERSION: lambda s, v: replace(s, downconversion=_integer(v)),
    X4Setting.FRAMEAREA: _set_frame_area,
    X4Setting.DACSTEP: _set_dac_step,
    X4Setting.DACMIN: lambda s, v: replace(s, dac_min=_dac_level(v)),
    X4Setting.DACMAX: lambda s, v: replace(s, dac_max=_dac_level(v)),
    X4Setting.FRAMEAREAOFFSET: _set_offset,
    X4Setting.TXCENTERFREQUENCY: _set_tx_center_frequency,
    X4Setting.TXPOWER: _set_tx_power,
    X4Setting.PRFDIV: _set_prf_div,
}
