"""Ports of XeThru modules are recognised among other serial ports by their USB ids."""

import pytest
from serial.tools.list_ports_common import ListPortInfo

from xethru_protocol import transport as ports


def port(path: str, vendor_id: int | None, product_id: int | None) -> ListPortInfo:
    found = ListPortInfo(path)
    found.vid, found.pid = vendor_id, product_id
    return found


def test_only_known_usb_ids_are_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = [
        port("/dev/ttyACM1", 0x03EB, 0x2404),
        port("/dev/ttyACM0", 0x03EB, 0x6124),
        port("/dev/ttyACM2", 0x2341, 0x0043),
        port("/dev/ttyS0", None, None),
    ]
    monkeypatch.setattr("xethru_protocol.transport.list_ports.comports", lambda: listed)
    monkeypatch.setattr(ports, "_emulated_ports", lambda folder: iter(()))
    assert [found.path for found in ports.find_ports()] == ["/dev/ttyACM0", "/dev/ttyACM1"]
