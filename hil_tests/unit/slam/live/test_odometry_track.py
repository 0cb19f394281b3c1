"""TUM text and odometry: exact stamps, the same floats on every path, the short way round."""

import contextlib
import math
import socket
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from slam.app.odometry.live import LiveOdometry
from slam.geometry import between, compose, wrap_angle
from slam.live import odometry_track as track
from slam.live.errors import OdometryError
from slam.live.odometry_track import (
    OdometryTrack,
    Trajectory,
    TumError,
    TumSample,
    format_tum_line,
    parse_tum_line,
    read_odometry_socket,
    read_tum,
    write_tum,
)


def lines_of(rows: list[tuple[int, float, float, float]]) -> list[str]:
    return [format_tum_line(t_ns, np.array(pose)) for t_ns, *pose in rows]


def test_between_two_samples_it_is_linear_and_at_a_samples_own_time_the_sample() -> None:
    drive = OdometryTrack.from_lines(lines_of([(0, 0.1, 0.2, 0.0), (10**9, 1 / 3, -2.0, 1.0)]))
    assert drive.pose_at(10**9)[:2].tolist() == [1 / 3, -2.0]
    assert drive.pose_at(0)[:2].tolist() == [0.1, 0.2]
    expected = [0.1 + (1 / 3 - 0.1) / 4, 0.2 - 2.2 / 4, 0.25]
    np.testing.assert_allclose(drive.pose_at(250_000_000), expected)


@given(st.floats(-0.4, 0.4), st.floats(0.001, 0.1))
def test_on_an_arc_it_is_off_by_no_more_than_the_arcs_height(turn_rad: float, arc_m: float) -> None:
    """Chord / 2 tan(turn / 4), 0.12 mm for a centimetre and 5.6 degrees; the heading is exact."""

    def on_arc(part: float) -> tuple[float, float, float]:
        turned = part * turn_rad
        chord_m = part * arc_m * float(np.sinc(turned / math.tau))
        return chord_m * math.cos(turned / 2), chord_m * math.sin(turned / 2), turned

    end = on_arc(1.0)
    drive = OdometryTrack.from_lines(lines_of([(0, 0.0, 0.0, 0.0), (1000, *end)]))
    height_m = math.hypot(end[0], end[1]) / 2 * math.tan(abs(turn_rad) / 4)
    for part in (0.1, 0.25, 0.5, 0.9):
        x_m, y_m, heading_rad = drive.pose_at(round(1000 * part))
        assert heading_rad == pytest.approx(part * turn_rad, abs=1e-12)
        assert math.dist((x_m, y_m), on_arc(part)[:2]) <= height_m + 1e-12
    assert math.dist(drive.pose_at(500)[:2], on_arc(0.5)[:2]) == pytest.approx(height_m, abs=1e-12)


@pytest.mark.parametrize("turn_rad", [0.4, -0.4])
def test_heading_crosses_half_a_turn_the_short_way(turn_rad: float) -> None:
    start = math.copysign(math.pi - 0.1, turn_rad)
    end = math.remainder(start + turn_rad, math.tau)
    assert abs(end - start) > math.pi  # as the text has it, the short way is not the direct one
    samples = [
        TumSample(t_ns=t_ns, x_m=0, y_m=0, qz=math.sin(h / 2), qw=math.cos(h / 2))
        for t_ns, h in ((0, start), (100, end))
    ]
    drive = OdometryTrack(samples)
    for part in (20, 50, 75):
        expected = math.remainder(start + turn_rad * part / 100, math.tau)
        heading_rad = float(drive.pose_at(part)[2])
        assert heading_rad == pytest.approx(expected)
        assert -math.pi <= heading_rad < math.pi


def test_a_time_far_outside_is_refused() -> None:
    drive = OdometryTrack.from_lines(lines_of([(0, 0, 0, 0), (10**9, 1, 0, 0)]))
    np.testing.assert_array_equal(drive.pose_at(1_400_000_000), [1.0, 0.0, 0.0])
    with pytest.raises(OdometryError, match=r"covers 0.00 .. 1.00 s, but a frame came at 1.60 s"):
        drive.pose_at(1_600_000_000)


