"""Cost of 20 s of a running profile: synthesis, matrices, noise map and detection."""

from collections import deque

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from hil_tests.unit.emulator.profiles.doubles import (
    SECOND,
    heard_until,
    profile,
    room,
    standing,
)
from xethru_protocol.wire.codes import OutputFeature

FRAMES = 340
OUTPUTS = {
    "presence": {int(OutputFeature.PRESENCE_SINGLE): 1},
    "baseband": {int(OutputFeature.BASEBAND_IQ): 1},
    "matrices": {int(OutputFeature.PULSEDOPPLER_BYTE): 3, int(OutputFeature.NOISEMAP_BYTE): 3},
}


@pytest.mark.parametrize("name", sorted(OUTPUTS))
def test_profile_frames(benchmark: BenchmarkFixture, name: str) -> None:
    """One module in RUN over its whole zone, one person in the room."""
    stream, _ = profile(room(standing(3.0)), outputs=OUTPUTS[name])
    deque(heard_until(stream, 25 * SECOND), maxlen=0)
    due_ns = stream.next_due_ns()
    assert due_ns is not None
    ends = iter(range(due_ns, due_ns + 10**15, 20 * SECOND))

    def twenty_seconds() -> None:
        end_ns = next(ends)
        while (due_ns := stream.next_due_ns()) is not None and due_ns < end_ns:
            stream.take()

    benchmark.pedantic(twenty_seconds, rounds=10, warmup_rounds=2)  # type: ignore[no-untyped-call] # the plugin has no types
    benchmark.extra_info["frames"] = FRAMES
