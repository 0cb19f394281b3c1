"""Every kind of fault, one file per layer that it hits."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from emulator.faults.kind import ENTERED, KindOfFault, Layer
from emulator.faults.kinds import bytes as _bytes  # noqa: F401 - importing enters its kinds
from emulator.faults.kinds import commands, device, frames, stream  # noqa: F401 - likewise

_LAYERS = list(Layer)
KINDS: Mapping[str, KindOfFault] = MappingProxyType(
    {kind.name: kind for kind in sorted(ENTERED, key=lambda kind: _LAYERS.index(kind.layer))}
)
"""The catalogue, in the order of its layers."""
