"""For each kind of fault: a driver counts exactly what was injected, or it cannot, and why."""

import itertools
from dataclasses import dataclass, field
from typing import Any

import pytest

from emulator.faults.faulty_device import fault
from emulator.faults.kinds import KINDS
from hil_tests.faulty import SERIAL, FaultyLine, faulty_line
from hil_tests.unit.emulator.faults.witnesses import FPS, WITNESSES
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, SensorMode, X4Setting
from xethru_protocol.wire.errors import DeviceError, RemoteProtocolError, ResponseTimeout
from xethru_protocol.wire.framing import FaultKind

__all__ = ["faulty_line"]  # a fixture

READ = {"command": "X4DRIVER_GET"}
ASKED = m.X4DriverGet(setting=X4Setting.PULSESPERSTEP)
PULSES = 100


@dataclass(frozen=True, kw_only=True)
class Expected:
    """What one injected fault makes a driver count; the rest must stay 0."""

    keys: dict[str, Any] = field(default_factory=dict)
    faults: dict[FaultKind, int] = field(default_factory=dict)
    more_faults: bool = False  # samples that are junk may look like starts
    junk_bytes: int | None = 0  # None: not told
    unknown: int = 0
    lost: int = 0
    discarded: int = 0
    off_lattice: int | None = 0
    stray: int = 0
    reboots: int = 0
    timeouts: int = 0
    refusals: int = 0
    unexpected: int = 0


def damaged(kind: FaultKind) -> Expected:
    return Expected(keys=READ, faults={kind: 1}, junk_bytes=None, timeouts=1)


def reply_damage(kind: FaultKind, **parameters: float) -> Expected:
    keys = {"packet": "reply", **READ, "parameters": parameters}
    return Expected(keys=keys, faults={kind: 1}, junk_bytes=None, timeouts=1)


CHECKSUM, TRUNCATED, GARBAGE = FaultKind.CHECKSUM, FaultKind.TRUNCATED, FaultKind.GARBAGE
CLEAN_REPLY = Expected(keys=READ)

# Faults of answers: 3 questions are asked, then a good one.
REPLIES: dict[str, Expected] = {
    "drop_bytes": reply_damage(CHECKSUM, at=1),
    "duplicate_bytes": reply_damage(CHECKSUM, at=3),
    "flip_bits": reply_damage(CHECKSUM, at=1),
    "insert_bytes": reply_damage(CHECKSUM, at=1),
    "burst_errors": reply_damage(GARBAGE, enter=1.0, leave=0.01),  # the start is hit, too
    "escape_lost": Expected(  # the byte behind it is a start now
        keys=READ, faults={TRUNCATED: 1, CHECKSUM: 1}, junk_bytes=None, timeouts=1
    ),
    # code, type and content id are 11, an odd number of them
    "flow_control_swallowed": reply_damage(CHECKSUM),
    "wrong_baud": Expected(
        keys={"packet": "reply", **READ}, faults={GARBAGE: 1}, junk_bytes=None, timeouts=1
    ),
    "bad_checksum": damaged(CHECKSUM),
    "missing_end": damaged(TRUNCATED),
    "missing_start": damaged(GARBAGE),
    "double_start": Expected(keys=READ, junk_bytes=1),
    "double_end": Expected(keys=READ, faults={GARBAGE: 1}, junk_bytes=1),
    "early_end": damaged(CHECKSUM),
    "truncated_reply": damaged(TRUNCATED),
    "stray_data": CLEAN_REPLY,
    "nack": Expected(keys={**READ, "parameters": {"code": 7}}, refusals=1),
    "no_reply": Expected(keys=READ, timeouts=1),
    "slow_reply": Expected(keys={**READ, "parameters": {"delay_ms": 3000.0}}, timeouts=1, stray=1),
    "duplicate_ack": Expected(keys=READ, stray=1),
    "stale_ack": Expected(keys=READ, stray=1),
    "late_reply": Expected(keys=READ, timeouts=1, stray=1),
    "wrong_reply": Expected(keys=READ, unexpected=1, stray=1),
    "system_message": Expected(keys={"packet": "reply", **READ}, reboots=1),
    "command_lost": Expected(keys=READ, timeouts=1),
    "command_damaged": Expected(keys=READ, timeouts=1),
}

