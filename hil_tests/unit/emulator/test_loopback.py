"""The real driver on an emulated module in the same process."""

import numpy as np
import pytest

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.scene.scene import load_scene
from emulator.x4m300 import radar_device
from hil_tests.unit.emulator.doubles import IDENTITY, ramp_device
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import OutputFeature, PongCode
from xethru_protocol.wire.errors import Disconnected, ResponseTimeout


def test_virtual_time_makes_a_silent_module_time_out_at_once() -> None:
    transport = LoopbackTransport(ramp_device())
    with X4M300(transport, clock=transport.clock_ns) as radar:
        radar.configure_raw()  # ends the profile
        with pytest.raises(ResponseTimeout):
            radar.read_frame(timeout_s=3600.0)
        assert transport.clock_ns() >= 3600 * 10**9


def test_time_passes_for_a_host_whose_module_never_stops_sending() -> None:
    """Without a profile this question stays without an answer (Protocol reference 4.4)."""
    transport = LoopbackTransport(ramp_device())
    with X4M300(transport, clock=transport.clock_ns) as radar:
        radar.configure_raw()
        radar.start(10)
        began_ns = transport.clock_ns()
        question = m.OutputGetControl(feature=OutputFeature.PRESENCE_SINGLE)
        with pytest.raises(ResponseTimeout, match="it sends frames meanwhile"):
            radar.request(question, 0.2)
        assert 0.2e9 <= transport.clock_ns() - began_ns < 0.3e9
        assert radar.ping() is PongCode.XTS_SPRP_READY


def test_a_reset_takes_no_wall_time() -> None:
    transport = LoopbackTransport(ramp_device())
    with X4M300(transport, clock=transport.clock_ns) as radar:
        radar.configure_raw()
        radar.reset()
        with pytest.raises(ResponseTimeout):
            radar.read_frame(5.0)
        assert radar.reboots == 1
        assert radar.ping() is PongCode.XTS_SPRP_READY
        radar.configure_raw()


def test_realtime_runs_on_the_virtual_clock() -> None:
    transport = LoopbackTransport(ramp_device(Pace.REALTIME))
    with X4M300(transport, clock=transport.clock_ns) as radar:
        radar.configure_raw()
        rate = radar.start(5.0)
        arrivals = [radar.read_frame().arrival_ns for _ in range(20)]
    steps = np.diff(arrivals)
    np.testing.assert_allclose(steps, 1e9 / rate, atol=1)


def test_content_depends_on_the_counter_alone() -> None:
    """Same frames with a pause and a settings change in between as without."""
    scene = load_scene("smoke")

    def frames_of(pauses: bool) -> dict[int, bytes]:
        transport = LoopbackTransport(
            radar_device(IDENTITY, echo_source(scene, 0, seed=3), Pace.ASAP)
        )
        with X4M300(transport, clock=transport.clock_ns) as radar:
            radar.configure_raw()
            radar.start(5.0)
            frames = list(radar.frames(7))
            if pauses:  # frames of the first stream that were not read are dropped
                radar.stop()
                radar.start(5.0)
            frames += radar.frames(40 if pauses else 240)
            return {frame.counter: frame.samples.tobytes() for frame in frames}

    paused, unpaused = frames_of(pauses=True), frames_of(pauses=False)
    assert list(unpaused) == list(range(1, 248))
    later = list(paused)[7:]
    assert later == list(range(later[0], later[0] + 40))
    assert paused.items() <= unpaused.items()


def test_a_closed_transport_says_so() -> None:
    transport = LoopbackTransport(ramp_device(), name="radar 3")
    transport.close()
    transport.close()
    with pytest.raises(Disconnected, match="radar 3"):
        transport.read(0.0)
    with pytest.raises(Disconnected, match="radar 3"):
        transport.write(b"x")
