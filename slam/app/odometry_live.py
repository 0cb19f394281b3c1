"""Odometry as it comes: every line checked, what is wrong with it said once, time kept.

Session time is the odometry's own clock. What the host's clock shows against it is told by when
lines arrive, or known beforehand; then radar frames, stamped with the host's time, can be placed.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam.app.arrival import ClockLine, LowerEnvelope
from slam.app.errors import OdometryError
from slam.app.odometry import OdometryTrack
from slam.app.tum import NS_PER_S, TumError, TumSample, parse_tum_line

MOST_GAP_NS = NS_PER_S
"""Between two samples farther apart nobody knows how the robot moved."""
SILENCE_S = 10.0
"""A source without a new pose for so long is dead; that of wheels that stand still talks on."""
MOST_SPEED_MPS = 10.0
"""Faster robots do not carry these radars; a pose that far off was set by hand or reset."""
AHEAD_NS = 60 * NS_PER_S
"""A file may begin so much later than a run, and a clock be so far off."""
MOST_STAMP_NS = (2**31 - 1_000_000) * NS_PER_S
"""The seconds of a ROS message end at 2**31; days before, for a drive that begins there goes on."""
MOST_M = 1e8
"""Farther than once around the Earth, as positions on a map may be; the filter squares them."""
_COMPLAINTS = 5


class FixedClock:
    """A clock known beforehand: `origin_ns` is the host's time at session time 0."""

    def __init__(self, origin_ns: int) -> None:
        self._line = ClockLine(origin_ns=origin_ns)

    def session_ns(self, host_ns: int) -> int:
        """Return the session time of a host time."""
        return self._line.nominal_ns(host_ns)


