"""Whether a test can run on its radars: capabilities, permissions, and the reason if it cannot."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, NoReturn

import pytest

from hil_tests.plugin.findings import findings_of

if TYPE_CHECKING:
    from hil_tests.plugin.session_radars import Bench, RadarUnderTest


def gate(
    request: pytest.FixtureRequest, bench: Bench, names: Sequence[str]
) -> tuple[RadarUnderTest, ...]:
    """Return the radars, each in its known state, or end the test with the reason.

    A test is skipped if a radar lacks what it requires, and fails then under ``--hil-strict``. It
    fails if a radar does not answer; later tests are skipped, or fail, without trying again. A test
    that ends here leaves no line open.
    """
    from hil_tests.plugin.radar_targets import TargetError
    from hil_tests.plugin.session_radars import BrokenRadarError, PortBusyError
    from xethru_protocol.wire.errors import XeThruError

    item: pytest.Item = request.node
    findings = findings_of(item)
    findings.names = names
    found: list[RadarUnderTest] = []
    with contextlib.ExitStack() as begun:
        for name in names:
            _check_kind(request, bench, name)
            problem: Exception | None = None
            try:
                radar = bench.radar(name, again=getattr(item, "execution_count", 1) > 1)
                found.append(radar)
                findings.radars = tuple(found)
                _check_capabilities(request, radar)
                _check_permissions(request, radar)
                begun.callback(radar.end_test)
                radar.begin_test()
                _check_capabilities(request, radar)  # which firmware it has is known only now
            except (BrokenRadarError, TargetError, PortBusyError, XeThruError) as error:
                problem = error
            if isinstance(problem, BrokenRadarError):
                lacking(request, names, str(problem))
            if problem is not None:
                pytest.fail(f"{name}: {problem}", pytrace=False)
        request.addfinalizer(begun.pop_all().close)
    return tuple(found)


def lacking(request: pytest.FixtureRequest, names: Sequence[str], reason: str) -> NoReturn:
    """Skip a test because something is missing; under ``--hil-strict`` fail it."""
    findings = findings_of(request.node)
    findings.names, findings.reason = names, reason
    if request.config.getoption("hil_strict"):
        pytest.fail(f"--hil-strict: {reason}", pytrace=False)
    pytest.skip(reason)


def leave_out(request: pytest.FixtureRequest, reason: str) -> NoReturn:
    """Skip a test that was not asked for; never a failure, since nothing is missing."""
    findings_of(request.node).reason = reason
    pytest.skip(reason)


def _check_kind(request: pytest.FixtureRequest, bench: Bench, name: str) -> None:
    item: pytest.Item = request.node
    spec = bench.specs[name]
    if item.get_closest_marker("emulated_only") and not spec.emulated:
        leave_out(request, f"{name}: for emulated radars only")
    if item.get_closest_marker("real_only") and spec.emulated:
        leave_out(request, f"{name}: for real modules only; give --radar /dev/...")


def _check_capabilities(request: pytest.FixtureRequest, radar: RadarUnderTest) -> None:
    from hil_tests.plugin.radar_targets import CAPABILITIES

    wanted = [name for mark in request.node.iter_markers("requires") for name in mark.args]
    if "fault" in request.fixturenames:
        wanted.append("faults")
    for capability in wanted:
        if capability not in radar.place.capabilities:
            name = radar.spec.name
            why = CAPABILITIES.get(capability, f"--radar ...?has={capability} declares it")
            lacking(request, [name], f"{name}: needs {capability} ({why})")


def _check_permissions(request: pytest.FixtureRequest, radar: RadarUnderTest) -> None:
    item: pytest.Item = request.node
    option = request.config.getoption
    name = radar.spec.name
    if not radar.spec.emulated:
        if item.get_closest_marker("writes_flash") and not option("allow_flash"):
            leave_out(request, f"{name}: writes the module's flash; --allow-flash lets it")
        if item.get_closest_marker("writes_factory_settings") and not option("allow_factory_reset"):
            leave_out(
                request, f"{name}: resets the module's settings; --allow-factory-reset lets it"
            )
    slow = item.get_closest_marker("slow_hw")
    if slow is not None and not radar.place.virtual and not option("hil_slow"):
        seconds = slow.kwargs.get("seconds", "many")
        leave_out(request, f"{name}: takes {seconds} s in real time; --hil-slow runs it")
