"""What the base firmware's source answers to requests at the edges, byte for byte.

The rows are of protocol reference 1.1, 3, 4.9 to 4.11, and of the sources that it names.
"""

import math
from collections.abc import Sequence

import pytest

from emulator.chip import Pace
from emulator.module.settings import DeviceOptions
from hil_tests.unit.emulator.doubles import BareHost, ramp_device
from xethru_protocol.wire import messages as m
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import FORMAT_KEY, X4Setting
from xethru_protocol.wire.framing import encode_normal

SECOND = 1_000_000_000
KEY = {"file_type": 0x80000001, "identifier": 0}
ACK, REFUSED = m.Ack(), m.Error(code=4)


@pytest.fixture(params=["sensor", "xep"])
def host(request: pytest.FixtureRequest) -> BareHost:
    return host_with(firmware=request.param)


def host_with(**options: object) -> BareHost:
    """Return a host of a module that sends nothing by itself."""
    host = BareHost(ramp_device(options=DeviceOptions.model_validate(options)))
    if options.get("firmware", "sensor") == "sensor":
        host.enter_manual()
    return host


def floats(setting: X4Setting, *values: float) -> m.ReplyFloat:
    return m.ReplyFloat(content_id=setting, values=values)


def set_to(setting: X4Setting, value: m.X4Value) -> m.X4DriverSet:
    return m.X4DriverSet(setting=setting, value=value)


def get(setting: X4Setting, address: int | None = None) -> m.X4DriverGet:
    return m.X4DriverGet(setting=setting, address=address)


# --- answers that no block of the message pool holds (1.1)


@pytest.mark.parametrize("length", [6976, 6977, 7000, 7984, 8192, 20_000])
def test_a_reply_that_fits_no_block_is_not_sent(host: BareHost, length: int) -> None:
    """24 bytes lie before the elements in a block of 7000."""
    host.command(m.CreateFile(**KEY, length=20_000))
    host.send(m.GetFileData(**KEY, offset=0, length=length))
    heard = host.hear()
    assert heard == ([m.ReplyByte(values=b"\xff" * length)] if length <= 6976 else [])
    assert host.ask(m.Ping()) == m.Pong(value=0xAAEEAEEA)


def test_a_crash_dump_that_fits_no_block_is_not_sent(host: BareHost) -> None:
    host.command(m.CreateFile(file_type=0x04554D50, identifier=0, length=20_000))
    host.send(m.GetCrashDump(offset=0, length=8048))
    assert host.hear() == []
    reply = host.ask(m.GetCrashDump(offset=0, length=6976))
    assert reply == m.ReplyByte(content_id=0x63, values=b"\xff" * 6976)


# --- 32 bits


@pytest.mark.parametrize("length", [0x80000000, 0xFFFFFFFF])
def test_a_length_is_answered_with_the_same_bits(host: BareHost, length: int) -> None:
    host.command(m.FormatFilesystem(key=FORMAT_KEY))
    host.command(m.CreateFile(**KEY, length=length))  # the first file is not checked
    host.send(m.GetFileLength(**KEY))
    packet = host.device.next_packet(0)
    payload = bytes.fromhex("11 11 00000000 00000000 01000000") + length.to_bytes(4, "little")
    assert packet == encode_normal(payload)


def test_identifiers_and_types_are_answered_with_the_same_bits(host: BareHost) -> None:
    host.command(m.FormatFilesystem(key=FORMAT_KEY))
    host.command(m.CreateFile(file_type=0xFFFFFFFF, identifier=0x80000002, length=1))
    assert host.ask(m.FindAllFiles()) == m.ReplyInt(values=(-1, 2 - (1 << 31)))
    assert host.ask(m.SearchFileType(file_type=0xFFFFFFFF)) == m.ReplyInt(values=(2 - (1 << 31),))


def test_a_file_offset_wraps(host: BareHost) -> None:
    """FFFFFFFFh and two bytes end at 1, within the file; what lies before it is not the file's."""
    host.command(m.CreateFile(**KEY, length=100))
    host.command(m.SetFileData(**KEY, offset=0xFFFFFFFF, data=b"\x01\x02"))
    assert host.ask(m.GetFileData(**KEY, offset=0, length=2)) == m.ReplyByte(values=b"\x02\xff")
    reply = host.ask(m.GetFileData(**KEY, offset=0xFFFFFFFF, length=2))
    assert reply == m.ReplyByte(values=b"\xff\x02")
    assert host.ask(m.GetFileData(**KEY, offset=0xFFFFFFFE, length=1)) == m.Error(code=0x21)


# --- what goes on behind an error, and what stops


