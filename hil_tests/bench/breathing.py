"""Measure breathing rates of emulated people: who is where and does what, and what is answered.

``python -m hil_tests.bench.breathing`` writes `fixtures/baselines/breathing.json`, from which
`hil_tests.architecture.pages.breathing` makes the tables of `docs/breathing.md`. Each window of
60 s is a scene of its own, drawn from its number: the room (empty, with walls or with furniture),
the person's place, size, breath and heart, and the noise. The numbers from 10 000 on are measured;
smaller ones were looked at while the rules of `xethru_protocol.processing.vital` were chosen.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.chip.chip import Chip
from emulator.echo.echo import echo_source
from emulator.scene.motion import MoverSpec
from emulator.scene.people import PersonSpec, ShiftsSpec, mean_breathing_rate_per_min
from emulator.scene.scene import (
    ClutterSpec,
    JitterSpec,
    Scene,
    TargetSpec,
    WallSpec,
    empty_room,
)
from hil_tests.paths import FIXTURES
from xethru_protocol.processing.downconversion import downconvert, line_bins
from xethru_protocol.processing.vital import Breathing, breathing_rate
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.messages import X4Value

Job = Callable[[], "Case"]

BASELINE = FIXTURES / "baselines" / "breathing.json"
FIRST_MEASURED = 10_000
WINDOW_S = 60.0
ERROR_BPM = 0.5
RANGES_M = (0.5, 1.0, 2.0, 3.0, 4.0)
POSTURES = ("facing", "side", "back", "supine", "on a side")
FALSE_ALARMS = ("empty room", "fan", "curtain", "walking", "fast fan")
_SWINGS = {
    "fan": ((1.0, 8.0), (0.001, 0.01)),
    "fast fan": ((9.0, 40.0), (0.001, 0.01)),
    "curtain": ((0.03, 0.09), (0.005, 0.05)),
}
"""Frequency [Hz] and swing [m], each between two numbers. A fast fan is above half of the frame
rate: what it appears as can lie anywhere."""
FRAME_RATE_HZ = x4.real_frame_rate(17.0)

SETTINGS: dict[X4Setting, X4Value] = {
    X4Setting.DACMIN: 949,
    X4Setting.DACMAX: 1100,
    X4Setting.ITERATIONS: 16,
    X4Setting.PULSESPERSTEP: 300,
    X4Setting.DOWNCONVERSION: 1,
    X4Setting.FRAMEAREA: (0.2, 5.0),
    X4Setting.FPS: 17.0,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One window: a scene and when its frames begin.

    Attributes
    ----------
    rate_bpm
        The true mean over the window; None if nobody breathes at rest.
    range_m
        Where the person is, true metres.
    """

    scene: Scene
    seed: int
    start_ns: int
    rate_bpm: float | None = None
    range_m: float | None = None


def frames_of(
    scene: Scene, seed: int, start_ns: int = 0, *, seconds: float = WINDOW_S, **changes: X4Value
) -> tuple[NDArray[np.float32], x4.FrameArea]:
    """Return the values of the frames of a scene's first radar, and their area.

    ``changes`` are settings by name, in lower case.
    """
    chip = Chip(echo_source(scene, 0, seed))
    changed = {X4Setting[name.upper()]: value for name, value in changes.items()}
    for setting, value in (SETTINGS | changed).items():
        chip.set(setting, value)
    chip.timeline.pause_until(start_ns)
    count = math.ceil(seconds * FRAME_RATE_HZ)
    return np.array([chip.next_frame().values for _ in range(count)]), chip.area


def baseband_of(
    scene: Scene, seed: int, start_ns: int = 0, *, seconds: float = WINDOW_S, rf: bool = False
) -> tuple[NDArray[np.complex64], NDArray[np.float64]]:
    """Return complex frames and their ranges [module metres]; with ``rf``, downconverted here."""
    values, area = frames_of(scene, seed, start_ns, seconds=seconds, downconversion=int(not rf))
    bins = np.arange(area.n_bins)
    ranges_m: NDArray[np.float64] = np.asarray(area.start_m + bins * area.bin_length_m)
    if rf:
        return downconvert(values), ranges_m[line_bins(area.n_bins)]
    return (values[:, : area.n_bins] + 1j * values[:, area.n_bins :]).astype(np.complex64), ranges_m


