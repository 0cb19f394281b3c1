"""`uwb-slam sweep`: the same run over scenes, presets, settings, stresses and seeds.

OUT.part holds lines of JSON: what the runs depend on, then a run each. A run is appended by one
write and on disk before the next begins, so a full disk or a kill costs the run in hand at most.
OUT is ``{"command": {...}, "runs": [...], "groups": [...]}``.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict, replace
from datetime import timedelta
from importlib import import_module
from itertools import product
from pathlib import Path

from joblib import cpu_count
from pydantic import TypeAdapter, ValidationError

from slam.app.errors import UsageError, naming
from slam.app.rig.emulated import FRAME_RATE_HZ
from slam.app.run.output import note, print_progress, print_table, print_text
from slam.app.run.result_files import made_folder
from slam.app.sweep import CLEAN
from slam.app.sweep.run import Case, RunKey, SweepRun, make_case, program_version, run_case
from slam.app.sweep.statistics import outcomes, summarise_groups
from slam.app.sweep.table import (
    group_line,
    outcomes_text,
    settings_text,
    stress_table,
    stress_tables,
)
from slam.app.sweep.workers import dask_results, worker_results
from slam.live.errors import AppError
from xethru_protocol.operating_system import (
    PathInUseError,
    StopFlag,
    StopRequestedError,
    locked,
    one_line,
    read_bounded,
    written_whole,
)

_RUN_READER: TypeAdapter[SweepRun] = TypeAdapter(SweepRun)
_RUNS_READER: TypeAdapter[list[SweepRun]] = TypeAdapter(list[SweepRun])
_MOST_BYTES = 1 << 30


class PartFile:
    """The file OUT.part: an existing file that is begun if it is empty, or read and continued.

    ``command`` holds what the runs depend on, by name, and must be what the file says; ``runs``
    are those done so far, in their order. A last line without its end is taken away: it was being
    written when the program or the disk failed.

    Raises AppError and changes nothing if it holds the runs of another command, or no such thing.
    """

    def __init__(self, path: Path, command: Mapping[str, str]) -> None:
        self.path = path
        self.runs: list[SweepRun] = []
        try:
            content = path.read_bytes()
        except OSError as error:
            raise AppError(f"{path}: cannot be read: {error.strerror or error}") from None
        head = _line({"command": dict(command)})
        self._end = content.rfind(b"\n") + 1
        if self._end:
            self.runs = _runs_of(path, content[: self._end], command)
        elif not head.startswith(content):
            raise _not_a_part(path, "not what a sweep leaves unfinished")
        with naming(path):
            if self._end < len(content):
                os.truncate(path, self._end)
            if not self._end:
                self._append(head)

    def add(self, run: SweepRun) -> None:
        with naming(self.path):
            self._append(_line(asdict(run)))
        self.runs.append(run)

    def _append(self, line: bytes) -> None:
        """Append a line, all or nothing: what a full disk took of it is taken away again."""
        with self.path.open("r+b", buffering=0) as file:
            file.seek(self._end)
            try:
                written = 0
                while written < len(line):  # the second write names the reason of a short one
                    written += file.write(line[written:])
                os.fsync(file.fileno())
            except BaseException:
                with suppress(OSError):
                    file.truncate(self._end)
                raise
        self._end += len(line)


def _line(value: object) -> bytes:
    return json.dumps(value, allow_nan=False).encode() + b"\n"


def _not_a_part(path: Path, what: str) -> AppError:
    return AppError(f"{path}: {what}; choose another --json, or move this file away to begin anew")


def _runs_of(path: Path, content: bytes, command: Mapping[str, str]) -> list[SweepRun]:
    """Read whole lines."""
    head, *rest = content.splitlines()
    try:
        known = json.loads(head)["command"]
    except (ValueError, LookupError, TypeError, RecursionError):
        known = None
    if not isinstance(known, dict):
        raise _not_a_part(path, "not what a sweep leaves unfinished")
    runs: dict[RunKey, SweepRun] = {}
    for number, line in enumerate(rest, start=2):
        try:
            run = _RUN_READER.validate_json(line)
            _line(asdict(run))  # ValueError for a number that is not finite
            runs[run.key] = run
        except ValueError:
            raise _not_a_part(path, f"line {number} is damaged, or no run of a sweep") from None
    names = [name for name in {**command, **known} if known.get(name) != command.get(name)]
    if names:
        raise AppError(
            f"{path}: holds {len(runs)} runs of another sweep (other: {', '.join(names)}); give "
            "that one's command to go on with it, choose another --json, or move this file away "
            "to begin anew"
        )
    return list(runs.values())


def _finished(out: Path, command: Mapping[str, str]) -> list[SweepRun]:
    """Return the runs of a result that this command wrote before; none if the file is missing.

    The result of another command is replaced at the end, and a line says so. Raises AppError for
    a file that is not the result of a sweep.
    """
    try:
        content = read_bounded(out, _MOST_BYTES)
        result = json.loads(content) if content else None
        is_sweep = result is None or {"runs", "groups"} <= result.keys()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise AppError(f"{out}: cannot be read: {error.strerror or error}") from None
    except (ValueError, AttributeError, RecursionError):
        is_sweep = False
    if not is_sweep:
        raise AppError(
            f"{out}: is not the result of a sweep, and would be lost; choose another --json"
        )
    if result is None:
        return []
    with suppress(ValidationError):
        if result.get("command") == command:
            return _RUNS_READER.validate_python(result["runs"])
    note(f"{out}: the result of another sweep; it is replaced when this one is done")
    return []


def run_sweep(
    stop: StopFlag,
    *,
    out: Path,
    scenes: Sequence[str] | None = None,
    presets: Sequence[str] | None = None,
    n_seeds: int,
    first_seed: int = 0,
    settings: Sequence[tuple[str, tuple[str, ...]]] = (),
    stresses: Sequence[str] = (),
    bound: bool = False,
    laps: int | None = None,
    fps: int = FRAME_RATE_HZ,
    jobs: int | None = None,
    dask: str | None = None,
) -> None:
    """Run all cells, write ``out``, print one line per group.

    A command whose result is there already prints it again. ``settings`` are dotted keys of a
    preset and the values to try; ``jobs`` is None for one process per core.

    Raises AppError before the first run for a wrong name, or a file that cannot be written or
    belongs to something else; later for a scene too short, a full disk, or a worker process or a
    cluster that died. Raises StopRequestedError after a signal; OUT.part stays if it holds a run.
    """
    presets = presets or ["robust"]
    # a wrong name ends the command before any run
    cases = _cases(
        rooms_named(scenes or ["lab"]),
        presets,
        (n_seeds, first_seed),
        settings,
        stresses,
        bound=bound,
        laps=laps,
    )
    cases = [replace(case, fps=fps) for case in cases]
    if bound:
        import_module("gtsam")  # what is missing ends the command before any run, too
    if out.is_dir():
        raise AppError(f"{out}: is a folder, must be a file")
    if out.exists() and not out.is_file():
        # it would be replaced: as root, even a device for everybody
        raise AppError(f"{out}: must be a regular file")
    command = _command(cases, presets, (n_seeds, first_seed), settings, bound=bound)
    path = out.with_name(f"{out.name}.part")
    if path.exists() and not path.is_file():  # opening a pipe waits for who writes into it
        raise AppError(f"{path}: is not a regular file; choose another --json, or move it away")
    with ExitStack() as held:
        held.enter_context(made_folder(path.parent))
        with naming(path):  # what cannot be written ends the command before any run, too
            path.touch()
            try:
                held.enter_context(locked(path))
            except PathInUseError:
                raise AppError(
                    f"{path}: another sweep is writing there; choose another --json"
                ) from None
        held.callback(_remove_empty, path)
        runs = _finished(out, command)
        part = PartFile(path, command)
        if runs:
            note(f"{out}: holds the result of this command; remove it to run everything again")
        else:
            done = {run.key for run in part.runs}
            missing = [case for case in cases if case.key not in done]
            with closing(_results(missing, jobs or cpu_count(), dask, stop)) as results:
                runs = _run(cases, part, results, out, command)
        part.path.unlink(missing_ok=True)
        groups = summarise_groups(runs)
    for group in groups:
        print_text(one_line(group_line(group)))
    for each in stress_tables(groups):
        print_table(*stress_table(*each))
    if len(groups) > 1:
        print_text(f"all together: {outcomes_text(outcomes(runs))}")


def _cases(
    scenes: Sequence[str],
    presets: Sequence[str],
    seeds: tuple[int, int],
    settings: Sequence[tuple[str, tuple[str, ...]]],
    stresses: Sequence[str],
    *,
    bound: bool,
    laps: int | None,
) -> list[Case]:
    """Return the runs in their order: seeds innermost, so that groups are done one by one.

    ``seeds`` are how many, and the first.
    """
    values = [[(key, value) for value in of_key] for key, of_key in settings]
    rows = dict.fromkeys((CLEAN, *stresses))
    cells = [
        make_case(scene, preset, 0, settings=dict(chosen), stress=stress, bound=bound, laps=laps)
        for scene, preset, chosen, stress in product(scenes, presets, product(*values), rows)
    ]
    if len({cell.key for cell in cells}) < len(cells):
        names = len({cell.scene.name for cell in cells}) < len(scenes)
        raise UsageError(
            "--scene: two of the scenes have the same name; give each its own"
            if names
            else "--preset, --set: one of them is given twice; give each once"
        )
    return [case for cell in cells for case in cell.with_seeds(*seeds)]


def rooms_named(scenes: Sequence[str]) -> list[str]:
    """Return names of scenes, each range of random rooms as its rooms.

    >>> rooms_named(["lab", "pillars:0-2"])
    ['lab', 'pillars:0', 'pillars:1', 'pillars:2']
    """
    names: list[str] = []
    for scene in scenes:
        found = re.fullmatch(r"([a-z]+):([0-9]{1,4})-([0-9]{1,4})", scene, re.ASCII)
        if found is None:
            names.append(scene)
            continue
        first, last = int(found[2]), int(found[3])
        if first > last:
            raise UsageError(f"--scene {scene}: the first room must not lie behind the last")
        names += [f"{found[1]}:{number}" for number in range(first, last + 1)]
    return names


def _command(
    cases: Sequence[Case],
    presets: Sequence[str],
    seeds: tuple[int, int],
    settings: Sequence[tuple[str, tuple[str, ...]]],
    *,
    bound: bool,
) -> dict[str, str]:
    """Return what the results depend on, by the name that an error message gives it."""
    command = {
        "scenes": " ".join(dict.fromkeys(case.scene.name for case in cases)),
        "presets": " ".join(presets),
        "seeds": f"{seeds[0]} from {seeds[1]}",
        "settings": " ".join(f"{key}={','.join(values)}" for key, values in settings),
        "stresses": " ".join(dict.fromkeys(case.stress for case in cases)),
        "bound": str(bound),
        "frame rate": str(cases[0].fps),
    }
    for case in cases[:: seeds[0]]:
        command[f"scene file {case.scene.name}"] = _digest(case.scene.model_dump_json())
    for preset in presets:
        configs = [case.config.model_dump_json() for case in cases if case.preset == preset]
        command[f"preset file {preset}"] = _digest(*dict.fromkeys(configs))
    return command | {"version of the program": program_version()}


def _digest(*texts: str) -> str:
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()


def _run(
    cases: Sequence[Case],
    part: PartFile,
    results: Iterator[SweepRun],
    out: Path,
    command: Mapping[str, str],
) -> list[SweepRun]:
    """Do the missing runs and write the result; return all runs in the order of the cases."""
    n_done = len(part.runs)
    if n_done:
        note(f"{part.path}: {n_done} of {len(cases)} runs are done, going on")

    def kept() -> str:
        at = f"{len(part.runs)} of {len(cases)} runs are in {part.path}"
        return f"; {at}, and the same command goes on with them" if part.runs else ""

    started = time.monotonic()
    try:
        for run in results:
            part.add(run)
            elapsed_s = time.monotonic() - started
            to_do = len(cases) - len(part.runs)
            remaining_s = elapsed_s / (len(part.runs) - n_done) * to_do
            print_progress(
                f"{len(part.runs)} of {len(cases)}: {_run_line(run)}; "
                f"{timedelta(seconds=round(elapsed_s))} elapsed, "
                f"{timedelta(seconds=round(remaining_s))} remaining"
            )
        by_key = {run.key: run for run in part.runs}
        runs = [by_key[case.key] for case in cases]
        result = {
            "command": command,
            "runs": [asdict(run) for run in runs],
            "groups": summarise_groups(runs),
        }
        with naming(out), written_whole(out) as fresh:
            fresh.write_text(json.dumps(result, indent=2, allow_nan=False) + "\n", "ascii")
    except StopRequestedError as stopped:
        raise StopRequestedError(stopped.received, kept()) from None
    except BrokenExecutor:
        raise AppError(f"a worker process died; did memory run out?{kept()}") from None
    except AppError as error:
        raise type(error)(f"{error}{kept()}") from None
    finally:
        if not part.runs:
            part.path.unlink(missing_ok=True)
    return runs


def _remove_empty(path: Path) -> None:
    with suppress(OSError):
        if not path.stat().st_size:
            path.unlink()


def _run_line(run: SweepRun) -> str:
    smoothed_m = run.smoothed_ate_rmse_m
    smoothed = "" if smoothed_m is None else f", smoothed {1e3 * smoothed_m:.1f} mm"
    return (
        f"{run.scene}, {run.preset}{settings_text(run.settings, run.stress)}, seed {run.seed}: "
        f"ATE {1e3 * run.ate_rmse_m:.1f} mm "
        f"({run.ate_ratio:.2f} of odometry's {1e3 * run.odometry_ate_rmse_m:.1f} mm){smoothed}"
    )


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
