"""Who is detected, where and which way; and that nobody is in an empty room."""

import math

import numpy as np
import pytest

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
from xethru_protocol.wire.codes import OutputFeature, PresenceDirection, PresenceState

MODULE_PER_METRE = 3.0e8 / 299_792_458.0


@pytest.mark.parametrize(
    "sensitivity", [9, *(pytest.param(less, marks=pytest.mark.rare) for less in (5, 0))]
)
def test_an_empty_room_is_empty(sensitivity: int) -> None:
    """Two minutes each; thresholds fall with sensitivity, so 9 holds for all."""
    stream, _ = profile(room(), sensitivity=sensitivity)
    heard = presence_until(stream, 140)
    states = [message.state for _, message in heard]
    assert states == [PresenceState.INITIALIZING] * 19 + [PresenceState.NO_PRESENCE] * 121
    assert {message.distance_m for _, message in heard} == {0.0}
    assert {message.signal_quality for _, message in heard} == {0}


@pytest.mark.parametrize(
    ("control", "until_s"),
    [
        (5, 120.0),
        *((control, 20.0) for control in (6, 2, 4)),
        *(pytest.param(control, 120.0, marks=pytest.mark.rare) for control in (7, 3)),
    ],
)
def test_initialising_takes_the_documented_time(control: int, until_s: float) -> None:
    """Protocol reference 4.6: 20 s to fill the slow matrix, 120 s when a map must be created."""
    stream, _ = profile(room(), noise_map_control=control)
    heard = presence_until(stream, until_s + 3)
    times = [time_s for time_s, message in heard if message.state == PresenceState.INITIALIZING]
    assert times[-1] == pytest.approx(until_s, abs=2.1)
    assert heard[len(times)][0] == pytest.approx(until_s, abs=1.0)
    assert {message.state for _, message in heard[len(times) :]} == {PresenceState.NO_PRESENCE}


def test_messages_come_once_a_second_with_the_frame_counter() -> None:
    stream, _ = profile(room())
    heard = presence_until(stream, 10)
    assert np.diff([time_s for time_s, _ in heard]) == pytest.approx(17 / FRAME_HZ, abs=1e-6)
    assert [message.counter for _, message in heard] == [17 * k for k in range(1, 11)]


@pytest.mark.parametrize(("range_m", "breaths"), [(1.0, 12.0), (3.0, 15.0), (6.0, 20.0)])
def test_somebody_who_only_breathes_is_found(range_m: float, breaths: float) -> None:
    stream, _ = profile(room(standing(range_m, breaths_per_min=breaths)))
    late = [message for time_s, message in presence_until(stream, 30) if time_s > 20]
    assert {message.state for message in late} == {PresenceState.PRESENCE}
    for message in late:
        assert message.distance_m == pytest.approx(range_m * MODULE_PER_METRE, abs=1.5 * BIN_M)
        assert message.direction == PresenceDirection.STILL
        assert 1 <= message.signal_quality <= 10


def test_somebody_who_does_not_move_at_all_is_not_found() -> None:
    stream, _ = profile(room(standing(3.0, breath_amplitude_m=0.0)))
    assert {message.state for _, message in presence_until(stream, 30)} == {
        PresenceState.INITIALIZING,
        PresenceState.NO_PRESENCE,
    }


@pytest.mark.parametrize("speed_mps", [0.15, 0.5, 1.0])
@pytest.mark.parametrize(
    ("start_m", "direction"), [(4.5, PresenceDirection.TOWARDS), (1.0, PresenceDirection.AWAY)]
)
def test_a_walker_is_where_it_is_and_goes_where_it_goes(
    start_m: float, direction: PresenceDirection, speed_mps: float
) -> None:
    """Also above 0.175 m/s, where the Doppler frequency alone is ambiguous."""
    sign = -1 if direction == PresenceDirection.TOWARDS else 1
    person = walking(start_m, start_m + sign * 3.5, speed_mps=speed_mps, enters_s=22.0)
    stream, _ = profile(room(person))
    walk_s = 3.5 / speed_mps
    checked = 0
    for time_s, message in presence_until(stream, 22 + walk_s):
        if time_s < 22:
            assert message.state != PresenceState.PRESENCE
        elif time_s > 23.2:
            truth_m = start_m + sign * speed_mps * (time_s - 22)
            assert message.state == PresenceState.PRESENCE
            assert message.distance_m == pytest.approx(truth_m, abs=2 * BIN_M)
            assert message.direction == direction
            checked += 1
    assert checked >= 2


def test_presence_ends_when_the_person_has_left() -> None:
    """The slow matrix remembers 20 s."""
    stream, _ = profile(room(standing(2.0, leaves_s=30.0)))
    heard = presence_until(stream, 60)
    assert heard[29][1].state == PresenceState.PRESENCE
    last = max(time_s for time_s, message in heard if message.state == PresenceState.PRESENCE)
    assert 30 < last < 52
    assert heard[-1][1].state == PresenceState.NO_PRESENCE


@pytest.mark.parametrize("range_m", [2.4, 4.0])
def test_people_outside_the_zone_are_not_found(range_m: float) -> None:
    stream, _ = profile(room(standing(range_m)), zone_m=(0.18 + 8 * BIN_M, 0.18 + 36 * BIN_M))
    heard = [message.state for time_s, message in presence_until(stream, 30) if time_s > 20]
    assert set(heard) == {PresenceState.NO_PRESENCE}


def test_more_sensitive_sees_weaker() -> None:
    person = standing(8.0, rcs_m2=0.15)
    seen = []
    for sensitivity in range(10):
        stream, _ = profile(room(person), sensitivity=sensitivity)
        *_, (_, last) = presence_until(stream, 22)
        seen.append(last.state == PresenceState.PRESENCE)
    assert seen == sorted(seen)
    assert not seen[0]
    assert seen[9]


def test_the_list_names_everybody_and_the_interval_they_are_in() -> None:
    # intervals of ten bins from the zone's first bin on; both stand in the middle of one
    at_m = {k: 0.18 + (4 + 10 * k + 4.5) * BIN_M for k in (2, 8)}
    people = (standing(at_m[2]), standing(at_m[8]).model_copy(update={"name": "another"}))
    stream, _ = profile(room(*people), outputs={int(OutputFeature.PRESENCE_MOVINGLIST): 1})
    messages = [message for _, message in heard_until(stream, 25 * SECOND)]
    last = messages[-1]
    assert isinstance(last, m.PresenceMovingList)
    assert sorted(last.detection_distance_m) == pytest.approx(list(at_m.values()), abs=2 * BIN_M)
    assert last.detection_rcs == last.detection_velocity == (0.0, 0.0)
    average, *intervals = last.movement_slow
    assert average == pytest.approx(math.fsum(intervals) / len(intervals))
    assert all(0 <= value <= 100 for value in (*last.movement_slow, *last.movement_fast))
    for k in at_m:
        assert intervals[k] > max(intervals[k - 1], intervals[k + 1]) + 10


def test_initialising_lists_are_empty_of_movement() -> None:
    stream, _ = profile(room(standing(2.0)), outputs={int(OutputFeature.PRESENCE_MOVINGLIST): 1})
    message = first_message(stream)
    assert isinstance(message, m.PresenceMovingList)
    assert message.state == PresenceState.INITIALIZING
    assert message.detection_distance_m == ()
    assert len(message.movement_slow) == len(message.movement_fast) == 1 + 18
    assert set(message.movement_slow) == {0.0}
