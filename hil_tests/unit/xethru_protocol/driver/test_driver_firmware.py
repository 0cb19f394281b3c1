"""Firmware images, and writing them by both drivers. Protocol reference 4.12."""

import functools
import operator
from collections.abc import Callable, Sequence

import pytest

from emulator.module.bootloader import Bootloader
from hil_tests.golden.vectors import load
from hil_tests.unit.xethru_protocol.both_drivers import DriverOn
from hil_tests.unit.xethru_protocol.machine import Machine
from hil_tests.unit.xethru_protocol.scripted import PlainModule, framed
from xethru_protocol.driver.firmware import FirmwareError, FirmwareImage
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import decode_response, encode
from xethru_protocol.wire.errors import (
    DeviceError,
    LocalProtocolError,
    RemoteProtocolError,
    ResponseTimeout,
)

Said = Sequence[m.Message | bytes]
NEW_KEY, OLD_KEY = 0xA2B96EF1, 0xA2B95EF0
BOOTING, READY = m.System(code=0x10), m.System(code=0x11)
CORE_ID = "0123456789ABCDEF"


def application(size: int, entry: int = 0x410101) -> bytes:
    """Bytes whose second word is where they start, as the processor has it."""
    content = bytes(range(7, 255)) * (size // 248 + 1)
    return b"\x00\x80\x44\x20" + entry.to_bytes(4, "little") + content[: size - 8]


def record(kind: int, address: int, data: bytes) -> str:
    """Return a line of Intel hex, whose bytes add up to a multiple of 256."""
    content = bytes((len(data), address >> 8, address & 0xFF, kind)) + data
    return f":{content.hex().upper()}{-sum(content) & 0xFF:02X}\n"


END = ":00000001FF\n"
AT_400000, AT_410000 = ":020000040040BA\n", ":020000040041B9\n"  # as add_checksum.py writes it


def hex_file(data: bytes, head: str = "", step: int = 16) -> bytes:
    lines = [record(0, at, data[at : at + step]) for at in range(0, len(data), step)]
    return (head + AT_410000 + "".join(lines) + END).encode()


def announced(checksum: int) -> str:
    return AT_400000 + record(0, 0, checksum.to_bytes(4, "little"))


DATA = application(1300)
PADDED = DATA + b"\xff" * (3 * 512 - 1300)


def _ending_like_a_start() -> bytes:
    """Return a page that ends in three bytes 7C, whose packet has the checksum 7C."""
    page = bytearray(application(509) + b"\x7c" * 3)
    packet = bytes.fromhex("7D C0 10 00 80 00") + page
    page[8] ^= functools.reduce(operator.xor, packet) ^ 0x7C
    return bytes(page)


ENDS_LIKE_A_START = _ending_like_a_start()


# --- images


@pytest.mark.parametrize("step", [16, 32, 1, 255])
def test_intel_hex_is_whole_pages_from_410000_on(step: int) -> None:
    image = FirmwareImage.parse(hex_file(DATA, step=step))
    assert image.data == PADDED
    assert image.pages == 3
    assert image.checksum == sum(DATA) + 0xFF * 236
    assert image.page_zero == image.checksum.to_bytes(4, "little") + b"\xff" * 508
    assert image.certificate is None


def test_other_forms_of_the_same_image() -> None:
    wanted = FirmwareImage.parse(hex_file(DATA))
    assert FirmwareImage.parse(DATA) == wanted, "raw bytes"
    assert FirmwareImage.parse(hex_file(DATA).replace(b"\n", b"\r\n").lower()) == wanted
    checksum = announced(sum(PADDED))
    assert FirmwareImage.parse(hex_file(DATA, checksum)) == wanted
    with_entry = hex_file(DATA).replace(END.encode(), b":0400000500410101B4\n" + END.encode())
    assert FirmwareImage.parse(with_entry) == wanted


def test_gaps_and_the_rest_of_the_last_page_are_erased_flash() -> None:
    gap = AT_410000 + record(0, 0, DATA[:16]) + record(0, 0x400, b"\x01") + END
    image = FirmwareImage.parse(gap.encode().replace(b"01014100", b"01014100"))
    assert image.data == DATA[:16] + b"\xff" * 1008 + b"\x01" + b"\xff" * 511


def test_the_vendors_certificate_is_page_zero() -> None:
    certificate = bytes(range(256)) * 2
    lines = "".join(record(0, at, certificate[at : at + 16]) for at in range(0, 512, 16))
    image = FirmwareImage.parse(hex_file(DATA, AT_400000 + lines))
    assert image.certificate == certificate
    assert image.page_zero == certificate


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "no data from address 410000h on"),
        (b"\x7fELF\x01\x01", "objcopy"),
        (hex_file(DATA)[:-12], "cut off"),
        (hex_file(DATA).replace(b":10001000", b":10001001", 1), "line 3 has a wrong checksum"),
        (hex_file(DATA).replace(b"\n", b"\nhello\n", 1), "line 2 "),
        (hex_file(DATA).replace(b":10", b":11", 1), "line 2 has another length than it says"),
        (b":0000000AF6\n" + hex_file(DATA), "line 1 is of an unknown kind, 0A"),
        ((AT_410000 + record(0, 0, b"\x01") * 2 + END).encode(), "line 3 has an address"),
        ((record(0, 0, b"\x01") + END).encode(), "outside the module's flash"),
        (hex_file(DATA, announced(sum(PADDED) + 1)), "it announces"),
        (hex_file(DATA, AT_400000 + record(0, 0, b"\x01\x02")), "it announces"),
        (hex_file(DATA, AT_400000 + record(0, 0x200, b"\x01")), "below address 410000h"),
        (hex_file(DATA, AT_400000 + record(0, 0xFFFF, b"\x01")), "below address 410000h"),
        (application(1300, 0x400101), "400101h, lies outside of it"),
        (application(1300, 0x410100), "lies outside of it"),
        (application(1300, 0x410000 + 1301), "lies outside of it"),
        (application(0x5B0000 - 0x410000 + 1), "ends at address 5B0001h"),
        (DATA[:700] + b"\x7c" * 4 + DATA[704:], "page 129 has four bytes 7C in a row"),
        (ENDS_LIKE_A_START, "page 128 has four bytes 7C in a row, or three and the checksum"),
    ],
)
def test_what_is_no_image_is_refused(content: bytes, reason: str) -> None:
    with pytest.raises(FirmwareError, match=reason):
        FirmwareImage.parse(content)