# --- scenes


def room(rng: np.random.Generator, **contents: object) -> Scene:
    """Return an empty room, one of three walls, or one with furniture, and what is in it."""
    walls: tuple[WallSpec, ...] = ()
    targets: tuple[TargetSpec, ...] = ()
    kind = rng.integers(3)
    if kind == 1:
        back, left, right = rng.uniform(4.3, 4.9), rng.uniform(1.2, 2.5), -rng.uniform(1.2, 2.5)
        walls = (
            WallSpec(name="back", from_m=(back, right), to_m=(back, left)),
            WallSpec(name="left", from_m=(-0.5, left), to_m=(back, left)),
            WallSpec(name="right", from_m=(-0.5, right), to_m=(back, right)),
        )
    elif kind == 2:
        targets = tuple(
            TargetSpec(
                name=f"thing_{number}",
                kind="rod" if rng.random() < 0.5 else "point",
                x_m=float(rng.uniform(0.4, 4.8)),
                y_m=float(rng.uniform(-1.5, 1.5)),
                amplitude_1m=float(rng.uniform(0.005, 0.05)),
            )
            for number in range(int(rng.integers(2, 7)))
        )
    recorded = {
        # as in the shipped scenes: of a recording of a real module
        "clutter": ClutterSpec(sigma=2.25e-4),
        "jitter": JitterSpec(white_rad=0.0056, slow_rad=0.032),
    }
    return empty_room().model_copy(
        update={"walls": walls, "targets": targets, **recorded, **contents}
    )


def somebody(rng: np.random.Generator, **changes: object) -> PersonSpec:
    """Return a person of random size, breath and heart."""
    return PersonSpec.model_validate(
        {
            "name": f"person_{rng.integers(1_000_000)}",
            "rcs_m2": rng.uniform(0.5, 1.0),
            "breaths_per_min": rng.uniform(8, 26),
            "breath_amplitude_m": rng.uniform(0.002, 0.006),
            "breath_pattern": rng.choice(["sine", "realistic"]),
            "rate_wander": rng.uniform(0, 0.1),
            "heartbeats_per_min": rng.uniform(50, 90),
            "heart_amplitude_m": rng.uniform(0.0001, 0.0005),
        }
        | changes
    )


def at_rest(number: int, range_m: float, posture: str, *, shifts_per_min: float = 0.0) -> Case:
    """Return a person within 5 cm of a range and 20 degrees of boresight."""
    rng = np.random.default_rng([number, round(10 * range_m), POSTURES.index(posture)])
    true_range_m = range_m + rng.uniform(-0.05, 0.05)
    bearing_rad = math.radians(rng.uniform(-20, 20))
    lies = posture in ("supine", "on a side")
    towards_deg = math.degrees(bearing_rad) + 180
    turned_deg = {"side": 90 * rng.choice([-1, 1]), "back": 180}.get(posture, 0)
    person = somebody(
        rng,
        waypoints_m=((true_range_m * math.cos(bearing_rad), true_range_m * math.sin(bearing_rad)),),
        posture={"supine": "supine", "on a side": "side"}.get(posture, "upright"),
        facing_deg=(towards_deg + turned_deg + (rng.uniform(-180, 180) if lies else 0)) % 360 - 180,
        shifts=ShiftsSpec(per_min=shifts_per_min, size_m=0.06) if shifts_per_min else None,
    )
    start_ns = int(rng.uniform(0, 600) * 1e9)
    end_ns = np.array([start_ns + round(WINDOW_S * 1e9)])
    truth = mean_breathing_rate_per_min(person, end_ns, WINDOW_S, number)
    return Case(
        scene=room(rng, people=(person,)),
        seed=number,
        start_ns=start_ns,
        rate_bpm=float(truth[0]),
        range_m=true_range_m,
    )


