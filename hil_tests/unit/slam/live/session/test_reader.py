"""A recorded session comes back as it was; damaged and foreign files are one line."""

import errno
import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from hil_tests.property.examples import examples
from hil_tests.unit.slam.app.sessions import (
    FRAME_NS,
    odometry,
    scan,
    session_info,
    smoothed_run,
    snapshot,
    write_scans,
    write_session,
)
from slam.app.run.replay import play_states
from slam.app.session.writer import SessionLog
from slam.config import SlamConfig, load_preset
from slam.frames import RadarFrame
from slam.live.errors import AppError
from slam.live.odometry_track import TumSample
from slam.live.session.description import read_radar_text, settings_text
from slam.live.session.reader import begins_with, open_session
from slam.live.session.state_rows import smoothed_of, smoothed_row, snapshot_of, state_row
from slam.live.session_records import LogLine, Scan, Snapshot
from slam.results import SmoothedRun
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.recordings.mcap import MAGIC

N_SCANS = 60
LIGHT_OVER_MODULE = 299_792_458.0 / 3.0e8


@pytest.fixture(scope="module")
def session_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("s") / "session.mcap", N_SCANS, odometry(80))


def test_head_and_rig_are_those_of_the_run(session_file: Path) -> None:
    session = open_session(session_file)
    expected = session_info()
    assert session.info.radars == expected.radars
    assert (session.info.scene, session.info.seed) == ("made_up", 7)
    assert session.info.versions == {"numpy": "2"}
    np.testing.assert_array_equal(session.info.true_landmarks_m, expected.true_landmarks_m)
    assert [(m.name, m.x_m, m.y_m) for m in session.rig.mounts] == [
        ("radar0", 0.1, 0.2),
        ("radar1", 0.1, 0.5),
    ]


