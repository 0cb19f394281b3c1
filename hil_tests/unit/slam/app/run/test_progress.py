"""The progress line: what it says, how often, and the difference a terminal makes."""

import io

from hil_tests.unit.slam.app.sessions import FRAME_NS, scan, session_info, snapshot
from slam.app.records import LogLine
from slam.app.run.output import Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_line_has_time_rate_error_landmarks_and_losses() -> None:
    now = [0.0]
    progress = Progress(
        session_info(), 100 * FRAME_NS, lambda: 3, stream=io.StringIO(), clock=lambda: now[0]
    )
    for counter in range(51):
        progress.on_scan(scan(counter))
    progress.on_snapshot(snapshot(50))
    now[0] = 0.5
    # 51 frames of each radar in half a second; the made-up estimate is 10 mm off
    assert progress.line() == (
        "scene time   10.0 of 19.9 s    102 frames/s per radar"
        "  pose error   10.0 mm  2 landmarks  3 frames lost"
    )


def test_plain_lines_come_every_ten_seconds() -> None:
    now, stream = [0.0], io.StringIO()
    progress = Progress(session_info(), FRAME_NS, lambda: 0, stream=stream, clock=lambda: now[0])
    for counter in range(31):
        now[0] = float(counter)
        progress.on_scan(scan(counter))
    assert len(stream.getvalue().splitlines()) == 3
    progress.close()
    assert len(stream.getvalue().splitlines()) == 4
    assert "\r" not in stream.getvalue()


def test_a_terminal_gets_one_line_rewritten() -> None:
    now, stream = [0.0], Terminal()
    progress = Progress(session_info(), FRAME_NS, lambda: 0, stream=stream, clock=lambda: now[0])
    for counter in range(20):
        now[0] = counter / 8
        progress.on_scan(scan(counter))
    progress.close()
    assert stream.getvalue().count("\n") == 1
    # every second scan is a quarter of a second after the last line, and one at the end
    assert stream.getvalue().count("\r\x1b[K") == 10


def test_a_warning_about_a_link_is_shown_at_once() -> None:
    stream = io.StringIO()
    progress = Progress(session_info(), FRAME_NS, lambda: 0, stream=stream)
    progress.on_log(LogLine(t_ns=0, radar="left", warning=False, text="Ping"))
    progress.on_log(LogLine(t_ns=0, radar="left", warning=True, text="checksum"))
    assert stream.getvalue() == "warning: radar left: checksum\n"
