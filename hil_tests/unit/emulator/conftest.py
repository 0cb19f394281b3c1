"""A host at a stock module."""

import pytest

from hil_tests.unit.emulator.doubles import BareHost, ramp_device


@pytest.fixture
def host() -> BareHost:
    return BareHost(ramp_device())
