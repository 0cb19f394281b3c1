"""The profile on the module's clock: baseband, pauses, restarts, silence, catching up."""

import math

import numpy as np
import pytest

from emulator.chip import Pace
from emulator.chip.chip import ModuleClock
from emulator.module.modes import ModuleState
from emulator.module.settings import ProfileSettings
from emulator.module.state import NOISE_MAPS
from emulator.x4m300 import ChipStream, CombinedStream
from hil_tests.unit.emulator.profiles.doubles import (
    BIN_M,
    FRAME_HZ,
    SECOND,
    first_message,
    heard_until,
    presence_until,
    profile,
    room,
    standing,
    walking,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import OutputFeature, PresenceState, SensorMode, X4Setting

IQ, AP = OutputFeature.BASEBAND_IQ, OutputFeature.BASEBAND_AMPLITUDE_PHASE
WALKER = walking(4.0, 1.0, speed_mps=0.7)


def test_baseband_covers_the_zone_and_a_bin_more_at_either_end() -> None:
    """Protocol reference 7.1; 0.4 ... 9.4 m on the grid is bins 4 ... 180 from 0.18 m."""
    stream, _ = profile(room(standing(2.0)), outputs={IQ: 1})
    heard = list(heard_until(stream, 2 * SECOND))
    messages = [message for _, message in heard if isinstance(message, m.BasebandIq)]
    assert len(messages) == len(heard) == 35
    assert [message.counter for message in messages] == list(range(1, 36))
    assert np.diff([due_s for due_s, _ in heard]) == pytest.approx(1 / FRAME_HZ, abs=1e-6)
    message = messages[0]
    assert message.num_bins == 177 + 2 == len(message.i) == len(message.q)
    assert message.range_offset_m == pytest.approx(0.18 + 3 * BIN_M, abs=1e-6)
    assert message.bin_length_m == pytest.approx(0.0514403)
    assert message.sampling_frequency_hz == pytest.approx(2.916e9)
    assert message.carrier_frequency_hz == pytest.approx(7.29e9)
    strongest = int(np.argmax(np.hypot(message.i, message.q)[20:])) + 20
    assert message.range_offset_m + strongest * BIN_M == pytest.approx(2.0, abs=BIN_M)


def test_amplitude_and_phase_are_those_of_the_same_frame() -> None:
    as_iq = first_message(profile(room(standing(2.0)), outputs={IQ: 1})[0])
    stream, _ = profile(room(standing(2.0)), outputs={AP: 1})
    as_ap = first_message(stream)
    assert isinstance(as_iq, m.BasebandIq)
    assert isinstance(as_ap, m.BasebandAp)
    iq = as_iq.i.astype(complex) + 1j * as_iq.q
    assert as_ap.amplitude == pytest.approx(np.abs(iq), rel=1e-6)
    assert np.angle(np.exp(1j * as_ap.phase) / iq) == pytest.approx(0, abs=1e-6)
    assert np.abs(as_ap.phase).max() <= math.pi + 1e-6
    assert {type(message) for _, message in heard_until(stream, SECOND)} == {m.BasebandAp}


def test_the_phase_falls_as_the_range_grows() -> None:
    """Protocol reference 9.8: -4 pi f dR / c, at the same bin."""
    phases = []
    for range_m in (3.0, 3.003):
        message = first_message(profile(room(standing(range_m), quiet=True), outputs={IQ: 1})[0])
        assert isinstance(message, m.BasebandIq)
        iq = message.i.astype(complex) + 1j * message.q
        phases.append(np.angle(iq[int(np.argmax(np.abs(iq)))]))
    expected = -4 * math.pi * 7.29e9 * 0.003 / 299_792_458.0
    turned = math.remainder(phases[1] - phases[0] - expected, math.tau)
    assert turned == pytest.approx(0, abs=0.05)


def test_idle_pauses_and_run_fills_the_matrices_anew() -> None:
    """Protocol reference 8.3; the second is an assumption."""
    stream, module = profile(room())
    assert presence_until(stream, 30)[-1][1].state == PresenceState.NO_PRESENCE
    module.modes.state = ModuleState.IDLE
    stream.command_done(m.SetMode(mode=SensorMode.XTID_SM_IDLE), 30 * SECOND)
    assert stream.next_due_ns() is None
    module.modes.state = ModuleState.RUN
    stream.command_done(m.SetMode(mode=SensorMode.XTID_SM_RUN), 100 * SECOND)
    heard = presence_until(stream, 125)
    assert heard[0][0] == pytest.approx(101, abs=0.1)
    # the chip did not sweep in the pause
    assert heard[0][1].counter == pytest.approx(30 * FRAME_HZ + 17, abs=1)
    ready = [time_s for time_s, one in heard if one.state != PresenceState.INITIALIZING]
    assert ready[0] == pytest.approx(120, abs=0.2)


def test_an_output_that_is_switched_off_leaves_nothing_waiting() -> None:
    """Rows of a matrix that are still to be sent are not waited for."""
    stream, module = profile(room(), outputs={OutputFeature.PULSEDOPPLER_FLOAT: 2})
    assert len(list(heard_until(stream, 3 * SECOND))) == 201
    module.profile.set_output(OutputFeature.PULSEDOPPLER_FLOAT, 0)
    assert stream.next_due_ns() is None
    module.profile.set_output(OutputFeature.PRESENCE_SINGLE, 1)
    assert presence_until(stream, 5)[0][0] == pytest.approx(4 * 17 / FRAME_HZ, abs=0.1)


def test_stop_ends_it_and_a_restart_begins_when_the_module_is_ready() -> None:
    stream, module = profile(room())
    module.modes.state = ModuleState.STOPPED
    stream.command_done(m.SetMode(mode=SensorMode.XTID_SM_STOP), 5 * SECOND)
    assert stream.next_due_ns() is None
    stream.restarted(8 * SECOND)
    assert stream.next_due_ns() is None
    module.modes.state = ModuleState.RUN
    stream.restarted(12 * SECOND)
    first_s, first = presence_until(stream, 14)[0]
    assert first.state == PresenceState.INITIALIZING
    assert first_s == pytest.approx(13, abs=0.1)


def test_under_asap_a_start_is_scene_time_zero() -> None:
    """What a host gets does not depend on when it starts the profile."""
    early, _ = profile(room(WALKER), pace=Pace.ASAP, zero_ns=0)
    late, _ = profile(room(WALKER), pace=Pace.ASAP, zero_ns=777 * SECOND)
    expected = [message for _, message in heard_until(early, 25 * SECOND)]
    late.skip_due_before(10**15)
    assert [message for _, message in heard_until(late, (777 + 25) * SECOND)] == expected


def test_skipped_messages_change_nothing_but_their_absence() -> None:
    """Protocol reference 8.4: the radar sweeps on while the queue is full."""
    whole, _ = profile(room(WALKER))
    expected = presence_until(whole, 32)
    gappy, _ = profile(room(WALKER))
    presence_until(gappy, 5)
    gappy.skip_due_before(25 * SECOND)
    assert presence_until(gappy, 32) == expected[-7:]


@pytest.mark.parametrize("control", [6, 7])
def test_hours_of_silence_cost_little_and_end_in_the_right_state(control: int) -> None:
    """Only frames that still matter are synthesised."""
    person = standing(3.0, enters_s=3000.0)
    stream, module = profile(room(person), noise_map_control=control, outputs={})
    stream.command_done(m.Ping(), SECOND)
    assert stream.next_due_ns() is None
    hour_ns = 3600 * SECOND
    module.profile.set_output(OutputFeature.PRESENCE_SINGLE, 1)
    stream.command_done(m.Ping(), hour_ns)
    heard = presence_until(stream, 3603)
    assert heard[0][0] == pytest.approx(3600.5, abs=0.6)
    assert heard[0][1].counter == pytest.approx(heard[0][0] * FRAME_HZ + 1, abs=1)
    assert {message.state for _, message in heard} == {PresenceState.PRESENCE}


def test_a_created_map_is_stored_and_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Protocol reference 4.6, control 3; deleting its files deletes it."""
    stream, module = profile(room(), noise_map_control=3)
    saved: list[int] = []
    monkeypatch.setattr(module, "save", lambda: saved.append(len(module.files.names())))
    presence_until(stream, 125)
    assert saved == [3]
    stream.restarted(200 * SECOND)
    states = [one.state for time_s, one in presence_until(stream, 225) if time_s > 220.5]
    assert set(states) == {PresenceState.NO_PRESENCE}
    for key in module.files.names():
        module.files.delete(key)
    stream.restarted(300 * SECOND)
    states = [one.state for _, one in presence_until(stream, 325)]
    assert set(states) == {PresenceState.INITIALIZING}


@pytest.mark.parametrize(
    "damage",
    [*(pytest.param(b, marks=pytest.mark.rare) for b in (b"\xff", b"x" * 64)), b"\x00" * 100],
    ids=["a byte", "text", "zeros"],
)
def test_a_damaged_map_is_created_anew(damage: bytes) -> None:
    stream, module = profile(room(), noise_map_control=3)
    presence_until(stream, 125)
    module.files.replace(NOISE_MAPS[0], damage)
    stream.restarted(200 * SECOND)
    assert {one.state for _, one in presence_until(stream, 225)} == {PresenceState.INITIALIZING}


def test_the_files_of_a_map_hold_its_powers() -> None:
    """Zone, band and frequencies in front, then a float32 per range and frequency."""
    stream, _ = profile(room(), noise_map_control=6, outputs={OutputFeature.NOISEMAP_FLOAT: 2})
    fast_rows = [message for _, message in heard_until(stream, round(20.9 * SECOND))]
    first = fast_rows[0]
    assert isinstance(first, m.NoiseMapFloat)
    slow, fast = stream.noise_map_files()
    assert (len(slow), len(fast)) == (16 + 4 * 179 * 85, 16 + 4 * 179 * 34)
    assert np.frombuffer(fast[:8], "<f4") == pytest.approx([0.18 + 4 * BIN_M, 0.18 + 180 * BIN_M])
    assert np.frombuffer(fast[8:16], "<u4").tolist() == [3, 34]
    powers = np.frombuffer(fast[16:], "<f4").reshape(179, 34)
    assert powers[0] == pytest.approx(first.power, rel=0.05)
    empty, _ = profile(room(), noise_map_control=7)
    assert empty.noise_map_files() == (b"", b"")


def test_another_zone_does_not_use_the_stored_map() -> None:
    stream, module = profile(room(), noise_map_control=3)
    presence_until(stream, 125)
    module.profile = ProfileSettings(noise_map_control=3, zone_m=(0.18 + 8 * BIN_M, 5.0))
    stream.restarted(200 * SECOND)
    assert {one.state for _, one in presence_until(stream, 225)} == {PresenceState.INITIALIZING}


def test_a_source_without_noise_divides_by_nothing() -> None:
    stream, _ = profile(room(quiet=True), noise_map_control=7)
    assert presence_until(stream, 125)[-1][1].state == PresenceState.NO_PRESENCE


@pytest.mark.parametrize("mode", [SensorMode.XTID_SM_RUN, SensorMode.XTID_SM_MANUAL])
def test_the_line_carries_frames_in_manual_and_the_profile_in_run(mode: SensorMode) -> None:
    profile_stream, module = profile(room())
    combined = CombinedStream(
        ChipStream(module, pace=Pace.REALTIME, clock=ModuleClock()), profile_stream
    )
    assert combined.next_due_ns() == 0
    module.modes.set_mode(mode)
    module.chip.set(X4Setting.FPS, 10.0)
    combined.command_done(m.SetMode(mode=mode), 5 * SECOND)
    expected = m.DataFloat if mode is SensorMode.XTID_SM_MANUAL else m.PresenceSingle
    messages = (combined.take() for _ in range(17))
    assert isinstance(next(filter(None, messages)), expected)
