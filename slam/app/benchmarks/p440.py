"""PulsON 440 radars that roll along a rail before motion capture: coherent images of real scans.

A file p440_*.npz holds one trial, as docs/studies/p440_npz.py writes it: the arrays of `_SHAPES`,
one of them JSON with ``clock_offset_ns``, ``range_offset_m``, ``lever_m``, ``reflectors`` and
``use``. The clock of the poses is t_ns + clock_offset_ns, the range of bin i is range_start_m + i
bin_length_m - range_offset_m, and antennas are at pose_m + R(pose_xyzw) lever_m. A reflector shows
its apex, not its markers. Scans are imaged while the radar moves, without their mean, and every
metre of the path has the same weight.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections import defaultdict
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam.app.benchmarks.text_columns import REMEDY, found
from slam.app.run.output import print_progress, print_table, print_text, write_json
from slam.app.run.pictures import ESTIMATE, label, picture
from slam.app.run.result_files import made_folder
from slam.front_end.pulse import ModulePulse, PulseModel
from slam.imaging.autofocus import autofocus
from slam.imaging.back_projection import Aperture, Grid, back_project, echoes_at
from slam.imaging.range_profiles import ProfileFilter, RangeProfiles
from slam.live.errors import AppError
from xethru_protocol.operating_system import StopFlag

Array = NDArray[np.float64]
Numbers = dict[str, Any]
Image = tuple[RangeProfiles, Aperture]  # what it is made of

_SHAPES: Mapping[str, tuple[Hashable, ...]] = {
    "samples": ("scans", "bins"),  # signed RF
    "t_ns": ("scans",),
    "range_start_m": (),
    "bin_length_m": (),
    "pose_t_ns": ("poses",),
    "pose_m": ("poses", 3),
    "pose_xyzw": ("poses", 4),
    "reflector_marker_m": ("reflectors", 3),
    "reflector_apex_m": ("reflectors", 3),
    "meta": (),
}
_NOT_FINITE = ("meta", "reflector_apex_m")  # an apex that is not known is NaN
_PULSE = ModulePulse(model=PulseModel(carrier_hz=3.95e9, bandwidth_hz=1.7e9), error=0.0)
_CELL_M = 0.04  # of the picture; an echo is 5 cm wide across
_NEAR_M = 0.15  # So far from its apex a reflector is looked for: its next echo is 19 cm away
_MOST_M2, _MOST_SIDE_M = 1000.0, 100.0  # of the picture
_BIN_M = (
    1e-3,
    0.015,
)  # Shortest and longest bin: a P440's are 9.15 mm; the pulse needs 19 mm or less
_SAME_M = 0.02  # Trials whose markers are no farther apart have one reflector
_CLOCK_STEP_NS = 1_000_000
_CUT_STEP_M = 0.002
_SEEDS = range(4)
_DRAWN_DB = 40.0
_APERTURES_M = (0.25, 0.5, 1.0, 2.0)
_PATH_ERRORS = {  # scale; random walk [m per root of a metre]
    "0.7 %, 2 mm": (0.007, 0.002),
    "10 mm": (0.0, 0.010),
    "2 %, 20 mm": (0.02, 0.020),
}
_TABLES = {
    "focus": "P440 on a rail: a reflector's peak (real data); median: of the scene; widths: -3 dB",
    "coherence": "Coherence at the peak, mean of all parts of the path of a length (real data)",
    "loss_db": "Loss [dB] by an error of the path's scale and a random walk, per root of a metre: "
    "median of all seeds (worst)",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trial:
    """One file: its arrays, and what its JSON holds."""

    name: str
    arrays: Mapping[str, Any]
    meta: Mapping[str, Any]

    @property
    def reflectors(self) -> list[tuple[str, Array, Array]]:
        """Return name, marker and apex (3,) of each; the marker twice where no apex is known."""
        marker, apex = self.arrays["reflector_marker_m"], self.arrays["reflector_apex_m"]
        names = [f"{self.name} {each['name']}" for each in self.meta["reflectors"]]
        return [*zip(names, marker, np.where(np.isfinite(apex), apex, marker), strict=True)]

    @property
    def cells_m(self) -> Array:
        """Return the cells of the picture at the height of the first reflector."""
        x_m, y_m = self.meta["use"]["background_box_m"]
        return np.insert(Grid.over(x_m, y_m, _CELL_M).centres_m, 2, self.reflectors[0][2][2], -1)

    def antennas_m(self, offset_ns: int) -> Array:
        """Return where the antenna was at each scan, (scans, 3), with a clock offset."""
        at_s, poses_s = (
            (t_ns - self.arrays["pose_t_ns"][0]) * 1e-9
            for t_ns in (self.arrays["t_ns"] + offset_ns, self.arrays["pose_t_ns"])
        )
        levers = Rotation.from_quat(self.arrays["pose_xyzw"]).apply(self.meta["lever_m"])
        track = self.arrays["pose_m"] + levers
        return np.column_stack([np.interp(at_s, poses_s, axis) for axis in track.T])

    def clock_by_motion_ns(self) -> int:
        """Return the offset at which scans change as fast as the poses move, by no reflector.

        The root mean square of the change from scan to scan is correlated with the way in between.
        """
        t_ns, poses_ns = self.arrays["t_ns"], self.arrays["pose_t_ns"]
        change = np.sqrt(np.mean(np.diff(self.arrays["samples"], axis=0) ** 2, axis=1))
        offsets = np.arange(poses_ns[0] - t_ns[0], poses_ns[-1] - t_ns[-1], _CLOCK_STEP_NS)
        steps = (np.diff(self.antennas_m(offset), axis=0) for offset in offsets.tolist())
        fits = [np.corrcoef(change, np.linalg.norm(step, axis=1))[0, 1] for step in steps]
        return int(offsets[np.argmax(fits)])

    def image(self, offset_ns: int) -> Image:
        """Return the range profiles of the scans taken in motion, and their antennas."""
        antennas_m, bin_m = self.antennas_m(offset_ns), float(self.arrays["bin_length_m"])
        velocity = np.gradient(antennas_m, self.arrays["t_ns"] * 1e-9, axis=0)
        moves = np.linalg.norm(velocity, axis=1) >= self.meta["use"]["least_speed_mps"]
        if np.count_nonzero(moves) < 2:
            raise ValueError("no scans were taken in motion")
        rows = self.arrays["samples"][moves]
        start_m = float(self.arrays["range_start_m"]) - self.meta["range_offset_m"]
        profile_filter = ProfileFilter(_PULSE, rows.shape[1], bin_m)
        profiles = profile_filter.apply(rows - rows.mean(axis=0), start_m)
        return profiles, Aperture(antennas_m=antennas_m[moves])


def read_trial(path: Path) -> Trial:
    """Read a file; AppError that says what is missing or wrong in it."""
    try:
        if not zipfile.is_zipfile(path):
            raise ValueError("it is not an .npz archive, or cannot be read")
        with np.load(path, allow_pickle=False) as archive:
            if missing := [name for name in _SHAPES if name not in archive.files]:
                raise ValueError(f"it has no array {missing[0]}")
            arrays = {name: archive[name] for name in _SHAPES}
        _check(arrays)
        meta = json.loads(str(arrays["meta"]))
        arrays["samples"] = arrays["samples"].astype(np.float64)
        trial = Trial(name=path.stem.removeprefix("p440_rail_"), arrays=arrays, meta=meta)
        scans_ns, poses_ns = arrays["t_ns"] + meta["clock_offset_ns"], arrays["pose_t_ns"]
        if not poses_ns[0] <= scans_ns[0] < scans_ns[-1] <= poses_ns[-1]:
            raise ValueError("with clock_offset_ns, scans lie outside of the time of the poses")
        if not 0 < len(meta["reflectors"]) == len(arrays["reflector_marker_m"]):
            raise ValueError("reflectors must name each row of reflector_marker_m, at least one")
        (left, right), (low, high) = meta["use"]["background_box_m"]
        sides_m = right - left, high - low
        is_box = all(0.0 < side_m < _MOST_SIDE_M for side_m in sides_m)
        if not (is_box and math.prod(sides_m) < _MOST_M2):
            raise ValueError(
                f"background_box_m must be an area below {_MOST_M2:g} square metres, no side of "
                f"{_MOST_SIDE_M:g} m"
            )
        image = trial.image(meta["clock_offset_ns"])
        echoes = coherent(image, np.array([apex_m for _, _, apex_m in trial.reflectors]))
        if not min(echoes.min(), np.median(coherent(image, trial.cells_m[::8, ::8]))) > 0.0:
            raise ValueError("scans do not reach over the reflectors and background_box_m")
    except (
        *(OSError, EOFError, ValueError, ArithmeticError, LookupError, TypeError),
        zipfile.BadZipFile,
    ) as error:
        why = f"meta has no {error}" if isinstance(error, KeyError) else error
        raise AppError(f"{path}: is not a trial of a P440: {why}; {REMEDY}") from None
    return trial


def _check(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise ValueError that names an array of another shape, or with what is no finite number."""
    sizes: dict[Hashable, int] = {3: 3, 4: 4}
    for name, shape in _SHAPES.items():
        values = arrays[name]
        known = [sizes.setdefault(size, n) for size, n in zip(shape, values.shape, strict=False)]
        if len(shape) != values.ndim or values.shape != tuple(known):
            raise ValueError(f"{name} has shape {values.shape}, must have {shape}")
        is_number = values.dtype.kind in "iuf" or name == "meta"
        if not is_number or (name not in _NOT_FINITE and not np.isfinite(values).all()):
            raise ValueError(f"{name} must hold finite numbers")
        if name.endswith("t_ns") and (values.size < 2 or np.any(np.diff(values) <= 0)):
            raise ValueError(f"{name} must hold at least two times, ascending")
    if not _BIN_M[0] <= arrays["bin_length_m"] <= _BIN_M[1]:
        raise ValueError(f"bin_length_m must be {_BIN_M[0]:g} to {_BIN_M[1]:g}")


