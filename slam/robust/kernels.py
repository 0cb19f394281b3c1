"""Loops of the back end over single ranges, compiled at their first call.

Plain functions of numbers and C-contiguous arrays; the signature of each is explicit, so that it is
compiled once and kept on disk. Nothing is reordered (no ``fastmath``): same input, same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_Function = TypeVar("_Function", bound=Callable[..., Any])


def kernel(signature: str) -> Callable[[_Function], _Function]:
    """Return a decorator that compiles a function for a signature when it is first called."""

    def decorate(function: _Function) -> _Function:
        @cache
        def machine_code() -> Callable[..., Any]:
            from numba import njit  # half a second, and not every run has a robust back end

            compiled: Callable[..., Any] = njit(signature, cache=True, error_model="numpy")(
                function
            )
            return compiled

        @wraps(function)
        def call(*args: object) -> object:
            return machine_code()(*args)

        return call  # type: ignore[return-value]  # the same function, faster

    return decorate


@kernel(
    "Tuple((f8[::1], f8[:,::1], i8[:,::1], i8[::1]))"
    "(b1, f8[::1], i8, f8[:,:,::1], f8[:,::1], f8[:,::1], b1[:,::1], f8[:,:,::1], f8[:,:,::1],"
    " i8[:,:,::1], i8, i8, i8[::1], f8[::1], f8[:,::1], f8[::1])"
)
def follow(
    is_wall: bool,
    guess: Array,
    label: int,
    places: Array,
    poses: Array,
    ways: Array,
    has_frame: NDArray[np.bool_],
    ranges: Array,
    sigmas: Array,
    labels: Indices,
    newest: int,
    count: int,
    radars: Indices,
    offsets: Array,
    radar_covariance: Array,
    limits: Array,
) -> tuple[Array, Array, Indices, Indices]:
    """Filter a target back through the frames, twice, the second time from the first result.

    ``guess`` is target and covariance, (x, y, cxx, cxy, cyy), in the newest body frame. Of a ring
    of frames, the newest in row ``newest`` and ``count`` of them, are given in the odometry frame
    the antennas ``places`` (f, r, 3), bodies ``poses`` (f, 3), way and turn so far ``ways`` (f, 2);
    ``ranges`` (f, r, k) is NaN where there is none. ``radar_covariance`` is that of the q unknowns
    of the radars: the r offsets and, if they are unknown, the r places of antennas in the body
    frame. ``limits`` are half the field of view, that of members, the limits of range, the gate
    squared, and the drift of a range per way and per turn.

    Returns (x, y, cxx, cxy, cyy, chi-square, frames in view, frames hit), d(target) / d(unknowns of
    the radars) (2, q), the members (back, radar, index), newest first, and the hits of each radar.
    """
    n_radars = len(offsets)
    has_mounts = len(radar_covariance) > n_radars
    found = np.empty(8)
    by_radar = np.zeros((2, len(radar_covariance)))
    members = np.empty((count * len(radars), 3), dtype=np.int64)
    hits = np.zeros(n_radars, dtype=np.int64)
    c0, s0 = math.cos(poses[newest, 2]), math.sin(poses[newest, 2])
    x, y = guess[0], guess[1]
    n_members = 0
    for _ in range(2):
        cxx, cxy, cyy = guess[2], guess[3], guess[4]
        by_radar[:] = 0.0
        hits[:] = 0
        chi_square = 0.0
        n_members, in_view, hit = 0, 0, 0
        for back in range(count):
            f = (newest - back) % len(poses)
            way, turn = ways[newest, 0] - ways[f, 0], ways[newest, 1] - ways[f, 1]
            drift = (limits[5] * way) ** 2 + (limits[6] * turn) ** 2
            heading = poses[f, 2] - poses[newest, 2]
            ch, sh = math.cos(heading), math.sin(heading)
            sees, is_hit = False, False
            for radar in radars:
                if not has_frame[f, radar]:
                    continue
                dx, dy = (
                    places[f, radar, 0] - poses[newest, 0],
                    places[f, radar, 1] - poses[newest, 1],
                )
                ax, ay = c0 * dx + s0 * dy, c0 * dy - s0 * dx
                yaw = places[f, radar, 2] - poses[newest, 2]
                if is_wall:
                    dx, dy = math.cos(x), math.sin(x)
                    distance = y - dx * ax - dy * ay
                    ux, uy = dy * ax - dx * ay, 1.0
                    bearing = x
                else:
                    dx, dy = x - ax, y - ay
                    distance = math.sqrt(dx * dx + dy * dy)
                    if distance == 0.0:
                        continue
                    dx, dy = dx / distance, dy / distance
                    ux, uy = dx, dy
                    bearing = math.atan2(dy, dx)
                off = bearing - yaw
                off = abs(off - math.tau * np.rint(off / math.tau))
                if off <= limits[0] and limits[2] <= distance <= limits[3]:
                    sees = True
                if off > limits[1]:
                    continue
                expected = distance + offsets[radar]
                nearest, nu = -1, math.inf
                for k in range(ranges.shape[2]):
                    miss = ranges[f, radar, k] - expected
                    if abs(miss) < abs(nu) and labels[f, radar, k] == label:
                        nearest, nu = k, miss
                if nearest < 0:
                    continue
                # d(range) / d(place of the antenna in the body)
                h1, h2 = -(dx * ch + dy * sh), dx * sh - dy * ch
                m1, m2 = n_radars + 2 * radar, n_radars + 2 * radar + 1
                own = radar_covariance[radar, radar]
                if has_mounts:
                    own += 2.0 * h1 * radar_covariance[radar, m1]
                    own += 2.0 * h2 * radar_covariance[radar, m2]
                    own += h1 * h1 * radar_covariance[m1, m1] + h2 * h2 * radar_covariance[m2, m2]
                    own += 2.0 * h1 * h2 * radar_covariance[m1, m2]
                px, py = cxx * ux + cxy * uy, cxy * ux + cyy * uy
                s = ux * px + uy * py + sigmas[f, radar, nearest] ** 2 + drift + own
                if nu * nu > limits[4] * s:
                    continue
                kx, ky = px / s, py / s
                x, y = x + kx * nu, y + ky * nu
                cxx, cxy, cyy = cxx - kx * px, cxy - kx * py, cyy - ky * py
                for other in range(by_radar.shape[1]):
                    change = ux * by_radar[0, other] + uy * by_radar[1, other]
                    if other == radar:
                        change += 1.0
                    elif other == m1:
                        change += h1
                    elif other == m2:
                        change += h2
                    by_radar[0, other] -= kx * change
                    by_radar[1, other] -= ky * change
                chi_square += nu * nu / s
                members[n_members, 0], members[n_members, 1] = back, radar
                members[n_members, 2] = nearest
                n_members += 1
                hits[radar] += 1
                is_hit = True
            in_view += sees or is_hit
            hit += is_hit
        found[0], found[1], found[2], found[3], found[4] = x, y, cxx, cxy, cyy
        found[5], found[6], found[7] = chi_square, in_view, hit
    return found, by_radar, members[:n_members].copy(), hits
