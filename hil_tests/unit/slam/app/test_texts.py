"""What `uwb-slam` prints when it is asked for help or refuses: one file of texts per command.

Each line of `REFUSED` is a command line; it must end with 1 or 2, print nothing but one line on
stderr (or argparse's usage), and leave every file as it is. After a change of wording,
``XETHRU_UPDATE_TEXTS=1`` writes the files of the folder `texts` anew.
"""

import os
import re
import shlex
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from scipy.io import savemat

from hil_tests.unit.slam.app.authors_bag import authors_bag
from hil_tests.unit.slam.app.sessions import feed, session_info
from slam.app.cli import main
from slam.app.experiments import EXPERIMENTS
from slam.app.odometry.track import OdometryTrack
from slam.app.odometry.tum import TumSample
from slam.app.session.log import SessionLog
from slam.app.session.messages import METADATA_NAME, session_table
from slam.app.view.rerun_sdk import rr

TEXTS = Path(__file__).parent / "texts"

RADAR = """\
[[radars]]
name = "left"
serial = "202305070101"
x_m = 0.1
y_m = 0
yaw_deg = 90
"""
RIGS = {
    "left": RADAR,
    "slip": RADAR + "[wheels]\nslip = 1\n",
    "negative": RADAR + "[wheels]\nscale_sigma = -1\n",
    "colour": RADAR + "colour = 1\n",
    "radar": "radar = []\n" + RADAR,
    "no_x": RADAR.replace("x_m = 0.1\n", ""),
    "text": RADAR.replace("0.1", '"0.1"'),
    "nan": RADAR.replace("0.1", "nan"),
    "true": RADAR.replace("0.1", "true"),
    "serial": RADAR.replace("202305070101", "12"),
    "twice": RADAR + RADAR,
    "empty": "radars = []\n",
    "syntax": "[[radars\n",
    "deep": "a=" + "[" * 5000,
}
TRAJECTORIES = {
    "drive": "1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n3 1 1 0 0 0 0 1\n",
    "late": "1000001 0 0 0 0 0 0 1\n1000002 1 0 0 0 0 0 1\n",
    "empty": "",
    "short": "1 2 3\n",
    "word": "0 0 0 0 0 0 0 1\nx 0 0 0 0 0 0 1\n",
    "nan": "0 nan 0 0 0 0 0 1\n",
    "nanoseconds": "0 0 0 0 0 0 0 1\n1732155000123456789 0 0 0 0 0 0 1\n",
    "exponent": "1e9999999 0 0 0 0 0 0 1\n",
    "infinite": "inf 0 0 0 0 0 0 1\n",
    "quaternion": "0 0 0 0 0 0 0 0\n",
    "repeated": "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n",
    "binary": b"\xff\xfe\x00",
}
FOREIGN = {
    "foreign.rrd": b"RRF2\x00\x57\x00\x00rest",
    "future.rrd": b"RRF2" + bytes((1, 2, 0, 0)) + bytes(100),
    "old.rrd": b"RRF2" + bytes((0, 20, 0, 0)) + bytes(100),
    "old.bag": b"#ROSBAG V2.0\n",
    "a.db3": b"SQLite format 3\0",
    "port.xtwire": b"\x89XTWIRE\n",
    "found.mat": b"MATLAB 5.0 MAT-file, Platform",
    "version73.mat": b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400),
    "view.mat": b"RRF2" + bytes(300),
    "packed.gz": b"\x1f\x8b\x08",
    "notes.mcap": b"a list of things to buy",
    "empty.mcap": b"",
    "text.bag": b"hello\n" * 99,
    "brace.json": b"{",
    "list.json": b"[]",
    "no_runs.json": b'{"runs": [], "groups": []}',
    "no_numbers.json": b'{"groups": [{"scene": "lab"}]}',
    "places.toml": b"[[reflectors]]\nx_m = 1.0\ny_m = 2\n[[reflectors]]\nx_m = true\ny_m = 0.0\n",
}
BAGS: dict[str, dict[str, Any]] = {
    "blind": {"odometry": False},
    "elsewhere": {"topics": "/radar{}"},
    "unknown": {"topics": "/UWBradar{}0"},
    "short": {"n_bins": 500},
}
FORMATS = ("3", "two", "1", None)
STATES = 6
AUTHORS = {
    "odom": np.zeros((STATES, 3)),
    "obsLHS": np.zeros((STATES, 5, 2)),
    "obsRHS": np.zeros((STATES, 5, 2)),
}
TABLES: dict[str, dict[str, object]] = {
    "no_odom": {"R1": np.zeros((STATES, 500))},
    "two_columns": AUTHORS | {"odom": np.zeros((STATES, 2))},
    "no_states": AUTHORS | {"odom": np.zeros((0, 3))},
    "five": AUTHORS | {"obsLHS": np.zeros((5, 5, 2))},
    "not_finite": AUTHORS | {"obsRHS": np.full((STATES, 5, 2), np.nan)},
    "cube": AUTHORS | {"R2": np.zeros((STATES, 5, 2))},
    "standstill": AUTHORS | {"t": np.zeros((STATES, 1))},
    "words": AUTHORS | {"odom": "text"},
}

