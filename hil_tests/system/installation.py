"""Install the wheel with each extra into an empty environment, and run what the extra promises.

``make test-install`` runs it for every Python from 3.11 to 3.13 that is on the path, and skips
the others with the reason. It prints a row per environment, with its size, and the output of what
failed. Exit 1 if anything failed, or nothing was tested. Needs an index of packages, and the
standard library only.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from hil_tests.system.short_scene import write_short_scene

REPOSITORY = Path(__file__).parents[2]
PYTHONS = ("3.11", "3.12", "3.13")
LIMIT_S = 900.0

READ_FRAME = """\
import sys
from xethru_protocol import X4M300

with X4M300.open(sys.argv[1]) as radar:
    radar.configure_raw()
    radar.start(17)
    print(radar.read_frame().samples.shape)
"""
SWEEP_ON_DASK = """\
import sys
from distributed import LocalCluster
from slam.app.cli import main

if __name__ == "__main__":
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        sys.exit(main([*sys.argv[1:], "--dask", cluster.scheduler_address]))
"""


class Promise(NamedTuple):
    """A command, what its output contains, and its exit code.

    ``{port}`` is that of an emulated module, ``{scene}`` a scene of a minute.
    """

    command: str
    says: str = ""
    code: int = 0


_DRIVER = (
    Promise("xethru info --port {port}", "X4M300"),
    Promise("python read_frame.py {port}", "(1431,)"),
    Promise("xethru record --port {port} --out rec --duration 1", " 0 lost"),
    Promise("xethru dump rec", "1431 RF bins"),
    Promise("xethru convert rec rec.npz"),
)
_EMULATOR = (
    Promise("xethru-emulator faults stall", "seconds"),
    Promise("xethru doctor --port {port}", "all is well"),
)
_SLAM = (
    Promise("uwb-slam demo --scene {scene} --out demo", "smoothed ATE"),
    Promise("uwb-slam report demo"),
    Promise("uwb-slam replay demo/session.mcap --out again", "smoothed ATE"),
)
_VIEW = (*_SLAM, Promise("uwb-slam view demo --out view.rrd"))
_HIL = (Promise("python -m pytest -q --pyargs hil_tests.device", " passed"),)

PROMISES: dict[str, tuple[Promise, ...]] = {
    "emulator": _EMULATOR,  # the first: its emulator serves the others
    "base": (
        *_DRIVER,
        Promise("xethru-emulator --help", "serve"),
        Promise("xethru-emulator serve --bare", "[emulator]", 2),
        Promise("uwb-slam --help", "demo"),
        Promise("uwb-slam demo", "[slam]", 2),
        Promise("xethru convert rec rec.mcap", "[mcap]", 1),
        Promise("pip install 'xethru-hil[mcap]'"),
        Promise("xethru convert rec rec.mcap"),
    ),
    "mcap": (
        *_DRIVER,
        Promise("xethru convert rec rec.mcap"),
        Promise("xethru dump rec.mcap", "1431 RF bins"),
    ),
    "hil": _HIL,
    "slam": (
        *_SLAM,
        Promise("uwb-slam view demo --out view.rrd", "[view]", 2),
        Promise("uwb-slam demo --scene {scene} --publish foxglove --out no", "[foxglove]", 2),
    ),
    "view": _VIEW,
    "all": (*_DRIVER, *_EMULATOR, *_VIEW, *_HIL),
    "foxglove": (
        Promise("uwb-slam demo --scene {scene} --publish foxglove --out demo", "events sent"),
    ),
    "ros2": (Promise("uwb-slam demo --scene {scene} --publish ros2 --out demo", "0 failed: ros2"),),
    "dask": (
        Promise("python sweep.py sweep --scene {scene} --seeds 1 --json sweep.json", "short"),
    ),
    "gtsam": (
        Promise("uwb-slam sweep --scene {scene} --seeds 1 --bound --json sweep.json", "short"),
    ),
}
"""What is run in the environment of each extra; `base` is without any."""

LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "</General></Domain></CycloneDDS>"
)
"""What ROS 2 uses of the network."""


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="make test-install", description=__doc__)
    parser.add_argument("--python", nargs="+", choices=PYTHONS, default=PYTHONS)
    parser.add_argument("--extra", nargs="+", choices=PROMISES, default=tuple(PROMISES))
    arguments = parser.parse_args(argv)
    failures: list[str] = []
    tested = False
    with tempfile.TemporaryDirectory() as folder:
        wheel = _wheel(Path(folder))
        print("python  extra      MB installed  seconds  promises", flush=True)
        for version in arguments.python:
            python = _interpreter(version)
            if python is None:
                print(f"{version:6}  skipped: no working python{version} on the path")
                continue
            tested = True
            failures += _each_extra(python, version, wheel, arguments.extra, Path(folder))
    for failure in failures:
        print(f"\n{failure}", file=sys.stderr)
    if not tested:
        print("nothing was tested", file=sys.stderr)
    return 0 if tested and not failures else 1


def _wheel(folder: Path) -> Path:
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir"]
    subprocess.run([*command, str(folder), str(REPOSITORY)], check=True)
    return next(folder.glob("*.whl"))


def _interpreter(version: str) -> str | None:
    """Return the path of an interpreter; None if there is none that starts."""
    found = shutil.which(f"python{version}")
    if (
        found is None
        or subprocess.run([found, "-c", ""], capture_output=True, check=False).returncode
    ):
        return None
    return found


def _each_extra(
    python: str, version: str, wheel: Path, extras: Sequence[str], folder: Path
) -> Iterator[str]:
    """Yield what failed, after a row for each extra was printed."""
    emulator = _installed(python, wheel, "emulator", folder / f"{version}-emulator")
    with _served(emulator, folder) as port:
        for extra in PROMISES:
            if extra not in extras:
                continue
            begun = time.monotonic()
            place = folder / f"{version}-{extra}"
            environment = emulator
            if extra != "emulator":
                environment = _installed(python, wheel, extra, place)
            size = _megabytes(environment)
            failed = list(_broken(environment, PROMISES[extra], port, folder))
            row = f"{version:6}  {extra:9}  {size:12.0f}  {time.monotonic() - begun:7.0f}"
            kept = len(PROMISES[extra]) - len(failed)
            print(f"{row}  {kept} of {len(PROMISES[extra])}", flush=True)
            yield from (f"python {version}, extra {extra}: {text}" for text in failed)
            if extra != "emulator":
                shutil.rmtree(environment)
    shutil.rmtree(emulator)


def _installed(python: str, wheel: Path, extra: str, environment: Path) -> Path:
    subprocess.run([python, "-m", "venv", str(environment)], check=True)
    pip = [str(environment / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    requirement = f"{wheel}[{extra}]" if extra != "base" else str(wheel)
    subprocess.run([*pip, "--disable-pip-version-check", requirement], check=True)
    return environment


def _megabytes(environment: Path) -> float:
    files = (path for path in environment.rglob("*") if path.is_file() and not path.is_symlink())
    return sum(path.stat().st_size for path in files) / 1e6


def _broken(
    environment: Path, promises: Sequence[Promise], port: str, folder: Path
) -> Iterator[str]:
    with tempfile.TemporaryDirectory(dir=folder) as work:
        place = Path(work)
        (place / "read_frame.py").write_text(READ_FRAME)
        (place / "sweep.py").write_text(SWEEP_ON_DASK)
        scene = write_short_scene(place)
        for promise in promises:
            program, *rest = shlex.split(promise.command.format(port=port, scene=scene))
            done = subprocess.run(
                [str(environment / "bin" / program), *rest],
                cwd=place,
                env=os.environ | {"CYCLONEDDS_URI": LOOPBACK},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                timeout=LIMIT_S,
                check=False,
            )
            if done.returncode != promise.code or promise.says not in done.stdout:
                wanted = f"exit {promise.code} and {promise.says!r} expected"
                yield f"{promise.command}: exit {done.returncode}; {wanted}\n{done.stdout[-2000:]}"


@contextmanager
def _served(environment: Path, folder: Path) -> Iterator[str]:
    """Serve an emulated module from an environment; yields its port."""
    command = [str(environment / "bin" / "xethru-emulator"), "serve", "--bare"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())["devices"][0]["path"]
        finally:
            process.terminate()


if __name__ == "__main__":
    sys.exit(main())
