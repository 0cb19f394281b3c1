"""The emulator answers as modules do: side by side with one, and from what one once answered.

``--hil-diff`` asks a radar and the emulator the same questions and compares their answers, and
``--hil-cassette FILE`` writes them down; each file in ``fixtures/cassettes`` binds the emulator.
"""

import datetime
from pathlib import Path

import pytest

from hil_tests.plugin.cassette import EMULATED, Cassette, ask_all, differences
from hil_tests.plugin.findings import Measure
from hil_tests.plugin.options import CHOICES
from hil_tests.plugin.radar_specs import parse_specs
from hil_tests.plugin.radar_targets import target_of
from hil_tests.plugin.requirements import leave_out
from hil_tests.plugin.session_radars import RadarUnderTest


def emulator() -> RadarUnderTest:
    radar = RadarUnderTest(target_of(parse_specs(["emu"])[0]))
    radar.begin_test()
    return radar


@pytest.mark.requires("settings", "profiles", "files")
def test_every_answer_is_the_emulators(
    request: pytest.FixtureRequest, radar_place: RadarUnderTest, measure: Measure
) -> None:
    if not request.config.getoption("hil_diff"):
        leave_out(request, f"{radar_place.spec.name}: asked and compared only with --hil-diff")
    questions = Cassette.read(EMULATED).exchanges
    answers = ask_all(radar_place.take_line(), radar_place.place.clock_ns, questions)
    cassette = request.config.stash[CHOICES].cassette
    if cassette is not None:
        recorded = {
            "identity": radar_place.identity,
            "reached": radar_place.place.description,
            "real_module": "hardware" in radar_place.place.capabilities,  # as the user says
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        }
        Cassette(recorded=recorded, exchanges=answers).write(cassette)
    emulated = emulator()
    expected = ask_all(emulated.take_line(), emulated.place.clock_ns, questions)
    found = differences(answers, expected)
    measure("answers_compared", len(answers))
    measure("answers_that_differ", len(found))
    assert not found, "\n".join(found)


@pytest.mark.parametrize("path", sorted(EMULATED.parent.glob("*.json")), ids=lambda path: path.stem)
def test_the_emulator_answers_as_the_cassette(path: Path) -> None:
    """Offline: the answers of each cassette come again.

    The shipped one is the emulator's own, which guards against change and proves no likeness.
    """
    cassette = Cassette.read(path)
    emulated = emulator()
    now = ask_all(emulated.take_line(), emulated.place.clock_ns, cassette.exchanges)
    found = differences(cassette.exchanges, now)
    assert not found, "\n".join(found)
