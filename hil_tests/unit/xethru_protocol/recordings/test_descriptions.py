"""What a recorder knew of the module is in the recording, in every format, also if converted."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.playback import played_radars
from emulator.scene.scene import load_scene
from emulator.x4m300 import radar_device
from hil_tests.unit.emulator.doubles import IDENTITY, BareHost
from hil_tests.unit.xethru_protocol.pty_module import PtyModule
from hil_tests.unit.xethru_protocol.recordings.messages import MS, frame
from xethru_protocol.cli import main
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.recordings import (
    Recorder,
    RecordingWriter,
    convert,
    load,
    read_recording,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.x4 import real_frame_rate

ABOUT = "xethru_radar.json"
FPS = 17.0


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[float, float]]:
    """Return a recording by `Recorder`, and the frame area that the module read back."""
    source = echo_source(load_scene("lab"), 0, seed=1)
    line = LoopbackTransport(radar_device(IDENTITY, source, Pace.ASAP))
    with X4M300(line, clock=line.clock_ns) as radar:
        geometry = radar.configure_raw(RawConfig(frame_area_m=(0.4, 2.0), downconversion=True))
        with Recorder(radar, tmp_path_factory.mktemp("r"), clock=line.clock_ns) as recorder:
            radar.start(FPS)
            list(radar.frames(6))
    assert recorder.directory is not None
    return recorder.directory, geometry.area_m


def check(path: Path, area_m: tuple[float, float]) -> None:
    radar = load(path).radar
    assert radar.kind == "iq"
    assert radar.ranges_m is not None
    assert (radar.ranges_m[0], radar.ranges_m[-1]) == pytest.approx(area_m, abs=1e-6)
    assert radar.frame_rate_hz == pytest.approx(real_frame_rate(FPS))
    assert radar.settings["DOWNCONVERSION"] == 1
    assert radar.settings["FRAMEBINCOUNT"] == radar.n_bins


def test_a_recorder_keeps_what_the_driver_knew(
    recorded: tuple[Path, tuple[float, float]],
) -> None:
    directory, area_m = recorded
    check(directory, area_m)
    (file,) = directory.glob("xethru_datafloat_*")
    check(file, area_m)
    (played,) = played_radars(directory, on_fault=lambda fault: pytest.fail(fault.reason))
    answer = BareHost(played.device).ask(m.X4DriverGet(setting=X4Setting.FRAMEAREA))
    assert isinstance(answer, m.ReplyFloat)
    assert answer.values == pytest.approx(area_m, abs=1e-6)


@pytest.mark.parametrize(
    "way", [["a.mcap"], ["a.xtwire"], ["copy"], ["a.mcap", "a.xtwire", "copy"]]
)
def test_a_conversion_keeps_it(
    way: list[str], recorded: tuple[Path, tuple[float, float]], tmp_path: Path
) -> None:
    source, area_m = recorded
    for target in way:
        convert(source, tmp_path / target)
        source = tmp_path / target
        check(source, area_m)


def test_the_module_s_answers_in_a_capture_are_kept_where_there_is_no_place_for_them(
    module: PtyModule, tmp_path: Path
) -> None:
    arguments = ["--wire", str(tmp_path / "a.xtwire"), "--count", "3"]
    assert main(["record", "--port", module.path, *arguments]) == 0
    expected = load(tmp_path / "a.xtwire").radar.ranges_m
    convert(tmp_path / "a.xtwire", tmp_path / "copy")
    found = load(tmp_path / "copy").radar.ranges_m
    assert expected is not None
    assert found is not None
    assert found.tolist() == pytest.approx(expected.tolist())


def test_a_recorded_directory_can_be_viewed(
    module: PtyModule, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first command of the README, then the next one."""
    out = tmp_path / "rec"
    options = ["--split-directories", "4records", "--baseband", "--count", "6", "--fps", "17"]
    assert main(["record", "--port", module.path, "--out", str(out), *options]) == 0
    assert load(out).radar.true_ranges_m is not None
    inner = sorted(out.glob("xethru_recording_*"))
    assert [load(path).radar.ranges_m is not None for path in inner] == [True, True]
    capsys.readouterr()
    assert main(["view", str(out), "--terminal", "--rate", "0"]) == 0


def _is_of_another_session(directory: Path) -> None:
    (directory / ABOUT).write_text('{"session_id": "other", "radar": {"n_bins": 3}}')


@pytest.mark.parametrize(
    "spoil",
    [
        _is_of_another_session,
        *(
            lambda path, text=text: (path / ABOUT).write_text(text)
            for text in ("", "[", "[]", '{"radar": 5}', "[" * 100_000)
        ),
        lambda path: (path / ABOUT).unlink(),
    ],
)
def test_a_description_that_makes_no_sense_costs_itself(
    spoil: Callable[[Path], object], recorded: tuple[Path, tuple[float, float]], tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(recorded[0], tmp_path / "copy"))
    spoil(copy)
    radar = load(copy).radar
    assert radar.ranges_m is None
    assert radar.n_frames == len(list(read_recording(recorded[0])))


@pytest.mark.parametrize("value", ["x", [1], None, float("nan"), {}])
def test_a_length_that_is_none_is_unknown(value: object, tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "r") as writer:
        writer.describe({"n_bins": 3, "range_start_m": value, "bin_length_m": 0.05})
        writer.write(frame(1, 3), MS)
    radar = load(tmp_path / "r").radar
    assert (radar.kind, radar.ranges_m) == ("rf", None)
