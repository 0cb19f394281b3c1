"""A host's view, through the driver and in virtual time: a person in the corridor."""

import math

import pytest

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.module.memory import Identity
from emulator.module.settings import DeviceOptions
from emulator.scene.scene import load_scene
from emulator.x4m300 import radar_device
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import (
    NoiseMapControl,
    OutputFeature,
    PresenceState,
    ProfileId,
    RespirationState,
)

SECOND = 1_000_000_000


def transport_of_the_corridor(
    options: DeviceOptions | None = None, name: str = "visitor"
) -> LoopbackTransport:
    scene = load_scene(name)
    identity = Identity(serial=scene.radars[0].serial)
    source = echo_source(scene, 0, 0)
    return LoopbackTransport(radar_device(identity, source, Pace.REALTIME, options=options))


def expected_state(time_s: float) -> PresenceState | None:
    """Return the state at a time, None in the seconds when it changes."""
    if time_s < 119:
        return PresenceState.INITIALIZING
    if 121 < time_s < 130:
        return PresenceState.NO_PRESENCE
    return PresenceState.PRESENCE if time_s > 132.5 else None


def test_a_stock_module_sees_the_visitor_of_the_corridor() -> None:
    """It powers up with its profile running; the visitor comes after 130 s, at 5.5 m."""
    transport = transport_of_the_corridor()
    with X4M300(transport, clock=transport.clock_ns) as radar:
        seen = []
        for message in radar.messages(140):
            assert isinstance(message, m.PresenceSingle)
            seen.append((transport.clock_ns() / SECOND, message))
    for time_s, message in seen:
        expected = expected_state(time_s)
        if expected is not None:
            assert message.state == expected, time_s
        if expected is PresenceState.PRESENCE:
            walked_m = 0.8 * (time_s - 130.0) % 8.0
            x_m = 5.5 - walked_m if walked_m < 4 else walked_m - 2.5
            if abs(walked_m - 4) > 0.3:  # not in the moment it turns round
                assert abs(message.distance_m - math.hypot(x_m, 0.2)) < 0.11
    assert seen[-1][0] > 138


def test_settings_of_a_host_reach_the_profile() -> None:
    """A zone that ends before the visitor's path, then one that holds it."""
    transport = transport_of_the_corridor()
    with X4M300(transport, clock=transport.clock_ns) as radar:
        states = {}
        for zone in ((0.5, 1.2), (0.5, 6.0)):
            radar.profile.stop()
            radar.profile.load()
            radar.profile.set_noise_map(NoiseMapControl(6))
            radar.profile.set_zone(*zone)
            radar.profile.run()
            while True:
                (message,) = radar.messages(1)
                clock_s = transport.clock_ns() / SECOND
                if clock_s > (145 if zone[1] < 2 else 175):
                    break
            assert isinstance(message, m.PresenceSingle)
            states[zone] = message.state
    assert list(states.values()) == [PresenceState.NO_PRESENCE, PresenceState.PRESENCE]


def test_an_x4m200_is_set_up_by_the_same_methods() -> None:
    """Its start takes 20 s with a noise map at hand; Protocol reference 4.6, 7.4."""
    transport = transport_of_the_corridor(DeviceOptions(model="x4m200"))
    with X4M300(transport, clock=transport.clock_ns) as radar:
        radar.profile.load(ProfileId.XTS_ID_APP_RESPIRATION_2)
        radar.profile.set_noise_map(NoiseMapControl(6))
        radar.profile.set_output(OutputFeature.RESP_STATUS)
        radar.profile.set_output(OutputFeature.RESPIRATION_MOVINGLIST)
        radar.profile.run()
        began_s = transport.clock_ns() / SECOND
        first = radar.profile.wait_until_initialized()
        assert isinstance(first, m.RespStatus)
        assert first.state != RespirationState.INITIALIZING
        assert 15 < transport.clock_ns() / SECOND - began_s < 25
        assert radar.read_message(m.RespirationMovingList).counter >= first.counter
        assert radar.read_message(m.RespStatus).counter > first.counter


@pytest.mark.parametrize(
    ("name", "distance_m", "rate", "wander"),
    [("sleeper", 1.6, 13.0, 0.06), ("two_people", 1.2042, 12.0, 0.05), ("desk", 0.9, 16.0, 0.1)],
)
def test_the_respiration_profile_knows_who_is_at_rest(
    name: str, distance_m: float, rate: float, wander: float
) -> None:
    """The nearest person of a scene; rates wander in a band, and 20 s resolve 3 a minute."""
    transport = transport_of_the_corridor(DeviceOptions(model="x4m200"), name)
    with X4M300(transport, clock=transport.clock_ns) as radar:
        radar.profile.load(ProfileId.XTS_ID_APP_RESPIRATION_2)
        radar.profile.set_noise_map(NoiseMapControl(6))
        radar.profile.set_output(OutputFeature.SLEEP_STATUS)
        radar.profile.run()
        radar.profile.wait_until_initialized()
        for _ in range(25):
            sleep = radar.read_message(m.SleepStatus)
            assert sleep.state == RespirationState.BREATHING
            assert abs(sleep.rpm - rate) < wander * rate + 1.5
            assert abs(sleep.distance_m - distance_m) < 0.06
