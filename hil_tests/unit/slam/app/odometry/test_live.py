"""Odometry as it comes: its sources of text, what is refused, and when a source counts as dead."""

import os
import pty
import socket
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from hil_tests.patience import seconds
from hil_tests.unit.slam.app.run.virtual_rig import straight_odometry
from slam.app.errors import UsageError
from slam.app.odometry.live import (
    LineSource,
    LiveOdometry,
    SourceKind,
    parse_source,
    read_lines,
)
from slam.live.arrival_clock import ClockLine
from slam.live.errors import OdometryError

NS_PER_S = 1_000_000_000


def line(t_s: float, x_m: float = 0.0) -> str:
    return f"{t_s:.9f} {x_m!r} 0 0 0 0 0 1"


def fed(*lines: str, gap_ns: int = 50_000_000) -> tuple[LiveOdometry, list[str]]:
    odometry = LiveOdometry("a test")
    said = [odometry.take(text, number * gap_ns)[1] for number, text in enumerate(lines)]
    return odometry, said


def test_comments_and_empty_lines_are_passed_over_without_a_word() -> None:
    odometry, said = fed("# timestamp x y z qx qy qz qw", "", "  ", line(1.0))
    assert said == ["", "", "", ""]
    assert odometry.n_refused == 0
    assert odometry.last_ns == NS_PER_S


def test_stamps_that_jump_back_are_refused_and_said_once() -> None:
    odometry, said = fed(line(5.0), line(5.1), *(line(2.0 + 0.1 * n) for n in range(4)), line(5.2))
    assert said[2] == "its stamps jumped back by 3.100 s; such lines are passed over"
    assert said[3:6] == ["", "", ""]
    assert said[6] == "its lines are sound again"
    assert odometry.n_refused == 4
    np.testing.assert_array_equal(odometry.pose_at(5_100_000_000), [0.0, 0.0, 0.0])


def test_rubbish_is_refused_twice_said_and_never_fatal() -> None:
    odometry, said = fed(line(1.0), *["rubbish"] * 8, line(1.1))
    assert said[1].startswith("expected 8 numbers")
    assert said[5].endswith("further ones are not reported")
    assert [text for text in said if text] == [said[1], said[5], said[9]]
    assert odometry.n_refused == 8


def test_a_pose_that_jumps_and_a_gap_are_said() -> None:
    _, said = fed(line(1.0), line(1.1, 4.0), line(4.1, 4.0))
    assert "the pose jumped by 4.00 m in 0.100 s" in said[1]
    assert said[2].startswith("3.0 s of it are missing")


def test_a_restarted_source_is_said_and_does_not_move_the_robot() -> None:
    driven = [line(1.0 + 0.1 * k, 0.05 * k) for k in range(20)]
    odometry, said = fed(*driven, *(line(3.0 + 0.1 * k, 0.05 * k) for k in range(5)))
    assert said[20] == (
        "the pose jumped by 0.95 m in 0.100 s, as when its source is restarted; SLAM does not take "
        "it for a drive"
    )
    assert [text for text in said if text] == [said[20]]
    assert odometry.pose_at(3_400_000_000) == pytest.approx([1.2, 0.0, 0.0])
    assert odometry.frame_at(3_400_000_000) == pytest.approx([1.0, 0.0, 0.0])


def test_poses_are_known_between_samples_that_are_near_only() -> None:
    odometry, _ = fed(line(1.0), line(1.5), line(4.0))
    known = {t_s: odometry.is_known(round(t_s * NS_PER_S)) for t_s in (0.9, 1.0, 1.3, 1.5, 2, 4, 5)}
    assert known == {0.9: False, 1.0: True, 1.3: True, 1.5: True, 2: False, 4: True, 5: False}
    covered = [odometry.covers(round(t_s * NS_PER_S)) for t_s in (3.9, 4.0, 4.1)]
    assert covered == [True, True, False]


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ((), "odometry from a test: no line for 10 s; is its sender running?"),
        ((line(1.0),), "odometry from a test: no more line for 10 s; is its sender running?"),
        (("a b",), "odometry from a test: no usable line for 10 s: expected 8 numbers"),
        ((line(9.0), line(1.0)), "no usable line for 10 s: its stamps jumped back by 8.000 s"),
    ],
)
def test_a_source_without_new_poses_is_silent_after_a_while(lines: tuple[str], words: str) -> None:
    odometry, _ = fed(*lines)
    assert odometry.silence(10 * NS_PER_S, 0) == ""
    assert words in odometry.silence(11 * NS_PER_S, 0)
    odometry.end("")
    assert odometry.silence(11 * NS_PER_S, 0) == ""  # the end is known, which is something else


