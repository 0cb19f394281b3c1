"""Through pseudo-terminals and in process: the same frames, bit for bit."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from emulator.chip import Pace
from emulator.cli import ask
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.module.memory import Identity
from emulator.scene.scene import load_scene
from emulator.x4m300 import radar_device
from hil_tests.device.emulator_process import Served, emulator, open_radar
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.x4 import real_frame_rate

pytestmark = pytest.mark.slow

SCENE = "smoke"
SEED = 5
FRAMES = 150

Content = dict[int, bytes]


def read(driver: X4M300, config: RawConfig, count: int, fps: float) -> Content:
    driver.configure_raw(config)
    driver.start(fps)
    return {frame.counter: frame.samples.tobytes() for frame in driver.frames(count)}


def by_index(served: Served, index: int, content: Content, fps: float) -> Content:
    """Return frames by their place in scene time: the control socket says where they begin."""
    assert served.control is not None
    name = served.names[index]
    answer = json.loads(ask(Path(served.control), {"verb": "state", "radar": name}))
    begin_ns = answer["radars"][name]["stream"]["scene_time_ns"]
    first = round(begin_ns * real_frame_rate(fps) / 1e9)
    return {first + counter - 1: samples for counter, samples in content.items()}


def in_process(index: int, config: RawConfig, count: int, fps: float) -> Content:
    scene = load_scene(SCENE)
    device = radar_device(
        Identity(serial=scene.radars[index].serial), echo_source(scene, index, SEED), Pace.ASAP
    )
    transport = LoopbackTransport(device)
    with X4M300(transport, clock=transport.clock_ns) as driver:
        frames = read(driver, config, count, fps)
        return {counter - 1: samples for counter, samples in frames.items()}


def through_ports(served: Served, config: RawConfig, count: int, fps: float) -> list[Content]:
    contents: list[Content] = [{} for _ in served.paths]

    def one(index: int, path: str) -> None:
        with open_radar(path) as driver:
            contents[index] = read(driver, config, count, fps)

    threads = [
        threading.Thread(target=one, args=(index, path)) for index, path in enumerate(served.paths)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return contents


@pytest.fixture(scope="module")
def served_asap() -> Iterator[Served]:
    with emulator("serve", SCENE, "--seed", str(SEED), "--pace", "asap") as served:
        yield served


@pytest.mark.parametrize("downconversion", [False, True])
def test_asap_all_frames_are_bit_identical(served_asap: Served, downconversion: bool) -> None:
    """The second stream goes on in time where the first one ended."""
    config = RawConfig(downconversion=downconversion)
    contents = through_ports(served_asap, config, FRAMES, 5.0)
    assert len(contents) == 4
    for index, content in enumerate(contents):
        assert sorted(content) == list(range(1, FRAMES + 1)), "nothing is lost"
        placed = by_index(served_asap, index, content, 5.0)
        whole = in_process(index, config, max(placed) + 1, 5.0)
        assert placed == {place: whole[place] for place in placed}
    assert len({content[10] for content in contents}) == 4, "each radar sees its own"


@pytest.mark.rare  # those without a clock are compared above
def test_realtime_those_that_arrive_are_bit_identical() -> None:
    config = RawConfig(iterations=16, pulses_per_step=10)
    with emulator("serve", SCENE, "--seed", str(SEED), "--pace", "realtime") as served:
        contents = through_ports(served, config, 60, 100.0)
        placed = [by_index(served, *one, 100.0) for one in enumerate(contents)]
    for index, content in enumerate(placed):
        assert len(content) == 60
        whole = in_process(index, config, max(content) + 1, 100.0)
        assert content == {place: whole[place] for place in content}
