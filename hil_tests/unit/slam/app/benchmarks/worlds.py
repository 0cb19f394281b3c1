"""A small simulated drive, written in the format of each data set. No real data are used.

A robot drives circles among landmarks; its velocities are known at 10 Hz, the wheels err by 3 % in
distance and in turn. What it sees at 5 Hz has noise.
"""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PERIOD_S = 0.1
RADIUS_M, SPEED_MPS = 2.0, 0.5
SCALE = 1.03  # reported over true
RANGE_SIGMA_M, BEARING_SIGMA_RAD = 0.05, 0.01
LANDMARKS_M = np.array([[3.5, 0.0], [0.0, 3.5], [-3.5, 0.5], [0.5, -3.5], [2.8, 2.8]])
BEACONS_M = np.array([[4.0, 4.0], [-4.0, 4.0], [-4.0, -4.0], [4.0, -4.5]])


def times_s(duration_s: float) -> Array:
    return np.arange(round(duration_s / PERIOD_S) + 1, dtype=np.float64) * PERIOD_S


def true_poses(t_s: Array, *, scale: float = 1.0) -> Array:
    """Return poses on the circle, (n, 3); begins at (R, 0), heading along +y."""
    angle = scale * SPEED_MPS * t_s / RADIUS_M
    xy = scale * RADIUS_M * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.column_stack([xy, angle + math.pi / 2])


def seen_from(
    pose: Array, landmarks_m: Array, rng: np.random.Generator, *, scale: float = 1.0
) -> list[tuple[int, float, float]]:
    """Return number, range and bearing of the landmarks within 4 m (scaled) and 60 deg."""
    seen = []
    for number, place in enumerate(scale * landmarks_m):
        away = place - pose[:2]
        range_m = math.hypot(*away)
        bearing = math.remainder(math.atan2(away[1], away[0]) - pose[2], math.tau)
        if range_m < 4.0 * scale and abs(bearing) < math.radians(60.0):
            noisy_m = range_m + scale * RANGE_SIGMA_M * rng.standard_normal()
            seen.append((number, noisy_m, bearing + BEARING_SIGMA_RAD * rng.standard_normal()))
    return seen


def write_rows(path: Path, rows: list[list[str]], *, comment: str | None = None) -> None:
    head = [] if comment is None else [f"# {comment}"]
    path.write_text("\n".join([*head, *map(" ".join, rows)]) + "\n", encoding="ascii")


def write_mrclam(folder: Path, *, duration_s: float = 40.0, robots: int = 1) -> Path:
    """Write a folder MRCLAM_Dataset1; barcodes are ten times the subject's number."""
    here = folder / "MRCLAM_Dataset1"
    here.mkdir(parents=True)
    subjects = range(1, 6 + len(LANDMARKS_M))
    write_rows(here / "Barcodes.dat", [[str(n), str(10 * n)] for n in subjects], comment="Subject")
    write_rows(
        here / "Landmark_Groundtruth.dat",
        [[str(6 + n), f"{x}", f"{y}", "0.001", "0.001"] for n, (x, y) in enumerate(LANDMARKS_M)],
        comment="Landmark",
    )
    t_s = times_s(duration_s)
    poses = true_poses(t_s)
    for robot in range(1, robots + 1):
        rng = np.random.default_rng(robot)
        stamp = [f"{1248272272 + t:.3f}" for t in t_s.tolist()]
        turn = SCALE * SPEED_MPS / RADIUS_M
        write_rows(
            here / f"Robot{robot}_Odometry.dat",
            [[s, f"{SCALE * SPEED_MPS:.4f}", f"{turn:.4f}"] for s in stamp],
            comment="Odometry",
        )
        write_rows(
            here / f"Robot{robot}_Groundtruth.dat",
            [[s, *(f"{v:.6f}" for v in p)] for s, p in zip(stamp, poses.tolist(), strict=True)],
            comment="Groundtruth",
        )
        rows = [[stamp[0], "20", "1.0", "0.1"]]  # another robot
        for s, pose in zip(stamp[::2], poses[::2], strict=True):
            for number, range_m, bearing in seen_from(pose, LANDMARKS_M, rng):
                rows.append([s, str(10 * (6 + number)), f"{range_m:.3f}", f"{bearing:.3f}"])
        write_rows(here / f"Robot{robot}_Measurement.dat", rows, comment="Measurement")
    return folder


