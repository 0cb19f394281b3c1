"""Whether radar frames are RF or baseband: from the module's answers, from their content, or not.

Frames come from the emulator, whose settings are known.
"""

from pathlib import Path

import numpy as np
import pytest

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.scene.scene import empty_room, load_scene
from emulator.x4m300 import radar_device
from hil_tests.unit.emulator.doubles import IDENTITY
from hil_tests.unit.xethru_protocol.recordings.messages import xethru
from xethru_protocol.cli import main
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.recordings import RecordingWriter, describe_recording
from xethru_protocol.recordings.frame_layout import FrameLayout, FrameLayouts
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting


def recorded(scene: str, area_m: tuple[float, float], *, downconversion: bool) -> list[m.Response]:
    """Return what a module sends: the answers to its setting up, and eight frames."""
    room = load_scene(scene) if scene else empty_room()
    line = LoopbackTransport(radar_device(IDENTITY, echo_source(room, 0, seed=1), Pace.ASAP))
    heard: list[m.Response] = []
    with X4M300(line, clock=line.clock_ns) as radar:
        radar.listener = lambda message, t_ns: heard.append(message)
        radar.configure_raw(RawConfig(frame_area_m=area_m, downconversion=downconversion))
        radar.start(17)
        list(radar.frames(8))
    return heard


def layout_of(messages: list[m.Response], known: bool | None = None) -> FrameLayout:
    layouts = FrameLayouts(known)
    for message in messages:
        layouts.take(message)
    (found,) = layouts.layouts().values()
    return found


@pytest.mark.parametrize("downconversion", [False, True])
@pytest.mark.parametrize(
    ("scene", "area_m"),
    [("lab", (0.4, 2.0)), ("visitor", (0.2, 2.5)), ("", (0.4, 1.2)), ("lab", (3.0, 5.0))],
)
def test_answers_are_certain_and_content_is_probable(
    scene: str, area_m: tuple[float, float], downconversion: bool
) -> None:
    heard = recorded(scene, area_m, downconversion=downconversion)
    frames = [message for message in heard if isinstance(message, m.DataFloat)]
    certain, inferred = layout_of(heard), layout_of(list(frames))
    assert certain.downconversion is inferred.downconversion is downconversion
    assert not certain.inferred
    assert inferred.inferred is (certain.values % 2 == 0 and certain.values <= 376)
    assert layout_of(list(frames), True).downconversion is (certain.values % 2 == 0)


@pytest.mark.parametrize("bin_at", [0, 1, 15, -1])
@pytest.mark.parametrize("times", [30, 1e4])
@pytest.mark.parametrize("downconversion", [False, True])
def test_one_bin_that_outshines_the_others_does_not_decide(
    downconversion: bool, times: float, bin_at: int
) -> None:
    """As the direct path does in the first bin of real frames."""
    heard = recorded("lab", (0.4, 2.0), downconversion=downconversion)
    frames: list[m.Response] = []
    for message in heard:
        if isinstance(message, m.DataFloat):
            parts = message.values.reshape(2, -1).copy()
            parts[:, bin_at] += np.float32(times) * np.abs(parts).max() * np.array((1, -0.7), "f4")
            frames.append(m.DataFloat(info=message.info, values=parts.ravel()))
    assert layout_of(frames).downconversion is downconversion


def test_what_is_inferred_or_unknown_names_the_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    smooth = np.sin(np.arange(100) / 5, dtype=np.float32)
    for name, values in (("inferred", smooth), ("unknown", np.ones(100, np.float32))):
        with RecordingWriter(tmp_path / name) as writer:
            writer.write(m.DataFloat(info=1, values=values), 0)
        assert "--frames rf or baseband" in xethru(capsys, "dump", tmp_path / name)
    assert main(["convert", str(tmp_path / "inferred"), str(tmp_path / "a.csv")]) == 0
    assert "--frames rf or baseband" in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "unknown"), str(tmp_path / "b.csv")]) == 1
    assert "--frames rf or baseband" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("n_values", "downconversion"),
    [
        (1431, False),
        (1432, False),
        (378, False),
        (181, False),  # an odd number of values cannot be pairs
        (376, None),
        (14, None),  # too short to say
        (0, None),
    ],
)
def test_what_a_number_of_values_says(n_values: int, downconversion: bool | None) -> None:
    constant = m.DataFloat(info=1, values=np.full(n_values, 0.25, np.float32))
    found = layout_of([constant])
    assert (found.downconversion, found.inferred) == (downconversion, False)


def test_an_answer_of_another_time_does_not_count() -> None:
    def answer(count: int) -> m.Response:
        return m.ReplyInt(content_id=X4Setting.FRAMEBINCOUNT, values=(count,))

    frame = m.DataFloat(info=1, values=np.zeros(182, np.float32))
    assert str(layout_of([answer(100), frame])) == "182 values, RF or complex baseband"
    assert str(layout_of([answer(91), frame])) == "91 complex baseband bins"
    assert str(layout_of([answer(182), frame])) == "182 RF bins"


def test_values_that_are_no_numbers_are_left_out() -> None:
    values = np.sin(np.arange(100) / 5, dtype=np.float32)
    broken = values.copy()
    broken[3] = np.nan
    frames: list[m.Response] = [
        m.DataFloat(info=k, values=v) for k, v in enumerate((values, broken))
    ]
    assert layout_of(frames).downconversion is True
    assert layout_of(frames[1:]).downconversion is None


def test_a_summary_has_each_size_of_frames(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path) as writer:
        for n_values in (5, 5, 400):
            writer.write(m.DataFloat(info=1, values=np.zeros(n_values, np.float32)), 0)
        writer.write(m.DataFloat(content_id=4, info=1, values=np.zeros(7, np.float32)), 0)
    frames = describe_recording(tmp_path).frames
    assert [str(frames[size]) for size in (5, 400)] == ["5 RF bins", "400 RF bins"]
    assert len(frames) == 2


def test_dump_names_a_few_sizes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RecordingWriter(tmp_path) as writer:
        for n_values in (3, 3, 5, 7, 9, 9, 9, 400):
            writer.write(m.DataFloat(info=1, values=np.zeros(n_values, np.float32)), 0)
    lines = xethru(capsys, "dump", tmp_path).splitlines()
    told = [line for line in lines if line.startswith(("  frames of", "  and of"))]
    assert told == [
        "  frames of 9 RF bins",
        "  frames of 3 RF bins",
        "  frames of 5 RF bins",
        "  and of 2 other sizes",
    ]
