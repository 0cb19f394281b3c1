"""Wheel odometry: TUM lines in, the pose at a frame's time out.

Odometry is canonical as text, once, at its source. Every path (a unix socket, a scene in this
process, a recorded session) parses the same lines here, so all of them see the same floats.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import OdometryError
from slam.app.tum import NS_PER_S, TumError, TumSample, parse_tum_line
from slam.geometry import wrap_angle

# A frame may lie this far outside the samples, as the last frame of a scene does by rounding.
_HOLD_NS = NS_PER_S // 2


class OdometryTrack:
    """Odometry samples in time order, asked for the pose at any time between them."""

    def __init__(self, samples: Iterable[TumSample]) -> None:
        self.samples = tuple(samples)
        if not self.samples:
            raise OdometryError("odometry: the source sent no pose")
        self._stamps_ns = np.array([sample.t_ns for sample in self.samples], dtype=np.int64)
        if np.any(np.diff(self._stamps_ns) <= 0):
            late = int(np.argmax(np.diff(self._stamps_ns) <= 0)) + 1
            raise OdometryError(f"odometry: line {late + 1} is not later than the line before")
        self._xy_m = np.array([(sample.x_m, sample.y_m) for sample in self.samples])
        # Unwrapped, so that interpolation across +-pi takes the short way round.
        self._heading_rad = np.unwrap([sample.heading_rad for sample in self.samples])

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
        first, last = int(self._stamps_ns[0]), int(self._stamps_ns[-1])
        if not first - _HOLD_NS <= t_ns <= last + _HOLD_NS:
            raise OdometryError(
                f"odometry covers {first / NS_PER_S:.2f} .. {last / NS_PER_S:.2f} s, "
                f"but a frame came at {t_ns / NS_PER_S:.2f} s"
            )
        after = int(np.searchsorted(self._stamps_ns, t_ns, side="right"))
        if after in (0, len(self._stamps_ns)):
            row = min(after, len(self._stamps_ns) - 1)
            (x_m, y_m), heading_rad = self._xy_m[row], self._heading_rad[row]
        else:
            before = after - 1
            step_ns = int(self._stamps_ns[after]) - int(self._stamps_ns[before])
            part = (t_ns - int(self._stamps_ns[before])) / step_ns
            x_m, y_m = self._xy_m[before] + part * (self._xy_m[after] - self._xy_m[before])
            turn_rad = self._heading_rad[after] - self._heading_rad[before]
            heading_rad = self._heading_rad[before] + part * turn_rad
        return np.array([x_m, y_m, wrap_angle(float(heading_rad))])


def read_odometry_socket(path: str, timeout_s: float = 10.0) -> OdometryTrack:
    """Read every line that an emulator under `--pace asap` serves on its unix socket.

    Raises
    ------
    OdometryError
        Nobody listens there, the sender falls silent before the end, or a line is malformed.
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
