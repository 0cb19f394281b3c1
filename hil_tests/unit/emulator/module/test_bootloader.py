"""The emulated bootloader, by its source. Protocol reference 4.12, 1.2."""

from collections.abc import Iterator
from random import Random

import pytest

from emulator.module.parser import PacketParser
from emulator.module.settings import DeviceOptions
from hil_tests.golden.test_protocol_vectors import MESSAGES, STREAMS
from hil_tests.golden.vectors import Vector, load
from hil_tests.unit.emulator.doubles import BareHost, host_of
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import BootloaderFraming
from xethru_protocol.wire.framing import encode_normal

SECOND = 1_000_000_000
VECTORS = {vector.name: vector for vector in load()}
NOT_WRITTEN, WRITTEN = "E0", "E0 33"


def found_in(data: bytes, size: int = 8000, chunk: int = 1 << 20) -> Iterator[str]:
    parser = PacketParser(size)
    for at in range(0, len(data), chunk):
        for found in parser.receive(data[at : at + chunk]):
            if isinstance(found, BootloaderFraming):
                yield found.name
            else:
                yield bytes(found[0][: found[1]]).hex(" ").upper()


@pytest.mark.parametrize("chunk", [1, 7, 1 << 20])
@pytest.mark.parametrize("vector", STREAMS, ids=lambda v: v.name)
def test_parser_finds_what_the_vendors_finds(vector: Vector, chunk: int) -> None:
    found = list(found_in(vector.wire, chunk=chunk))
    names = {"CRC_ERROR": "CRC"}
    errors = [names.get(error, error) for error in vector.decoded["parser_errors"]]
    assert [item for item in found if item in BootloaderFraming.__members__] == errors
    assert [item for item in found if item not in errors] == vector.decoded["packets"]


def test_parser_takes_every_packet() -> None:
    for vector in MESSAGES:
        if vector.payload is not None:
            assert list(found_in(vector.wire)) == [vector.decoded["payload"]], vector.name


def test_parser_counts_the_bytes_of_the_deprecated_framing() -> None:
    """1.2: 51, length, that many bytes whatever they are, and one more."""
    fast = "51 03 00 00 00 7D 7E 7F"
    assert list(found_in(bytes.fromhex(fast) + b"\x00" + bytes.fromhex("7D 10 6D 7E"))) == [
        fast,
        "10",
    ]


def test_parser_finds_the_same_in_any_chunks() -> None:
    """Whole runs of bytes are taken at once, so single bytes judge them."""
    random = Random(1)
    marks = bytes.fromhex("7D 7E 7F 7C 51 00 01 C0")
    for _ in range(3000):
        data = bytes(random.choices(marks, k=random.randrange(1, 80)))
        data = data.replace(b"\x7c\x7c", b"\x7c\x7c\x7c\x7c\x02\x00\x00\x00\x00")
        size = random.choice((12, 33, 64))
        assert list(found_in(data, size)) == list(found_in(data, size, 1))


class BootloaderHost:
    """Asks a module in its bootloader; payloads as hexadecimal."""

    def __init__(self, host: BareHost) -> None:
        self.host = host
        assert host.ask(m.StartBootloader(key=0xA2B96EF1)) == m.Ack()
        assert self.wait() == [], "no BOOTING, no READY"

    def wait(self, seconds: float = 3.0) -> list[m.Message]:
        return self.host.at(self.host.now_ns + round(seconds * SECOND))

    def power_cycle(self) -> list[m.Message]:
        self.host.device.power_cycle(self.host.now_ns)
        return self.wait()

    def send(self, data: bytes) -> str:
        """Return the answers of the module, separated by ``|``."""
        device = self.host.device
        device.receive_data(data, self.host.now_ns)
        packets = []
        while (packet := device.next_packet(self.host.now_ns)) is not None:
            packets += [item for item in found_in(packet)]
        return " | ".join(packets)

    def ask(self, payload: str | bytes) -> str:
        return self.send(
            encode_normal(bytes.fromhex(payload) if isinstance(payload, str) else payload)
        )

    def write(self, page: int, data: bytes) -> str:
        return self.ask(b"\xc0\x10" + page.to_bytes(2, "big") + b"\x00" + data)

    def announce(self, checksum: int) -> str:
        return self.write(0, checksum.to_bytes(4, "little"))

    def content(self, page: int) -> bytes:
        return self.host.device.module.bootloader.page(page)


