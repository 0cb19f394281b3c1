"""Lanes of link states: what frames, gaps and lines of the log make of them."""

from dataclasses import replace

from hil_tests.unit.slam.app.sessions import FRAME_NS, scan, session_info
from slam.app.records import LogLine
from slam.app.run.runner import LinkStates


def line(text: str, *, warning: bool = False, radar: str = "radar0") -> LogLine:
    return LogLine(t_ns=0, radar=radar, warning=warning, text=text)


def test_a_gap_in_the_counters_is_a_loss_until_the_next_frame() -> None:
    links = LinkStates(session_info(1).radars)
    changes = [
        (change.t_ns // FRAME_NS, str(change.state))
        for counter in (5, 6, 9, 10)
        for change in links.on_scan(scan(counter, 1))
    ]
    assert changes == [(5, "streaming"), (9, "frames lost"), (10, "streaming")]
    count = links.counts["radar0"]
    assert (count.frames, count.lost, count.longest_gap) == (4, 2, 2)


def test_a_radar_without_a_frame_in_a_tick_is_silent_and_others_go_on() -> None:
    links = LinkStates(session_info(2).radars)
    list(links.on_scan(scan(0)))
    both = scan(1)
    (change,) = links.on_scan(replace(both, frames=both.frames[:1]))
    assert (change.radar, str(change.state), change.t_ns) == ("radar1", "silent", FRAME_NS)
    changes = {change.radar: str(change.state) for change in links.on_scan(scan(2))}
    assert changes == {"radar1": "frames lost"}


def test_late_frames_that_slam_did_not_use_make_no_other_radar_silent() -> None:
    links = LinkStates(session_info(2).radars)
    list(links.on_scan(scan(0)))
    late = scan(1)
    assert list(links.on_scan(replace(late, frames=late.frames[:1], used=False))) == []


def test_a_module_is_set_up_streams_fails_and_streams_again() -> None:
    links = LinkStates(session_info(1).radars)
    states = [
        str(change.state)
        for changes in (
            links.on_log(line("tx SetMode")),
            links.on_log(line("rx Ack")),
            links.on_scan(scan(0, 1)),
            links.on_log(line("tx Ping")),
            links.on_log(line("fault CRC", warning=True)),
            links.on_scan(scan(1, 1)),
            links.end(2 * FRAME_NS),
        )
        for change in changes
    ]
    assert states == ["setting up", "streaming", "fault", "streaming", "ended"]
    assert links.counts["radar0"].faults == 1


def test_a_line_about_something_else_changes_no_lane() -> None:
    links = LinkStates(session_info(1).radars)
    assert list(links.on_log(line("stopped", warning=True, radar="odometry"))) == []
