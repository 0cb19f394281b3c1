"""Programs that are ended from outside, and what each must leave then.

Independent on purpose: files are read by the `mcap` library, `rosbags`, Pillow and plain JSON.
Every program leads the session of a real terminal. It gets a signal, or the terminal is closed
under it, or its disk gets full. Then

- a session or recording holds all that there was until a second before,
- a file under its final name is whole, and what a run had printed as done is in its file,
- the exit code is that of the signal, and no traceback was printed,
- no process, lock, link or announcement is left, and modules are stopped.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from enum import Enum, auto
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from PIL import Image
from rosbags.highlevel import AnyReader

from emulator.scene.scene import load_scene
from hil_tests.device.emulator_process import emulator
from hil_tests.patience import seconds
from hil_tests.system.recorded_session import record_session, write_shorter_scene
from hil_tests.system.short_scene import write_short_scene
from hil_tests.system.terminal import Command, in_terminal
from hil_tests.unit.xethru_protocol.pty_module import PtyModule
from slam.app.rig.rig_files import write_rig
from slam.app.view.rerun_recording import count_rows
from slam.library.rig_files import RigFile, RigRadar
from xethru_protocol.recordings import describe_recording

UWB_SLAM, XETHRU, EMULATOR = "slam.app.cli", "xethru_protocol.cli", "emulator.cli"
MARK = "XETHRU_ENDED_PROGRAM"
RADARS = ("front_left", "rear_left", "front_right", "rear_right")
CTRL_C = b"\x03"
END_S = 60.0
"""A program that has not ended after that hangs."""
LOST_S = 1.0
"""What a kill may cost of a session or a recording."""
N_MESSAGES = 60
"""Length of a recording."""


class Ending(Enum):
    """How a program is ended."""

    KILL = auto()
    TERM = auto()
    INT = auto()  # Ctrl-C, which the whole group of processes gets
    HANG_UP = auto()  # the terminal is closed
    NO_HANG_UP = auto()  # the terminal is closed, but as after `nohup` there is no signal
    FULL_DISK = auto()


@dataclass(frozen=True, kw_only=True)
class Ended:
    """A program that was ended: its place, how, its exit code, what it printed, and when.

    Attributes
    ----------
    folder
        Of its results.
    ending
        None: it was not ended.
    at_unix_s
        Time of day at which it was ended.
    """

    folder: Path
    ending: Ending | None
    code: int
    printed: str
    at_unix_s: float

    @property
    def may_write_no_more(self) -> bool:
        """Whether it could not finish what it had begun."""
        return self.ending in (Ending.KILL, Ending.FULL_DISK)

    def check_loss(self, written: Iterable[Path]) -> None:
        """AssertionError if nothing was written for a second, and half a one for the next chunk."""
        lost_s = self.at_unix_s - max(path.stat().st_mtime for path in written)
        assert lost_s < LOST_S + seconds(0.5), f"the last {lost_s:.1f} s are lost"


def nothing(ended: Ended) -> None:
    """Check nothing: all there is to see is the result."""


def of_nothing(folder: Path) -> None:
    """Return nothing: the program has no result."""


@dataclass(frozen=True, kw_only=True)
class Program:
    """A program to end.

    Attributes
    ----------
    arguments
        Of the program that writes into a folder.
    check
        AssertionError if what is in the folder of an ended one is not as it should be.
    result
        Returns what every whole run gives alike; AssertionError if it is not there.
    is_under_way
        Whether it has begun what it is for, by its folder and by what it has printed.
    again
        Arguments that are added for another run into the same folder.
    refuses
        What it never replaces.
    serves
        Whether a signal is its usual end. Without one, it goes on.
    """

    module: str
    arguments: Callable[[Path], Sequence[object]]
    check: Callable[[Ended], None] = nothing
    result: Callable[[Path], object] = of_nothing
    is_under_way: Callable[[Path, bytes], bool] = lambda folder, printed: False
    again: Sequence[str] = ()
    refuses: str | None = None
    serves: bool = False

    def codes(self, ending: Ending) -> set[int]:
        """Return the exit codes of one that is ended while it has its handlers of signals."""
        if self.serves and ending is not Ending.KILL:
            return {0}
        return {
            Ending.KILL: {-9},
            Ending.TERM: {143},
            Ending.INT: {130},
            Ending.HANG_UP: {129},
            Ending.NO_HANG_UP: {1},  # what it prints at last is lost
            Ending.FULL_DISK: {0, 1},
        }[ending]


# --- what is left -------------------------------------------------------------------------------


def is_written(size_bytes: int, pattern: str) -> Callable[[Path, bytes], bool]:
    """Return whether a file of a folder has that many bytes."""
    return lambda folder, printed: any(
        path.stat().st_size >= size_bytes for path in folder.glob(pattern)
    )


def is_printed(text: bytes) -> Callable[[Path, bytes], bool]:
    return lambda folder, printed: text in printed


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


def check_session(ended: Ended, *, live: bool) -> int:
    """Check a session; return the number of its states."""
    log = ended.folder / "session.mcap"
    if not log.exists() or (ended.may_write_no_more and not log.stat().st_size):
        return 0
    found, is_finished = counters_by_topic(log)
    assert is_finished or ended.may_write_no_more, "the session was not finished"
    n_scans = len(found.get("/scan", ())) + len(found.get("/scan_unused", ()))
    for radar in RADARS:
        counters = found.get(f"/radar/{radar}/frame", [])
        gaps = [b - a for a, b in pairwise(counters) if b - a != 1]
        assert live or not gaps, f"frames of {radar} are missing"
        # a frame stands before its scan's mark, so that a cut may part them
        assert live or len(counters) - n_scans in (0, 1), f"{len(counters)} frames of {radar}"
    if ended.ending is Ending.KILL and not is_finished and n_scans:
        ended.check_loss([log])
    return len(found.get("/slam/state", ()))


def check_results(ended: Ended, n_states: int) -> None:
    """Check the results of a run whose session has that many states."""
    folder = ended.folder
    rows = {path.stem: len(path.read_text().splitlines()) for path in folder.glob("*.tum")}
    if ended.ending is Ending.FULL_DISK and rows:  # a drive goes on where its session does not
        n_states = max(rows.values())
    for name, n_rows in rows.items():
        assert n_rows == n_states, f"{name}.tum has {n_rows} rows of {n_states}"
    if (map_png := folder / "map.png").exists():
        check_picture(map_png)
    if (summary := folder / "summary.json").exists():
        n_frames = json.loads(summary.read_text())["frames"]
        assert n_frames > 0 or not n_states, "no frames in summary.json"
    if not ended.may_write_no_more:
        assert not list(folder.glob(".unfinished*")), "unfinished files are left"
        has_all = summary.exists() and map_png.exists() and {"estimate", "odometry"} <= set(rows)
        assert has_all or not n_states, f"{n_states} states, and results are missing"


def check_picture(path: Path) -> None:
    with Image.open(path) as picture:
        picture.load()


def without_speed(summary: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in summary.items() if name != "realtime_factor"}


def results_of(folder: Path) -> object:
    summary = folder / "summary.json"
    check_picture(folder / "map.png")
    tables = {path.name: path.read_text() for path in sorted(folder.glob("*.tum"))}
    assert {"estimate.tum", "odometry.tum"} <= set(tables)
    return without_speed(json.loads(summary.read_text())), tables


# --- the programs -------------------------------------------------------------------------------


class Stage:
    """The programs, and what they need: a session, scenes, and modules, made when asked for."""

    def __init__(self, folder: Path, stack: ExitStack, *, n_sweep_runs: int = 3) -> None:
        self._folder, self._stack, self._n_sweep_runs = folder, stack, n_sweep_runs

    def program(self, name: str) -> Program:
        found: Program = getattr(self, name)
        return found

    @cached_property
    def _session(self) -> Path:
        (folder := self._folder / "session").mkdir()
        record_session(folder / "session.mcap", "paper")
        return folder / "session.mcap"

    @cached_property
    def _scene(self) -> Path:
        (folder := self._folder / "scene").mkdir()
        return write_shorter_scene(folder)

    @cached_property
    def _module(self) -> PtyModule:
        return self._stack.enter_context(PtyModule())

    def _module_stops(self, ended: Ended) -> None:
        assert ended.ending is Ending.KILL or self._module.fps == 0, "the module goes on"

    @cached_property
    def demo(self) -> Program:
        what = ["demo", "--preset", "paper", "--scene", self._scene]
        return Program(
            module=UWB_SLAM,
            arguments=lambda out: [*what, "--out", out],
            check=lambda ended: check_results(ended, check_session(ended, live=False)),
            result=results_of,
            is_under_way=is_written(500_000, "session.mcap"),
        )

    @cached_property
    def run(self) -> Program:
        (place := self._folder / "robot").mkdir()
        scene = write_short_scene(place, repeats=1000)  # it drives on in all trials
        rig = place / "robot.toml"
        keys = ("name", "serial", "x_m", "y_m", "yaw_deg")
        radars = [
            RigRadar(**{key: getattr(one, key) for key in keys}) for one in load_scene(scene).radars
        ]
        write_rig(rig, RigFile(radars=tuple(radars)))
        serve = emulator("serve", scene, "--link-dir", place / "ports")
        served = self._stack.enter_context(serve)
        drive = ["--odometry", served.odometry, "--duration", "3", "--ports", *served.paths]

        def result(out: Path) -> object:
            assert (out / "session.mcap").exists()
            results_of(out)
            return None  # every drive is another

        return Program(
            module=UWB_SLAM,
            arguments=lambda out: ["run", "--rig", rig, *drive, "--out", out],
            check=lambda ended: check_results(ended, check_session(ended, live=True)),
            result=result,
            is_under_way=is_written(200_000, "session.mcap"),
            refuses="session.mcap",
        )

    @cached_property
    def record(self) -> Program:
        def check(ended: Ended) -> None:
            self._module_stops(ended)
            files = [*ended.folder.glob("rec/xethru_datafloat_*")]
            if not files:
                return
            kept = describe_recording(ended.folder / "rec")
            n_messages = sum(kept.messages.values())
            assert not kept.faults or ended.ending is Ending.KILL, f"damaged: {kept.faults}"
            if ended.ending is Ending.KILL and 0 < n_messages < N_MESSAGES:
                ended.check_loss(files)

        def result(out: Path) -> object:
            kept = describe_recording(out / "rec")
            assert not kept.faults
            assert kept.messages["DATA FLOAT"] == N_MESSAGES
            return kept.messages

        what = ["record", "--port", self._module.path, "--count", N_MESSAGES]
        return Program(
            module=XETHRU,
            arguments=lambda out: [*what, "--out", out / "rec"],
            check=check,
            result=result,
            is_under_way=is_written(1, "rec/xethru_datafloat_*"),
            again=("--force",),
        )

    @cached_property
    def stream(self) -> Program:
        return Program(
            module=XETHRU,
            arguments=lambda out: ["stream", "--port", self._module.path],
            check=self._module_stops,
            is_under_way=is_printed(b"strongest at"),
        )

    @cached_property
    def sweep(self) -> Program:
        n_runs = self._n_sweep_runs
        what = ["sweep", "--preset", "paper", "--scene", self._scene, "--jobs", "2", "--seeds"]

        def check(ended: Ended) -> None:
            out = ended.folder / "sweep.json"
            if out.exists():
                assert len(json.loads(out.read_text())["runs"]) == n_runs
                return
            part = out.with_name("sweep.json.part")
            lines = part.read_bytes().split(b"\n") if part.exists() else []
            n_done = sum("ate_rmse_m" in json.loads(line) for line in lines[:-1])
            printed = [int(done) for done in re.findall(rf"(\d+) of {n_runs}: ", ended.printed)]
            assert n_done >= max(printed, default=0), f"{n_done} runs, and {printed} were printed"

        def result(out: Path) -> object:
            assert not (out / "sweep.json.part").exists()
            runs = json.loads((out / "sweep.json").read_text())["runs"]
            return [without_speed(one) for one in runs]

        return Program(
            module=UWB_SLAM,
            arguments=lambda out: [*what, n_runs, "--json", out / "sweep.json"],
            check=check,
            result=result,
            is_under_way=is_printed(f"1 of {n_runs}: ".encode()),
        )

    @cached_property
    def replay(self) -> Program:
        n_states = len(counters_by_topic(self._session)[0]["/slam/state"])

        def check(ended: Ended) -> None:
            if ended.may_write_no_more or ended.code == 0:
                check_results(ended, n_states)
                return
            for path in ended.folder.glob("*.tum"):
                assert len(path.read_text().splitlines()) == n_states, f"{path.name} is not whole"
            if (ended.folder / "map.png").exists():
                check_picture(ended.folder / "map.png")

        return Program(
            module=UWB_SLAM,
            arguments=lambda out: ["replay", self._session, "--out", out],
            check=check,
            result=results_of,
        )

    def _from_session(
        self,
        command: str,
        name: str,
        read: Callable[[Path], object],
        *,
        option: str | None = "--out",
        refuses: str | None = None,
    ) -> Program:
        """Return a program that makes one file, whole or not at all, of a session."""

        def check(ended: Ended) -> None:
            if (ended.folder / name).exists():
                read(ended.folder / name)

        options = () if option is None else (option,)
        return Program(
            module=UWB_SLAM,
            arguments=lambda out: [command, self._session, *options, out / name],
            check=check,
            result=lambda out: read(out / name),
            refuses=refuses,
        )

    @cached_property
    def report(self) -> Program:
        def read(page: Path) -> object:
            text = page.read_text()
            assert text.rstrip().endswith("</html>")
            return text

        return self._from_session("report", "report.html", read)

    @cached_property
    def convert(self) -> Program:
        def read(folder: Path) -> object:
            with AnyReader([folder]) as bag:
                messages = Counter(connection.topic for connection, _, _ in bag.messages())
                assert sum(messages.values()) == bag.message_count > 100
            return messages

        return self._from_session("convert", "bag", read, option=None, refuses="bag")

    @cached_property
    def view(self) -> Program:
        def read(file: Path) -> object:
            rows = count_rows(file)
            assert sum(rows.values()) > 100
            return rows

        return self._from_session("view", "view.rrd", read)

    @cached_property
    def calibrate(self) -> Program:
        def read(rig: Path) -> object:
            text = rig.read_text()
            assert text.count("[[radars]]") == len(RADARS)
            return text

        return self._from_session("calibrate", "rig.toml", read, option="--rig")

    @cached_property
    def repair(self) -> Program:
        def read(log: Path) -> object:
            found, is_finished = counters_by_topic(log)
            assert is_finished
            return found

        return self._from_session("repair", "session.mcap", read)

    def _server(self, *what: object) -> Program:
        def check(ended: Ended) -> None:
            assert not (ended.folder / "links").exists(), "links are left"

        return Program(
            module=EMULATOR,
            arguments=lambda out: [*what, "--link-dir", out / "links"],
            check=check,
            is_under_way=is_printed(b'"ready":true'),
            serves=True,
        )

    @cached_property
    def serve(self) -> Program:
        return self._server("serve", "smoke")

    @cached_property
    def play(self) -> Program:
        return self._server("play", self._session)

    @cached_property
    def proxy(self) -> Program:
        return self._server("proxy", "--port", self._module.path)


# --- one end ------------------------------------------------------------------------------------


def processes_of(mark: str) -> list[int]:
    """Return the processes that a program started and that still run."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                environment = (entry / "environ").read_bytes()  # empty of one that has ended
            except OSError:
                continue
            if f"{MARK}={mark}".encode() in environment.split(b"\0"):
                found.append(int(entry.name))
    return found


