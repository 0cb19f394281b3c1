"""`open_rig`: modules as an iterator of scans, by counters, and by arrival in virtual time."""

from __future__ import annotations

import math
import time
from itertools import pairwise
from pathlib import Path

import pytest

from emulator import emulated_port
from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.module.memory import Identity
from emulator.scene.scene import Scene, load_scene
from emulator.x4m300 import radar_device
from hil_tests.patience import seconds
from hil_tests.unit.slam.app.run.virtual_rig import delays, drifting, radar_events
from slam import ConfigError, Mount, Rig, Slam
from slam.app.rig.rig_files import rig_file_of, write_rig
from slam.live import AppError, RadarSilentError, Scan, open_rig
from slam.live.rig import _Arrivals
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.errors import PortUnavailable
from xethru_protocol.wire.x4 import frame_time_ns, real_frame_rate

NS_PER_S = 1_000_000_000
TRUE_PER_MODULE_M = 299_792_458.0 / 3.0e8
LAB = load_scene("lab")


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch) -> Scene:
    """Put the radars of the scene at ports of their names, in this process; nobody waits."""
    names = [radar.name for radar in LAB.radars]

    def opened(port: str, **_: object) -> X4M300:
        if port not in names:
            raise PortUnavailable(f"there is no port {port}")
        index = names.index(port)
        radar = LAB.radars[index]
        source = echo_source(LAB, index, 0)
        device = radar_device(Identity(serial=radar.serial), source, Pace.ASAP)
        line = LoopbackTransport(device, name=port)
        return X4M300(line, clock=line.clock_ns)

    monkeypatch.setattr(X4M300, "open", opened)
    return LAB


@pytest.mark.parametrize("n_radars", [1, 2, 3])
def test_any_number_of_radars_at_any_mounts_gives_scans(lab: Scene, n_radars: int) -> None:
    rig = Rig([Mount(x_m=0.1 * k, y_m=-0.1, yaw_rad=2.0 * k) for k in range(n_radars)])
    ports = [radar.name for radar in lab.radars[:n_radars]]
    with open_rig(rig, ports, frame_area_m=(0.5, 3.0), time_base="counter") as live:
        assert live.rig == rig
        slam = Slam(live.rig)
        for number, scan in zip(range(4), live, strict=False):
            assert scan.t_ns == frame_time_ns(number, real_frame_rate(5))
            assert [frame.radar for frame in scan] == list(range(n_radars))
            for frame in scan:
                assert frame.t_ns == scan.t_ns
                assert frame.range_start_m / TRUE_PER_MODULE_M == pytest.approx(0.5, abs=0.06)
            state = slam.step(scan.t_ns, (0.03 * number, 0.0, 0.0), frames=scan)
            assert state.pose[0] == pytest.approx(0.03 * number, abs=0.01)
            with pytest.raises(AppError):
                _ = scan.odometry_pose
    with pytest.raises(StopIteration):
        next(iter(live))


def test_a_rig_file_says_which_module_is_where(lab: Scene, tmp_path: Path) -> None:
    file = rig_file_of(lab)
    write_rig(path := tmp_path / "robot.toml", file)
    ports = [radar.name for radar in reversed(lab.radars)]
    with open_rig(path, ports, time_base="counter") as live:
        assert live.rig == file
        assert [radar.port for radar in live.radars] == ports[::-1]
        assert len(next(iter(live)).frames) == len(lab.radars)


def test_what_cannot_be_opened_is_named(lab: Scene, tmp_path: Path) -> None:
    with pytest.raises(AppError, match="nowhere: there is no port"):
        open_rig(ports=["left_front", "nowhere"])
    with pytest.raises(ConfigError, match=r"robot.toml: cannot read"):
        open_rig(tmp_path / "robot.toml")
    with pytest.raises(ValueError, match="time_base"):
        open_rig(ports=["left_front"], time_base="counters")  # type: ignore[arg-type]  # wrong on purpose
    for ports in (None, [], ["left_front"], "left_front"):
        with pytest.raises(ValueError, match="ports"):
            open_rig(Rig([Mount(x_m=0.0, y_m=0.0, yaw_rad=0.0)] * 2), ports)


