"""What is written is read, in every format; a cut anywhere leaves a prefix and one fault."""

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hil_tests.property.examples import examples
from hil_tests.property.message_strategies import messages, of_type
from hil_tests.unit.xethru_protocol.recordings.messages import (
    MS,
    presence,
    write_capture,
    write_recording,
)
from xethru_protocol.recordings import (
    RecordingError,
    RecordingFacts,
    RecordingFault,
    RecordingReader,
    Split,
    convert,
    read_recording,
)
from xethru_protocol.recordings.mcap import read_mcap, write_mcap
from xethru_protocol.recordings.vendor.layouts import KINDS
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import encode
from xethru_protocol.wire.table import RESPONSES

STORED = [kind.message for kind in KINDS]
"""Message types that the vendor's format has a place for."""
TIMES_MS = st.integers(0, 2**31)


def payloads(timed: list[tuple[m.Response, int | None]]) -> list[tuple[bytes, int | None]]:
    """Compare by bytes: unlike floats, they tell NaN from NaN and 0 from -0."""
    return [(encode(message, bulk=True), t_ns) for message, t_ns in timed]


@st.composite
def stored_messages(draw: st.DrawFn) -> list[tuple[m.Response, int | None]]:
    """Messages of any kinds the vendor's format has, with times that never decrease.

    RESP_STATUS has counter 0: the format does not store it.
    """
    kinds = draw(st.lists(st.sampled_from(STORED), max_size=8))
    times = sorted(draw(st.lists(TIMES_MS, min_size=len(kinds), max_size=len(kinds))))
    drawn = [draw(of_type(kind)) for kind in kinds]
    kept = [replace(one, counter=0) if isinstance(one, m.RespStatus) else one for one in drawn]
    return [(message, time * MS) for message, time in zip(kept, times, strict=True)]


