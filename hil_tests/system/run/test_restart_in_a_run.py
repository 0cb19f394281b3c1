"""A module that restarts in the middle of a run under ASAP: its frames go on at their own time."""

import json
from pathlib import Path

import pytest

from emulator.cli import ask
from hil_tests.system.short_scene import write_short_scene
from slam.app.rig.emulated import (
    FRAME_RATE_HZ,
    RAW_CONFIG,
    EmulatorProcess,
    end_tick,
    open_loopback,
    open_ports,
    rig_of,
    scene_and_config,
)
from slam.live import frame_sources
from xethru_protocol.operating_system import StopFlag

pytestmark = pytest.mark.slow


@pytest.mark.rare
def test_frames_after_a_restart_are_those_of_their_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Protocol reference 6.1: the counter begins anew; content is that of scene time."""
    # A restart takes a second, on a loaded machine several: that does not count as silence here.
    monkeypatch.setattr(frame_sources, "SILENCE_S", 10.0)
    scene_file = str(write_short_scene(tmp_path))
    scene, _ = scene_and_config(scene_file, "paper")
    ticks = end_tick(scene.trajectory().duration_ns)
    with EmulatorProcess(scene_file, 0) as emulator:
        emulator.wait_until_ready(StopFlag())
        # The one that begins last, for all send as fast as they are read: of its 298 frames, a
        # handful has come when it is asked to restart.
        name = emulator.devices[-1].name
        with open_ports(
            emulator.devices, rig_of(scene), lambda *_: None, emulator.stream_begins_ns
        ) as source:
            source.start(RAW_CONFIG, FRAME_RATE_HZ)
            answer = ask(Path(emulator.control_socket), {"verb": "reset", "radar": name})
            assert json.loads(answer)["ok"]
            scans = list(source.scans(ticks, StopFlag()))
            radar = [info.name for info in source.radars].index(name)
            lost = source.lost_frames
    with open_loopback(scene, 0) as source:
        source.start(RAW_CONFIG, FRAME_RATE_HZ)
        whole = {scan.counter: scan for scan in source.scans(ticks, StopFlag())}
    counters = []
    for scan in scans:
        expected = {frame.radar: frame for frame in whole[scan.counter].frames}
        for frame in scan.frames:
            assert frame.t_ns == expected[frame.radar].t_ns
            assert frame.samples.tobytes() == expected[frame.radar].samples.tobytes()
        counters += [frame.counter for frame in scan.frames if frame.radar == radar]
    begins = [place for place, counter in enumerate(counters) if counter == 1]
    assert len(begins) == 2
    assert len(counters) - begins[1] > 10
    assert lost == ticks - len(counters)