def test_by_arrival_every_frame_comes_once_and_at_its_time() -> None:
    """Clocks 30 ppm apart, starts up to 150 ms apart, lines with jitter, in virtual time."""
    scene = drifting(LAB, (15.0, -15.0, 0.0, 5.0), (0.0, 150.0, 60.0, 30.0))
    infos, events = radar_events(scene, 0, 10.0, delays(1, 16.0))
    arrivals = _Arrivals(infos, None)
    scans: list[Scan] = []
    for row in sorted(events, key=lambda row: row.t_ns):
        arrivals.take(row.event)
        while (scan := arrivals.next_scan(row.t_ns)) is not None:
            scans.append(scan)
    first_ns = scans[0].t_ns
    assert 2.0 * NS_PER_S < first_ns < 2.8 * NS_PER_S
    assert len(scans) == pytest.approx((10.0 - first_ns / NS_PER_S) * real_frame_rate(5), abs=3)
    came = [(frame.radar, frame.counter) for scan in scans for frame in scan]
    assert len(came) == len(set(came))
    for scan in scans[:-1]:
        assert scan.used
        assert len(scan.frames) == 4
        for frame in scan:
            late_ns = round(scene.radars[frame.radar].start_skew_ms * 1e6)
            taken_ns = frame_time_ns(frame.counter - 1, infos[frame.radar].rate_hz) + late_ns
            assert frame.t_ns == pytest.approx(taken_ns, abs=5e6)
    of_one = [f.t_ns for scan in scans for f in scan if f.radar == 0]
    steps_ns = [b - a for a, b in pairwise(of_one)]
    assert steps_ns == pytest.approx([NS_PER_S / real_frame_rate(5)] * len(steps_ns), abs=5e6)


def test_a_rig_goes_on_without_a_radar_and_ends_without_all(
    caplog: pytest.LogCaptureFixture,
) -> None:
    infos, events = radar_events(LAB, 0, 8.0, lambda: 1_000_000)
    arrivals = _Arrivals(infos, None)
    sizes = []
    for row in sorted(events, key=lambda row: row.t_ns):
        kind, radar, *_ = row.event
        if row.t_ns > 4 * NS_PER_S and 1 in arrivals._ticks.alive:
            arrivals.take(("lost", 1, "no frame for 3 s"))
        if kind == "frame" and (radar != 1 or row.t_ns < 4 * NS_PER_S):
            arrivals.take(row.event)
        while (scan := arrivals.next_scan(row.t_ns)) is not None:
            sizes.append(len(scan.frames))
    assert sizes[0] == 4
    assert sizes[-5:] == [3] * 5
    assert "no frame for 3 s" in caplog.text
    for radar in (0, 2, 3):
        arrivals.take(("lost", radar, "unplugged"))
    while arrivals.next_scan(row.t_ns) is not None:
        pass
    with pytest.raises(RadarSilentError):
        arrivals.next_scan(row.t_ns + 11 * NS_PER_S)


def test_a_radar_that_never_sends_is_not_waited_for_once_it_is_lost() -> None:
    infos, events = radar_events(LAB, 0, 6.0, lambda: 0)
    arrivals = _Arrivals(infos, None)
    sizes = []
    for row in sorted(events, key=lambda row: row.t_ns):
        if row.event[1] != 2:
            arrivals.take(row.event)
        if row.t_ns > 3 * NS_PER_S:
            arrivals.take(("lost", 2, "no frame for 3 s"))
        while (scan := arrivals.next_scan(row.t_ns)) is not None:
            assert row.t_ns > 3 * NS_PER_S
            sizes.append(len(scan.frames))
    assert set(sizes[:-1]) == {3}


def test_a_program_that_is_too_slow_is_warned_ever_more_rarely(
    caplog: pytest.LogCaptureFixture,
) -> None:
    infos, events = radar_events(LAB, 0, 60.0, lambda: 1_000_000)
    arrivals = _Arrivals(infos, None)
    asked_ns, n_unused = 0, 0
    for row in sorted(events, key=lambda row: row.t_ns):
        if row.t_ns - asked_ns > 10 * NS_PER_S or asked_ns < 4 * NS_PER_S:
            asked_ns = row.t_ns
            while (scan := arrivals.next_scan(row.t_ns)) is not None:
                n_unused += not scan.used
        arrivals.take(row.event)
    assert n_unused > 100
    assert 4 <= len(caplog.messages) <= 1 + math.log2(n_unused)


@pytest.mark.slow
def test_a_module_at_a_port_gives_scans_in_real_time() -> None:
    with emulated_port() as port, open_rig(ports=[port], fps=20) as live:
        scans = [scan for _, scan in zip(range(5), live, strict=False)]
        now_ns = time.monotonic_ns()
    times_ns = [scan.t_ns for scan in scans]
    assert times_ns == sorted(times_ns)
    assert 0 <= now_ns - times_ns[-1] < seconds(2) * NS_PER_S
    assert times_ns[-1] - times_ns[0] >= 4 * 0.9 * NS_PER_S / 20