@settings(deadline=None, max_examples=examples(40, 80))
@given(
    timed=stored_messages(),
    limit=st.none() | st.integers(1, 3),
    header=st.binary(max_size=5),
)
def test_vendor_directories_give_back_what_was_written(
    timed: list[tuple[m.Response, int | None]], limit: int | None, header: bytes
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording"
        write_recording(path, timed, user_header=header, split=Split(records=limit))
        if timed:
            assert payloads(list(read_recording(path))) == payloads(timed)


@settings(deadline=None, max_examples=examples(30, 60))
@given(
    timed=stored_messages(),
    files=st.none() | st.integers(1, 3),
    directories=st.none() | st.integers(1, 3),
    header=st.binary(max_size=5),
    data=st.data(),
)
def test_single_records_are_those_of_the_stream(
    timed: list[tuple[m.Response, int | None]],
    files: int | None,
    directories: int | None,
    header: bytes,
    data: st.DataObject,
) -> None:
    """Seeks against a search through all records."""
    if not timed:
        return
    with tempfile.TemporaryDirectory() as folder:
        write_recording(
            Path(folder),
            timed,
            user_header=header,
            split=Split(records=files),
            split_directories=None if directories is None else Split(records=directories),
        )
        with RecordingReader(folder) as reader:
            records = list(reader)
            found = [(record.message, record.t_ns) for record in records]
            assert payloads(list(found)) == payloads(timed)
            assert payloads(list(read_recording(folder))) == payloads(timed)
            assert reader.duration_ns == records[-1].t_ns - records[0].t_ns
            position_ms = data.draw(st.integers(0, reader.duration_ns // MS))
            reader.seek_ms(position_ms)
            later = [one for one in records if one.t_ns >= reader.start_ns + position_ms * MS]
            assert reader.peek().position == later[0].position
            position = data.draw(st.integers(0, reader.size_bytes))
            reader.seek_byte(position)
            behind = [one for one in records if one.position + len(one.data) > position]
            assert reader.at_end == (not behind)
            wanted = type(data.draw(st.sampled_from(timed))[0])
            reader.set_filter(wanted)
            assert [one.position for one in reader] == [
                one.position for one in behind if isinstance(one.message, wanted)
            ]


def test_every_stored_kind_is_a_response_of_the_table() -> None:
    assert len(set(STORED)) == len(KINDS)
    assert set(STORED) <= set(RESPONSES.types.values())
    assert len({kind.data_type for kind in KINDS}) == len(KINDS)


@st.composite
def timed_messages(draw: st.DrawFn) -> list[tuple[m.Response, int | None]]:
    """Messages of any kind with times that never decrease; some have none."""
    drawn = draw(st.lists(messages(m.Response), max_size=6))
    times = draw(st.lists(st.integers(0, 2**62), min_size=len(drawn), max_size=len(drawn)))
    stamps = [t_ns if draw(st.booleans()) else None for t_ns in sorted(times)]
    return list(zip(drawn, stamps, strict=True))


@settings(deadline=None, max_examples=examples(30, 60))
@given(timed_messages())
def test_mcap_and_captures_give_back_what_was_written(
    timed: list[tuple[m.Response, int | None]],
) -> None:
    facts = RecordingFacts(session_id="s", user_header=b"\xff")
    with tempfile.TemporaryDirectory() as folder:
        write_mcap(Path(folder) / "x.mcap", timed, facts)
        if timed:
            assert payloads(list(read_mcap(Path(folder) / "x.mcap", None))) == payloads(timed)
        write_capture(Path(folder) / "x.xtwire", timed)
        assert payloads(list(read_recording(Path(folder) / "x.xtwire"))) == payloads(timed)


@cache
def _examples() -> dict[str, tuple[dict[str, bytes], list[tuple[bytes, int | None]]]]:
    """One small recording in each format that can be cut: its files, and its messages."""
    timed: list[tuple[m.Response, int | None]] = []
    for counter in range(4):
        values = np.arange(counter + 1, dtype=np.float32)
        timed.append((m.DataFloat(info=counter, values=values), (2 * counter + 1) * MS))
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        write_recording(root / "vendor", timed)
        write_recording(root / "csv", [(presence(at), at * MS) for at in range(4)])
        write_capture(root / "x.xtwire", timed)
        convert(root / "vendor", root / "x.mcap")
        found = {}
        for name in ("vendor", "csv", "x.xtwire", "x.mcap"):
            path = root / name
            files = path.iterdir() if path.is_dir() else [path]
            contents = {str(file.relative_to(root)): file.read_bytes() for file in files}
            found[name] = contents, payloads(list(read_recording(path)))
    return found


@pytest.mark.parametrize("name", ["vendor", "csv", "x.xtwire", "x.mcap"])
def test_a_cut_anywhere_leaves_a_prefix_and_at_most_one_fault(name: str, tmp_path: Path) -> None:
    contents, whole = _examples()[name]
    for file, data in contents.items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_bytes(data)
    for file, data in contents.items():
        if file.endswith("meta.dat"):
            continue  # below
        step = 1 if len(data) < 500 else 7  # MCAP's own head and index are long
        for at in range(0, len(data), step):
            (tmp_path / file).write_bytes(data[:at])
            faults: list[RecordingFault] = []
            found, error = _read(tmp_path / name, faults)
            assert found == whole[: len(found)], (file, at)
            assert len(faults) + len(error) <= 1, (file, at, faults, error)
            if found != whole and at not in _chunk_ends(data):
                assert faults or error, (file, at)


def _chunk_ends(data: bytes) -> set[int]:
    """Where a wire capture may end without anybody seeing that it was longer."""
    if not data.startswith(b"\x89XTWIRE"):
        return set()
    ends = {16 + int.from_bytes(data[12:16], "little")}
    while (last := max(ends)) < len(data):
        ends.add(last + 13 + int.from_bytes(data[last + 9 : last + 13], "little"))
    return ends


def _read(
    path: Path, faults: list[RecordingFault]
) -> tuple[list[tuple[bytes, int | None]], list[str]]:
    found: list[tuple[m.Response, int | None]] = []
    try:
        for timed in read_recording(path, faults.append):
            found.append(timed)  # noqa: PERF402 - what came before an error counts
    except RecordingError as error:
        return payloads(found), [str(error)]
    return payloads(found), []


@settings(deadline=None, max_examples=examples(40, 120))
@given(at=st.integers(0, 2**16), to=st.binary(min_size=1, max_size=8), cut=st.booleans())
@example(at=0x1D, to=b"\xff" * 8, cut=False)
@example(at=0x55, to=b"\xff" * 4, cut=False)
def test_a_damaged_meta_never_costs_a_message(at: int, to: bytes, cut: bool) -> None:
    contents, whole = _examples()["vendor"]
    with tempfile.TemporaryDirectory() as folder:
        for name, data in contents.items():
            path = Path(folder) / name
            path.parent.mkdir(exist_ok=True)
            if name.endswith("meta.dat"):
                at %= len(data)
                data = data[:at] if cut else (data[:at] + to + data[at + len(to) :])
            path.write_bytes(data)
        found, error = _read(Path(folder) / "vendor", [])
    assert error == []
    assert [payload for payload, _ in found] == [payload for payload, _ in whole]
