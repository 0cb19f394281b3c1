"""`docs/studies/p440_npz.py` on files written by their formats: every array is what went in."""

import csv
import json
import pickle
import struct
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.paths import study

p440_npz = study("p440_npz")

SCANS, BINS = 40, 460  # 350 and 110 samples in the packets of a scan
PERIOD_MS = 21.5727
POSES = 2000


def write_radar(path: Path, samples: NDArray[np.int32]) -> None:
    """Write settings, all scans, and the first packet of one more."""
    content = struct.pack(">IiiHH8x4xBBBB", 1, 16670, 86982, 32, 11, 2, 63, 6, 0)
    for scan, row in enumerate([*samples, samples[0]]):
        stamp = 1000 + int(scan * PERIOD_MS)
        for index, part in enumerate((row[:350], row[350:])):
            head = struct.pack(">HHII30xHIHH", 0xF201, scan, 1, stamp, len(part), BINS, index, 2)
            content += head + part.astype(">i4").tobytes().ljust(1400, b"\0")
            if scan == len(samples):
                break
    path.write_bytes(content)


def write_bodies(path: Path, bodies: dict[str, NDArray[np.float64]]) -> None:
    """Write rigid bodies of x, y, z, w and x, y, z as OptiTrack does; one pose is not seen."""
    names = [name for name in bodies for _ in range(7)]
    with path.open("w", newline="", encoding="utf-8") as opened:
        writer = csv.writer(opened)
        writer.writerow(["Format Version", "1.23", "Capture Start Time", "2019-07-23 04.54 PM"])
        writer.writerow([])
        writer.writerow(["", "Type", *["Rigid Body"] * len(names), "Marker"])
        writer.writerow(["", "Name", *names, f"{names[0]}:Marker1"])
        for _ in range(3):
            writer.writerow([""] * (len(names) + 3))
        for i in range(POSES):
            values = [f"{value:.6f}" for body in bodies.values() for value in body[i]]
            seen = values if i != 7 else [""] * len(values)
            writer.writerow([i, f"{i / 360:.6f}", *seen, "9.9"])


@pytest.fixture
def repositories(tmp_path: Path) -> tuple[Path, Path]:
    """Return look-alikes of both repositories, whose trials are all the same."""
    samples = np.arange(SCANS * BINS, dtype=np.int32).reshape(SCANS, BINS) ** 2 % 7919 - 4000
    way = np.arange(POSES) / 360
    turns = np.tile([0.0, -0.6, 0.0, -0.8], (POSES, 1))
    radar = np.column_stack([turns, -5.0 + 0 * way, 1.8 + 0 * way, -0.3 * way])
    corner = np.column_stack([turns, np.tile([-1.0, 0.067, -1.15], (POSES, 1))])
    places = (tmp_path / "one", tmp_path / "two")
    for source in p440_npz.SOURCES.values():
        folder = places[source.repository]
        for file in (source.radar, source.poses, *(each.markers for each in source.corners)):
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
        write_radar(folder / source.radar, samples)
        write_bodies(folder / source.poses, {source.body: radar, "Corner Reflector": corner})
        for each in source.corners:
            if each.markers.endswith(".pkl"):
                listed = [
                    ((2.0, -3.8, 0.1), 0.0),
                    ((float("nan"),) * 3, 0.1),
                    ((2.2, -3.6, 0.3), 0.2),
                ]
                (folder / each.markers).write_bytes(pickle.dumps(listed))
            else:
                write_bodies(folder / each.markers, {"Corner Reflector": corner})
        (folder / "LICENSE").write_text("MIT License", encoding="ascii")
    return places


def test_samples_poses_and_reflectors_are_those_of_the_files(
    repositories: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The files are shorter than those of the course; a clock offset that fits
    for name, source in p440_npz.SOURCES.items():
        changed = replace(source, clock_offset_ns=2_000_000_000)
        monkeypatch.setitem(p440_npz.SOURCES, name, changed)
    monkeypatch.setattr(
        "sys.argv", ["p440_npz.py", *map(str, repositories), "--out", str(tmp_path)]
    )
    p440_npz.main()
    for name in p440_npz.SOURCES:
        made = {key: value for key, value in np.load(tmp_path / f"{name}.npz").items()}
        expected = np.arange(SCANS * BINS, dtype=np.int32).reshape(SCANS, BINS) ** 2 % 7919 - 4000
        np.testing.assert_array_equal(made["samples"], expected)
        # Stamps have whole milliseconds; the line through them is better than that.
        line_ms = np.arange(SCANS) * PERIOD_MS
        np.testing.assert_array_equal(made["stamp_ms"], 1000 + line_ms.astype(int))
        residual = made["t_ns"] * 1e-6 - line_ms
        assert np.ptp(residual) < 0.2
        # c / 2 (16.67 - 10) ns; 32 steps of 1.9 ps a bin
        assert made["range_start_m"] == pytest.approx(299_792_458 / 2 * 6.67e-9)
        assert made["bin_length_m"] == pytest.approx(299_792_458 / 2 * 32e-6 / 2**19)
        assert made["pose_t_ns"][0] >= made["t_ns"][0] + 1_000_000_000
        assert made["pose_t_ns"][-1] <= made["t_ns"][-1] + 3_000_000_000
        # y up became z up, and a quaternion has a positive w
        seconds = made["pose_t_ns"] * 1e-9
        np.testing.assert_allclose(made["pose_m"][:, 1], 0.3 * seconds, atol=1e-5)
        np.testing.assert_allclose(
            made["pose_m"][:, [0, 2]], [[-5.0, 1.8]] * len(seconds), atol=1e-6
        )
        np.testing.assert_allclose(made["pose_xyzw"][0], [0.0, 0.0, 0.6, 0.8], atol=1e-7)
        marker = [2.1, 3.7, 0.2] if "24" in name else [-1.0, 1.15, 0.067]
        np.testing.assert_allclose(made["reflector_marker_m"][0], marker, atol=1e-9)
        meta = json.loads(str(made["meta"]))
        assert meta["licence_text"] == "MIT License"
        assert (meta["bin_ps"], meta["pii"], meta["code_channel"]) == (61.03515625, 11, 6)


def test_a_lost_packet_and_a_pickle_that_would_run_code_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "radar"
    write_radar(path, np.zeros((3, BINS), dtype=np.int32))
    content = path.read_bytes()
    path.write_bytes(content[: 32 + 1452] + content[32 + 2 * 1452 :])
    with pytest.raises(SystemExit, match="packet"):
        p440_npz.read_scans(path)
    markers: Any = tmp_path / "markers.pkl"
    markers.write_bytes(pickle.dumps(OrderedDict()))
    with pytest.raises(pickle.UnpicklingError):
        p440_npz.marker_m(markers)
