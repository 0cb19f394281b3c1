"""Several radars at once: each answers for itself, none disturbs the other's stream."""

from collections.abc import Mapping

import pytest

from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300

pytestmark = pytest.mark.requires("settings")

SHORT = RawConfig(frame_area_m=(0.4, 1.0))


def test_a_pair_is_two_modules(radar_pair: tuple[X4M300, X4M300]) -> None:
    said = [radar.info() for radar in radar_pair]
    # the base firmware tells no serial number, but that of its microcontroller
    assert len({info.serial_number or info.system_core_id for info in said}) == 2


def test_a_pair_streams_side_by_side(radar_pair: tuple[X4M300, X4M300]) -> None:
    for radar in radar_pair:
        radar.configure_raw(SHORT)
    for radar in radar_pair:
        radar.start(10.0)
    counters: list[list[int]] = [[], []]
    for _ in range(5):
        for radar, seen in zip(radar_pair, counters, strict=True):
            seen.append(radar.read_frame().counter)
    for radar, seen in zip(radar_pair, counters, strict=True):
        radar.stop()
        assert seen == list(range(seen[0], seen[0] + 5))
        assert radar.frames_lost == 0


def test_one_that_is_reconfigured_does_not_disturb_the_other(
    radar_pair: tuple[X4M300, X4M300],
) -> None:
    first, second = radar_pair
    geometry = first.configure_raw(SHORT)
    first.start(10.0)
    second.configure_raw(RawConfig(frame_area_m=(0.4, 2.0), iterations=8))
    second.configure_raw(RawConfig(frame_area_m=(0.4, 3.0), downconversion=True))
    frames = list(first.frames(5))
    assert {frame.samples.shape for frame in frames} == {(geometry.n_bins,)}
    assert first.frames_lost == 0


def test_every_radar_of_the_rig_gives_the_same_number_of_bins(
    radar_rig: Mapping[str, X4M300],
) -> None:
    """Protocol reference 9.5: 1431 from 0.2 ... 9.4 m, on every one."""
    assert {radar.configure_raw().n_bins for radar in radar_rig.values()} == {1431}