@pytest.fixture
def boot(host: BareHost) -> BootloaderHost:
    return BootloaderHost(host)


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("bl_get_page_size", "bl_reply_page_size_512"),
        ("bl_get_page_count", "bl_reply_page_count_3712"),
        ("bl_echo", "bl_reply_echo"),
        ("bl_write_page_0_checksum", "bl_reply_success"),
        ("bl_write_page_128", "bl_reply_page_written"),
        ("bl_unknown_command", "bl_reply_error_unknown_command"),
    ],
)
def test_answers_are_the_vectors(boot: BootloaderHost, command: str, answer: str) -> None:
    assert boot.send(VECTORS[command].wire) == VECTORS[answer].decoded["payload"]


def test_banner_ends_with_the_microcontrollers_own_number(boot: BootloaderHost) -> None:
    banner = bytes.fromhex(boot.ask("C0 00"))
    assert banner == b"\xe0XETHRU OPENBOOTLOADER V:0.1.2 ID:EMUL202611210001 "


def test_a_small_microcontroller_has_fewer_pages() -> None:
    boot = BootloaderHost(host_of(DeviceOptions(storage_bytes=0x18000)))
    assert boot.ask("C0 02") == "E0 80 06"


def test_what_is_not_for_the_bootloader_gets_no_answer(boot: BootloaderHost) -> None:
    for payload in ("01 AE EA AA EE", "22", "26", "A0", "C0", "EE", "02 F1 6E B9 A2"):
        assert boot.ask(payload) == ""


@pytest.mark.parametrize("key", [0xA2B95EF0, 0])
def test_the_wrong_key_is_answered_with_the_vendors_text(host: BareHost, key: int) -> None:
    """4.1; 11 row 19: the old key is refused."""
    host.send(m.StartBootloader(key=key))
    text, error = host.hear(2)
    assert text == m.DataString(text=VECTORS["data_string_unknown_bootloader_key"].decoded["value"])
    assert error == m.Error(code=1)


def test_start_without_a_page_gets_no_answer_and_ends_writing(boot: BootloaderHost) -> None:
    assert boot.announce(0) == "E0"
    assert boot.ask("C0 20") == ""
    assert boot.write(128, bytes(512)) == NOT_WRITTEN
    assert boot.announce(0) == "E3"
    assert boot.content(128) == b"\xff" * 512


def test_an_unknown_command_ends_writing(boot: BootloaderHost) -> None:
    boot.announce(0)
    assert boot.ask("C0 30") == "E2"
    assert boot.write(128, bytes(512)) == NOT_WRITTEN
    assert boot.announce(0) == "E3"
    assert boot.ask("C0 01") == "E0 00 02", "it answers all the same"


def test_pages_outside_the_application_are_not_written(boot: BootloaderHost) -> None:
    boot.announce(0)
    for page in (1, 64, 127):
        assert boot.write(page, bytes(512)) == NOT_WRITTEN
        assert boot.content(page) == b"\xff" * 512
    assert [boot.write(page, bytes(512)) for page in (128, 3456)] == [WRITTEN] * 2
    assert [boot.write(page, bytes(512)) for page in (3457, 0xFFFF)] == ["E5"] * 2


def test_locked_flash_ignores_pages(boot: BootloaderHost) -> None:
    """Page 0 unlocks it; the bootloader does not look whether a page was written."""
    assert boot.write(128, bytes(512)) == WRITTEN
    assert boot.content(128) == b"\xff" * 512


