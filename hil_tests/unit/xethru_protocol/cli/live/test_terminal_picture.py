"""The picture in text: what each letter stands for, and that it fits."""

import re

import numpy as np
import pytest

from xethru_protocol.cli.live.analysis import LiveUpdate, VitalAnswer
from xethru_protocol.cli.live.terminal_picture import Style, picture
from xethru_protocol.processing.doppler import RangeDoppler

COLOUR = re.compile(r"\x1b\[[\d;]*m")


def update(*, n_bins: int = 30, n_rows: int = 4, with_doppler: bool = False) -> LiveUpdate:
    """Amplitudes of 1, but for 100 in bin 10, and in bin 20 of the newest frame a third in dB."""
    waterfall = np.ones((n_rows, n_bins), np.float32)
    waterfall[:, 10] = 100.0
    waterfall[0, 20] = 10 ** (2 / 3)
    doppler = None
    if with_doppler:
        velocities_mps = np.array([-0.1, 0.0, 0.1])
        power = np.ones((3, n_bins))
        power[2, 10] = 1e4
        doppler = RangeDoppler(
            power=power, frequencies_hz=velocities_mps, velocities_mps=velocities_mps
        )
    return LiveUpdate(
        name="port",
        clutter="mean",
        t_s=1.5,
        n_frames=3,
        n_lost=2,
        frame_rate_hz=2.0,
        carrier_hz=7.29e9,
        ranges_m=np.linspace(1.0, 3.9, n_bins),
        profile=waterfall[0],
        rf_ranges_m=None,
        rf=None,
        waterfall=waterfall,
        waterfall_s=2.0,
        doppler=doppler,
        chest_s=None,
        chest_mm=None,
        vital=VitalAnswer(t_s=1.5, heard_s=1.5, window_s=60.0, breathing=None, presence=None),
    )


ASCII = """\
1.5 s, 3 frames, 2.0/s, 2 lost, clutter
listening: 2 of 60 s
-------- newest frame, 0 to 40 dB ------
                   |
                   |         :
-------- last 2 s, newest above --------
     now           @         -
                   @
                   @
    -2 s           @
         +---------+---------+---------
       m 1         2         3"""

UNICODE = """\
1.5 s, 3 frames, 2.0/s, 2 lost, clutter
listening: 2 of 60 s
──────── newest frame, 0 to 40 dB ──────
                   █
                   █         ▅
──────── last 2 s, newest above ────────
     now           █         ░
                   █
                   █
    -2 s           █
         ┬─────────┬─────────┬─────────
       m 1         2         3"""


@pytest.mark.parametrize(("style", "expected"), [(Style.ASCII, ASCII), (Style.UNICODE, UNICODE)])
def test_a_letter_is_a_cell(style: Style, expected: str) -> None:
    drawn = picture(update(), 40, 12, style)
    assert [line.rstrip() for line in drawn] == expected.splitlines()


def test_in_colour_a_letter_is_two_cells() -> None:
    lines = picture(update(n_rows=8), 40, 12, Style.COLOUR)
    now, later = lines[6], lines[7]
    # white upon white in bin 10; a third of 14 steps is the colour of index 5, upon black
    assert now.count("\x1b[38;5;231;48;5;231m▀") == 1
    assert now.count("\x1b[38;5;126;48;5;16m▀") == 1
    assert COLOUR.sub("", now) == "     now " + "▀" * 30
    assert "126" not in later


def test_velocities_stand_beside_the_map() -> None:
    lines = picture(update(with_doppler=True), 40, 18, Style.ASCII)
    first = lines.index("-------- range-Doppler, approaching abov") + 1
    # three velocities in four lines
    assert [line.rstrip() for line in lines[first:-2]] == [
        "   +0.10           @",
        "                   @",
        "   0 m/s",
        "   -0.10",
    ]


@pytest.mark.parametrize("style", Style)
@pytest.mark.parametrize("size", [(1, 1), (40, 12), (80, 24), (79, 18), (200, 61)])
def test_it_fits(size: tuple[int, int], style: Style) -> None:
    columns, rows = size
    for drawn in (update(n_bins=175, n_rows=512, with_doppler=True), update(n_bins=24, n_rows=2)):
        lines = picture(drawn, columns, rows, style)
        assert len(lines) == max(rows, 12)
        assert max(len(COLOUR.sub("", line)) for line in lines) <= max(columns, 40)


def test_what_was_not_measured_yet_is_dark() -> None:
    empty = update()
    empty.waterfall[1:] = 0
    lines = picture(empty, 40, 12, Style.ASCII)
    assert [line[9:].strip() for line in lines[6:10]] == ["@         -", "", "", ""]
