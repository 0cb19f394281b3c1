"""Which ports of this machine may be XeThru modules: by USB ids, and running emulators.

An emulator leaves one file ``<pid>.json`` with its ready line in the run directory, because
pseudo-terminals appear in no list of ports.
"""

import json
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xethru_protocol.transport import usb_serial_ports

# Vendor and product ids; the vendor's sources disagree on which of the first two is the
# application and which the bootloader (Protocol reference 10).
_USB_IDS: dict[tuple[int | None, int | None], str] = {
    (0x03EB, 0x6124): "XeThru module",
    (0x03EB, 0x2404): "XeThru module or its bootloader",
    (0x0403, 0x6001): "FTDI adapter (X2 module?)",
    (0x0403, 0x6014): "FTDI adapter (X2 module?)",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PortInfo:
    """A port worth trying."""

    path: str
    kind: str  # "usb" or "emulated"
    description: str
    serial: str | None


def find_ports() -> tuple[PortInfo, ...]:
    """Ports that may be modules: USB first, then those of running emulators."""
    return (*_usb_ports(), *_emulated_ports(run_directory()))


def run_directory() -> Path:
    """Folder in which running emulators leave word; it may not exist."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and Path(runtime).is_dir():
        return Path(runtime) / "xethru"
    return Path(tempfile.gettempdir()) / f"xethru-{os.getuid()}"


def _usb_ports() -> Iterator[PortInfo]:
    for port in usb_serial_ports():
        description = _USB_IDS.get((port.vendor_id, port.product_id))
        if description is not None:
            yield PortInfo(path=port.path, kind="usb", description=description, serial=port.serial)


def _emulated_ports(folder: Path) -> Iterator[PortInfo]:
    if not folder.is_dir():
        return
    for entry in sorted(folder.glob("*.json")):
        try:
            word: dict[str, Any] = json.loads(entry.read_text())
            if not is_running(int(word["pid"])):
                continue
            devices = [
                (str(one["path"]), str(one["name"]), one["serial"]) for one in word["devices"]
            ]
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            continue  # not an emulator's word, or one that is just being written
        for path, name, serial in devices:
            if os.path.exists(path):  # False, too, for what can be no path
                yield PortInfo(
                    path=path, kind="emulated", description=f"emulated {name}", serial=serial
                )


def is_running(pid: int) -> bool:
    """Whether a process of this number exists; False for numbers no process can have."""
    if pid <= 0:  # kill() would mean groups of processes
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
