"""Firmware of an emulated module whose port goes away, through a real port, also after a break."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from hil_tests.device.emulator_process import emulator, open_radar
from hil_tests.unit.xethru_protocol.driver.test_driver_firmware import application
from xethru_protocol.driver.firmware import FirmwareImage
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.errors import DeviceError
from xethru_protocol.wire.messages import BootloaderGetDeviceInfo

pytestmark = pytest.mark.slow
PAGES = 300


class PulledPlugError(Exception):
    """Stands for whatever ends an update midway."""


def xethru(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "xethru_protocol.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.rare
def test_an_unfinished_update_is_finished_after_a_power_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    content = application(PAGES * 512 - 5)
    file = tmp_path / "image.bin"
    file.write_bytes(content)
    serve = ("serve", "--bare", "--port-on-reset", "vanish", "--state-dir", str(tmp_path / "state"))
    with emulator(*serve) as served:
        (path,) = served.paths
        with X4M300.open(path) as radar:
            asked: list[int] = []

            def pull(done: int, total: int) -> None:
                asked.append(done)
                if done == 100:
                    raise PulledPlugError

            with pytest.raises(PulledPlugError):
                radar.firmware.write(FirmwareImage.load(str(file)), pull)
            assert asked == list(range(101))
    with emulator(*serve) as served:
        (path,) = served.paths
        found = xethru("doctor", "--port", path, "--json")
        (report,) = (json.loads(line) for line in found.stdout.splitlines()[:1])
        assert "bootloader" in json.dumps(report)
        assert found.returncode == 1
        refused = xethru("ping", "--port", path)
        assert refused.returncode == 1
        done = xethru("flash", str(file), "--port", path, "--yes", "--json")
        assert done.returncode == 0, done.stderr
        written = json.loads(done.stdout)
        assert written["pages"] == PAGES
        assert int(written["checksum"], 16) == sum(content) + 5 * 0xFF
        assert (written["firmware_id"], written["version"]) == ("Annapurna", "1.6.8")
        with open_radar(path) as radar:
            radar.ping()
            with pytest.raises(DeviceError, match="NOT_RECOGNIZED"):
                radar.request(BootloaderGetDeviceInfo())
