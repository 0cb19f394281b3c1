"""Numbers that tests measure, with units and limits, for JUnit, JSON and Rerun."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import pytest

Limit = tuple[float | None, float | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """One number in ``unit`` (empty: a count), with its inclusive limits (None: no limit)."""

    name: str
    value: float
    unit: str
    low: float | None
    high: float | None

    @property
    def within(self) -> bool:
        """Whether the value is within its limits; NaN never is."""
        above = self.low is None or self.value >= self.low
        below = self.high is None or self.value <= self.high
        return above and below and not math.isnan(self.value)

    @property
    def text(self) -> str:
        """Value, unit and limits.

        >>> Measurement(name="jitter", value=6.25, unit="ms", low=None, high=5.0).text
        '6.25 ms (at most 5)'
        """
        limits = []
        if self.low is not None:
            limits.append(f"at least {self.low:g}")
        if self.high is not None:
            limits.append(f"at most {self.high:g}")
        shown = f"{self.value:.6g} {self.unit}".rstrip()
        return f"{shown} ({', '.join(limits)})" if limits else shown

    def as_json(self) -> Mapping[str, Any]:
        return {**asdict(self), "within": self.within}


class Measure:
    """Takes measurements of one test; one outside its limits fails the test at once.

    They go into ``properties``, the user properties of the test, and so into JUnit files.
    """

    def __init__(self, properties: list[tuple[str, object]]) -> None:
        self._properties = properties
        self.taken: list[Measurement] = []

    def __call__(
        self, name: str, value: float, *, unit: str = "", limit: Limit = (None, None)
    ) -> None:
        """Record a number; ``limit`` holds the smallest and the largest allowed value."""
        low, high = limit
        measurement = Measurement(name=name, value=float(value), unit=unit, low=low, high=high)
        self.taken.append(measurement)
        self._properties.append((f"measurement {name}", measurement.text))
        if not measurement.within:
            pytest.fail(f"{name} is {measurement.text}", pytrace=False)
