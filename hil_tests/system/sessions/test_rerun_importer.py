"""`rerun-importer-xethru` as the Rerun viewer calls it, its drawing read back by Rerun's reader."""

import os
import shutil
import stat
import struct
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.paths import FIXTURES, REPOSITORY
from hil_tests.patience import seconds
from hil_tests.system.sessions.test_view import HAS_LAVAPIPE
from slam.app.view.importer import INCOMPATIBLE, main
from slam.app.view.rerun_recording import RrdReader, ViewerClient, count_rows, rr
from slam.app.view.viewer import SlamViewerProcess
from xethru_protocol.cli.live.viewer import ViewerKind
from xethru_protocol.recordings import WireCapture, read_recording
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.messages import BasebandIq, DataFloat, Pong, ReplyFloat, ReplyInt

pytestmark = pytest.mark.slow

IQ = FIXTURES / "recordings" / "iq"
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 40_000_000
N_FRAMES, N_BINS, FIRST_COUNTER = 150, 436, 41
AREA_M = (0.25, 3.05)
SAMPLES = (
    np.random.default_rng(3).standard_normal((N_FRAMES, N_BINS)).astype(np.float32) * 1e-3
    + np.sin(np.arange(N_BINS) * 1.96).astype(np.float32) * 0.1
)


def write_wire(path: Path) -> None:
    module = Connection(Role.MODULE)
    with WireCapture(path, {"port": "made up"}) as capture:

        def send(message: Any, t_ns: int) -> None:  # noqa: ANN401 - any response
            capture.write("rx", module.send(message), t_ns)

        send(ReplyFloat(content_id=X4Setting.FRAMEAREA, values=AREA_M), START_NS)
        send(ReplyInt(content_id=X4Setting.FRAMEBINCOUNT, values=(N_BINS,)), START_NS)
        for row, values in enumerate(SAMPLES):
            t_ns = START_NS + row * PERIOD_NS
            send(DataFloat(info=FIRST_COUNTER + row, values=values), t_ns)
        send(Pong(value=0xAAEEAEEA), START_NS + N_FRAMES * PERIOD_NS)


def draw(path: Path, drawn: Path, *options: str) -> subprocess.CompletedProcess[bytes]:
    """Run the importer with its standard output in a file."""
    command = [sys.executable, "-m", "slam.app.view.importer", str(path), *options]
    with drawn.open("wb") as out:
        return subprocess.run(command, stdout=out, stderr=subprocess.PIPE, check=False)


def rows(drawn: Path, entity: str, component: str) -> Iterator[tuple[dict[str, Any], Any]]:
    """Yield the rows of one component with their times by timeline [ns or number]."""
    reader = RrdReader(drawn)
    (store,) = reader.recordings()
    for chunk in reader.stream(store=store):
        batch = chunk.to_record_batch()
        if str(chunk.entity_path) != entity or component not in batch.schema.names:
            continue
        names = [n for n in ("device_time", "frame", "host_time") if n in batch.schema.names]
        columns = {n: batch[n].cast("int64").to_pylist() for n in names}
        for k, value in enumerate(batch[component].to_pylist()):
            yield {n: columns[n][k] for n in names}, value


def tensor(value: Any) -> NDArray[np.float32]:  # noqa: ANN401 - Arrow's rows are of any type
    (only,) = value
    return np.array(only["buffer"], dtype=np.float32).reshape(only["shape"])


