"""`proxy`: a module behind a pseudo-terminal, which here is an emulated one."""

from pathlib import Path

from hil_tests.device.serving import emulator, open_radar
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.recordings.wire_capture import read_chunks

SHORT = RawConfig(frame_area_m=(0.4, 1.0))


def test_no_byte_changes_without_a_fault_and_the_capture_holds_them_all(tmp_path: Path) -> None:
    wire = tmp_path / "line.xtwire"
    passed: dict[str, bytes] = {"rx": b"", "tx": b""}

    def heard(direction: str, data: bytes, t_ns: int) -> None:
        passed[direction] += data

    with (
        emulator("serve", "--bare") as module,
        emulator("proxy", "--port", module.paths[0], "--wire", str(wire)) as proxy,
    ):
        with open_radar(proxy.paths[0]) as radar:
            radar.raw_listener = heard
            radar.configure_raw(SHORT)
            radar.start(50.0)
            frames = list(radar.frames(50))
            assert radar.statistics.clean
        assert len(frames) == 50
    captured = {"rx": b"", "tx": b""}
    for chunk in read_chunks(wire):
        captured[chunk.way] += chunk.data
    assert captured["tx"] == passed["tx"]
    assert passed["rx"] in captured["rx"]  # what came before we listened is there, too


def test_faults_hit_the_line_of_the_module(tmp_path: Path) -> None:
    scenario = tmp_path / "gaps.toml"
    scenario.write_text(
        '[[fault]]\nkind = "missing_frames"\nevery = 10\ncount = 2\nparameters = { frames = 3 }\n'
    )
    with (
        emulator("serve", "--bare") as module,
        emulator("proxy", "--port", module.paths[0], "--faults", str(scenario)) as proxy,
        open_radar(proxy.paths[0]) as radar,
    ):
        radar.configure_raw(SHORT)
        radar.start(50.0)
        list(radar.frames(40))
        assert radar.frames_lost == 6
        assert radar.fault_count == 0
