"""Drivers on scripted lines, in both kinds, and a module at a port."""

from collections.abc import Iterator

import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn, Scripted, driver_factory
from hil_tests.unit.xethru_protocol.emulated import Emulated, EmulatedModule
from hil_tests.unit.xethru_protocol.pty_module import PtyModule


@pytest.fixture(params=["sync", "async"])
def driver_on(request: pytest.FixtureRequest) -> Iterator[DriverOn]:
    with driver_factory(request.param) as driver_on:
        yield driver_on


@pytest.fixture
def raw(driver_on: DriverOn) -> Scripted:
    """Return a driver in raw mode, and its line."""
    radar, line = driver_on()
    radar.configure_raw()
    return radar, line


@pytest.fixture
def emulated(driver_on: DriverOn) -> Emulated:
    module = EmulatedModule()
    return *driver_on(module), module


@pytest.fixture
def loaded(emulated: Emulated) -> Emulated:
    emulated[0].profile.load()
    return emulated


@pytest.fixture
def running(loaded: Emulated) -> Emulated:
    loaded[0].profile.run()
    return loaded


@pytest.fixture
def module() -> Iterator[PtyModule]:
    with PtyModule() as module:
        yield module
