"""The image of a room: the brightest of what patches show, each placed by where the robot was.

A cell holds the largest value of all patches that it was in view of. The value is what pictures
show, the amplitude times the root of the coherence factor, of echoes multiplied by range**1.5, the
law by which those of rods fall: so it is the amplitude that a rod there would have at 1 m. Radars
and patches are not summed with their phases, so an error of the path from patch to patch does not
blur the image. A cell counts where most frames of a patch saw it: of few frames the coherence
factor is large by chance. Patches with grating lobes, whose frames are far apart, and patches of
turns, whose beam sweeps past each thing in a part of them, show only what no other patch does.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slam.geometry import transform
from slam.imaging.back_projection import Aperture, Grid, back_project
from slam.imaging.patches import Patch, aperture_of

Array = NDArray[np.float64]

LEVEL_DB = 0.4
"""Of one step of `RoomImage.levels`."""
_RANGE_POWER = 1.5
# An echo is 2 to 4 cm wide across the line of sight: larger cells are looked at in several points.
_MOST_SPACING_M = 0.025
_STEP = 16  # cells by which an image grows
_MOST_TURN_RAD = 0.3  # of a patch whose beam stays on what it sees
_DIRECTIONS = np.linspace(-1.0, 1.0, 9)


class RoomImage:
    """An image that grows with what radars see, in bounded memory.

    Parameters
    ----------
    cell_m
        Length of a cell.
    area
        What is imaged, of cells of that length; None: whatever patches show.
    most_cells
        An image that would take more does not grow any further.

    Attributes
    ----------
    grid
        Where its cells are.
    values, coherence
        Shape (rows, columns), float32: the image, and the coherence factor of the patch that gave
        the value; NaN where nothing was in view.
    """

    def __init__(
        self, *, cell_m: float = 0.02, area: Grid | None = None, most_cells: int = 1 << 21
    ) -> None:
        self.grid = area or Grid(x_m=0.0, y_m=0.0, cell_m=cell_m, rows=0, columns=0)
        self._most_cells = most_cells if area is None else 0
        # Value, coherence, and whether a sharp patch without grating lobes gave them
        shape = (3, self.grid.rows, self.grid.columns)
        self._layers = np.full(shape, np.nan, dtype=np.float32)
        self.values, self.coherence = self._layers[:2]

    @property
    def levels(self) -> NDArray[np.int8]:
        """Return the image as pictures show it: 100 of the brightest cell, 1 less per 0.4 dB.

        0 at 40 dB below and darker, -1 where nothing was in view.
        """
        values = np.nan_to_num(self.values)
        shares = values / np.max(values, initial=np.finfo(np.float32).tiny)
        steps = 100 + 20 / LEVEL_DB * np.log10(np.maximum(shares, 1e-6))
        return np.where(np.isnan(self.values), -1, np.clip(steps, 0, 100)).astype(np.int8)

    def add(self, patch: Patch, origin: Array) -> None:
        """Add a patch, whose own frame is at ``origin`` (3,) in the frame of the image."""
        poses = np.column_stack(
            [transform(origin, patch.poses[:, :2]), origin[2] + patch.poses[:, 2]]
        )
        aperture, profiles = aperture_of(patch.mount, patch.view, poses), patch.profiles
        grid, rows, columns = self._part(*_reach(aperture))
        if not (grid.rows and grid.columns):
            return
        k = math.ceil(grid.cell_m / _MOST_SPACING_M - 1e-9)
        fine = replace(grid, cell_m=grid.cell_m / k, rows=k * grid.rows, columns=k * grid.columns)
        n, points = len(profiles.values), fine.centres_m
        is_near = _in_view(aperture, n // 2, points)  # what most frames see, so does the middle one
        sums = back_project(profiles.times_range(_RANGE_POWER), aperture, points[is_near])
        step_m = np.linalg.norm(np.diff(aperture.antennas_m, axis=0), axis=1).max(initial=0.0)
        turn_rad = profiles.wave_number_rad_per_m * 2 * step_m * math.sin(aperture.half_beam_rad)
        is_sure = turn_rad < math.tau and np.ptp(patch.poses[:, 2]) < _MOST_TURN_RAD
        new = np.full((3, *is_near.shape), -1.0)
        new[0, is_near] = np.where(2 * sums.count > n, sums.weighted, -1.0)
        new[1, is_near], new[2] = sums.coherence_factor, is_sure
        if k > 1:
            new = new.reshape(3, grid.rows, k, grid.columns, k).swapaxes(2, 3)
            new = new.reshape(3, grid.rows, grid.columns, k * k)
            best = np.argmax(new[0], axis=-1)
            new = np.take_along_axis(new, best[None, ..., None], axis=-1)[..., 0]
        old = self._layers[:, rows, columns]
        sure = np.nan_to_num(old[2], nan=-1.0)
        is_better = (new[2] > sure) | ((new[2] == sure) & (new[0] > old[0]))
        np.copyto(old, new, where=is_better & (new[0] >= 0.0))

    def _part(self, low: Array, high: Array) -> tuple[Grid, slice, slice]:
        """Return the part of the grid, its rows and its columns, between two corners (2,)."""
        self._grow(low, high)
        grid = self.grid
        shape, corner = (grid.columns, grid.rows), np.array([grid.x_m, grid.y_m])
        first = np.clip(np.floor((low - corner) / grid.cell_m), 0, shape).astype(int)
        last = np.clip(np.ceil((high - corner) / grid.cell_m), first, shape).astype(int)
        x_m, y_m = (corner + grid.cell_m * first).tolist()
        columns, rows = map(slice, first.tolist(), last.tolist())
        n_columns, n_rows = (last - first).tolist()
        part = Grid(x_m=x_m, y_m=y_m, cell_m=grid.cell_m, rows=n_rows, columns=n_columns)
        return part, rows, columns

    def _grow(self, low: Array, high: Array) -> None:
        """Make the grid hold two corners (2,), in steps of some cells."""
        grid = self.grid
        step_m = _STEP * grid.cell_m
        first = np.floor(low / step_m + 1e-9).astype(int)
        last = np.ceil(high / step_m - 1e-9).astype(int)
        begin = np.round(np.array([grid.x_m, grid.y_m]) / step_m).astype(int)
        end = begin + np.array([grid.columns, grid.rows]) // _STEP
        if grid.rows:
            first, last = np.minimum(first, begin), np.maximum(last, end)
        else:
            begin = end = first
        columns, rows = (_STEP * (last - first)).tolist()
        if not grid.rows * grid.columns < rows * columns <= self._most_cells:
            return
        (left, below), (right, above) = _STEP * (begin - first), _STEP * (last - end)
        room = ((0, 0), (below, above), (left, right))
        self._layers = np.pad(self._layers, room, constant_values=np.nan)
        self.values, self.coherence = self._layers[:2]
        x_m, y_m = (step_m * first).tolist()
        self.grid = replace(grid, x_m=x_m, y_m=y_m, rows=rows, columns=columns)


def _in_view(aperture: Aperture, frame: int, points_m: Array) -> NDArray[np.bool_]:
    """Return which points (..., 2) one frame has in view, but for the nearest ones."""
    assert aperture.boresights is not None
    away_m = points_m - aperture.antennas_m[frame]
    range_m = np.hypot(away_m[..., 0], away_m[..., 1])
    ahead_m = away_m @ aperture.boresights[frame]
    is_ahead = ahead_m >= math.cos(aperture.half_beam_rad) * range_m
    return np.asarray(is_ahead & (range_m <= aperture.max_range_m))


def _reach(aperture: Aperture) -> tuple[Array, Array]:
    """Return two corners (2,) of a box that holds what an aperture has in view."""
    assert aperture.boresights is not None
    turns = np.exp(1j * aperture.half_beam_rad * _DIRECTIONS)
    axes = aperture.boresights[:, 0] + 1j * aperture.boresights[:, 1]
    antennas = aperture.antennas_m[:, 0] + 1j * aperture.antennas_m[:, 1]
    ends = antennas[:, None] + aperture.max_range_m * np.outer(axes, [0.0, *turns])
    corners = np.stack([ends.real.ravel(), ends.imag.ravel()])
    return corners.min(axis=1), corners.max(axis=1)
