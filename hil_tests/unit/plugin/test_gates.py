"""What the plugin lets a test do to a radar, and how often it tries one that does not answer."""

import math
from collections.abc import Iterator
from typing import cast

import pytest

from hil_tests.plugin.findings import Measure, Measurement, findings_of
from hil_tests.plugin.radar_specs import RadarArgument, parse_specs
from hil_tests.plugin.radar_targets import InProcessTarget, TargetError
from hil_tests.plugin.requirements import gate
from hil_tests.plugin.session_radars import Bench, BrokenRadarError
from xethru_protocol.transport import Transport
from xethru_protocol.wire.errors import PortUnavailable

REAL = "tcp://127.0.0.1:1"


class Stand(InProcessTarget):
    """An emulated module in the place of any radar; counts how often it is opened."""

    def __init__(self, spec: RadarArgument) -> None:
        super().__init__(parse_specs(["emu"])[0])
        self.spec = spec
        self.n_opened = 0
        self.answers = True

    def open_line(self, path: str | None = None, baudrate: int = 115200) -> Transport:
        self.n_opened += 1
        if not self.answers:
            raise PortUnavailable("nobody is there")
        return super().open_line(path, baudrate)


class RealTime(Stand):
    @property
    def virtual(self) -> bool:
        return False


def bench_of(*texts: str, kind: type[Stand] = Stand) -> tuple[Bench, dict[str, Stand]]:
    """Return a bench, and the stands that it has reached so far."""
    reached: dict[str, Stand] = {}

    def reach(spec: RadarArgument) -> Stand:
        return reached.setdefault(spec.name, kind(spec))

    return Bench(parse_specs(texts), reach), reached


def outcome(request: pytest.FixtureRequest, bench: Bench, name: str) -> str:
    """Return what the gate makes of this test: "runs", "skipped: ..." or "failed: ..."."""
    try:
        (radar,) = gate(request, bench, (name,))
    except pytest.skip.Exception as skipped:
        return f"skipped: {skipped.msg}"
    except pytest.fail.Exception as failed:
        return f"failed: {failed.msg}"
    assert radar.spec.name == name
    return "runs"


@pytest.fixture(autouse=True)
def _no_findings(request: pytest.FixtureRequest) -> Iterator[None]:
    """Leave the radars out of the report: they only serve to test the gate."""
    yield
    findings = findings_of(request.node)
    findings.names, findings.radars, findings.reason = (), (), None


@pytest.mark.parametrize(
    ("marker", "option", "says"),
    [
        ("writes_flash", "allow_flash", "--allow-flash lets it"),
        ("writes_factory_settings", "allow_factory_reset", "--allow-factory-reset lets it"),
    ],
)
def test_a_real_module_is_written_only_with_permission(
    marker: str,
    option: str,
    says: str,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not even a strict session makes a failure of it, and nothing is sent."""
    for other in ("allow_flash", "allow_factory_reset", "hil_slow"):
        monkeypatch.setattr(request.config.option, other, other != option)
    request.node.add_marker(marker)
    bench, reached = bench_of(REAL, "emu")
    real, emulated = bench.specs
    for strict in (False, True):
        monkeypatch.setattr(request.config.option, "hil_strict", strict)
        refused = outcome(request, bench, real)
        assert refused.startswith("skipped: ")
        assert says in refused
    assert reached[real].n_opened == 0
    assert outcome(request, bench, emulated) == "runs", "nothing outlives it"
    monkeypatch.setattr(request.config.option, option, True)
    assert outcome(request, bench, real) == "runs"
    assert reached[real].n_opened == 1


@pytest.mark.parametrize("kind", [Stand, RealTime])
def test_what_takes_long_in_real_time_must_be_asked_for(
    kind: type[Stand], request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    request.node.add_marker(pytest.mark.slow_hw(seconds=30))
    bench, _ = bench_of("emu", kind=kind)
    monkeypatch.setattr(request.config.option, "hil_slow", False)
    refused = "skipped: emu: takes 30 s in real time; --hil-slow runs it"
    assert outcome(request, bench, "emu") == (refused if kind is RealTime else "runs")
    monkeypatch.setattr(request.config.option, "hil_slow", True)
    assert outcome(request, bench, "emu") == "runs"


@pytest.mark.parametrize(("value", "limit"), [("a", (None, None)), (1.0, (2.0, 1.0))])
def test_a_measure_that_makes_no_sense_fails_the_test(
    value: object, limit: tuple[float | None, float | None]
) -> None:
    properties: list[tuple[str, object]] = []
    with pytest.raises(pytest.fail.Exception):
        Measure(properties)("noise", cast("float", value), limit=limit)
    assert not properties


@pytest.mark.parametrize(
    ("value", "low", "high", "within"),
    [
        (1.0, 1.0, 2.0, True),
        (2.0, 1.0, 2.0, True),
        (math.nextafter(1.0, 0.0), 1.0, 2.0, False),
        (math.nextafter(2.0, 3.0), 1.0, 2.0, False),
        (math.inf, 1.0, None, True),
        (-math.inf, None, 2.0, True),
    ],
)
def test_limits_of_a_measure_are_inclusive(
    value: float, low: float | None, high: float | None, within: bool
) -> None:
    assert Measurement(name="x", value=value, unit="", low=low, high=high).within is within


@pytest.mark.parametrize("strict", [False, True])
def test_a_radar_that_does_not_answer_fails_one_test_and_is_not_tried_again(
    strict: bool, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(request.config.option, "hil_strict", strict)
    bench, reached = bench_of(REAL, "emu")
    broken, whole = bench.specs
    place = bench.radar(broken).place
    assert place is reached[broken]
    reached[broken].answers = False
    assert outcome(request, bench, broken) == f"failed: {broken}: nobody is there"
    lacking = f"{broken} did not answer in an earlier test: nobody is there"
    later = f"failed: --hil-strict: {lacking}" if strict else f"skipped: {lacking}"
    assert [outcome(request, bench, broken) for _ in range(2)] == [later, later]
    assert reached[broken].n_opened == 1
    assert outcome(request, bench, whole) == "runs", "the others are tested"
    # a test that runs again after a failure tries it again
    reached[broken].answers = True
    monkeypatch.setattr(request.node, "execution_count", 2, raising=False)
    assert outcome(request, bench, broken) == "runs"


def test_a_radar_that_cannot_be_reached_is_not_tried_again() -> None:
    tried = []

    def reach(spec: RadarArgument) -> Stand:
        tried.append(spec.name)
        raise TargetError("no such port")

    bench = Bench(parse_specs([REAL]), reach)
    (name,) = bench.specs
    with pytest.raises(TargetError):
        bench.radar(name)
    for _ in range(2):
        with pytest.raises(BrokenRadarError):
            bench.radar(name)
    assert len(tried) == 1
    with pytest.raises(TargetError):
        bench.radar(name, again=True)
    assert len(tried) == 2


@pytest.mark.requires("profiles", "presence")
@pytest.mark.parametrize(
    ("target", "says"), [("emu", "runs"), ("emu:sleeper", "skipped: "), ("emu:desk", "skipped: ")]
)
def test_a_test_of_the_presence_profile_is_not_for_an_x4m200(
    target: str, says: str, request: pytest.FixtureRequest
) -> None:
    bench = Bench(parse_specs([target]), InProcessTarget)
    (name,) = bench.specs
    came = outcome(request, bench, name)
    assert came.startswith(says)
    assert ("presence" in came) == (says != "runs")