def test_the_largest_image_ends_where_the_file_system_begins() -> None:
    image = FirmwareImage.parse(application(0x5B0000 - 0x410000))
    assert image.pages == 3456 - 128


def test_a_file_that_cannot_be_read_is_named(tmp_path: object) -> None:
    with pytest.raises(FirmwareError, match=r"nothing-here\.hex cannot be read: No such file"):
        FirmwareImage.load(f"{tmp_path}/nothing-here.hex")
    with pytest.raises(FirmwareError):
        FirmwareImage.load(str(tmp_path))


# --- modules


class UpdatableModule(PlainModule):
    """An application that knows one key, and behind it the emulated bootloader."""

    def __init__(self, key: int = NEW_KEY, core_id: str | None = CORE_ID) -> None:
        super().__init__()
        self.key = key
        self.core_id = core_id
        self.bootloader = Bootloader(core_id or CORE_ID)
        self.runs_application = True
        # what the line does to packets
        self.mangle: Callable[[m.Message, bytes], bytes] = lambda command, packet: packet
        self.banner: bytes | None = None

    def __call__(self, command: m.Message) -> Said:
        if self.runs_application:
            return self._application(command)
        said: list[m.Message] = []
        if self.banner is not None and isinstance(command, m.BootloaderGetDeviceInfo):
            return [m.BootloaderSuccess(data=self.banner)]
        packet = self.mangle(command, framed(encode(command)))
        said += [decode_response(answer) for answer in self.bootloader.receive(packet)]
        if self.bootloader.started:
            self.power_cycle()
            said += [BOOTING, READY]
        return said

    def power_cycle(self) -> None:
        self.bootloader.power_up()
        self.runs_application = not self.bootloader.stays

    def _application(self, command: m.Message) -> Said:
        match command:
            case m.StartBootloader(key=key) if key == self.key:
                self.runs_application = False
                return [m.Ack()]
            case m.StartBootloader():
                return [m.DataString(text="Unknown start_bootloader key."), m.Error(code=1)]
            case m.SystemGetInfo(item=8) if self.core_id is not None:
                return [m.ReplyString(content_id=0x58, info=8, text=self.core_id)]
        if command.__class__.__name__.startswith("Bootloader"):
            return [m.Error(code=1)]
        return super().__call__(command)

    @property
    def content(self) -> bytes:
        return b"".join(self.bootloader.page(128 + number) for number in range(3))


IMAGE = FirmwareImage.parse(DATA)