@pytest.mark.parametrize(
    "lines",
    [
        [],
        ["0 0 0 0 0 0 0 1", "oops"],
        ["1 0 0 0 0 0 0 1", "0 0 0 0 0 0 0 1"],
    ],
)
def test_bad_odometry_is_an_error(lines: list[str]) -> None:
    with pytest.raises(OdometryError):
        OdometryTrack.from_lines(lines)


def test_the_socket_gives_what_was_sent_however_it_was_cut(tmp_path: Path) -> None:
    lines = lines_of([(k, k / 7, k / 11, k / 13) for k in range(200)])
    data = "".join(f"{line}\n" for line in lines).encode()
    path = str(tmp_path / "odom")
    server = socket.socket(socket.AF_UNIX)
    server.bind(path)
    server.listen()

    def serve() -> None:
        client, _ = server.accept()
        with client:
            for start in range(0, len(data), 777):
                client.sendall(data[start : start + 777])

    thread = threading.Thread(target=serve)
    thread.start()
    drive = read_odometry_socket(path)
    thread.join()
    server.close()
    assert list(drive) == list(OdometryTrack.from_lines(lines))


def test_a_missing_or_silent_socket_is_named(tmp_path: Path) -> None:
    with pytest.raises(OdometryError):
        read_odometry_socket(str(tmp_path / "nobody"))
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "silent"))
        server.listen()
        with pytest.raises(OdometryError, match=r"silent for 0\.1 s"):
            read_odometry_socket(str(tmp_path / "silent"), timeout_s=0.1)


@given(st.lists(st.floats(-2 * math.pi, 2 * math.pi), min_size=2, max_size=30))
def test_a_track_that_grows_unwraps_like_numpy_to_the_last_bit(headings: list[float]) -> None:
    samples = [
        TumSample(t_ns=t_ns, x_m=0.0, y_m=0.0, qz=math.sin(h / 2), qw=math.cos(h / 2))
        for t_ns, h in enumerate(headings)
    ]
    drive = OdometryTrack(samples[:1])
    for sample in samples[1:]:
        drive.append(sample)
    unwrapped = np.unwrap([sample.heading_rad for sample in samples])
    for row, heading_rad in enumerate(unwrapped):
        assert drive.pose_at(row)[2] == wrap_angle(float(heading_rad))
    with pytest.raises(OdometryError):
        drive.append(samples[-1])


Pose = tuple[float, float, float]
Row = tuple[int, float, float, float]
PERIOD_NS = 20_000_000


def turned_drive() -> list[Row]:
    """Return a drive at 0.5 m/s: 3 m, a quarter turn on the spot, and 3 m to the left."""
    legs = [(k / 100, 0.0, 0.0) for k in range(300)]
    legs += [(3.0, 0.0, k * math.pi / 100) for k in range(50)]
    legs += [(3.0, k / 100, math.pi / 2) for k in range(300)]
    return [(k * PERIOD_NS, *pose) for k, pose in enumerate(legs)]


def from_row(rows: list[Row], first: int, start: Pose = (0.0, 0.0, 0.0)) -> list[Row]:
    """Return rows whose source begins at ``start`` again at one of them."""
    origin = np.array(rows[first][1:])
    seen = [compose(np.array(start), between(origin, np.array(row[1:]))) for row in rows[first:]]
    again = [(t_ns, *pose.tolist()) for (t_ns, *_), pose in zip(rows[first:], seen, strict=True)]
    return [*rows[:first], *again]


