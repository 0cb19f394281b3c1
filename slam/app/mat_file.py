"""MATLAB files in the layout of the paper's authors' `dataset_mph*_mpp*.mat`.

One row per collected state:

======  ===============  ========================================================================
odom    (n, 3)           pose by the wheels: x, y [mm], heading [rad]
obsLHS  (n, m, 2)        fixes of the two left radars: distance [mm], bearing [rad], from the body's
obsRHS  (n, m, 2)        origin and counter-clockwise from forward; of the right ones, unwrapped to
                         pi and more; rows of zeros are empty
R1..R4  (n, n_bins)      raw frames of the four radars; rows of zeros are none
======  ===============  ========================================================================

Two more variables, which their programs ignore and ours write::

    t       (n, 1)   session time of the state [s]
    mounts  (4, 3)   of the radars: x, y [mm], boresight [rad], body frame
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat, savemat

from slam.app.errors import AppError, naming
from slam.app.file_kinds import describe_kind

_MM = 1e-3
_POSE_UNITS = np.array([_MM, _MM, 1.0])
_FEWEST_FIXES = 5  # that the authors' programs have room for
_FRAME_NAMES = ("R1", "R2", "R3", "R4")

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatDrive:
    """What such a file holds.

    Attributes
    ----------
    odometry
        Shape (n, 3): x [m], y [m], heading [rad], odometry frame.
    left, right
        For each state the fixes of that side, shape (k, 2): x [m], y [m], body frame.
    frames
        Raw frames by the number of the radar, 1 to 4, shape (n, n_bins), float32; zeros: none.
    stamps_s
        Shape (n,), ascending; None where the file does not tell.
    mounts
        Shape (4, 3): x [m], y [m], boresight [rad], body frame; None where the file does not tell.
    """

    odometry: Array
    left: tuple[Array, ...]
    right: tuple[Array, ...]
    frames: dict[int, NDArray[np.float32]]
    stamps_s: Array | None = None
    mounts: Array | None = None


def read_mat(path: Path) -> MatDrive:
    """Read a file.

    Raises
    ------
    AppError
        No such MATLAB file, or without the variables above; one line.
    """
    try:
        with path.open("rb") as stream:
            table = loadmat(stream)  # type: ignore[arg-type]  # takes files, the stubs know names
    except NotImplementedError:
        raise AppError(
            f"{path}: a MATLAB file of version 7.3; in MATLAB, save it with '-v7'"
        ) from None
    except OSError as error:
        raise AppError(f"{path}: cannot read: {error.strerror or error}") from None
    except Exception as error:  # scipy does not say what it may raise of a damaged file
        words = " ".join(str(error).split()) or type(error).__name__
        raise AppError(
            f"{path}: no MATLAB file, or a damaged one{describe_kind(path)}: {words}"
        ) from None
    odometry = _variable(path, table, "odom", (3,))
    n_states = len(odometry)
    if not n_states:
        raise AppError(f"{path}: odom is empty, there is no state")
    left = _variable(path, table, "obsLHS", (None, 2), n_states)
    right = _variable(path, table, "obsRHS", (None, 2), n_states)
    frames = {
        number: _variable(path, table, name, (None,), n_states).astype(np.float32)
        for number, name in enumerate(_FRAME_NAMES, start=1)
        if name in table
    }
    stamps_s = _variable(path, table, "t", (1,), n_states)[:, 0] if "t" in table else None
    if stamps_s is not None and not np.all(np.diff(stamps_s) > 0):
        raise AppError(f"{path}: t must go forward from state to state")
    mounts = _variable(path, table, "mounts", (3,), 4) if "mounts" in table else None
    return MatDrive(
        stamps_s=stamps_s,
        mounts=None if mounts is None else mounts * _POSE_UNITS,
        odometry=odometry * _POSE_UNITS,
        left=tuple(map(_points_of, left)),
        right=tuple(map(_points_of, right)),
        frames=frames,
    )


def write_mat(path: Path, drive: MatDrive) -> None:
    """Write a file that `read_mat`, MATLAB and Octave read.

    Raises
    ------
    AppError
        It cannot be written.
    """
    table: dict[str, Any] = {
        "odom": drive.odometry / _POSE_UNITS,
        "obsLHS": _polar_of(drive.left, unwrapped=False),
        "obsRHS": _polar_of(drive.right, unwrapped=True),
    }
    table |= {f"R{number}": rows for number, rows in drive.frames.items()}
    if drive.stamps_s is not None:
        table["t"] = drive.stamps_s[:, np.newaxis]
    if drive.mounts is not None:
        table["mounts"] = drive.mounts / _POSE_UNITS
    with naming(path):
        path.open("wb").close()  # savemat's own words would not say why it cannot be
        savemat(path, table, appendmat=False, do_compression=True)


def _variable(
    path: Path,
    table: dict[str, Any],
    name: str,
    ends: tuple[int | None, ...],
    n_states: int | None = None,
) -> Array:
    """Return a variable of shape (n_states, *ends); None stands for any number."""
    wanted = ", ".join("n" if size is None else str(size) for size in (n_states, *ends))
    value = table.get(name)
    if value is None:
        known = ", ".join(sorted(key for key in table if not key.startswith("__"))) or "nothing"
        raise AppError(f"{path}: holds no {name} of shape ({wanted}); it holds {known}")
    fits = (
        isinstance(value, np.ndarray)
        and value.dtype.kind in "fiu"
        and value.ndim == 1 + len(ends)
        and all(
            size in (None, found)
            for size, found in zip((n_states, *ends), value.shape, strict=True)
        )
    )
    if not fits:
        found = getattr(value, "shape", type(value).__name__)
        raise AppError(f"{path}: {name} is {found}, must be numbers of shape ({wanted})")
    numbers = np.asarray(value, dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise AppError(f"{path}: {name} holds NaN or infinity")
    return numbers


def _points_of(rows: Array) -> Array:
    """Return the points of one state's fixes, shape (k, 2) [m], from (m, 2) [mm, rad]."""
    distance_mm, bearing = rows[rows[:, 0] > 0].T
    return _MM * np.column_stack([distance_mm * np.cos(bearing), distance_mm * np.sin(bearing)])


def _polar_of(states: tuple[Array, ...], *, unwrapped: bool) -> Array:
    most = max([_FEWEST_FIXES, *map(len, states)])
    table = np.zeros((len(states), most, 2))
    for row, points in zip(table, states, strict=True):
        if len(points):
            x, y = points.T
            bearing = np.arctan2(y, x)
            row[: len(points), 0] = np.hypot(x, y) / _MM
            row[: len(points), 1] = bearing % math.tau if unwrapped else bearing
    return table
