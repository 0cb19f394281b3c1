"""A `LiveUpdate` as lines of text: frame, waterfall and range-Doppler over one range axis."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xethru_protocol.cli.live.analysis import LiveUpdate

_MARGIN = 9
_LEAST_SPAN_DB = 20.0
"""Noise alone varies by less, and stays dark."""
_TICK_COLUMNS = 7
STEPS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
"""From one round value of an axis to the next."""
_SMALLEST = (40, 12)
_WITHOUT_DOPPLER = 18

Levels = NDArray[np.float64]


class Style(Enum):
    """What the picture is made of: colours of half blocks, Unicode shades, or ASCII."""

    COLOUR = "colour"
    UNICODE = "unicode"
    ASCII = "ascii"


_SHADES = {Style.UNICODE: " ░▒▓█", Style.ASCII: " .:-=+*#%@"}
_BARS = {Style.UNICODE: " ▁▂▃▄▅▆▇█", Style.COLOUR: " ▁▂▃▄▅▆▇█", Style.ASCII: " .:|"}
_RAMP = (16, 17, 18, 54, 90, 126, 162, 198, 203, 208, 214, 220, 226, 229, 231)
"""Colours of the usual 256, from black over red to white."""
_BAR_COLOUR, _PLAIN = "\x1b[38;5;117m", "\x1b[0m"


def in_decibels(amplitude: NDArray[Any]) -> Levels:
    """Return 20 log10 of amplitudes; NaN for 0, where nothing was measured."""
    positive = np.where(amplitude > 0, amplitude, np.nan).astype(np.float64)
    return np.asarray(20 * np.log10(positive), dtype=np.float64)


def scale_of(decibels: Levels) -> tuple[float, float]:
    """Return what is drawn dark and what bright [dB]: the median, and the maximum."""
    measured = decibels[np.isfinite(decibels)]
    if not len(measured):
        return 0.0, _LEAST_SPAN_DB
    floor = float(np.median(measured))
    return floor, max(float(measured.max()), floor + _LEAST_SPAN_DB)


def levels(decibels: Levels, scale: tuple[float, float]) -> Levels:
    """Return brightness from 0 to 1; 0 where nothing was measured."""
    floor, top = scale
    return np.nan_to_num(np.clip((decibels - floor) / (top - floor), 0.0, 1.0))


def ticks_m(start_m: float, end_m: float, most: int) -> list[float]:
    """Return round ranges between two, at most so many.

    >>> ticks_m(0.2, 9.4, 5), ticks_m(0.4, 1.0, 4)
    ([2.0, 4.0, 6.0, 8.0], [0.4, 0.6, 0.8, 1.0])
    """
    for step in STEPS:
        first, last = np.ceil(start_m / step - 1e-6), np.floor(end_m / step + 1e-6)
        if last - first < most:
            return [round(float(number * step), 3) for number in np.arange(first, last + 1)]
    return []


def picture(update: LiveUpdate, columns: int, rows: int, style: Style) -> list[str]:
    """Draw an update.

    Parameters
    ----------
    columns, rows
        Size of the terminal; at least 40 x 12 are drawn.

    Returns
    -------
    list[str]
        ``rows`` lines without line ends, none with more than ``columns`` letters besides colours.
    """
    columns, rows = max(columns, _SMALLEST[0]), max(rows, _SMALLEST[1])
    width = columns - _MARGIN - 1
    n_profile = max(rows // 6, 2)
    n_doppler = 0 if rows < _WITHOUT_DOPPLER or update.doppler is None else max(rows // 4, 3)
    titles = 3 if n_doppler else 2
    n_waterfall = rows - 4 - titles - n_profile - n_doppler
    half = 2 if style is Style.COLOUR else 1

    waterfall = in_decibels(_pooled(update.waterfall, half * n_waterfall, width))
    scale = scale_of(waterfall)
    profile = levels(in_decibels(_pooled(update.profile[np.newaxis], 1, width)[0]), scale)

    lines = [_head(update)[:columns], update.vital.text[:columns]]
    lines.append(_title(f"newest frame, {scale[0]:.0f} to {scale[1]:.0f} dB", columns, style))
    lines += _with_margin([""] * n_profile, _bars(profile, n_profile, style))
    lines.append(_title(f"last {update.waterfall_s:.0f} s, newest above", columns, style))
    times = [-update.waterfall_s * row / n_waterfall for row in range(n_waterfall)]
    labels = [f"{time_s:.0f} s" if row % 3 == 0 else "" for row, time_s in enumerate(times)]
    lines += _with_margin(["now", *labels[1:]], _image(levels(waterfall, scale), style))
    if n_doppler and update.doppler is not None:
        lines.append(_title("range-Doppler, approaching above", columns, style))
        power = np.sqrt(update.doppler.power[::-1])
        doppler = in_decibels(_pooled(power, half * n_doppler, width))
        fastest = float(update.doppler.velocities_mps.max())
        labels = [""] * n_doppler
        labels[0], labels[n_doppler // 2], labels[-1] = (
            f"{fastest:+.2f}",
            "0 m/s",
            f"{-fastest:+.2f}",
        )
        lines += _with_margin(labels, _image(levels(doppler, scale_of(doppler)), style))
    return lines + _axis(update.ranges_m, width, style)


def _head(update: LiveUpdate) -> str:
    lost = f", {update.n_lost} lost" if update.n_lost else ""
    return (
        f"{update.t_s:.1f} s, {update.n_frames} frames, {update.frame_rate_hz:.1f}/s{lost}, "
        f"clutter {update.clutter}, {update.name}"
    )


def _title(text: str, columns: int, style: Style) -> str:
    line = "-" if style is Style.ASCII else "─"
    return f"{line * (_MARGIN - 1)} {text} ".ljust(columns, line)[:columns]


def _with_margin(labels: Sequence[str], drawn: Sequence[str]) -> list[str]:
    width = _MARGIN - 1
    return [f"{label:>{width}} {row}" for label, row in zip(labels, drawn, strict=True)]


def _pooled(values: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    """Return the greatest value of each cell of a grid; fewer values than cells are repeated."""
    for axis, cells in ((0, rows), (1, columns)):
        starts = np.arange(cells) * values.shape[axis] // cells
        values = np.maximum.reduceat(values, starts, axis=axis)
    return values


def _bars(heights: Levels, rows: int, style: Style) -> list[str]:
    """Draw heights from 0 to 1 as columns, the uppermost row first."""
    letters = _BARS[style]
    steps = len(letters) - 1
    filled = np.rint(heights * rows * steps).astype(int)
    lines = []
    for row in reversed(range(rows)):
        part = np.clip(filled - row * steps, 0, steps)
        line = "".join(letters[step] for step in part)
        lines.append(f"{_BAR_COLOUR}{line}{_PLAIN}" if style is Style.COLOUR else line)
    return lines


def _image(brightness: Levels, style: Style) -> list[str]:
    """Draw rows of cells; in colour two cells above each other in one letter."""
    if style is not Style.COLOUR:
        shades = _SHADES[style]
        numbers = np.rint(brightness * (len(shades) - 1)).astype(int)
        return ["".join(shades[number] for number in row) for row in numbers]
    colours = np.asarray(_RAMP)[np.rint(brightness * (len(_RAMP) - 1)).astype(int)]
    lines = []
    for above, below in zip(colours[::2], colours[1::2], strict=True):
        line, before = "", (-1, -1)
        for pair in zip(above.tolist(), below.tolist(), strict=True):
            if pair != before:
                line += f"\x1b[38;5;{pair[0]};48;5;{pair[1]}m"
                before = pair
            line += "▀"
        lines.append(line + _PLAIN)
    return lines


def _axis(ranges_m: NDArray[np.float64], width: int, style: Style) -> list[str]:
    line, tick = ("-", "+") if style is Style.ASCII else ("─", "┬")
    marks, labels = [line] * width, [" "] * (width + _MARGIN)
    start, end = float(ranges_m[0]), float(ranges_m[-1])
    for at_m in ticks_m(start, end, max(width // _TICK_COLUMNS, 2)):
        column = round((at_m - start) / max(end - start, 1e-9) * (width - 1))
        marks[column] = tick
        text = f"{at_m:g}"
        begin = _MARGIN + column - len(text) // 2
        labels[begin : begin + len(text)] = text
    labels[: _MARGIN - 1] = f"{'m':>{_MARGIN - 1}}"
    return [" " * _MARGIN + "".join(marks), "".join(labels)[: width + _MARGIN].rstrip()]