REFUSED = {
    "": ["", "fly"],
    "demo": [
        "--seed -1",
        "--seed x",
        "--out \udcff",
        "--scene mars --out new",
        "--scene no/such.toml --out new",
        "--preset magic --out new",
        "--out drive.tum/o",
        "--rerun http://127.0.0.1:9876",
        "--rerun spawn --out empty",
    ],
    "run": [
        "",
        "--rig none.toml --odometry -",
        *(f"--rig {name}.toml --odometry -" for name in RIGS if name != "left"),
        "--rig /dev/zero --odometry -",
        "--rig left.toml --odometry - --preset magic",
        "--rig left.toml --odometry - --out .",
        "--rig left.toml --odometry - --odometry-clock ²",
        "--rig left.toml --odometry drive.tum",
        *(
            f"--rig left.toml --odometry {source}"
            for source in (
                "tcp://host",
                "tcp:host:5",
                "tcp://h:99999",
                "tcp://h:²",
                "serial:@9600",
                "serial:/dev/x@fast",
                "serial:p@0",
                "nowhere",
                "/",
            )
        ),
    ],
    "replay": [
        "",
        *(
            f"{name} --out new"
            for name in (
                "none.mcap",
                "notes.mcap",
                "chatter.mcap",
                "cut.mcap",
                "head.mcap",
                "empty",
            )
        ),
        *(f"format_{number}.mcap --out new" for number in FORMATS),
    ],
    "evaluate": [
        "drive.tum",
        "none.tum drive.tum",
        *(f"{name}.tum drive.tum" for name in TRAJECTORIES if name != "drive"),
    ],
    "view": [
        "made.rrd",
        "none.mcap",
        "empty",
        "notes.rrd",
        "future.rrd",
        "old.rrd",
        "killed.rrd",
        "cut.mcap --out new.rrd",
        "made.rrd --out new.rrd",
        "session.mcap --out other.mcap",
        "session.mcap --out session.mcap",
        "session.mcap --out link.rrd",
        "session.mcap --screenshot session.mcap",
        "session.mcap --at 3",
        "session.mcap --at nan",
        "session.mcap --web --out v.rrd",
    ],
    "report": [
        "none.mcap",
        "empty",
        "notes.mcap",
        "session.mcap --out other.mcap",
        "session.mcap --out session.mcap",
    ],
    "repair": [
        *(name for name in FOREIGN if not name.endswith((".json", ".toml"))),
        "none.mcap",
        "no/where.mcap",
        "empty",
        "nothing.mcap",
        "loop.mcap",
        "pipe",
    ],
    "convert": [
        "none.mat new.mcap",
        "version73.mat new.mcap",
        "view.mat new.mcap",
        "found.mat new.mcap",
        *(f"{name}.mat new.mcap" for name in TABLES),
        "none.bag new.mcap",
        "text.bag new.mcap",
        "empty new.mcap",
        "blind.bag new.mcap",
        "elsewhere.bag new.mcap",
        "unknown.bag new.mcap",
        "short.bag new.mcap",
        "short.bag new.mcap --frame-area 0.2 9.4",
        "short.bag new.mcap --frame-area 9.4 0.2",
        "short.bag new.mcap --frame-area nan 9.4",
        "short.bag new.mcap --preset mine",
        "session.mcap empty",
        "old.bag new.bag",
        "session.mcap new.mcap",
        "session.mcap new",
        "full.mcap new.mat --preset paper",
        "full.mcap new.xtwire",
        "full.mcap new.xtwire --radar left",
        "full.mcap new.xtwire --radar radar0",
        "tomorrow.mcap new.mat",
    ],
    "calibrate": [
        "none.mcap",
        "none.mcap --truth nowhere",
        "none.mcap --reflectors nowhere",
        "none.mcap --reflectors places.toml",
        "session.mcap --rig none/rig.toml",
        "session.mcap --rig empty",
        "session.mcap --rig session.mcap",
        "session.mcap --truth visitor",
    ],
    "sweep": [
        "",
        "--json new --seeds 0",
        "--json new --set gate",
        "--json new --stress mud",
        "--json new --jobs 2 --dask tcp://x:1",
        "--json new --scene mars",
        "--json new --scene no/such.toml",
        "--json new --scene lab lab",
        "--json new --preset magic",
        "--json new --preset paper paper",
        "--json new --set association.gte=1",
        "--json new --set association.gate=1,x",
        "--json new --set gate=1",
        "--json new --set association.gate=1,1",
        "--json new --set robust.calibrated_offset_sigma_m=1",
        "--json empty",
        "--json drive.tum/o",
        "--json pipe",
    ],
    "experiment": [
        "figure8",
        *(f"{name} --out drive.tum" for name in EXPERIMENTS if name != "recording"),
        "filter --scene lab nowhere",
        "step-cost --landmarks 1",
        "recording --recording nowhere",
        "recording --recording full.mcap",
        "recording --recording full.mcap --radar radar0",
        *(
            f"{name} --sweep {sweep}.json"
            for name in ("consistency", "stress", "scenes")
            for sweep in ("none", "brace", "list", "no_runs", "no_numbers")
        ),
    ],
}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fill a folder with what the command lines name."""
    place = tmp_path_factory.mktemp("place")
    texts = {f"{name}.toml": text for name, text in RIGS.items()}
    texts |= {f"{name}.tum": text for name, text in TRAJECTORIES.items()}
    for name, content in (texts | FOREIGN).items():
        data = content.encode() if isinstance(content, str) else content
        (place / name).write_bytes(data)
    for name, table in TABLES.items():
        savemat(place / f"{name}.mat", table)
    start = OdometryTrack([TumSample(t_ns=0, x_m=0.0, y_m=0.0, qz=0.0, qw=1.0)])
    SessionLog(place / "session.mcap", session_info(), start).close()
    tomorrow = replace(session_info(4), config_json='{"tomorrow": 1}', wheels={"scale_sigma": 0.1})
    for name, info in (("full", session_info()), ("tomorrow", tomorrow)):
        log = SessionLog(place / f"{name}.mcap", info, start)
        feed(log, 2)
        log.close()
    for number in FORMATS:
        write_format(place / f"format_{number}.mcap", number)
    with (place / "chatter.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates in part
    for name, options in BAGS.items():
        authors_bag(place / f"{name}.bag", **options)
    whole = (place / "session.mcap").read_bytes()
    (place / "head.mcap").write_bytes(whole[: whole.index(b"zstd")])  # stands in a chunk's head
    (place / "other.mcap").write_bytes(whole)
    (place / "cut.mcap").write_bytes(whole[:100])
    (place / "nothing.mcap").write_bytes(whole[:100])
    rr.RecordingStream("somebody_elses").save(place / "made.rrd")
    (place / "killed.rrd").write_bytes((place / "made.rrd").read_bytes()[:-100])
    (place / "notes.rrd").write_text("a list of things to buy")
    (place / "link.rrd").symlink_to("session.mcap")
    (place / "loop.mcap").symlink_to("loop.mcap")
    (place / "empty").mkdir()
    os.mkfifo(place / "pipe")
    return place


def write_format(path: Path, number: str | None) -> None:
    """Write the head of a session that says it is of this format."""
    table = session_table(session_info())
    del table["format"]
    if number is not None:
        table["format"] = number
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata(METADATA_NAME, table)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates in part


def files_of(place: Path) -> dict[Path, bytes | None]:
    """Return the content of every file, None for what is no file; results have folders."""
    return {
        path: path.read_bytes() if path.is_file() else None
        for path in place.rglob("*")
        if path != place / "out" / "experiments" and path != place / "out"
    }


def paragraphs(text: str) -> str:
    """Return argparse's text whatever version of Python wrapped and quoted it."""
    found = re.sub(r"'([\w-]+)'(?=[,)])", r"\1", text)
    parts = [" ".join(part.split()) for part in re.split(r"\n\s*\n|\n(?=  -)", found.strip())]
    return "\n".join(textwrap.fill(part, 100, break_on_hyphens=False) for part in parts)


