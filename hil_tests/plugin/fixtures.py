"""Fixtures for tests of radars; modules that open radars are imported on first use."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import pytest

from hil_tests.plugin.findings import InjectFault, Measure, findings_of
from hil_tests.plugin.options import CHOICES
from hil_tests.plugin.requirements import gate, lacking

if TYPE_CHECKING:
    from hil_tests.plugin.radar_specs import RadarArgument
    from hil_tests.plugin.radar_targets import RadarTarget
    from hil_tests.plugin.session_radars import Bench, RadarUnderTest
    from xethru_protocol.driver.radar import X4M300

RF_FRAME_BYTES = 5747  # 1431 bins (Protocol reference 9.5)


@pytest.fixture(scope="session")
def hil_bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """All radars of the session."""
    from hil_tests.plugin.radar_targets import RadarTarget, TargetError
    from hil_tests.plugin.session_radars import Bench
    from xethru_protocol.optional_packages import what_is_missing

    config = request.config

    def reach(spec: RadarArgument) -> RadarTarget:
        try:
            place = config.hook.pytest_xethru_radar_target(config=config, spec=spec)
        except ModuleNotFoundError as error:
            missing = what_is_missing(error, extra="hil")
            if missing is None:
                raise
            raise TargetError(f"--radar {spec.text}: {missing}") from None
        if not isinstance(place, RadarTarget):
            hook = "pytest_xethru_radar_target"
            raise TargetError(f"--radar {spec.text}: {hook} returned {place!r}, no RadarTarget")
        return place

    bench = Bench(config.stash[CHOICES].specs, reach)
    yield bench
    bench.close()


@pytest.fixture(scope="session")
def radar_name(request: pytest.FixtureRequest) -> str:
    """Name of the radar a test runs on: each of ``--radar`` in turn."""
    name: str = request.param
    return name


@pytest.fixture
def radar_place(
    request: pytest.FixtureRequest, radar_name: str, hil_bench: Bench
) -> RadarUnderTest:
    """Return the radar in a known state: stopped, no profile, nothing on the line.

    ``radar_place.open()`` returns drivers; ``radar_place.power_cycle()`` cuts the power of a radar
    that has the capability ``power``, ``radar_place.place.unplug(seconds)`` unplugs one that has
    ``unplug``.
    """
    return gate(request, hil_bench, (radar_name,))[0]


@pytest.fixture
def radar(radar_place: RadarUnderTest) -> X4M300:
    """Return a driver of the radar, in its known state."""
    return radar_place.open()


@pytest.fixture
def frame_rate_hz(radar_place: RadarUnderTest) -> float:
    """Frame rate to ask for: the spec's, or what a UART carries of whole RF frames [Hz]."""
    from xethru_protocol.transport import carried_rate_hz

    return carried_rate_hz(radar_place.spec.fps, radar_place.place.bytes_per_s, RF_FRAME_BYTES)


@pytest.fixture(scope="session")
def rig_name(request: pytest.FixtureRequest) -> tuple[str, ...]:
    """Names of the radars of `radar_pair` and `radar_rig`."""
    names: tuple[str, ...] = request.param
    return names


@pytest.fixture
def radar_pair(
    request: pytest.FixtureRequest, rig_name: tuple[str, ...], hil_bench: Bench
) -> tuple[X4M300, X4M300]:
    """Drivers of two radars, both in their known state."""
    names = hil_bench.rig(rig_name)
    if len(names) < 2:
        lacking(request, names, f"{'+'.join(names)}: needs two radars; give --radar twice")
    one, other = gate(request, hil_bench, names[:2])
    return one.open(), other.open()


@pytest.fixture
def radar_rig(
    request: pytest.FixtureRequest, rig_name: tuple[str, ...], hil_bench: Bench
) -> Mapping[str, X4M300]:
    """Drivers of all radars by name: of the real ones together, or of an emulated scene.

    With ``--rig`` by the names of its file; each module is found by its serial number there.
    """
    from hil_tests.plugin.session_radars import matched

    found = gate(request, hil_bench, hil_bench.rig(rig_name))
    rig = request.config.stash[CHOICES].rig
    drivers = {place.spec.name: place.open() for place in found}
    return drivers if rig is None else matched(rig, drivers)


@pytest.fixture
def fault(request: pytest.FixtureRequest) -> Iterator[InjectFault]:
    """Arm faults of emulated radars: ``fault("stall", seconds=1.5)``; others skip the test.

    What it returns counts: ``.injected()``. A test that passes although one of its faults never
    took effect fails. All faults end with the test.
    """
    findings = findings_of(request.node)
    yield InjectFault(findings)
    for one in findings.faults:
        one.clear()


@pytest.fixture
def measure(request: pytest.FixtureRequest) -> Measure:
    """Record numbers with units and limits in JUnit, JSON and the artefacts.

    ``measure("frame_interval_p99", 61.2, unit="ms", limit=(None, 70))`` fails beyond its limit.
    """
    node: pytest.Item = request.node
    taker = Measure(node.user_properties)
    findings_of(node).measure = taker
    return taker
