"""Make the files of `uwb-slam benchmark p440` from public recordings of a PulsON 440 on a rail.

The recordings were made by teams of the MIT Beaver Works Summer Institute, UAS-SAR course of 2019.
They are in two repositories, MIT licence. Clone both, check out the commits below, and run::

    git clone https://github.com/stevenruidigao/bwsiuassar2019
    git clone https://github.com/jjimmykang/bwsi-backprojection
    python docs/studies/p440_npz.py bwsiuassar2019 bwsi-backprojection --out data/p440

A radar file has 32 bytes of settings and packets of 1452 bytes, all big-endian: at byte 8 the stamp
[ms], at 44 the samples of a scan, at 48 which packet of the scan it is, at 50 of how many, and from
52 on 350 samples. The last scan is cut; only its stamp is used. Stamps lie on a line up to their
millisecond. Motion capture (OptiTrack CSV) has y up: its (x, y, z) become (x, -z, y), metres.

Two things are not in the recordings and are in `SOURCES`: the offset between the clocks, and where
the apex of each reflector is. Both were found by focusing. The benchmark prints what becomes of the
images without them: with the clock of the motion alone, and with the apex of another trial.
"""

import argparse
import csv
import json
import pickle
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

REPOSITORIES = (
    (
        "https://github.com/stevenruidigao/bwsiuassar2019",
        "25e267d2c9d96c767f7f9ea168a27bcad56690b7",
    ),
    (
        "https://github.com/jjimmykang/bwsi-backprojection",
        "440e21f90e2a1d0d1c28bfd9a0faaf97129378a5",
    ),
)
RAIL = "raw_code/pulson440"
TRIAL_6 = "backprojection/pulson440/rail_sar_test/trial_6"
SPEED_OF_LIGHT_MPS = 299_792_458.0
HEADER_BYTES, PACKET_BYTES, SAMPLES_AT = 32, 1452, 52
UNIT_PS = 1e6 / 2**19  # of the sampling interval
ZERO_S = 10e-9  # when a pulse is sent, on the clock of scan_start_ps
RANGE_OFFSET_M = 0.31  # by focusing trials a and b, each alone: 0.318 and 0.303
MARGIN_NS = 1_000_000_000  # poses are kept from so long before the first scan to after the last
FIRST_ROW = 7  # of poses in a CSV file; rows 2 and 3 have kinds and names


@dataclass(frozen=True, slots=True, kw_only=True)
class Corner:
    """A corner reflector: where its markers are recorded, and its apex [m]."""

    name: str
    markers: str  # rigid body "Corner Reflector" of a CSV file, or a pickled list of positions
    apex_m: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """What one file is made of."""

    repository: int
    radar: str
    poses: str
    body: str
    clock_offset_ns: int
    corners: tuple[Corner, ...]
    area_m: tuple[tuple[float, float], tuple[float, float]]  # x and y of the picture


CORNER_CSV = f"{RAIL}/Corner Reflector Localtion.csv"
SOURCES = {
    "p440_rail_2019-07-23_a": Source(
        repository=0,
        radar=f"{RAIL}/July23_03.out",
        poses=f"{RAIL}/Rail SAR 2.csv",
        body="Radar",
        clock_offset_ns=4_489_147_369,
        corners=(Corner(name="corner", markers=CORNER_CSV, apex_m=(-0.8943, 1.1516)),),
        area_m=((-3.17, 3.33), (-2.2, 5.8)),
    ),
    "p440_rail_2019-07-23_b": Source(
        repository=0,
        radar=f"{RAIL}/July23_04.out",
        poses=f"{RAIL}/Rail SAR 3.csv",
        body="Radar",
        clock_offset_ns=7_443_698_098,
        corners=(Corner(name="corner", markers=CORNER_CSV, apex_m=(-0.8933, 1.1499)),),
        area_m=((-3.17, 3.33), (-2.1, 5.9)),
    ),
    "p440_rail_2019-07-24": Source(
        repository=1,
        radar=f"{TRIAL_6}/scan_2105627.txt",
        poses=f"{TRIAL_6}/group6_trial_008.csv",
        body="radar_group6",
        clock_offset_ns=9_274_879_410,
        corners=(
            Corner(name="left", markers=f"{TRIAL_6}/reflector_1.pkl", apex_m=(2.3374, 4.0125)),
            Corner(name="right", markers=f"{TRIAL_6}/reflector_2.pkl", apex_m=(2.3636, -1.1854)),
        ),
        area_m=((-3.07, 3.43), (-2.97, 5.03)),
    ),
}