def ended(arguments: list[str]) -> tuple[int, bool]:
    """Return the exit code, and whether argparse gave it."""
    try:
        return main(arguments), False
    except SystemExit as end:
        return int(str(end.code)), True


@pytest.mark.parametrize("command", REFUSED)
def test_help_and_refusals_are_as_recorded_and_change_no_file(
    command: str, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("NO_COLOR", "1")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    before = files_of(place)
    found = []
    for line in ("--help", *REFUSED[command]):
        code, is_usage = ended(shlex.split(f"{command} {line}"))
        said = capsys.readouterr()
        if is_usage:
            text = paragraphs(said.out if line == "--help" else said.err.partition("error: ")[2])
        else:
            text = said.err.rstrip("\n")
            assert (said.out, said.err.count("\n")) == ("", 1), (line, said)
            assert text.startswith("uwb-slam: ")
        assert (code == 0) == (line == "--help"), (line, said)
        found.append(
            " ".join(["$ uwb-slam", *command.split(), line]).rstrip() + f"\n{text}\n[{code}]\n"
        )
    assert files_of(place) == before
    whole = "\n".join(found).replace(str(place), "PLACE")
    whole = re.sub(r"\d+\.\d+(?= here)", "VERSION", whole)
    recorded = TEXTS / f"{command or 'uwb-slam'}.txt"
    if "XETHRU_UPDATE_TEXTS" in os.environ:
        recorded.write_text(whole, encoding="utf-8", errors="backslashreplace")
    assert whole.encode(errors="backslashreplace").decode() == recorded.read_text(encoding="utf-8")
