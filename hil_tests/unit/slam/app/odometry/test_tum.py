"""TUM text: exact stamps, floats that survive, one clear line for what is not TUM."""

import contextlib
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from slam.app.odometry.track import (
    Trajectory,
    TumError,
    TumSample,
    format_tum_line,
    parse_tum_line,
    read_tum,
    write_tum,
)

finite = st.floats(-1e6, 1e6, allow_subnormal=False)


def test_stamp_has_every_nanosecond_of_the_text() -> None:
    # 2**53 ns is 104 days: a float would lose this last digit
    assert parse_tum_line("1732155000.123456789 0 0 0 0 0 0 1").t_ns == 1_732_155_000_123_456_789


@pytest.mark.parametrize(
    ("qz", "qw", "heading_rad"),
    [
        (0.0, 1.0, 0.0),
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
    monkeypatch.setattr("slam.app.odometry.track._MAX_BYTES", 1000)
    with pytest.raises(TumError, match="it is no trajectory"):
        read_tum(Path("/dev/zero"))
