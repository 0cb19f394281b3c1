"""Emulated radars through ptys: share of a core, punctuality, and the fastest they can go.

The bar of the design: four radars at 400 frames/s with synthesis in under a quarter of a core,
p99 of the interval error under 5 ms on an idle machine. Nothing is asserted about time here.
"""

import contextlib
import os
import select
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from emulator.chip import Pace
from emulator.chip.chip import Chip
from emulator.echo.echo import echo_source
from emulator.scene.scene import load_scene
from hil_tests.bench.virtual_time import counters_of, lab_radar
from hil_tests.device.emulator_process import Served, emulator
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NeedData, encode_normal
from xethru_protocol.wire.x4 import real_frame_rate

FAST = RawConfig(iterations=16, pulses_per_step=10)
SECONDS = 5.0


def cpu_s(pid: int) -> float:
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(served: Served, fps: float, config: RawConfig) -> dict[str, float]:
    drivers = [X4M300.open(path) for path in served.paths]
    for driver in drivers:
        driver.configure_raw(config)
        driver.close()  # the settings stay; the stream is read below without a driver's cost
    descriptors = [os.open(path, os.O_RDWR | os.O_NOCTTY) for path in served.paths]
    lines = {descriptor: Connection(Role.HOST) for descriptor in descriptors}
    arrivals: dict[int, list[tuple[int, int]]] = {descriptor: [] for descriptor in descriptors}
    commands: list[m.Command[m.Response]] = [
        m.SetMode(mode=SensorMode.XTID_SM_MANUAL),
        m.X4DriverSet(setting=X4Setting.FPS, value=fps),
    ]
    for descriptor in descriptors:
        for command in commands:
            os.write(descriptor, lines[descriptor].send(command))
    end = time.monotonic() + SECONDS
    before_s, began = cpu_s(served.process.pid), time.monotonic()
    while time.monotonic() < end:
        for descriptor in select.select(descriptors, [], [], 0.1)[0]:
            line = lines[descriptor]
            line.receive_data(os.read(descriptor, 65536))
            now_ns = time.monotonic_ns()
            while not isinstance(event := line.next_event(), NeedData):
                if isinstance(event, m.DataFloat):
                    arrivals[descriptor].append((event.info, now_ns))
    share = (cpu_s(served.process.pid) - before_s) / (time.monotonic() - began)
    for descriptor in descriptors:
        os.close(descriptor)
    counters = [np.array([counter for counter, _ in seen]) for seen in arrivals.values()]
    steps_ms = [np.diff([at_ns for _, at_ns in seen]) / 1e6 for seen in arrivals.values()]
    errors_ms = np.concatenate(
        [
            np.abs(step_ms - np.diff(counter) * 1e3 / fps)
            for step_ms, counter in zip(steps_ms, counters, strict=True)
        ]
    )
    return {
        "cpu_share": share,
        "received": sum(map(len, counters)),
        "lost": sum(int(counter[-1] - counter[0]) + 1 - len(counter) for counter in counters),
        "interval_error_p50_ms": float(np.percentile(errors_ms, 50)),
        "interval_error_p99_ms": float(np.percentile(errors_ms, 99)),
        "interval_error_max_ms": float(errors_ms.max()),
    }


@pytest.mark.timeout(60)
@pytest.mark.parametrize("fps", [40.0, 400.0])
def test_four_radars_in_real_time(benchmark: BenchmarkFixture, fps: float) -> None:
    with emulator("serve", "lab") as served:
        measured = benchmark.pedantic(  # type: ignore[no-untyped-call] # the plugin has no annotation there
            measure, args=(served, fps, FAST), rounds=1
        )
    benchmark.extra_info.update(measured)
    assert measured["received"] > 0.9 * 4 * fps * SECONDS


@pytest.mark.timeout(120)
def test_sixty_four_radars_in_real_time(benchmark: BenchmarkFixture) -> None:
    """One process, 1431 bins at 17 frames/s each."""
    with emulator("serve", "--bare", "--count", "64") as served:
        measured = benchmark.pedantic(  # type: ignore[no-untyped-call] # as above
            measure, args=(served, 17.0, RawConfig()), rounds=1
        )
    benchmark.extra_info.update(measured)
    assert measured["lost"] == 0
    assert measured["received"] > 0.9 * 64 * 17 * SECONDS