class LiveOdometry:
    """Lines in, poses out; what is wrong comes out as words.

    Parameters
    ----------
    name
        What to call the source in messages to people.
    clock
        Host time of session time 0, if known; None: from when lines arrive.

    Attributes
    ----------
    n_refused
        Lines that were no pose, or not later than the one before.
    ended
        Whether no more lines will come.
    trouble
        Why they will not; "" where the source just ended.
    """

    def __init__(self, name: str, clock: FixedClock | None = None) -> None:
        self._name = name
        self._fixed = clock
        self._envelope = LowerEnvelope()
        self._track: OdometryTrack | None = None
        self._heard_ns: int | None = None  # host time of the newest pose taken
        self._trouble = ""  # why the lines since then were refused
        self._complaints = 0
        self.n_refused = 0
        self.ended = False
        self.trouble = ""

    @property
    def has_pose(self) -> bool:
        """Whether a pose came."""
        return self._track is not None

    @property
    def first_ns(self) -> int:
        """Session time of the first pose."""
        return self._whole().first_ns

    @property
    def last_ns(self) -> int:
        """Session time of the newest pose."""
        return self._whole().last_ns

    @property
    def drift_ppm(self) -> float | None:
        """How fast its clock is against the host's, in millionths; None where that is not asked."""
        return None if self._fixed else self._envelope.line.drift_ppm

    def session_ns(self, host_ns: int) -> int:
        """Return the session time of a host time; needs a pose, unless the clock is known."""
        if self._fixed is not None:
            return self._fixed.session_ns(host_ns)
        return self._envelope.line.nominal_ns(host_ns)

    def take(self, line: str, arrival_ns: int) -> tuple[TumSample | None, str]:
        """Take one line.

        Parameters
        ----------
        line
            TUM text; empty ones and comments are passed over.
        arrival_ns
            Host time when it came.

        Returns
        -------
        The pose, None if the line gave none; and what the user should know, or "".
        """
        if not line.strip() or line.lstrip().startswith("#"):
            return None, ""
        try:
            sample = parse_tum_line(line)
        except TumError as error:
            return None, self._refuse(str(error))
        if trouble := _cannot_be(sample):
            return None, self._refuse(trouble)
        if self._track is not None and sample.t_ns <= self._track.last_ns:
            back_s = (self._track.last_ns - sample.t_ns) / NS_PER_S
            return None, self._refuse(
                f"its stamps jumped back by {back_s:.3f} s"
                if back_s
                else f"stamp {sample.t_ns / NS_PER_S:.3f} s came twice"
            )
        words = self._accept(sample)
        if self._fixed is None:
            self._envelope.take(sample.t_ns, arrival_ns)
        self._heard_ns = arrival_ns
        return sample, words

    def _accept(self, sample: TumSample) -> str:
        if self._track is None:
            self._track = OdometryTrack([sample])
            return ""
        before = self._track.last
        self._track.append(sample)
        words = []
        if self._trouble:
            words.append("its lines are sound again")
            self._trouble, self._complaints = "", 0
        elapsed_ns = sample.t_ns - before.t_ns
        step_m = math.hypot(sample.x_m - before.x_m, sample.y_m - before.y_m)
        if elapsed_ns > MOST_GAP_NS:
            words.append(
                f"{elapsed_ns / NS_PER_S:.1f} s of it are missing; no scan of them is used"
            )
        if step_m > MOST_SPEED_MPS * elapsed_ns / NS_PER_S:
            words.append(
                f"the pose jumped by {step_m:.2f} m in {elapsed_ns / NS_PER_S:.3f} s; "
                "was it reset? SLAM takes it for a drive"
            )
        return "; ".join(words)

    def _refuse(self, trouble: str) -> str:
        self.n_refused += 1
        is_news = not self._trouble
        self._trouble = self._trouble or trouble
        self._complaints += 1
        if is_news:
            return f"{trouble}; such lines are passed over"
        if self._complaints == _COMPLAINTS:
            return f"{trouble}; no more is said of such lines"
        return ""

    def end(self, trouble: str) -> None:
        """Take note that no more lines will come."""
        if not trouble and self._track is None:
            trouble = f"odometry from {self._name}: ended before its first pose"
            trouble += f": {self._trouble}" if self._trouble else ""
        self.ended, self.trouble = True, trouble

    def dead(self, now_ns: int, since_ns: int) -> str:
        """Return why the source must be taken for dead, "" if it need not.

        Parameters
        ----------
        now_ns
            Host time.
        since_ns
            Host time from which on poses are expected.
        """
        heard_ns = since_ns if self._heard_ns is None else max(self._heard_ns, since_ns)
        if self.ended or now_ns - heard_ns <= SILENCE_S * NS_PER_S:
            return ""
        if self._trouble:
            return (
                f"odometry from {self._name}: no usable line for {SILENCE_S:g} s: {self._trouble}"
            )
        said = "no line" if self._heard_ns is None else "no more line"
        return f"odometry from {self._name}: {said} for {SILENCE_S:g} s; is its sender running?"

    def is_elsewhere(self, now_ns: int) -> str:
        """Return why its stamps cannot be of the clock that it was said to have, "" if they can."""
        t_ns = self.session_ns(now_ns)
        if self._fixed is None or self.first_ns - AHEAD_NS <= t_ns <= self.last_ns + AHEAD_NS:
            return ""
        return (
            f"odometry from {self._name}: its newest pose is of {self.last_ns / NS_PER_S:.3f} s, "
            f"and by --odometry-clock it is {t_ns / NS_PER_S:.3f} s now: its stamps are of another "
            "clock; if you do not know which, leave the option out"
        )

    def covers(self, t_ns: int) -> bool:
        """Return whether a pose at or after this time is known."""
        return self._track is not None and t_ns <= self._track.last_ns

    def is_known(self, t_ns: int) -> bool:
        """Return whether the pose at this time lies between two samples close enough."""
        return self._track is not None and self._track.gap_ns(t_ns) <= MOST_GAP_NS

    def pose_at(self, t_ns: int) -> NDArray[np.float64]:
        """Return the pose at a session time; see `OdometryTrack.pose_at`."""
        return self._whole().pose_at(t_ns)

    def _whole(self) -> OdometryTrack:
        if self._track is None:
            raise OdometryError(f"odometry from {self._name}: no pose came")
        return self._track


def _cannot_be(sample: TumSample) -> str:
    """Return why a session cannot hold a pose, or the filter not take it; "" if both can."""
    if not 0 <= sample.t_ns < MOST_STAMP_NS:
        return (
            f"stamp {sample.t_ns / NS_PER_S:.3f} s is none of 0 to {MOST_STAMP_NS // NS_PER_S} s, "
            "which a session can hold"
        )
    if max(abs(sample.x_m), abs(sample.y_m)) > MOST_M:
        return f"position ({sample.x_m:g}, {sample.y_m:g}) m is nowhere on Earth"
    return ""
