"""What holds for every fault: no plan changes nothing, one seed gives the same bytes."""

from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.faults.faulty_device import FaultyDevice
from emulator.faults.kind import (
    Context,
    Handling,
    KindOfFault,
    PacketClass,
    Piece,
    Target,
    classify,
    frame_packet,
)
from emulator.faults.kinds import KINDS
from emulator.faults.plan import FaultPlan, FaultSpec, Injected, fault_spec
from emulator.module.memory import Identity
from emulator.scene.philox import Rng
from emulator.scene.scene import empty_room
from emulator.x4m300 import PortDevice, radar_device
from hil_tests.property.examples import examples
from xethru_protocol.driver.frames import Lattice
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting
from xethru_protocol.wire.connection import Connection, Role

HOST = Connection(Role.HOST)
MODULE = Connection(Role.MODULE)
SCRIPT = [
    m.Ping(),
    m.SetMode(mode=SensorMode.XTID_SM_STOP),
    m.SetMode(mode=SensorMode.XTID_SM_MANUAL),
    m.X4DriverInit(),
    m.X4DriverSet(setting=X4Setting.PULSESPERSTEP, value=125),
    m.X4DriverSet(setting=X4Setting.FRAMEAREA, value=(0.4, 1.0)),
    m.X4DriverGet(setting=X4Setting.PULSESPERSTEP),
    m.X4DriverSet(setting=X4Setting.FPS, value=20.0),
]
LATTICE = Lattice.of(
    iterations=16,
    pulses_per_step=300,
    dac_min=949,
    dac_max=1100,
    dac_step=0,
    downconversion=False,
    tx_center_frequency=3,
)
PACKETS = st.one_of(
    st.sampled_from(
        [
            MODULE.send(message)
            for message in (
                m.Ack(),
                m.Pong(value=0xAAEEAEEA),
                m.ReplyInt(content_id=0x11, values=(125,)),
                m.ReplyString(content_id=1, text="}~\x7f||||"),
                m.System(code=0x11),
                m.DataString(text=""),
            )
        ]
    ),
    st.integers(1, 200).map(lambda n: frame_packet(7, LATTICE.nearest(np.zeros(n, np.float32)))),
    st.binary(min_size=1, max_size=60),  # what an earlier fault left
)


def module() -> PortDevice:
    return radar_device(Identity(serial="1" * 12), echo_source(empty_room(), 0, 0), Pace.REALTIME)


def transcript(device: PortDevice, chunk: int = 7) -> list[tuple[int, bytes]]:
    """Return what a device sends in 2 s, with times."""
    data = b"".join(HOST.send(command) for command in SCRIPT)
    sent = []
    now_ns = 0
    for at in range(0, len(data), chunk):
        device.receive_data(data[at : at + chunk], now_ns)
        now_ns += 1_000_000
    while now_ns < 2_000_000_000:
        device.advance(now_ns)
        while (packet := device.next_packet(now_ns)) is not None:
            sent.append((now_ns, packet))
        now_ns += 5_000_000
    return sent


@pytest.mark.parametrize(
    "faults",
    [
        (),
        (fault_spec("silent", radar=["other"]),),
        *((fault_spec(k, at_s=3600.0),) for k in KINDS if KINDS[k].target is Target.COMMAND),
    ],
)
def test_faults_that_never_fire_change_no_byte(faults: tuple[FaultSpec, ...]) -> None:
    device = FaultyDevice(module(), "radar_1", FaultPlan(fault=faults))
    assert transcript(device) == transcript(module())
    assert not device.injected


@pytest.mark.parametrize("kind", KINDS)
def test_one_seed_gives_the_same_bytes(kind: str) -> None:
    plan = FaultPlan(seed=5, fault=(fault_spec(kind, probability=0.5, count=0),))
    truths: tuple[list[Injected], list[Injected]] = [], []
    first, second = (
        transcript(FaultyDevice(module(), "radar_1", plan, truth.append)) for truth in truths
    )
    assert first == second
    assert truths[0] == truths[1]


def test_another_seed_or_radar_gives_other_bytes() -> None:
    def bytes_of(seed: int, radar: str) -> list[tuple[int, bytes]]:
        fault = fault_spec("flip_bits", packet="frame", probability=0.5, count=0, bits=20)
        return transcript(FaultyDevice(module(), radar, FaultPlan(seed=seed, fault=(fault,))))

    assert bytes_of(1, "a") != bytes_of(2, "a")
    assert bytes_of(1, "a") != bytes_of(1, "b")


def effect_of(kind: KindOfFault, packet: bytes, seed: int) -> Any:  # noqa: ANN401 - of either sort
    context = Context(
        now_ns=10**9,
        since_ns=10**9 - 10**6,
        first_counter=5,
        command=m.X4DriverGet(setting=X4Setting.PULSESPERSTEP),
        previous_frame=packet if classify(packet) is PacketClass.FRAME else None,
        lattice=LATTICE,
    )
    effect = cast("Any", kind.effect)
    return effect(packet, kind.parameters(), Rng(seed), context)


@pytest.mark.parametrize("kind", [k for k in KINDS if KINDS[k].target is not Target.MOMENT])
@settings(max_examples=examples(20, 100))  # of each kind
@given(packet=PACKETS, seed=st.integers(0, 2**64 - 1))
def test_effects_are_pure_and_take_any_bytes(kind: str, packet: bytes, seed: int) -> None:
    row = KINDS[kind]
    if row.target is Target.COMMAND:
        packet = HOST.send(m.X4DriverGet(setting=X4Setting.PULSESPERSTEP))
    first, second = effect_of(row, packet, seed), effect_of(row, packet, seed)
    assert first == second
    if isinstance(first, Handling):
        return
    for piece in first or ():
        assert isinstance(piece, Piece)
        assert piece.delay_ns >= 0
        assert piece.behind >= 0


@given(seed=st.integers(0, 2**64 - 1), count=st.integers(1, 1000))
def test_dice_stay_in_their_range(seed: int, count: int) -> None:
    rng = Rng(seed)
    assert 0 <= rng.below(count) < count
    assert 0 <= rng.uniform() < 1
    assert abs(rng.normal()) <= 6


def test_dice_are_fair() -> None:
    rng = Rng(1)
    normals = np.array([rng.normal() for _ in range(4000)])
    assert abs(normals.mean()) < 4 / 4000**0.5
    assert abs(normals.var() - 1) < 4 * (2 / 4000) ** 0.5
    counts = np.bincount([rng.below(6) for _ in range(6000)])
    assert np.abs(counts - 1000).max() < 4 * (6000 * 5 / 36) ** 0.5
