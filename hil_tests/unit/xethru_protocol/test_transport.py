"""Serial transport on pseudo-terminals."""

import fcntl
import gc
import math
import os
import pty
import resource
import struct
import sys
import termios
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
from serial.tools.list_ports_common import ListPortInfo

from hil_tests.patience import seconds, wait_until
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.transport import (
    SerialTransport,
    announcements,
    carried_rate_hz,
    find_ports,
    run_directory,
)
from xethru_protocol.wire.errors import Disconnected, LocalProtocolError, PortUnavailable


class Line:
    """A pty: ``master`` is the module's end, ``path`` the port."""

    def __init__(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self._open = [self.master, slave]

    def unplug(self) -> None:
        while self._open:
            os.close(self._open.pop())


@pytest.fixture
def line() -> Iterator[Line]:
    line = Line()
    yield line
    line.unplug()


@pytest.mark.parametrize("replays", [True, False])
def test_programs_that_replace_methods_of_pyserial_are_named(
    line: Line, monkeypatch: pytest.MonkeyPatch, replays: bool
) -> None:
    """pytest-reserial 0.6 patches these; its replay has no descriptor, its record no bytes."""

    def read(port: serial.Serial, size: int = 1) -> bytes:
        return b""

    def no_open(port: serial.Serial) -> None:
        port.is_open, port.fd = True, None

    monkeypatch.setattr(serial.Serial, "read", read)
    if replays:
        monkeypatch.setattr(serial.Serial, "open", no_open)
    path = "/dev/none" if replays else line.path
    with pytest.raises(PortUnavailable, match=rf"{__name__} has replaced .*xethru-emulator play"):
        X4M300.open(path)


@pytest.fixture
def port(line: Line) -> Iterator[SerialTransport]:
    port = SerialTransport(line.path)
    yield port
    port.close()


def test_one_program_at_a_time(line: Line, port: SerialTransport) -> None:
    with pytest.raises(PortUnavailable, match=f"port {line.path} is in use by another program"):
        SerialTransport(line.path)
    port.close()
    SerialTransport(line.path).close()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux shows whether a port is exclusive")
def test_port_is_exclusive_until_it_is_closed(line: Line) -> None:
    """Also for programs that do not ask for the lock, such as the vendor's."""
    port = SerialTransport(line.path)
    assert is_exclusive(port.fileno())
    port.close()
    other = os.open(line.path, os.O_RDWR | os.O_NOCTTY)
    assert not is_exclusive(other)
    os.close(other)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux shows whether a port is exclusive")
def test_a_port_that_is_dropped_is_as_free_as_a_closed_one(line: Line) -> None:
    before = set(os.listdir("/proc/self/fd"))
    port = SerialTransport(line.path)
    del port
    gc.collect()
    assert set(os.listdir("/proc/self/fd")) == before
    other = os.open(line.path, os.O_RDWR | os.O_NOCTTY)
    assert not is_exclusive(other)
    os.close(other)


def is_exclusive(descriptor: int) -> bool:
    get = 0x80045440  # TIOCGEXCL, which termios does not have
    return bool(struct.unpack("i", fcntl.ioctl(descriptor, get, bytes(4)))[0])


def test_closing_ends_the_wait_of_another_thread(line: Line, port: SerialTransport) -> None:
    ends: list[object] = []

    def read() -> None:
        try:
            ends.append(port.read(seconds(60)))
        except Disconnected as error:
            ends.append(str(error))

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    time.sleep(0.05)  # it waits now, or is about to: both must end
    port.close()
    reader.join(seconds(30))
    assert ends == [f"{line.path} was closed"]


def test_unplugged_port_is_disconnected_and_can_be_closed(
    line: Line, port: SerialTransport
) -> None:
    line.unplug()
    with pytest.raises(Disconnected):
        port.read(1.0)
    with pytest.raises(Disconnected):
        port.write(b"\x00")
    port.close()
    port.close()
    with pytest.raises(Disconnected, match="was closed"):
        port.read(0.0)


def test_read_waits_for_what_comes_in_time(line: Line, port: SerialTransport) -> None:
    timer = threading.Timer(0.1, os.write, (line.master, b"late"))
    timer.start()
    assert port.read(math.inf) == b"late"
    timer.join()


def test_long_writes_wait_for_room(line: Line, port: SerialTransport) -> None:
    data = bytes(range(256)) * 400
    got = bytearray()

    def take_slowly() -> None:
        time.sleep(0.1)  # the line is full by now
        while len(got) < len(data):
            got.extend(os.read(line.master, 4096))

    reader = threading.Thread(target=take_slowly)
    reader.start()
    port.write(data)
    reader.join()
    assert bytes(got) == data


def test_line_that_takes_nothing_is_given_up(
    port: SerialTransport, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("xethru_protocol.transport._WRITE_TIMEOUT_S", 0.1)
    with pytest.raises(Disconnected):
        port.write(bytes(1 << 20))


def test_frame_is_read_in_few_pieces_never_byte_by_byte(line: Line, port: SerialTransport) -> None:
    """Field measurement: pyserial's read(1) carries 49 frames/s, reads of all there is 43 900."""
    os.write(line.master, bytes(5747))  # a radar frame; one call of a tty gives at most 4095
    sizes: list[int] = []

    def is_full() -> bool:  # the kernel moves bytes on at no certain time
        n_waiting = struct.unpack("i", fcntl.ioctl(port.fileno(), termios.FIONREAD, bytes(4)))[0]
        return bool(n_waiting >= min(4095, 5747 - sum(sizes)))

    while sum(sizes) < 5747:
        wait_until(is_full)
        sizes.append(len(port.read(1.0)))
    assert len(sizes) <= 2


def test_every_byte_passes_unchanged_although_the_line_was_not_raw() -> None:
    """A fresh pty echoes, edits lines and swallows control bytes, 11h and 13h among them."""
    master, slave = pty.openpty()
    port = SerialTransport(os.ttyname(slave))
    port.write(bytes(range(256)))
    assert os.read(master, 999) == bytes(range(256))
    os.write(master, bytes(range(256)))
    assert port.read(1.0) == bytes(range(256))
    assert port.read(0.0) == b""
    port.write(b"!")
    assert os.read(master, 999) == b"!"  # nothing was echoed
    port.close()
    os.close(master)
    os.close(slave)


def test_what_waited_from_before_the_opening_is_not_read(line: Line) -> None:
    os.write(line.master, b"stale")
    port = SerialTransport(line.path)
    assert port.read(0.05) == b""
    port.close()


def test_port_without_modem_lines_is_opened_and_closed(line: Line) -> None:
    with pytest.raises(OSError, match="Inappropriate ioctl"):  # what setting them would say
        serial.Serial(line.path, timeout=0).dtr = False
    port = SerialTransport(line.path)
    port.set_baudrate(921600)
    port.close()


def test_line_is_pending_data_first_then_disconnected(line: Line, port: SerialTransport) -> None:
    os.write(line.master, b"last words")
    assert port.read(0.5) == b"last words"
    line.unplug()
    with pytest.raises(Disconnected):
        port.read(0.0)
    with pytest.raises(Disconnected, match="cannot be set to 9600 baud"):
        port.set_baudrate(9600)
    port.close()
    with pytest.raises(Disconnected, match="was closed"):
        port.fileno()


@pytest.mark.parametrize("end", [None, b"", OSError("gone")], ids=["empty", "hung up", "error"])
def test_read_takes_all_that_waits_and_loses_none_of_it(
    port: SerialTransport, monkeypatch: pytest.MonkeyPatch, end: bytes | OSError | None
) -> None:
    calls = iter([b"a" * 4095, b"b" * 4095, b"c" * 4095, end])

    def take() -> bytes | None:
        piece = next(calls)
        if isinstance(piece, OSError):
            raise piece
        return piece

    monkeypatch.setattr(port, "_take", take)
    assert port.read(0.0) == b"a" * 4095 + b"b" * 4095 + b"c" * 4095


def test_only_a_uart_has_a_limit(
    port: SerialTransport, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # emulated UARTs of others are none here
    assert port.bytes_per_s == math.inf
    for real, limit in [
        ("/dev/ttyUSB0", 11520.0),
        ("/dev/ttyS1", 11520.0),
        ("/dev/ttyACM3", math.inf),
    ]:
        monkeypatch.setattr("os.path.realpath", lambda path, real=real: real)
        assert port.bytes_per_s == limit


def test_descriptors_above_1023_work(line: Line) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 1200:
        pytest.skip("this system allows no descriptor above 1023")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 1200), hard))
    taken: list[int] = []
    try:
        while not taken or taken[-1] < 1023:
            taken.append(os.dup(line.master))
        port = SerialTransport(line.path)
        port.write(b"\x7d\x10\x6d\x7e")
        assert os.read(line.master, 99) == b"\x7d\x10\x6d\x7e"
        os.write(line.master, b"answer")
        assert port.read(1.0) == b"answer"
        port.close()
    finally:
        for descriptor in taken:
            os.close(descriptor)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_only_known_usb_ids_are_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = []
    for path, vendor_id, product_id in [
        ("/dev/ttyACM1", 0x03EB, 0x2404),
        ("/dev/ttyACM0", 0x03EB, 0x6124),
        ("/dev/ttyACM2", 0x2341, 0x0043),
        ("/dev/ttyUSB0", 0x0403, 0x6001),
        ("/dev/ttyUSB1", 0x0403, 0x6014),
        ("/dev/ttyUSB2", 0x0403, 0x6015),
        ("/dev/ttyS0", None, None),
    ]:
        listed.append(ListPortInfo(path))
        listed[-1].vid, listed[-1].pid = vendor_id, product_id
    monkeypatch.setattr("xethru_protocol.transport.list_ports.comports", lambda: listed)
    monkeypatch.setattr("xethru_protocol.transport._emulated_ports", lambda folder: iter(()))
    assert [(found.path, found.description) for found in find_ports()] == [
        ("/dev/ttyACM0", "XeThru module"),
        ("/dev/ttyACM1", "XeThru module in its bootloader"),
        ("/dev/ttyUSB0", "FTDI adapter (X2 module?)"),
        ("/dev/ttyUSB1", "FTDI adapter (X2 module?)"),
    ]


