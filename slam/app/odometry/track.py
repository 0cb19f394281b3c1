"""Wheel odometry: TUM lines in, the pose at a frame's time out.

Odometry is canonical as text, once, at its source. Every path (a unix socket, a scene in this
process, a recorded session) parses the same lines here, so all of them see the same floats.
"""

from __future__ import annotations

import math
import socket
from bisect import bisect_left, bisect_right
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import OdometryError
from slam.app.odometry.tum import NS_PER_S, TumError, TumSample, parse_tum_line
from slam.geometry import wrap_angle

# A frame may lie this far outside the samples, as the last frame of a scene does by rounding.
_HOLD_NS = NS_PER_S // 2


class OdometryTrack:
    """Odometry samples in time order, asked for the pose at any time between them.

    Later ones may be appended while a robot drives; what lies between earlier ones stays the same
    to the last bit.
    """

    def __init__(self, samples: Iterable[TumSample]) -> None:
        self._samples: list[TumSample] = []
        self._stamps_ns: list[int] = []
        # Unwrapped, so that interpolation across +-pi takes the short way round.
        self._heading_rad: list[float] = []
        self._turns_rad = 0.0  # what unwrapping adds to the newest heading
        for number, sample in enumerate(samples, start=1):
            if self._stamps_ns and sample.t_ns <= self._stamps_ns[-1]:
                raise OdometryError(f"odometry: line {number} is not later than the line before")
            self.append(sample)
        if not self._samples:
            raise OdometryError("odometry: the source sent no pose")

    @property
    def samples(self) -> tuple[TumSample, ...]:
        return tuple(self._samples)

    @property
    def last(self) -> TumSample:
        return self._samples[-1]

    @property
    def first_ns(self) -> int:
        return self._stamps_ns[0]

    @property
    def last_ns(self) -> int:
        return self._stamps_ns[-1]

    def gap_ns(self, t_ns: int) -> float:
        """Return how far apart the two samples around a time are; infinite outside of all.

        At a sample's own time there is no gap.
        """
        after = bisect_left(self._stamps_ns, t_ns)
        if after == len(self._stamps_ns) or (after == 0 and self._stamps_ns[0] != t_ns):
            return math.inf
        if self._stamps_ns[after] == t_ns:
            return 0.0
        return self._stamps_ns[after] - self._stamps_ns[after - 1]

    def append(self, sample: TumSample) -> None:
        """Take a sample later than all before it.

        Raises
        ------
        OdometryError
            It is not later.
        """
        if self._samples:
            if sample.t_ns <= self._stamps_ns[-1]:
                raise OdometryError("odometry: a pose is not later than the one before")
            self._turns_rad += _unwrapping(self._samples[-1].heading_rad, sample.heading_rad)
        self._samples.append(sample)
        self._stamps_ns.append(sample.t_ns)
        self._heading_rad.append(sample.heading_rad + self._turns_rad)

    @classmethod
    def from_lines(cls, lines: Iterable[str]) -> OdometryTrack:
        """Parse TUM lines.

        Raises
        ------
        OdometryError
            A malformed line, no line at all, or time that does not go forward.
        """
        samples = []
        for number, line in enumerate(lines, start=1):
            try:
                samples.append(parse_tum_line(line))
            except TumError as error:
                raise OdometryError(f"odometry, line {number}: {error}") from None
        return cls(samples)

    def pose_at(self, t_ns: int) -> NDArray[np.float64]:
        """Interpolate the pose at one time.

        Parameters
        ----------
        t_ns
            Session time [ns].

        Returns
        -------
        Shape (3,): x [m], y [m], heading [rad] in [-pi, pi), odometry frame. Position and heading
        are linear between two samples; at a sample's own time they are the sample's. That is exact
        on straight legs and for turns on the spot. On an arc the position half way between samples
        is chord / 2 * tan(turn / 4) off, 0.12 mm for 1 cm and 5.6 degrees; an arc instead would
        help only there, and fits no wheel that stops or starts between samples either.

        Raises
        ------
        OdometryError
            The time is more than half a second outside the samples.
        """
        stamps_ns = self._stamps_ns
        first, last = stamps_ns[0], stamps_ns[-1]
        if not first - _HOLD_NS <= t_ns <= last + _HOLD_NS:
            raise OdometryError(
                f"odometry covers {first / NS_PER_S:.2f} .. {last / NS_PER_S:.2f} s, "
                f"but a frame came at {t_ns / NS_PER_S:.2f} s"
            )
        after = bisect_right(stamps_ns, t_ns)
        if after in (0, len(stamps_ns)):
            row = min(after, len(stamps_ns) - 1)
            held = self._samples[row]
            return np.array([held.x_m, held.y_m, wrap_angle(self._heading_rad[row])])
        old, new = self._samples[after - 1], self._samples[after]
        part = (t_ns - old.t_ns) / (new.t_ns - old.t_ns)
        turn_rad = self._heading_rad[after] - self._heading_rad[after - 1]
        heading_rad = self._heading_rad[after - 1] + part * turn_rad
        return np.array(
            [
                old.x_m + part * (new.x_m - old.x_m),
                old.y_m + part * (new.y_m - old.y_m),
                wrap_angle(heading_rad),
            ]
        )


def _unwrapping(before_rad: float, after_rad: float) -> float:
    """Return what to add to a heading so that it follows on the one before the short way round.

    One step of `numpy.unwrap`, to the last bit.

    >>> _unwrapping(3.0, -3.0) == math.tau, _unwrapping(0.5, 0.25)
    (True, 0.0)
    """
    turn_rad = after_rad - before_rad
    if abs(turn_rad) < math.pi:
        return 0.0
    short_rad = (turn_rad + math.pi) % math.tau - math.pi
    if short_rad == -math.pi and turn_rad > 0:
        short_rad = math.pi
    return short_rad - turn_rad


def read_odometry_socket(path: str, timeout_s: float = 10.0) -> OdometryTrack:
    """Read every line that an emulator under `--pace asap` serves on its unix socket.

    Raises
    ------
    OdometryError
        There is no listener, the sender stops before the end, or a line is malformed.
    """
    received = bytearray()
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(timeout_s)
            client.connect(path)
            while chunk := client.recv(65536):
                received += chunk
    except TimeoutError:
        raise OdometryError(
            f"odometry socket {path}: silent for {timeout_s:g} s before its end"
        ) from None
    except OSError as error:
        raise OdometryError(f"odometry socket {path}: {error.strerror or error}") from None
    return OdometryTrack.from_lines(received.decode("ascii", errors="replace").splitlines())