NOISE = {"packet": "frame", "every": 4}
EVERY = {"every": 4}
FRAME_BYTES = 9 + 14 + 4 * 94

# Faults in a running stream: 3 of them, 4 frames apart.
STREAMS: dict[str, Expected] = {
    "noise_between": Expected(
        keys={**NOISE, "parameters": {"bytes": 5}}, faults={GARBAGE: 1}, junk_bytes=5
    ),
    "seven_bits": Expected(
        keys=NOISE, faults={FaultKind.HEADER: 1}, more_faults=True, junk_bytes=FRAME_BYTES, lost=1
    ),
    "split_writes": Expected(keys={**NOISE, "parameters": {"bytes": 64}}),
    "one_byte_writes": Expected(keys={**NOISE, "parameters": {"gap_us": 10.0}}),
    "escaped_checksum": Expected(keys=NOISE, unknown=1),
    "truncated_frame": Expected(
        keys={**EVERY, "parameters": {"keep": 100}},
        faults={GARBAGE: 1},
        junk_bytes=100,
        lost=1,
        off_lattice=None,
    ),
    "oversized": Expected(keys=NOISE, faults={FaultKind.OVERSIZE: 1}, junk_bytes=2 * 7999 + 10),
    "empty_packet": Expected(keys=NOISE, faults={FaultKind.EMPTY: 1}, junk_bytes=2),
    "unknown_response": Expected(keys=NOISE, unknown=1),
    "unknown_content": Expected(keys=NOISE, unknown=1),
    "nan_samples": Expected(keys={**EVERY, "parameters": {"samples": 4}}, off_lattice=4),
    "infinite_samples": Expected(keys={**EVERY, "parameters": {"samples": 4}}, off_lattice=4),
    "denormal_samples": Expected(keys={**EVERY, "parameters": {"samples": 4}}, off_lattice=4),
    "off_lattice_samples": Expected(keys={**EVERY, "parameters": {"samples": 4}}, off_lattice=4),
    "in_range_samples": Expected(keys={**EVERY, "parameters": {"samples": 4}}),
    "wrong_bin_count": Expected(keys=EVERY, discarded=1, lost=1),
    "wrong_length": Expected(
        keys=EVERY, faults={FaultKind.HEADER: 1}, more_faults=True, junk_bytes=FRAME_BYTES, lost=1
    ),
    # 199 bytes into the packet a sample begins: the ACK takes its place, the last one falls off
    "packet_inside_frame": Expected(keys=EVERY, faults={GARBAGE: 1}, junk_bytes=4, off_lattice=1),
    "normal_framed": Expected(keys=EVERY),
    "false_bulk_start": Expected(keys=NOISE, faults={FaultKind.HEADER: 1}, junk_bytes=9),
    "counter_jump": Expected(keys={**EVERY, "parameters": {"frames": 3}}, lost=3),
    "counter_back": Expected(keys={**EVERY, "frame": 30, "parameters": {"frames": 5}}),
    "counter_wrap": Expected(keys={"every": 20}),
    "counter_reset": Expected(keys={"every": 20}),
    "duplicate_frame": Expected(keys=EVERY),
    "missing_frames": Expected(keys={**EVERY, "parameters": {"frames": 2}}, lost=2),
    "reordered_frames": Expected(keys=EVERY, lost=2),
    "saturation": Expected(keys=EVERY),
    "dead_bins": Expected(keys=EVERY),
    "dc_step": Expected(keys={}),
    "stale_frame": Expected(keys=EVERY),
    "slow_rate": Expected(),
    "stall": Expected(),
    "start_offset": Expected(),
    "clock_drift": Expected(keys={"parameters": {"ppm": 10_000.0}}),
    "jitter": Expected(),
    "usb_latency": Expected(),
    "range_offset_drift": Expected(),
    "strong_clutter": Expected(),
    "interference": Expected(),
    "fading": Expected(),
}

# Those with a test of their own below.
SINGLE = {
    "cancelling_flips",
    "not_ready",
    "ack_then_ignore",
    "ack_quantised",
    "unplug",
    "disconnect_mid_frame",
    "watchdog_reboot",
    "brown_out",
    "safe_mode",
    "wrong_profile",
    "wrong_version",
    "duplicate_serial",
    "mode_lost",
    "stream_stopped",
    "silent",
}