def assert_same_path(drive: OdometryTrack, rows: list[Row]) -> None:
    for t_ns, *pose in rows:
        apart = between(np.array(pose), drive.pose_at(t_ns))
        assert np.abs(apart).max() < 1e-9, t_ns


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (-3.0, 2.0, 1.0)])
@pytest.mark.parametrize("row", [60, 330, 620])
def test_the_path_of_a_restarted_source_goes_on(row: int, start: Pose) -> None:
    """Straight or turning at one rate it is as without: all poses, and those half way."""
    rows = from_row(turned_drive(), 0, start)
    drive = OdometryTrack.from_lines(lines_of(from_row(rows, row, start)))
    assert_same_path(drive, rows)
    for before, after in ((row - 1, row), (row, row + 1)):
        expected = (np.array(rows[before][1:]) + np.array(rows[after][1:])) / 2
        t_ns = (rows[before][0] + rows[after][0]) // 2
        np.testing.assert_allclose(drive.pose_at(t_ns), expected, atol=1e-9)
    assert [sample.x_m for sample in drive][row] == start[0]  # what is recorded is what came
    expected = compose(np.array(rows[row][1:]), between(np.array(start), np.zeros(3)))
    np.testing.assert_allclose(drive.frame_at(rows[row][0]), expected, atol=1e-9)
    np.testing.assert_array_equal(drive.frame_at(rows[row][0] - 1), np.zeros(3))


@pytest.mark.parametrize("first_m", [0.0, 0.01, 0.09, 0.11])
def test_a_first_pose_up_to_10_cm_from_the_start_is_that_of_a_restarted_source(
    first_m: float,
) -> None:
    rows = turned_drive()
    t_ns = rows[299][0] + PERIOD_NS
    drive = OdometryTrack.from_lines(lines_of([*rows[:300], (t_ns, first_m, 0.0, 0.0)]))
    expected_m = 3.0 if first_m < 0.1 else first_m
    assert drive.pose_at(t_ns)[0] == pytest.approx(expected_m, abs=1e-9)


def test_where_the_path_goes_on_does_not_hang_on_the_last_two_poses() -> None:
    """Wheels that count coarsely turn back and forth, and two messages may have come at once."""
    tick_rad = 0.02
    rows = [(k * PERIOD_NS, k / 100, 0.0, tick_rad * (k % 2)) for k in range(200)]
    drive = OdometryTrack.from_lines(lines_of([*rows, (200 * PERIOD_NS, 0.0, 0.0, 0.0)]))
    expected = [2.0, 0.0, 0.0]
    assert drive.pose_at(200 * PERIOD_NS) == pytest.approx(expected, abs=1.1 * tick_rad)
    rows += [(rows[-1][0] + 1000, 2.0, 0.0, 0.0), (rows[-1][0] + 10**9, 0.0, 0.0, 0.0)]
    drive = OdometryTrack.from_lines(lines_of(rows))
    assert drive.pose_at(rows[-1][0]) == pytest.approx([2.5, 0.0, 0.0], abs=0.1)


def test_a_source_may_be_restarted_again_and_old_poses_be_forgotten() -> None:
    rows = turned_drive()
    given = from_row(from_row(rows, 90), 500)
    kept = OdometryTrack.from_lines(lines_of(given))
    drive = OdometryTrack.from_lines(lines_of(given[:1]))
    for number, row in enumerate(given[1:], start=1):
        was_restarted = drive.append(parse_tum_line(lines_of([row])[0]))
        assert was_restarted == (number in (90, 500))
        drive.forget_before(row[0])
        assert drive.pose_at(row[0]).tobytes() == kept.pose_at(row[0]).tobytes()
    assert len(drive) < 100
    assert_same_path(drive, rows[-10:])


def test_a_restart_may_be_at_zero_where_the_first_pose_was_elsewhere() -> None:
    rows = from_row(turned_drive(), 0, (-3.0, 2.0, 1.0))
    assert_same_path(OdometryTrack.from_lines(lines_of(from_row(rows, 620))), rows)


def test_a_restart_on_the_spot_turns_nothing() -> None:
    rows = [(k * PERIOD_NS, 0.0, 0.0, math.pi * k / 100) for k in range(90)]
    assert_same_path(OdometryTrack.from_lines(lines_of(from_row(rows, 60))), rows)


def test_a_source_without_a_pose_for_a_moment_says_zero_and_goes_on() -> None:
    rows = turned_drive()
    zeros = [(t_ns, 0.0, 0.0, 0.0) for t_ns, *_ in rows[520:540]]
    given = [*from_row(rows[:520], 400), *zeros, *from_row(rows, 400)[540:]]
    drive = OdometryTrack.from_lines(lines_of(given))
    assert_same_path(drive, rows[:520] + rows[540:])


