"""Files of others are recognised by what they hold, or the message says what decides."""

import io
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from hil_tests.unit.xethru_protocol.recordings.messages import (
    META,
    MS,
    RECORDINGS,
    presence,
    read_with_faults,
    write_recording,
)
from xethru_protocol.cli import main
from xethru_protocol.recordings import (
    RecordingError,
    RecordingFault,
    convert,
    load,
    read_recording,
)
from xethru_protocol.wire import messages as m

N_FRAMES, N_BINS = 12, 20
AT = np.arange(N_BINS) / 3
IQ = np.array([np.exp(1j * (AT + n / 5)) / (1 + AT) for n in range(N_FRAMES)]).astype(np.complex64)
SENT = np.concatenate([IQ.real, IQ.imag], axis=1)  # as a module sends baseband
NOISE = np.random.default_rng(5).normal(size=(N_FRAMES, 2 * N_BINS)).astype(np.float32)


def of_kind(kind: str, number: int) -> m.Response:
    if kind == "presence":
        return presence(number)
    if kind == "iq":
        i, q = IQ[number].real, IQ[number].imag
        return m.BasebandIq(
            counter=number,
            num_bins=N_BINS,
            bin_length_m=0.0625,
            sampling_frequency_hz=2.0**30,
            carrier_frequency_hz=2.0**33,
            range_offset_m=0.5,
            i=i,
            q=q,
        )
    return m.DataFloat(info=number, values=SENT[number])


def record(path: Path, kind: str) -> list[m.Response]:
    messages = [of_kind(kind, number) for number in range(N_FRAMES)]
    write_recording(path, ((message, at * 1000 * MS) for at, message in enumerate(messages)))
    return messages


@pytest.mark.parametrize("kind", ["float", "iq", "presence"])
def test_a_killed_recorder_of_the_vendor(kind: str, tmp_path: Path) -> None:
    messages = record(tmp_path / "r", kind)
    for path in list((tmp_path / "r").iterdir()):
        path.rename(path.with_suffix(".writing"))
    (tmp_path / "r" / META).with_suffix(".writing").write_bytes(b"")
    found, faults = read_with_faults(tmp_path / "r")
    assert [message for message, _ in found] == messages
    assert [fault.minor for fault in faults] == [True]
    assert "killed" in faults[0].reason


@pytest.mark.parametrize(
    "file",
    sorted(path for path in (RECORDINGS / "every_kind").glob("xethru_*_2*")),
    ids=lambda path: path.name,
)
def test_every_kind_of_file_is_known_by_its_records_or_needs_its_name(
    file: Path, tmp_path: Path
) -> None:
    renamed = Path(shutil.copy(file, tmp_path / "a"))
    prefix = file.name.rpartition("_20")[0]
    try:
        found = list(read_recording(renamed, lambda fault: None))
    except RecordingError as error:
        assert prefix in str(error)  # noqa: PT017 - one of several kinds with the same layout
        assert prefix.endswith(
            ("pulsedoppler_float", "noisemap_float", "_byte", "_rf", "_normalized")
        )
    else:
        whole = list(read_recording(file, lambda fault: None))
        assert [message for message, _ in found] == [message for message, _ in whole]


@pytest.mark.parametrize("name", ["s1p1r1.dat", "data", "night.bin", "a.csv"])
@pytest.mark.parametrize("kind", ["float", "iq", "presence"])
def test_a_renamed_data_file(kind: str, name: str, tmp_path: Path) -> None:
    messages = record(tmp_path / "r", kind)
    (file,) = (path for path in (tmp_path / "r").iterdir() if path.name != META)
    renamed = file.rename(tmp_path / name)
    assert [message for message, _ in read_recording(renamed)] == messages
    assert main(["dump", str(renamed)]) == 0


def test_a_directory_of_renamed_files_names_one(tmp_path: Path) -> None:
    record(tmp_path / "r", "float")
    (file,) = (path for path in (tmp_path / "r").iterdir() if path.name != META)
    (tmp_path / "many").mkdir()
    file.rename(tmp_path / "many" / "s1p1r1.dat")
    with pytest.raises(RecordingError, match=r"s1p1r1\.dat is one"):
        list(read_recording(tmp_path / "many"))