def test_every_kind_is_tested() -> None:
    assert set(REPLIES) | set(STREAMS) | SINGLE == set(KINDS)
    assert len(KINDS) >= 40


def check(
    radar: X4M300, line: FaultyLine, wanted: Expected, timeouts: int = 0, refusals: int = 0
) -> None:
    n = len(line.truth)
    seen = radar.statistics
    assert {kind: seen.faults[kind] for kind in wanted.faults} == {
        kind: n * count for kind, count in wanted.faults.items()
    }
    assert radar.fault_count == seen.faults.total()
    assert wanted.more_faults or radar.fault_count == n * sum(wanted.faults.values())
    assert wanted.junk_bytes is None or seen.junk_bytes == n * wanted.junk_bytes
    assert seen.unknown == n * wanted.unknown
    assert seen.frames_lost == n * wanted.lost
    assert radar.frames_discarded == n * wanted.discarded
    assert wanted.off_lattice is None or seen.off_lattice_samples == n * wanted.off_lattice
    assert radar.stray_count == n * wanted.stray
    assert radar.reboots == n * wanted.reboots
    assert timeouts == n * wanted.timeouts
    assert refusals == n * wanted.refusals


@pytest.mark.parametrize("kind", REPLIES)
def test_faults_of_answers_are_counted(kind: str, faulty_line: FaultyLine) -> None:
    wanted = REPLIES[kind]
    pulses = 0x7D if kind == "escape_lost" else PULSES
    radar = faulty_line.radar()
    radar.request(m.X4DriverInit(), 10.0)
    radar.request(m.X4DriverSet(setting=X4Setting.PULSESPERSTEP, value=pulses))
    timeouts = refusals = unexpected = 0
    with fault(faulty_line.device, kind, count=3, **wanted.keys) as injection:
        for _ in range(3):
            try:
                radar.request(ASKED)
            except ResponseTimeout:
                timeouts += 1
            except DeviceError as error:
                refusals += error.code == 7
            except RemoteProtocolError:
                unexpected += 1
    assert unexpected == 3 * wanted.unexpected
    assert injection.injected == faulty_line.device.injected[kind] == 3
    faulty_line.sleep(10.0)
    radar.ping()
    assert radar.request(ASKED).values == (pulses,)
    check(radar, faulty_line, wanted, timeouts, refusals)


@pytest.mark.parametrize("kind", STREAMS)
def test_faults_of_a_stream_are_counted(kind: str, faulty_line: FaultyLine) -> None:
    wanted = STREAMS[kind]
    radar = faulty_line.streaming(FPS)
    radar.read_frame()  # the one with which the stream began
    count = 1 if KINDS[kind].lasting and "every" not in wanted.keys else 3
    with fault(faulty_line.device, kind, **{"count": count, **wanted.keys}) as injection:
        frames = list(radar.frames(75))
    assert injection.injected == faulty_line.device.injected[kind] == count
    check(radar, faulty_line, wanted)
    hidden = not (wanted.faults or wanted.lost or wanted.off_lattice or wanted.unknown)
    assert bool(KINDS[kind].hidden) == (hidden and not wanted.discarded)
    if kind in WITNESSES:
        sound = FaultyLine()
        WITNESSES[kind](frames, list(sound.streaming(FPS).frames(100))[1:], faulty_line)
        sound.forget()


@pytest.mark.parametrize(("bins", "injected"), [(0, 0), (1, 1), (2, 1)])
def test_a_frame_may_shrink_to_one_bin(bins: int, injected: int, faulty_line: FaultyLine) -> None:
    radar = faulty_line.streaming(FPS)
    n_bins = radar.read_frame().geometry.n_bins
    with fault(faulty_line.device, "wrong_bin_count", more=bins - n_bins) as injection:
        list(radar.frames(20))
    assert injection.injected == radar.frames_discarded == injected


def test_flips_that_cancel_pass_the_checksum(faulty_line: FaultyLine) -> None:
    radar = faulty_line.radar()
    asked = m.X4DriverGet(setting=X4Setting.FRAMEAREA)
    right = radar.request(asked)
    with fault(faulty_line.device, "cancelling_flips", command="X4DRIVER_GET"):
        wrong = radar.request(asked)
    assert wrong != right
    assert radar.statistics.clean
    assert radar.stray_count == 0
    assert KINDS["cancelling_flips"].hidden


