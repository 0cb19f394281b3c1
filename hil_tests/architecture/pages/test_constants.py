"""The numbers that decide in `slam/robust` have an origin, and a session stores them."""

import pytest

from hil_tests.architecture.pages.constants import Constant, groups
from slam.app.session.constants import slam_constants

ALL = {
    f"{group.title}.{constant.name}": constant for group in groups() for constant in group.constants
}


@pytest.mark.parametrize("constant", ALL.values(), ids=ALL)
def test_a_constant_has_one_origin_and_one_sentence(constant: Constant) -> None:
    assert len(constant.origins) == 1
    assert constant.sentence.endswith(".")
    assert "|" not in constant.sentence


def test_a_session_stores_every_rule() -> None:
    stored = slam_constants()
    for group in groups():
        for constant in group.constants:
            if group.title != "Settings":  # those are in the session's own table
                owner = "" if group.title == "Shared" else f"{group.title}."
                assert stored[f"slam.robust.parameters.{owner}{constant.name}"] == constant.value