def _matlab(iq: npt.NDArray[np.complex64]) -> str:
    return "\n".join(" ".join(f"{z.real:.9g}{z.imag:+.9g}i" for z in row) for row in iq)


def _savetxt(iq: npt.NDArray[np.complex64]) -> str:
    stream = io.StringIO()
    np.savetxt(stream, iq, delimiter=",", header="frames of I and Q")
    return stream.getvalue()


def _python(iq: npt.NDArray[np.complex64]) -> str:
    return "\n".join(",".join(map(str, row.tolist())) for row in iq) + "\n\n"


@pytest.mark.parametrize("name", ["a.txt", "a.csv", "a.dat", "a"])
@pytest.mark.parametrize("text_of", [_matlab, _savetxt, _python])
def test_lines_of_complex_numbers(
    text_of: Callable[[npt.NDArray[np.complex64]], str],
    name: str,
    tmp_path: Path,
) -> None:
    (tmp_path / name).write_text(text_of(IQ))
    radar = load(tmp_path / name).radar
    assert radar.iq is not None
    np.testing.assert_allclose(radar.iq, IQ, rtol=1e-6)
    convert(tmp_path / name, tmp_path / "b.npz")
    np.testing.assert_array_equal(load(tmp_path / "b.npz").radar.iq, radar.iq)


def test_a_line_that_is_damaged_is_left_out(tmp_path: Path) -> None:
    lines = _python(IQ).splitlines()
    lines[3] = lines[3].replace("j", "x", 1)
    lines[5] = lines[5].rpartition(",")[0]
    (tmp_path / "a.txt").write_text("\n".join(lines))
    faults: list[RecordingFault] = []
    radar = load(tmp_path / "a.txt", faults.append).radar
    assert radar.iq is not None
    np.testing.assert_allclose(radar.iq, np.delete(IQ, [3, 5], axis=0), rtol=1e-6)
    assert len(faults) == 2


@pytest.mark.parametrize("name", ["a.npy", "a.dat", "a"])
@pytest.mark.parametrize(
    ("values", "downconversion", "kind"),
    [
        (IQ, None, "iq"),
        (IQ.astype(np.complex128), None, "iq"),
        (SENT, None, "iq"),
        (SENT, True, "iq"),
        (NOISE, None, "rf"),
        (SENT, False, "rf"),
        (NOISE[:, :-1], None, "rf"),
    ],
)
def test_an_array_of_numpy(
    values: npt.NDArray[np.generic],
    downconversion: bool | None,
    kind: str,
    name: str,
    tmp_path: Path,
) -> None:
    with (tmp_path / name).open("wb") as stream:
        np.save(stream, values)
    radar = load(tmp_path / name, downconversion=downconversion).radar
    assert radar.kind == kind
    found = radar.iq if kind == "iq" else radar.rf
    np.testing.assert_array_equal(found, IQ if kind == "iq" else values)
    assert main(["convert", str(tmp_path / name), str(tmp_path / "b.csv"), "--frames", "rf"]) == 0


@pytest.mark.parametrize(
    ("name", "as_name"), [("a.npz", "a.dat"), ("a.mat", "a.bin"), ("a.npz", "a")]
)
def test_archives_under_other_names(name: str, as_name: str, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", IQ)
    convert(tmp_path / "a.npy", tmp_path / name)
    (tmp_path / name).rename(tmp_path / as_name)
    np.testing.assert_array_equal(load(tmp_path / as_name).radar.iq, IQ)


@pytest.mark.parametrize(
    "content", [b"", b"hello\n", b"\0" * 5000, b"1,2,3\n4,5,6\n", bytes(range(256)) * 40, b"i\n"]
)
def test_what_holds_nothing_known_is_refused_by_what_decides(
    content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.dat").write_bytes(content)
    assert main(["dump", str(tmp_path / "a.dat")]) == 1
    assert "xethru_datafloat_*.dat" in capsys.readouterr().err
