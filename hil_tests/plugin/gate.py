"""Whether a test can run on a radar: capabilities, permissions, and radars that do not answer."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NoReturn

import pytest

from hil_tests.plugin.choices import CHOICES
from hil_tests.plugin.measurements import Measure

if TYPE_CHECKING:
    from hil_tests.plugin.bench import Bench, RadarAtPlace

__all__ = ["FINDINGS", "Findings", "gate", "lacking", "leave_out"]


@dataclass(slots=True, kw_only=True)
class Findings:
    """What the plugin knows of one test.

    Attributes
    ----------
    radars
        The radars it runs on, in the order of its names.
    names
        Their names, also where they could not be had.
    measure
        What it measures with, if it does.
    reason
        Why it was not run; None: it was.
    bundle
        Folder of its artefacts, if they were kept.
    failures
        What went wrong, in order: setup, call, teardown.
    """

    radars: Sequence[RadarAtPlace] = ()
    names: Sequence[str] = ()
    measure: Measure | None = None
    reason: str | None = None
    bundle: str | None = None
    failures: list[str] = field(default_factory=list)

    def as_json(self) -> Mapping[str, Any]:
        """Return what the report of the test carries, from workers too."""
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
            "measurements": [
                dict(one.as_json()) for one in (self.measure.taken if self.measure else ())
            ],
        }


class _FindingsOfTests:
    """Keeps findings in the tests themselves."""

    def __init__(self) -> None:
        self._key: pytest.StashKey[Findings] = pytest.StashKey()

    def of(self, item: pytest.Item) -> Findings:
        """Return the findings of a test, empty at first."""
        return item.stash.setdefault(self._key, Findings())

    def known(self, item: pytest.Item) -> Findings | None:
        """Return them if there are any."""
        return item.stash.get(self._key, None)


FINDINGS = _FindingsOfTests()


def gate(
    request: pytest.FixtureRequest, bench: Bench, names: Sequence[str]
) -> tuple[RadarAtPlace, ...]:
    """Return the radars, each in its known state, or end the test with the reason.

    A test is skipped where a radar lacks what it requires, and fails so under ``--hil-strict``. It
    fails where a radar does not answer; tests after that are skipped, or fail, without trying. A
    test that ends here leaves no line open.
    """
    from hil_tests.plugin.bench import BrokenRadarError, PortBusyError
    from hil_tests.plugin.places import PlaceError
    from xethru_protocol.wire.errors import XeThruError

    item: pytest.Item = request.node
    findings = FINDINGS.of(item)
    findings.names = names
    found: list[RadarAtPlace] = []
    with contextlib.ExitStack() as begun:
        for name in names:
            _check_kind(request, bench, name)
            problem: Exception | None = None
            try:
                radar = bench.radar(name)
                found.append(radar)
                findings.radars = tuple(found)
                _check_capabilities(request, radar)
                _check_permissions(request, radar)
                begun.callback(radar.end_test)
                radar.begin_test()
                _check_capabilities(request, radar)  # which firmware it has is known only now
            except (BrokenRadarError, PlaceError, PortBusyError, XeThruError) as error:
                problem = error
            if isinstance(problem, BrokenRadarError):
                lacking(request, names, str(problem))
            if problem is not None:
                pytest.fail(f"{name}: {problem}", pytrace=False)
        begun.pop_all()  # the fixture ends them, behind the test
    return tuple(found)


def lacking(request: pytest.FixtureRequest, names: Sequence[str], reason: str) -> NoReturn:
    """Skip a test for something that is not there; under ``--hil-strict`` fail it."""
    findings = FINDINGS.of(request.node)
    findings.names, findings.reason = names, reason
    if request.config.stash[CHOICES].strict:
        pytest.fail(f"--hil-strict: {reason}", pytrace=False)
    pytest.skip(reason)


def leave_out(request: pytest.FixtureRequest, reason: str) -> NoReturn:
    """Skip a test that nobody asked for here; nothing is missing, so never a failure."""
    FINDINGS.of(request.node).reason = reason
    pytest.skip(reason)


def _check_kind(request: pytest.FixtureRequest, bench: Bench, name: str) -> None:
    item: pytest.Item = request.node
    spec = bench.specs[name]
    if item.get_closest_marker("emulated_only") and not spec.emulated:
        leave_out(request, f"{name}: for emulated radars only")
    if item.get_closest_marker("real_only") and spec.emulated:
        leave_out(request, f"{name}: for real modules only; give --radar /dev/...")


def _check_capabilities(request: pytest.FixtureRequest, radar: RadarAtPlace) -> None:
    from hil_tests.plugin.places import CAPABILITIES

    wanted = [name for mark in request.node.iter_markers("requires") for name in mark.args]
    for capability in wanted:
        if capability not in radar.place.capabilities:
            name = radar.spec.name
            why = CAPABILITIES.get(capability, f"--radar ...?has={capability} vouches for it")
            lacking(request, [name], f"{name}: needs {capability} ({why})")


def _check_permissions(request: pytest.FixtureRequest, radar: RadarAtPlace) -> None:
    item: pytest.Item = request.node
    choices = request.config.stash[CHOICES]
    name = radar.spec.name
    if not radar.spec.emulated:
        if item.get_closest_marker("writes_flash") and not choices.flash:
            leave_out(request, f"{name}: writes the module's flash; --allow-flash lets it")
        if item.get_closest_marker("writes_factory_settings") and not choices.factory:
            leave_out(
                request, f"{name}: resets the module's settings; --allow-factory-reset lets it"
            )
    slow = item.get_closest_marker("slow_hw")
    if slow is not None and not radar.place.virtual and not choices.slow:
        seconds = slow.kwargs.get("seconds", "many")
        leave_out(request, f"{name}: takes {seconds} s in real time; --hil-slow runs it")
