"""Random bytes do not stop a module, and how frames are asked for changes none."""

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from emulator.chip import Pace
from emulator.x4m300 import Device, radar_device
from hil_tests.unit.emulator.doubles import IDENTITY, BareHost, RampSource, ramp_device
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting


def assert_sane(device: Device, now_ns: int, take: int) -> None:
    device.advance(now_ns)
    for _ in range(take):
        packet = device.next_packet(now_ns)
        if packet is None:
            break
        assert len(packet) <= 6163, "the largest frame of protocol reference 1.3"


@given(
    pace=st.sampled_from(list(Pace)),
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
