"""The numbers that decide in `slam/robust` have an origin, are on one page, and get no more."""

import pytest

from hil_tests.architecture.pages.constants import PAGE, Constant, counts, groups, page
from slam.app.session.constants import slam_constants
from slam.config import Origin

# How many constants there are of each origin. A number may fall, or a constant move to another
# origin because it was measured or derived; their sum does not rise. The goal is 45, 12 of them
# chosen.
COUNTS = {
    Origin.DATA_SHEET: 2,
    Origin.QUANTILE: 9,
    Origin.BUDGET: 27,
    Origin.CHOSEN: 72,
}

# Modules of slam/robust and the numbers in them that are no constants by the definition at the top
# of slam/robust/parameters.py.
DECIDE_NOTHING = {
    "pipeline": "_NS_PER_S _STILL_M _STILL_RAD",
    "association": "LONGEST_M _LEAST_RANGE_M",
    "back_end": "_CARRIED_M _CARRIED_RAD _FREE_M _FREE_RAD _ANYWHERE_M2",
    "branches": "_IDS_APART",
    "proposals.constellation": "_STEPS _LEAST_CHANGE _VARIANCE_FLOOR_M2",
    "initialisation": "_FORBIDDEN _LEAST_WAY_M _KNOWN_SHARE SEEN _FEWEST_SLOTS _STEPS "
    "_DAMPING _LEAST_SHARE _LEAST_DECREASE _FLOOR",
    "kernels": "_LEAST_ENTRY",
    "map": "MERGE_SIGMA_M _FLOOR",
    "solver.beacons": "_ANYWHERE_M2 _STEPS _DAMPING _LEAST_M",
    "solver.revision": "_SIGMA_PER_MEDIAN _LEAST_SHARE _MOST_SHARE _UNKNOWN _ALONE_STEPS _BEGINS "
    "_LEAST_VARIANCE_M2",
    "solver.run_log": "_LEAST_SIGMA _POSE_SIGMA _LEAST_WAY_M _ANYWHERE_M",
    "solver.smoother": "POSE CALIBRATION _LEAST_WALK_SHARE _TOLERANCE _ROUNDING _GROUPS _HALVINGS "
    "_SETTLED_SHARE _LEAST_RANGE_M _LEAST_RANGE_M2 _TINY",
    "state": "HEADING POSITION CALIBRATION HEAD_SIZE _PROMPT_SIZE _MOST_GRAMS _MOST_PAIRS _SPARE "
    "_ODD _SMALL_RAD",
}

ALL = {
    f"{group.title}.{constant.name}": constant for group in groups() for constant in group.constants
}


@pytest.mark.skipif(not PAGE.exists(), reason="docs are in the source tree")
def test_the_page_is_that_of_the_source() -> None:
    """Else: python -m hil_tests.architecture.pages.constants."""
    assert PAGE.read_text() == page()


@pytest.mark.parametrize("constant", ALL.values(), ids=ALL)
def test_a_constant_has_one_origin_and_one_sentence(constant: Constant) -> None:
    assert len(constant.origins) == 1
    assert constant.sentence.endswith(".")
    assert "|" not in constant.sentence


def test_there_are_no_more_constants_than_before() -> None:
    assert counts() == COUNTS


def test_no_number_of_the_back_end_decides_beside_the_table() -> None:
    """Defaults of a run's own data, such as a score that begins at zero, are no constants."""
    beside = {
        name.removeprefix("slam.robust.")
        for name in slam_constants()
        if name.startswith("slam.robust.") and not name.startswith("slam.robust.parameters.")
    }
    of_modules = {name for name in beside if name.rpartition(".")[0] in DECIDE_NOTHING}
    of_data = {name for name in beside - of_modules if name.split(".")[-2].lstrip("_")[0].isupper()}
    assert of_modules == {
        f"{module}.{name}" for module, names in DECIDE_NOTHING.items() for name in names.split()
    }
    assert beside == of_modules | of_data


def test_a_session_stores_every_rule() -> None:
    stored = slam_constants()
    for group in groups():
        for constant in group.constants:
            if group.title != "Settings":  # those are in the session's own table
                owner = "" if group.title == "Shared" else f"{group.title}."
                assert stored[f"slam.robust.parameters.{owner}{constant.name}"] == constant.value
