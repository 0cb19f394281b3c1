"""Programs that are ended at random moments, then run again with the result of a whole run.

A moment lies between the start and the usual end. The disk for the results of some is a small file
system that gets full.

    python -m hil_tests.system.ends.trials --count 100 --seed 0
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from hil_tests.system.ends.programs import (
    END_S,
    Ended,
    Ending,
    Program,
    Stage,
    check_nothing_is_left,
    end,
    started,
    wait_for_end,
)

NAMES = (
    *("demo", "run", "record", "sweep", "replay", "report", "convert"),
    *("view", "calibrate", "repair"),
)
ENDINGS = (Ending.KILL, Ending.TERM, Ending.HANG_UP, Ending.FULL_DISK)


@dataclass(kw_only=True)
class Whole:
    """How long a program takes that is not stopped, last time [s]; what it gives; and its size."""

    took_s: float
    result: object
    size_bytes: int


@dataclass(kw_only=True)
class Findings:
    """Trials by program, ending and exit code, and what was wrong."""

    ended: Counter[tuple[str, str, int]] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)


def run_until(program: Program, place: Path, folder: Path, ending: Ending, after_s: float) -> Ended:
    """Run a program, and end it after a time."""
    with started(program, place, folder) as command:
        instant_s = time.monotonic() + after_s
        while time.monotonic() < instant_s and command.process.poll() is None:
            command.read()
            time.sleep(0.002)
        at_unix_s = time.time()
        end(command, ending)
        return wait_for_end(command, folder, ending, at_unix_s)


def run_whole(program: Program, place: Path, folder: Path, again: Sequence[str] = ()) -> float:
    """Run a program to its end; return how long it took [s]."""
    began_s = time.monotonic()
    with started(program, place, folder, again) as command:
        ended = wait_for_end(command, folder, None, 0.0)
    assert ended.code == 0, f"it ended with {ended.code}: {ended.printed[-300:]!r}"
    return time.monotonic() - began_s


@contextmanager
def small_disk(folder: Path, size_bytes: int) -> Iterator[None]:
    """Mount a file system of a size."""
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size_bytes}", "none", str(folder)]
    subprocess.run(mount, check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def make_room(folder: Path) -> None:
    subprocess.run(["mount", "-o", "remount,size=100m", str(folder)], check=True)


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def trial(
    program: Program, ending: Ending, place: Path, chance: random.Random, whole: Whole
) -> int:
    """End a program and look at what is left, then run it again; return the exit code."""
    place.mkdir()
    (folder := place / "out").mkdir()
    after_s = chance.uniform(0.0, whole.took_s)
    size_bytes = chance.randrange(min(4096, whole.size_bytes // 2), whole.size_bytes)
    with ExitStack() as stack:
        if ending is Ending.FULL_DISK:
            stack.enter_context(small_disk(folder, size_bytes))
            after_s = END_S
        ended = run_until(program, place, folder, ending, after_s)
        # 0: it was done just before; by the signal itself: it came before the program has its
        # handlers, or after it gave them back
        codes = program.codes(ending) | {0, *(128 - code for code in program.codes(ending))}
        assert ended.code in codes, f"exit code {ended.code}: {ended.printed[-300:]}"
        check_nothing_is_left(place, folder)
        program.check(ended)
        if ended.code == 0:
            assert program.result(folder) == whole.result, "the result is another"
        else:
            if ending is Ending.FULL_DISK:
                make_room(folder)
            is_refused = program.refuses is not None and (folder / program.refuses).exists()
            again = folder / "again" if is_refused else folder
            whole.took_s = run_whole(program, place, again, program.again)
            check_nothing_is_left(place, folder)
            assert program.result(again) == whole.result, "another run gives another result"
            assert not list(again.glob(".unfinished*")), "unfinished files are left"
    return ended.code


def run_trials(
    count: int,
    seed: int,
    *,
    endings: Sequence[Ending] = ENDINGS,
    say: Callable[[str], None] = lambda text: None,
) -> Findings:
    """End programs so many times, each program and each way in turn."""
    if os.geteuid() != 0 or shutil.which("mount") is None:
        endings = [ending for ending in endings if ending is not Ending.FULL_DISK]
        say("no disk gets full here: mounting a small file system takes root")
    chance, findings = random.Random(seed), Findings()
    with tempfile.TemporaryDirectory(prefix="xethru-ends-") as temporary, ExitStack() as stack:
        place = Path(temporary)
        stage = Stage(place, stack)
        wholes = {}
        for name in NAMES:
            program = stage.program(name)
            (at := place / f"whole-{name}").mkdir()
            (of_whole := at / "out").mkdir()
            took_s = run_whole(program, at, of_whole)
            wholes[name] = Whole(
                took_s=took_s, result=program.result(of_whole), size_bytes=size_of(of_whole)
            )
            say(f"{name}: {took_s:.1f} s")
        for number in range(count if endings else 0):
            name = NAMES[number % len(NAMES)]
            ending = endings[(number // len(NAMES)) % len(endings)]
            at = place / f"trial-{seed}-{number}"
            what = f"{number + 1} of {count}: {name}, {ending.name}"
            try:
                code = trial(stage.program(name), ending, at, chance, wholes[name])
                findings.ended[name, ending.name, code] += 1
                say(f"{what}, exit code {code}")
            except AssertionError as problem:
                findings.problems.append(f"{what}: {problem}")
                say(findings.problems[-1])
            shutil.rmtree(at, ignore_errors=True)
    return findings


def say_on_stderr(text: str) -> None:
    sys.stderr.write(f"{text}\n")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=100, help="ends (default 100)")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    began_s = time.monotonic()
    findings = run_trials(asked.count, asked.seed, say=say_on_stderr)
    for (name, ending, code), n_trials in sorted(findings.ended.items()):
        sys.stdout.write(f"{name:8} {ending:10} exit code {code:4}: {n_trials}\n")
    sys.stdout.write(
        f"{asked.count} ends in {time.monotonic() - began_s:.0f} s, "
        f"{len(findings.problems)} problems\n"
    )
    return 1 if findings.problems else 0


if __name__ == "__main__":
    sys.exit(main())
