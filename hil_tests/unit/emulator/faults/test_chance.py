"""``every`` and ``probability`` of a fault against the binomial distribution."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom

from emulator.faults.faulty_device import Armed, Opportunity
from emulator.faults.kind import PacketClass, Target
from emulator.faults.plan import fault_spec

N = 5000
SURE = 1 - 1e-9  # of each count's interval: a right fault passes with nearly any seed


def hits(
    probability: float = 1.0,
    every: int = 1,
    *,
    n: int = N,
    radar: str = "front",
    seed: int = 1,
    own_seed: int | None = None,
) -> NDArray[np.bool_]:
    """Return at which of so many frames a fault would be injected, of a fault without end."""
    spec = fault_spec("bad_checksum", count=0, probability=probability, every=every, seed=own_seed)
    armed = Armed(0, spec, radar, seed)
    frames = (
        Opportunity(time_ns=0, counter=1 + at, packet_class=PacketClass.FRAME) for at in range(n)
    )
    return np.array([armed.due(frame) for frame in frames])


def assert_binomial(count: int, n: int, probability: float) -> None:
    low, high = binom.interval(SURE, n, probability)
    assert low <= count <= high


@pytest.mark.parametrize("probability", [0.01, 0.1, 0.3, 0.7, 0.95])
def test_each_opportunity_has_the_probability(probability: float) -> None:
    hit = hits(probability)
    assert_binomial(hit.sum(), N, probability)
    # the next one does not depend on it: disjoint pairs
    pairs = hit.reshape(-1, 2)
    assert_binomial(pairs.all(axis=1).sum(), N // 2, probability**2)
    assert_binomial((~pairs).all(axis=1).sum(), N // 2, (1 - probability) ** 2)


def test_without_a_probability_each_opportunity_is_taken() -> None:
    assert fault_spec("bad_checksum").probability == 1.0
    assert hits(1.0).all()


def test_the_probability_is_of_every_third_opportunity() -> None:
    hit = hits(0.3, every=3, n=3 * N)
    assert not np.delete(hit, np.s_[2::3]).any()
    assert_binomial(hit.sum(), N, 0.3)


def test_radars_and_seeds_draw_on_their_own_and_the_same_ones_repeat() -> None:
    """Of two independent faults both strike with the square of the probability."""
    first = hits(0.3)
    assert np.array_equal(first, hits(0.3))
    for other in (hits(0.3, seed=2), hits(0.3, radar="rear")):
        assert_binomial((first & other).sum(), N, 0.3**2)
    own = hits(0.3, seed=1, own_seed=5)
    assert np.array_equal(own, hits(0.3, seed=2, own_seed=5))
    assert not np.array_equal(own, first)


def test_a_fault_of_a_moment_with_a_probability_waits_for_frames() -> None:
    """Moments come as often as somebody looks; only frames can be counted."""
    for probability, target in ((1.0, Target.MOMENT), (0.5, Target.FRAME)):
        armed = Armed(0, fault_spec("unplug", probability=probability), "front", 1)
        assert armed.kind.target is Target.MOMENT
        assert armed.spec.target is target
