"""A module that restarts: with its port closed, open, and while streaming, through a real port.

The arrival of the first frame shows how long it took.
"""

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from hil_tests.device.emulator_process import Served, emulator, open_radar
from hil_tests.patience import seconds
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.transport import find_ports
from xethru_protocol.wire.errors import Disconnected, PortUnavailable, ResponseTimeout
from xethru_protocol.wire.messages import ModReset

pytestmark = pytest.mark.slow

CONFIG = RawConfig(frame_area_m=(0.4, 5.0))
FPS = 17.0
# Protocol reference 8.1: it restarts half a second after the ACK, and is silent for two seconds.
# How late it may be is tested in virtual time.
SOONEST_S, LATEST_S = 2.5, seconds(5)


THOROUGH = partial(pytest.param, marks=pytest.mark.thorough)


@pytest.fixture
def served(mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with emulator("serve", "--bare", "--count", "2", "--port-on-reset", mode) as made:
        yield made


def seconds_since(asked_ns: int) -> float:
    return (time.monotonic_ns() - asked_ns) / 1e9


def where_it_is(serial: str) -> str | None:
    return next((port.path for port in find_ports() if port.serial == serial), None)


@pytest.mark.parametrize("mode", [THOROUGH("stay"), THOROUGH("vanish"), "rename"])
def test_with_the_port_closed(served: Served) -> None:
    with open_radar(served.paths[0]) as radar:
        asked_ns = time.monotonic_ns()
        radar.reset()
    back_s = 0.0
    while back_s < SOONEST_S:  # it answers on for half a second before it restarts
        assert time.monotonic_ns() - asked_ns < LATEST_S * 1e9, "it did not come back"
        try:
            with X4M300.open(where_it_is(served.serials[0]) or served.paths[0]) as radar:
                radar.configure_raw(CONFIG)
                radar.start(FPS)
                radar.read_frame(timeout_s=1.0)
                back_s = seconds_since(asked_ns)
        except (PortUnavailable, ResponseTimeout, Disconnected):
            time.sleep(0.05)
    assert back_s < LATEST_S


@pytest.mark.parametrize("mode", [THOROUGH("stay"), "vanish", THOROUGH("rename")])
def test_with_the_port_open(served: Served) -> None:
    with open_radar(served.paths[0]) as radar:
        asked_ns = time.monotonic_ns()
        radar.reset(wait=True)
        radar.configure_raw(CONFIG)
        radar.start(FPS)
        radar.read_frame()
        assert SOONEST_S < seconds_since(asked_ns) < LATEST_S
        assert radar.info().serial_number == served.serials[0]


@pytest.mark.parametrize(
    "mode", [pytest.param("stay", marks=pytest.mark.rare), "vanish", THOROUGH("rename")]
)
def test_while_streaming(served: Served, mode: str) -> None:
    with open_radar(served.paths[0], reconnect_s=10.0) as radar:
        geometry = radar.configure_raw(CONFIG)
        radar.start(FPS)
        frame = radar.read_frame()
        asked_ns = time.monotonic_ns()
        if mode == "stay":
            radar.reset(wait=True)  # nothing hangs up: only who asked knows
            radar.configure_raw(CONFIG)
            radar.start(FPS)
        else:
            radar.request(ModReset())
        while (back_s := seconds_since(asked_ns)) < SOONEST_S:
            frame = radar.read_frame()
        assert back_s < LATEST_S
        assert frame.geometry == geometry
        assert frame.samples.shape == (716,)  # Protocol reference 9.4
