"""Numbers that tests measure, with units and limits: for JUnit, JSON, Rerun and people."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import pytest

__all__ = ["Measure", "Measurement"]

Limit = tuple[float | None, float | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """One number.

    Attributes
    ----------
    name
        What it is.
    value
        In ``unit``.
    unit
        As people write it; empty for counts.
    low, high
        What it may be at least and at most; None: no limit.
    """

    name: str
    value: float
    unit: str
    low: float | None
    high: float | None

    @property
    def within(self) -> bool:
        """Whether it keeps its limits; not-a-number keeps none."""
        above = self.low is None or self.value >= self.low
        below = self.high is None or self.value <= self.high
        return above and below and not math.isnan(self.value)

    @property
    def text(self) -> str:
        """What to say about it.

        >>> Measurement(name="jitter", value=6.25, unit="ms", low=None, high=5.0).text
        '6.25 ms (at most 5)'
        """
        limits = []
        if self.low is not None:
            limits.append(f"at least {self.low:g}")
        if self.high is not None:
            limits.append(f"at most {self.high:g}")
        said = f"{self.value:.6g} {self.unit}".rstrip()
        return f"{said} ({', '.join(limits)})" if limits else said

    def as_json(self) -> Mapping[str, Any]:
        """JSON-able fields, and whether it keeps its limits."""
        return {**asdict(self), "within": self.within}


class Measure:
    """Takes measurements of one test; one outside its limits fails the test at once.

    Parameters
    ----------
    properties
        The test's user properties, which go into JUnit files.

    Attributes
    ----------
    taken
        In order.
    """

    def __init__(self, properties: list[tuple[str, object]]) -> None:
        self._properties = properties
        self._taken: list[Measurement] = []

    @property
    def taken(self) -> Sequence[Measurement]:
        """What was measured so far."""
        return tuple(self._taken)

    def __call__(
        self, name: str, value: float, *, unit: str = "", limit: Limit = (None, None)
    ) -> None:
        """Note a number.

        Parameters
        ----------
        name
            What it is, such as ``frame_interval_p99``.
        value
            The number.
        unit
            Its unit, such as ``ms``.
        limit
            Smallest and largest value, both allowed; None: no limit on that side.
        """
        low, high = limit
        measurement = Measurement(name=name, value=float(value), unit=unit, low=low, high=high)
        self._taken.append(measurement)
        self._properties.append((f"measurement {name}", measurement.text))
        if not measurement.within:
            pytest.fail(f"{name} is {measurement.text}", pytrace=False)
