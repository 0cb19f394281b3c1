"""What Rerun is sent: pictures that replace each other, by closed-form frames."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil_tests.unit.xethru_protocol.cli.live.test_terminal_picture import update

rr = pytest.importorskip("rerun")

from rerun.chunk import Chunk, RrdReader  # noqa: E402 - behind importorskip

from xethru_protocol.cli.live.analysis import LiveUpdate  # noqa: E402 - behind importorskip
from xethru_protocol.cli.live.rerun_view import RerunPicture, blueprint  # noqa: E402 - behind importorskip
from xethru_protocol.processing.vital import Breathing  # noqa: E402 - behind importorskip


def sent(path: Path, *pictures: LiveUpdate) -> list[Chunk]:
    """Return the chunks of an .rrd into which updates were drawn."""
    stream = rr.RecordingStream("xethru", recording_id="test")
    stream.save(path, default_blueprint=blueprint())
    drawing = RerunPicture(stream)
    for picture in pictures:
        drawing.draw(picture)
    stream.disconnect()
    return list(RrdReader(path).stream())


def test_amplitudes_become_pixels(tmp_path: Path) -> None:
    chunks = sent(tmp_path / "a.rrd", update())
    (image,) = (
        column.to_pylist()[-1][0]
        for chunk in chunks
        if str(chunk.entity_path) == "/range/waterfall"
        for name, column in zip(
            chunk.to_record_batch().schema.names, chunk.to_record_batch().columns, strict=True
        )
        if name.endswith("DepthImage:buffer")
    )
    pixels = np.asarray(image, dtype=np.uint8).reshape(4, 30)
    expected = np.zeros((4, 30), np.uint8)
    expected[:, 10] = 255
    expected[0, 20] = 85  # a third of the decibels
    np.testing.assert_array_equal(pixels, expected)


def test_nothing_but_the_rate_grows(tmp_path: Path) -> None:
    found = Breathing(rate_bpm=15.0, confidence=0.9, range_m=2.0)
    first = update(with_doppler=True)
    breathes = replace(first.vital, breathing=found)
    later = [replace(first, t_s=1.5 + k, vital=breathes) for k in range(4)]
    rows = Counter[str]()
    for chunk in sent(tmp_path / "b.rrd", first, *later):
        path = str(chunk.entity_path)
        if not chunk.is_static and not path.startswith("/__"):
            rows[path] += chunk.num_rows
    assert rows == {"/breathing": 4}


def test_what_did_not_change_is_not_sent_again(tmp_path: Path) -> None:
    once = update()
    both = sum(chunk.num_rows for chunk in sent(tmp_path / "c.rrd", once, replace(once, t_s=3.0)))
    alone = sum(chunk.num_rows for chunk in sent(tmp_path / "d.rrd", once))
    assert both == alone + 1  # the time in words