def test_the_robot_stood_while_nothing_came_for_long() -> None:
    """Then it is not known how it drove, and a restarted source does not say."""
    rows = turned_drive()
    given = [row for k, row in enumerate(from_row(rows, 500)) if not 440 <= k < 500]
    drive = OdometryTrack.from_lines(lines_of(given))
    np.testing.assert_allclose(drive.pose_at(rows[500][0]), rows[439][1:], atol=1e-9)
    went_on = between(np.array(rows[500][1:]), np.array(rows[-1][1:]))
    since = between(drive.pose_at(rows[500][0]), drive.pose_at(rows[-1][0]))
    np.testing.assert_allclose(since, went_on, atol=1e-9)


def test_the_noise_of_a_restarted_source_is_turned_with_it() -> None:
    triangle = (0.04, 0.01, 0.0, 0.01, 0.0, 0.02)
    tracks = []
    for rows in (turned_drive(), from_row(turned_drive(), 400)):
        samples = (parse_tum_line(line) for line in lines_of(rows))
        tracks.append(OdometryTrack(replace(one, velocity_covariance=triangle) for one in samples))
    whole, restarted = (track.noise_at(tracks[0].last_ns) for track in tracks)
    np.testing.assert_allclose(restarted, whole, atol=1e-12)


def along(step_ns: int, *places_m: float) -> list[Row]:
    return [(k * step_ns, x_m, 0.0, 0.0) for k, x_m in enumerate(places_m)]


def on_circle(radius_m: float, turn_rad: float) -> list[Row]:
    turns = (turn_rad * k for k in range(200))
    places = [(radius_m * math.sin(a), radius_m * (1.0 - math.cos(a)), a) for a in turns]
    return [(k * 10**8, *place) for k, place in enumerate(places)]


def on_square(step_ns: int) -> list[Row]:
    """Return three laps of a metre a step and a quarter turn a step."""
    corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
    lap = [(*corners[k % 4], side * math.pi / 2) for side in range(4) for k in (side, side + 1)]
    return [(k * step_ns, *pose) for k, pose in enumerate(3 * lap)]


MS = 10**6


@pytest.mark.parametrize(
    "rows",
    [
        pytest.param(on_circle(9.0, 0.1), id="laps at 9 m/s"),
        pytest.param(on_circle(0.0, 0.35), id="a spin at 3.5 rad/s"),
        pytest.param([*on_circle(0.0, 0.35)[:180:5], (18000 * MS, 0.0, 0.0, 0.0)], id="its stop"),
        pytest.param(on_square(2000 * MS), id="a square, its corners every other second"),
        pytest.param(on_square(200 * MS), id="a square, a side in 0.2 s"),
        pytest.param(along(200 * MS, 0.0, 0.5, 0.0), id="there and back in two steps"),
        pytest.param(along(200 * MS, 0.0, 0.8, 1.6, 0.8, 0.8, 0.02), id="home after a rest"),
        pytest.param(along(100 * MS, 0.0, 0.1, 0.1, 0.1, 0.9, 1.0), id="poses that were held"),
        pytest.param(along(100 * MS, 0.0, 0.1, 0.2, 5.0, 5.1), id="a pose that was set"),
        pytest.param(along(100 * MS, 0.0, 0.1, 0.2, 5.0, 5.1, 0.0, 0.1), id="set there and back"),
        pytest.param(along(1000 * MS, 0.0, 0.2, 0.4, 0.6, 0.02, 0.0), id="home, faster than away"),
        pytest.param(along(20 * MS, *[0.0] * 50, 1.0, *[0.0] * 50), id="one outlier"),
        pytest.param(along(20 * MS, *[0.0] * 50, *[5.0] * 50, 5.01, 5.02), id="zeros at first"),
    ],
)
def test_what_is_no_restart_is_taken_as_it_is(rows: list[Row]) -> None:
    assert_same_path(OdometryTrack.from_lines(lines_of(rows)), rows)