def write_victoria_park(
    folder: Path, *, duration_s: float = 30.0, with_graph: bool = False
) -> Path:
    """Write a car whose rear axle drives a circle of 20 m, among trees ten times as far apart.

    Axle and laser are placed by hand, so the reader's model of the car has something to agree with.
    ``with_graph`` adds the drive as GTSAM has it: every fifth scan, poses of the axle, ids that
    poses and trees share, no times.
    """
    wheelbase_m, h_m, a_m, b_m = 2.83, 0.76, 3.78, 0.50
    axle_radius_m, axle_mps = 20.0, 5.0
    steering = math.atan(wheelbase_m / axle_radius_m)
    wheel_mps = axle_mps * (1.0 - math.tan(steering) * h_m / wheelbase_m)
    t_s = times_s(duration_s)
    turned = axle_mps / axle_radius_m * t_s
    heading = turned + math.pi / 2
    axle = axle_radius_m * np.column_stack([np.cos(turned), np.sin(turned)])
    c, s = np.cos(heading), np.sin(heading)
    laser = axle + np.column_stack([a_m * c - b_m * s, a_m * s + b_m * c])
    poses = np.column_stack([laser, heading])
    rng = np.random.default_rng(1)
    folder.mkdir(parents=True, exist_ok=True)
    write_rows(
        folder / "inputs.dat",
        [[f"{t:.3f}", f"{SCALE * wheel_mps:.4f}", f"{steering:.5f}"] for t in t_s.tolist()],
    )
    write_rows(
        folder / "gps.dat",
        [[f"{t:.3f}", f"{x:.3f}", f"{y:.3f}"] for t, (x, y) in zip(t_s, laser, strict=True)],
    )
    rows, graph = [], []
    turn = SCALE * axle_mps / axle_radius_m * PERIOD_S
    chord_m = 2.0 * axle_radius_m * math.sin(5.0 * turn / 2)
    step = [chord_m * math.cos(5.0 * turn / 2), chord_m * math.sin(5.0 * turn / 2), 5.0 * turn]
    for n, (t, pose) in enumerate(zip(t_s.tolist(), poses, strict=True)):
        here = 100 + n
        if n % 5 == 0 and n:
            graph.append(["ODOMETRY", str(here - 5), str(here), *map(repr, step), *["1"] * 6])
        if n % 2:
            continue
        for tree, range_m, bearing in seen_from(pose, LANDMARKS_M, rng, scale=10.0):
            rows.append([f"{t:.3f}", f"{range_m:.4f}", f"{bearing + math.pi / 2:.5f}", "0.4"])
            if n % 5 == 0 and n:
                x_m = a_m + range_m * math.cos(bearing)
                y_m = b_m + range_m * math.sin(bearing)
                graph.append(
                    ["LANDMARK", str(here), str(tree), repr(x_m), repr(y_m), "1", "0", "1"]
                )
    write_rows(folder / "measurements.dat", rows)
    if with_graph:
        write_rows(folder / "victoria_park.txt", graph)
    return folder


def write_pyfg_file(path: Path, *, duration_s: float = 60.0) -> Path:
    """Write a graph with ranges to four beacons, asked in turn."""
    t_s = times_s(duration_s)
    poses = true_poses(t_s)
    rng = np.random.default_rng(2)
    angle = SCALE * SPEED_MPS / RADIUS_M * PERIOD_S
    way_m = SCALE * 2.0 * RADIUS_M * math.sin(SPEED_MPS * PERIOD_S / RADIUS_M / 2)  # the chord
    step = [way_m * math.cos(angle / 2), way_m * math.sin(angle / 2), angle]
    lines = [
        f"VERTEX_SE2 {100 + t:.9f} A{n} {x!r} {y!r} {heading!r}"
        for n, (t, (x, y, heading)) in enumerate(zip(t_s.tolist(), poses.tolist(), strict=True))
    ]
    lines += [f"VERTEX_XY L{n} {x!r} {y!r}" for n, (x, y) in enumerate(BEACONS_M.tolist())]
    numbers = " ".join(map(repr, step))
    for n, t in enumerate(t_s.tolist()):
        if n:
            triangle = "0.0001 0.0 0.0 0.0001 0.0 1e-06"
            lines.append(f"EDGE_SE2 {100 + t:.9f} A{n - 1} A{n} {numbers} {triangle}")
        asked = n % len(BEACONS_M)
        range_m = math.dist(poses[n, :2], BEACONS_M[asked]) + RANGE_SIGMA_M * rng.standard_normal()
        lines.append(f"EDGE_RANGE {100 + t:.9f} A{n} L{asked} {range_m!r} {RANGE_SIGMA_M**2!r}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return path


def write_librsf(folder: Path, *, duration_s: float = 60.0) -> Path:
    """Write Small_Input.txt and Small_GT.txt; half the track is 0.08 m."""
    half_m = 0.08
    turn = SPEED_MPS / RADIUS_M
    wheels = [SCALE * (SPEED_MPS - half_m * turn), SCALE * (SPEED_MPS + half_m * turn)]
    t_s = times_s(duration_s)
    poses = true_poses(t_s)
    rng = np.random.default_rng(3)
    lines, truth = [], []
    for n, t in enumerate(t_s.tolist()):
        x, y = poses[n, :2].tolist()
        truth.append(["point2", f"{t:.9f}", repr(x), repr(y), "0", "0", "0", "0"])
        lines.append(
            ["odom2diff", f"{t:.9f}", *map(repr, wheels), "0", str(half_m), "1e-4", "1e-4", "1e-4"]
        )
        asked = n % len(BEACONS_M)
        range_m = math.dist((x, y), BEACONS_M[asked]) + RANGE_SIGMA_M * rng.standard_normal()
        place = map(repr, BEACONS_M[asked].tolist())
        lines.append(["range2", f"{t:.9f}", repr(range_m), "0.01", *place, str(105 + asked), "0"])
    folder.mkdir(parents=True, exist_ok=True)
    write_rows(folder / "Small_Input.txt", lines)
    write_rows(folder / "Small_GT.txt", truth)
    return folder
