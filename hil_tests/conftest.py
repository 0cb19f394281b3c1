"""Shared pytest configuration: Hypothesis profiles, slow tests, what an installed package runs."""

import importlib.util
import os
from pathlib import Path

import pytest

HERE = Path(__file__).parent
IN_SOURCE_TREE = (HERE.parent / "pyproject.toml").exists()
# What users run on their own radars; the other tests are about our sources and lie beside them.
FOR_USERS = {"device", "plugin"}
SLOW_TIMEOUT_S = 120

if importlib.util.find_spec("hypothesis") is not None:
    from hypothesis import settings

    # CI repeats the same examples; what it finds becomes an @example beside the test.
    settings.register_profile("ci", derandomize=True, deadline=None, print_blob=True)
    settings.register_profile("explore", max_examples=2000, deadline=None)
    settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def pytest_configure(config: pytest.Config) -> None:
    """Register the one marker that tests outside the plugin use."""
    config.addinivalue_line("markers", "slow: 120 s instead of 20 s")


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out what needs a source tree, in an installed package."""
    if IN_SOURCE_TREE or not collection_path.is_relative_to(HERE):
        return None
    parts = collection_path.relative_to(HERE).parts
    return True if parts and collection_path.is_dir() and parts[0] not in FOR_USERS else None


def pytest_report_collectionfinish() -> list[str]:
    """Say what was left out."""
    left_out = "hil_tests: of an installed package the device suite runs, without a source tree"
    return [] if IN_SOURCE_TREE else [left_out]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Give tests marked slow their own time limit."""
    if not config.pluginmanager.hasplugin("timeout"):
        return
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_TIMEOUT_S))