def test_not_ready_is_what_ping_says(faulty_line: FaultyLine) -> None:
    radar = faulty_line.radar()
    with fault(faulty_line.device, "not_ready", count=3) as injection:
        answers = [radar.ping() for _ in range(5)]
    assert answers.count(PongCode.XTS_SPRP_NOTREADY) == injection.injected == 3


@pytest.mark.parametrize(
    ("kind", "setting", "value"),
    [
        ("ack_then_ignore", X4Setting.ITERATIONS, 33),
        ("ack_quantised", X4Setting.FRAMEAREAOFFSET, 0.18),
    ],
)
def test_reading_back_shows_what_was_not_set(
    kind: str, setting: X4Setting, value: float, faulty_line: FaultyLine
) -> None:
    radar = faulty_line.radar()
    radar.request(m.X4DriverInit(), 10.0)
    differs = 0
    with fault(faulty_line.device, kind, count=2, command="X4DRIVER_SET") as injection:
        for _ in range(4):
            radar.request(m.X4DriverSet(setting=setting, value=value))
            (read,) = radar.request(m.X4DriverGet(setting=setting)).values
            differs += read != pytest.approx(value)
    assert differs == injection.injected == 2


def test_a_damaged_command_is_counted_by_the_module(faulty_line: FaultyLine) -> None:
    radar = faulty_line.radar()
    with fault(faulty_line.device, "command_damaged", count=2), pytest.raises(ResponseTimeout):
        radar.ping()
    assert faulty_line.device.inner.faults_seen == 1  # type: ignore[attr-defined] # a Device here


@pytest.mark.parametrize("kind", ["unplug", "disconnect_mid_frame"])
def test_a_module_that_vanishes_is_found_again(kind: str, faulty_line: FaultyLine) -> None:
    radar = faulty_line.streaming(FPS, reconnect_s=15.0)
    (rate_hz,) = radar.request(m.X4DriverGet(setting=X4Setting.FPS)).values
    frames = list(radar.frames(5))
    for _ in range(2):
        with fault(faulty_line.device, kind, away_s=0.5):
            began_ns = faulty_line.clock_ns()
            frames += radar.frames(10)
            assert faulty_line.clock_ns() - began_ns < 5e9
    assert radar.reconnects == faulty_line.device.injected[kind] == 2
    assert [frame.stream for frame in frames] == sorted(frame.stream for frame in frames)
    assert {frame.stream for frame in frames} == {0, 1, 2}
    away_s = [
        (after.arrival_ns - before.arrival_ns) * 1e-9
        for before, after in itertools.pairwise(frames)
        if after.stream != before.stream
    ]
    assert radar.frames_lost == sum(round(gap_s * rate_hz) - 1 for gap_s in away_s)
    assert radar.frames_lost > 2 * 0.5 * rate_hz


def test_a_watchdog_reboot_is_counted(faulty_line: FaultyLine) -> None:
    for n in range(1, 4):
        radar = faulty_line.streaming(FPS)
        reboots = radar.reboots
        with (
            fault(faulty_line.device, "watchdog_reboot"),
            pytest.raises(ResponseTimeout, match="restarted"),
        ):
            list(radar.frames(200, timeout_s=4.0))
        assert radar.reboots - reboots == 1
        assert faulty_line.device.injected["watchdog_reboot"] == n


def test_a_brown_out_loop_is_counted(faulty_line: FaultyLine) -> None:
    radar = faulty_line.radar()
    with fault(faulty_line.device, "brown_out", restarts=4) as injection:
        deadline_ns = faulty_line.clock_ns() + 20_000_000_000
        while faulty_line.clock_ns() < deadline_ns:
            try:
                radar.ping(0.5)
            except ResponseTimeout:
                continue
            faulty_line.sleep(0.1)
    assert injection.injected == 1
    assert radar.reboots == 4


@pytest.mark.parametrize("kind", ["watchdog_reboot", "brown_out"])
def test_faults_count_towards_safe_mode_and_the_bootloader(
    kind: str, faulty_line: FaultyLine
) -> None:
    """8.5: ten in a row start safe mode, the sixteenth ends in the bootloader."""
    radar = faulty_line.radar()

    def fail(times: int) -> None:
        in_a_row = 1 if kind == "watchdog_reboot" else times
        parameters = {} if kind == "watchdog_reboot" else {"restarts": times, "period_s": 3}
        for _ in range(times // in_a_row):
            with fault(faulty_line.device, kind, **parameters):
                faulty_line.sleep(3.5 * in_a_row)

    fail(9)
    assert radar.ping() is PongCode.XTS_SPRP_READY
    fail(1)
    assert radar.ping() is PongCode.XTS_SPRP_SAFEMODE
    fail(5)
    assert radar.ping() is PongCode.XTS_SPRP_SAFEMODE
    fail(1)
    with pytest.raises(ResponseTimeout):
        radar.ping()
    reply = radar.request(m.BootloaderGetDeviceInfo())
    assert reply.data.startswith(b"XETHRU OPENBOOTLOADER"), "not deaf"


def test_unplugging_forgets_the_faults(faulty_line: FaultyLine) -> None:
    """8.5: power-on is not counted, and clears."""
    for _ in range(9):
        with fault(faulty_line.device, "watchdog_reboot"):
            faulty_line.sleep(3)
    with fault(faulty_line.device, "unplug", away_s=0.5):
        faulty_line.sleep(3)
    with fault(faulty_line.device, "watchdog_reboot"):
        faulty_line.sleep(3)
    assert faulty_line.radar().ping() is PongCode.XTS_SPRP_READY


def test_safe_mode_is_warned_of(faulty_line: FaultyLine) -> None:
    radar = faulty_line.radar()
    with fault(faulty_line.device, "safe_mode"):
        radar.configure_raw()
        assert radar.ping() is PongCode.XTS_SPRP_SAFEMODE
    assert sum("safe mode" in warning for warning in radar.warnings) == 1
    assert radar.ping() is PongCode.XTS_SPRP_READY


def test_what_a_module_tells_of_itself_can_be_wrong(faulty_line: FaultyLine) -> None:
    radar = faulty_line.radar()
    true = radar.info()
    with (
        fault(faulty_line.device, "wrong_version", version="9.9.9"),
        fault(faulty_line.device, "duplicate_serial", serial="000000000007"),
        fault(faulty_line.device, "wrong_profile", profile=0x12345678),
    ):
        told = radar.info()
        profile = radar.request(m.GetProfileId()).values
    assert (told.version, told.serial_number) == ("9.9.9", "000000000007")
    assert profile == (0x12345678,)
    assert (true.version, true.serial_number) != (told.version, told.serial_number)
    assert radar.info() == true
    assert true.serial_number == SERIAL
    assert sorted(faulty_line.device.injected.values()) == [1, 1, 1]


@pytest.mark.parametrize(
    ("kind", "asked", "shown"),
    [
        ("mode_lost", m.GetMode(), bytes((SensorMode.XTID_SM_STOP,))),
        ("stream_stopped", m.X4DriverGet(setting=X4Setting.FPS), (0.0,)),
    ],
)
def test_a_stream_that_ended_by_itself_shows_when_it_is_asked_for(
    kind: str, asked: m.GetMode | m.X4DriverGet, shown: object, faulty_line: FaultyLine
) -> None:
    radar = faulty_line.streaming(FPS)
    with fault(faulty_line.device, kind), pytest.raises(ResponseTimeout):
        list(radar.frames(20))
    assert radar.request(asked).values == shown
    assert radar.stray_count == 0
    assert faulty_line.device.injected[kind] == 1


def test_a_silent_radar_loses_its_messages(faulty_line: FaultyLine) -> None:
    radar = faulty_line.streaming(FPS)
    list(radar.frames(5))
    with fault(faulty_line.device, "silent", seconds=1.0):
        list(radar.frames(20))
    assert radar.frames_lost in (20, 21)  # of the second that the first one lost begins
    with fault(faulty_line.device, "silent"):
        with pytest.raises(ResponseTimeout):
            radar.read_frame(1.0)
        with pytest.raises(ResponseTimeout):
            radar.ping()
    assert faulty_line.device.injected["silent"] == 2
