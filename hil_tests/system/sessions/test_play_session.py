"""``xethru-emulator play`` of a session of four radars: each at its own port, byte for byte."""

import os
import select
import time
from pathlib import Path

import numpy as np
import pytest

from hil_tests.device.emulator_process import emulator, open_radar
from hil_tests.patience import seconds
from hil_tests.unit.emulator.test_playback_control import samples, write_session
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.connection import Connection, Role

SECOND = 1_000_000_000
NAMES = ("front_left", "rear_left", "front_right", "rear_right")
LIMIT_S = seconds(10)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    path = tmp_path / "session.mcap"
    write_session(path, {name: SECOND for name in NAMES}, n_frames=30)
    return path


def sent(radar: int, counters: range) -> bytes:
    module = Connection(Role.MODULE)
    return b"".join(
        module.send(m.DataFloat(info=counter, values=samples(radar, counter)))
        for counter in counters
    )


def heard(paths: tuple[str, ...], size: int) -> list[bytes]:
    descriptors = [os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK) for path in paths]
    data = {descriptor: b"" for descriptor in descriptors}
    deadline = time.monotonic() + LIMIT_S
    while any(len(got) < size for got in data.values()) and time.monotonic() < deadline:
        for descriptor in select.select(descriptors, [], [], 0.1)[0]:
            data[descriptor] += os.read(descriptor, 65536)
    for descriptor in descriptors:
        os.close(descriptor)
    return list(data.values())


def test_every_radar_plays_at_a_port_of_its_own(session: Path) -> None:
    with emulator("play", session, "--rate", "0") as served:
        assert served.names == NAMES
        assert served.serials == tuple(f"20261121000{number}" for number in range(4))
        expected = [sent(number, range(30)) for number in range(4)]
        assert heard(served.paths, len(expected[0])) == expected
        with open_radar(served.paths[2]) as driver:
            driver.configure_raw(RawConfig())
            driver.start(20.0)
            for counter, frame in enumerate(driver.frames(30, timeout_s=5.0)):
                assert frame.counter == counter
                assert np.array_equal(frame.samples, samples(2, counter))
        assert served.end() == 0
