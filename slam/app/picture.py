"""What all our pictures share: style, colours, and how one becomes a file."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from PIL import Image

from slam.app.errors import naming

TRUTH, ODOMETRY, ESTIMATE, LANDMARK = "#8a8f98", "#e08a2c", "#1f6fd0", "#c2255c"
INK, PALE_INK, GRID = "#20242a", "#6a707a", "#eceef1"
_PALETTE = 256

# The same picture on every machine: no user style, no font that may be missing.
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 10.0,
    "axes.edgecolor": "#c8ccd2",
    "axes.labelcolor": "#40444c",
    "xtick.color": "#40444c",
    "ytick.color": "#40444c",
}


@contextmanager
def picture(path: Path, *, width_in: float, height_in: float, dpi: int = 100) -> Iterator[Figure]:
    """Give a figure to draw in, and write it as a PNG file at the end.

    Its colours are cut to a palette of 256, which makes the file a third of the size. No software
    version or date goes into it: the same figure gives the same bytes.

    Raises
    ------
    AppError
        The file cannot be written.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(width_in, height_in), dpi=dpi, layout="constrained", facecolor="white"
        )
        FigureCanvasAgg(figure)
        yield figure
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png")
        with Image.open(drawn) as colours:
            few = colours.convert("RGB").quantize(_PALETTE, dither=Image.Dither.NONE)
        with naming(path):
            few.save(path, format="png", optimize=True)


def svg_of(draw: Callable[[Figure], None], *, width_in: float, height_in: float) -> str:
    """Return what `draw` puts on a figure as the text of an SVG, the same for the same figure."""
    with matplotlib.rc_context(STYLE | {"svg.hashsalt": "xethru-hil"}):
        figure = Figure(figsize=(width_in, height_in), layout="constrained", facecolor="white")
        FigureCanvasSVG(figure)
        draw(figure)
        drawn = io.StringIO()
        figure.savefig(drawn, format="svg", metadata={"Date": None, "Creator": None})
    return drawn.getvalue()


def label(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    """Give a panel its title, its axes' names with units, and a quiet grid."""
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(length=0)