@pytest.fixture(scope="module")
def wire(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("importer") / "line.xtwire"
    write_wire(path)
    return path


@pytest.fixture(scope="module")
def drawn_wire(wire: Path) -> Path:
    drawn = wire.with_suffix(".rrd")
    options = (
        "--recording-id",
        "rec-7",
        "--application-id",
        "app-7",
        "--entity-path-prefix",
        "a/b",
    )
    # What the viewer adds if something is open already, and what a later version may add.
    more = ("--opened-recording-id", "x", "--static", "--time_sequence", "tick=3", "--new", "1")
    done = draw(wire, drawn, *options, *more)
    assert (done.returncode, done.stderr) == (0, b"")
    return drawn


def test_it_draws_under_the_names_that_the_viewer_gives(drawn_wire: Path) -> None:
    (store,) = RrdReader(drawn_wire).recordings()
    assert (store.application_id, store.recording_id) == ("app-7", "rec-7")
    entities = {
        str(chunk.entity_path)
        for chunk in RrdReader(drawn_wire).stream(store=store)
        if not str(chunk.entity_path).startswith("/__properties")
    }
    of_frames = {f"/a/b/data_float/{name}" for name in ("amplitude", "bscan")}
    assert entities == of_frames | {"/a/b/log", "/a/b/about"}


def test_frames_of_a_capture_lie_at_their_ranges_and_times(drawn_wire: Path) -> None:
    found = list(rows(drawn_wire, "/a/b/data_float/amplitude", "BarChart:values"))
    shown = [(times, tensor(value)) for times, value in found if value]
    assert len(shown) == N_FRAMES
    for row, (times, values) in enumerate(sorted(shown, key=lambda each: each[0]["frame"])):
        assert times == {
            "device_time": row * PERIOD_NS,
            "frame": FIRST_COUNTER + row,
            "host_time": START_NS + row * PERIOD_NS,
        }
        np.testing.assert_array_equal(values, SAMPLES[row])
    ((_, places),) = rows(drawn_wire, "/a/b/data_float/amplitude", "BarChart:abscissa")
    # RF: the area ends one bin behind the last (Protocol reference 9.4).
    expected_m = AREA_M[0] + (AREA_M[1] - AREA_M[0]) / N_BINS * np.arange(N_BINS)
    np.testing.assert_allclose(tensor(places), expected_m, atol=1e-6)


def test_a_bscan_is_the_envelope_without_the_constant_part(drawn_wire: Path) -> None:
    scans = [tensor(value) for _, value in rows(drawn_wire, "/a/b/data_float/bscan", "Tensor:data")]
    assert [scan.shape for scan in scans] == [(128, N_BINS), (N_FRAMES - 128, N_BINS)]
    for scan, block in zip(scans, (SAMPLES[:128], SAMPLES[128:]), strict=True):
        moving = block.astype(np.float64) - block.mean(axis=0, dtype=np.float64)
        spectrum = np.fft.fft(moving, axis=1)
        spectrum[:, 1 : N_BINS // 2] *= 2.0
        spectrum[:, N_BINS // 2 + 1 :] = 0.0
        np.testing.assert_allclose(scan, np.abs(np.fft.ifft(spectrum, axis=1)), atol=1e-6)
    (_, value) = next(rows(drawn_wire, "/a/b/data_float/bscan", "Tensor:data"))
    assert value[0]["names"] == ["time 5.1 s", "range 0.25 .. 3.04 m"]


def test_other_messages_are_lines_of_the_log(drawn_wire: Path) -> None:
    lines = [text for _, (text,) in rows(drawn_wire, "/a/b/log", "TextLog:text")]
    assert [line.split()[0] for line in lines] == ["REPLY", "REPLY", "PONG"]


def test_baseband_of_a_vendors_recording_is_envelope_and_phase(
    tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    drawn = tmp_path / "iq.rrd"
    assert main([str(IQ)]) == 0
    drawn.write_bytes(capfdbinary.readouterr().out)
    frames = [message for message, _ in read_recording(IQ) if isinstance(message, BasebandIq)]
    assert len(frames) == 40
    for chart, of in (("amplitude", np.hypot), ("phase", lambda i, q: np.arctan2(q, i))):
        found = [
            tensor(value)
            for _, value in rows(drawn, f"/baseband_iq/{chart}", "BarChart:values")
            if value
        ]
        for values, frame in zip(found, frames, strict=True):
            np.testing.assert_allclose(values, of(frame.i, frame.q), rtol=1e-6)
    ((_, places),) = rows(drawn, "/baseband_iq/amplitude", "BarChart:abscissa")
    np.testing.assert_allclose(tensor(places), 0.4 + 0.05138 * np.arange(10), atol=1e-6)


def test_what_is_for_other_importers_is_left_to_them(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert INCOMPATIBLE == rr.EXTERNAL_IMPORTER_INCOMPATIBLE_EXIT_CODE
    foreign = tmp_path / "other.dat"
    foreign.write_bytes(bytes(range(256)))
    session = tmp_path / "session.mcap"
    session.write_bytes(b"\x89MCAP0\r\n")
    pipe = tmp_path / "pipe.xtwire"
    os.mkfifo(pipe)
    empty = tmp_path / "folder"
    empty.mkdir()
    for path in (foreign, session, pipe, empty, tmp_path / "missing.dat", REPOSITORY / "README.md"):
        assert main([str(path), "--recording-id", "r"]) == INCOMPATIBLE, path
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "cut"),
        (b"no capture at all, whatever its name", "is not a wire capture"),
        (b"\x89XTWIRE\n" + struct.pack("<II", 9, 0), "version 9"),
    ],
)
def test_a_capture_with_a_damaged_head_ends_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], content: bytes, reason: str
) -> None:
    path = tmp_path / "line.xtwire"
    path.write_bytes(content)
    assert main([str(path)]) == 1
    out, err = capfd.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    assert line.startswith(f"rerun-importer-xethru: {path}")
    assert reason in line


