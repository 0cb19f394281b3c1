"""Ports of XeThru modules are told from other serial ports by their USB ids."""

import pytest

from xethru_protocol import transport as ports
from xethru_protocol.transport import UsbSerialPort


def port(path: str, vendor_id: int | None, product_id: int | None) -> UsbSerialPort:
    return UsbSerialPort(path=path, vendor_id=vendor_id, product_id=product_id, serial=None)


def test_only_known_usb_ids_are_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = (
        port("/dev/ttyACM0", 0x03EB, 0x6124),
        port("/dev/ttyACM1", 0x03EB, 0x2404),
        port("/dev/ttyACM2", 0x2341, 0x0043),
        port("/dev/ttyS0", None, None),
    )
    monkeypatch.setattr(ports, "usb_serial_ports", lambda: listed)
    monkeypatch.setattr(ports, "_emulated_ports", lambda folder: iter(()))
    assert [found.path for found in ports.find_ports()] == ["/dev/ttyACM0", "/dev/ttyACM1"]
