"""One flipped bit anywhere costs the record or the chunk that it is in, in every format."""

import random
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil_tests.unit.xethru_protocol.recordings.messages import (
    META,
    MS,
    presence,
    write_capture,
    write_recording,
)
from xethru_protocol.recordings import (
    RecordingError,
    RecordingFacts,
    RecordingFault,
    convert,
    load,
    read_recording,
)
from xethru_protocol.recordings.mcap import McapWriter, RadarTopics, write_mcap
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import encode

N_MESSAGES = 24
IN_CHUNK = 4
FRAMES: list[tuple[m.Response, int | None]] = [
    (m.DataFloat(info=counter + 1, values=values), (counter * 100 + 1000) * MS)
    for counter, values in enumerate(
        np.random.default_rng(3).normal(size=(N_MESSAGES, 50)).astype(np.float32)
    )
]


def _without_index(path: Path) -> None:
    write_recording(path, FRAMES)
    (path / META).unlink()


def _text(path: Path) -> None:
    write_recording(path, ((presence(counter), counter * 10**9) for counter in range(N_MESSAGES)))


def _mcap(path: Path) -> None:
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        radar = RadarTopics(writer)
        for number, (message, t_ns) in enumerate(FRAMES, start=1):
            radar.write(message, t_ns)
            if number % IN_CHUNK == 0:
                writer.end_chunk()
        writer.finish()


# how each is written, and how many messages a flipped bit may cost
WRITTEN: dict[str, tuple[Callable[[Path], None], int]] = {
    "vendor": (lambda path: write_recording(path, FRAMES), 1),
    "without_index": (_without_index, 2),
    "text": (_text, 2),  # it may join two lines
    "a.xtwire": (lambda path: write_capture(path, FRAMES), 1),
    "a.mcap": (_mcap, IN_CHUNK),
}


def _payloads(path: Path) -> tuple[Counter[bytes], list[RecordingFault]]:
    faults: list[RecordingFault] = []
    return Counter(
        encode(message, bulk=True) for message, _ in read_recording(path, faults.append)
    ), faults


@pytest.mark.parametrize(
    "n_places",
    [60, pytest.param(None, marks=[pytest.mark.thorough, pytest.mark.timeout(1800)])],
    ids=["some", "all"],
)
@pytest.mark.parametrize("name", WRITTEN)
def test_a_flipped_bit_costs_the_record_it_is_in(
    name: str, n_places: int | None, tmp_path: Path
) -> None:
    write, most = WRITTEN[name]
    path = tmp_path / name
    write(path)
    whole, _ = _payloads(path)
    assert whole.total() == N_MESSAGES
    chance = random.Random(35)
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        data = file.read_bytes()
        places = range(len(data))
        for at in places if n_places is None else sorted(chance.sample(places, n_places)):
            if name == "a.xtwire" and 8 <= at < 12:
                continue  # another version of the format is refused
            damaged = bytearray(data)
            damaged[at] ^= 1 << chance.randrange(8)
            file.write_bytes(damaged)
            found, faults = _payloads(path)
            lost = whole - found
            assert lost.total() <= most, (file.name, at, faults)
            assert faults or found.total() == N_MESSAGES, (file.name, at)
        file.write_bytes(data)


@pytest.mark.parametrize("target", ["copy", "b.mcap", "b.xtwire", "b.npz", "b.csv"])
def test_what_is_whole_behind_damage_is_loaded_and_converted(target: str, tmp_path: Path) -> None:
    """The second of six chunks is damaged: its four frames are missing, the others are there."""
    path = tmp_path / "a.mcap"
    _mcap(path)
    data = bytearray(path.read_bytes())
    places = [at for at in range(len(data)) if data[at : at + 8] == b"\x04\0\0\0zstd"]
    data[places[1] + 200] ^= 4
    path.write_bytes(data)
    left = [n for n in range(1, N_MESSAGES + 1) if not IN_CHUNK < n <= 2 * IN_CHUNK]
    faults: list[RecordingFault] = []
    counter = load(path, faults.append, downconversion=False).radar.counter
    assert counter is not None
    assert counter.tolist() == left
    assert len(faults) == 1
    with pytest.raises(RecordingError, match="checksum"):
        list(read_recording(path))
    done = convert(path, tmp_path / target, downconversion=False)
    assert (done.messages, len(done.faults)) == (len(left), 1)
    again = load(tmp_path / target, downconversion=False).radar.counter
    assert again is not None
    assert again.tolist() == left


def test_a_damaged_first_chunk_does_not_hide_the_others(tmp_path: Path) -> None:
    """It names schemas and channels; the index behind the data names them, too."""
    path = tmp_path / "a.mcap"
    _mcap(path)
    data = bytearray(path.read_bytes())
    data[data.index(b"\x04\0\0\0zstd") + 200] ^= 4
    path.write_bytes(data)
    found, faults = _payloads(path)
    assert found.total() == N_MESSAGES - IN_CHUNK
    assert len(faults) == 1


def test_a_message_of_mcap_that_makes_no_sense_costs_itself(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        radar = RadarTopics(writer)
        radar.write(*FRAMES[0])
        writer.add_message(2, 7, b"\0\1\0\0", 7)  # an array without its count
        radar.write(*FRAMES[1])
        writer.finish()
    found, faults = _payloads(path)
    assert found.total() == 2
    assert len(faults) == 1


def test_lines_of_an_array_file_that_are_damaged_are_left_out(tmp_path: Path) -> None:
    path, copy = tmp_path / "a.csv", tmp_path / "copy.csv"
    write_mcap(tmp_path / "a.mcap", FRAMES, RecordingFacts())
    convert(tmp_path / "a.mcap", path, downconversion=False)
    lines = path.read_bytes().splitlines(keepends=True)
    lines[3] = lines[3].replace(b",", b'"', 1)
    lines[5] = b"\xff" + lines[5]
    lines[7] = lines[7][:-3] + b"x" + lines[7][-2:]
    copy.write_bytes(b"".join(lines))
    faults: list[RecordingFault] = []
    counter = load(copy, faults.append).radar.counter
    assert counter is not None
    assert counter.tolist() == [n for n in range(1, N_MESSAGES + 1) if n not in (3, 5, 7)]
    assert [fault.minor for fault in faults] == [False] * 3
    with pytest.raises(RecordingError, match="line 4"):
        _ = load(copy).radar.counter
    shutil.copy(path, copy)
    assert load(copy).radar.n_frames == N_MESSAGES
