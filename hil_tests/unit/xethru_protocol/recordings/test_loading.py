"""`load`: any recording as arrays.

Expected values come from the manifest of recordings that the vendor's library wrote, from files
read here with numpy by their layout alone, or are put into the messages here.
"""

import json
import math
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.io import loadmat, savemat

from emulator import emulated_port
from hil_tests.paths import real_raw_recording, real_recording, shared_data
from hil_tests.unit.xethru_protocol.recordings.messages import MS, RECORDINGS, frame, write_capture
from xethru_protocol import Frame, FrameGeometry, load
from xethru_protocol.cli import main
from xethru_protocol.optional_packages import install_command
from xethru_protocol.recordings import (
    RecordingError,
    RecordingFault,
    SessionRecorder,
    TextColumn,
    convert,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting


def baseband(counter: int, n_bins: int, start_m: float = 0.5) -> m.BasebandIq:
    i = np.arange(n_bins, dtype=np.float32) + counter
    return m.BasebandIq(
        counter=counter,
        num_bins=n_bins,
        bin_length_m=0.25,
        sampling_frequency_hz=2.916e9,
        carrier_frequency_hz=7.29e9,
        range_offset_m=start_m,
        i=i,
        q=-i,
    )


def test_the_vendors_baseband_is_as_its_manifest_says() -> None:
    manifest = json.loads((shared_data("recordings") / "manifest.json").read_text())
    (listed,) = [one for one in manifest["recordings"] if one["name"] == "iq"]
    recording = load(RECORDINGS / "iq")
    values = [record["values"] for record in listed["records"]]
    expected = np.array([value["i"] for value in values], np.float32) + np.complex64(1j) * np.array(
        [value["q"] for value in values], np.float32
    )
    np.testing.assert_array_equal(recording.iq, expected)
    assert recording.rf is None
    assert recording.counter is not None
    assert recording.counter.tolist() == [value["frame_counter"] for value in values]
    assert recording.t_ns is not None
    assert recording.t_ns.tolist() == [record["epoch_ms"] * MS for record in listed["records"]]
    first = values[0]
    ranges_m = first["range_offset"] + np.arange(first["num_bins"]) * first["bin_length"]
    assert np.asarray(recording.ranges_m) == pytest.approx(ranges_m, rel=1e-7)
    true_m = np.asarray(recording.ranges_m) * 299_792_458 / 3e8
    assert np.asarray(recording.true_ranges_m) == pytest.approx(true_m, rel=1e-15)


def test_a_bare_xeps_data_file_has_91_complex_bins_without_being_given_more() -> None:
    path = real_raw_recording()
    (file,) = path.glob("xethru_datafloat_*.dat")
    rows = np.fromfile(file, "<f4").reshape(-1, 3 + 182)[:, 3:]
    for source in (path, file):
        recording = load(source)
        assert (recording.kind, recording.n_frames, recording.n_bins) == ("iq", 1518, 91)
        assert recording.iq is not None
        np.testing.assert_array_equal(recording.iq.real, rows[:, :91])
        np.testing.assert_array_equal(recording.iq.imag, rows[:, 91:])
        assert recording.counter is not None
        assert recording.counter.tolist() == list(range(1, 1519))
        assert recording.ranges_m is None
        # Protocol reference 9.6; the host's clock and the module's crystal differ by 0.03 %
        assert recording.frame_rate_hz == pytest.approx(17.04938, rel=5e-4)
    given = load(path, area_m=(0.4, 5.0)).ranges_m
    assert given is not None
    assert (given[0], given[-1], len(given)) == (0.4, pytest.approx(5.0), 91)


def test_baseband_of_a_profile_has_its_ranges() -> None:
    recording = load(real_recording())
    assert recording.iq is not None
    assert recording.iq.shape == (514, 54)
    assert recording.ranges_m is not None
    assert recording.ranges_m[0] == pytest.approx(0.3343, abs=5e-5)
    assert np.diff(recording.ranges_m) == pytest.approx(0.05144, abs=5e-6)


def test_every_way_to_send_a_frame_becomes_an_array() -> None:
    """The fixture holds one message of each kind, described in its manifest entry."""
    parts = load(RECORDINGS / "every_kind").parts
    iq = [part.iq[0].tolist() for part in parts if part.iq is not None]
    rf = [part.rf[0].tolist() for part in parts if part.rf is not None]
    by_hand = [
        *([1 + 3j, 2 + 4j], pytest.approx([0.5 * np.exp(-1.5j), 0.25 * np.exp(3j)], abs=1e-6)),
        *([1 + 3j, 2 + 4j], [0.25 + 1.25j, -0.5 - 1.5j, 0.75 + 8191.75j, -1 - 8192j]),
    ]
    assert iq == by_hand
    assert rf == [[-0.0625, 0.03125, 0.0], [364800.0, 364801.0], [0.5, -0.25]]
    assert {part.iq.dtype for part in parts if part.iq is not None} == {np.dtype(np.complex64)}


@pytest.mark.parametrize("n_frames", [1, 3, 39, 40, 1000])
def test_blocks_are_the_whole(n_frames: int) -> None:
    recording = load(RECORDINGS / "iq")
    blocks = list(recording.blocks(n_frames))
    assert [block.n_frames for block in blocks[:-1]] == [n_frames] * (len(blocks) - 1)
    for name in ("iq", "t_ns", "counter"):
        joined = np.concatenate([getattr(block, name) for block in blocks])
        np.testing.assert_array_equal(joined, getattr(recording, name))
    for block in blocks:
        np.testing.assert_array_equal(block.ranges_m, recording.ranges_m)
        assert block.frame_rate_hz == recording.frame_rate_hz


def test_a_frame_area_that_was_changed_makes_two_parts(tmp_path: Path) -> None:
    """Also where the number of bins is the same, and only their ranges differ."""
    sent = [baseband(1, 9), baseband(2, 9), baseband(3, 12), baseband(1, 9, 2.0), baseband(4, 9)]
    write_capture(tmp_path / "a.xtwire", [(one, at * MS) for at, one in enumerate(sent)])
    recording = load(tmp_path / "a.xtwire")
    assert recording.n_frames == 5
    with pytest.raises(RecordingError, match=r"frames of 3 layouts.*parts"):
        _ = recording.iq
    counters = [np.asarray(part.counter).tolist() for part in recording.parts]
    assert counters == [[1, 2, 4], [3], [1]]
    starts_m = [np.asarray(part.ranges_m)[0] for part in recording.parts]
    assert starts_m == [0.5, 0.5, 2.0]
    assert [np.asarray(part.iq).shape for part in recording.parts] == [(3, 9), (1, 12), (1, 9)]


def test_a_damaged_range_makes_a_part_of_unknown_ranges(tmp_path: Path) -> None:
    """No number is equal to NaN, also not that of the same frame when it is read again."""
    sent = [baseband(1, 9), baseband(2, 9, math.nan), baseband(3, 9), baseband(4, 9, math.nan)]
    write_capture(tmp_path / "a.xtwire", [(one, at * MS) for at, one in enumerate(sent)])
    known, damaged = load(tmp_path / "a.xtwire").parts
    assert [np.asarray(part.counter).tolist() for part in (known, damaged)] == [[1, 3], [2, 4]]
    assert np.asarray(damaged.iq).shape == (2, 9)
    assert damaged.ranges_m is None
    assert sum(block.n_frames for block in damaged.blocks()) == 2


def test_the_modules_answers_give_ranges_and_settings(tmp_path: Path) -> None:
    sent: list[m.Response] = [
        m.ReplyFloat(content_id=X4Setting.FPS, values=(17.0,)),
        m.ReplyFloat(content_id=X4Setting.FRAMEAREA, values=(0.5, 2.0)),
        m.ReplyInt(content_id=X4Setting.FRAMEBINCOUNT, values=(4,)),
        m.DataFloat(info=1, values=np.arange(8, dtype=np.float32)),
    ]
    write_capture(tmp_path / "a.xtwire", [(one, None) for one in sent])
    recording = load(tmp_path / "a.xtwire")
    assert recording.settings == {"FPS": 17.0, "FRAMEAREA": (0.5, 2.0), "FRAMEBINCOUNT": 4}
    np.testing.assert_array_equal(recording.iq, [[0 + 4j, 1 + 5j, 2 + 6j, 3 + 7j]])
    # baseband ends at its last bin: Protocol reference 9.4
    assert np.asarray(recording.ranges_m) == pytest.approx([0.5, 1.0, 1.5, 2.0])
    assert recording.frame_rate_hz == pytest.approx(17.04938, abs=1e-5)  # 9.6
    assert recording.t_ns is None


def rate_answer(fps: float) -> m.ReplyFloat:
    return m.ReplyFloat(content_id=X4Setting.FPS, values=(fps,))


@pytest.mark.parametrize(
    ("answers", "rate_hz"),
    [
        pytest.param({}, 5000.0, id="never asked: by the times"),
        pytest.param({2: 17.0}, 17.04938, id="asked when frames came already"),
        pytest.param({0: 0.0, 2: 17.0}, 17.04938, id="asked while it stood, and again"),
        pytest.param({0: 17.0, 4: 17.0}, 17.04938, id="asked twice"),
        pytest.param({0: 17.0, 4: 50.0}, 5000.0, id="changed: by the times"),
    ],
)
def test_the_rate_is_the_modules_answer_and_not_how_fast_frames_came(
    tmp_path: Path, answers: Mapping[int, float], rate_hz: float
) -> None:
    """Frames 0.2 ms apart, as those of an emulated module that waits for nobody.

    17 frames/s are 17.04938 by the chip's timer: Protocol reference 9.6.
    """
    sent: list[tuple[m.Response, int | None]] = []
    for at in range(6):
        if at in answers:
            sent.append((rate_answer(answers[at]), at * MS // 5))
        sent.append((frame(1 + at), at * MS // 5))
    write_capture(tmp_path / "a.xtwire", sent)
    recording = load(tmp_path / "a.xtwire")
    assert recording.frame_rate_hz == pytest.approx(rate_hz, rel=1e-6)
    assert {block.frame_rate_hz for block in recording.blocks(2)} == {recording.frame_rate_hz}
    if rate_hz < 100:
        assert recording.settings["FPS"] == 17.0


def test_the_rate_of_a_capture_of_an_emulated_module_is_the_radars(tmp_path: Path) -> None:
    path = tmp_path / "a.xtwire"
    with emulated_port("--bare", "--pace", "asap") as port:
        assert main(["record", "--port", port, "--wire", str(path), "--count", "40"]) == 0
    recording = load(path)
    assert recording.n_frames >= 40
    assert recording.frame_rate_hz == pytest.approx(17.04938, abs=1e-5)  # 9.6


def test_what_frames_are_is_asked_for_where_it_is_not_known(tmp_path: Path) -> None:
    write_capture(tmp_path / "a.xtwire", [(frame(1, 4), None), (frame(2, 4), None)])
    recording = load(tmp_path / "a.xtwire")
    assert recording.kind is None
    with pytest.raises(RecordingError):
        _ = recording.iq
    with pytest.raises(RecordingError):
        next(recording.blocks())
    with pytest.raises(RecordingError, match="--frames rf or baseband"):
        convert(tmp_path / "a.xtwire", tmp_path / "a.csv")
    np.testing.assert_array_equal(
        load(tmp_path / "a.xtwire", downconversion=True).iq, [[1 + 3j, 2 + 4j], [2 + 4j, 3 + 5j]]
    )
    assert load(tmp_path / "a.xtwire", downconversion=False).rf is not None
    assert recording.frame_rate_hz is None


def test_unknown_times_are_not_a_time(tmp_path: Path) -> None:
    write_capture(tmp_path / "a.xtwire", [(frame(1), None), (frame(2), 7), (frame(4), 9)])
    t_ns = load(tmp_path / "a.xtwire").t_ns
    assert t_ns is not None
    assert np.isnat(t_ns.view("datetime64[ns]")).tolist() == [True, False, False]
    assert load(tmp_path / "a.xtwire").frame_rate_hz == pytest.approx(1e9)


def test_the_rate_comes_from_the_longest_run_of_counters(tmp_path: Path) -> None:
    """20 frames/s, two of three frames missing, and the counter begins anew."""
    sent = [(frame(1 + 3 * at), at * 150 * MS) for at in range(10)]
    sent += [(frame(1 + at), (5000 + at) * MS) for at in range(3)]
    write_capture(tmp_path / "a.xtwire", sent)
    assert load(tmp_path / "a.xtwire").frame_rate_hz == pytest.approx(20.0)


def run_of(n_frames: int, rate_hz: float, begin_s: int, first: int) -> list[tuple[m.Response, int]]:
    """Return frames in a row, at times that are multiples of their period."""
    return [
        (frame(first + at), begin_s * 1000 * MS + round(at * 1000 * MS / rate_hz))
        for at in range(n_frames)
    ]


@pytest.mark.parametrize("place", [0, 1, 2], ids=["first", "middle", "last"])
@pytest.mark.parametrize("step", [0, 1], ids=["repeated", "falling"])
def test_the_longest_run_is_that_of_most_frames(tmp_path: Path, place: int, step: int) -> None:
    """Wherever it stands, and although the others take longer; a repeated counter ends a run."""
    runs = [(3, 0.5), (4, 0.25)]
    runs.insert(place, (7, 20.0))
    sent: list[tuple[m.Response, int | None]] = []
    first = 100
    for number, (n_frames, rate_hz) in enumerate(runs):
        sent += run_of(n_frames, rate_hz, begin_s=30 * number, first=first)
        first += n_frames - 1 - step
    write_capture(tmp_path / "a.xtwire", sent)
    assert load(tmp_path / "a.xtwire").frame_rate_hz == pytest.approx(20.0)


def test_of_runs_of_equal_length_the_first_gives_the_rate(tmp_path: Path) -> None:
    sent = [*run_of(4, 20.0, begin_s=0, first=9), *run_of(4, 5.0, begin_s=10, first=1)]
    write_capture(tmp_path / "a.xtwire", sent)
    assert load(tmp_path / "a.xtwire").frame_rate_hz == pytest.approx(20.0)


def test_a_cut_file_gives_what_is_there(tmp_path: Path) -> None:
    (file,) = (RECORDINGS / "iq").glob("xethru_baseband_iq_*.dat")
    cut = tmp_path / file.name
    cut.write_bytes(file.read_bytes()[:-50])
    with pytest.raises(RecordingError):
        _ = load(cut).iq
    faults: list[RecordingFault] = []
    recording = load(cut, faults.append)
    assert recording.n_frames == 39
    np.testing.assert_array_equal(recording.iq, np.asarray(load(RECORDINGS / "iq").iq)[:39])
    assert len(faults) == 1


def test_nans_and_infinities_are_kept(tmp_path: Path) -> None:
    values = np.array([np.nan, np.inf, -np.inf, -0.0], np.float32)
    sent = m.DataFloat(info=1, values=values)
    write_capture(tmp_path / "a.xtwire", [(sent, 1)])
    for downconversion in (True, False):
        recording = load(tmp_path / "a.xtwire", downconversion=downconversion)
        samples = recording.iq if downconversion else recording.rf
        assert samples is not None
        for suffix in (".csv", ".mat", ".npz"):
            target = tmp_path / f"{downconversion}{suffix}"
            convert(tmp_path / "a.xtwire", target, downconversion=downconversion)
            with np.errstate(invalid="ignore"):
                again = load(target, downconversion=downconversion)
            read = again.iq if downconversion else again.rf
            assert read is not None
            assert read.tobytes() == samples.tobytes()
        parts = samples.view(np.float32).tolist()[0]
        assert sorted(map(str, parts)) == ["-0.0", "-inf", "inf", "nan"]


@pytest.mark.parametrize(
    "make",
    [lambda path: path.mkdir(), lambda path: None, lambda path: path.write_bytes(b"RIFF")],
)
def test_what_is_no_recording_is_named(tmp_path: Path, make: Callable[[Path], object]) -> None:
    make(tmp_path / "x")
    with pytest.raises(RecordingError, match=str(tmp_path / "x")):
        load(tmp_path / "x")


def test_a_recording_without_frames_says_so() -> None:
    recording = load(RECORDINGS / "single")
    assert (recording.n_frames, recording.n_bins, recording.kind) == (0, 0, None)
    assert list(recording.blocks()) == []
    with pytest.raises(RecordingError):
        _ = recording.iq


def test_ranges_that_make_no_sense_are_refused() -> None:
    with pytest.raises(RecordingError):
        load(RECORDINGS / "iq", area_m=(1.0, float("nan")))


# --- files of arrays ----------------------------------------------------------------------------


def test_other_programs_read_the_arrays(tmp_path: Path) -> None:
    """Read by scipy for MATLAB's file, numpy's own reader of text for the table."""
    source = load(RECORDINGS / "iq")
    assert source.iq is not None
    assert source.t_ns is not None
    for suffix in (".csv", ".mat", ".npz"):
        convert(RECORDINGS / "iq", tmp_path / f"a{suffix}")
    table = loadmat(str(tmp_path / "a.mat"))
    with np.load(tmp_path / "a.npz") as archive:
        for held in (table, archive):
            np.testing.assert_array_equal(held["iq"], source.iq)
            assert held["iq"].dtype == np.complex64
            assert np.ravel(held["t_ns"]).tolist() == source.t_ns.tolist()
            assert np.ravel(held["counter"]).tolist() == np.asarray(source.counter).tolist()
            assert np.ravel(held["ranges_m"]).tolist() == np.asarray(source.ranges_m).tolist()
    titles, *lines = (tmp_path / "a.csv").read_text().splitlines()
    columns = titles.split(",")
    assert columns[:3] == ["t_ns", "counter", "time_s"]
    ranges_m = [float(name[2:-1]) for name in columns[3:13]]
    assert ranges_m == pytest.approx(np.asarray(source.ranges_m).tolist(), abs=0.5001e-6)
    assert max(map(len, columns)) <= len("i_0.400000m"), "no digits of a double"
    rows = np.loadtxt(lines, delimiter=",")
    n_bins = source.n_bins
    np.testing.assert_array_equal(rows[:, 3 : 3 + n_bins].astype(np.float32), source.iq.real)
    np.testing.assert_array_equal(rows[:, 3 + n_bins :].astype(np.float32), source.iq.imag)
    np.testing.assert_allclose(rows[:, 2], (source.t_ns - source.t_ns[0]) * 1e-9, atol=1e-9)


def test_files_of_others_are_read(tmp_path: Path) -> None:
    values = np.arange(6.0).reshape(3, 2)
    np.savez(tmp_path / "a.npz", rf=values)
    np.savez(tmp_path / "b.npz", iq=np.asfortranarray(values * 1j), counter=[1, 2, 3])
    savemat(str(tmp_path / "a.mat"), {"rf": values, "t_ns": np.array([1.0, np.nan, 3.0])})
    (tmp_path / "a.csv").write_text("\ufeffnote,rf_0,rf_1\r\nx,0,1\r\n,2,3\r\n\r\ny,4,5\r\n")
    for name in ("a.npz", "a.mat", "a.csv"):
        recording = load(tmp_path / name)
        assert recording.rf is not None
        assert recording.rf.dtype == np.float32
        np.testing.assert_array_equal(recording.rf, values)
        assert (recording.counter, recording.ranges_m) == (None, None)
    t_ns = load(tmp_path / "a.mat").t_ns
    assert t_ns is not None
    assert t_ns.tolist() == [1, -(2**63), 3]
    other = load(tmp_path / "b.npz", area_m=(1.0, 1.5))
    np.testing.assert_array_equal(other.iq, values * 1j)
    np.testing.assert_array_equal(other.ranges_m, [1.0, 1.5])
    convert(tmp_path / "b.npz", tmp_path / "b.csv")
    np.testing.assert_array_equal(load(tmp_path / "b.csv").iq, values * 1j)
    with pytest.raises(RecordingError):
        convert(tmp_path / "b.npz", tmp_path / "b.mcap")


BAD = {
    "empty.csv": b"",
    "titles.csv": b"a,b\n1,2\n",
    "short.csv": b"rf_0,rf_1\n1,2\n3\n",
    "text.csv": b"rf_0,rf_1\n1,x\n",
    "half.csv": b"i_0,i_1,q_0\n1,2,3\n",
    "latin.csv": b"rf_0\n\xff\n",
    "empty.mat": b"",
    "cut.mat": b"MATLAB 5.0 MAT-file" + bytes(200),
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_files_of_arrays_are_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(BAD[name])
    with pytest.raises(RecordingError, match=name) as caught:
        _ = load(tmp_path / name).rf
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "held",
    [
        {"x": np.zeros((2, 2))},
        {"iq": np.zeros(3)},
        {"iq": np.zeros((3, 2)), "t_ns": np.zeros(2)},
        {"iq": np.zeros((3, 2)), "ranges_m": np.zeros(3)},
        {"iq": np.array([["a", "b"]])},
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    tmp_path: Path, held: dict[str, npt.NDArray[Any]]
) -> None:
    np.savez(tmp_path / "a.npz", **held)  # type: ignore[arg-type]  # of allow_pickle
    savemat(str(tmp_path / "a.mat"), held)
    names = ["a.npz", "a.mat"]
    if held.get("iq", np.zeros(0)).shape == (3,):
        names.remove("a.mat")  # MATLAB has no vectors, there it is (1, 3)
    for name in names:
        with pytest.raises(RecordingError, match=name):
            _ = load(tmp_path / name).iq


@pytest.mark.parametrize(
    "held",
    [
        {"rf": np.full((3, 2), 1j)},
        {"iq": np.zeros((3, 0))},
        {"iq": np.zeros((3, 2)), "t_ns": np.full(3, 1e300)},
        {"iq": np.zeros((3, 2)), "t_ns": np.zeros(3) + 1j},
        {"iq": np.zeros((3, 2)), "counter": np.array([-1, 0, 1])},
        {"iq": np.zeros((3, 2)), "counter": np.array([0.0, np.nan, 1])},
        {"iq": np.zeros((3, 2)), "counter": np.array([0, 2**32, 1])},
        {"iq": np.zeros((3, 2)), "frame_rate_hz": np.zeros(1)},
        {"iq": np.zeros((3, 2)), "frame_rate_hz": np.full(1, np.nan)},
        {"iq": np.zeros((3, 2)), "frame_rate_hz": np.full(1, 17j)},
    ],
)
def test_numbers_that_mean_nothing_are_refused(
    tmp_path: Path, held: dict[str, npt.NDArray[Any]]
) -> None:
    np.savez(tmp_path / "a.npz", **held)  # type: ignore[arg-type]  # of allow_pickle
    with pytest.raises(RecordingError, match=f"{list(held)[-1]} (is|has|holds|must)"):
        _ = load(tmp_path / "a.npz").frame_rate_hz


@pytest.mark.parametrize("shape", [(10**9, 10**6), (10**12, 0), (3, 2), (-1, -2), (-1, 2)])
def test_a_head_that_promises_other_samples_is_refused(
    tmp_path: Path, shape: tuple[int, int]
) -> None:
    about = f"{{'descr': '<c8', 'fortran_order': False, 'shape': {shape}, }}".encode()
    head = b"\x93NUMPY\x01\x00" + len(about).to_bytes(2, "little") + about
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("iq.npy", head + bytes(16))
    with pytest.raises(RecordingError, match=r"a\.npz .* 16 bytes, which do not fit its shape"):
        _ = load(tmp_path / "a.npz").iq


def test_what_unpacks_to_more_than_belongs_there_is_refused(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", iq=np.zeros((3, 2)), t_ns=np.zeros(10**6))
    np.savez_compressed(tmp_path / "b.npz", iq=np.zeros((3, 2)), settings=np.array("[" * 10**7))
    for name in ("a.npz", "b.npz"):
        with pytest.raises(RecordingError):
            _ = load(tmp_path / name).iq


def test_samples_larger_than_memory_name_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.savez(tmp_path / "a.npz", iq=np.zeros((3, 2)))
    recording = load(tmp_path / "a.npz")
    assert recording.n_frames == 3

    def full(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr("xethru_protocol.recordings.loading.np.empty", full)
    with pytest.raises(RecordingError, match=r"a\.npz: its 3 frames .* blocks\(\)"):
        _ = recording.iq


def test_a_cut_archive_is_one_line(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", rf=np.random.default_rng(1).normal(size=(300, 50)))
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[len(data) // 2] ^= 255
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(RecordingError, match=r"a\.npz"):
        _ = load(tmp_path / "a.npz").rf


def test_a_mat_file_is_checked_before_scipy_gets_it(tmp_path: Path) -> None:
    """An element of type 99, which ends scipy 1.17 with a segmentation fault."""
    savemat(str(tmp_path / "a.mat"), {"rf": np.ones((2, 3))})
    data = bytearray((tmp_path / "a.mat").read_bytes())
    place = data.index(b"\x09\0\0\0")  # of miDOUBLE
    data[place] = 99
    (tmp_path / "a.mat").write_bytes(data)
    with pytest.raises(RecordingError, match=r"a\.mat cannot be read.*element is damaged"):
        _ = load(tmp_path / "a.mat").rf
    savemat(str(tmp_path / "b.mat"), {"rf": np.ones((2, 3))}, do_compression=True)
    np.testing.assert_array_equal(load(tmp_path / "b.mat").rf, np.ones((2, 3)))


def test_without_scipy_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scipy.io", None)
    monkeypatch.setitem(sys.modules, "scipy", None)
    with pytest.raises(RecordingError, match=re.escape(install_command("emulator"))):
        convert(RECORDINGS / "iq", tmp_path / "a.mat")
    assert not (tmp_path / "a.mat").exists()


# --- memory, sessions, metres -------------------------------------------------------------------

_BY_BLOCKS = """\
import resource, sys
from xethru_protocol import load
recording = load(sys.argv[1])
limit = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
n = sum(block.rf.shape[0] for block in recording.blocks(256))
print(n, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - limit)
"""


def test_blocks_need_the_memory_of_a_block(tmp_path: Path) -> None:
    """29 MB of frames by blocks of 1.5 MB, of which three may be there at once; 12 MB suffice."""
    rows = np.zeros(5_000, np.dtype([("head", "<u4", 3), ("values", "<f4", 1431)]))
    rows["head"] = np.column_stack([np.zeros(5_000), np.arange(5_000), np.full(5_000, 1431)])
    path = tmp_path / "xethru_datafloat_20260101_000000.dat"
    rows.tofile(path)
    ran = subprocess.run(
        [sys.executable, "-c", _BY_BLOCKS, str(path)], capture_output=True, text=True, check=True
    )
    n_frames, kilobytes = map(int, ran.stdout.split())
    assert n_frames == 5_000
    assert kilobytes < 12_000


def test_a_session_has_radars_and_texts_by_name(tmp_path: Path) -> None:
    recorder = SessionRecorder(tmp_path / "a.mcap", clock=lambda: 5)
    about = {"range_start_m": 0.5, "bin_length_m": 0.25, "n_bins": 3, "rate_hz": 17.0}
    recorder.add_radar("left", about)
    recorder.add_radar("right", {})
    recorder.add_text("belt")
    for counter in (1, 2):
        assert recorder.write("left", frame(counter), 10 * counter)
    assert recorder.write("right", baseband(7, 9), 15)
    assert recorder.write_line("belt", "0.25, 3", 12)
    recorder.close()
    recording = load(tmp_path / "a.mcap")
    assert list(recording.radars) == ["left", "right"]
    left, right = recording.radars.values()
    np.testing.assert_array_equal(left.rf, [[1, 2, 3], [2, 3, 4]])
    np.testing.assert_array_equal(left.ranges_m, [0.5, 0.75, 1.0])
    assert left.frame_rate_hz == pytest.approx(17.04938, abs=1e-5)
    assert right.iq is not None
    belt = recording.texts["belt"]
    np.testing.assert_array_equal(belt.values, [[0.25, 3.0]])
    assert left.t_ns is not None
    assert right.t_ns is not None
    assert (left.t_ns - belt.t_ns[0]).tolist() == [-2, 8]
    assert (right.t_ns - belt.t_ns[0]).tolist() == [3]
    with pytest.raises(RecordingError, match='holds 2 radars, not one: "left", "right"'):
        _ = recording.iq
    with pytest.raises(RecordingError, match='no radar "front"; it holds "left", "right"'):
        convert(tmp_path / "a.mcap", tmp_path / "b.csv", radar="front")
    assert convert(tmp_path / "a.mcap", tmp_path / "b.csv", radar="left").messages == 2


def test_a_session_that_was_never_closed_is_read(tmp_path: Path) -> None:
    now = iter(range(0, 10**12, 600_000_000))
    recorder = SessionRecorder(tmp_path / "a.mcap", clock=lambda: next(now))
    recorder.add_radar("left", {})
    for counter in range(1, 8):
        recorder.write("left", frame(counter), counter)
    copy = tmp_path / "killed.mcap"
    copy.write_bytes((tmp_path / "a.mcap").read_bytes())
    recorder.close()
    faults: list[RecordingFault] = []
    found = load(copy, faults.append).counter
    assert found is not None
    assert found.tolist() == [1, 2, 3, 4, 5, 6]  # a chunk ends every other frame
    assert len(faults) == 1


@pytest.mark.parametrize(
    ("lines", "values"),
    [
        (("1", "2.5", "-3e2"), [1.0, 2.5, -300.0]),
        (("volt", "1", "2"), [None, 1.0, 2.0]),
        (("1;2", "3;4", "5"), [[1.0, 2.0], [3.0, 4.0], [None, None]]),
        (("start", "stop"), None),
        (("a", "b", "c", "1"), None),
        ((), None),
    ],
)
def test_numbers_of_lines(lines: tuple[str, ...], values: object) -> None:
    found = TextColumn(name="x", t_ns=np.arange(len(lines)), lines=lines).values
    if values is None:
        assert found is None
    else:
        np.testing.assert_array_equal(found, np.array(values, float))


def test_true_metres_are_those_of_light() -> None:
    """An echo after 20 ns lies at 2.99792458 m; the module takes 3.0e8 m/s and says 3 m."""
    geometry = FrameGeometry(range_start_m=3.0, bin_length_m=1.5, n_bins=2, downconversion=False)
    one = Frame(counter=1, samples=np.zeros(2, np.float32), geometry=geometry, arrival_ns=0)
    assert one.true_ranges_m == pytest.approx([2.99792458, 4.49688687], rel=1e-12)


def test_arrays_are_read_once_and_shared() -> None:
    recording = load(RECORDINGS / "iq")
    assert recording.iq is recording.iq
    assert recording.radars[""].iq is recording.iq


def test_a_session_cut_before_its_first_radar_says_that_it_is_empty(tmp_path: Path) -> None:
    SessionRecorder(tmp_path / "all.mcap").close()
    recording = load(tmp_path / "all.mcap")
    for call in (lambda: recording.iq, lambda: recording.named("left")):
        with pytest.raises(RecordingError, match=r"all\.mcap holds no radar frames"):
            call()
