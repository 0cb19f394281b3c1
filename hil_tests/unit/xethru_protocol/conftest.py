"""Drivers on scripted lines, in both kinds, and a module at a port."""

import asyncio
from collections.abc import Iterator

import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn, driver_factory
from hil_tests.unit.xethru_protocol.pty_module import PtyModule


@pytest.fixture(params=["sync", "async"])
def driver_on(request: pytest.FixtureRequest) -> Iterator[DriverOn]:
    with asyncio.Runner() as runner:
        yield driver_factory(request.param, runner)


@pytest.fixture
def module() -> Iterator[PtyModule]:
    with PtyModule() as module:
        yield module
