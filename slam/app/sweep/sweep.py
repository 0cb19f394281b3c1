"""`uwb-slam sweep`: the same run over scenes, presets, settings, stresses and seeds.

The file of results is a JSON object, ``{"command": {...}, "runs": [...]}``, whole after every run:
each is appended over the closing brackets by one write.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

from joblib import cpu_count
from pydantic import TypeAdapter, ValidationError

from slam.app.errors import AppError, UsageError, naming
from slam.app.run.output import print_table
from slam.app.sweep import CLEAN
from slam.app.sweep.bound import PURPOSE, load_gtsam
from slam.app.sweep.run import Case, SweepRun, make_case, program_version, run_case
from slam.app.sweep.statistics import (
    group_line,
    settings_text,
    stress_table,
    stress_tables,
    summarise_groups,
)
from slam.app.sweep.workers import ClusterLostError, dask_results, worker_results
from xethru_protocol.system import PathInUseError, StopFlag, StopRequestedError, locked, one_line

_TAIL = b"\n]}\n"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Contents:
    command: dict[str, str]
    runs: list[SweepRun]


_READER: TypeAdapter[_Contents] = TypeAdapter(_Contents)


class PartFile:
    """The file OUT.part: an existing file that is begun if it is empty, or read and continued.

    ``command`` holds what the runs depend on, by name, and must be what the file says; ``runs``
    are those done so far, in their order.

    Raises AppError and changes nothing if it holds the runs of another command, or no such thing.
    """

    def __init__(self, path: Path, command: Mapping[str, str]) -> None:
        self.path = path
        self.runs: list[SweepRun] = []
        try:
            content = path.read_bytes()
        except OSError as error:
            raise AppError(f"{path}: cannot be read: {error.strerror or error}") from None
        if content:
            self.runs = _runs_of(path, content, command)
            self._end = content.rindex(_TAIL)
            return
        head = f'{{"command": {json.dumps(dict(command), indent=1)},\n"runs": ['.encode()
        with naming(path):
            path.write_bytes(head + _TAIL)
        self._end = len(head)

    def add(self, run: SweepRun) -> None:
        text = json.dumps(asdict(run), allow_nan=False).encode()
        separator = b",\n" if self.runs else b"\n"
        with naming(self.path), self.path.open("r+b", buffering=0) as file:
            file.seek(self._end)
            file.write(separator + text + _TAIL)
            os.fsync(file.fileno())
        self._end += len(separator) + len(text)
        self.runs.append(run)


def _runs_of(path: Path, content: bytes, command: Mapping[str, str]) -> list[SweepRun]:
    remedy = "choose another --json, or move this file away"
    try:
        known = _READER.validate_json(content)
    except ValidationError:
        raise AppError(
            f"{path}: damaged, or not what a sweep left unfinished; {remedy} to begin anew"
        ) from None
    if not content.endswith(_TAIL):
        raise AppError(f"{path}: somebody else wrote behind the runs of a sweep; {remedy}")
    differing = [name for name in command if known.command.get(name) != command[name]]
    if differing or set(known.command) != set(command):
        names = ", ".join(differing or sorted(set(known.command) ^ set(command)))
        raise AppError(
            f"{path}: holds {len(known.runs)} runs of another sweep (other: {names}); "
            f"give that one's command to go on with it, {remedy}"
        )
    return known.runs


def run_sweep(
    stop: StopFlag,
    *,
    out: Path,
    scenes: Sequence[str] | None = None,
    presets: Sequence[str] | None = None,
    n_seeds: int,
    settings: Sequence[tuple[str, tuple[str, ...]]] = (),
    stresses: Sequence[str] = (),
    bound: bool = False,
    jobs: int | None = None,
    dask: str | None = None,
) -> None:
    """Run all cells, write `{"runs": [...], "groups": [...]}`, print one line per group.

    OUT.part holds the runs done so far, and the same command goes on with it. The scene is the lab
    and the preset robust, if none is given; ``settings`` are dotted keys of a preset and the values
    to try. ``jobs`` is the number of processes, None for one per core; ``dask`` the address of a
    scheduler that runs them instead.

    Raises AppError before the first run for a wrong name, or a file that cannot be written or is
    not this sweep's; later for a scene too short, or a worker process or a cluster that died.
    Raises StopRequestedError after a signal; OUT.part stays if it holds a run.
    """
    presets = presets or ["robust"]
    # a wrong name ends the command before any run
    cases = _cases(scenes or ["lab"], presets, n_seeds, settings, stresses, bound=bound)
    if bound:
        load_gtsam(PURPOSE)
    if out.is_dir():
        raise AppError(f"{out}: is a folder, must be a file")
    if out.exists() and not out.is_file():
        # it would be replaced: as root, even a device for everybody
        raise AppError(f"{out}: is no regular file, must be one")
    path = out.with_name(f"{out.name}.part")
    with ExitStack() as held:
        with naming(path):  # what cannot be written ends the command before any run, too
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            try:
                held.enter_context(locked(path))
            except PathInUseError:
                raise AppError(
                    f"{path}: another sweep is writing there; choose another --json"
                ) from None
        part = PartFile(path, _command(cases, presets, n_seeds, settings, bound=bound))
        done = {run.key for run in part.runs}
        missing = [case for case in cases if case.key not in done]
        with closing(_results(missing, jobs or cpu_count(), dask, stop)) as results:
            _run(cases, part, results, out)


def _cases(
    scenes: Sequence[str],
    presets: Sequence[str],
    n_seeds: int,
    settings: Sequence[tuple[str, tuple[str, ...]]],
    stresses: Sequence[str],
    *,
    bound: bool,
) -> list[Case]:
    """Return the runs in their order: seeds innermost, so that groups are done one by one."""
    values = [[(key, value) for value in of_key] for key, of_key in settings]
    rows = dict.fromkeys((CLEAN, *stresses))
    cells = [
        make_case(scene, preset, 0, settings=dict(chosen), stress=stress, bound=bound)
        for scene, preset, chosen, stress in product(scenes, presets, product(*values), rows)
    ]
    if len({cell.key for cell in cells}) < len(cells):
        names = len({cell.scene.name for cell in cells}) < len(scenes)
        raise UsageError(
            "--scene: two of the scenes have the same name; give each its own"
            if names
            else "--preset, --set: one of them is given twice; give each once"
        )
    return [replace(cell, seed=seed) for cell in cells for seed in range(n_seeds)]


def _command(
    cases: Sequence[Case],
    presets: Sequence[str],
    n_seeds: int,
    settings: Sequence[tuple[str, tuple[str, ...]]],
    *,
    bound: bool,
) -> dict[str, str]:
    """Return what the results depend on, by the name that an error message gives it."""
    command = {
        "scenes": " ".join(dict.fromkeys(case.scene.name for case in cases)),
        "presets": " ".join(presets),
        "seeds": str(n_seeds),
        "settings": " ".join(f"{key}={','.join(values)}" for key, values in settings),
        "stresses": " ".join(dict.fromkeys(case.stress for case in cases)),
        "bound": str(bound),
    }
    for case in cases[::n_seeds]:
        command[f"scene file {case.scene.name}"] = _digest(case.scene.model_dump_json())
        command[f"preset file {case.preset}"] = ""
    for preset in presets:
        configs = [case.config.model_dump_json() for case in cases if case.preset == preset]
        command[f"preset file {preset}"] = _digest(*dict.fromkeys(configs))
    return command | {"version of the program": program_version()}


def _digest(*texts: str) -> str:
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()


def _run(cases: Sequence[Case], part: PartFile, results: Iterator[SweepRun], out: Path) -> None:
    n_done = len(part.runs)
    if n_done:
        at = one_line(str(part.path))
        sys.stderr.write(f"{at}: {n_done} of {len(cases)} runs are done, going on\n")

    def left() -> str:
        return f"; {len(part.runs)} of {len(cases)} runs are in {part.path}" if part.runs else ""

    started = time.monotonic()
    try:
        for run in results:
            part.add(run)
            elapsed_s = time.monotonic() - started
            to_do = len(cases) - len(part.runs)
            remaining_s = elapsed_s / (len(part.runs) - n_done) * to_do
            sys.stderr.write(
                f"{len(part.runs)} of {len(cases)}: {one_line(_run_line(run))}; "
                f"{_clock(elapsed_s)} elapsed, {_clock(remaining_s)} remaining\n"
            )
    except StopRequestedError as stopped:
        raise StopRequestedError(stopped.received, left()) from None
    except BrokenExecutor:
        raise AppError(f"a worker process died; did memory run out?{left()}") from None
    except ClusterLostError as lost:
        raise AppError(f"{lost}{left()}") from None
    finally:
        if not part.runs:
            part.path.unlink()
    by_key = {run.key: run for run in part.runs}
    runs = [by_key[case.key] for case in cases]
    groups = summarise_groups(runs)
    result = {"runs": [asdict(run) for run in runs], "groups": groups}
    with naming(part.path):
        text = json.dumps(result, indent=2, allow_nan=False) + "\n"
        part.path.write_text(text, encoding="ascii")
        part.path.replace(out)
    for group in groups:
        sys.stdout.write(f"{one_line(group_line(group))}\n")
    for clean, rows in stress_tables(groups):
        print_table(*stress_table(clean, rows))


def _run_line(run: SweepRun) -> str:
    return (
        f"{run.scene}, {run.preset}{settings_text(run.settings, run.stress)}, seed {run.seed}: "
        f"ATE {1e3 * run.ate_rmse_m:.1f} mm "
        f"({run.ate_ratio:.2f} of odometry's {1e3 * run.odometry_ate_rmse_m:.1f} mm)"
    )


def _clock(seconds: float) -> str:
    """Return a duration as hours, minutes and seconds.

    >>> _clock(3723.4)
    '1:02:03'
    """
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def _results(
    cases: Sequence[Case], jobs: int, dask: str | None, stop: StopFlag
) -> Generator[SweepRun]:
    """Run cases here, on worker processes or on a cluster; results in the order of the cases."""
    if not cases:
        return
    if dask is None and jobs == 1:
        for case in cases:
            yield run_case(case, stop=stop)
            stop.check()
        return
    if dask is None:
        workers = worker_results(run_case, [(case,) for case in cases], jobs)
    else:
        workers = dask_results(run_case, [(case, program_version()) for case in cases], dask)
    with workers as results:
        while True:
            # Nothing is half-written while we wait, so a signal may end the waiting at once.
            with stop.at_once():
                run = next(results, None)
            if run is None:
                return
            yield run
            stop.check()