def test_every_sixteenth_page_erases_sixteen(boot: BootloaderHost) -> None:
    boot.announce(0)
    for page in (128, 129, 143, 144):
        boot.write(page, b"\x0f" * 512)
    boot.write(129, b"\xf3" * 512)
    assert boot.content(129) == b"\x03" * 512, "writing clears bits only"
    boot.write(128, b"\xf3" * 512)
    assert [boot.content(page)[0] for page in (128, 129, 143, 144)] == [0xF3, 0xFF, 0xFF, 0x0F]


def test_a_short_page_takes_what_the_buffer_still_holds(boot: BootloaderHost) -> None:
    boot.announce(0)
    boot.write(128, b"\xaa" * 512)
    boot.write(129, b"\x01\x02\x03")
    # behind the payload stands the checksum that came with it
    checksum = 0x7D ^ 0xC0 ^ 0x10 ^ 129 ^ 1 ^ 2 ^ 3
    assert boot.content(129) == bytes((1, 2, 3, checksum)) + b"\xaa" * 508


@pytest.mark.parametrize(
    ("wire", "answer"),
    [
        ("7D C0 00 BC 7E", "E1 01"),
        ("7D C0 00 7D C0 01 BC 7E", "E1 02 | E0 00 02"),
        ("7E 7D C0 01 BC 7E", "E1 03 | E0 00 02"),
    ],
)
def test_damage_is_reported(boot: BootloaderHost, wire: str, answer: str) -> None:
    assert boot.send(bytes.fromhex(wire)) == answer


def test_a_packet_longer_than_the_buffer_is_reported(boot: BootloaderHost) -> None:
    echo = b"\xc0\xef" + bytes(2045)  # with its checksum 2048 bytes: it fits, its end does not
    assert boot.ask(echo[:-1]) == (echo[1:-1]).hex(" ").upper()
    assert boot.ask(echo) == "E1 04"
    assert boot.ask("C0 01") == "E0 00 02"


def image(pages: int) -> bytes:
    return bytes(range(1, 256)) * 2 * pages + bytes(2 * pages)


def update(boot: BootloaderHost, data: bytes, checksum: int) -> str:
    assert boot.announce(checksum) == "E0"
    for at in range(0, len(data), 512):
        assert boot.write(128 + at // 512, data[at : at + 512]) == WRITTEN
    return boot.ask("C0 20")


def test_a_good_image_starts_after_a_tenth_of_a_second(boot: BootloaderHost) -> None:
    data = image(3)
    # a page of image() has the bytes 1 to 255 twice
    assert update(boot, data, 3 * 2 * 255 * 256 // 2) == "E0"
    assert boot.ask("C0 01") == "", "it has committed itself"
    assert boot.wait(0.099) == []
    assert boot.wait(2.001) == [m.System(code=0x10), m.System(code=0x11)]
    assert boot.power_cycle()[:2] == [m.System(code=0x10), m.System(code=0x11)]


def test_a_wrong_sum_stays_in_the_bootloader_until_a_good_image(boot: BootloaderHost) -> None:
    data = image(2)
    checksum = 2 * 2 * 255 * 256 // 2
    assert update(boot, data, checksum + 1) == "E4"
    assert boot.announce(checksum) == "E3", "until a reset"
    assert boot.power_cycle() == [], "no BOOTING, no READY"
    assert update(boot, data, checksum) == "E0"
    assert boot.wait() == [m.System(code=0x10), m.System(code=0x11)]


def test_an_unfinished_update_stays_in_the_bootloader(boot: BootloaderHost) -> None:
    assert boot.announce(1) == "E0"
    assert boot.power_cycle() == []
    assert boot.ask("C0 01") == "E0 00 02"


def test_the_bootloader_is_left_by_a_power_cycle_before_anything_is_written(
    boot: BootloaderHost,
) -> None:
    boot.ask("C0 00")
    assert boot.power_cycle()[:2] == [m.System(code=0x10), m.System(code=0x11)]
    assert boot.host.ask(m.Ping()) == m.Pong(value=0xAAEEAEEA)