@pytest.mark.parametrize(
    ("dump", "part", "errors", "values"),
    [
        (None, (0, 3), [1, 1, 0xA0], b"\xff\xff\xff"),
        (None, (0, 0), [1, 1], b""),
        (b"hard", (2, 3), [0xA0], b"rd\xff"),
        (b"hard", (1, 3), [], b"ard"),
    ],
)
def test_a_crash_dump_is_sent_behind_the_errors(
    host: BareHost, dump: bytes | None, part: tuple[int, int], errors: list[int], values: bytes
) -> None:
    if dump is not None:
        host.command(m.CreateFile(file_type=0x04554D50, identifier=0, length=len(dump)))
        host.command(m.SetFileData(file_type=0x04554D50, identifier=0, offset=0, data=dump))
    host.send(m.GetCrashDump(offset=part[0], length=part[1]))
    reply = m.ReplyByte(content_id=0x63, values=values)
    assert host.hear() == [*(m.Error(code=code) for code in errors), reply]


def test_a_read_of_no_bytes_stops_the_module(host: BareHost) -> None:
    """An empty block is taken for lack of memory, a fault that is counted (8.5)."""
    host.send(m.X4DriverRead(address=2, length=0))
    assert host.hear() == []
    assert host.at(2 * SECOND)[:2] == [m.System(code=0x10), m.System(code=0x11)]
    if host.device.module.firmware.sensor is not None:
        host.command(m.SetMode(mode=0x13))
        host.hear()
    reply = host.ask(m.GetCrashDumpLength())
    assert isinstance(reply, m.ReplyInt)
    assert reply.values[0] > 0


# --- frame area (9.4): only start > end is refused


@pytest.mark.parametrize(
    ("start_m", "end_m", "bins", "baseband_bins"),
    [
        (0.4, math.inf, 1501, 184),  # shortened
        (0.4, math.nan, 1501, 184),  # as far as the chip samples
        (math.nan, 5.0, 0, 1),
        (math.inf, math.inf, 0, 1),
        (-math.inf, 5.0, 0, 1),
    ],
)
def test_areas_without_limits_are_taken(
    host: BareHost, start_m: float, end_m: float, bins: int, baseband_bins: int
) -> None:
    if math.isfinite(start_m):
        assert bins == x4.frame_area(start_m, 50.0).n_bins
    for downconversion, expected in ((0, bins), (1, baseband_bins)):
        host.set(X4Setting.DOWNCONVERSION, downconversion)
        host.set(X4Setting.FRAMEAREA, (start_m, end_m))
        count = host.ask(get(X4Setting.FRAMEBINCOUNT))
        assert count == m.ReplyInt(content_id=0x26, values=(expected,))
        assert isinstance(host.ask(get(X4Setting.FRAMEAREA)), m.ReplyFloat)
    assert host.ask(set_to(X4Setting.FRAMEAREA, (5.0, -math.inf))) == m.Error(code=17)


@pytest.mark.parametrize("offset_m", [math.inf, -math.inf, math.nan])
def test_an_offset_reads_back_whatever_it_is(host: BareHost, offset_m: float) -> None:
    host.set(X4Setting.FRAMEAREAOFFSET, offset_m)
    reply = host.ask(get(X4Setting.FRAMEAREAOFFSET))
    assert isinstance(reply, m.ReplyFloat)
    assert reply.values == (offset_m,) or math.isnan(reply.values[0]) is math.isnan(offset_m)
    host.set(X4Setting.FPS, 17.0)
    assert [frame.values.size for frame in host.frames(3)] == [0, 0, 0]


def test_only_one_is_baseband(host: BareHost) -> None:
    """DOWNCONVERSION 2: the bins of RF, 3 bytes per counter, and the value in its register."""
    host.set(X4Setting.DOWNCONVERSION, 2)
    host.set(X4Setting.FRAMEAREA, (0.4, 5.0))
    count = host.ask(get(X4Setting.FRAMEBINCOUNT))
    assert count == m.ReplyInt(content_id=0x26, values=(716,))
    for address, value in ((0x1B, 3), (0x0F, 2)):
        reply = host.ask(get(X4Setting.PIFREGISTER, address))
        assert reply == m.ReplyByte(content_id=0x23, values=bytes([value]))
    assert host.ask(get(X4Setting.DOWNCONVERSION)) == m.ReplyByte(content_id=0x13, values=b"\x02")
    host.set(X4Setting.FPS, 17.0)
    assert host.frames(1)[0].values.size == 716


# --- a chip that is off


@pytest.mark.parametrize("value", [0, 2, 255])
def test_enable_is_on_for_one_only(host: BareHost, value: int) -> None:
    host.set(X4Setting.ENABLE, value)
    assert host.ask(get(X4Setting.ITERATIONS)) == REFUSED


