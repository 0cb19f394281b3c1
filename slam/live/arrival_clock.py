"""Time base `arrival`: when frames were taken, from when they arrived.

A frame carries a counter and no time. It arrives after it was taken, later by a delay that is
never negative and often small: what a USB hub or a busy host adds varies. So the frames
that came soonest give the module's clock: the line below all points (counter, arrival) that lies
closest to them. Jitter goes, drift stays.

The smallest delay cannot be separated from the module's own time; it stays in every stamp.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import pairwise

from slam.live.odometry_track import NS_PER_S
from xethru_protocol.wire.x4 import frame_time_ns

WINDOW_S = 300
"""How much of the past is used for a clock: crystals change with temperature, over minutes."""
DRIFT_SIGMA = 30e-6
"""Crystals are off by tens of millionths; this is known of one before its first frame."""
KNOWN_DRIFT_SIGMA = 5e-6
"""How much a drift that was known may change across a restart of the counter."""
FLOOR_NS = 400_000.0
"""By how much the least delay of a host wanders while other programs come and go: the root mean
square over 20 clocks without drift, of runs of 12 to 77 s on a busy machine of two cores."""
_HALVINGS = 40
LEAST_DELAY_NS = 20_000.0
"""Mean delay below which a host does not keep time itself; keeps the sums finite."""
_KNOWN_AFTER_NS = 30 * NS_PER_S
_BREAK_NS = NS_PER_S
"""A frame this much too early for its clock, or ten times as late, belongs to a new count."""
_LATE_BREAK_NS = 10 * NS_PER_S


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockLine:
    """A clock against the host's.

    `origin_ns` is the host's time when it shows 0; `slope` by how much its seconds are longer than
    the host's, in parts of one.
    """

    origin_ns: int
    slope: float = 0.0

    def host_ns(self, nominal_ns: int) -> int:
        """Return the host's time when the clock shows `nominal_ns`.

        >>> ClockLine(origin_ns=1000, slope=1e-6).host_ns(5_000_000)
        5001005
        """
        return self.origin_ns + nominal_ns + round(self.slope * nominal_ns)

    def nominal_ns(self, host_ns: int) -> int:
        """Return what the clock shows, to within 1 ns.

        >>> ClockLine(origin_ns=1000, slope=1e-6).nominal_ns(5001005)
        5000000
        """
        elapsed_ns = host_ns - self.origin_ns
        return elapsed_ns - round(elapsed_ns * (self.slope / (1.0 + self.slope)))

    @property
    def drift_ppm(self) -> float:
        """How fast the clock is against the host's, in millionths; negative: slow."""
        return -self.slope / (1.0 + self.slope) * 1e6


class LowerEnvelope:
    """Follows one clock by the readings that arrived soonest.

    Of each second of arrivals the reading with the least delay is kept, for `WINDOW_S` seconds.
    `drift` is the slope to expect, `drift_sigma` its standard deviation.
    """

    def __init__(self, *, drift: float = 0.0, drift_sigma: float = DRIFT_SIGMA) -> None:
        self._drift, self._drift_sigma = drift, drift_sigma
        # Of each second: (second, nominal, arrival - nominal), relative to the first reading.
        self._soonest: deque[tuple[int, int, int]] = deque(maxlen=WINDOW_S)
        self._first: tuple[int, int] | None = None
        self._judged = _Likelihood(
            hull=((0, 0),), mean_x=0.0, mean_y=0.0, weight=0.0, prior=drift, variance=drift_sigma**2
        )
        self.line = ClockLine(origin_ns=0)

    @property
    def baseline_ns(self) -> int:
        """Time between the first and the last reading that count."""
        return self._soonest[-1][1] - self._soonest[0][1] if self._soonest else 0

    def take(self, nominal_ns: int, arrival_ns: int) -> None:
        """Take one reading: what the clock showed, and the host's time when we learnt it."""
        if self._first is None:
            self._first = (nominal_ns, arrival_ns - nominal_ns)
        since_ns = nominal_ns - self._first[0]
        later_ns = arrival_ns - nominal_ns - self._first[1]
        second = arrival_ns // NS_PER_S
        if self._soonest and self._soonest[-1][0] == second:
            if later_ns >= self._soonest[-1][2]:
                return
            self._soonest.pop()
        self._soonest.append((second, since_ns, later_ns))
        self._fit()

    def _fit(self) -> None:
        """Find the line below all points, by maximum likelihood of delays that are exponential.

        Without knowledge of the slope that is the edge of their lower convex hull at the mean of
        their times (Moon, Skelly and Towsley 1999); what is known of crystals keeps it near while
        there is little to see. In between the hull's corner carries the line.
        """
        assert self._first is not None
        points = sorted((since_ns, later_ns) for _, since_ns, later_ns in self._soonest)
        hull = _lower_hull(points)
        n = len(points)
        mean_x, mean_y = (sum(values) / n for values in zip(*points, strict=True))
        edges = [(y_1 - y_0) / (x_1 - x_0) for (x_0, y_0), (x_1, y_1) in pairwise(hull)]
        best = next((e for e, (x, _) in zip(edges, hull[1:], strict=True) if mean_x <= x), 0.0)
        delay_ns = mean_y - best * mean_x - min(y - best * x for x, y in hull)
        judged = self._judged = _Likelihood(
            hull=tuple(hull),
            mean_x=mean_x,
            mean_y=mean_y,
            weight=n / max(delay_ns, LEAST_DELAY_NS),
            prior=self._drift,
            variance=self._drift_sigma**2,
        )
        slope = judged.most_likely(edges)
        base_ns = min(y - slope * x for x, y in hull)
        first_nominal_ns, first_offset_ns = self._first
        self.line = ClockLine(
            origin_ns=first_offset_ns + round(base_ns - slope * first_nominal_ns), slope=slope
        )

    @property
    def slope_sigma(self) -> float:
        """How far off the slope may be: where it is e times less likely, the farther side."""
        return self._judged.half_width(self.line.slope)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Likelihood:
    """How well a slope fits: minus its logarithm, from the delays' mean and the prior."""

    hull: tuple[tuple[int, int], ...]
    mean_x: float
    mean_y: float
    weight: float
    prior: float
    variance: float

    def cost(self, slope: float) -> float:
        delay_ns = self.mean_y - slope * self.mean_x - min(y - slope * x for x, y in self.hull)
        return self.weight * delay_ns + (slope - self.prior) ** 2 / (2.0 * self.variance)

    def most_likely(self, edges: list[float]) -> float:
        """Return the slope of least cost; `edges` are those of the hull.

        The first term's derivative is constant while one corner carries the line, and grows from
        corner to corner; the root of it with the prior's lies in such a range or at its end.
        """
        for index, (x, _) in enumerate(self.hull):
            slope = self.prior - self.variance * self.weight * (x - self.mean_x)
            if index > 0:
                slope = max(slope, edges[index - 1])
            if index == len(edges) or slope <= edges[index]:
                return slope
        raise AssertionError  # the last corner has no edge after it

    def half_width(self, slope: float) -> float:
        limit = self.cost(slope) + 1.0
        widths = []
        for side in (-1.0, 1.0):
            near, far = 0.0, math.sqrt(self.variance)  # no less is known than before
            for _ in range(_HALVINGS):
                middle = (near + far) / 2.0
                near, far = (
                    (near, middle) if self.cost(slope + side * middle) > limit else (middle, far)
                )
            widths.append(far)
        return max(widths)


