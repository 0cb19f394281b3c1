"""Random rooms: families of scenes that differ in course, targets and rig, a room for each number.

``pillars:3`` names room 3 of the family ``pillars`` wherever a scene is named. They show what a
method does in rooms that it was not tuned for, so nothing about SLAM may be chosen by looking at
single ones. The same name gives the same room as long as NumPy keeps the streams of its generators.

The last six families deceive: things that look alike, bodies wider than a landmark, or next to
nothing. Rig, speed and, where it is free, the shape of the course are drawn, too.

A room is the tables of a scene file as plain values; `emulator.scene.scene` checks them. Lengths
are metres, angles degrees; the robot drives its closed course twice, with the lab's noise and, but
for ``sparse`` and ``yard``, the lab's wheels.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Values = dict[str, Any]
Point = Sequence[float] | NDArray[np.float64]
Course = list[tuple[float, float]]

MOST_ROOMS = 10_000
"""Of a family: numbers run from 0 to one less."""

_DIGITS = 4
_MOST_TRIES = 100_000

_WHEELS = {
    "scale_sigma": 0.007,
    "turn_scale_sigma": 0.007,
    "curvature_sigma_rad_per_m": 0.0042,
    "along_sigma_m_per_sqrt_m": 0.002,
    "across_sigma_m_per_sqrt_m": 0.0006,
    "heading_sigma_rad_per_sqrt_m": 0.0042,
    "heading_sigma_rad_per_rad": 0.01,
}
"""The lab's."""
_RIG = ((-0.1, 0.2, 90.0), (0.1, 0.2, 90.0), (-0.1, -0.2, -90.0), (0.1, -0.2, -90.0))
"""The paper's: place and yaw of each radar."""
_RIGS = (((0.0, 0.2, 90.0), (0.0, -0.2, -90.0)), (*_RIG[:2], (0.0, -0.2, -90.0)), _RIG)
"""Two, three and four radars: a side with one radar has no pair of ranges of one time."""
_SPEEDS_MPS = (0.05, 0.3)
_SENSORS: Values = {
    "noise": {"rf_sigma": 5e-4, "iterations": 16, "pulses_per_step": 300},
    "clutter": {"sigma": 2.25e-4, "correlation_s": 4.8},
    "jitter": {"white_rad": 0.0056, "slow_rad": 0.032, "slow_correlation_s": 4.0},
    "leakage": {"amplitude": 0.06, "range_m": 0.05},
}
"""The lab's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """What a family draws; everything else is the same in all of them."""

    way: Course
    targets: list[Values] = field(default_factory=list)
    walls: list[Values] = field(default_factory=list)
    objects: list[Values] = field(default_factory=list)
    people: list[Values] = field(default_factory=list)
    rig: Sequence[tuple[float, float, float]] = _RIG
    wheels_factor: float = 1.0  # on every standard deviation of the wheels
    speed_mps: float = 0.05


def _off_course_m(point: NDArray[np.float64], way: Course) -> float:
    """Return how far a point is from the nearest place of a closed course."""
    corners = np.array([*way, way[0]])
    nearest = math.inf
    for start, end in pairwise(corners):
        along = end - start
        part = np.clip((point - start) @ along / max(along @ along, 1e-12), 0.0, 1.0)
        nearest = min(nearest, float(np.hypot(*(point - start - part * along))))
    return nearest


def _beside(
    rng: np.random.Generator, count: int, way: Course, *, off: tuple[float, float], apart: float
) -> list[NDArray[np.float64]]:
    """Return up to ``count`` places within two distances from the course, apart from each other."""
    nearest, farthest = off
    low, high = np.min(way, axis=0) - farthest, np.max(way, axis=0) + farthest
    places: list[NDArray[np.float64]] = []
    for _ in range(_MOST_TRIES):
        if len(places) == count:
            break
        place = rng.uniform(low, high)
        free = all(float(np.hypot(*(place - other))) >= apart for other in places)
        if free and nearest <= _off_course_m(place, way) <= farthest:
            places.append(place)
    return places


def _rod(place: Point, amplitude: float = 0.015) -> Values:
    return {"kind": "rod", "x_m": place[0], "y_m": place[1], "amplitude_1m": amplitude}


def _rods(places: Sequence[Point]) -> list[Values]:
    return [_rod(place) for place in places]


def _rectangle(rng: np.random.Generator, shortest: float, longest: float) -> Course:
    width, depth = rng.uniform(shortest, longest, 2)
    return [(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth)]


def pillars(rng: np.random.Generator) -> Room:
    """18 round pillars of 0 to 15 cm radius along an L-shaped course."""
    length, depth = rng.uniform(3.2, 4.4), rng.uniform(3.0, 4.0)
    arm, foot = rng.uniform(1.4, 1.9), rng.uniform(1.4, 1.9)
    way = [(0.0, 0.0), (length, 0.0), (length, arm), (foot, arm), (foot, depth), (0.0, depth)]
    targets = []
    for place in _beside(rng, 18, way, off=(0.5, 1.15), apart=0.45):
        radius = float(rng.choice([0.0, 0.02, 0.05, 0.08, 0.12, 0.15]))
        target = _rod(place, rng.uniform(0.008, 0.03))
        targets.append(target | ({"kind": "cylinder", "radius_m": radius} if radius else {}))
    return Room(way=way, targets=targets)


def office(rng: np.random.Generator) -> Room:
    """Four walls, two or three desks, two or three chairs of four legs."""
    way = _rectangle(rng, 2.4, 3.6)
    width, depth = way[2]
    gap = rng.uniform(1.1, 1.5)
    left, right, front, back = -gap, width + gap, -gap, depth + gap
    corners = [(left, front), (right, front), (right, back), (left, back), (left, front)]
    walls = [
        {"from_m": start, "to_m": end, "amplitude_1m": 0.05, "transmission": 0.5}
        for start, end in pairwise(corners)
    ]
    most = 2 if width < 3 else 3
    desks = [
        {
            "x_m": width * part + rng.normal(0, 0.05),
            "y_m": depth / 2 + rng.normal(0, 0.1),
            "width_m": 0.8,
            "depth_m": 0.6,
            "yaw_deg": rng.uniform(-10, 10),
            "amplitude_1m": 0.03,
            "transmission": 0.7,
        }
        for part in np.linspace(0.3, 0.7, rng.integers(2, 4))[:most]
    ]
    legs = []
    for part in rng.permutation([0.2, 0.5, 0.8])[: rng.integers(2, 4)]:
        x, y = width * part, -rng.uniform(0.7, 0.8)
        legs += [_rod((x + i * 0.2, y + j * 0.2), 0.01) for i in (-1, 1) for j in (-1, 1)]
    return Room(way=way, targets=legs, walls=walls, objects=desks)


def dense(rng: np.random.Generator) -> Room:
    """About thirty rods 0.25 m apart, outside a square course."""
    side = rng.uniform(2.0, 2.4)
    targets = []
    for row in range(4):
        for number in range(9 - row):
            x, y = 0.25 * number + rng.normal(0, 0.03), -0.75 + rng.normal(0, 0.03)
            for _ in range(row):  # turned to the next side
                x, y = side - y, x
            targets.append(_rod((x, y)))
    return Room(way=[(0.0, 0.0), (side, 0.0), (side, side), (0.0, side)], targets=targets)


def loop(rng: np.random.Generator) -> Room:
    """25 rods along a long loop."""
    length, depth = rng.uniform(8, 11), rng.uniform(5, 7)
    way = [(0.0, 0.0), (length, 0.0), (length, depth), (0.0, depth)]
    return Room(way=way, targets=_rods(_beside(rng, 25, way, off=(0.5, 1.15), apart=0.7)))


def sparse(rng: np.random.Generator) -> Room:
    """Six rods, wheels three times as bad."""
    way = _rectangle(rng, 2.5, 4.0)
    rods = _rods(_beside(rng, 6, way, off=(0.5, 1.0), apart=1.2))
    return Room(way=way, targets=rods, wheels_factor=3.0)


def people(rng: np.random.Generator) -> Room:
    """Twelve rods, two walkers."""
    way = _rectangle(rng, 2.0, 2.8)
    width, depth = way[2]
    round_the_course: Course = [
        (-1.0, -0.7),
        (width + 1, -0.6),
        (width + 0.9, depth + 0.7),
        (-0.9, depth + 0.6),
    ]
    inside: Course = [(width / 2, 0.3 * depth), (width / 2, 0.7 * depth)]
    walkers: list[Values] = [
        {"waypoints_m": round_the_course, "speed_mps": 0.6, "walk": "round", "rcs_m2": 0.5},
        {"waypoints_m": inside, "speed_mps": 0.3, "walk": "to_and_fro", "rcs_m2": 0.5},
    ]
    rods = _rods(_beside(rng, 12, way, off=(0.55, 1.1), apart=0.4))
    return Room(way=way, targets=rods, people=walkers)


def rig(rng: np.random.Generator) -> Room:
    """14 rods; three to six radars at random places and angles, at least one to each side."""
    way = _rectangle(rng, 1.8, 2.4)
    left, right = rng.uniform(60, 120), rng.uniform(-120, -60)
    yaws = [left, right, *rng.uniform(-180, 180, rng.integers(1, 5))]
    mounts = [(rng.uniform(-0.2, 0.2), 0.2 * math.sin(math.radians(yaw)), yaw) for yaw in yaws]
    rods = _rods(_beside(rng, 14, way, off=(0.5, 1.1), apart=0.38))
    return Room(way=way, targets=rods, rig=mounts)


def _square(rng: np.random.Generator) -> Course:
    return _rectangle(rng, 2.4, 3.6)


def _circle(rng: np.random.Generator) -> Course:
    """Return 24 corners of a circle that begins along x."""
    step_m = rng.uniform(1.2, 1.8) * math.tau / 24
    way = [(0.0, 0.0)]
    for corner in range(23):
        (x, y), heading = way[-1], corner * math.tau / 24
        way.append((x + step_m * math.cos(heading), y + step_m * math.sin(heading)))
    return way


def _eight(rng: np.random.Generator) -> Course:
    """Return two squares that touch at the start, each driven round once, in opposite senses."""
    a = rng.uniform(1.8, 2.4)
    return [(0.0, 0.0), (a, 0.0), (a, a), (0.0, a), (0.0, -a), (-a, -a), (-a, 0.0)]


def _corridor(rng: np.random.Generator) -> Course:
    """Return a straight way, there and back."""
    return [(0.0, 0.0), (rng.uniform(4.0, 6.0), 0.0)]


def _course(rng: np.random.Generator) -> Course:
    shapes = (_square, _circle, _eight, _corridor)
    return shapes[int(rng.integers(len(shapes)))](rng)


def _drawn(rng: np.random.Generator) -> Values:
    """Return the rig and the speed of a room that leaves them free."""
    rig = _RIGS[int(rng.integers(len(_RIGS)))]
    return {"rig": rig, "speed_mps": float(rng.choice(_SPEEDS_MPS))}


def rack(rng: np.random.Generator) -> Room:
    """One to four aisles between rows of uprights at one pitch."""
    n_aisles, pitch = int(rng.integers(1, 5)), rng.uniform(0.5, 0.8)
    length, width, depth = rng.uniform(3.0, 5.0), rng.uniform(1.4, 2.0), rng.uniform(0.3, 0.6)
    way: Course = []
    for aisle in range(n_aisles):
        y = aisle * (width + depth)
        way += [(0.0, y), (length, y)] if aisle % 2 == 0 else [(length, y), (0.0, y)]
    if n_aisles % 2 and n_aisles > 1:  # back along the last aisle, not across the racks
        way.append((0.0, way[-1][1]))
    uprights = [
        (0.4 + number * pitch + rng.normal(0, 0.003), row + rng.normal(0, 0.003))
        for aisle in range(n_aisles)
        for row in (aisle * (width + depth) - width / 2, aisle * (width + depth) + width / 2)
        for number in range(int((length - 0.8) / pitch) + 1)
    ]
    return Room(way=way, targets=_rods(uprights), **_drawn(rng))


def doors(rng: np.random.Generator) -> Room:
    """Corridor with eight door frames, four to each side, there and back."""
    gap, pitch, opening = rng.uniform(0.8, 1.1), rng.uniform(1.6, 2.2), 0.9
    length = 4 * pitch
    frames, walls = [], []
    for y in (-gap, gap):
        ends = [-0.5]
        for number in range(4):
            middle = (number + 0.5) * pitch
            ends += [middle - opening / 2, middle + opening / 2]
            frames += [(middle - opening / 2, y), (middle + opening / 2, y)]
        ends.append(length + 0.5)
        walls += [
            {"from_m": (start, y), "to_m": (end, y), "amplitude_1m": 0.035}
            for start, end in zip(ends[::2], ends[1::2], strict=True)
        ]
    way = [(0.0, 0.0), (length, 0.0)]
    return Room(way=way, targets=_rods(frames), walls=walls, **_drawn(rng))


def legs(rng: np.random.Generator) -> Room:
    """Equal desks or chairs of four legs, in a row on either side of the course."""
    way = _rectangle(rng, 2.4, 3.6)
    width, depth = way[2]
    long, short = (1.2, 0.6) if rng.integers(2) else (0.4, 0.4)
    pitch, off = long + rng.uniform(0.3, 0.6), rng.uniform(0.5, 0.7)
    count = int(width / pitch) + 1
    places = [
        (number * pitch + along * long, y)
        for near, far in ((-off, -off - short), (depth + off, depth + off + short))
        for number in range(count)
        for along in (0, 1)
        for y in (near, far)
    ]
    return Room(way=way, targets=[_rod(place, 0.01) for place in places], **_drawn(rng))


def columns(rng: np.random.Generator) -> Room:
    """Up to nine columns of 5 to 40 cm radius."""
    way = _course(rng)
    targets = [
        _rod(place, rng.uniform(0.01, 0.03))
        | {"kind": "cylinder", "radius_m": rng.uniform(0.05, 0.4)}
        for place in _beside(rng, 9, way, off=(0.8, 1.3), apart=0.9)
    ]
    return Room(way=way, targets=targets, **_drawn(rng))


def yard(rng: np.random.Generator) -> Room:
    """No more than three rods, the lab's wheels or three times as bad ones."""
    way = [(3 * x, 3 * y) for x, y in _course(rng)]
    rods = _rods(_beside(rng, int(rng.integers(4)), way, off=(0.5, 1.4), apart=2.0))
    wheels_factor = float(rng.choice([1.0, 3.0]))
    drawn = _drawn(rng) | {"speed_mps": 0.3}  # the way is three times as long
    return Room(way=way, targets=rods, wheels_factor=wheels_factor, **drawn)


