"""The real driver on an emulated module in the same process."""

import pytest

from emulator.loopback import LoopbackTransport
from hil_tests.unit.emulator.doubles import ramp_device
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


def test_a_closed_transport_says_so() -> None:
    transport = LoopbackTransport(ramp_device(), name="radar 3")
    transport.close()
    transport.close()
    with pytest.raises(Disconnected, match="radar 3"):
        transport.read(0.0)
    with pytest.raises(Disconnected, match="radar 3"):
        transport.write(b"x")
