"""What is found of a test: its radars, the faults it armed, and the numbers it measures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from hil_tests.plugin.radar_targets import InjectedFault
    from hil_tests.plugin.session_radars import RadarUnderTest


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

    def as_json(self) -> dict[str, Any]:
        return {**asdict(self), "within": self.within}


class InjectFault:
    """Orders faults of the emulated radars of one test."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings

    def __call__(
        self,
        kind: str,
        *,
        radar: str | None = None,
        **keys: Any,  # noqa: ANN401 - parameters of the kind
    ) -> InjectedFault:
        """Arm a fault of the test's radar, or of the one called ``radar``, until the test ends.

        Kinds, their parameters and when they strike: `xethru-emulator faults`. Times of a scenario
        are not allowed: a test arms a fault when it wants it.
        """
        from hil_tests.plugin.radar_targets import TargetError

        if wrong := {"at_s", "until_s"} & set(keys):
            pytest.fail(
                f"fault {kind}: {wrong.pop()} is for scenario files; arm it when you want it",
                pytrace=False,
            )
        places = {one.spec.name: one.place for one in self._findings.radars}
        name = next(iter(places), "no radar") if radar is None else radar
        if name not in places or (radar is None and len(places) > 1):
            there = ", ".join(places) or "none; ask for the fixture radar first"
            pytest.fail(f"fault {kind}: radar= must be one of: {there}", pytrace=False)
        refused = ""
        try:
            self._findings.faults.append(fault := places[name].inject(kind, keys))
        except TargetError as error:
            refused = str(error).removeprefix("fault: ")
        if refused:  # not above, where pytest would show both errors
            pytest.fail(f"fault {kind}: {refused}", pytrace=False)
        return fault


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
        if low is not None and high is not None and low > high:
            pytest.fail(
                f"measure {name}: limit {low, high}: the smallest comes first", pytrace=False
            )
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = None
        if number is None:  # not above, where pytest would show both errors
            pytest.fail(f"measure {name}: {value!r} is not a number", pytrace=False)
        measurement = Measurement(name=name, value=number, unit=unit, low=low, high=high)
        self.taken.append(measurement)
        self._properties.append((f"measurement {name}", measurement.text))
        if not measurement.within:
            pytest.fail(f"{name} is {measurement.text}", pytrace=False)


@dataclass(slots=True, kw_only=True)
class Findings:
    """What the plugin knows of one test.

    ``names`` also holds radars that could not be opened. ``reason`` says why the test was not run
    (None: it was); ``bundle`` is the folder of its artefacts, if they were kept.
    """

    radars: Sequence[RadarUnderTest] = ()
    names: Sequence[str] = ()
    measure: Measure | None = None
    reason: str | None = None
    bundle: str | None = None
    failures: list[str] = field(default_factory=list)
    faults: list[InjectedFault] = field(default_factory=list)

    @property
    def measurements(self) -> Sequence[Measurement]:
        return self.measure.taken if self.measure else ()

    def as_json(self) -> Mapping[str, Any]:
        """Return what the report of the test carries, also from a worker."""
        return {
            "radars": [
                {
                    "name": radar.spec.name,
                    "identity": radar.identity,
                    "reached": radar.place.description,
                }
                for radar in self.radars
            ],
            "names": list(self.names),
            "reason": self.reason,
            "bundle": self.bundle,
            "measurements": [one.as_json() for one in self.measurements],
        }


FINDINGS: pytest.StashKey[Findings] = pytest.StashKey()


def findings_of(item: pytest.Item) -> Findings:
    """Return the findings of a test, empty at first."""
    return item.stash.setdefault(FINDINGS, Findings())


def check_faults(findings: Findings) -> None:
    """Fail a test of which a fault never took effect: whatever it showed, it was not that."""
    for fault in findings.faults:
        if not fault.injected():
            pytest.fail(
                f"{fault.radar}: the fault '{fault}' never took effect, so this test shows nothing "
                f"of it; 'xethru-emulator faults {fault.kind}' says what it acts on",
                pytrace=False,
            )