def test_missing_port_says_where_to_look(tmp_path: Path) -> None:
    with pytest.raises(PortUnavailable, match=r"there is no port .*/radar; 'xethru list'"):
        SerialTransport(str(tmp_path / "radar"))


def test_what_is_no_port_is_called_so(tmp_path: Path) -> None:
    for path in (__file__, str(tmp_path)):
        with pytest.raises(PortUnavailable):
            SerialTransport(path)


def test_a_rate_beyond_all_sense_is_no_port(line: Line) -> None:
    with pytest.raises(PortUnavailable, match=line.path):
        SerialTransport(line.path, 2**40)


def test_driver_that_cannot_be_made_gives_its_port_back(line: Line) -> None:
    # the error is held, and with it everything that its frames refer to
    with pytest.raises(LocalProtocolError) as refused:
        X4M300.open(line.path, queue_frames=0)
    SerialTransport(line.path).close()
    assert refused.value


@pytest.mark.parametrize(
    ("bytes_per_s", "rate_hz"),
    # 80 % of the line over 5747 bytes, whole Hz, at least one
    [(math.inf, 17.0), (92160.0, 12.0), (11520.0, 1.0), (960.0, 1.0)],
)
def test_rates_that_lines_carry(bytes_per_s: float, rate_hz: float) -> None:
    assert carried_rate_hz(17.0, bytes_per_s, 5747) == rate_hz


def test_a_pipe_among_the_announcements_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = run_directory()
    folder.mkdir(mode=0o700)
    os.mkfifo(folder / "1.json")
    (folder / "2.json").symlink_to("/dev/zero")
    (folder / "3.json").write_text("{}")
    assert announcements(folder) == [folder / "3.json"]