def coherent(image: Image, points_m: Array) -> Array:
    """Return the size of the mean echo at points, every metre of path with the same weight."""
    profiles, aperture = image
    weighted = profiles.times(aperture.metres)
    return np.abs(back_project(weighted, aperture, points_m).total) / aperture.length_m


def incoherent(image: Image, points_m: Array) -> Array:
    """Return the root of the mean power at points, likewise."""
    profiles, aperture = image
    weighted = profiles.times(np.sqrt(aperture.metres))
    return np.sqrt(back_project(weighted, aperture, points_m).power / aperture.length_m)


def peak_near(image: Image, point_m: Array) -> tuple[Array, float]:
    """Return the brightest place near a point, (3,), to a millimetre, and its mean echo."""
    brightest = 0.0
    for half_m, cell_m in ((_NEAR_M, 0.01), (0.01, 0.001)):
        side = cell_m * np.arange(-round(half_m / cell_m), round(half_m / cell_m) + 1)
        points = point_m + np.insert(np.stack(np.meshgrid(side, side), axis=-1), 2, 0.0, axis=-1)
        echo = coherent(image, points)
        point_m, brightest = points.reshape(-1, 3)[echo.argmax()], float(echo.max())
    return point_m, brightest


def coherence(echoes: NDArray[np.complex128], metres: Array, length_m: float = math.inf) -> float:
    """Return |sum| / sum of |.| of echoes by way, over parts of the path, the mean of all parts.

    It is 1 for echoes of one phase. The coherence factor is its square times mean(|v|)**2 /
    mean(|v|**2): it falls where amplitudes differ, too, as in the beam of an antenna.
    """
    way_m = np.cumsum(metres)
    parts = max(1, math.floor(way_m[-1] / length_m))
    ends = np.searchsorted(way_m, min(length_m, float(way_m[-1])) * np.arange(parts + 1))
    pieces = [(metres * echoes)[first : last + 1] for first, last in pairwise(ends)]
    return float(np.mean([np.abs(piece.sum()) / np.abs(piece).sum() for piece in pieces]))


