"""``xethru flash``: nothing without ``--yes``, what it prints, and how it ends."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from hil_tests.patience import seconds
from hil_tests.unit.xethru_protocol.driver.test_driver_firmware import (
    DATA,
    PADDED,
    UpdatableModule,
    hex_file,
)
from hil_tests.unit.xethru_protocol.pty_module import PtyModule
from xethru_protocol.cli import main
from xethru_protocol.wire import messages as m

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def image(tmp_path: Path) -> str:
    path = tmp_path / "image.hex"
    path.write_bytes(hex_file(DATA))
    return str(path)


def test_without_yes_nothing_is_sent(image: str, capsys: Capture) -> None:
    with PtyModule(UpdatableModule()) as port, pytest.raises(SystemExit) as ended:
        main(["flash", image, "--port", port.path])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert f"3 pages, 1.5 kB, checksum {sum(PADDED):08X}" in error
    assert "--yes" in error
    assert port.received == []


def test_an_image_is_written(image: str, capsys: Capture) -> None:
    module = UpdatableModule()
    with PtyModule(module) as port:
        assert main(["flash", image, "--port", port.path, "--yes", "--json"]) == 0
        assert main(["ping", "--port", port.path]) == 0
    assert module.content == PADDED
    written = json.loads(capsys.readouterr().out.splitlines()[0])
    assert written == {
        "port": port.path,
        "pages": 3,
        "bytes": 1536,
        "checksum": f"{sum(PADDED):08X}",
        "firmware_id": None,
        "version": None,
    }


def test_a_damaged_image_is_refused_before_the_port_is_opened(
    tmp_path: Path, capsys: Capture
) -> None:
    damaged = tmp_path / "image.hex"
    damaged.write_bytes(hex_file(DATA)[:-20])
    assert main(["flash", str(damaged), "--port", "no port", "--yes"]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"xethru flash: {damaged}: line 83 ")


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.rare)],
)
def test_an_interruption_says_what_to_do(image: str, number: signal.Signals, code: int) -> None:
    module = UpdatableModule()

    def stuck(command: m.Message) -> Sequence[m.Message | bytes]:
        return [] if getattr(command, "page", 0) == 129 else module(command)

    with PtyModule(stuck) as port:
        command = [sys.executable, "-m", "xethru_protocol.cli", "flash", image, "--yes"]
        command += ["--port", port.path]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            give_up_s = time.monotonic() + seconds(10)
            while not any(getattr(one, "page", 0) == 129 for one in port.received):
                assert time.monotonic() < give_up_s
                time.sleep(0.01)
            process.send_signal(number)
            _, error = process.communicate()
    assert process.returncode == code
    assert "\nxethru flash: stopped after 1 of 3 pages" in f"\n{error}"
    assert "stays in its bootloader; write an image again" in error
    assert "Traceback" not in error
