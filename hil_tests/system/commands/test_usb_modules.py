"""Modules on USB: found, examined, unplugged and found again, on devices that umockdev fakes.

The system lists a XeThru module, 03eb:6124, that does not exist; its port is a pseudo-terminal
behind which a scripted module answers. So what finds modules is tested against sysfs as Linux
lays it out. Needs Debian's packages ``umockdev``, ``gir1.2-umockdev-1.0`` and ``python3-gi``.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import pytest

from hil_tests.patience import seconds
from hil_tests.unit.xethru_protocol.pty_module import PRESENCE_2, PtyModule
from hil_tests.unit.xethru_protocol.scripted import PlainModule
from xethru_protocol.wire import messages as m

pytestmark = pytest.mark.slow

WITH_PROFILE: dict[m.Message | type[m.Message], list[m.Message | bytes]] = {
    m.GetProfileId: [m.ReplyInt(values=(PRESENCE_2,))]
}

_PYTHON = "/usr/bin/python3"  # Debian's package of gi is for this one
_PACKAGES = "Debian: apt-get install umockdev gir1.2-umockdev-1.0 python3-gi"
_NEEDS = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"

# /dev/NAME of the bed is one end of a pty, whose other end is joined to the module's port.
_BED = """
import fcntl, os, select, sys, threading, time, tty
import gi
gi.require_version("UMockdev", "1.0")
from gi.repository import UMockdev

bed = UMockdev.Testbed.new()
print(bed.get_root_dir(), flush=True)
plugged = {}

def join(name, outer, inner):
    while name in plugged:
        for end in select.select([outer, inner], [], [], 0.02)[0]:
            try:
                data = os.read(end, 65536)
                while data and name in plugged:
                    try:
                        data = data[os.write(inner if end == outer else outer, data) :]
                    except BlockingIOError:  # nobody reads
                        time.sleep(0.001)
            except OSError:  # no program has the port open
                time.sleep(0.005)
    os.close(outer)
    os.close(inner)