def width_m(cut: Array) -> float | None:
    """Return the width at -3 dB about the middle of a cut; None if it does not fall so far."""
    middle, steps = cut.size // 2, 0.0
    for side in (cut[middle:], cut[middle::-1]):
        over = side / cut[middle] - math.sqrt(0.5)
        below = int(np.argmax(over < 0.0))
        if not below:
            return None
        steps += below - over[below] / (over[below] - over[below - 1])
    return _CUT_STEP_M * steps


def focus(trial: Trial, clock: str, offset_ns: int, apex: tuple[str, Array]) -> Numbers:
    """Return how sharp a reflector is, and how far from its apex, with a clock offset."""
    image, cells_m = trial.image(offset_ns), trial.cells_m
    peak_m, brightest = peak_near(image, apex[1])
    blurred = float(incoherent(image, peak_m))
    medians = [float(np.median(each(image, cells_m))) for each in (coherent, incoherent)]
    profiles, aperture = image
    echoes, metres = echoes_at(profiles, aperture.antennas_m, peak_m), aperture.metres
    sight = (peak_m - aperture.antennas_m[len(echoes) // 2]) * [1.0, 1.0, 0.0]
    along = sight / np.linalg.norm(sight)
    steps_m = _CUT_STEP_M * np.arange(-1000, 1001)[:, None]
    across_m = peak_m + steps_m * np.array([-along[1], along[0], 0.0])
    return {
        "clock": clock,
        "clock_s": offset_ns * 1e-9,
        "apex_of": apex[0],
        "peak_m": peak_m.tolist(),
        "focus": {
            "coherence": coherence(echoes, metres),
            "factor": (brightest / blurred) ** 2,
            "over_median_db": 20.0 * math.log10(brightest / medians[0]),
            "incoherent_db": 20.0 * math.log10(blurred / medians[1]),
            "along_m": width_m(coherent(image, peak_m + steps_m * along)),
            "across_m": width_m(coherent(image, across_m)),
            "incoherent_m": width_m(incoherent(image, across_m)),
            "to_apex_m": math.dist(peak_m[:2], apex[1][:2]),
        },
        "coherence": {f"{m:g} m": coherence(echoes, metres, m) for m in _APERTURES_M},
    }


def spoilt(antennas_m: Array, scale: float, walk_m: float, seed: int) -> Array:
    """Return a path as wheels have it, right in its middle: scale, and a random walk in x and y."""
    steps_m, error = np.diff(antennas_m[:, :2], axis=0), np.zeros_like(antennas_m)
    noise = np.random.default_rng(seed).normal(size=steps_m.shape)
    noise *= walk_m * np.sqrt(np.linalg.norm(steps_m, axis=1))[:, None]
    error[1:, :2] = np.cumsum(scale * steps_m + noise, axis=0)
    return np.asarray(antennas_m + error - error[len(error) // 2])


def losses_db(trial: Trial, stop: StopFlag) -> list[dict[str, list[float]]]:
    """Return by how much each reflector is fainter on spoilt paths, a value for each seed."""
    image, cells_m = trial.image(trial.meta["clock_offset_ns"]), trial.cells_m
    profiles, aperture = image
    peaks = [peak_near(image, apex_m) for _, _, apex_m in trial.reflectors]
    lost: list[dict[str, list[float]]] = [defaultdict(list) for _ in peaks]
    rows = [*zip(lost, peaks, strict=True)]
    for name, (scale, walk_m) in _PATH_ERRORS.items():
        for seed in _SEEDS:
            stop.check()
            path = replace(aperture, antennas_m=spoilt(aperture.antennas_m, scale, walk_m, seed))
            tried = {name: path, f"{name}, autofocus": autofocus(profiles, path, cells_m)}
            for (what, each), (row, (peak_m, best)) in product(tried.items(), rows):
                ratio = peak_near((profiles, each), peak_m)[1] / best
                row[what].append(-20.0 * math.log10(ratio))
    return lost


def evaluate(trials: Sequence[Trial], stop: StopFlag) -> list[Numbers]:
    """Return the numbers of each reflector, with the clock as given and with that of the motion.

    With the latter, the apex is that of another trial of the same reflector, if there is one:
    nothing has been fitted on the trial itself.
    """
    numbers: list[Numbers] = []
    for trial in trials:
        print_progress(f"{trial.name}: {len(trial.arrays['t_ns'])} scans")
        try:
            given_ns, by_motion_ns = int(trial.meta["clock_offset_ns"]), trial.clock_by_motion_ns()
            others = [each for other in trials if other is not trial for each in other.reflectors]
            lost = losses_db(trial, stop)
            for (name, marker_m, apex_m), loss_db in zip(trial.reflectors, lost, strict=True):
                own = (name, apex_m)
                same = [each[::2] for each in others if math.dist(each[1], marker_m) < _SAME_M]
                numbers += [
                    {"reflector": name, "loss_db": loss_db} | focus(trial, "given", given_ns, own),
                    {"reflector": name} | focus(trial, "motion", by_motion_ns, [*same, own][0]),
                ]
        except ValueError as error:  # with the clock of the motion, nothing may be in motion
            raise AppError(f"{trial.name}: {error}; {REMEDY}") from None
    return numbers


def _cell(value: float | Sequence[float] | None) -> str:
    if isinstance(value, Sequence):
        return f"{np.median(value):.2f} ({max(value):.2f})"
    return "-" if value is None else f"{value:.3f}"


def draw(figure: Figure, trials: Sequence[Trial]) -> None:
    """Draw each trial, coherent above incoherent, in dB below its brightest cell."""
    panels = figure.subplots(2, len(trials), squeeze=False)
    for column, trial in zip(panels.T, trials, strict=True):
        image = trial.image(trial.meta["clock_offset_ns"])
        x_m, y_m = trial.meta["use"]["background_box_m"]
        for axes, each in zip(column, (coherent, incoherent), strict=True):
            cells = each(image, trial.cells_m)
            drawn = axes.imshow(
                20.0 * np.log10(np.maximum(cells / cells.max(), 1e-9)),
                origin="lower",
                extent=(*x_m, *y_m),
                vmin=-_DRAWN_DB,
                cmap="magma",
            )
            axes.plot(*image[1].antennas_m[:, :2].T, color=ESTIMATE, linewidth=2.0)
            for _, _, apex_m in trial.reflectors:
                axes.plot(*apex_m[:2], "o", markersize=12, markerfacecolor="none", color="white")
            label(axes, f"{trial.name}, {each.__name__}", "x [m]", "y [m]")
            axes.grid(visible=False)
    figure.colorbar(drawn, ax=panels, label="below the brightest cell [dB]", shrink=0.6)


def run_trials(stop: StopFlag, *, data: Path, out: Path, as_json: bool) -> None:
    """Image all trials of a folder; write picture and numbers, print tables or JSON.

    Raises AppError if there is no trial, one is damaged, or a file cannot be written.
    """
    trials = [read_trial(path) for path in found(data, "p440_*.npz")]
    with made_folder(out):
        rows = evaluate(trials, stop)
        title = "P440 radar on a rail: blue its path, white corner reflectors (real data)"
        width_in = 4.2 * len(trials) + 1.2
        with picture(out / "p440.png", width_in=width_in, height_in=8.2, title=title) as figure:
            draw(figure, trials)
        write_json(out / "p440.json", numbers := {"benchmark": "p440", "reflectors": rows})
    if as_json:
        print_text(json.dumps(numbers, allow_nan=False))
        return
    for key, title in _TABLES.items():
        kept = [each for each in rows if key in each]
        names = ("reflector", "clock", "apex_of")
        cells = [[*(each[n] for n in names), *map(_cell, each[key].values())] for each in kept]
        print_table(title, [*names, *kept[0][key]], cells)
