"""Which messages a profile sends: control bits, exclusions, and what a reset switches off.

A table of bits by message id holds only messages that are on.

Source: protocol reference 4.7 and 11, row 5.
"""

from __future__ import annotations

from collections.abc import Mapping

from xethru_protocol.codes import MatrixControl, OutputControl, OutputFeature

__all__ = ["MATRIX", "VOLATILE", "set_output", "without_volatile"]

_BASEBAND = frozenset({OutputFeature.BASEBAND_IQ, OutputFeature.BASEBAND_AMPLITUDE_PHASE})
_RIVALS: dict[int, OutputFeature] = {
    OutputFeature.PULSEDOPPLER_FLOAT: OutputFeature.PULSEDOPPLER_BYTE,
    OutputFeature.PULSEDOPPLER_BYTE: OutputFeature.PULSEDOPPLER_FLOAT,
    OutputFeature.NOISEMAP_FLOAT: OutputFeature.NOISEMAP_BYTE,
    OutputFeature.NOISEMAP_BYTE: OutputFeature.NOISEMAP_FLOAT,
}
"""Messages of the same matrices; an instance is sent as one of them."""

MATRIX: frozenset[int] = frozenset(_RIVALS)
"""Messages whose control has a bit per instance, `MatrixControl`."""
VOLATILE: frozenset[int] = MATRIX | _BASEBAND
"""Messages that are off after every reset."""


def set_output(outputs: Mapping[int, int], feature: int, control: int) -> dict[int, int]:
    """Return the table after one message was switched.

    Examples
    --------
    >>> set_output({0x0C: 1}, 0x0D, 1)
    {13: 1}
    >>> set_output({0x10: 3}, 0x11, 2)
    {16: 1, 17: 2}
    """
    changed = dict(outputs)
    if feature in _BASEBAND:
        for excluded in _BASEBAND:  # switching either off switches both off
            changed.pop(excluded, None)
        _keep(changed, feature, control & _SWITCH, control & OutputControl.ON)
    elif feature in MATRIX:
        instances = _instances(control)
        rival = _RIVALS[feature]
        left = changed.get(rival, 0) & ~instances
        _keep(changed, rival, left, left & _INSTANCES)
        _keep(changed, feature, instances | control & MatrixControl.DEBUG_ROUTING, instances)
    else:
        _keep(changed, feature, control & _SWITCH, control & OutputControl.ON)
    return changed


def without_volatile(outputs: Mapping[int, int]) -> dict[int, int]:
    """Return the table as a reset leaves it."""
    return {feature: bits for feature, bits in outputs.items() if feature not in VOLATILE}


_SWITCH = OutputControl.ON | OutputControl.DEBUG_ROUTING
_INSTANCES = MatrixControl.SLOW | MatrixControl.FAST


def _instances(control: int) -> int:
    fast = MatrixControl.FAST if MatrixControl(control).fast else MatrixControl(0)
    return int(control & MatrixControl.SLOW | fast)


def _keep(table: dict[int, int], feature: int, bits: int, on: int) -> None:
    table.pop(feature, None)
    if on:
        table[int(feature)] = int(bits)
