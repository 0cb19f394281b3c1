"""What every source of frames shows, a recording that is played among them."""

from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.codes import PongCode


def test_frames_come_one_after_the_other(radar: X4M300, frame_rate_hz: float) -> None:
    """The module's own bin count holds for every frame, and no counter goes back."""
    assert radar.ping() is PongCode.XTS_SPRP_READY
    geometry = radar.configure_raw()
    radar.start(frame_rate_hz)
    frames = list(radar.frames(5))
    radar.stop()
    assert {frame.samples.shape for frame in frames} == {(geometry.n_bins,)}
    counters = [frame.counter for frame in frames]
    assert counters == sorted(set(counters))
    assert radar.fault_count == 0
