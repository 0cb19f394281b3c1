"""What recordings of real modules show without knowing their settings.

The files are read here with numpy and struct, by the layout alone, so that our reader is compared
with something else. Both were made by others: an X4 of 2017, and an X4M03 of 2025. Expected numbers
come from the protocol reference, or describe the recordings themselves.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from hil_tests.paths import real_raw_recording, real_recording
from hil_tests.unit.xethru_protocol.recordings.messages import META, xethru
from xethru_protocol.recordings import RecordingReader, read_recording, recording_facts
from xethru_protocol.recordings.frame_layout import FrameLayouts
from xethru_protocol.wire import messages as m

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Real:
    """A recording as its files have it.

    ``values`` has shape (n, 2 * bins), all I and then all Q; ``t_s`` is by the host's stamps.
    """

    path: Path
    counters: npt.NDArray[np.uint32]
    headers: npt.NDArray[np.uint32]
    values: npt.NDArray[np.float32]
    t_s: Floats

    @property
    def n_bins(self) -> int:
        return int(self.values.shape[1]) // 2

    @property
    def bins(self) -> npt.NDArray[np.complex128]:
        values = self.values.astype(np.float64)
        return values[:, : self.n_bins] + 1j * values[:, self.n_bins :]


def stamps_s(directory: Path) -> Floats:
    """Read the index: head of 0x59 bytes, session id of the length at 0x55, end at 0x1D."""
    meta = (directory / META).read_bytes()
    (length,) = struct.unpack_from("<I", meta, 0x55)
    (end,) = struct.unpack_from("<Q", meta, 0x1D)
    index = np.frombuffer(meta[0x59 + length : end], np.dtype([("ms", "<u4"), ("rest", "V29")]))
    return index["ms"][:-1] * 1e-3  # the last entry closes the file


@pytest.fixture(scope="module")
def x4() -> Real:
    """54 bins: counter, bin count, bin length, two frequencies and range offset before them."""
    path = real_recording()
    data = np.fromfile(next(path.glob("xethru_baseband_iq_*.dat")), "<u4").reshape(-1, 6 + 108)
    return Real(
        path=path,
        counters=data[:, 0],
        headers=data[:, :6],
        values=np.ascontiguousarray(data[:, 6:]).view("<f4"),
        t_s=stamps_s(path),
    )


@pytest.fixture(scope="module")
def x4m03() -> Real:
    """182 values: content id, info and length before them."""
    path = real_raw_recording()
    data = np.fromfile(next(path.glob("xethru_datafloat_*.dat")), "<u4").reshape(-1, 3 + 182)
    return Real(
        path=path,
        counters=data[:, 1],
        headers=data[:, :3],
        values=np.ascontiguousarray(data[:, 3:]).view("<f4"),
        t_s=stamps_s(path),
    )


@pytest.fixture(scope="module", params=["x4", "x4m03"])
def real(request: pytest.FixtureRequest) -> Real:
    found: Real = request.getfixturevalue(request.param)
    return found


def test_the_meta_file_has_version_13(real: Real) -> None:
    assert struct.unpack_from("<II", (real.path / META).read_bytes()) == (0xA0B1C2D3, 13)
    with RecordingReader(real.path) as reader:
        assert reader.meta_version == 13
        assert len(reader) == len(real.counters)


def test_sessions_and_profiles_are_read(x4: Real, x4m03: Real) -> None:
    assert recording_facts(x4.path).session_id == "baseband_recording"
    assert recording_facts(x4.path).profile_id == 0x014D4AB8
    assert recording_facts(x4m03.path).session_id == "test_recording"
    assert recording_facts(x4m03.path).profile_id is None  # raw frames


def test_counters_begin_at_1_and_have_no_gap(real: Real) -> None:
    """The chip's counter begins at 1 after INIT: Protocol reference 6.1."""
    np.testing.assert_array_equal(real.counters, np.arange(1, len(real.counters) + 1))
    assert len(real.counters) == {54: 514, 91: 1518}[real.n_bins]


def test_the_reader_gives_every_value_and_stamp(real: Real) -> None:
    records = list(read_recording(real.path))
    assert len(records) == len(real.counters)
    first_ns = records[0][1]
    assert first_ns is not None
    for (message, t_ns), counter, values, t_s in zip(
        records, real.counters, real.values, real.t_s, strict=True
    ):
        assert t_ns is not None
        assert t_ns - first_ns == round(t_s * 1000) * 10**6
        if isinstance(message, m.BasebandIq):
            assert message.counter == counter
            assert message.i.tobytes() + message.q.tobytes() == values.tobytes()
        else:
            assert isinstance(message, m.DataFloat)
            assert (message.content_id, message.info) == (0, counter)
            assert message.values.tobytes() == values.tobytes()


def step(halves: tuple[Floats, Floats]) -> float:
    """RMS step between neighbours in range, per RMS value."""
    steps = sum(float(np.square(np.diff(half, axis=1)).sum()) for half in halves)
    return float(np.sqrt(steps / sum(float(np.square(half).sum()) for half in halves)))


