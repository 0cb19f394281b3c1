"""One damaged byte anywhere: the session opens, and `repair` says what it lost."""

import random
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from hil_tests.unit.slam.app.session.mcap_files import chunks_of, records_of
from hil_tests.unit.slam.app.sessions import SlowClock, scan, session_info, snapshot
from slam.app.session.repair import repair
from slam.app.session.writer import SessionLog
from slam.frames import RadarFrame
from slam.live.session.reader import open_session
from slam.live.session_records import LogLine
from xethru_protocol.operating_system import StopFlag

N_BINS = 16
N_SCANS = 12
INFO = replace(
    session_info(), radars=tuple(replace(radar, n_bins=N_BINS) for radar in session_info().radars)
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "session.mcap"
    log = SessionLog(path, INFO, clock_ns=SlowClock())
    for counter in range(N_SCANS):
        log.on_scan(scan(counter, n_bins=N_BINS))
        log.on_snapshot(snapshot(counter))
    log.on_log(LogLine(t_ns=9, radar="radar0", warning=False, text="the end"))
    log.close()
    return path.read_bytes()


def frames_in(path: Path) -> list[tuple[int, int]]:
    records = open_session(path).records()
    return [(one.radar, one.counter) for one in records if isinstance(one, RadarFrame)]


def flipped(content: bytes, at: int, chance: random.Random) -> bytes:
    changed = bytearray(content)
    changed[at] ^= chance.randrange(1, 256)
    return bytes(changed)


ALL_FRAMES = [(radar, counter) for counter in range(N_SCANS) for radar in (0, 1)]


def is_readable_after_repair(path: Path, *, with_rosbags: bool = True) -> list[tuple[int, int]]:
    """Return the frames that are left, read with our reader, mcap's and rosbags'."""
    out = path.with_name("repaired.mcap")
    out.unlink(missing_ok=True)
    repair(path, out, StopFlag())
    session = open_session(out)
    assert session.info.radars == INFO.radars
    assert (session.info.scene, session.info.seed) == (INFO.scene, INFO.seed)
    with out.open("rb") as stream:
        stored = [c.topic for _, c, _ in make_reader(stream, validate_crcs=True).iter_messages()]
    if with_rosbags:
        with AnyReader([out]) as reader:
            assert sum(1 for _ in reader.messages()) == len(stored)
    left = frames_in(out)
    assert sum(topic.endswith("/frame") for topic in stored) == len(left)
    return left


@pytest.mark.parametrize(
    "n_places",
    [
        12,
        pytest.param(30, marks=pytest.mark.rare),
        pytest.param(None, marks=[pytest.mark.thorough, pytest.mark.timeout(1800)]),
    ],
    ids=["few", "some", "all"],
)
def test_a_damaged_byte_in_the_head_loses_nothing(
    whole: bytes, tmp_path: Path, n_places: int | None
) -> None:
    chance = random.Random(8)
    path = tmp_path / "damaged.mcap"
    first_data = chunks_of(whole)[2]
    places = list(range(first_data))
    if n_places is not None:  # most of them where a record begins
        heads = [at + k for _, at in records_of(whole) for k in range(40) if at + k < first_data]
        places = [*range(8), *chance.sample(heads, n_places), *chance.sample(places, n_places // 2)]
    for at in places:
        path.write_bytes(flipped(whole, at, chance))
        left = is_readable_after_repair(path, with_rosbags=at % 8 == 0)
        assert left == ALL_FRAMES, at


@pytest.mark.rare
def test_a_head_with_damage_needs_no_repair(whole: bytes, tmp_path: Path) -> None:
    """The second copy follows the first at once, so what lies before it is not lost."""
    chance = random.Random(9)
    path = tmp_path / "damaged.mcap"
    first, second, *_ = chunks_of(whole)
    for at in [*range(0, first + 60, 3), *range(first + 60, second, 97)]:
        path.write_bytes(flipped(whole, at, chance))
        assert open_session(path).info.radars == INFO.radars
        assert frames_in(path) == ALL_FRAMES, at


@pytest.mark.parametrize(
    "n_places",
    [8, pytest.param(25, marks=pytest.mark.rare), pytest.param(60, marks=pytest.mark.thorough)],
)
def test_a_damaged_byte_anywhere_costs_one_chunk_at_most(
    whole: bytes, tmp_path: Path, n_places: int
) -> None:
    chance = random.Random(10)
    path = tmp_path / "damaged.mcap"
    for _ in range(n_places):
        at = chance.randrange(len(whole))
        path.write_bytes(flipped(whole, at, chance))
        assert len(is_readable_after_repair(path)) >= len(ALL_FRAMES) - 8, at


@pytest.mark.parametrize("share", [0.3, pytest.param(0.8, marks=pytest.mark.rare)])
def test_a_killed_run_can_be_damaged_too(whole: bytes, tmp_path: Path, share: float) -> None:
    chance = random.Random(11)
    path = tmp_path / "damaged.mcap"
    chunks = chunks_of(whole)
    cut = whole[: chunks[int(len(chunks) * share)] + 40]
    path.write_bytes(cut)
    kept = frames_in(path)
    for at in range(0, chunks[2], 1501):
        path.write_bytes(flipped(cut, at, chance))
        assert is_readable_after_repair(path) == kept


def test_a_head_that_is_gone_altogether_is_found_behind_it(whole: bytes, tmp_path: Path) -> None:
    """A lost block of a disk is longer than a copy; others lie all over the file."""
    path = tmp_path / "damaged.mcap"
    third = chunks_of(whole)[2]
    path.write_bytes(whole[:8] + bytes(third - 8 + 100) + whole[third + 100 :])
    assert open_session(path).info.radars == INFO.radars
    left = is_readable_after_repair(path)
    assert left == ALL_FRAMES[-len(left) :]
    assert len(left) >= len(ALL_FRAMES) - 8
