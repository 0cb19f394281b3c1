"""The plugin's hooks; imports nothing heavy, since every pytest of the machine loads it."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from hil_tests.plugin.findings import FINDINGS, Findings, check_faults
from hil_tests.plugin.options import CHOICES, WORKER_KEY, add_options, choose
from hil_tests.plugin.radar_specs import RadarArgument, RadarKind, no_radar

if TYPE_CHECKING:
    from hil_tests.plugin.radar_targets import RadarTarget

pytest_plugins = ["hil_tests.plugin.fixtures"]

_OUTCOMES = ("passed", "failed", "skipped")


class HookSpecs:
    """The hook with which a conftest.py or another plugin adds radars of its own."""

    @staticmethod
    @pytest.hookspec(firstresult=True)
    def pytest_xethru_radar_target(
        config: pytest.Config, spec: RadarArgument
    ) -> RadarTarget | None:
        """Return how the radar of a ``--radar`` value is reached, or None if others know.

        Called once per process and radar, before its first test. ``spec.target`` is the value
        before the question mark, such as ``mylab:rack3``, and ``spec.options`` what follows. The
        plugin's own kinds are asked last, so a hook may also answer for one of theirs. It raises
        `TargetError`, with one line, if the radar is not available.
        """


class RadarReports:
    """Collects the reports of all tests that used radars, also those of workers."""

    def __init__(self) -> None:
        self.trouble = ""  # why the JSON could not be written
        self._counts: dict[str, Counter[str]] = defaultdict(Counter)
        self._identities: dict[str, str] = {}
        self._reasons: Counter[str] = Counter()
        self._tests: list[dict[str, Any]] = []
        self._pending: dict[str, str] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        found: dict[str, Any] | None = getattr(report, "xethru_hil", None)
        if report.when != "teardown":
            if report.when == "call" or not report.passed:
                self._pending[report.nodeid] = report.outcome
            return
        outcome = self._pending.pop(report.nodeid, "passed")
        outcome = "failed" if report.failed else outcome
        if found is None or not found["names"]:
            return
        name = "+".join(found["names"])
        self._counts[name][outcome] += 1
        for one in found["radars"]:
            if one["identity"] or one["name"] not in self._identities:
                silent = "did not answer" if found["reason"] is None else "not asked"
                who = one["identity"] or silent
                self._identities[one["name"]] = f"{who}; {one['reached']}"
        if found["reason"] is not None:
            self._reasons[found["reason"]] += 1
        self._tests.append({"test": report.nodeid, "outcome": outcome, **found})

    def write_terminal(self, terminal: pytest.TerminalReporter) -> None:
        if not self._counts:
            return
        terminal.section("radars")
        width = max(map(len, [*self._counts, "radar"]))
        terminal.line(f"{'radar':{width}}  passed  failed  skipped  what it is")
        for name, counts in self._counts.items():
            numbers = "  ".join(f"{counts[outcome]:{len(outcome)}}" for outcome in _OUTCOMES)
            together = name.count("+") + 1
            unknown = "could not be opened" if together == 1 else f"{together} radars together"
            what = self._identities.get(name, unknown)
            terminal.line(f"{name:{width}}  {numbers}  {what}")
        for reason, count in sorted(self._reasons.items()):
            terminal.line(f"{count:4} x {reason}")

    def write_json(self, path: Path) -> None:
        """Write every test with its radars, outcome and measurements."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            json.dumps({"radars": self._identities, "tests": self._tests}, indent=2) + "\n", "utf-8"
        )


SUMMARY: pytest.StashKey[RadarReports] = pytest.StashKey()


MARKERS = (
    "requires(name, ...): capabilities of the radar that this test needs, else it is skipped",
    "emulated_only: not for real modules",
    "real_only: not for emulated radars",
    "writes_flash: changes what a module keeps; on real ones only with --allow-flash",
    "writes_factory_settings: resets a module's settings; on real ones with --allow-factory-reset",
    "slow_hw(seconds): takes long on a radar in real time; runs there with --hil-slow",
)