def test_all_i_come_before_all_q(real: Real) -> None:
    """Neighbours in range are alike if the values are split so, and not if I and Q alternate."""
    values = real.values.astype(np.float64)
    split = step((values[:, : real.n_bins], values[:, real.n_bins :]))
    alternating = step((values[:, ::2], values[:, 1::2]))
    assert split < 0.6
    assert alternating > 1.0


def frames_of(values: npt.NDArray[np.float32]) -> FrameLayouts:
    layouts = FrameLayouts()
    for row in values:
        layouts.take(m.DataFloat(info=0, values=row))
    return layouts


def test_the_layout_is_found_in_the_values(real: Real) -> None:
    (found,) = frames_of(real.values).layouts().values()
    assert str(found) == f"probably {real.n_bins} complex baseband bins"
    # the same values in another order have no neighbours that are alike
    mixed = np.random.default_rng(1).permuted(real.values, axis=1)
    (found,) = frames_of(mixed).layouts().values()
    assert found.downconversion is False


def test_dump_shows_complex_bins(x4m03: Real, capsys: pytest.CaptureFixture[str]) -> None:
    lines = xethru(capsys, "dump", x4m03.path).splitlines()
    assert "  1518 DATA FLOAT" in lines
    assert any(line.startswith("  frames of probably 91 complex baseband bins") for line in lines)
    assert lines[-1].split("DATA FLOAT ")[1].startswith("content_id=0 info=1518 bins=91 i=[")
    lines = xethru(capsys, "dump", x4m03.path, "--frames", "rf").splitlines()
    assert "  frames of 182 RF bins" in lines
    assert " length=182 data=[" in lines[-1]


def test_the_rate_is_that_of_the_chips_timer(real: Real) -> None:
    """17 frames per second run at 17.04938: Protocol reference 9.6.

    By a line through the host's stamps, since several frames may arrive at once. Its clock and the
    module's crystal may differ: by 0.01 and 0.03 % here. The next rates of the table are 6 % away.
    """
    period_s = np.polyfit(real.counters, real.t_s, 1)[0]
    assert 1 / period_s == pytest.approx(17.04938, rel=5e-4)


def test_bins_lie_on_the_grid_of_the_firmware(x4: Real) -> None:
    """Frame area as in Protocol reference 9.4: the constant is a float32, the rest is double."""
    half_wave_m = float(np.float32(1.5e8 / 23.328e9))
    bin_m = 8 * half_wave_m
    start_m = float(np.float32(0.18)) + 3 * bin_m
    header = np.frombuffer(x4.headers[0].tobytes(), "<f4")[2:]
    np.testing.assert_array_equal(
        header, np.array([bin_m, 23.328e9 / 8, 7.29e9, start_m], np.float32)
    )
    assert (x4.headers[:, 1:] == x4.headers[0, 1:]).all()


def lag_1(values: Floats) -> float:
    """Autocorrelation from frame to frame of each column, averaged."""
    centred = values - values.mean(axis=0)
    products = (centred[1:] * centred[:-1]).sum(axis=0) / np.square(centred).sum(axis=0)
    return float(products.mean())


def parts(bins: npt.NDArray[np.complex128]) -> Floats:
    """I and Q beside each other."""
    return np.concatenate([bins.real, bins.imag], axis=1)


def test_far_bins_of_the_x4_are_slow_with_a_white_floor(x4: Real) -> None:
    """What the emulator's receiver is fitted to: slow clutter above a white floor."""
    far = parts(x4.bins[:, -10:])
    assert np.sqrt(far.var(axis=0).mean()) == pytest.approx(1.4e-4, rel=0.01)
    assert lag_1(far) == pytest.approx(0.973, abs=0.005)
    # A step has twice the variance of the white part, as long as the rest does not move.
    white = np.sqrt(np.diff(far, axis=0).var(axis=0).mean() / 2)
    assert white == pytest.approx(2.1e-5, rel=0.03)


def test_the_strongest_reflector_of_the_x4_jitters_in_phase(x4: Real) -> None:
    amplitude = np.abs(x4.bins).mean(axis=0)
    assert int(np.argmax(amplitude)) == 0
    assert amplitude[0] == pytest.approx(0.0294, abs=1e-4)
    phase_rad = np.unwrap(np.angle(x4.bins[:, 0]))
    assert phase_rad.std() == pytest.approx(0.032, abs=5e-4)
    assert np.diff(phase_rad).std() / np.sqrt(2) == pytest.approx(0.0056, abs=1e-4)


def test_far_bins_of_the_x4m03_are_not_white_either(x4m03: Real) -> None:
    far = parts(x4m03.bins[:, -10:])
    assert lag_1(far) == pytest.approx(0.69, abs=0.02)
    white = np.sqrt(np.diff(far, axis=0).var(axis=0).mean() / 2)
    assert white == pytest.approx(6.2e-5, rel=0.05)