def _lower_hull(points: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the corners of the lower convex hull of sorted points, from left to right."""
    hull: list[tuple[int, int]] = []
    for point in points:
        if hull and hull[-1][0] == point[0]:
            continue  # the lower one came first, as the points are sorted
        while len(hull) > 1 and not _turns_left(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    return hull


def _turns_left(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) > (b[1] - a[1]) * (c[0] - a[0])


class ArrivalClock:
    """Stamps the frames of one radar with the host's time at which they were taken.

    Another stream, or a counter that begins anew, as after a restart of the module, begins a new
    line; what is known of the drift is kept, for it is the same crystal. `rate_hz` is the chip's
    real frame rate, as read back.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._envelope = LowerEnvelope()
        self._last: tuple[int, int] | None = None  # stream and counter
        self._last_stamp_ns = 0
        self.restarts = 0

    @property
    def drift_ppm(self) -> float:
        """How fast the module's clock is against the host's, in millionths."""
        return self._envelope.line.drift_ppm

    @property
    def drift_sigma_ppm(self) -> float:
        """How far off that may be, in millionths.

        Where it would be e times less likely, and what a wandering least delay makes of it.
        """
        envelope = self._envelope
        if envelope.baseline_ns <= 0:
            return DRIFT_SIGMA * 1e6
        wander = min(FLOOR_NS / envelope.baseline_ns, DRIFT_SIGMA)
        return math.hypot(envelope.slope_sigma, wander) * 1e6

    @property
    def baseline_s(self) -> float:
        """Time over which the drift was seen."""
        return self._envelope.baseline_ns / NS_PER_S

    def stamp_ns(self, counter: int, arrival_ns: int, stream: int = 0) -> int:
        """Return when a frame was taken, host time; later than the frame before it.

        `arrival_ns` is the host's time when its last byte was read, `stream` its number as the
        driver counts streams.
        """
        if self._last is not None and self._is_another_count(counter, arrival_ns, stream):
            before, self._envelope = self._envelope, LowerEnvelope()
            if before.baseline_ns >= _KNOWN_AFTER_NS:
                drift = before.line.slope
                self._envelope = LowerEnvelope(drift=drift, drift_sigma=KNOWN_DRIFT_SIGMA)
            self.restarts += 1
        self._last = stream, counter
        nominal_ns = frame_time_ns(counter, self._rate_hz)
        self._envelope.take(nominal_ns, arrival_ns)
        stamp_ns = self._envelope.line.host_ns(nominal_ns)
        self._last_stamp_ns = max(stamp_ns, self._last_stamp_ns + 1)
        return self._last_stamp_ns

    def _is_another_count(self, counter: int, arrival_ns: int, stream: int) -> bool:
        assert self._last is not None
        last_stream, last_counter = self._last
        if stream != last_stream or counter <= last_counter:
            return True
        expected_ns = self._envelope.line.host_ns(frame_time_ns(counter, self._rate_hz))
        return not -_BREAK_NS <= arrival_ns - expected_ns <= _LATE_BREAK_NS