for line in sys.stdin:
    action, name, what = line.rstrip("\\n").split(" ", 2)
    if action == "plug":
        description, port = what.split(" ")
        bed.add_from_string(open(description).read())
        outer = bed.get_dev_fd("/dev/" + name)
        inner = os.open(port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(inner)
        for end in (outer, inner):  # set_blocking() is an ioctl that umockdev does not pass on
            fcntl.fcntl(end, fcntl.F_SETFL, os.O_RDWR | os.O_NONBLOCK)
        plugged[name] = threading.Thread(target=join, args=(name, outer, inner))
        slave = os.open("/dev/" + name, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(slave)  # for every program that opens it
        os.close(slave)
        plugged[name].start()
    else:
        plugged.pop(name).join()
        for depth in (0, 2, 3):  # the port, its interface, the device
            bed.remove_device("/sys" + what.rsplit("/", depth)[0])
    print("done", flush=True)
for name in list(plugged):
    plugged.pop(name).join()
"""


def usb_path(name: str) -> str:
    number = name[-1]
    return f"/devices/pci0000:00/0000:00:14.0/usb1/1-{number}/1-{number}:1.0/tty/{name}"


def described(name: str, vendor: str, product: str) -> str:
    """Device, interface and port as umockdev reads them.

    The port has a number of the driver of ptys, since this machine may have none of USB ports.
    """
    number = name[-1]
    port = usb_path(name)
    interface = port.partition("/tty/")[0]
    device = interface.rpartition("/")[0]
    return f"""\
P: {device}
E: DEVTYPE=usb_device
E: SUBSYSTEM=usb
A: idVendor={vendor}
A: idProduct={product}
A: manufacturer=XeThru
A: product=X4M300
A: serial=205A36A{number}
A: bNumInterfaces= 2
A: busnum=1
A: devnum=5

P: {interface}
E: DEVTYPE=usb_interface
E: SUBSYSTEM=usb
A: bInterfaceNumber=00
A: interface=CDC

P: {port}
N: {name}
E: DEVNAME=/dev/{name}
E: SUBSYSTEM=tty
A: dev=136:{900000 + int(number)}
L: device=../../../{interface.rpartition("/")[2]}
"""


class Bed:
    """A machine of umockdev, at whose ports modules come and go."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._held = ExitStack()

    def __enter__(self) -> Self:
        self._process = self._held.enter_context(
            subprocess.Popen(
                ["umockdev-wrapper", _PYTHON, "-c", _BED],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        )
        assert self._process.stdin is not None
        self._held.callback(self._process.stdin.close)  # it ends
        self.environment = {
            **os.environ,
            "UMOCKDEV_DIR": self._line(),
            "LD_PRELOAD": "libumockdev-preload.so.0",
            "XDG_RUNTIME_DIR": str(self._folder),
        }
        return self

    def __exit__(self, *reason: object) -> None:
        self._held.close()

    def plug(self, name: str, serial: str, ids: str = "03eb:6124") -> PtyModule:
        module = self._held.enter_context(PtyModule(PlainModule(serial, WITH_PROFILE)))
        description = self._folder / f"{name}.umockdev"
        description.write_text(described(name, *ids.split(":")))
        self._ask(f"plug {name} {description} {module.path}")
        return module

    def unplug(self, name: str) -> None:
        self._ask(f"unplug {name} {usb_path(name)}")

    def ran(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-B", "-m", "xethru_protocol.cli", *arguments]
        return subprocess.run(
            command,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=seconds(30),
            check=False,
        )

    def _ask(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        assert self._line() == "done"

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Bed]:
    if not shutil.which("umockdev-wrapper"):
        pytest.skip(f"umockdev is not installed ({_PACKAGES})")
    found = subprocess.run([_PYTHON, "-c", _NEEDS], capture_output=True, text=True, check=False)
    if found.returncode:
        reason = found.stderr.strip().rpartition("\n")[2]
        pytest.skip(f"{_PYTHON} cannot use umockdev: {reason} ({_PACKAGES})")
    with Bed(tmp_path) as bed:
        yield bed


def ports(bed: Bed) -> list[dict[str, Any]]:
    listed = bed.ran("list", "--json")
    assert listed.returncode == 0, listed.stderr
    found: list[dict[str, Any]] = json.loads(listed.stdout)["ports"]
    return found


@pytest.mark.rare
def test_modules_are_listed_examined_and_gone(bed: Bed, tmp_path: Path) -> None:
    bed.plug("ttyACM0", "100000000007")
    bed.plug("ttyACM1", "?", "03eb:2404")
    bed.plug("ttyACM2", "?", "1d6b:0002")  # something else
    found = ports(bed)
    assert [(one["path"], one["kind"], one["serial"]) for one in found] == [
        ("/dev/ttyACM0", "usb", "205A36A0"),
        ("/dev/ttyACM1", "usb", "205A36A1"),
    ]
    assert "bootloader" in found[1]["description"]
    bed.unplug("ttyACM1")
    examined = bed.ran("doctor", "--json")
    reports = json.loads(examined.stdout)["reports"]
    assert reports[0]["subject"] == "/dev/ttyACM0"
    faults = [one for report in reports for one in report["checks"] if one["level"] == "fault"]
    assert faults == []
    recorded = bed.ran(
        *("record", "--port", "/dev/ttyACM0", "--out", str(tmp_path / "rec.mcap")),
        *("--profile", "raw", "--count", "20", "--json"),
    )
    assert recorded.returncode == 0, recorded.stderr
    bed.unplug("ttyACM0")
    assert ports(bed) == []
    gone = bed.ran("ping", "--port", "/dev/ttyACM0")
    assert gone.returncode == 1
    assert "there is no port /dev/ttyACM0" in gone.stderr


_CLIENT = """
import sys
from xethru_protocol import X4M300
with X4M300.open(sys.argv[1], reconnect_s=float(sys.argv[2])) as radar:
    radar.configure_raw()
    radar.start(17)
    for frame in radar.frames(timeout_s=float(sys.argv[2])):
        print(radar.port, frame.stream, radar.fault_count, flush=True)
"""


def test_a_stream_goes_on_at_the_port_where_the_module_comes_back(bed: Bed) -> None:
    """Beside it is another module's port, which streams. umockdev gives no name a second time."""
    bed.plug("ttyACM0", "100000000007")
    client = subprocess.Popen(
        [sys.executable, "-B", "-c", _CLIENT, "/dev/ttyACM0", str(seconds(10))],
        env=bed.environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    with client, ExitStack() as ends:
        ends.callback(client.kill)
        assert client.stdout is not None
        assert client.stdout.readline().split() == ["/dev/ttyACM0", "0", "0"]
        bed.unplug("ttyACM0")
        other = bed.plug("ttyACM1", "100000000008")
        other.fps = 17.0
        bed.plug("ttyACM2", "100000000007")
        told = ["/dev/ttyACM0", "0", "0"]
        while told == ["/dev/ttyACM0", "0", "0"]:
            told = client.stdout.readline().split()
        assert told == ["/dev/ttyACM2", "1", "0"]
    assert all(isinstance(one, m.Ping | m.SystemGetInfo) for one in other.received)
