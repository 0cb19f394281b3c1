"""Shared pytest configuration: Hypothesis profiles, slow tests, what an installed package runs."""

import gc
import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

from hil_tests.paths import NO_SHARED_DATA, shared_data
from hil_tests.patience import seconds
from hil_tests.plugin.options import CHOICES

HERE = Path(__file__).parent
IN_SOURCE_TREE = (HERE.parent / "pyproject.toml").exists()
# What users run on their own radars; the other tests are about our sources and lie beside them.
FOR_USERS = {"device", "plugin"}
SLOW_TIMEOUT_S = 120.0

if IN_SOURCE_TREE:
    # No threads for linear algebra: those of several processes wait for each other most of the
    # time. Here, since a conftest.py below this one loads numpy, which looks at them once.
    for library in ("OPENBLAS", "OMP"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")

if importlib.util.find_spec("hypothesis") is not None:
    from hypothesis import HealthCheck, settings

    # No verdict on speed, which is that of the machine.
    timeless = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
    # CI repeats its examples, but for constants, which Hypothesis takes from the modules loaded so
    # far. What `make test-explore` finds becomes an @example beside the test.
    settings.register_profile("thorough", timeless, derandomize=True, print_blob=True)
    # The default suite has a third as many examples as `make test-rare`.
    settings.register_profile("ci", settings.get_profile("thorough"), max_examples=20)
    settings.register_profile("rare", settings.get_profile("thorough"), max_examples=60)
    settings.register_profile(
        "explore", timeless, derandomize=False, print_blob=True, max_examples=2000
    )
    settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--vendor-examples",
        metavar="DIR",
        help="also run the vendor's Python examples that are in DIR, by 'xethru legacy'",
    )


class DoctestsWhereExamplesAre:
    """Lets doctest collect only files with examples: to search all of them takes seconds.

    A plugin of its own, since hooks of this file are not asked about files outside of its folder.
    """

    @pytest.hookimpl(wrapper=True)
    def pytest_collect_file(
        self, file_path: Path, parent: pytest.Collector
    ) -> Generator[None, list[pytest.Collector], list[pytest.Collector]]:
        option, wanted = parent.config.option, parent.config.option.doctestmodules
        option.doctestmodules = (
            wanted and file_path.suffix == ".py" and b">>>" in file_path.read_bytes()
        )
        try:
            return (yield)
        finally:
            option.doctestmodules = wanted


def pytest_configure(config: pytest.Config) -> None:
    """Register the one marker that tests outside the plugin use; let signals end what tests start.

    `nohup` and a shell's background jobs ignore some signals, and all children would inherit that.
    Workers and the hundreds of processes that tests start share bytecode, also where the
    environment forbids to write it: each would compile all sources again.
    """
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if IN_SOURCE_TREE:
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        sys.dont_write_bytecode = False
    config.pluginmanager.register(DoctestsWhereExamplesAre(), "doctests-where-examples-are")
    if IN_SOURCE_TREE and getattr(config.option, "numprocesses", None):
        _compile_once()  # workers load what is compiled; each would compile all
    config.addinivalue_line("markers", "slow: ends after 120 s * XETHRU_TEST_PATIENCE, not 20 s")


def _compile_once() -> None:
    """Compile the kernels, those of each file in a process, which takes a quarter of a minute.

    A file whose kernels lie beside it, compiled later than it was written, is left out.
    """
    program = (
        "import slam.{}.kernels\n"
        "from slam.front_end.numba_compilation import compile_kernels\n"
        "compile_kernels()"
    )
    compilers, version = [], f"{sys.version_info.major}{sys.version_info.minor}"
    for file in sorted((HERE.parent / "slam").glob("*/kernels.py")):
        kept = (file.parent / "__pycache__").glob(f"kernels.*.py{version}.nbi")
        if not any(each.stat().st_mtime > file.stat().st_mtime for each in kept):
            command = [sys.executable, "-c", program.format(file.parent.name)]
            compilers.append(subprocess.Popen(command, cwd=HERE.parent))
    for compiler in compilers:
        compiler.wait()


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out what needs a source tree, in an installed package."""
    if IN_SOURCE_TREE or not collection_path.is_relative_to(HERE):
        return None
    parts = collection_path.relative_to(HERE).parts
    return True if parts and collection_path.is_dir() and parts[0] not in FOR_USERS else None


def pytest_report_collectionfinish() -> list[str]:
    left_out = "hil_tests: of an installed package the device suite runs, without a source tree"
    return [] if IN_SOURCE_TREE else [left_out]


@pytest.fixture(scope="session", autouse=True)
def _own_run_directory(pytestconfig: pytest.Config) -> Iterator[None]:
    """Register emulators where only tests of this worker find them.

    A driver that looks for a module that vanished opens every port it finds, and sets its rate:
    another worker's test, whose server does not claim the port for itself, would lose its module.
    """
    choices = pytestconfig.stash.get(CHOICES, None)
    # A radar that is chosen may be one of an emulator that the user has started.
    if not IN_SOURCE_TREE or (choices is not None and choices.chosen):
        yield
        return
    with (
        tempfile.TemporaryDirectory(prefix="xethru-tests-", ignore_cleanup_errors=True) as folder,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("XDG_RUNTIME_DIR", folder)
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Give all tests without the shared data one place of their skip: the report joins them."""
    report = yield
    if isinstance(report.longrepr, tuple) and report.longrepr[2] == f"Skipped: {NO_SHARED_DATA}":
        code = shared_data.__code__
        report.longrepr = (code.co_filename, code.co_firstlineno, report.longrepr[2])
    return report


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Let the garbage collector look at what tests make, not again and again at all items."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    compilation = sys.modules.get("slam.front_end.numba_compilation")
    if compilation is not None:  # not within the time limit of the first test
        compilation.compile_kernels()
    if not config.pluginmanager.hasplugin("timeout") or config.getoption("timeout") is not None:
        return
    usual_s = float(config.getini("timeout") or 0)
    for item in items:
        limit_s = SLOW_TIMEOUT_S if item.get_closest_marker("slow") else usual_s
        if limit_s and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(seconds(limit_s)))
