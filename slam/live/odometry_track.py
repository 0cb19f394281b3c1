"""Trajectories as TUM text, and the pose at any time between their lines.

`timestamp x y z qx qy qz qw`, seconds and metres, no header; of odometry six more numbers may
follow, the covariance of its velocity. Text carries the int64 nanoseconds as a decimal with nine
places, and reading goes through Decimal, so no stamp passes through a float.

Odometry is canonical as text, once, at its source. Every path (a unix socket, a scene in this
process, a recorded session) parses the same lines here, so all of them see the same floats.
"""

from __future__ import annotations

import math
import re
import socket
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.library.pose_track import PoseTrack
from slam.live.errors import AppError, OdometryError
from xethru_protocol.operating_system import read_bounded
from xethru_protocol.validation import shown

NS_PER_S = 1_000_000_000
MOST_GAP_NS = NS_PER_S
"""Between two samples farther apart the motion of the robot is unknown."""
_FIELDS = 8
_WITH_COVARIANCE = _FIELDS + 6
_NOISE_SIZE = 9
_BLANKS = re.compile(r"[ \t]+")
# Python's own readers take digits of every script, underscores, hexadecimals and words, too.
_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_MAX_BYTES = 1 << 28
"""Weeks of poses; a longer or endless file is not a trajectory."""
_MAX_STAMP_S = Decimal(2**63 - 1) / NS_PER_S
"""Where int64 nanoseconds end; a larger stamp was written in another unit."""


