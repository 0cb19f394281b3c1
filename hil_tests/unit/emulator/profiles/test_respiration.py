"""The respiration profile of an X4M200: rate, distance and chest of a person that breathes."""

import math

import numpy as np
import pytest

from emulator.chip import Pace
from emulator.echo.echo import SceneEcho
from emulator.module.settings import RESPIRATION_PROFILES, DeviceOptions, ModelName
from emulator.profiles.doppler import SLOW, NoiseMap, ProfileSweep
from emulator.profiles.presence import PresenceProcessing
from emulator.profiles.respiration import (
    breathing_rate_hz,
    displacement_m,
    normalized_movement_list,
)
from emulator.scene.scene import Scene
from hil_tests.unit.emulator.doubles import BareHost, ramp_device
from hil_tests.unit.emulator.profiles.doubles import (
    BIN_M,
    FRAME_HZ,
    SECOND,
    heard_until,
    profile,
    room,
    standing,
    walking,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import (
    ErrorCode,
    InfoItem,
    OutputFeature,
    ProfileId,
    RespirationState,
    SensorMode,
)

MODULE_PER_METRE = 3.0e8 / 299_792_458.0
WINDOW_S = SLOW.frames / FRAME_HZ


def statuses(scene: Scene, end_s: float) -> list[tuple[float, m.RespStatus]]:
    stream, _ = profile(scene, model="x4m200")
    heard = list(heard_until(stream, round(end_s * SECOND)))
    assert {type(message) for _, message in heard} == {m.RespStatus}
    return [(time_s, one) for time_s, one in heard if isinstance(one, m.RespStatus)]


@pytest.mark.parametrize(("range_m", "breaths"), [(1.5, 10.0), (3.0, 15.0), (5.0, 24.0)])
def test_a_person_that_breathes(range_m: float, breaths: float) -> None:
    """Rate within the resolution of the window, 3 a minute; distance within a bin."""
    late = [one for at, one in statuses(room(standing(range_m, breaths_per_min=breaths)), 32)]
    late = late[21:]
    assert {one.state for one in late} == {RespirationState.BREATHING}
    for one in late:
        assert one.rpm == pytest.approx(breaths, abs=60 / WINDOW_S / 2)
        assert one.distance_m == pytest.approx(range_m * MODULE_PER_METRE, abs=BIN_M)
        assert 1 <= one.signal_quality <= 10


def test_movement_is_the_displacement_of_the_chest() -> None:
    """4 mm sin(2 pi f t) towards the radar, at the middle of the newest four frames."""
    heard = statuses(room(standing(2.0, breaths_per_min=15.0), quiet=True), 45)[22:]
    for _, one in heard:
        newest = (one.counter + 1) // SLOW.decimation * SLOW.decimation - 2.5
        expected_mm = 4 * math.sin(math.tau * 0.25 * newest / FRAME_HZ)
        assert one.movement_mm == pytest.approx(expected_mm, abs=0.8)
    assert max(one.movement_mm for _, one in heard) > 3
    assert min(one.movement_mm for _, one in heard) < -3


def test_a_still_room_has_no_movement() -> None:
    for scene in (room(), room(standing(3.0, breath_amplitude_m=0.0))):
        heard = statuses(scene, 40)
        states = [one.state for _, one in heard]
        assert states[:19] == [RespirationState.INITIALIZING] * 19
        assert set(states[19:]) == {RespirationState.NO_MOVEMENT}
        assert {(one.rpm, one.distance_m, one.signal_quality) for _, one in heard} == {(0, 0.0, 0)}


def test_a_walker_is_tracked() -> None:
    walker = walking(7.0, 1.0, speed_mps=0.3, enters_s=21.0)
    walks = [one for at, one in statuses(room(walker), 36) if 25 < at < 35]
    assert {one.state for one in walks} == {RespirationState.MOVEMENT_TRACKING}
    assert {one.rpm for one in walks} == {0}


@pytest.mark.parametrize("rate_hz", [0.12, 0.25, 0.31, 0.6])
@pytest.mark.parametrize("amplitude_m", [0.001, 0.004, 0.012])
def test_rate_and_displacement_of_a_phase_modulated_tone(
    rate_hz: float, amplitude_m: float
) -> None:
    """Closed form: a clutter constant and exp(j 4 pi d(t) / lambda)."""
    wavelength_m = 299_792_458.0 / 7.29e9
    t_s = np.arange(SLOW.pulses) / SLOW.rate_hz
    chest_m = amplitude_m * np.sin(math.tau * rate_hz * t_s + 0.4)
    pulses = 1e-3 * (3 - 2j) + 1e-3 * np.exp(1j * (4 * math.pi / wavelength_m * chest_m + 1.1))
    found_m = displacement_m(pulses, wavelength_m)
    assert found_m == pytest.approx(chest_m - chest_m.mean(), abs=0.02 * amplitude_m)
    found = breathing_rate_hz(found_m, SLOW.rate_hz)
    assert found is not None
    found_hz, confidence = found
    assert found_hz == pytest.approx(rate_hz, abs=0.5 / WINDOW_S)
    assert 0.9 < confidence <= 1


def test_noise_has_no_rate() -> None:
    rng = np.random.default_rng(5)
    rates = [breathing_rate_hz(rng.standard_normal(SLOW.pulses), SLOW.rate_hz) for _ in range(200)]
    assert sum(rate is not None for rate in rates) <= 20


def test_a_step_has_no_rate() -> None:
    """Of a body that shifts: its spectrum falls through the band, without a peak in it."""
    for at in range(20, 65, 5):
        chest_m = np.where(np.arange(SLOW.pulses) > at, 0.03, 0.0)
        assert breathing_rate_hz(chest_m, SLOW.rate_hz) is None


def test_sleep_and_vital_signs_are_of_the_same_breath() -> None:
    """Three messages a tick; a person at 15 breaths a minute, no heart rate (7.4)."""
    features = (OutputFeature.RESP_STATUS, OutputFeature.SLEEP_STATUS, OutputFeature.VITAL_SIGNS)
    stream, _ = profile(
        room(standing(3.0, breaths_per_min=15.0)),
        model="x4m200",
        outputs=dict.fromkeys(features, 1),
    )
    heard = [message for _, message in heard_until(stream, 40 * SECOND)]
    assert len(heard) % 3 == 0
    for status, sleep, vital in zip(heard[::3], heard[1::3], heard[2::3], strict=True):
        assert isinstance(status, m.RespStatus)
        assert isinstance(sleep, m.SleepStatus)
        assert isinstance(vital, m.VitalSigns)
        assert status.counter == sleep.counter == vital.counter
        assert status.state == sleep.state == vital.state
        assert status.rpm == round(sleep.rpm)
        assert sleep.rpm == vital.respiration_rate
        assert status.distance_m == sleep.distance_m == vital.respiration_distance_m
        assert status.signal_quality == sleep.signal_quality
        assert (vital.heart_rate, vital.heart_distance_m, vital.heart_confidence) == (0, 0, 0)
    assert isinstance(status, m.RespStatus)
    assert isinstance(sleep, m.SleepStatus)
    assert isinstance(vital, m.VitalSigns)
    assert status.state == RespirationState.BREATHING
    assert sleep.rpm == pytest.approx(15.0, abs=60 / WINDOW_S / 2)
    assert 0.9 < vital.respiration_confidence <= 1
    assert sleep.movement_slow > 3 * sleep.movement_fast
    assert 0 < vital.normalized_movement_slow < 1
    zone_m = (vital.normalized_movement_start_m, vital.normalized_movement_end_m)
    assert zone_m == pytest.approx((0.40, 9.40), abs=BIN_M)


@pytest.mark.parametrize(
    ("shape", "rate"),
    [
        ({"breath_pattern": "realistic"}, 15.0),
        ({"breath_pattern": "realistic", "heart_amplitude_m": 0.0003}, 15.0),
        ({"facing_deg": 0.0}, 15.0),  # the back: 1 mm of 4 mm
        ({"facing_deg": 90.0}, 15.0),
        ({"posture": "prone"}, 15.0),
        ({"posture": "supine", "rate_wander": 0.1}, 15.0),
    ],
)
def test_posture_and_pattern_leave_the_rate(shape: dict[str, object], rate: float) -> None:
    person = standing(2.0, breaths_per_min=rate, **shape)
    late = [one for _, one in statuses(room(person), 32)][21:]
    assert {one.state for one in late} == {RespirationState.BREATHING}
    for one in late:
        assert one.rpm == pytest.approx(rate, abs=60 / WINDOW_S / 2)


@pytest.mark.parametrize(
    ("posture", "facing_deg", "share"), [("upright", 0.0, 0.25), ("upright", 180.0, 1.0)]
)
def test_movement_is_what_is_seen_of_the_chest(
    posture: str, facing_deg: float, share: float
) -> None:
    """The radar looks along x at a back (0 degrees) or a front."""
    person = standing(2.0, posture=posture, facing_deg=facing_deg, breath_amplitude_m=0.008)
    heard = statuses(room(person, quiet=True), 45)[22:]
    assert max(one.movement_mm for _, one in heard) == pytest.approx(8 * share, rel=0.25)


def test_nobody_breathes_in_apnoea() -> None:
    """60 s of rest in every 61 s: from 20 s into it on there is nothing to see."""
    person = standing(2.0, apnoea={"every_s": 61.0, "lasts_s": 60.0})
    states = [one.state for at, one in statuses(room(person), 58) if at > 27]
    assert set(states) == {RespirationState.NO_MOVEMENT}


def test_lists_say_where() -> None:
    features = (
        OutputFeature.RESPIRATION_MOVINGLIST,
        OutputFeature.RESPIRATION_DETECTIONLIST,
        OutputFeature.RESPIRATION_NORMALIZEDMOVEMENTLIST,
        OutputFeature.PRESENCE_SINGLE,  # of another profile: not sent
    )
    stream, _ = profile(room(standing(3.0)), model="x4m200", outputs=dict.fromkeys(features, 1))
    heard = [message for _, message in heard_until(stream, 30 * SECOND)]
    moving, detected, normalized = heard[-3:]
    assert isinstance(moving, m.RespirationMovingList)
    assert isinstance(detected, m.RespirationDetectionList)
    assert isinstance(normalized, m.RespirationNormalizedMovementList)
    assert len(heard) % 3 == 0
    place_m = 3.0 * MODULE_PER_METRE
    assert detected.detection_distance_m[0] == pytest.approx(place_m, abs=BIN_M)
    assert detected.detection_rcs == (0.0,) * len(detected.detection_distance_m)
    assert len(normalized.movement_slow) == len(normalized.movement_fast) == 177
    strongest = int(np.argmax(normalized.movement_slow))
    strongest_m = normalized.start_m + strongest * normalized.bin_length_m
    assert strongest_m == pytest.approx(place_m, abs=2 * BIN_M)
    assert 0.3 < max(normalized.movement_slow) <= 1
    assert moving.movement_slow[0] == pytest.approx(np.mean(moving.movement_slow[1:]), rel=1e-5)
    assert 1 + int(np.argmax(moving.movement_slow[1:])) == 1 + strongest // 10


def test_normalized_movement_is_0_at_an_excess_of_3_db_and_1_at_40() -> None:
    sweep = ProfileSweep(
        SceneEcho(room(), room().radars[0], seed=1),
        zone_m=(1.0, 1.25),
        tx_center_frequency=3,
        largest_block=1,
    )
    processing = PresenceProcessing(sweep, NoiseMap())
    excess_db = np.linspace(-7.0, 50.0, sweep.n_bins)
    processing.excess[SLOW.instance] = 10.0 ** (excess_db / 10.0)
    message = normalized_movement_list(7, processing, sweep)
    inside = excess_db[sweep.in_zone]
    expected = np.interp(inside, [3.0, 40.0], [0.0, 1.0])
    np.testing.assert_allclose(message.movement_slow, expected, atol=1e-12)
    assert message.movement_fast == (0.0,) * len(inside)


@pytest.mark.parametrize("profile_id", sorted(RESPIRATION_PROFILES))
def test_every_respiration_profile_reports_breathing(profile_id: ProfileId) -> None:
    options = DeviceOptions(model="x4m200")
    host = BareHost(ramp_device(Pace.REALTIME, options=options))
    host.command(m.SetMode(mode=SensorMode.XTID_SM_STOP), m.LoadApp(profile_id=profile_id))
    host.command(m.SetMode(mode=SensorMode.XTID_SM_RUN))
    (report, *more) = host.at(3 * SECOND // 2)
    assert isinstance(report, m.RespStatus)
    sleeps = profile_id is ProfileId.XTS_ID_APP_RESPIRATION_3
    assert [type(one) for one in more] == [m.SleepStatus] * sleeps


@pytest.mark.parametrize(("model", "taken"), [("x4m200", True), ("x4m300", False)])
def test_outputs_after_run_are_taken_by_an_x4m200(model: ModelName, taken: bool) -> None:
    options = DeviceOptions(model=model)
    load = m.LoadApp(profile_id=options.product.profiles[0])
    switch = m.OutputSetControl(feature=options.product.output, control=1)
    host = BareHost(ramp_device(Pace.REALTIME, options=options))
    host.command(m.SetMode(mode=SensorMode.XTID_SM_STOP))
    host.command(load, m.SetMode(mode=1))
    assert host.ask(switch) == (m.Ack() if taken else m.Error(code=0x21))
    # before RUN both take it
    host.command(m.SetMode(mode=SensorMode.XTID_SM_STOP), load, switch)


def test_an_x4m200_runs_the_respiration_profile_and_an_x4m300_refuses_it() -> None:
    host = BareHost(ramp_device(Pace.REALTIME, options=DeviceOptions(model="x4m200")))
    host.now_ns = 5 * SECOND
    profile_id = ProfileId.XTS_ID_APP_RESPIRATION_2

    def last(command: m.Command[m.Response]) -> m.Message:
        host.send(command)
        return [one for one in host.hear() if not isinstance(one, m.System | m.RespStatus)][-1]

    assert last(m.GetProfileId()) == m.ReplyInt(values=(int(profile_id),))
    assert last(m.SetMode(mode=SensorMode.XTID_SM_STOP)) == m.Ack()
    assert last(m.LoadApp(profile_id=profile_id)) == m.Ack()
    assert last(m.SetMode(mode=SensorMode.XTID_SM_RUN)) == m.Ack()
    refused = m.Error(code=ErrorCode.XTS_SPRE_APP_INVALID)
    assert last(m.SetMode(mode=SensorMode.XTID_SM_STOP)) == m.Ack()
    assert last(m.LoadApp(profile_id=ProfileId.XTS_ID_APP_PRESENCE_2)) == refused
    host = BareHost(ramp_device(Pace.REALTIME))
    host.now_ns = 5 * SECOND
    assert last(m.SetMode(mode=SensorMode.XTID_SM_STOP)) == m.Ack()
    assert last(m.LoadApp(profile_id=profile_id)) == refused
    assert isinstance(last(m.SystemGetInfo(item=InfoItem.XTID_SSIC_ORDERCODE)), m.ReplyString)