def check_nothing_is_left(place: Path, folder: Path) -> None:
    """AssertionError if processes, announcements or locks are left; results are in `folder`."""
    give_up_s = time.monotonic() + seconds(5)
    while running := processes_of(str(place)):
        assert time.monotonic() < give_up_s, f"{len(running)} processes are left"
        time.sleep(0.02)
    announced = [path.name for path in (place / "run").rglob("*.json")]
    assert not announced, f"announcements are left: {announced}"
    for path in (folder, *folder.rglob("*")):
        if path.is_dir() or path.suffix == ".part":
            descriptor = os.open(path, os.O_RDONLY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise AssertionError(f"{path.name} is locked") from None
            finally:
                os.close(descriptor)


@contextmanager
def started(
    program: Program,
    place: Path,
    folder: Path,
    again: Sequence[str] = (),
    *,
    ignores_hangup: bool = False,
) -> Iterator[Command]:
    """Start a program, which keeps its own things in `place` and its results in `folder`."""
    for name in ("tmp", "run"):
        (place / name).mkdir(exist_ok=True, mode=0o700)
    environment = {
        MARK: str(place),
        "TMPDIR": str(place / "tmp"),
        "XDG_RUNTIME_DIR": str(place / "run"),
    }
    with in_terminal(
        program.module,
        [*program.arguments(folder), *again],
        place / "crashes",
        environment=environment,
        ignores_hangup=ignores_hangup,
    ) as command:
        yield command


def end(command: Command, ending: Ending) -> None:
    """Do to a program what ends it; a full disk ends it by itself."""
    if ending in (Ending.HANG_UP, Ending.NO_HANG_UP):
        command.hang_up()
    elif ending is Ending.INT:
        command.press(CTRL_C)
    elif ending is Ending.TERM:
        command.process.terminate()
    elif ending is Ending.KILL:
        command.process.kill()


def wait_for_end(command: Command, folder: Path, ending: Ending | None, at_unix_s: float) -> Ended:
    give_up_s = time.monotonic() + seconds(END_S)
    while command.process.poll() is None:
        command.read()
        assert time.monotonic() < give_up_s, "it does not end"
        time.sleep(0.005)
    command.read()
    assert not command.tracebacks, f"it printed a traceback:\n{command.tracebacks}"
    return Ended(
        folder=folder,
        ending=ending,
        code=command.process.returncode,
        printed=command.printed.decode(errors="replace"),
        at_unix_s=at_unix_s,
    )
