"""System tests, info, baud rate, bootloader, safe mode, base firmware. Protocol reference 4, 8."""

import pytest

from emulator.module.settings import DeviceOptions
from hil_tests.unit.emulator.doubles import IDENTITY, BareHost, host_of
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import FramePostprocessing, X4Setting

SECOND = 1_000_000_000
BOOTED = [m.System(code=0x10), m.System(code=0x11)]
READY, SAFE = m.Pong(value=0xAAEEAEEA), m.Pong(value=0xFFEEFEEF)


@pytest.fixture
def bare() -> BareHost:
    return host_of(DeviceOptions(firmware="xep"))


def wait(host: BareHost, seconds: float = 3) -> None:
    host.now_ns += round(seconds * SECOND)
    host.device.advance(host.now_ns)


def crash(host: BareHost, times: int) -> None:
    for _ in range(times):
        host.device.module.crash("watchdog", host.now_ns)
        wait(host)


def system_test(host: BareHost, code: int) -> bytes:
    reply = host.ask(m.SystemTest(code=code))
    assert isinstance(reply, m.ReplyByte)
    assert reply.content_id == 0x5090
    assert len(reply.values) == 256
    assert reply.info == code | reply.values[0] << 8
    return reply.values


def test_system_tests(host: BareHost) -> None:
    """4.10, table of test codes."""
    assert system_test(host, 0x11)[:9] == b"\x01" + bytes(8)
    assert system_test(host, 0x19)[:3] == b"\x01\x00\x00"
    assert system_test(host, 0x1C)[:13] == b"\x01" + IDENTITY.serial.encode()
    host.command(m.IoPinSetControl(pin_id=3, pin_setup=8, pin_feature=2))  # pulled up
    assert system_test(host, 0x18)[:5] == b"\x01\x04\x00\x00\x00"
    for code in (0x10, *range(0x12, 0x18), 0x20, 0x00):
        assert host.ask(m.SystemTest(code=code)) == m.Error(code=1)


def test_a_chip_that_is_off_fails_its_test(host: BareHost) -> None:
    host.set(X4Setting.ENABLE, 0)
    assert system_test(host, 0x19)[:2] == b"\x00\x04"


def test_certification_mode_is_effective_after_a_reset(host: BareHost) -> None:
    assert system_test(host, 0x1A)[0] == 0, "not passed although it worked"
    assert host.ask(m.GetMode()) == m.ReplyByte(values=b"\x01")
    host.ask(m.ModReset())
    wait(host)
    host.hear(2)
    assert host.ask(m.GetMode()) == m.ReplyByte(values=b"\x50")
    system_test(host, 0x1B)
    host.ask(m.ModReset())
    wait(host)
    host.hear(2)
    assert host.ask(m.GetMode()) == m.ReplyByte(values=b"\x01")


@pytest.mark.parametrize("code", [0x1D, 0x1E])
def test_transmit_only_sleeps_until_a_power_cycle(host: BareHost, code: int) -> None:
    assert host.ask(m.SystemTest(code=code)) == m.Ack()
    host.send(m.ModReset())
    wait(host, 10)
    assert host.hear() == []
    assert host.device.wake_ns(host.now_ns) is None
    host.device.module.power_cycle(host.now_ns)
    wait(host)
    assert host.hear(2) == BOOTED


def test_transmitter_off_is_a_test_too(host: BareHost) -> None:
    assert host.ask(m.SystemTest(code=0x1F)) == m.Ack()
    reply = host.ask(m.X4DriverGet(setting=X4Setting.TXPOWER))
    assert reply == m.ReplyByte(content_id=0x21, values=b"\x00")


def test_baud_rate_changes_half_a_second_after_the_ack(host: BareHost) -> None:
    module = host.device.module
    assert module.uart_baudrate == 115200
    assert host.ask(m.SetBaudRate(baudrate=921600)) == m.Ack()
    assert module.uart_baudrate == 115200
    wait(host, 0.5)
    assert module.uart_baudrate == 921600
    for ignored in (599, 10_000_001, 0):
        assert host.ask(m.SetBaudRate(baudrate=ignored)) == m.Ack()
        wait(host, 1)
        assert module.uart_baudrate == 921600
    host.ask(m.ModReset())
    wait(host)
    assert module.uart_baudrate == 115200, "never saved"


def test_injected_frames_are_acknowledged(host: BareHost, bare: BareHost) -> None:
    prepare = m.PrepareInjectFrame(frames=1, bins=2, mode=3)
    inject = m.InjectFrame(counter=0, values=(0.0, 1.0, 2.0, 3.0))
    host.command(prepare, inject)
    assert [bare.ask(command) for command in (prepare, inject)] == [m.Error(code=1)] * 2


def test_ten_faults_in_a_row_start_safe_mode(host: BareHost) -> None:
    """8.5."""
    crash(host, 9)
    assert host.hear(2) == BOOTED
    assert host.ask(m.Ping()) == READY
    crash(host, 1)
    assert host.hear(2) == BOOTED, "still sent"
    assert host.ask(m.Ping()) == SAFE
    assert host.ask(m.SetMode(mode=0x13)) == m.Error(code=1)
    assert host.ask(m.SystemGetInfo(item=6)) == m.Error(code=1)
    reply = host.ask(m.SystemGetInfo(item=2))
    assert isinstance(reply, m.ReplyString)
    assert reply.text == "XEP"
    assert host.ask(m.SearchFileType(file_type=0x04554D50)) == m.ReplyInt(values=(0,))
    host.set(X4Setting.FPS, 17.0)
    assert isinstance(host.hear(1)[0], m.DataFloat), "it behaves like MANUAL"
    host.send(m.ModReset())
    wait(host)
    host.hear(3)
    assert host.ask(m.Ping()) == READY