def test_its_clock_is_told_by_arrivals_through_a_burst_and_jitter() -> None:
    """Whoever joins late gets all old lines at once; they say nothing about the clock."""
    odometry = LiveOdometry("a test")
    generator = np.random.default_rng(4)
    zero_ns, joined_ns = 1_000 * NS_PER_S, 1_008 * NS_PER_S
    for stamp_ns, text in straight_odometry(60.0):
        delay_ns = int(generator.exponential(2e6))
        odometry.take(text, max(zero_ns + stamp_ns + delay_ns, joined_ns))
    for t_s in (9.0, 30.0, 60.0):
        host_ns = zero_ns + round(t_s * NS_PER_S)
        assert abs(odometry.session_ns(host_ns) - t_s * NS_PER_S) < 1_000_000
    assert odometry.drift_ppm == pytest.approx(0.0, abs=5.0)


def test_a_clock_that_is_known_needs_no_arrivals() -> None:
    odometry = LiveOdometry("a file", ClockLine(origin_ns=5 * NS_PER_S))
    assert odometry.session_ns(7 * NS_PER_S) == 2 * NS_PER_S
    odometry.take(line(1.0), 0)
    assert odometry.drift_ppm is None
    assert odometry.session_ns(7 * NS_PER_S) == 2 * NS_PER_S


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (line(5.0, 1.0), "stamp 5.000 s came twice"),
        *((line(stamp_s), "the range of a session") for stamp_s in (-0.001, -3e9, 2.0**31, 9e9)),
        *((line(5.1, x_m), "is nowhere on Earth") for x_m in (1e9, -1e308)),
    ],
)
def test_poses_that_neither_a_session_nor_the_filter_takes_are_refused(
    bad: str, words: str
) -> None:
    odometry, said = fed(line(5.0), bad, line(5.2))
    assert words in said[1]
    assert odometry.n_refused == 1
    assert odometry.last_ns == 5_200_000_000
    assert odometry.pose_at(5 * NS_PER_S)[0] == 0.0


def test_a_source_that_ends_without_a_pose_says_what_was_wrong_with_its_lines() -> None:
    odometry, _ = fed("-1 0 0 0 0 0 0 1")
    odometry.end("")
    assert "ended before its first pose: stamp -1.000 s is outside 0 to" in odometry.trouble


@pytest.mark.parametrize(
    ("origin_s", "now_s", "fits"),
    [(0, 103, True), (0, 5000, False), (5000, 103, False), (-1_700_000_000, 103, False)],
)
def test_stamps_of_another_clock_than_the_one_named_are_told(
    origin_s: int, now_s: int, fits: bool
) -> None:
    odometry = LiveOdometry("a test", ClockLine(origin_ns=origin_s * NS_PER_S))
    odometry.take(line(100.0), 0)
    said = odometry.clock_mismatch(now_s * NS_PER_S)
    assert (said == "") is fits
    assert fits or "its stamps are of another clock" in said


LINES = ["0.1 0 0 0 0 0 0 1", "# a comment", "0.2 0 0 0 0 0 0 1"]
TEXT = "\n".join(LINES).encode()


def lines_of(source: LineSource) -> list[str]:
    got = list(read_lines(source, lambda: False))
    assert all(arrival_ns > 0 for _, arrival_ns in got)
    return [text for text, _ in got]


@pytest.fixture
def threads() -> Iterator[Callable[[Callable[[], object]], None]]:
    started: list[threading.Thread] = []

    def start(work: Callable[[], object]) -> None:
        started.append(threading.Thread(target=work))
        started[-1].start()

    yield start
    for thread in started:
        thread.join(timeout=seconds(5))
        assert not thread.is_alive()


@pytest.mark.parametrize("kind", [SourceKind.FILE, SourceKind.FIFO])
def test_a_file_or_a_fifo_is_read_to_its_end(
    tmp_path: Path, threads: Callable[[Callable[[], object]], None], kind: SourceKind
) -> None:
    path = tmp_path / "drive.tum"
    if kind is SourceKind.FIFO:
        os.mkfifo(path)
        threads(lambda: path.write_bytes(TEXT))  # which waits for its reader
    else:
        path.write_bytes(TEXT)
    source = parse_source(str(path))
    assert (source.kind, source.is_live) == (kind, kind is SourceKind.FIFO)
    assert lines_of(source) == LINES


