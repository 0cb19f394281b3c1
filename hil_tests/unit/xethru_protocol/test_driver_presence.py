"""The presence profile, by both drivers. Protocol reference 4.4-4.7, 7.3, 8.2, 8.3, 13."""

from dataclasses import replace

import numpy as np
import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn, Scripted
from hil_tests.unit.xethru_protocol.emulated import Emulated, EmulatedModule
from hil_tests.unit.xethru_protocol.scripted import frame
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import LedMode, NoiseMapControl, OutputFeature
from xethru_protocol.wire.errors import DeviceError, LocalProtocolError, ResponseTimeout

NO_PRESENCE, PRESENCE, INITIALIZING = 0, 1, 2
STEP_M = 0.0514403  # grid of zones
STOP, RUN, IDLE = 0x13, 0x01, 0x11


def presence(counter: int, state: int) -> m.PresenceSingle:
    return m.PresenceSingle(
        counter=counter, state=state, distance_m=1.5, direction=1, signal_quality=4
    )


def test_profile_is_set_up_and_run_by_the_recipe(loaded: Emulated) -> None:
    radar, _, module = loaded
    radar.profile.set_sensitivity(8)
    radar.profile.set_noise_map(NoiseMapControl.NO_DEFAULT | NoiseMapControl.ADAPTIVE)
    radar.profile.set_led(LedMode.OFF)
    radar.profile.set_output(OutputFeature.PRESENCE_SINGLE)
    radar.profile.run()
    assert module.received == [
        m.Ping(),
        m.SetMode(mode=STOP),
        m.LoadApp(profile_id=0x014D4AB8),
        m.SetSensitivity(sensitivity=8),
        m.SystemGetInfo(item=7),  # old firmware has no noise map control (17)
        m.NoiseMapSetControl(control=3),
        m.AppSetLedControl(mode=0, intensity=0),
        m.OutputSetControl(feature=0x723BFA1E, control=1),
        m.SetMode(mode=RUN),
    ]


def test_what_a_running_profile_refuses_is_explained(loaded: Emulated) -> None:
    """Protocol reference 8.3."""
    radar, _, _ = loaded
    radar.profile.run()
    with pytest.raises(DeviceError) as caught:
        radar.profile.set_led(LedMode.OFF)
    (note,) = caught.value.__notes__
    assert "load() it, set, run()" in note
    radar.profile.load()
    radar.profile.set_led(LedMode.OFF)


def test_settings_are_read_as_they_were_set(loaded: Emulated) -> None:
    radar, _, _ = loaded
    radar.profile.set_sensitivity(2)
    radar.profile.set_band(4)
    radar.profile.set_led(LedMode.SIMPLE)
    radar.profile.set_noise_map(NoiseMapControl.ADAPTIVE)
    radar.profile.set_output(OutputFeature.PULSEDOPPLER_FLOAT, 3)
    assert radar.profile.sensitivity() == 2
    assert radar.profile.band() == 4
    assert radar.profile.led() is LedMode.SIMPLE
    assert radar.profile.noise_map() == NoiseMapControl.ADAPTIVE
    assert radar.profile.output(OutputFeature.PULSEDOPPLER_FLOAT) == 3
    assert radar.profile.output(OutputFeature.PULSEDOPPLER_BYTE) == 0
    assert radar.profile.profile_id() == 0x014D4AB8


def test_zone_is_checked_against_the_modules_limits_and_read_back_snapped(
    loaded: Emulated,
) -> None:
    radar, _, module = loaded
    limits = radar.profile.zone_limits()
    assert (limits.min_m, limits.max_m) == pytest.approx((0.4, 9.4))
    assert limits.step_m == pytest.approx(STEP_M)
    start_m, end_m = radar.profile.set_zone(1.0, 5.0)
    assert 1.0 - STEP_M < start_m <= 1.0
    assert 5.0 <= end_m < 5.0 + STEP_M
    radar.profile.set_zone(0.4, 9.4)  # the limits themselves
    module.received.clear()
    for start, end, why in [
        (0.3, 5.0, "does not lie within 0.4 ... 9.4 m"),
        (1.0, 9.5, "does not lie within 0.4 ... 9.4 m"),
        (5.0, 1.0, "does not lie within"),
        (1.0, 1.1, "is smaller than 0.2 m"),
    ]:
        with pytest.raises(LocalProtocolError, match=why):
            radar.profile.set_zone(start, end)
    assert not any(isinstance(c, m.SetDetectionZone) for c in module.received)


@pytest.mark.parametrize(
    ("verb", "value"), [("set_sensitivity", 10), ("set_sensitivity", -1), ("set_band", 5)]
)
def test_values_no_module_has_are_not_sent(loaded: Emulated, verb: str, value: int) -> None:
    radar, _, module = loaded
    sent = len(module.received)
    with pytest.raises(LocalProtocolError):
        getattr(radar.profile, verb)(value)
    assert len(module.received) == sent