class PlainUnpickler(pickle.Unpickler):
    """Reads lists, tuples and numbers: a pickled file from elsewhere may run code otherwise."""

    def find_class(self, module_name: str, global_name: str, /) -> Any:  # noqa: ANN401 - its type
        raise pickle.UnpicklingError(f"holds {module_name}.{global_name}")


def read_scans(path: Path) -> tuple[NDArray[np.int32], Stamps, dict[str, int]]:
    """Return whole scans (n, bins), the stamps of all [ms], and settings."""
    content = path.read_bytes()
    _, start_ps, _, resolution, pii, *_, channel, _ = struct.unpack(
        ">IiiHH4H4BBBBB", content[:HEADER_BYTES]
    )
    n_packets = (len(content) - HEADER_BYTES) // PACKET_BYTES
    packets = np.frombuffer(content, np.uint8, n_packets * PACKET_BYTES, HEADER_BYTES)
    packets = packets.reshape(n_packets, PACKET_BYTES)

    def field(at: int, kind: str) -> Stamps:
        width = np.dtype(kind).itemsize
        return packets[:, at : at + width].copy().view(kind)[:, 0].astype(np.int64)

    n_bins, per_scan = int(field(44, ">u4")[0]), int(field(50, ">u2")[0])
    if not np.array_equal(field(48, ">u2"), np.arange(n_packets) % per_scan):
        raise SystemExit(f"{path}: a packet is missing; get the file anew")
    whole = packets[: n_packets // per_scan * per_scan, SAMPLES_AT:].copy().view(">i4")
    # All packets of a scan but its last are full.
    samples = whole.reshape(len(whole) // per_scan, -1)[:, :n_bins].astype(np.int32)
    settings = {"scan_start_ps": start_ps, "resolution": resolution, "pii": pii}
    return samples, field(8, ">u4")[::per_scan], settings | {"code_channel": channel}


def read_body(path: Path, name: str) -> tuple[Stamps, Array, Array, str]:
    """Return times [ns], positions, quaternions (x, y, z, w) of a rigid body, and the start."""
    with path.open(newline="", encoding="utf-8-sig") as opened:
        rows = list(csv.reader(opened))
    columns = [i for i, kind in enumerate(rows[2]) if kind == "Rigid Body" and rows[3][i] == name]
    seen = [row for row in rows[FIRST_ROW:] if all(row[i] for i in columns)]
    values = np.array([[float(row[i]) for i in columns] for row in seen])
    t_ns = np.round(np.array([float(row[1]) for row in seen]) * 1e9).astype(np.int64)
    start = rows[0][rows[0].index("Capture Start Time") + 1]
    turns = np.column_stack([z_up(values[:, :3]), values[:, 3]]) * np.sign(values[:, 3:4])
    return t_ns, z_up(values[:, 4:7]), turns, start


def z_up(vectors: Array) -> Array:
    """Return vectors (n, 3) of motion capture, y up, with z up."""
    return np.column_stack([vectors[:, 0], -vectors[:, 2], vectors[:, 1]])


def marker_m(path: Path) -> Array:
    """Return the mean position of a reflector's markers, (3,)."""
    if path.suffix == ".csv":
        return np.asarray(read_body(path, "Corner Reflector")[1].mean(axis=0))
    with path.open("rb") as opened:
        listed = PlainUnpickler(opened).load()  # of ((x, z, y), time)
    places = np.array([place for place, _ in listed], dtype=np.float64)
    return np.asarray(z_up(places[:, [0, 2, 1]][np.isfinite(places).all(axis=1)]).mean(axis=0))


def arrays_of(source: Source, repository: Path) -> dict[str, Array | NDArray[Any]]:
    """Return the arrays of a file; the meaning of each is in the head of the benchmark's reader."""
    samples, stamps_ms, settings = read_scans(repository / source.radar)
    number = np.arange(len(stamps_ms))
    line = np.polyfit(number, 1e6 * (stamps_ms - stamps_ms[0]), 1)
    t_ns = np.round(np.polyval(line, number)).astype(np.int64)[: len(samples)]
    pose_t_ns, pose_m, turns, start = read_body(repository / source.poses, source.body)
    begin, end = t_ns[[0, -1]] + source.clock_offset_ns + [-MARGIN_NS, MARGIN_NS]
    kept = (pose_t_ns >= begin) & (pose_t_ns <= end)
    markers = np.array([marker_m(repository / each.markers) for each in source.corners])
    apexes = np.array([each.apex_m for each in source.corners])
    start_s, bin_ps = settings["scan_start_ps"] * 1e-12, settings.pop("resolution") * UNIT_PS
    url, commit = REPOSITORIES[source.repository]
    meta = {
        "radar": "Time Domain PulsON 440 (impulse UWB, 3.1-4.8 GHz), monostatic, two antennas",
        **settings,
        "bin_ps": bin_ps,
        "range_offset_m": RANGE_OFFSET_M,
        "clock_offset_ns": source.clock_offset_ns,
        "lever_m": [0.0, 0.0, 0.0],  # attitude is constant: an arm cannot be told from the apex
        "reflectors": [{"name": each.name} for each in source.corners],
        "use": {"least_speed_mps": 0.05, "background_box_m": source.area_m},
        "source": {
            "repository": url,
            "commit": commit,
            "radar_file": source.radar,
            "pose_file": source.poses,
            "mocap_start": start,
        },
        "licence": "MIT",
        "licence_text": (repository / "LICENSE").read_text(encoding="utf-8"),
    }
    return {
        "samples": samples,
        "t_ns": t_ns,
        "stamp_ms": stamps_ms[: len(samples)],
        "range_start_m": np.array(SPEED_OF_LIGHT_MPS * (start_s - ZERO_S) / 2),
        "bin_length_m": np.array(SPEED_OF_LIGHT_MPS / 2 * (bin_ps / 1e3 * 1e-9)),
        "pose_t_ns": pose_t_ns[kept],
        "pose_m": pose_m[kept].astype(np.float32),
        "pose_xyzw": turns[kept].astype(np.float32),
        "reflector_marker_m": markers,
        "reflector_apex_m": np.column_stack([apexes, markers[:, 2]]),
        "meta": np.array(json.dumps(meta)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bwsiuassar2019", type=Path, help="folder of the first repository")
    parser.add_argument("bwsi_backprojection", type=Path, help="folder of the second")
    parser.add_argument("--out", type=Path, default=Path("data/p440"), help="folder to write to")
    given = parser.parse_args()
    repositories = (given.bwsiuassar2019, given.bwsi_backprojection)
    for source in SOURCES.values():
        for file in (source.radar, source.poses, "LICENSE", *(c.markers for c in source.corners)):
            if not (path := repositories[source.repository] / file).is_file():
                parser.error(f"{path} is not there; clone {REPOSITORIES[source.repository][0]}")
    given.out.mkdir(parents=True, exist_ok=True)
    for name, source in SOURCES.items():
        arrays = arrays_of(source, repositories[source.repository])
        np.savez_compressed(given.out / f"{name}.npz", **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
