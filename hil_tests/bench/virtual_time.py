"""Device time without waiting: a driver and a module in this process, on a virtual clock."""

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.module.memory import Identity
from emulator.scene.scene import load_scene
from emulator.x4m300 import radar_device
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300

NS_PER_S = 1_000_000_000
FPS = 17.0


def lab_radar(pace: Pace) -> tuple[X4M300, LoopbackTransport]:
    scene = load_scene("lab")
    identity = Identity(serial=scene.radars[0].serial)
    line = LoopbackTransport(radar_device(identity, echo_source(scene, 0, 0), pace))
    return X4M300(line, clock=line.clock_ns), line


def counters_of(duration_s: float, config: RawConfig) -> list[int]:
    """Return the counters of the frames that a radar of the lab sends in a time of its own clock.

    The module has the firmware's queue and absolute deadlines, so that a frame that came late by
    a second, or met a full queue, would be missing.
    """
    driver, line = lab_radar(Pace.REALTIME)
    with driver:
        driver.configure_raw(config)
        driver.start(FPS)
        end_ns = line.clock_ns() + round(duration_s * NS_PER_S)
        counters = []
        for frame in driver.frames(timeout_s=5.0):
            if frame.arrival_ns > end_ns:
                break
            assert frame.samples.size == frame.geometry.n_bins
            counters.append(frame.counter)
        assert (driver.frames_lost, driver.fault_count) == (0, 0)
    return counters