def test_without_a_profile_nothing_is_asked_that_gets_no_answer(emulated: Emulated) -> None:
    radar, line, _ = emulated
    for verb in ("zone", "zone_limits", "sensitivity", "led", "noise_map", "run", "idle"):
        with pytest.raises(LocalProtocolError, match=r"no profile is loaded; load\(\) one first"):
            getattr(radar.profile, verb)()
    assert line.now_ns < 1e9  # no timeout among them


def test_profile_that_was_found_running_is_used_as_it_is(driver_on: DriverOn) -> None:
    module = EmulatedModule(stopped=False)  # as a stock module powers up
    radar, line = driver_on(module)
    assert radar.profile.sensitivity() == 5
    line.say(presence(1, NO_PRESENCE))
    radar.ping()
    line.say(presence(2, PRESENCE))
    assert list(radar.messages(1)) == [presence(2, PRESENCE)]  # heard since asked for
    assert not any(isinstance(c, m.LoadApp | m.SetMode) for c in module.received)


def test_refusals_are_the_modules_own(driver_on: DriverOn) -> None:
    radar, _ = driver_on(EmulatedModule())
    with pytest.raises(DeviceError, match="APP_INVALID"):
        radar.profile.load(0x064E57AD)
    radar.profile.load()
    radar.profile.run()
    with pytest.raises(DeviceError, match="COMMAND_FAILED"):
        radar.profile.set_sensitivity(1)


def test_messages_come_typed_and_in_order_and_frames_stay_frames(running: Emulated) -> None:
    radar, line, _ = running
    moving = m.PresenceMovingList(
        counter=3,
        state=PRESENCE,
        movement_slow=(1.0, 2.0),
        movement_fast=(3.0, 4.0),
        detection_distance_m=(1.5,),
        detection_rcs=(0.0,),
        detection_velocity=(0.0,),
    )
    baseband = m.BasebandIq(
        counter=9,
        num_bins=2,
        bin_length_m=0.0514403,
        sampling_frequency_hz=2.916e9,
        carrier_frequency_hz=7.29e9,
        range_offset_m=0.25,
        i=np.array([1, 2], np.float32),
        q=np.array([3, 4], np.float32),
    )
    line.say(presence(2, PRESENCE), baseband, moving)
    assert list(radar.messages(2)) == [presence(2, PRESENCE), moving]
    assert radar.read_frame().counter == 9
    with pytest.raises(ResponseTimeout, match="no message of the profile from the port within 3 s"):
        next(radar.messages())


def test_messages_of_what_ran_before_are_not_the_loaded_profiles(loaded: Emulated) -> None:
    radar, line, _ = loaded
    line.say(presence(1, PRESENCE))
    radar.profile.load()
    line.say(presence(2, PRESENCE))
    # what came is heard without waiting
    assert next(radar.messages(timeout_s=0.0)) == presence(2, PRESENCE)
    with pytest.raises(ResponseTimeout):
        next(radar.messages(timeout_s=0.0))


def test_messages_are_kept_only_if_they_are_asked_for(raw: Scripted) -> None:
    radar, line = raw
    line.say(*(presence(k, PRESENCE) for k in range(9)), frame(1))
    radar.read_frame()
    assert not radar._link.messages


def test_texts_are_kept_for_whoever_reads_messages_later(loaded: Emulated) -> None:
    radar, line, _ = loaded
    early, late = m.DataString(text="early"), m.DataString(text="late")
    line.say(early, presence(1, PRESENCE))
    radar.profile.load()  # what ran before has nothing more to say, but for its texts
    radar.profile.run()
    line.say(presence(2, INITIALIZING), late, presence(3, PRESENCE), presence(4, PRESENCE))
    assert radar.profile.wait_until_initialized() == presence(3, PRESENCE)
    assert list(radar.messages(3)) == [early, late, presence(4, PRESENCE)]


def test_text_that_came_before_anything_was_asked_is_kept(driver_on: DriverOn) -> None:
    radar, line = driver_on(EmulatedModule(stopped=False))
    line.say(presence(1, PRESENCE), m.DataString(text="boot"), presence(2, PRESENCE))
    radar.ping()
    assert next(radar.messages(timeout_s=0.0)) == m.DataString(text="boot")


def test_output_is_not_asked_for_while_no_profile_is_loaded(emulated: Emulated) -> None:
    """In that state stock firmware leaves the question unanswered. Protocol reference 4.4, 8.3."""
    radar, line, _ = emulated
    with pytest.raises(LocalProtocolError):
        radar.profile.output(OutputFeature.BASEBAND_IQ)
    assert line.now_ns < 1e9


def test_messages_that_pile_up_are_dropped_and_told_of(loaded: Emulated) -> None:
    radar, line, _ = loaded
    for number in range(4101):
        radar._link._take(presence(number, PRESENCE), 0)
    assert radar.messages_dropped == 5
    assert radar.warnings == ["4096 messages wait unread, so the oldest are dropped"]
    assert line.pending == []
    waiting = radar.messages(timeout_s=0.0)
    kept = [next(waiting) for _ in range(4096)]
    assert kept == [presence(number, PRESENCE) for number in range(5, 4101)]


