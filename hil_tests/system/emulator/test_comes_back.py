"""An emulated module whose process dies and starts again: the driver goes on."""

import signal
from pathlib import Path

from hil_tests.device.serving import emulator, open_radar
from xethru_protocol.driver.link import RawConfig


def test_driver_goes_on_when_its_emulator_comes_back(tmp_path: Path) -> None:
    links = tmp_path / "links"
    serve = ("serve", "--bare", "--link-dir", links)
    with emulator(*serve) as first:
        radar = open_radar(first.paths[0], reconnect_s=15.0)
        geometry = radar.configure_raw(RawConfig(frame_area_m=(0.4, 5.0)))
        radar.start(17.0)
        radar.read_frame()
        first.end(signal.SIGKILL)  # no goodbye, and links that lead nowhere
    with emulator(*serve) as second, radar:
        assert second.serials == first.serials
        while radar.reconnects == 0:
            radar.read_frame()
        frame = radar.read_frame()
        assert frame.geometry == geometry
        assert frame.samples.shape == (716,)  # Protocol reference 9.4
        assert radar.frames_lost == 0
        assert radar.statistics.off_lattice_samples == 0