def test_after_a_restart_the_old_frame_is_not_taken_up_again() -> None:
    rows = [(k * 10**8, 0.05 * k, 0.0, 0.0) for k in range(60)]
    stands = [(k * 10**8, 0.0, 0.0, 0.0) for k in range(60, 100)]
    turned = (100 * 10**8, 0.0, 0.0, 0.5)
    drive = OdometryTrack.from_lines(lines_of([*rows, *stands, turned]))
    assert drive.pose_at(turned[0]) == pytest.approx([3.0, 0.0, 0.5])


def test_a_reference_is_taken_as_it_is() -> None:
    rows = from_row(turned_drive(), 330)
    samples = [parse_tum_line(line) for line in lines_of(rows)]
    assert_same_path(OdometryTrack(samples, may_restart=False), rows)


finite = st.floats(-1e6, 1e6, allow_subnormal=False)


def test_stamp_has_every_nanosecond_of_the_text() -> None:
    # 2**53 ns is 104 days: a float would lose this last digit
    assert parse_tum_line("1732155000.123456789 0 0 0 0 0 0 1").t_ns == 1_732_155_000_123_456_789


@pytest.mark.parametrize(
    ("qz", "qw", "heading_rad"),
    [
        (0.0, 1.0, 0.0),
        (1.0, 0.0, math.pi),
        (math.sqrt(0.5), math.sqrt(0.5), math.pi / 2),
        (-0.5, math.sqrt(0.75), -math.pi / 3),
        (0.5, -math.sqrt(0.75), 5 * math.pi / 3),  # q and -q are the same turn
        (-math.sqrt(0.75), -0.5, -4 * math.pi / 3),
    ],
)
def test_heading_is_twice_the_quaternion_angle(qz: float, qw: float, heading_rad: float) -> None:
    assert parse_tum_line(f"0 0 0 0 0 0 {qz!r} {qw!r}").heading_rad == pytest.approx(heading_rad)


@given(st.integers(-(2**62), 2**62), finite, finite, st.floats(-3.1, 3.1))
def test_a_line_gives_back_what_was_written(t_ns: int, x: float, y: float, heading: float) -> None:
    sample = parse_tum_line(format_tum_line(t_ns, np.array([x, y, heading])))
    assert (sample.t_ns, sample.x_m, sample.y_m) == (t_ns, x, y)
    assert sample.heading_rad == pytest.approx(heading, abs=1e-12)


@given(st.text(max_size=60))
def test_any_text_is_a_sample_or_a_tum_error(text: str) -> None:
    with contextlib.suppress(TumError):
        assert isinstance(parse_tum_line(text), TumSample)


number_like = st.one_of(
    st.floats().map(repr),
    st.integers(-(2**80), 2**80).map(str),
    st.decimals().map(str),
    st.from_regex(r"[+-]?[0-9]{1,4}(\.[0-9]{0,12})?[eE][+-]?[0-9]{1,20}", fullmatch=True),
)


NO_DECIMALS = (
    "1_000", "0x10", "0x1p3", "nan", "-inf", "Infinity", "\u0661", "\uff11", "1\u0660", "+-1", "1e",
    ".", "1.2.3", "1,5", "--1", "e5", "\u2212" "1", "1\x0b", "1\x1c", "\xa0" "1",
)  # fmt: skip


@pytest.mark.parametrize("place", range(8))
def test_numbers_are_ascii_decimals_in_every_field_and_reader(place: int, tmp_path: Path) -> None:
    """Python's own float and int read more: other scripts' digits, underscores, hex, words."""
    live = LiveOdometry("test")
    for number, text in enumerate(NO_DECIMALS, start=1):
        fields = ["1", "0", "0", "0", "0", "0", "0", "1"]
        fields[place] = text
        line = " ".join(fields)
        with pytest.raises(TumError):
            parse_tum_line(line)
        with pytest.raises(OdometryError):
            OdometryTrack.from_lines(["0 0 0 0 0 0 0 1", line])
        (path := tmp_path / "t.tum").write_text(f"0 0 0 0 0 0 0 1\n{line}\n", encoding="utf-8")
        with pytest.raises(TumError):
            read_tum(path)
        live.take(line, 0)
        assert live.n_refused == number, ascii(text)


