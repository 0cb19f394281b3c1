"""A session as the source of a run."""

from dataclasses import asdict, replace
from pathlib import Path

from hil_tests.unit.slam.app.sessions import odometry, scan, session_info, write_scans
from slam.app.run.replay import recorded_source
from slam.app.session.messages import settings_text
from slam.app.session.reader import open_session
from slam.config import WheelNoise, load_preset
from xethru_protocol.system import StopFlag


def test_lost_frames_are_those_between_counters_of_one_stream(tmp_path: Path) -> None:
    info = replace(
        session_info(1),
        config_json=settings_text(load_preset("robust")),
        wheels=asdict(WheelNoise()),
    )
    scans = []
    for tick, (counter, stream) in enumerate(((1, 0), (3, 0), (6, 1), (7, 1), (10, 1), (1, 2))):
        one = scan(tick, 1)
        frames = (replace(one.frames[0], counter=counter, stream=stream),)
        scans.append(replace(one, frames=frames))
    path = write_scans(tmp_path / "s.mcap", scans, odometry(20), info)
    source = recorded_source(open_session(path), StopFlag())
    assert [len(one.frames) for one in source.scans] == [1] * 6
    assert source.lost_frames() == 1 + 2
