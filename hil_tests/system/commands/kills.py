"""Commands killed at random instants: what is left is whole, and nothing else is left.

Independent on purpose: files are read by the `mcap` library, `rosbags`, Pillow and plain JSON.
Every command leads the session of a real terminal. At an instant between its start and its usual
end it gets SIGKILL or SIGTERM, or the terminal is closed under it; or the disk for its results is a
small file system that gets full. Then

- a session or recording holds all that there was until a second before,
- a file under its final name is whole, and what a run had printed as done is in its file,
- the exit code is that of the signal, and no traceback was printed,
- no process, lock or announcement is left,
- and the same command can be run again, with the result of one that was never stopped.

    python -m hil_tests.system.commands.kills --count 100 --seed 0
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from PIL import Image
from rosbags.highlevel import AnyReader

from emulator.scene.scene import load_scene
from hil_tests.device.serving import emulator
from hil_tests.patience import seconds
from hil_tests.system.recorded_session import record_session, write_shorter_scene
from hil_tests.system.short_scene import write_short_scene
from hil_tests.system.terminal import Command, in_terminal
from slam.app.rig.files import RigFile, RigRadar, write_rig
from xethru_protocol.recordings import describe_recording

UWB_SLAM, XETHRU = "slam.app.cli", "xethru_protocol.cli"
MARK = "XETHRU_KILLED_TRIAL"
RADARS = ("front_left", "rear_left", "front_right", "rear_right")
END_S = 60.0
"""A command that is not ended after that hangs."""
LOST_S = 1.0
"""What a kill may cost of a session or a recording."""


class Kind(Enum):
    """How a command is ended; the value is the signal that it gets."""

    KILL = signal.SIGKILL
    TERM = signal.SIGTERM
    HANG_UP = signal.SIGHUP
    FULL_DISK = None


class Problem(Exception):  # noqa: N818 - it is one of the command, not of this program
    """What a kill left is not as it should be."""


def require(condition: object, problem: str) -> None:
    if not condition:
        raise Problem(problem)


@dataclass(frozen=True, kw_only=True)
class Killed:
    """A command that was ended: its place, how, its exit code, what it printed, and when.

    Attributes
    ----------
    folder
        Of its results.
    kind
        None: it was not ended.
    at_unix_s
        Time of day at which it was ended.
    """

    folder: Path
    kind: Kind | None
    code: int
    printed: str
    at_unix_s: float

    @property
    def may_write_no_more(self) -> bool:
        """Whether it could not finish what it had begun."""
        return self.kind in (Kind.KILL, Kind.FULL_DISK)


@dataclass(frozen=True, kw_only=True)
class Job:
    """A command to kill.

    Attributes
    ----------
    arguments
        Of the command that writes into a folder.
    check
        Raises Problem if what is in the folder is not as it should be.
    again
        Arguments that are added for another run into the same folder.
    result
        Returns what every whole run gives alike; raises Problem if it is not there.
    refuses
        What it never replaces.
    """

    module: str
    arguments: Callable[[Path], Sequence[object]]
    check: Callable[[Killed], None]
    result: Callable[[Path], object]
    again: Sequence[str] = ()
    refuses: str | None = None


@dataclass(kw_only=True)
class Whole:
    """How long a command takes that is not stopped, last time [s]; what it gives; and its size."""

    took_s: float
    result: object
    size_bytes: int


@dataclass(kw_only=True)
class Findings:
    """What was killed how often, and what was wrong then.

    Attributes
    ----------
    ended
        Trials by command, kind and exit code.
    longest_loss_s
        Time between the last write to a session or recording and the kill.
    """

    ended: Counter[tuple[str, str, int]] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)
    longest_loss_s: float = 0.0


# --- what is left -------------------------------------------------------------------------------


def counters_by_topic(log: Path) -> tuple[dict[str, list[int]], bool]:
    """Return the sequence numbers of every topic, and whether the file was finished."""
    found: dict[str, list[int]] = {}
    with log.open("rb") as stream:
        try:
            for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
                found.setdefault(channel.topic, []).append(message.sequence)
        except EndOfFile:
            return found, False
    with log.open("rb") as stream:
        try:
            return found, make_reader(stream).get_summary() is not None
        except EndOfFile:
            return found, False


def check_session(killed: Killed, findings: Findings, *, live: bool) -> int:
    """Check a session; return the number of its states."""
    log = killed.folder / "session.mcap"
    if not log.exists() or (killed.may_write_no_more and not log.stat().st_size):
        return 0
    found, is_finished = counters_by_topic(log)
    require(is_finished or killed.may_write_no_more, "the session was not finished")
    n_scans = len(found.get("/scan", ())) + len(found.get("/scan_unused", ()))
    for radar in RADARS:
        counters = found.get(f"/radar/{radar}/frame", [])
        gaps = [b - a for a, b in pairwise(counters) if b - a != 1]
        require(live or not gaps, f"frames of {radar} are missing")
        # a frame stands before its scan's mark, so that a cut may part them
        require(live or len(counters) - n_scans in (0, 1), f"{len(counters)} frames of {radar}")
    if killed.kind is Kind.KILL and not is_finished and n_scans:
        loss_s = killed.at_unix_s - log.stat().st_mtime
        findings.longest_loss_s = max(findings.longest_loss_s, loss_s)
        # one tick more, as a chunk ends with the first message after its second
        require(loss_s < LOST_S + seconds(0.5), f"the last {loss_s:.1f} s of the session are lost")
    return len(found.get("/slam/state", ()))


def check_results(killed: Killed, n_states: int) -> None:
    """Check the results of a run whose session has that many states."""
    folder = killed.folder
    rows = {path.stem: len(path.read_text().splitlines()) for path in folder.glob("*.tum")}
    if killed.kind is Kind.FULL_DISK and rows:  # a drive goes on where its session does not
        n_states = max(rows.values())
    for name, n_rows in rows.items():
        require(n_rows == n_states, f"{name}.tum has {n_rows} rows of {n_states}")
    if (map_png := folder / "map.png").exists():
        check_picture(map_png)
    if (summary := folder / "summary.json").exists():
        n_frames = json.loads(summary.read_text())["frames"]
        require(n_frames > 0 or not n_states, "no frames in summary.json")
    has_all = summary.exists() and map_png.exists() and {"estimate", "odometry"} <= set(rows)
    require(
        has_all or killed.may_write_no_more or not n_states,
        f"{n_states} states, and results are missing",
    )


def check_picture(path: Path) -> None:
    with Image.open(path) as picture:
        picture.load()


def without_speed(summary: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in summary.items() if name != "realtime_factor"}


def results_of(folder: Path) -> object:
    summary = folder / "summary.json"
    require(summary.exists() and (folder / "map.png").exists(), "the results are missing")
    check_picture(folder / "map.png")
    tables = {path.name: path.read_text() for path in sorted(folder.glob("*.tum"))}
    return without_speed(json.loads(summary.read_text())), tables


# --- the commands -------------------------------------------------------------------------------


def demo(place: Path, findings: Findings) -> Job:
    scene = write_shorter_scene(place)

    def check(killed: Killed) -> None:
        check_results(killed, check_session(killed, findings, live=False))

    return Job(
        module=UWB_SLAM,
        arguments=lambda out: ["demo", "--preset", "paper", "--scene", scene, "--out", out],
        check=check,
        result=results_of,
    )


def run(place: Path, findings: Findings, stack: ExitStack) -> Job:
    scene = write_short_scene(place, repeats=1000)  # it drives on in all trials
    radars = load_scene(scene).radars
    rig = place / "robot.toml"
    write_rig(
        rig,
        RigFile(
            radars=tuple(
                RigRadar(
                    name=one.name, serial=one.serial, x_m=one.x_m, y_m=one.y_m, yaw_deg=one.yaw_deg
                )
                for one in radars
            )
        ),
    )
    served = stack.enter_context(emulator("serve", scene, "--link-dir", place / "robot"))
    assert served.odometry is not None
    drive = ["--odometry", served.odometry, "--duration", "3", "--ports", *served.paths]

    def check(killed: Killed) -> None:
        n_states = check_session(killed, findings, live=True)
        check_results(killed, n_states)

    def result(out: Path) -> object:
        require((out / "session.mcap").exists(), "there is no session")
        results_of(out)
        return None  # every drive is another

    return Job(
        module=UWB_SLAM,
        arguments=lambda out: ["run", "--rig", rig, *drive, "--out", out],
        check=check,
        result=result,
        refuses="session.mcap",
    )


def record(place: Path, findings: Findings, stack: ExitStack) -> Job:
    served = stack.enter_context(emulator("serve", "--bare", "--link-dir", place / "bare"))

    def check(killed: Killed) -> None:
        files = [*killed.folder.glob("rec/xethru_datafloat_*")]
        if not files:
            return
        kept = describe_recording(killed.folder / "rec")
        n_messages = sum(kept.messages.values())
        require(not kept.faults or killed.kind is Kind.KILL, f"damaged: {kept.faults}")
        if killed.kind is Kind.KILL and n_messages:
            loss_s = killed.at_unix_s - max(path.stat().st_mtime for path in files)
            findings.longest_loss_s = max(findings.longest_loss_s, loss_s)
            require(n_messages == 60 or loss_s < LOST_S + seconds(0.5), f"{loss_s:.1f} s are lost")

    def result(out: Path) -> object:
        kept = describe_recording(out / "rec")
        require(not kept.faults, "the recording has faults")
        return kept.messages

    port = served.paths[0]
    return Job(
        module=XETHRU,
        arguments=lambda out: ["record", "--port", port, "--out", out / "rec", "--count", "60"],
        check=check,
        result=result,
        again=("--force",),
    )


def sweep(place: Path) -> Job:
    scene = write_shorter_scene(place)

    def check(killed: Killed) -> None:
        out = killed.folder / "sweep.json"
        if out.exists():
            require(len(json.loads(out.read_text())["runs"]) == 3, "runs are missing")
            return
        part = out.with_name("sweep.json.part")
        lines = part.read_bytes().split(b"\n") if part.exists() else []
        n_done = sum("ate_rmse_m" in json.loads(line) for line in lines[:-1])
        printed = [int(done) for done in re.findall(r"(\d) of 3: ", killed.printed)]
        require(n_done >= max(printed, default=0), f"{n_done} runs, and {printed} were printed")

    def result(out: Path) -> object:
        require((out / "sweep.json").exists(), "there is no result")
        require(not (out / "sweep.json.part").exists(), "its part is left")
        return [without_speed(one) for one in json.loads((out / "sweep.json").read_text())["runs"]]

    drives = ["--preset", "paper", "--scene", scene, "--seeds", "3", "--jobs", "2"]
    return Job(
        module=UWB_SLAM,
        arguments=lambda out: ["sweep", *drives, "--json", out / "sweep.json"],
        check=check,
        result=result,
    )


def replay(session: Path) -> Job:
    n_states = len(counters_by_topic(session)[0]["/slam/state"])

    def check(killed: Killed) -> None:
        if killed.may_write_no_more or killed.code == 0:
            check_results(killed, n_states)
            return
        for path in killed.folder.glob("*.tum"):
            require(len(path.read_text().splitlines()) == n_states, f"{path.name} is not whole")
        if (killed.folder / "map.png").exists():
            check_picture(killed.folder / "map.png")

    return Job(
        module=UWB_SLAM,
        arguments=lambda out: ["replay", session, "--out", out],
        check=check,
        result=results_of,
    )


def report(session: Path) -> Job:
    def result(out: Path) -> object:
        page = out / "report.html"
        require(page.exists(), "there is no report")
        text = page.read_text()
        require(text.rstrip().endswith("</html>"), "the report is not whole")
        return text

    def check(killed: Killed) -> None:
        if (killed.folder / "report.html").exists():
            result(killed.folder)

    return Job(
        module=UWB_SLAM,
        arguments=lambda out: ["report", session, "--out", out / "report.html"],
        check=check,
        result=result,
    )


def convert(session: Path) -> Job:
    def result(out: Path) -> object:
        require((out / "bag").exists(), "there is no bag")
        with AnyReader([out / "bag"]) as bag:
            messages = Counter(connection.topic for connection, _, _ in bag.messages())
            require(sum(messages.values()) == bag.message_count, "messages are missing")
        return messages

    def check(killed: Killed) -> None:
        if (killed.folder / "bag").exists():
            result(killed.folder)

    return Job(
        module=UWB_SLAM,
        arguments=lambda out: ["convert", session, out / "bag"],
        check=check,
        result=result,
        refuses="bag",
    )


# --- one trial ----------------------------------------------------------------------------------


def processes_of(mark: str) -> list[int]:
    """Return the processes that a trial started and that still run."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                environment = (entry / "environ").read_bytes()  # empty of one that has ended
            except OSError:
                continue
            if f"{MARK}={mark}".encode() in environment:
                found.append(int(entry.name))
    return found