def test_an_image_is_written_upwards_verified_and_started(driver_on: DriverOn) -> None:
    module = UpdatableModule()
    radar, line = driver_on(module)
    told: list[tuple[int, int]] = []
    radar.firmware.write(IMAGE, lambda *at: told.append(at))
    assert module.content == PADDED
    assert module.runs_application
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]
    written = [c for c in line.received if isinstance(c, m.BootloaderWritePage)]
    assert [command.page for command in written] == [0, 128, 129, 130]
    assert written[0].data[:4] == sum(PADDED).to_bytes(4, "little")
    assert all(len(command.data) == 512 for command in written)
    assert radar.ping() == 0xAAEEAEEA


def test_a_module_in_its_bootloader_is_taken_as_it_is(driver_on: DriverOn) -> None:
    module = UpdatableModule()
    module.runs_application = False
    radar, line = driver_on(module)
    assert radar.firmware.start_bootloader() == f"XETHRU OPENBOOTLOADER V:0.1.2 ID:{CORE_ID}"
    radar.firmware.write(IMAGE)
    assert module.content == PADDED
    assert not [c for c in line.received if isinstance(c, m.StartBootloader)]


def test_older_firmware_has_another_key(driver_on: DriverOn) -> None:
    radar, line = driver_on(UpdatableModule(OLD_KEY))
    radar.firmware.start_bootloader()
    asked = [c.key for c in line.received if isinstance(c, m.StartBootloader)]
    assert asked == [NEW_KEY, OLD_KEY]


def test_an_application_that_answers_on_for_a_while_is_waited_for(driver_on: DriverOn) -> None:
    module = UpdatableModule()
    until_ns = -1

    def slow_to_leave(command: m.Message) -> Said:
        nonlocal until_ns
        if 0 <= line.now_ns < until_ns:
            return [m.Error(code=1)]
        if isinstance(command, m.StartBootloader):
            until_ns = line.now_ns + 500_000_000
        return module(command)

    radar, line = driver_on(slow_to_leave)
    assert "OPENBOOTLOADER" in radar.firmware.start_bootloader()
    assert 0.5e9 <= line.now_ns < 1e9


def test_no_key_fits(driver_on: DriverOn) -> None:
    radar, _ = driver_on(UpdatableModule(0))
    with pytest.raises(DeviceError, match="NOT_RECOGNIZED"):
        radar.firmware.start_bootloader()
    assert radar.ping() == 0xAAEEAEEA


def test_nothing_answers(driver_on: DriverOn) -> None:
    radar, _ = driver_on(lambda command: [])
    with pytest.raises(ResponseTimeout):
        radar.firmware.write(IMAGE)


def test_damaged_pages_are_written_again(driver_on: DriverOn) -> None:
    module = UpdatableModule()
    damaged = {0: 1, 129: 2}

    def mangle(command: m.Message, packet: bytes) -> bytes:
        page = getattr(command, "page", -1)
        if damaged.get(page, 0):
            damaged[page] -= 1
            return packet[:40] + b"\x00\x01\x02\x03\x7d\x05" + packet[46:]
        return packet

    module.mangle = mangle
    radar, line = driver_on(module)
    radar.firmware.write(IMAGE)
    assert module.content == PADDED
    pages = [c.page for c in line.received if isinstance(c, m.BootloaderWritePage)]
    assert pages == [0, 0, 128, 129, 129, 129, 130]
    assert len(radar.warnings) == 3


def test_a_line_that_damages_everything_is_given_up(driver_on: DriverOn) -> None:
    module = UpdatableModule()
    module.mangle = lambda command, packet: (
        packet[:40] + b"\x00\x7d" + packet[42:] if getattr(command, "page", 0) == 129 else packet
    )
    radar, _ = driver_on(module)
    with pytest.raises(FirmwareError, match=r"FRAMING_ERROR LOST_BYTES.*stays in its bootloader"):
        radar.firmware.write(IMAGE)


def test_a_flash_that_differs_is_told_with_the_remedy(driver_on: DriverOn) -> None:
    module = UpdatableModule()
    # damage that the checksum of the line does not show
    module.mangle = lambda command, packet: (
        framed(encode(command)[:9] + b"\x00" + encode(command)[10:])
        if getattr(command, "page", 0) == 130
        else packet
    )
    radar, _ = driver_on(module)
    with pytest.raises(FirmwareError, match=r"WRONG_CHECKSUM.*write an image again.*power was off"):
        radar.firmware.write(IMAGE)
    with pytest.raises(FirmwareError, match=r"WRITING_REFUSED.*switch it off and on"):
        radar.firmware.write(IMAGE)
    module.mangle = lambda command, packet: packet
    module.power_cycle()
    assert not module.runs_application
    radar.firmware.write(IMAGE)
    assert module.content == PADDED
    assert module.runs_application