def test_frames_come_back_in_true_metres_with_their_own_stamps(session_file: Path) -> None:
    frames = [r for r in open_session(session_file).records() if isinstance(r, RadarFrame)]
    assert len(frames) == 2 * N_SCANS
    for index, frame in enumerate(frames):
        sent = scan(index // 2).frames[index % 2]
        assert (frame.radar, frame.counter, frame.t_ns) == (sent.radar, sent.counter, sent.t_ns)
        assert frame.samples.tobytes() == sent.samples.tobytes()
        assert frame.range_start_m == pytest.approx(0.2 * LIGHT_OVER_MODULE, rel=1e-12)
        assert frame.bin_length_m == pytest.approx(0.0064 * LIGHT_OVER_MODULE, rel=1e-12)


def test_odometry_and_log_come_back(session_file: Path) -> None:
    session = open_session(session_file)
    records = list(session.records())
    assert session.cut_at_byte is None
    samples = [r for r in records if isinstance(r, TumSample)]
    assert samples == list(odometry(80))[: len(samples)]
    assert samples[-1].t_ns >= (N_SCANS - 1) * FRAME_NS
    lines = [r for r in records if isinstance(r, LogLine)]
    assert [(line.radar, line.warning) for line in lines] == [("radar0", False), ("radar1", True)]


def test_scans_group_by_tick_also_where_a_radar_started_whole_periods_late(tmp_path: Path) -> None:
    info = session_info()
    late = replace(info.radars[1], start_skew_ns=FRAME_NS + 50_000_000)
    info = replace(info, radars=(info.radars[0], late))
    path = tmp_path / "late.mcap"
    scans = []
    for tick in range(5):
        first, second = scan(tick).frames
        frames = (first,) if tick == 0 else (first, replace(second, counter=tick - 1))
        scans.append(replace(scan(tick), frames=frames))
    write_scans(path, scans, odometry(80), info)
    grouped = [one for one in open_session(path).scans()]
    assert [(s.counter, [f.counter for f in s.frames]) for s in grouped] == [
        (0, [0]),
        *((tick, [tick, tick - 1]) for tick in range(1, 5)),
    ]
    assert [s.t_ns for s in grouped] == pytest.approx([tick * FRAME_NS for tick in range(5)])


def facts(one: Scan) -> tuple[object, ...]:
    frames = [(frame.radar, frame.counter, frame.t_ns) for frame in one.frames]
    return one.counter, one.t_ns, one.host_ns, one.used, frames


def test_scans_come_back_as_the_run_took_them(tmp_path: Path) -> None:
    """Stamps of time base `arrival`, a tick without frames, a counter that begins anew."""
    path = tmp_path / "s.mcap"
    log = SessionLog(path, session_info(), truth_at=lambda t_ns: np.outer(t_ns, [1e-9, 1 / 3, 0.1]))
    first, second = scan(7).frames
    sent = (
        replace(scan(7), t_ns=123, host_ns=(10**18, 10**18 + 5)),
        replace(scan(8), t_ns=456, frames=()),
        replace(scan(9), t_ns=789, frames=(replace(second, counter=0, t_ns=700),)),
        replace(scan(10), t_ns=999, frames=(replace(first, counter=3, t_ns=999),), used=False),
    )
    for one in sent:
        log.on_scan(one)
    log.close()
    taken = list(open_session(path).scans())
    assert [facts(one) for one in taken] == [facts(one) for one in sent]
    for one in taken:
        assert one.truth is not None
        assert one.truth.tolist() == (one.t_ns * np.array([1e-9, 1 / 3, 0.1])).tolist()


def test_what_is_unknown_stays_unknown(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    unknown = np.full(3, np.nan)
    info = replace(session_info(), seed=None, simulated=False, time_base="arrival")
    log = SessionLog(path, info)
    log.on_scan(scan(0))
    log.on_snapshot(replace(snapshot(0), truth=unknown))
    log.close()
    session = open_session(path)
    assert (session.info.seed, session.info.simulated) == (None, False)
    assert session.info.time_base == "arrival"
    assert [one.truth for one in session.scans()] == [None]
    (state,) = [record for record in session.records() if isinstance(record, Snapshot)]
    assert np.isnan(state.truth).all()


def test_states_come_back_to_the_last_bit(session_file: Path) -> None:
    states = [r for r in open_session(session_file).records() if isinstance(r, Snapshot)]
    assert len(states) == N_SCANS
    for counter in (0, 7):
        sent, found = snapshot(counter), states[counter]
        assert (found.counter, found.t_ns) == (sent.counter, sent.t_ns)
        assert state_row(found).tobytes() == state_row(sent).tobytes()
        assert found.estimate.tolist() == sent.estimate.tolist()
        assert found.landmark_covariances_m2.tolist() == sent.landmark_covariances_m2.tolist()


@settings(max_examples=examples(50), deadline=None)
@given(
    numbers=st.lists(st.floats(allow_nan=False), min_size=21, max_size=21),
    landmarks=st.lists(
        st.tuples(st.integers(0, 2**31), *[st.floats(allow_nan=False)] * 6), max_size=5
    ),
    nis=st.lists(st.floats(allow_nan=False), max_size=4),
)
def test_a_state_as_a_row_of_doubles_and_back(
    numbers: list[float], landmarks: list[tuple[float, ...]], nis: list[float]
) -> None:
    table = np.array(landmarks, dtype=np.float64).reshape(-1, 7)
    row = np.concatenate([[len(table), len(nis)], numbers, table.ravel(), nis])
    state = snapshot_of(4, 5, row)
    assert (state.counter, state.t_ns) == (4, 5)
    assert state_row(state).tolist() == row.tolist()
    for wrong in (row[:-1], np.append(row, 0.0)):
        with pytest.raises(ValueError, match="counts need"):
            snapshot_of(4, 5, wrong)


def test_smoothed_runs_come_back_to_the_last_bit(tmp_path: Path) -> None:
    path, first_ns = tmp_path / "session.mcap", 1_700_000_000_123_456_789
    log = SessionLog(path, session_info())
    made = [smoothed_run(2), smoothed_run(5)]
    made = [replace(one, t_ns=one.t_ns + first_ns) for one in made]
    for counter in range(5):
        log.on_snapshot(replace(snapshot(counter), t_ns=int(made[1].t_ns[counter])))
        if counter in {1, 4}:
            log.on_smoothed(made[counter == 4])
    log.close()
    session = open_session(path)
    found = [record for record in session.records() if isinstance(record, SmoothedRun)]
    assert len(found) == 2
    for one, wanted in zip(found, made, strict=True):
        assert one.landmark_ids == wanted.landmark_ids
        for part in fields(SmoothedRun):
            ours, theirs = getattr(one, part.name), getattr(wanted, part.name)
            assert np.array_equal(ours, theirs), part.name
    record = play_states(session, [], StopFlag())
    assert record.whole_smoothed is not None
    assert np.array_equal(record.whole_smoothed.poses, made[1].poses)


@pytest.mark.parametrize("row", [[0.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 2.0, 0.0]])
def test_a_smoothed_run_of_another_length_than_it_says_is_refused(row: list[float]) -> None:
    with pytest.raises(ValueError, match=r"counts?|without states"):
        smoothed_of(0, np.array(row))


def test_a_smoothed_run_that_is_not_finite_is_refused() -> None:
    row = smoothed_row(smoothed_run(3))
    row[2] = np.nan  # a time
    with pytest.raises(ValueError, match="not finite"):
        smoothed_of(0, row)


@pytest.mark.parametrize("written", [None, True, False])
def test_a_session_that_says_nothing_of_images_had_none(
    written: bool | None, tmp_path: Path
) -> None:
    """Sessions of before it was a setting are replayed as they were."""
    tables = json.loads(settings_text(load_preset("robust")))
    del tables["robust"]["patches"]
    if written is not None:
        tables["robust"]["patches"] = written
    path = tmp_path / "s.mcap"
    SessionLog(path, replace(session_info(), config_json=json.dumps(tables))).close()
    assert open_session(path).config.robust.patches is bool(written)


def test_a_session_without_settings_of_the_back_end_had_no_images(tmp_path: Path) -> None:
    tables = json.loads(settings_text(load_preset("robust")))
    del tables["robust"]
    path = tmp_path / "s.mcap"
    SessionLog(path, replace(session_info(), config_json=json.dumps(tables))).close()
    assert not open_session(path).config.robust.patches


def test_settings_and_surroundings_come_back(tmp_path: Path) -> None:
    sent = replace(
        session_info(),
        config_json='{"a": 0.1}',
        wheels={"scale_sigma": 1 / 3},
        constants={"slam.a.B": 1 / 3, "slam.a.C": [1, 2.5], "slam.a.D": {"x": 1e-200}},
        outlines_m=(np.array([[0.1, 1 / 3], [2.0, 3.0]]), np.zeros((3, 2))),
        started_unix_ns=1_790_000_000_123_456_789,
        odometry_clock="unix",
    )
    path = tmp_path / "s.mcap"
    SessionLog(path, sent).close()
    found = open_session(path).info
    assert (found.config_json, found.wheels) == (sent.config_json, sent.wheels)
    assert found.started_unix_ns == sent.started_unix_ns
    assert found.odometry_clock == "unix"
    assert found.constants == sent.constants
    assert [line.tolist() for line in found.outlines_m] == [
        line.tolist() for line in sent.outlines_m
    ]


def test_wire_bytes_come_back_with_both_clocks(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    log = SessionLog(path, session_info())
    log.on_wire("radar1", "tx", b"\x7d\x01", 77)
    log.on_scan(scan(3))
    log.on_wire("radar1", "rx", bytes(range(256)), 99)
    log.on_wire("radar0", "rx", b"", 100)
    log.close()
    session = open_session(path)
    assert list(session.wire()) == [
        ("radar1", "tx", b"\x7d\x01", 77),
        ("radar1", "rx", bytes(range(256)), 99),
    ]
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        topics = ["/radar/radar1/tx", "/radar/radar1/rx"]
        stamps = [message.log_time for _, _, message in reader.iter_messages(topics=topics)]
    assert stamps == [0, 3 * FRAME_NS]
    assert summary is not None
    types = {
        c.topic: summary.schemas[c.schema_id].name
        for c in summary.channels.values()
        if c.topic.endswith("x")
    }
    assert types == {
        "/radar/radar1/tx": "std_msgs/msg/UInt8MultiArray",
        "/radar/radar1/rx": "std_msgs/msg/UInt8MultiArray",
    }


@pytest.mark.parametrize("preset", ["paper", "robust"])
def test_settings_of_every_preset_come_back_the_same(preset: str) -> None:
    config = load_preset(preset, "lab")
    assert SlamConfig.model_validate_json(settings_text(config)) == config


def test_damage_names_the_file(session_file: Path, tmp_path: Path) -> None:
    content = bytearray(session_file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    (path := tmp_path / "damaged.mcap").write_bytes(content)
    with pytest.raises(AppError) as caught:
        list(open_session(path).records())
    assert str(path) in str(caught.value)


def test_a_file_that_cannot_be_read_is_not_called_unwritable(
    session_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert begins_with(session_file, MAGIC)

    def refuse(path: Path, mode: str) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(AppError, match="cannot read: Permission denied"):
        begins_with(session_file, MAGIC)


def test_a_recorded_range_that_cannot_be_names_file_and_message(tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    log = SessionLog(path, session_info())
    log.on_detections(0, 0, np.array([0.8, np.nan]))
    log.close()
    with pytest.raises(AppError, match=rf"{path}: a message of /radar/.*/detections"):
        open_session(path).detections()


def test_the_end_comes_from_the_index_without_a_pass_over_the_file(
    session_file: Path, tmp_path: Path
) -> None:
    with session_file.open("rb") as stream:
        newest_ns = max(message.log_time for *_, message in make_reader(stream).iter_messages())
    assert open_session(session_file).end_ns == newest_ns >= (N_SCANS - 1) * FRAME_NS
    whole = session_file.read_bytes()
    cut = tmp_path / "cut.mcap"
    for n_bytes in (len(whole) - 1, len(whole) - 40, len(whole) // 2):
        cut.write_bytes(whole[:n_bytes])
        assert open_session(cut).end_ns is None
    for wrong in (
        0,
        1,
        len(whole) // 2,
        len(whole) - 20,
        2**63,
    ):  # the footer's offset of the index
        cut.write_bytes(whole[:-28] + wrong.to_bytes(8, "little") + whole[-20:])
        open_session(cut)  # whatever it finds there


def test_a_session_that_grows_reads_the_same_again(tmp_path: Path) -> None:
    """What a run adds after it was opened would have scans without the odometry read before."""
    path = write_session(tmp_path / "session.mcap", 60)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    session = open_session(path)
    n_scans = sum(1 for _ in session.scans())
    assert 0 < n_scans < 60
    path.write_bytes(whole)
    assert sum(1 for _ in session.scans()) == n_scans
    assert sum(1 for _ in open_session(path).scans()) == 60


def test_a_recording_of_modules_is_not_a_session(tmp_path: Path) -> None:
    """What `xethru record` writes has the same topics, and does not know where a radar is."""
    with pytest.raises(AppError, match="xethru view"):
        read_radar_text(tmp_path / "rec.mcap", "/radar/radar_1/info", '{"x_m": null}')