def test_a_cut_capture_is_drawn_as_far_as_it_goes(
    wire: Path, tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    cut, drawn = tmp_path / "cut.xtwire", tmp_path / "cut.rrd"
    cut.write_bytes(wire.read_bytes()[:100_000])
    assert main([str(cut)]) == 1
    out, err = capfdbinary.readouterr()
    drawn.write_bytes(out)
    (line,) = err.decode().splitlines()
    assert line.startswith(f"rerun-importer-xethru: {cut}: damaged; cut.xtwire: the last chunk")
    shown = [v for _, v in rows(drawn, "/data_float/amplitude", "BarChart:values") if v]
    frame_bytes = 13 + 4 + 1 + 1 + 4 * 4 + 4 * N_BINS  # a chunk with one frame, not less
    assert 100_000 // frame_bytes - 5 <= len(shown) <= 100_000 // (4 * N_BINS)
    assert any("last chunk" in text for _, (text,) in rows(drawn, "/log", "TextLog:text"))


@pytest.mark.parametrize("kind", ["wire", "every_kind"])
def test_damage_anywhere_ends_in_at_most_one_line(
    wire: Path, tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes], kind: str
) -> None:
    rng = np.random.default_rng(11)
    for case in range(4):
        folder = tmp_path / str(case)
        if kind == "wire":
            folder.mkdir()
            recording = folder / wire.name
            recording.write_bytes(wire.read_bytes()[:40_000])
            files = [recording]
        else:
            recording = shutil.copytree(FIXTURES / "recordings" / kind, folder)
            files = sorted(recording.iterdir())
        for file in files:
            content = np.frombuffer(file.read_bytes(), np.uint8).copy()
            places = rng.integers(0, len(content), 1 + len(content) // 400)
            content[places] = rng.integers(0, 256, len(places))
            file.write_bytes(content.tobytes())
        code = main([str(recording), "--recording-id", f"{kind}-{case}"])
        out, err = capfdbinary.readouterr()
        lines = err.decode().splitlines()
        assert (code, len(lines)) in {(0, 0), (1, 1)}, lines
        if out:
            drawn = tmp_path / f"{case}.rrd"
            drawn.write_bytes(out)
            assert count_rows(drawn)["/about (static)"] == 1


def test_it_is_installed_under_the_name_that_the_viewer_looks_for() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    module, _, function = project["scripts"]["rerun-importer-xethru"].partition(":")
    assert getattr(import_module(module), function) is main


@pytest.mark.thorough
@pytest.mark.skipif(not HAS_LAVAPIPE, reason="Mesa's lavapipe (mesa-vulkan-drivers) is missing")
def test_a_viewer_opens_a_capture_by_its_path(
    wire: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "rerun-importer-xethru"
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m slam.app.view.importer "$@"\n')
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    picture = tmp_path / "viewer.png"
    with SlamViewerProcess(ViewerKind.HEADLESS, wire) as viewer:
        viewer.wait_until_ready()
        client = ViewerClient.connect(viewer.url)
        give_up = time.monotonic() + seconds(20)
        while True:
            try:
                client.set_time("device_time", duration=7.0)
                break
            except ConnectionError:  # no timelines yet
                assert time.monotonic() < give_up
                time.sleep(0.1)
        time.sleep(1.0)
        client.save_screenshot(str(picture))
        errors = [entry for entry in client.get_logs() if entry.level == "ERROR"]
    assert errors == []
    assert picture.stat().st_size > 50_000