FLOODS = {
    "nothing": b"",
    "starts and escaped starts": b"\x7d\x7f\x7d\x7f\x7d",
    "empty packets": b"\x7d\x7e",
    "noescape starts": b"\x7c\x7c\x7c\x7c\x00",
    "unknown commands": encode_normal(b"\x77"),
    "pings": encode_normal(bytes.fromhex("01 AE EA AA EE")),
}


@contextlib.contextmanager
def flooded(path: str, pattern: bytes) -> Iterator[None]:
    """Write a pattern to a port as fast as it takes it, and read what comes."""
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    ended = threading.Event()

    def flood() -> None:
        data, at = pattern * (1 + 100_000 // max(len(pattern), 1)), 0
        while not ended.is_set():
            readable, _, _ = select.select([descriptor], [descriptor] if data else [], [], 0.1)
            with contextlib.suppress(BlockingIOError):
                if readable:
                    os.read(descriptor, 65536)
                at += os.write(descriptor, data[at : at + 4096])
                at %= len(pattern) or 1

    writer = threading.Thread(target=flood)
    writer.start()
    yield
    ended.set()
    writer.join()
    os.close(descriptor)


@pytest.mark.parametrize("name", FLOODS)
@pytest.mark.benchmark(group="PONG of a module beside another client's garbage (bar: 20 ms)")
def test_answer_beside_a_flood(benchmark: BenchmarkFixture, name: str) -> None:
    with (
        emulator("serve", "--bare", "--count", "2") as served,
        X4M300.open(served.paths[1]) as radar,
        flooded(served.paths[0], FLOODS[name]),
    ):
        benchmark.pedantic(radar.ping, rounds=300, warmup_rounds=10)  # type: ignore[no-untyped-call] # as above


@pytest.mark.timeout(300)
@pytest.mark.parametrize("minutes", [60], ids=["an_hour"])
def test_device_time_under_a_virtual_clock(benchmark: BenchmarkFixture, minutes: int) -> None:
    frames = benchmark.pedantic(counters_of, args=(minutes * 60.0, RawConfig()), rounds=1)  # type: ignore[no-untyped-call] # as above
    assert frames == list(range(frames[0], frames[0] + len(frames)))
    assert len(frames) == pytest.approx(minutes * 60 * real_frame_rate(17.0), abs=2)
    benchmark.extra_info["frames"] = len(frames)


@pytest.mark.parametrize("downconversion", [False, True], ids=["rf", "baseband"])
@pytest.mark.parametrize("block", [1, 8, 32])
def test_synthesis_of_frames(benchmark: BenchmarkFixture, block: int, downconversion: bool) -> None:
    """What a frame of the lab costs from echo to float32 values, by how many are made at once."""
    chip = Chip(echo_source(load_scene("lab"), 0, 0), block)
    driver_settings = {X4Setting.DOWNCONVERSION: int(downconversion), X4Setting.FPS: 17.0}
    chip.set(X4Setting.FRAMEAREA, (0.2, 9.4))
    for setting, value in driver_settings.items():
        chip.set(setting, value)
    for _ in range(64):
        chip.next_frame()  # blocks grow
    benchmark(lambda: [chip.next_frame() for _ in range(32)])
    benchmark.extra_info["frames"] = 32


@pytest.mark.parametrize("downconversion", [False, True], ids=["rf", "baseband"])
def test_frames_through_driver_and_device_in_process(
    benchmark: BenchmarkFixture, downconversion: bool
) -> None:
    driver, _ = lab_radar(Pace.ASAP)
    with driver:
        driver.configure_raw(RawConfig(downconversion=downconversion))
        driver.start(5.0)
        benchmark(lambda: sum(1 for _ in driver.frames(320)))
    benchmark.extra_info["frames"] = 320
