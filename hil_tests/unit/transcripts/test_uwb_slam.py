"""What `uwb-slam` prints when it is asked for help or refuses, one transcript per command.

The files that the command lines name are made here. Nothing but help ends with 0, a refusal is one
line, and every file stays as it is.
"""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from scipy.io import savemat

from hil_tests.unit.slam.app.convert.authors_bag import authors_bag
from hil_tests.unit.slam.app.sessions import session_info, write_session
from hil_tests.unit.slam.library.test_saved_map import FILE
from hil_tests.unit.transcripts.test_transcripts import check_transcript
from slam.app.session.writer import SessionLog
from slam.app.view.rerun_recording import rr
from slam.library.saved_map import map_text
from slam.live.odometry_track import OdometryTrack, TumSample
from slam.live.session.description import METADATA_NAME, session_table

TEXTS = Path(__file__).parent / "uwb_slam"

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
TRAJECTORIES: dict[str, str | bytes] = {
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
AUTHORS: dict[str, object] = {
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
    "cube": AUTHORS | {"obsLHS": np.zeros((STATES, 5, 3))},
    "words": AUTHORS | {"odom": "text"},
    "detections": AUTHORS,
}

# Files of data sets: damaged, but for those in `good`
DATA_SETS = {
    "mrclam/Barcodes.dat": "# Subject Barcode\n6 72\n",
    "mrclam/Landmark_Groundtruth.dat": "6 1 1 0 0\n",
    "mrclam/Robot1_Odometry.dat": "# Time v w\n2 0.1 0\n1 0.1 0\n",
    "victoria-park/inputs.dat": "1 2 0\n2 2\n",
    "plaza/drive.pyfg": "VERTEX_SE2 0 A0 0 0 0\nEDGE_RANGE 0 A0 L0 1 1\n",
    "uwb-indoor/drive_Input.txt": "range2 0 1 0.01 0 0 105 0\nodom3 1 2 3\n",
    "good/drive_Input.txt": "odom2diff 0 0 0 0 1 1 1 1\nodom2diff 1 0 0 0 1 1 1 1\n",
    "good/drive_GT.txt": "point2 0 0 0 0 0 0 0\n",
}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fill a folder with what the command lines name."""
    place = tmp_path_factory.mktemp("place")
    texts: dict[str, str | bytes] = {f"{name}.toml": text for name, text in RIGS.items()}
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
        write_session(place / f"{name}.mcap", 2, start, info)
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
    (place / "room.json").write_text(map_text(FILE))
    (place / "newer.json").write_text(map_text(FILE).replace('"version": 1', '"version": 2'))
    (place / "damaged.json").write_text(map_text(FILE)[:300])
    for name, text in DATA_SETS.items():
        (place / name).parent.mkdir(exist_ok=True)
        (place / name).write_text(text, encoding="ascii")
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
    """Return the content of every file, None for what is no file."""
    return {path: path.read_bytes() if path.is_file() else None for path in place.rglob("*")}


@pytest.mark.parametrize("path", sorted(TEXTS.glob("*.txt")), ids=lambda path: path.stem)
def test_a_refusal_is_one_line_and_changes_no_file(
    path: Path, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    monkeypatch.setenv("COLUMNS", "100")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    before = files_of(place)
    rerun = ".".join(rr.__version__.split(".")[:2])
    masks = {str(place): "PLACE", f"{rerun} here": "VERSION here"}
    for printed in check_transcript(path, capsys, masks):
        *lines, code = printed.splitlines()[1:]
        assert code == "[0]" or (len(lines) == 1 and lines[0].startswith("! uwb-slam")), printed
    assert files_of(place) == before