def twins(rng: np.random.Generator) -> Room:
    """Two equal rooms of eight rods, on one drive."""
    first = _rectangle(rng, 2.0, 2.8)
    apart = first[1][0] + rng.uniform(3.0, 4.0)
    second = [(x + apart, y) for x, y in first]
    way = [*first, (0.0, 0.0), *second, (apart, 0.0)]
    free = [
        place
        for place in _beside(rng, 30, first, off=(0.5, 1.0), apart=0.5)
        if min(_off_course_m(place + shift, way) for shift in ((0, 0), (apart, 0))) >= 0.5
    ]
    rods = [place + shift for shift in ((0, 0), (apart, 0)) for place in free[:8]]
    return Room(way=way, targets=_rods(rods), **_drawn(rng))


_FAMILIES = (pillars, office, dense, loop, sparse, people, rig)
_DECEIVING = (rack, doors, legs, columns, yard, twins)
FAMILIES: dict[str, Callable[[np.random.Generator], Room]] = {
    family.__name__: family for family in (*_FAMILIES, *_DECEIVING)
}
"""A family keeps its place: the random numbers of a room depend on it."""


def room_of(name: str) -> tuple[str, int] | None:
    """Return family and number of a room by its name; None if no room has this name.

    >>> room_of("pillars:3"), room_of("lab"), room_of("cellar:3"), room_of("rig:10000")
    (('pillars', 3), None, None, None)
    """
    found = re.fullmatch(r"([a-z]+):([0-9]{1,4})", name, re.ASCII)
    return (found[1], int(found[2])) if found and found[1] in FAMILIES else None


