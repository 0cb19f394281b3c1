"""A second day in emulated rooms: on the map within 10 mm, or lost, and never sure and wrong."""

import pytest

from hil_tests.bench.second_day import PRESET, mapped, second_day
from slam.app.sweep.run import make_case

pytestmark = [pytest.mark.slow, pytest.mark.rare]


def test_in_the_lab_the_place_is_found_and_right_to_a_centimetre() -> None:
    case = make_case("lab", PRESET, 0, laps=1)
    day = second_day(case.scene, case.config, mapped(case.scene, case.config, 3), 3)
    assert day.found.error_rmse_m is not None
    assert day.found.error_rmse_m <= 0.010
    assert day.wrong_share == 0.0
    assert day.found.found_after_m is not None
    assert day.three_seen_m is not None
    assert day.found.found_after_m - day.three_seen_m <= 1.0
    assert len(day.found.gone) == 2  # those that moved


def test_among_equal_racks_the_robot_says_that_it_does_not_know() -> None:
    case = make_case("rack:3", PRESET, 0, laps=1)
    day = second_day(case.scene, case.config, mapped(case.scene, case.config, 0), 0)
    assert day.wrong_share == 0.0