def require_nothing_is_left(place: Path, folder: Path) -> None:
    give_up_s = time.monotonic() + seconds(5)
    while running := processes_of(place.name):
        require(time.monotonic() < give_up_s, f"{len(running)} processes are left")
        time.sleep(0.02)
    announced = [path.name for path in (place / "run").rglob("*.json")]
    require(not announced, f"announcements are left: {announced}")
    for path in (folder, *folder.rglob("*")):
        if path.is_dir() or path.suffix == ".part":
            descriptor = os.open(path, os.O_RDONLY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise Problem(f"{path.name} is locked") from None
            finally:
                os.close(descriptor)


@contextmanager
def started(job: Job, place: Path, folder: Path, again: Sequence[str] = ()) -> Iterator[Command]:
    """Start the command of a trial, which keeps its own things in `place`."""
    for name in ("tmp", "run"):
        (place / name).mkdir(exist_ok=True, mode=0o700)
    environment = {
        MARK: place.name,
        "TMPDIR": str(place / "tmp"),
        "XDG_RUNTIME_DIR": str(place / "run"),
    }
    arguments = [*job.arguments(folder), *again]
    with in_terminal(job.module, arguments, place / "crashes", environment=environment) as command:
        yield command


def ended(command: Command, folder: Path, kind: Kind | None, at_unix_s: float) -> Killed:
    give_up_s = time.monotonic() + seconds(END_S)
    while command.process.poll() is None:
        command.read()
        require(time.monotonic() < give_up_s, "it does not end")
        time.sleep(0.005)
    command.read()
    require(not command.tracebacks, f"it printed a traceback:\n{command.tracebacks}")
    return Killed(
        folder=folder,
        kind=kind,
        code=command.process.returncode,
        printed=command.printed.decode(errors="replace"),
        at_unix_s=at_unix_s,
    )


def kill(job: Job, place: Path, folder: Path, kind: Kind, after_s: float) -> Killed:
    with started(job, place, folder) as command:
        instant_s = time.monotonic() + after_s
        while time.monotonic() < instant_s and command.process.poll() is None:
            command.read()
            time.sleep(0.002)
        at_unix_s = time.time()
        if kind is Kind.HANG_UP:
            command.hang_up()
        elif kind.value is not None:
            command.process.send_signal(kind.value)
        return ended(command, folder, kind, at_unix_s)


def run_whole(job: Job, place: Path, folder: Path, again: Sequence[str] = ()) -> float:
    """Run a command to its end; return how long it took [s]."""
    began_s = time.monotonic()
    with started(job, place, folder, again) as command:
        done = ended(command, folder, None, 0.0)
    require(done.code == 0, f"it ended with {done.code}: {done.printed[-300:]!r}")
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


def codes_of(kind: Kind) -> set[int]:
    """Return the exit codes of a command that is ended so, or was done just before."""
    if kind.value is None:
        return {0, 1}
    number = int(kind.value)
    # minus the signal before the program has its handlers, or after it gave them back
    return {0, -number} | ({128 + number} if kind is not Kind.KILL else set())


def trial(job: Job, kind: Kind, place: Path, chance: random.Random, whole: Whole) -> int:
    """Kill a command and look at what is left, then run it again; return the exit code."""
    place.mkdir()
    (folder := place / "out").mkdir()
    after_s = chance.uniform(0.0, whole.took_s)
    size_bytes = chance.randrange(4096, whole.size_bytes)
    with ExitStack() as stack:
        if kind is Kind.FULL_DISK:
            stack.enter_context(small_disk(folder, size_bytes))
            after_s = END_S
        killed = kill(job, place, folder, kind, after_s)
        require(killed.code in codes_of(kind), f"exit code {killed.code}: {killed.printed[-300:]}")
        require_nothing_is_left(place, folder)
        job.check(killed)
        if killed.code == 0:
            require(job.result(folder) == whole.result, "the result is another")
        else:
            if kind is Kind.FULL_DISK:
                make_room(folder)
            is_refused = job.refuses is not None and (folder / job.refuses).exists()
            again = folder / "again" if is_refused else folder
            whole.took_s = run_whole(job, place, again, job.again)
            require_nothing_is_left(place, folder)
            require(job.result(again) == whole.result, "another run gives another result")
            require(not list(again.glob(".unfinished*")), "unfinished files are left")
    return killed.code


def run_trials(
    count: int,
    seed: int,
    *,
    names: Sequence[str] = ("demo", "run", "record", "sweep", "replay", "report", "convert"),
    kinds: Sequence[Kind] = tuple(Kind),
    say: Callable[[str], None] = lambda text: None,
) -> Findings:
    """Kill commands so many times, each command and each kind in turn."""
    if os.geteuid() != 0 or shutil.which("mount") is None:
        kinds = [kind for kind in kinds if kind is not Kind.FULL_DISK]
        say("no disk gets full here: mounting a small file system takes root")
    chance, findings = random.Random(seed), Findings()
    with tempfile.TemporaryDirectory(prefix="xethru-kills-") as temporary, ExitStack() as stack:
        place = Path(temporary)
        session = place / "session.mcap"
        record_session(session, "paper")
        jobs = {
            "demo": lambda: demo(place, findings),
            "run": lambda: run(place, findings, stack),
            "record": lambda: record(place, findings, stack),
            "sweep": lambda: sweep(place),
            "replay": lambda: replay(session),
            "report": lambda: report(session),
            "convert": lambda: convert(session),
        }
        chosen = {name: jobs[name]() for name in names}
        wholes = {}
        for name, job in chosen.items():
            (at := place / f"whole-{name}").mkdir()
            (of_whole := at / "out").mkdir()
            took_s = run_whole(job, at, of_whole)
            wholes[name] = Whole(
                took_s=took_s, result=job.result(of_whole), size_bytes=size_of(of_whole)
            )
            say(f"{name}: {took_s:.1f} s")
        for number in range(count):
            name = names[number % len(names)]
            kind = kinds[(number // len(names)) % len(kinds)]
            at = place / f"trial-{seed}-{number}"
            what = f"{number + 1} of {count}: {name}, {kind.name}"
            try:
                code = trial(chosen[name], kind, at, chance, wholes[name])
                findings.ended[name, kind.name, code] += 1
                say(f"{what}, exit code {code}")
            except Problem as problem:
                findings.problems.append(f"{what}: {problem}")
                say(findings.problems[-1])
            shutil.rmtree(at, ignore_errors=True)
    return findings


def say_on_stderr(text: str) -> None:
    sys.stderr.write(f"{text}\n")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=100, help="kills (default 100)")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    began_s = time.monotonic()
    findings = run_trials(asked.count, asked.seed, say=say_on_stderr)
    for (name, kind, code), n_trials in sorted(findings.ended.items()):
        sys.stdout.write(f"{name:8} {kind:10} exit code {code:4}: {n_trials}\n")
    sys.stdout.write(
        f"{asked.count} kills in {time.monotonic() - began_s:.0f} s; the last write to a session "
        f"or recording at most {findings.longest_loss_s:.2f} s before the kill; "
        f"{len(findings.problems)} problems\n"
    )
    return 1 if findings.problems else 0


if __name__ == "__main__":
    sys.exit(main())
