"""Shifts, turns, sway and posture of people, things that swing, and the truth about them."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from emulator.echo.paths import direct_reflections, viewpoint
from emulator.echo.people import people_truth, person_scatterer
from emulator.scene.motion import MoverSpec
from emulator.scene.people import PersonSpec, SleepDepth, facing_cosines, moves, positions_m
from emulator.scene.scene import load_scene
from hil_tests.unit.emulator.rooms import heard, radar_at, room

SECOND = 1_000_000_000
FORWARD = radar_at(0, 0, 0)
SEAT = (2.0, 0.0)
BED = {"posture": "supine", "sleep": {"turns_per_hour": 30.0}}
DOWN = math.sqrt(0.5)


def person(**changes: Any) -> PersonSpec:  # noqa: ANN401 - any field
    return PersonSpec.model_validate({"name": "somebody", "waypoints_m": (SEAT,)} | changes)


def every(step_s: float, until_s: float) -> NDArray[np.int64]:
    return np.arange(0, round(until_s * SECOND), round(step_s * SECOND), dtype=np.int64)


def parabola(shares: tuple[float, float, float], cosine: float) -> float:
    """Return the parabola through shares at the cosines 1, 0 and -1, as NumPy fits it."""
    return float(np.polyval(np.polyfit([1.0, 0.0, -1.0], shares, 2), cosine))


@pytest.mark.parametrize(
    ("changes", "cosine"),
    [
        ({"facing_deg": 180.0}, 1.0),
        ({"facing_deg": 90.0}, 0.0),
        ({"facing_deg": 0.0}, -1.0),
        ({"facing_deg": 120.0}, 0.5),
        ({"posture": "supine"}, DOWN),
        ({"posture": "prone", "facing_deg": 33.0}, -DOWN),
        ({"posture": "side"}, DOWN),
        ({"posture": "side", "facing_deg": 0.0}, -DOWN),
    ],
    ids=str,
)
def test_a_posture_changes_chest_and_cross_section(changes: dict[str, Any], cosine: float) -> None:
    """Seen from the origin at 2 m: 1, 0.4, 0.25 of 4 mm, and 1, 0.25, 2 of 1 m**2."""
    t_ns = every(0.1, 4.0)
    view = viewpoint(FORWARD, np.zeros((len(t_ns), 3)))
    echo = direct_reflections(person_scatterer(person(**changes), t_ns, view), view)
    chest_m = 0.004 * parabola((1, 0.4, 0.25), cosine) * np.sin(math.tau * t_ns / SECOND / 4)
    assert echo.range_m[:, 0] == pytest.approx(2.0 - chest_m)
    amplitude = 0.06 / 4 * math.sqrt(parabola((1, 0.25, 2), cosine))
    assert echo.amplitude[:, 0] == pytest.approx(np.full(len(t_ns), amplitude))


def test_radars_see_different_sides() -> None:
    """One in front of the chest, one behind it; whoever faces nobody in particular faces both."""
    front, behind = radar_at(0, 0, 0, name="a"), radar_at(4, 0, 180, name="b", serial="0" * 12)
    scene = room(front, people=(person(facing_deg=180.0),))
    scene = scene.model_copy(update={"radars": (front, behind)})
    (truth,) = people_truth(scene, every(0.1, 4.0))
    assert truth.distance_m[0].tolist() == [2.0, 2.0]
    assert truth.towards_m[:, 1] == pytest.approx(0.25 * truth.towards_m[:, 0])
    assert truth.towards_m[:, 0] == pytest.approx(truth.chest_m)


def test_a_body_shifts_within_its_disc_at_random_times() -> None:
    """A shift of 2 s, then an exponential time of mean 10 s: one in 12 s, within 4 sigma."""
    shifts = {"per_min": 6.0, "size_m": 0.08, "takes_s": 2.0}
    sits = person(shifts=shifts)
    hours = 20
    t_ns = every(0.1, hours * 3600.0)
    away_m = positions_m(sits, t_ns, 3) - SEAT
    assert np.hypot(*away_m.T).max() <= 0.04 + 1e-12
    moving = moves(sits, t_ns, 3)
    begins = np.flatnonzero(moving[1:] & ~moving[:-1])
    expected = hours * 3600 / 12
    assert len(begins) == pytest.approx(expected, abs=4 * math.sqrt(expected) * 10 / 12 + 60)
    assert moving.mean() == pytest.approx(2 / 12, abs=0.01)
    waits_s = np.diff(begins) / 10 - 2
    assert waits_s.std() == pytest.approx(waits_s.mean(), rel=0.1)  # as of an exponential law
    steps_m = np.hypot(*np.diff(away_m, axis=0).T)
    assert steps_m[~(moving[1:] | moving[:-1])].max() == 0
    assert steps_m.max() <= 0.08 * 1.5 / 2 * 0.1 + 1e-12  # the steepest of a cubic
    # evenly in the disc: mean square distance from the middle is half of the radius squared
    rests_m = away_m[begins]
    assert (rests_m**2).sum(axis=1).mean() == pytest.approx(0.04**2 / 2, rel=0.05)


def test_motion_belongs_to_seed_and_name_and_a_time_has_one_answer() -> None:
    spec = person(shifts={"per_min": 3.0})
    t_ns = every(11.7, 20_000.0)
    places = positions_m(spec, t_ns, 4)
    alone = [positions_m(spec, t_ns[n : n + 1], 4)[0] for n in range(len(t_ns) - 1, -1, -1)]
    assert places[::-1].tobytes() == np.array(alone).tobytes()
    assert np.abs(positions_m(spec, t_ns, 5) - places).max() > 0.01
    other = person(name="another", shifts={"per_min": 3.0})
    assert np.abs(positions_m(other, t_ns, 4) - places).max() > 0.01


def test_sway_is_small_and_about_the_place() -> None:
    away_m = positions_m(person(sway_m=0.01), every(0.1, 3600.0)) - SEAT
    assert 0.006 < np.abs(away_m).max() <= 0.01
    assert np.abs(away_m.mean(axis=0)).max() < 1e-4
    assert not moves(person(sway_m=0.01), every(1.0, 60.0)).any()


def test_a_sleeper_turns_over_as_people_do() -> None:
    """54.7 % side, 37.9 % back, 7.4 % front of 60 000 s with 30 turns an hour, within 4 sigma."""
    t_ns = every(1.0, 600_000.0)
    sleeper = person(**BED, facing_deg=180.0)
    turning = moves(sleeper, t_ns)
    turns = np.count_nonzero(turning[1:] & ~turning[:-1])
    expected = 600_000 / (120 + 4)
    assert turns == pytest.approx(expected, abs=4 * math.sqrt(expected))
    away_m = positions_m(sleeper, t_ns) - SEAT
    assert np.hypot(*away_m.T).max() <= 0.1 + 1e-12
    # it lies across the line of sight: a side shows 90 degrees, back and front 45 and 135
    across = np.broadcast_to([-1000.0, 0.0], (len(t_ns), 2))
    cosines = facing_cosines(person(**BED, facing_deg=90.0), t_ns, across)
    assert cosines is not None
    rest = cosines[~turning]
    shares = [np.mean(np.abs(rest - cosine) < 1e-3) for cosine in (0.0, DOWN, -DOWN)]
    for share, probability in zip(shares, (0.547, 0.379, 0.074), strict=True):
        sigma = math.sqrt(2 * probability * (1 - probability) / expected)
        assert share == pytest.approx(probability, abs=4 * sigma)
    assert sum(shares) == pytest.approx(1.0, abs=1e-3)


def test_the_echo_of_a_mover() -> None:
    """A fan at 5 blades a second swings along x: a quarter and three quarters of its period."""
    fan = MoverSpec(
        name="fan", x_m=2.0, y_m=0.0, rate_hz=5.0, swing_m=0.01, amplitude_1m=0.04, fading=0.5
    )
    for t_s, out_m, factor in ((0.0, 0.0, 1.5), (0.05, 0.01, 1.0), (0.1, 0.0, 0.5)):
        echo = heard(FORWARD, t_ns=round(t_s * SECOND), movers=(fan,))
        assert echo.range_m == pytest.approx([2.0 + out_m])
        assert echo.amplitude == pytest.approx([0.04 * factor / (2.0 + out_m) ** 2])
    across = fan.model_copy(update={"direction_deg": 90.0})
    (range_m,) = heard(FORWARD, t_ns=50_000_000, movers=(across,)).range_m
    assert range_m == pytest.approx(math.hypot(2.0, 0.01))


def test_the_truth_of_the_shipped_scenes() -> None:
    t_ns = np.array([100, 3000], dtype=np.int64) * SECOND
    (sleeper,) = people_truth(load_scene("sleeper"), t_ns)
    assert sleeper.sleep_stage.tolist() == [SleepDepth.AWAKE, SleepDepth.DEEP]
    assert sleeper.distance_m[:, 0] == pytest.approx([1.6, 1.6], abs=0.1)
    near, far = people_truth(load_scene("two_people"), t_ns)
    assert near.distance_m[0] == pytest.approx([math.hypot(1.2, 0.1), math.hypot(1.2, 0.3)])
    assert far.breaths_per_min == pytest.approx([18.0, 18.0], rel=0.05)
    (worker,) = people_truth(load_scene("desk"), t_ns)
    assert worker.name == "worker"
    assert [radar.model for radar in load_scene("two_people").radars] == ["x4m200", "x4m300"]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"apnoea": {"every_s": 20.0, "lasts_s": 20.0}}, "lasts_s: must be less than every_s"),
        ({"posture": "side", "sway_m": 0.01}, "posture: who lies has one waypoint and no sway_m"),
        ({"posture": "prone", "waypoints_m": (SEAT, (1.0, 0.0))}, "who lies has one waypoint"),
        ({"breath_pattern": "square"}, "'sine' or 'realistic'"),
        ({"rate_wander": 0.6}, "less than or equal to 0.5"),
        ({"shifts": {"often": 3.0}}, "Extra inputs"),
        ({"heart_amplitude_m": 0.01}, "less than or equal to 0.002"),
        ({"waypoints_m": ()}, "at least 1 item"),
        ({"walk": "run"}, "'once', 'to_and_fro' or 'round'"),
        ({"speed_mps": 0.0}, "greater than or equal to 0.001"),
        ({"speed_mps": math.inf}, "must be a finite number"),
        ({"rcs_m2": 0.0}, "greater than 0"),
    ],
)
def test_a_bad_person_is_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValidationError, match="1 validation error") as caught:
        person(**changes)
    assert reason in str(caught.value)