class TumError(AppError):
    """A line is not TUM text; the message names the line and what is expected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TumSample:
    """One line of a planar trajectory, as written: position and the twist of the quaternion.

    `velocity_covariance` is the upper triangle, row by row, of the covariance of velocity forwards
    and to the left [m/s] and turn rate [rad/s], as the last of 14 numbers; () if there are 8.
    """

    t_ns: int
    x_m: float
    y_m: float
    qz: float
    qw: float
    velocity_covariance: tuple[float, ...] = ()

    @property
    def heading_rad(self) -> float:
        """Rotation about the vertical, in (-2 pi, 2 pi]: the twist part of the quaternion."""
        return 2.0 * math.atan2(self.qz, self.qw)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """Poses over time, shape (n, 3): x [m], y [m], heading [rad]; stamps ascending, shape (n,)."""

    stamps_ns: NDArray[np.int64]
    poses: NDArray[np.float64]


def parse_tum_line(line: str) -> TumSample:
    """Read one TUM line; roll and pitch are ignored, as the robot is planar.

    Raises
    ------
    TumError
        Not 8 or 14 numbers, one that is not a finite decimal in ASCII, a stamp that
        cannot be seconds, a quaternion without length.

    >>> sample = parse_tum_line("12.000000005 1.5 -2 0 0 0 0 1")
    >>> sample.t_ns, sample.x_m, sample.y_m
    (12000000005, 1.5, -2.0)
    """
    fields = _BLANKS.split(line.strip(" \t\r\n"))
    if len(fields) not in (_FIELDS, _WITH_COVARIANCE):
        raise TumError(
            "expected 8 numbers (timestamp x y z qx qy qz qw), "
            f"found {len(fields)}: {shown(line.strip())}"
        )
    if not all(map(_DECIMAL.fullmatch, fields)):
        raise TumError(f"not a decimal number in TUM line {shown(line.strip())}")
    try:
        stamp_s = Decimal(fields[0])
        x, y, _z, _qx, _qy, qz, qw, *covariance = (float(field) for field in fields[1:])
    except (InvalidOperation, ValueError):
        raise TumError(f"not a number in TUM line {shown(line.strip())}") from None
    if not stamp_s.is_finite() or not all(map(math.isfinite, (x, y, qz, qw, *covariance))):
        raise TumError(f"not a finite number in TUM line {shown(line.strip())}")
    # copy_abs, as abs would round to the context and overflow on a huge exponent
    if stamp_s.copy_abs() >= _MAX_STAMP_S:
        raise TumError(
            f"stamps must be seconds, found {fields[0]} in TUM line {shown(line.strip())}"
        )
    if qz == 0.0 and qw == 0.0:
        raise TumError(f"quaternion without a heading in TUM line {shown(line.strip())}")
    return TumSample(
        t_ns=round(stamp_s * NS_PER_S),
        x_m=x,
        y_m=y,
        qz=qz,
        qw=qw,
        velocity_covariance=tuple(covariance),
    )


def format_tum_line(t_ns: int, pose: NDArray[np.float64]) -> str:
    """Write a pose [x m, y m, heading rad] as one TUM line; floats round-trip exactly.

    >>> format_tum_line(1_000_000_001, np.array([0.5, -1.0, 0.0]))
    '1.000000001 0.5 -1.0 0 0 0 0.0 1.0'
    """
    x, y, heading = (float(value) for value in pose)
    qz, qw = math.sin(heading / 2), math.cos(heading / 2)
    return format_sample(TumSample(t_ns=int(t_ns), x_m=x, y_m=y, qz=qz, qw=qw))


def format_sample(sample: TumSample) -> str:
    """Write a sample as the TUM line that it is read from."""
    sign = "-" if sample.t_ns < 0 else ""
    seconds, rest = divmod(abs(sample.t_ns), NS_PER_S)
    numbers = (sample.x_m, sample.y_m, 0, 0, 0, sample.qz, sample.qw, *sample.velocity_covariance)
    return f"{sign}{seconds}.{rest:09d} {' '.join(map(repr, numbers))}"


def write_tum(path: Path, trajectory: Trajectory) -> None:
    lines = map(format_tum_line, trajectory.stamps_ns.tolist(), trajectory.poses)
    path.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")


def read_tum(path: Path) -> Trajectory:
    """Read a TUM file; empty lines and lines that begin with `#` are skipped.

    Raises TumError if it cannot be read, holds no pose, goes back in time, or has a bad line.
    """
    try:
        text = read_bounded(path, _MAX_BYTES).decode()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise TumError(f"{path}: cannot read: {reason}") from None
    samples = []
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            samples.append(parse_tum_line(line))
        except TumError as error:
            raise TumError(f"{path}, line {number}: {error}") from None
        if len(samples) > 1 and samples[-1].t_ns <= samples[-2].t_ns:
            back_s = (samples[-2].t_ns - samples[-1].t_ns) / NS_PER_S
            raise TumError(
                f"{path}, line {number}: its time is not after the line before, but {back_s:.3f} s "
                "earlier; sort the lines, or, where a clock was set back, cut the file there"
            )
    if not samples:
        raise TumError(f"{path}: holds no pose")
    rows = [(sample.x_m, sample.y_m, sample.heading_rad) for sample in samples]
    return Trajectory(
        stamps_ns=np.array([sample.t_ns for sample in samples], dtype=np.int64),
        poses=np.array(rows, dtype=np.float64),
    )


# A frame may lie this far outside the samples, as the last frame of a scene does by rounding.
_HOLD_NS = NS_PER_S // 2


class OdometryTrack(PoseTrack):
    """Odometry as TUM lines in time order, asked for the pose at any time between them.

    Iterating gives the samples as they came.
    """

    def __init__(
        self,
        samples: Iterable[TumSample],
        *,
        may_restart: bool = True,
        may_be_empty: bool = False,
    ) -> None:
        super().__init__(may_restart=may_restart)
        self._qz, self._qw = array("d"), array("d")  # the quaternion of each sample
        # Of each sample the nine numbers of `noise_at`, if all samples have covariances
        self._noise = array("d")
        self._n_forgotten = 0
        for sample in samples:
            self.append(sample)
        if not self._stamps_ns and not may_be_empty:
            raise OdometryError("odometry: the source sent no pose")

    def __iter__(self) -> Iterator[TumSample]:
        return map(self._sample, range(len(self)))

    def _sample(self, row: int) -> TumSample:
        return TumSample(
            t_ns=self._stamps_ns[row],
            x_m=self._x_m[row],
            y_m=self._y_m[row],
            qz=self._qz[row],
            qw=self._qw[row],
        )

    @property
    def last(self) -> TumSample:
        return self._sample(-1)

    def is_known(self, t_ns: int) -> bool:
        """Return whether the pose at this time is a sample's or lies between two close enough."""
        after = bisect_left(self._stamps_ns, t_ns)
        if after == len(self):
            return False
        after_ns = self._stamps_ns[after]
        return t_ns == after_ns or (
            after > 0 and after_ns - self._stamps_ns[after - 1] <= MOST_GAP_NS
        )

    def append(self, sample: TumSample) -> bool:
        """Take a sample; OdometryError if it is not later than all before it.

        Return whether the source seems to have been restarted.
        """
        if self._stamps_ns and sample.t_ns <= self.last_ns:
            number = self._n_forgotten + len(self) + 1
            raise OdometryError(f"odometry: line {number} is not later than the line before")
        is_restart = self.add(sample.t_ns, (sample.x_m, sample.y_m, sample.heading_rad))
        self._noise.extend(self._newest_noise(sample))
        self._qz.append(sample.qz)
        self._qw.append(sample.qw)
        return is_restart

    def forget_before(self, t_ns: int) -> int:
        n_forgotten = super().forget_before(t_ns)
        self._n_forgotten += n_forgotten
        del self._qz[:n_forgotten], self._qw[:n_forgotten]
        del self._noise[: _NOISE_SIZE * n_forgotten]
        return n_forgotten

    def _newest_noise(self, sample: TumSample) -> list[float]:
        """Return the noise until the newest sample, as `noise_at` has it.

        Its velocity is taken to err independently of the one before, for the time between the two.
        """
        n_before = len(self) - 1
        if not sample.velocity_covariance or len(self._noise) != _NOISE_SIZE * n_before:
            return []
        if not n_before:
            return [0.0] * _NOISE_SIZE
        dt_s = (sample.t_ns - self._stamps_ns[-2]) / NS_PER_S
        added = symmetric(sample.velocity_covariance)
        turned = np.eye(3)
        heading_rad = sample.heading_rad + float(self.frame_at(sample.t_ns)[2])
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        turned[:2, :2] = [[c, -s], [s, c]]
        noise = self._noise_of(n_before - 1) + dt_s**2 * (turned @ added @ turned.T)
        return [float(number) for number in noise.ravel()]

    def _noise_of(self, row: int) -> NDArray[np.float64]:
        begin = _NOISE_SIZE * row
        return np.array(self._noise[begin : begin + _NOISE_SIZE]).reshape(3, 3)

    def noise_at(self, t_ns: int) -> NDArray[np.float64]:
        """Return the noise gathered until a session time, see `slam.results.NoiseAt`.

        It is linear between two samples. Raises OdometryError where samples lack covariances.
        """
        if len(self._noise) != _NOISE_SIZE * len(self):
            raise OdometryError("odometry: its lines have no covariance")
        after = bisect_right(self._stamps_ns, t_ns)
        if after in (0, len(self)):
            return self._noise_of(min(after, len(self) - 1))
        before_ns, after_ns = self._stamps_ns[after - 1], self._stamps_ns[after]
        part = (t_ns - before_ns) / (after_ns - before_ns)
        before = self._noise_of(after - 1)
        return before + part * (self._noise_of(after) - before)

    @staticmethod
    def from_lines(lines: Iterable[str]) -> OdometryTrack:
        """Parse TUM lines; OdometryError if one is malformed or not later, or there is none."""
        samples = []
        for number, line in enumerate(lines, start=1):
            try:
                samples.append(parse_tum_line(line))
            except TumError as error:
                raise OdometryError(f"odometry, line {number}: {error}") from None
        return OdometryTrack(samples)

    def pose_at(self, t_ns: int) -> NDArray[np.float64]:
        """Return the pose at a session time; see `PoseTrack`.

        Up to half a second outside the samples it is the nearest one. OdometryError beyond that.
        """
        first, last = self.first_ns, self.last_ns
        if not first - _HOLD_NS <= t_ns <= last + _HOLD_NS:
            raise OdometryError(
                f"odometry covers {first / NS_PER_S:.2f} .. {last / NS_PER_S:.2f} s, "
                f"but a frame came at {t_ns / NS_PER_S:.2f} s"
            )
        return super().pose_at(t_ns)


def symmetric(triangle: Sequence[float]) -> NDArray[np.float64]:
    """Return the matrix (3, 3) of an upper triangle of six numbers, row by row."""
    matrix = np.zeros((3, 3))
    matrix[np.triu_indices(3)] = triangle
    return matrix + np.triu(matrix, 1).T


def read_odometry_socket(path: str, timeout_s: float = 10.0) -> OdometryTrack:
    """Read every line that an emulator under `--pace asap` serves on its unix socket.

    `pose_at(t_ns)` of what is returned is the pose of the wheels at a time, which `Slam.step`
    takes; `last_ns` is the time of the last line.

    Raises OdometryError if there is no listener, the sender stops before the end, or a line is bad.
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