def pytest_addhooks(pluginmanager: pytest.PytestPluginManager) -> None:
    pluginmanager.add_hookspecs(HookSpecs)


def pytest_addoption(parser: pytest.Parser) -> None:
    add_options(parser)


def pytest_configure(config: pytest.Config) -> None:
    """Register markers and read what the user chose."""
    for marker in MARKERS:
        config.addinivalue_line("markers", marker)
    choices = config.stash[CHOICES] = choose(config)
    if len(config.hook.pytest_xethru_radar_target.get_hookimpls()) == 1:  # ours
        for spec in choices.specs:
            if spec.kind is RadarKind.OWN:
                raise pytest.UsageError(str(no_radar(spec.text)))
    summary = config.stash[SUMMARY] = RadarReports()
    config.pluginmanager.register(summary, "xethru-hil-summary")


@pytest.hookimpl(trylast=True)
def pytest_xethru_radar_target(config: pytest.Config, spec: RadarArgument) -> RadarTarget:
    """Reach a radar of a built-in kind."""
    from hil_tests.plugin.radar_targets import target_of

    return target_of(spec, config.stash[CHOICES].power)


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:  # noqa: ANN401 - xdist may be missing
    """Send a worker the list of radars: it must not search for them itself."""
    node.workerinput[WORKER_KEY] = [spec.text for spec in node.config.stash[CHOICES].specs]