def room_tables(family: str, number: int) -> Values:
    """Return the tables of the scene of a room; numbers have four decimals."""
    index = list(FAMILIES).index(family)
    room = FAMILIES[family](np.random.default_rng([index, number]))
    wheels = {key: sigma * room.wheels_factor for key, sigma in _WHEELS.items()}
    radars = [
        {
            "name": f"radar_{place}",
            "serial": f"2024{index:02d}{number:04d}{place:02d}",
            "x_m": x,
            "y_m": y,
            "yaw_deg": yaw,
        }
        for place, (x, y, yaw) in enumerate(room.rig, 1)
    ]
    drawn = {
        "path": {
            "waypoints_m": room.way,
            "laps": ["forward", "forward"],
            "speed_mps": room.speed_mps,
            "turn_rate_deg_per_s": 28.125,
        },
        "odometry": {"rate_hz": 5.0, **wheels},
        "radars": radars,
        "targets": _named("target", room.targets),
        "walls": _named("wall", room.walls),
        "objects": _named("object", room.objects),
        "people": _named("person", room.people),
    }
    description = FAMILIES[family].__doc__ or ""
    tables: Values = {
        "name": f"{family}_{number}",
        "environment": "lab",
        "description": f"random room: {description}",
        **_rounded(drawn),
        **_SENSORS,
    }
    return tables


def _named(kind: str, rows: Sequence[Values]) -> list[Values]:
    return [{"name": f"{kind}_{number}", **row} for number, row in enumerate(rows)]


def _rounded(value: Any) -> Any:  # noqa: ANN401 - a table, a list, a number or text
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return tuple(_rounded(each) for each in value)
    return value if isinstance(value, str) else round(float(value), _DIGITS)