def nobody_at_rest(number: int, kind: str) -> Case:
    """Return a window to which every answer is false."""
    rng = np.random.default_rng([number, 100 + FALSE_ALARMS.index(kind)])
    contents: dict[str, object] = {}
    if kind == "walking":
        places = [
            (rng.uniform(0.8, 4.2), rng.uniform(-1.5, 1.5)) for _ in range(rng.integers(2, 6))
        ]
        contents["people"] = (
            somebody(
                rng,
                waypoints_m=places,
                speed_mps=rng.uniform(0.2, 1.4),
                walk=rng.choice(["to_and_fro", "round"]),
            ),
        )
    elif kind in _SWINGS:
        contents["movers"] = (
            MoverSpec(
                name=f"mover_{rng.integers(1_000_000)}",
                x_m=float(rng.uniform(0.5, 4.0)),
                y_m=float(rng.uniform(-1, 1)),
                rate_hz=float(rng.uniform(*_SWINGS[kind][0])),
                swing_m=float(rng.uniform(*_SWINGS[kind][1])),
                direction_deg=float(rng.uniform(-180, 180)),
                amplitude_1m=float(rng.uniform(0.005, 0.05)),
                fading=float(rng.uniform(0, 0.5)),
            ),
        )
    return Case(scene=room(rng, **contents), seed=number, start_ns=int(rng.uniform(0, 600) * 1e9))


def answer(case: Case, *, rf: bool = False) -> Breathing | None:
    iq, ranges_m = baseband_of(case.scene, case.seed, case.start_ns, rf=rf)
    return breathing_rate(iq, ranges_m, FRAME_RATE_HZ)


# --- measured


def jobs(rest: int, nobody: int, first: int) -> Iterator[tuple[str, str, float | None, Job]]:
    """Yield row, column, range and what makes the case of each window."""
    for range_m in RANGES_M:
        for number in range(first, first + rest):
            for posture in POSTURES:
                yield "rest", posture, range_m, partial(at_rest, number, range_m, posture)
            fidgets = partial(at_rest, number, range_m, "facing", shifts_per_min=2.0)
            yield "fidgets", "facing", range_m, fidgets
            yield "rf", "facing", range_m, partial(at_rest, number, range_m, "facing")
    for kind in FALSE_ALARMS:
        for number in range(first, first + nobody):
            yield "nobody", kind, None, partial(nobody_at_rest, number, kind)


def outcome(job: tuple[str, str, float | None, Job]) -> str:
    """Return whether the answer is right, wrong or none."""
    row, _, _, make = job
    case = make()
    found = answer(case, rf=row == "rf")
    if found is None:
        return "none"
    if case.rate_bpm is None or abs(found.rate_bpm - case.rate_bpm) > ERROR_BPM:
        return "wrong"
    return "right"


def measure(rest: int, nobody: int, first: int, processes: int) -> list[dict[str, Any]]:
    """Return a cell for each row, column and range, with its counts of outcomes."""
    todo = list(jobs(rest, nobody, first))
    cells: dict[tuple[str, str, float | None], dict[str, int]] = {}
    with ProcessPoolExecutor(processes) as pool:
        for job, found in zip(todo, pool.map(outcome, todo, chunksize=8), strict=True):
            counts = cells.setdefault(job[:3], dict.fromkeys(("right", "wrong", "none"), 0))
            counts[found] += 1
    return [
        {"row": row, "column": column, "range_m": range_m, **counts}
        for (row, column, range_m), counts in cells.items()
    ]


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rest", type=int, default=40, help="windows per range and posture")
    parser.add_argument("--nobody", type=int, default=300, help="windows of each kind")
    parser.add_argument("--first", type=int, default=FIRST_MEASURED, help="number of the first")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--out", type=Path, default=BASELINE)
    chosen = parser.parse_args(argv)
    cells = measure(chosen.rest, chosen.nobody, chosen.first, chosen.jobs)
    found = {"first": chosen.first, "window_s": WINDOW_S, "error_bpm": ERROR_BPM, "cells": cells}
    chosen.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