SPI = X4Setting.SPIREGISTER
WITHOUT_POWER: list[tuple[m.Command[m.Response], m.Response]] = [
    (set_to(X4Setting.FRAMEAREA, (0.4, 5.0)), ACK),
    (set_to(X4Setting.FRAMEAREAOFFSET, 0.0), ACK),
    (set_to(X4Setting.TXPOWER, 1), ACK),
    (set_to(X4Setting.PRFDIV, 8), ACK),
    (set_to(X4Setting.TXPOWER, 4), m.Error(code=21)),
    (set_to(X4Setting.PRFDIV, 3), m.Error(code=18)),
    (set_to(X4Setting.ITERATIONS, 8), REFUSED),
    (set_to(X4Setting.PULSESPERSTEP, 8), REFUSED),
    (set_to(X4Setting.DACMIN, 8), REFUSED),
    (set_to(X4Setting.DACSTEP, 1), REFUSED),
    (set_to(X4Setting.DOWNCONVERSION, 1), REFUSED),
    (set_to(X4Setting.TXCENTERFREQUENCY, 3), REFUSED),
    (get(X4Setting.TXPOWER), m.ReplyByte(content_id=0x21, values=b"\x00")),
    (get(X4Setting.PRFDIV), m.ReplyByte(content_id=0x25, values=b"\x00")),
    (get(X4Setting.TXCENTERFREQUENCY), m.ReplyByte(content_id=0x20, values=b"\x00")),
    (get(X4Setting.ITERATIONS), REFUSED),
    (get(SPI, 1), m.ReplyByte(content_id=0x22, values=b"\x00")),
    (set_to(SPI, (0x14, 9)), ACK),
    (m.X4DriverWrite(address=0x14, values=b"\x01\x02"), ACK),
    (m.X4DriverRead(address=1, length=2), m.ReplyByte(content_id=0x22, values=b"\x00\x00")),
    (get(X4Setting.PIFREGISTER, 1), REFUSED),
    (set_to(X4Setting.XIFREGISTER, (1, 1)), REFUSED),
]


@pytest.mark.parametrize(("command", "answer"), WITHOUT_POWER, ids=lambda one: type(one).__name__)
def test_answers_of_a_chip_that_is_off(
    host: BareHost, command: m.Command[m.Response], answer: m.Response
) -> None:
    host.set(X4Setting.ENABLE, 0)
    assert host.ask(command) == answer
    host.command(m.X4DriverInit())
    assert host.ask(get(SPI, 0x14)) == m.ReplyByte(content_id=0x22, values=b"\x02"), "as reset"


def test_a_rate_is_noted_although_the_chip_is_off(host: BareHost) -> None:
    host.set(X4Setting.ENABLE, 0)
    assert host.ask(set_to(X4Setting.FPS, 17.0)) == REFUSED
    reply = host.ask(get(X4Setting.FPS))
    assert isinstance(reply, m.ReplyFloat)
    assert reply.values[0] == pytest.approx(17.04938, abs=1e-5)


# --- options for what the reference leaves to the emulator


def answers_to(host: BareHost, *data: bytes) -> list[m.Message]:
    for one in data:
        host.device.receive_data(one, host.now_ns)
    return host.hear()


@pytest.mark.parametrize("option", ["answer", "error"])
def test_the_first_command_after_damage(option: str) -> None:
    """Public logs of an X4M03 show ERROR 1 to INIT behind a wrong checksum."""
    host = host_with(firmware="xep", after_damage=option)
    assert answers_to(host, b"\x00\x01\x02") == []
    assert host.ask(m.X4DriverInit()) == ACK, "other bytes are no wrong checksum"
    damaged = encode_normal(b"\x50\x20")[:-2] + b"\x00\x7e"
    assert answers_to(host, damaged) == []
    assert host.ask(m.X4DriverInit()) == (ACK if option == "answer" else m.Error(code=1))
    assert host.ask(m.X4DriverInit()) == ACK


def test_two_frames_wait_for_a_host_that_does_not_read() -> None:
    host = BareHost(ramp_device(Pace.REALTIME, options=DeviceOptions(firmware="xep")))
    host.now_ns = 3 * SECOND
    host.hear()
    host.set(X4Setting.FPS, 20.0)
    host.hear()
    begin_ns = host.now_ns
    for step in range(1, 251):
        host.device.advance(begin_ns + step * SECOND // 100)
    frames: Sequence[m.Message] = host.at(begin_ns + 5 * SECOND // 2)
    counters = [frame.info for frame in frames if isinstance(frame, m.DataFloat)]
    # the oldest, then a gap
    assert counters[1] == counters[0] + 1
    assert len(counters) in (2, 3)
