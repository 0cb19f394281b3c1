"""The same tests on a module in this process, on one behind a pseudo-terminal, on a real one.

A real X4M300 is used when the environment variable ``XETHRU_RADAR`` names its port.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from emulator.device import radar_device
from emulator.echo import echo_source
from emulator.identity import Identity
from emulator.loopback import LoopbackTransport
from emulator.pace import Pace
from emulator.scene import empty_room
from hil_tests.device.serving import emulator
from xethru_protocol.driver import X4M300


@pytest.fixture(scope="session")
def bare_port() -> Iterator[str]:
    """Port of a stock module that `xethru-emulator serve --bare` emulates in real time."""
    with emulator("serve", "--bare") as served:
        yield served.paths[0]


@pytest.fixture(params=["in-process", "pty", "real"])
def radar(request: pytest.FixtureRequest) -> Iterator[X4M300]:
    """Drive a module in whatever state it is."""
    if request.param == "in-process":
        device = radar_device(
            Identity(serial="202611210001"), echo_source(empty_room(), 0, 0), Pace.REALTIME
        )
        transport = LoopbackTransport(device)
        driver = X4M300(transport, clock=transport.clock_ns)
    elif request.param == "pty":
        driver = X4M300.open(request.getfixturevalue("bare_port"))
    elif port := os.environ.get("XETHRU_RADAR"):
        driver = X4M300.open(port)
    else:
        pytest.skip("no real module: set XETHRU_RADAR to its port to run this on hardware")
    with driver:
        yield driver