@pytest.mark.parametrize("text", ["1", "+1", "-1", "1.", ".5", "1.25", "1e-05", "1.0E+2", "007"])
def test_every_ascii_decimal_is_read(text: str) -> None:
    assert parse_tum_line(f"3 {text} 0 0 0 0 0 1\r\n").x_m == float(text)
    assert parse_tum_line(f"\t{text} 2  0 0 0 0 0\t1").t_ns == round(float(text) * 1e9)


@given(st.lists(number_like, min_size=8, max_size=8))
@example(["1e9999999", *"0000001"])
@example(["-1e99999999999999999999", *"0000001"])
@example(["1e-9999999", *"0000001"])
def test_eight_number_like_fields_are_an_int64_stamp_or_a_tum_error(fields: list[str]) -> None:
    with contextlib.suppress(TumError):
        sample = parse_tum_line(" ".join(fields))
        assert -(2**63) < sample.t_ns < 2**63
        assert all(map(math.isfinite, (sample.x_m, sample.y_m, sample.heading_rad)))


def test_files_round_trip_and_skip_comments(tmp_path: Path) -> None:
    path = tmp_path / "t.tum"
    poses = np.array([[0.1, 0.2, 0.3], [1 / 3, -2.0, -3.0]])
    write_tum(path, Trajectory(stamps_ns=np.array([5, 199_261_498]), poses=poses))
    path.write_text("# a comment\n\n" + path.read_text())
    back = read_tum(path)
    np.testing.assert_array_equal(back.stamps_ns, [5, 199_261_498])
    np.testing.assert_array_equal(back.poses[:, :2], poses[:, :2])
    np.testing.assert_allclose(back.poses[:, 2], poses[:, 2], atol=1e-15)


def test_endless_input_is_no_trajectory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(track, "_MAX_BYTES", 1000)
    with pytest.raises(TumError):
        read_tum(Path("/dev/zero"))


def test_noise_is_the_sum_of_what_velocities_err_by_in_the_frame_of_the_odometry() -> None:
    """Half a second at heading 0, then a second at a right angle, then between two samples."""
    ahead = "0.09 0 0.006 0.01 0 0.04"
    wheels = OdometryTrack.from_lines(
        [
            f"1.0 0 0 0 0 0 0 1 {ahead}",
            f"1.5 0 0 0 0 0 0 1 {ahead}",
            f"2.5 0 0 0 0 0 {math.sqrt(0.5)!r} {math.sqrt(0.5)!r} {ahead}",
        ]
    )
    first = np.array([[0.09, 0.0, 0.006], [0.0, 0.01, 0.0], [0.006, 0.0, 0.04]])
    turned = np.array([[0.01, 0.0, 0.0], [0.0, 0.09, 0.006], [0.0, 0.006, 0.04]])
    np.testing.assert_array_equal(wheels.noise_at(track.NS_PER_S), np.zeros((3, 3)))
    expected = 0.25 * first
    np.testing.assert_allclose(wheels.noise_at(1_500_000_000), expected, atol=1e-17)
    np.testing.assert_allclose(wheels.noise_at(2_000_000_000), expected + turned / 2, atol=1e-17)
    np.testing.assert_allclose(wheels.noise_at(2_900_000_000), expected + turned, atol=1e-17)


def test_noise_stays_the_same_bits_when_what_is_before_it_is_forgotten() -> None:
    lines = [f"{k / 10} {k / 3} 0 0 0 0 {k / 7!r} 1 0.1 0.01 0 0.2 0.02 0.3" for k in range(200)]
    whole, short = OdometryTrack.from_lines(lines), OdometryTrack.from_lines(lines)
    short.forget_before(15 * track.NS_PER_S)
    assert len(short) < len(whole)
    for t_ns in (15 * track.NS_PER_S, 17_250_000_001, 19_900_000_000):
        assert short.noise_at(t_ns).tobytes() == whole.noise_at(t_ns).tobytes()


def test_a_track_of_lines_without_covariance_has_no_noise() -> None:
    wheels = OdometryTrack.from_lines(["1 0 0 0 0 0 0 1", "2 0 0 0 0 0 0 1 1 0 0 1 0 1"])
    with pytest.raises(OdometryError):
        wheels.noise_at(track.NS_PER_S)
