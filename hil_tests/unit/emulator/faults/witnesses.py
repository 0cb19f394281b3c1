"""What frames show of a fault that no counter tells: each witness compares them with true ones."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hil_tests.faulty import FaultyLine
from xethru_protocol.driver.frames import Frame

FPS = 20.0
Witness = Callable[[list[Frame], list[Frame], FaultyLine], None]


def counters(frames: list[Frame]) -> list[int]:
    return [frame.counter for frame in frames]


def changed(frames: list[Frame], true: list[Frame]) -> dict[int, int]:
    """How many samples of a frame are not what they should be, by counter."""
    truth = {frame.counter: frame.samples for frame in true}
    return {
        frame.counter: int(np.count_nonzero(frame.samples != truth[frame.counter]))
        for frame in frames
        if frame.samples.tobytes() != truth[frame.counter].tobytes()
    }


def hit(line: FaultyLine) -> list[int | None]:
    return [record.counter for record in line.truth]


def arrivals_s(frames: list[Frame]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([frame.arrival_ns for frame in frames]) * 1e-9


def same_content(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    assert not changed(frames, true)


def four_samples(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    assert changed(frames, true) == dict.fromkeys(hit(line), 4)


def steps_back(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    steps = np.diff(counters(frames))
    assert sorted(set(steps.tolist())) == [-4, 1]
    assert np.count_nonzero(steps < 0) == 3


def one_wrap(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    assert counters(frames).count(2**32 - 1) == counters(frames)[20:].count(0) == 3


def starts_again(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    assert counters(frames)[1:].count(1) == 3


def twice(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    repeated = [a for a, b in itertools.pairwise(counters(frames)) if a == b]
    assert repeated == hit(line)


def old_samples(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    pairs = itertools.pairwise(frames)
    stale = [b.counter for a, b in pairs if a.samples.tobytes() == b.samples.tobytes()]
    assert stale == hit(line)


def slower(ratio: float) -> Witness:
    def witness(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
        steps = np.diff(arrivals_s(frames)) / np.diff(arrivals_s(true[:75]))
        np.testing.assert_allclose(steps, ratio, atol=1e-6)

    return witness


def gap_then_burst(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    late = arrivals_s(frames) - arrivals_s(true[:75])
    first = late[0]
    assert first == pytest.approx(1.5)
    periods = np.arange(75) * np.diff(arrivals_s(true))[0]
    np.testing.assert_allclose(late, np.maximum(1.5 - periods, 0), atol=1e-3)


def twenty_ms_late(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    np.testing.assert_allclose(arrivals_s(frames) - arrivals_s(true[:75]), 0.02, atol=1e-6)


def wandering(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    late = arrivals_s(frames) - arrivals_s(true[:75])
    assert late.min() >= 0
    assert 0.0001 < late.std() < 0.01  # 75 steps of 0.2 ms


def at_polls(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    since_s = line.truth[0].t_ns * 1e-9
    polls = (arrivals_s(frames) - since_s) / 0.016
    np.testing.assert_allclose(polls, np.rint(polls), atol=1e-4)
    late = arrivals_s(frames) - arrivals_s(true[:75])
    assert 0 <= late.min() < late.max() < 0.016


def dead(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    stuck = [f.counter for f in frames if np.unique(f.samples[:8]).size == 1]
    assert stuck == hit(line) == list(changed(frames, true))


def clipped(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    largest = {f.counter: np.abs(f.samples).max() for f in true}
    for frame in frames:
        part = np.abs(frame.samples).max() / largest[frame.counter]
        assert part == pytest.approx(0.5 if frame.counter in hit(line) else 1.0, rel=0.01)


def lifted(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    for frame, before in zip(frames, true, strict=False):
        np.testing.assert_allclose(frame.samples - before.samples, 0.01, atol=2e-5)


def wandered(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    assert frames[0].samples.tobytes() == true[0].samples.tobytes()
    shifts = [
        next(k for k in range(5) if (f.samples[k:] == t.samples[: f.samples.size - k]).all())
        for f, t in zip(frames, true, strict=False)
    ]
    assert shifts == sorted(shifts)
    assert shifts[-1] == 1  # 4 bins in 10 s; 3.75 s have passed


def clutter(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    added = np.mean([f.samples - t.samples for f, t in zip(frames, true, strict=False)], axis=0)
    assert np.abs(added).argmax() == 20
    assert added[20] == pytest.approx(0.05, abs=1e-4)
    assert np.abs(added[60:]).max() < 1e-4


def rain(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    for frame, before in zip(frames, true, strict=False):
        added = np.abs(frame.samples - before.samples) > 0.01
        assert 0 < np.count_nonzero(added) <= 5


def faded(frames: list[Frame], true: list[Frame], line: FaultyLine) -> None:
    power = [np.std(f.samples) / np.std(t.samples) for f, t in zip(frames, true, strict=False)]
    assert power[0] == pytest.approx(1.0, abs=0.01)
    assert min(power) == pytest.approx(10 ** (-12 / 20), rel=0.02)


WITNESSES: dict[str, Witness] = {
    "split_writes": same_content,
    "one_byte_writes": same_content,
    "normal_framed": same_content,
    "noise_between": same_content,
    "in_range_samples": four_samples,
    "off_lattice_samples": four_samples,
    "counter_back": steps_back,
    "counter_wrap": one_wrap,
    "counter_reset": starts_again,
    "duplicate_frame": twice,
    "stale_frame": old_samples,
    "saturation": clipped,
    "dead_bins": dead,
    "dc_step": lifted,
    "slow_rate": slower(1.1),
    "stall": gap_then_burst,
    "start_offset": twenty_ms_late,
    "clock_drift": slower(1.01),
    "jitter": wandering,
    "usb_latency": at_polls,
    "range_offset_drift": wandered,
    "strong_clutter": clutter,
    "interference": rain,
    "fading": faded,
}