def test_a_page_that_was_not_written_ends_the_update(driver_on: DriverOn) -> None:
    """E0 without 33, as after an unknown command."""
    module = UpdatableModule()

    def mangle(command: m.Message, packet: bytes) -> bytes:
        if getattr(command, "page", 0) == 129:
            list(module.bootloader.receive(framed(b"\xc0\x30")))
        return packet

    module.mangle = mangle
    radar, _ = driver_on(module)
    with pytest.raises(FirmwareError, match=r"did not write page 129.*stays in its bootloader"):
        radar.firmware.write(IMAGE)


def test_an_interrupted_update_is_done_again(driver_on: DriverOn) -> None:
    module = UpdatableModule()
    radar, _ = driver_on(module)

    def interrupt(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        radar.firmware.write(IMAGE, interrupt)
    module.power_cycle()
    assert not module.runs_application
    again, _ = driver_on(module)
    again.firmware.write(IMAGE)
    assert module.content == PADDED
    assert module.runs_application


@pytest.mark.parametrize(
    ("image", "banner", "reason"),
    [
        (FirmwareImage(data=PADDED, certificate=bytes(512)), None, "signed for the vendor's"),
        (IMAGE, b"XETHRU BOOTLOADER V:1.0 ", "takes signed images only"),
    ],
)
def test_an_image_for_another_bootloader_is_not_written(
    driver_on: DriverOn, image: FirmwareImage, banner: bytes | None, reason: str
) -> None:
    module = UpdatableModule()
    module.banner = banner
    radar, line = driver_on(module)
    with pytest.raises(FirmwareError, match=f"{reason}.*nothing was written"):
        radar.firmware.write(image)
    assert not [c for c in line.received if isinstance(c, m.BootloaderWritePage)]
    module.power_cycle()
    assert module.runs_application


def test_a_signed_image_goes_to_the_vendors_bootloader(driver_on: DriverOn) -> None:
    """No command is sent of which it is not known that this bootloader has it."""
    module = UpdatableModule()
    module.banner = b"XETHRU BOOTLOADER V:1.0 "
    certificate = sum(PADDED).to_bytes(4, "little") + bytes(range(1, 255)) * 2
    radar, line = driver_on(module)
    radar.firmware.write(FirmwareImage(data=PADDED, certificate=certificate))
    assert module.content == PADDED
    pages = [c for c in line.received if isinstance(c, m.BootloaderWritePage)]
    assert pages[0] == m.BootloaderWritePage(page=0, data=certificate.ljust(512, b"\xff"))
    unproven = (m.BootloaderPageSize, m.BootloaderPageCount, m.BootloaderEcho)
    assert not [c for c in line.received if isinstance(c, unproven)]


def test_a_flash_that_is_too_small_is_not_written(driver_on: DriverOn) -> None:
    module = UpdatableModule()
    module.bootloader = Bootloader(CORE_ID, page_count=2)
    radar, _ = driver_on(module)
    with pytest.raises(FirmwareError, match="3 pages of 512 bytes, the module's flash 2 of 512"):
        radar.firmware.write(IMAGE)


@pytest.mark.parametrize("decoy_runs", [False, True])
def test_the_bootloader_is_found_at_another_port(driver_on: DriverOn, decoy_runs: bool) -> None:
    """10: on USB it is another device; it is known by the microcontroller's number."""
    machine = Machine("decoy", "elsewhere", "home")
    other = UpdatableModule(core_id="another number..")
    other.runs_application = decoy_runs
    machine.plug("decoy", other)
    module = UpdatableModule()

    def behind_a_cable(command: m.Message) -> Said:
        said = module(command)
        line = machine.lines[-1] if machine.lines else first
        now_s = first.now_ns * 1e-9
        if isinstance(command, m.StartBootloader):
            line.vanish_later(0.5)
            machine.plug("elsewhere", behind_a_cable, now_s + 2.5)
        elif isinstance(command, m.BootloaderStartApp):
            line.vanish_later(0.1)
            machine.plug("home", behind_a_cable, now_s + 2.0)
            return said[:1]  # BOOTING and READY are lost
        return said

    radar, first = driver_on(behind_a_cable, ports=machine.ports, name="home")
    machine.runs_on(first)
    radar.firmware.write(IMAGE)
    assert module.content == PADDED
    assert radar.port == "home"
    assert other.bootloader.page(128) == b"\xff" * 512


@pytest.mark.parametrize("banner", ["OLD BOOTLOADER", f"NEW BOOTLOADER ID:{CORE_ID}"])
@pytest.mark.parametrize("core_id", [CORE_ID, None])
def test_a_bootloader_is_known_by_its_port_where_a_number_is_missing(
    driver_on: DriverOn, core_id: str | None, banner: str
) -> None:
    """Either the banner or the application has none: what comes back at the port is the module."""
    machine = Machine("home")
    module = UpdatableModule(core_id=core_id)
    module.banner = banner.encode()

    def behind_a_cable(command: m.Message) -> Said:
        if isinstance(command, m.StartBootloader):
            first.vanish_later(0.5)
            machine.plug("home", module, first.now_ns * 1e-9 + 2.5)
        # the bootloader hears nothing before it is a device of its own
        return module(command) if module.runs_application else []

    radar, first = driver_on(behind_a_cable, ports=machine.ports, name="home")
    machine.runs_on(first)
    assert radar.firmware.start_bootloader() == banner


# --- single questions


VECTORS = {vector.name: vector for vector in load()}


@pytest.mark.parametrize(
    ("vector", "code", "meaning"),
    [
        ("bl_reply_framing_error_checksum", 0xE1, "FRAMING_ERROR CRC"),
        ("bl_reply_error_unknown_command", 0xE2, "UNKNOWN_COMMAND"),
        ("bl_reply_error_writing_refused", 0xE3, "WRITING_REFUSED"),
        ("bl_reply_error_wrong_checksum", 0xE4, "WRONG_CHECKSUM"),
        ("bl_reply_error_page_out_of_bounds", 0xE5, "PAGE_OUT_OF_BOUNDS"),
    ],
)
def test_an_answer_that_is_an_error_raises(
    driver_on: DriverOn, vector: str, code: int, meaning: str
) -> None:
    radar, _ = driver_on(lambda command: [VECTORS[vector].wire])
    with pytest.raises(DeviceError) as raised:
        radar.request(m.BootloaderPageSize())
    assert (raised.value.code, raised.value.meaning) == (code, meaning)


@pytest.mark.parametrize(
    "stray",
    [
        m.Ack(),
        m.DataString(text="hello"),
        m.BootloaderEchoed(data=b"\x00\x02"),
        m.UnknownMessage(code=0xE9, payload=b"\xe9\x00\x02"),
        m.ReplyByte(values=b"\x00\x02"),
    ],
)
def test_a_stray_message_is_no_answer(driver_on: DriverOn, stray: m.Message) -> None:
    size = VECTORS["bl_reply_page_size_512"].wire
    radar, _ = driver_on(lambda command: [stray, size])
    assert radar.request(m.BootloaderPageSize()).data == b"\x00\x02"
    silent, _ = driver_on(lambda command: [stray])
    with pytest.raises((ResponseTimeout, RemoteProtocolError)):
        silent.request(m.BootloaderPageSize())


def test_an_echo_is_the_one_that_was_asked_for(driver_on: DriverOn) -> None:
    late = m.BootloaderEchoed(data=b"earlier")
    radar, _ = driver_on(
        lambda command: [late, m.BootloaderError(code=0xE2), command_echo(command)]
    )
    assert radar.request(m.BootloaderEcho(data=b"\x01\x7e\x03")).data == b"\x01\x7e\x03"


def command_echo(command: m.Message) -> m.Message:
    assert isinstance(command, m.BootloaderEcho)
    return m.BootloaderEchoed(data=command.data)


def test_after_a_silence_an_echo_brings_both_sides_into_step(driver_on: DriverOn) -> None:
    module = UpdatableModule()
    module.runs_application = False
    radar, line = driver_on(module)
    with pytest.raises(ResponseTimeout):  # nothing is written, so there is no answer
        radar.request(m.BootloaderStartApp())
    assert radar.request(m.BootloaderPageCount()).data == b"\x80\x0e"
    assert isinstance(line.received[1], m.BootloaderEcho)


def test_more_than_a_packet_is_not_sent(driver_on: DriverOn) -> None:
    radar, line = driver_on(UpdatableModule())
    with pytest.raises(LocalProtocolError):
        radar.request(m.BootloaderEcho(data=bytes(8000)))
    assert line.received == []
