"""The hook with which a conftest.py or another plugin adds radars of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from hil_tests.plugin.radar_specs import RadarSpec
    from hil_tests.plugin.radar_targets import RadarTarget


@pytest.hookspec(firstresult=True)
def pytest_xethru_radar_target(config: pytest.Config, spec: RadarSpec) -> RadarTarget | None:
    """Return how the radar of a ``--radar`` value is reached, or None if others know.

    Called once per process and radar, before its first test. ``spec.target`` is the value before
    the question mark, such as ``mylab:rack3``, and ``spec.options`` what follows. The plugin's own
    kinds are asked last, so a hook may also answer for one of theirs. It raises `TargetError`, with
    one line, if the radar is not available.
    """