@pytest.mark.parametrize(("pause_s", "pong"), [(290, SAFE), (301, READY)])
def test_five_minutes_without_fault_clear_the_count(
    host: BareHost, pause_s: float, pong: m.Pong
) -> None:
    crash(host, 9)
    wait(host, pause_s)
    crash(host, 1)
    host.hear(2)
    assert host.ask(m.Ping()) == pong


def test_a_host_reset_clears_the_count(host: BareHost) -> None:
    crash(host, 9)
    host.hear(2)
    assert host.ask(m.ModReset()) == m.Ack()
    wait(host)
    crash(host, 1)
    host.hear(2)
    assert host.ask(m.Ping()) == READY


def test_a_fault_wakes_the_loop(host: BareHost) -> None:
    host.now_ns = 5 * SECOND
    host.device.advance(host.now_ns)
    host.device.module.crash("out of memory", host.now_ns)
    assert host.device.wake_ns(host.now_ns) == host.now_ns
    host.device.advance(host.now_ns)
    assert host.device.wake_ns(host.now_ns) == 7 * SECOND


SENSOR_ONLY: list[m.Command[m.Response]] = [
    m.SetMode(mode=0x13),
    m.GetMode(),
    m.LoadApp(profile_id=0x014D4AB8),
    m.GetProfileId(),
    m.SetSensitivity(sensitivity=5),
    m.GetSensitivity(),
    m.GetDetectionZone(),
    m.SetLedControl(mode=1),
    m.NoiseMapGetControl(),
    m.OutputSetControl(feature=0x0C, control=1),
    m.OutputGetControl(feature=0x0C),
    m.DebugOutputGetControl(feature=0x0C),
    m.DebugLevel(level=3),
    m.IoPinGetControl(pin_id=1),
    m.IoPinSetControl(pin_id=1, pin_setup=1, pin_feature=3),
    m.IoPinSetControl(pin_id=0, pin_setup=1, pin_feature=2),
    m.X4DriverReadI2c(length=1),
    m.FramePostprocessingGet(setting=FramePostprocessing.NUMBER_FORMAT),
    *(m.SystemGetInfo(item=item) for item in (0, 1, 5, 6)),
]


@pytest.mark.parametrize("command", SENSOR_ONLY, ids=lambda c: type(c).__name__)
def test_bare_firmware_lacks_what_is_the_sensors(
    bare: BareHost, command: m.Command[m.Response]
) -> None:
    """2: "sensor only" on bare XEP gives ERROR 1."""
    assert bare.ask(command) == m.Error(code=1)


def test_bare_firmware_streams_without_modes(bare: BareHost) -> None:
    assert bare.ask(m.Ping()) == READY
    bare.set(X4Setting.FPS, 17.0)
    assert [frame.info for frame in bare.frames(2)] == [1, 2]


def test_i2c_and_postprocessing_of_the_sensor_firmware(host: BareHost) -> None:
    """16."""
    assert host.ask(m.X4DriverWriteI2c(address=0x42, values=b"\x01\x02")) == m.Ack()
    reply = host.ask(m.X4DriverReadI2c(length=3))
    assert reply == m.ReplyByte(content_id=0x27, values=b"\x01\x02\x00")
    assert host.ask(m.X4DriverReadI2c(length=10**9)) == m.Error(code=1)
    for setting, value, expected in (
        (FramePostprocessing.NORMALISATION, 0, m.ReplyByte(content_id=0x10, values=b"\x00")),
        (
            FramePostprocessing.PHASE_NOISE_CORRECTION,
            (1, 0.5),
            m.ReplyFloat(content_id=0x11, values=(0.5,)),
        ),
        (FramePostprocessing.DECIMATION_FACTOR, 4, m.ReplyInt(content_id=0x12, values=(4,))),
        (FramePostprocessing.NUMBER_FORMAT, 1, m.ReplyByte(content_id=0x13, values=b"\x01")),
        (FramePostprocessing.LEGACY_OUTPUT, 1, m.ReplyByte(content_id=0x14, values=b"\x01")),
    ):
        assert host.ask(m.FramePostprocessingSet(setting=setting, value=value)) == m.Ack()
        assert host.ask(m.FramePostprocessingGet(setting=setting)) == expected


def test_trace_output_is_a_string_before_the_reply(host: BareHost) -> None:
    """4.5: levels 0...9."""
    assert host.ask(m.DebugLevel(level=9)) == m.Ack()
    assert host.ask(m.DebugLevel(level=10)) == m.Error(code=0x21)
    host.send(m.SetMode(mode=0x13))
    text, ack = host.hear(2)
    assert isinstance(text, m.DataString)
    assert ack == m.Ack()
    host.command(m.DebugLevel(level=2), m.SetMode(mode=0x13))


@pytest.mark.parametrize(("kind", "away"), [("vanish", True), ("stay", False)])
def test_a_port_may_vanish_on_reset(kind: str, away: bool) -> None:
    """8.1: away from the reset until the USB transmitter starts."""
    host = host_of(DeviceOptions(port_on_reset="vanish" if kind == "vanish" else "stay"))
    device = host.device
    host.ask(m.ModReset())
    assert device.port_present(SECOND // 2 - 1)
    for now_ns in (SECOND // 2, SECOND, SECOND // 2 + 2 * SECOND - 1):
        assert device.port_present(now_ns) != away, "asked before the device was advanced"
        device.advance(now_ns)
        assert device.port_present(now_ns) != away
    device.advance(SECOND // 2 + 2 * SECOND)
    assert device.port_present(SECOND // 2 + 2 * SECOND)