def pytest_report_header(config: pytest.Config) -> str | None:
    """List the radars, if some were chosen: the plugin is loaded by every pytest."""
    choices = config.stash[CHOICES]
    if not choices.chosen:
        return None
    strict = ", strict" if config.getoption("hil_strict") else ""
    return f"radars: {', '.join(spec.text for spec in choices.specs)}{strict}"


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each test that asks for a radar on all of them."""
    specs = metafunc.config.stash[CHOICES].specs
    if "radar_name" in metafunc.fixturenames:
        names = [spec.name for spec in specs]
        metafunc.parametrize("radar_name", names, indirect=True, scope="session", ids=names)
    if "rig_name" in metafunc.fixturenames:
        # what belongs together: all real radars, and the scene of each emulated one
        real = tuple(spec.name for spec in specs if not spec.emulated)
        rigs = [*([real] if real else []), *((spec.name,) for spec in specs if spec.emulated)]
        metafunc.parametrize(
            "rig_name", rigs, indirect=True, scope="session", ids=["+".join(rig) for rig in rigs]
        )


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> object | None:  # noqa: ANN401 - xdist is not typed
    """Keep the tests of each real radar on one worker, however the others are spread.

    The mark ``xdist_group`` would need ``--dist loadgroup``, and xdist 3.8 loses groups under
    pytest 9.2.
    """
    shared = {s.name: s.shared_as for s in config.stash[CHOICES].specs if not s.emulated}
    if not shared:
        return None
    from xdist.scheduler import LoadScopeScheduling  # which need not be installed

    class RealRadarScheduling(LoadScopeScheduling):  # type: ignore[misc]  # xdist is not typed
        _groups: dict[str, str] | None = None

        def _split_scope(self, nodeid: str) -> str:
            if self._groups is None:
                collected = next(iter(self.registered_collections.values()))
                self._groups = groups_of(collected, shared)
            return self._groups[nodeid]

    return RealRadarScheduling(config, log)


def groups_of(nodeids: Sequence[str], radars: Mapping[str, str]) -> dict[str, str]:
    """Return for each test the group that must stay on one worker: its own id if it may go to any.

    ``radars`` holds names of real radars, and what each is locked by. A test of all of them
    together, as with `radar_rig`, ties them to one worker.

    >>> radars = {"ttyACM0": "/dev/ttyACM0", "ttyACM1": "/dev/ttyACM1"}
    >>> list(groups_of(["t::a[ttyACM0-8]", "t::a[ttyACM1-8]", "t::a[emu-8]"], radars).values())
    ['/dev/ttyACM0', '/dev/ttyACM1', 't::a[emu-8]']
    >>> set(groups_of(["t::a[ttyACM0-1431]", "t::b[ttyACM0+ttyACM1]"], radars).values())
    {'tests of real radars'}
    """
    groups = {nodeid: nodeid for nodeid in nodeids}
    together = "+".join(radars)
    tied = False
    for nodeid in nodeids:
        found = re.search(r"\[(.*)\]", nodeid, re.DOTALL)
        parameters = f"-{found[1]}-" if found else ""
        if f"-{together}-" in parameters:
            tied |= len(radars) > 1
            groups[nodeid] = next(iter(radars.values()))
        # the longest: one name may begin with another
        elif names := [name for name in radars if f"-{name}-" in parameters]:
            groups[nodeid] = radars[max(names, key=len)]
    if tied:
        real = set(radars.values())
        return {n: "tests of real radars" if g in real else g for n, g in groups.items()}
    return groups


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Clear the findings where a test runs again: they belong to the run before."""
    if item.stash.get(FINDINGS, None) is not None:
        del item.stash[FINDINGS]
        kept = [one for one in item.user_properties if not one[0].startswith("measurement ")]
        item.user_properties[:] = kept


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    yield
    if FINDINGS in item.stash:
        check_faults(item.stash[FINDINGS])


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Keep the artefacts of a test that failed, and add its findings to the report."""
    report = yield
    findings = item.stash.get(FINDINGS, None)
    if findings is None:
        return report
    if report.failed:
        findings.failures.append(f"{call.when}: {report.longreprtext}")
    keep = item.config.getoption("hil_keep")
    if findings.radars and findings.reason is None and keep != "none":
        # after the call, while the drivers are open; after a teardown that fails, once more
        last = report.when == "call" or (report.failed and report.when in {"setup", "teardown"})
        if last and (keep == "all" or report.failed):
            _keep(item, findings, report)
    report.xethru_hil = findings.as_json()  # type: ignore[attr-defined]  # reports carry added attributes
    return report


def _keep(item: pytest.Item, findings: Findings, report: pytest.TestReport) -> None:
    from xethru_protocol.optional_packages import what_is_missing

    try:
        from hil_tests.plugin.artifacts import folder_name, write_bundle
    except ModuleNotFoundError as error:
        missing = what_is_missing(error, extra="hil")
        report.sections.append(("radar artefacts", f"not kept: {missing or error}"))
        return
    tries = getattr(item, "execution_count", 1)  # of pytest-rerunfailures
    folder = item.config.stash[CHOICES].artifacts / folder_name(item.nodeid, tries)
    about = {
        "test": item.nodeid,
        "outcome": report.outcome,
        "repeat": "pytest "
        + " ".join(
            [f"'{item.nodeid}'", *(f"--radar '{radar.spec.text}'" for radar in findings.radars)]
        ),
    }
    try:
        write_bundle(folder, findings, about)
    except Exception as error:  # the failure of the test is reported in any case
        report.sections.append(("radar artefacts", f"{folder}: incomplete: {error!r}"))
        return
    if findings.bundle is None:
        item.user_properties.append(("artefacts", str(folder)))
    findings.bundle = str(folder)
    report.sections.append(("radar artefacts", f"{folder}: log.txt shows what was on the wire"))


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    summary = config.stash[SUMMARY]
    summary.write_terminal(terminalreporter)
    if summary.trouble:
        terminalreporter.line(f"ERROR: {summary.trouble}", red=True)


def pytest_sessionfinish(session: pytest.Session) -> None:
    path = session.config.stash[CHOICES].json
    if path is not None and not hasattr(session.config, "workerinput"):
        summary = session.config.stash[SUMMARY]
        try:
            summary.write_json(path)
        except OSError as error:
            summary.trouble = f"--hil-json {path}: cannot be written: {error.strerror or error}"
            session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED
