"""Whatever a host sends, the module never raises, never blocks, and never grows."""

import struct

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from emulator.chip import Pace
from emulator.x4m300 import Device, radar_device
from hil_tests.unit.emulator.doubles import IDENTITY, BareHost, RampSource, ramp_device
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.messages import X4_SET_LAYOUTS

PACES = st.sampled_from(list(Pace))


def raw_setting(setting: X4Setting) -> st.SearchStrategy[bytes]:
    size = struct.calcsize("<" + X4_SET_LAYOUTS[setting][0])
    value = st.binary(min_size=0, max_size=size + 2) | st.integers(0, 255).map(
        lambda low: low.to_bytes(4, "little")
    )
    return value.map(lambda data: b"\x50\x10" + setting.to_bytes(4, "little") + data)


def float_setting(setting: X4Setting) -> st.SearchStrategy[bytes]:
    numbers = st.floats(-1, 1e3, width=32) | st.floats(width=32)
    return st.lists(numbers, min_size=1, max_size=2).map(
        lambda values: (
            b"\x50\x10" + setting.to_bytes(4, "little") + struct.pack(f"<{len(values)}f", *values)
        )
    )


PAYLOADS = st.one_of(
    st.sampled_from([bytes.fromhex("5020"), b"\x01", b"\x22", b"\x26", b"\x90\x74"]),
    st.sampled_from([1, 0x10, 0x11, 0x12, 0x12, 0x13, 0x50]).map(lambda mode: bytes([0x20, mode])),
    st.sampled_from(sorted(X4_SET_LAYOUTS)).map(X4Setting).flatmap(raw_setting),
    st.sampled_from([X4Setting.FPS, X4Setting.FRAMEAREA, X4Setting.FRAMEAREAOFFSET]).flatmap(
        float_setting
    ),
    st.sampled_from(list(X4Setting)).map(lambda s: b"\x50\x11" + s.to_bytes(4, "little") + b"\x01"),
    st.binary(min_size=1, max_size=12),
)
STEPS = st.tuples(PAYLOADS, st.integers(0, 3_000_000_000), st.integers(0, 4))


def assert_sane(device: Device, now_ns: int, take: int) -> None:
    device.advance(now_ns)
    for _ in range(take):
        packet = device.next_packet(now_ns)
        if packet is None:
            break
        assert len(packet) <= 6163, "the largest frame of protocol reference 1.3"


@given(pace=PACES, steps=st.lists(STEPS, max_size=30))
def test_random_commands_in_any_order(pace: Pace, steps: list[tuple[bytes, int, int]]) -> None:
    device = ramp_device(pace)
    line = Connection(Role.HOST)
    device.receive_data(line.send(m.SetMode(mode=SensorMode.XTID_SM_MANUAL)), 0)
    now_ns = 0
    for payload, wait_ns, take in steps:
        now_ns += wait_ns
        device.advance(now_ns)
        if device.wants_data:
            packet = line.send(m.UnknownMessage(code=payload[0], payload=payload))
            device.receive_data(packet, now_ns)
        assert_sane(device, now_ns, take)
    # whatever happened, a reset brings it back, and it answers within what it had queued
    device.receive_data(line.send(m.ModReset()), now_ns)
    device.advance(now_ns + 1_000_000_000)
    device.advance(now_ns + 10_000_000_000)
    host = BareHost(device, now_ns + 10_000_000_000)
    host.send(m.Ping())
    assert m.Pong(value=0xAAEEAEEA) in host.hear(60)


@given(
    pace=PACES,
    chunks=st.lists(st.binary(max_size=300), max_size=20),
)
@example(pace=Pace.ASAP, chunks=[b"\x7c\x7c\x7c\x7c\xff\xff\xff\xff", b"\x7d" * 100])
def test_random_bytes(pace: Pace, chunks: list[bytes]) -> None:
    device = ramp_device(pace)
    for step, chunk in enumerate(chunks):
        device.receive_data(chunk, step)
        assert_sane(device, step, 3)
    host = BareHost(device, len(chunks))
    host.hear(500)
    # a false NoEscape start may wait for bytes that never come; real commands get through it
    for _ in range(3000):
        host.send(m.Ping())
        if m.Pong(value=0xAAEEAEEA) in host.hear():
            return
    raise AssertionError("garbage made the module deaf")


@given(
    takes=st.lists(st.integers(1, 40), min_size=1, max_size=6),
    downconversion=st.integers(0, 1),
)
def test_how_frames_are_asked_for_never_changes_one(takes: list[int], downconversion: int) -> None:
    """Block size, pauses and settings written again: frame k is frame k."""

    def fresh() -> BareHost:
        host = BareHost(radar_device(IDENTITY, RampSource(), Pace.ASAP))
        host.enter_manual()
        host.set(X4Setting.DOWNCONVERSION, downconversion)
        host.set(X4Setting.FPS, 20.0)
        return host

    plain = {frame.info: frame for frame in fresh().frames(sum(takes))}
    host = fresh()
    for take in takes:
        for frame in host.frames(take):
            assert frame == plain.pop(frame.info)
            assert np.isfinite(frame.values).all()
        host.set(X4Setting.ITERATIONS, 8)  # throws the block away
    assert not plain