@pytest.mark.parametrize("prefix", ["unix:", "", "tcp:"])
def test_a_socket(
    prefix: str, tmp_path: Path, threads: Callable[[Callable[[], object]], None]
) -> None:
    is_tcp = prefix == "tcp:"
    with socket.socket(socket.AF_INET if is_tcp else socket.AF_UNIX) as listener:
        listener.bind(("127.0.0.1", 0) if is_tcp else str(tmp_path / "s"))
        listener.listen()
        threads(lambda: serve(listener))
        path = f"//127.0.0.1:{listener.getsockname()[1]}" if is_tcp else str(tmp_path / "s")
        source = parse_source(prefix + path)
        assert source.kind is (SourceKind.TCP if is_tcp else SourceKind.UNIX)
        assert lines_of(source) == LINES


def serve(listener: socket.socket) -> None:
    connection, _ = listener.accept()
    with connection:
        for byte in TEXT:  # however they are cut
            connection.sendall(bytes([byte]))


def test_a_serial_port_and_its_unplugging() -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    name = os.ttyname(slave)
    source = parse_source(f"serial:{name}@57600")
    assert source == LineSource(kind=SourceKind.SERIAL, place=name, number=57600)
    assert parse_source(name).kind is SourceKind.SERIAL
    lines = read_lines(source, lambda: False)
    timer = threading.Timer(0.2, lambda: os.write(master, TEXT + b"\n"))
    timer.start()
    try:
        assert [next(lines)[0] for _ in LINES] == LINES
        os.close(master)
        with pytest.raises(OdometryError):
            next(lines)
    finally:
        timer.join()
        os.close(slave)


def test_bytes_that_are_no_lines_end_it(tmp_path: Path) -> None:
    (path := tmp_path / "image").write_bytes(bytes(range(1, 10)) * 10_000)
    with pytest.raises(OdometryError):
        lines_of(LineSource(kind=SourceKind.FILE, place=str(path)))


def test_it_stops_when_it_is_told_to(tmp_path: Path) -> None:
    os.mkfifo(path := tmp_path / "silent")
    asked = iter([False, True])
    assert list(read_lines(parse_source(str(path)), lambda: next(asked))) == []


def test_a_source_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(OdometryError):
        lines_of(parse_source(f"unix:{tmp_path}/none"))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(OdometryError, match=f"TCP socket 127.0.0.1:{port}: Connection refused"):
        lines_of(parse_source(f"tcp://127.0.0.1:{port}"))


@pytest.mark.parametrize(
    "text",
    [f"tcp://h:{'9' * 5000}", "tcp://h:²", f"serial:p@{'9' * 5000}", "serial:p@²", "serial:p@0"],
)
def test_numbers_that_are_none_are_wrong_usage(text: str) -> None:
    with pytest.raises(UsageError):
        parse_source(text)


@pytest.mark.parametrize("host", ["a..б", "a" * 300 + "б", "a\udcffb"])
def test_what_is_no_name_of_a_host_is_one_line(host: str) -> None:
    with pytest.raises(OdometryError):
        lines_of(parse_source(f"tcp://{host}:1"))


@pytest.mark.parametrize(
    ("triangle", "words"),
    [
        ("", "does not say how its velocity errs"),
        (" 0 0 0 0 0 0", "does not say how its velocity errs"),
        (" 1 2 0 1 0 1", "eigenvalues of -1 to "),
        (" -1 0 0 1 0 1", "eigenvalues of -1 to "),
        (" 0.01 0 0 1e6 0 0.01", "unknown"),
    ],
)
def test_where_a_covariance_is_asked_for_lines_without_a_good_one_are_refused(
    triangle: str, words: str
) -> None:
    odometry = LiveOdometry("a test", has_covariance=True)
    assert words in odometry.take(line(1.0) + triangle, 0)[1]
    assert not odometry
    sample, warning = odometry.take(line(1.0) + " 0.01 0 0 0 0 0.02", 0)  # no sideways error at all
    assert sample is not None
    assert sample.velocity_covariance == (0.01, 0.0, 0.0, 0.0, 0.0, 0.02)
    assert "sound again" not in warning
    assert LiveOdometry("a test").take(line(1.0) + triangle, 0)[0] is not None
