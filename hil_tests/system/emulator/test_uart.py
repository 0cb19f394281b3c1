"""A served module on a UART: the driver sets its speed, changes it, comes back after a reset."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from hil_tests.device.serving import Served, emulator
from hil_tests.patience import seconds
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.codes import PongCode
from xethru_protocol.wire.errors import ResponseTimeout

pytestmark = pytest.mark.slow


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with emulator("serve", "--bare", "--link", "uart") as made:
        yield made


def test_the_speed_must_fit_and_can_be_changed(served: Served) -> None:
    with X4M300.open(served.paths[0], baudrate=57600) as deaf, pytest.raises(ResponseTimeout):
        deaf.ping()
    with X4M300.open(served.paths[0]) as radar:
        assert radar.ping() is PongCode.XTS_SPRP_READY
        radar.set_baud_rate(921600)
        radar.configure_raw(RawConfig(frame_area_m=(0.4, 5.0)))
        radar.start(17.0)
        counters = [frame.counter for frame in radar.frames(8)]
        assert counters == list(range(counters[0], counters[0] + 8)), "716 bins fit"
        # back at 115200, from where the driver takes it again
        radar.reset(wait=True, timeout_s=seconds(15))
        assert radar.ping() is PongCode.XTS_SPRP_READY