@pytest.mark.parametrize(("control", "limit_s"), [(2, 25.0), (6, 25.0), (3, 125.0), (7, 125.0)])
def test_start_is_waited_for_as_long_as_it_may_take(
    loaded: Emulated, control: int, limit_s: float
) -> None:
    radar, line, _ = loaded
    radar.profile.set_noise_map(NoiseMapControl(control))
    radar.profile.run()
    for second in range(1, 200):
        line.say_later(second, presence(second, INITIALIZING))
    with pytest.raises(ResponseTimeout, match=rf"no end of the profile's start .* {limit_s:g} s"):
        radar.profile.wait_until_initialized()
    assert limit_s <= line.now_ns * 1e-9 < limit_s + 2


def test_end_of_the_start_is_the_first_message_of_another_state(running: Emulated) -> None:
    radar, line, _ = running
    for second in range(1, 19):
        line.say_later(second, presence(second, INITIALIZING))
    line.say_later(19, presence(19, NO_PRESENCE), presence(20, PRESENCE))
    assert radar.profile.wait_until_initialized() == presence(19, NO_PRESENCE)
    assert list(radar.messages(1)) == [presence(20, PRESENCE)]


RESPIRING = m.RespStatus(
    counter=2, state=0, rpm=15, distance_m=1.0, movement_mm=0.5, signal_quality=9
)
SLEEPING = m.SleepStatus(
    counter=2,
    state=3,
    rpm=12.0,
    distance_m=1.0,
    signal_quality=9,
    movement_slow=0.0,
    movement_fast=0.0,
)
VITAL = m.VitalSigns(
    counter=2,
    state=7,
    respiration_rate=15.0,
    respiration_distance_m=1.0,
    respiration_confidence=1.0,
    heart_rate=60.0,
    heart_distance_m=1.0,
    heart_confidence=1.0,
    normalized_movement_slow=0.0,
    normalized_movement_fast=0.0,
    normalized_movement_start_m=0.5,
    normalized_movement_end_m=5.0,
)


@pytest.mark.parametrize("first", [RESPIRING, SLEEPING, VITAL])
def test_start_of_a_respiration_profile_ends_as_its_states_say(
    running: Emulated, first: m.RespStatus | m.SleepStatus | m.VitalSigns
) -> None:
    """Protocol reference 7.4: state 4 is initialising there, 2 is not."""
    radar, line, _ = running
    line.say(replace(first, state=4), replace(first, counter=1, state=4), first)
    assert radar.profile.wait_until_initialized() == first
    line.say(replace(first, state=2))
    assert radar.profile.wait_until_initialized() == replace(first, state=2)


def test_module_that_falls_silent_while_it_starts_is_not_waited_for_all_the_time(
    running: Emulated,
) -> None:
    radar, line, _ = running
    with pytest.raises(ResponseTimeout):
        radar.profile.wait_until_initialized()
    assert line.now_ns < 4e9


def test_module_that_restarts_to_change_its_profile_is_waited_for(driver_on: DriverOn) -> None:
    module = EmulatedModule()
    module.run_errors = [0x22]
    radar, line = driver_on(module)
    radar.profile.load()
    radar.profile.set_sensitivity(1)
    line.say_later(2.5, m.System(code=0x10), m.System(code=0x11))
    module.received.clear()
    radar.profile.run()
    assert module.received == [
        m.SetMode(mode=RUN),
        m.SetMode(mode=STOP),
        m.LoadApp(profile_id=0x014D4AB8),
        m.SetSensitivity(sensitivity=1),
        m.SetMode(mode=RUN),
    ]
    assert line.now_ns >= 2.5e9
    assert radar.warnings == ["the module restarts to change its profile"]


def test_profile_pauses_goes_on_and_stops(running: Emulated) -> None:
    radar, _, module = running
    radar.profile.idle()
    radar.profile.run()
    radar.profile.stop()
    modes = [c.mode for c in module.received if isinstance(c, m.SetMode)]
    assert modes == [STOP, RUN, IDLE, RUN, STOP]
    with pytest.raises(LocalProtocolError):
        radar.profile.run()


def test_running_profile_is_left_running_at_the_end(emulated: Emulated) -> None:
    radar, line, module = emulated
    with radar:
        radar.profile.load()
        radar.profile.run()
    assert module.module.modes.mode == RUN
    assert line.closed


def test_noise_map_and_factory_preset(loaded: Emulated) -> None:
    radar, _, module = loaded
    radar.profile.store_noise_map()
    radar.profile.load_noise_map()
    radar.profile.delete_noise_map()
    radar.profile.factory_preset()
    assert module.received[3:] == [
        m.SystemGetInfo(item=7),
        m.StoreNoiseMap(),
        m.LoadNoiseMap(),
        m.DeleteNoiseMap(),
        m.FactoryPreset(),
    ]
