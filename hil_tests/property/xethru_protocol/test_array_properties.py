"""Frames as arrays: files give back every bit, blocks are the whole, layouts are kept apart."""

import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from hil_tests.property.examples import examples
from hil_tests.unit.xethru_protocol.recordings.messages import write_capture
from xethru_protocol import load
from xethru_protocol.recordings.array_files import (
    FrameKind,
    Frames,
    read_array_file,
    write_array_file,
)
from xethru_protocol.wire import messages as m

# a NaN has one text: its sign and payload bits are lost in .csv
FLOATS = st.floats(width=32, allow_nan=False) | st.just(float("nan"))


@st.composite
def known_frames(draw: st.DrawFn) -> tuple[Frames, npt.NDArray[np.generic]]:
    """Frames whose ranges, times and counters are known or not, and their samples."""
    n_frames, n_bins = draw(st.integers(1, 5)), draw(st.integers(1, 4))
    kind: FrameKind = draw(st.sampled_from(("rf", "iq")))
    width = n_bins * (2 if kind == "iq" else 1)
    values = draw(arrays.arrays(np.float32, (n_frames, width), elements=FLOATS))
    samples = values.view(np.complex64) if kind == "iq" else values
    counter = draw(st.none() | arrays.arrays(np.uint32, n_frames))
    t_ns = draw(st.none() | arrays.arrays(np.int64, n_frames).map(np.sort))
    ranges_m = draw(
        st.none()
        | arrays.arrays(np.float64, n_bins, elements=st.floats(-100, 100, allow_subnormal=False))
    )
    at = draw(st.integers(0, n_frames))
    return Frames(
        about="drawn",
        kind=kind,
        chunks=lambda: iter([samples[:at], samples[at:]]),
        n_frames=n_frames,
        n_bins=n_bins,
        counter=counter,
        t_ns=t_ns,
        ranges_m=ranges_m,
        frame_rate_hz=None,
        settings={},
    ), samples


@pytest.mark.parametrize("suffix", [".csv", ".mat", ".npz"])
@settings(deadline=None, max_examples=examples(50))
@given(drawn=known_frames())
def test_files_of_arrays_give_back_what_was_written(
    suffix: str, drawn: tuple[Frames, npt.NDArray[np.generic]]
) -> None:
    frames, samples = drawn
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        write_array_file(path, frames)
        found = read_array_file(path)
        read = np.concatenate(list(found.chunks()))
    assert found.kind == frames.kind
    assert read.tobytes() == samples.tobytes()
    for name in ("counter", "t_ns", "ranges_m"):
        before, after = getattr(frames, name), getattr(found, name)
        assert (before is None) == (after is None)
        if before is not None and (name, suffix) == ("ranges_m", ".csv"):
            assert np.abs(after - before).max() <= 0.5001e-6, "titles have micrometres"
        elif before is not None:
            assert after.tobytes() == before.tobytes()


@settings(deadline=None, max_examples=examples(50))
@given(
    lengths=st.lists(st.sampled_from([377, 379, 381]), min_size=1, max_size=12),
    n_frames=st.integers(1, 13),
)
def test_blocks_of_each_layout_are_its_frames_in_order(lengths: list[int], n_frames: int) -> None:
    """An odd number of values is RF: Protocol reference 9.4."""
    sent = [
        m.DataFloat(info=at, values=np.full(length, at, np.float32))
        for at, length in enumerate(lengths)
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.xtwire"
        write_capture(path, [(one, one.info) for one in sent])
        recording = load(path)
        assert [part.n_bins for part in recording.parts] == list(dict.fromkeys(lengths))
        for part in recording.parts:
            blocks = list(part.blocks(n_frames))
            expected = [at for at, length in enumerate(lengths) if length == part.n_bins]
            assert [len(block.rf) for block in blocks if block.rf is not None] == [
                min(n_frames, len(expected) - begin) for begin in range(0, len(expected), n_frames)
            ]
            rows = np.concatenate([block.rf for block in blocks if block.rf is not None])
            assert rows[:, 0].tolist() == rows[:, -1].tolist() == expected
            assert np.concatenate([block.t_ns for block in blocks]).tolist() == expected
            np.testing.assert_array_equal(part.rf, rows)
