"""People: where they are, how they breathe, move and sleep, at any scene time.

Everything is a function of the person's table, the scene's seed and the scene time. What is random
is drawn from streams of `emulator.scene.philox` that belong to the seed and the person's name.

A person is a point reflector that moves: its echo falls with R**-2, and its range is the distance
to a point on its path less the displacement of the chest that the radar sees, so the carrier's
phase follows every movement continuously. Limbs, shadowing and the body's extent are left out.

Breathing
    ``sine``: the chest is ``breath_amplitude_m sin(2 pi n)`` out, with n the breaths so far.
    ``realistic``: a breath is inspiration (40 % of it), expiration (40 %), both half cosines, and a
    pause with the chest in (20 %), a ratio of 1 : 1.5; the travel is the same. Harmonics follow
    from the shape. That expiration is longer than inspiration and ends in a pause is textbook
    physiology (Lujan et al., Med. Phys. 26 (1999) 715, for the pause); the shares are assumed.
Rate
    ``breaths_per_min`` (1 + w sum_k sin(2 pi t / T_k + phi_k) / 3), with w = ``rate_wander`` and
    three random phases, so that it never leaves the band. Assumed; n is its closed integral.
Apnoea
    Once in every ``every_s`` the chest rests in for ``lasts_s``, at a random time. It comes to rest
    and starts again within 1.5 s of that.
Heartbeat
    A sine of ``heart_amplitude_m`` more. Chest walls move by 0.2 to 0.5 mm with the heart
    (Droitcour, Non-contact measurement of heart and respiration rates, Stanford 2006).
Shifts
    After an exponential time of mean 60 s / ``per_min`` the body goes, within ``takes_s``, to a
    place drawn evenly from a disc of diameter ``size_m`` around the waypoint.
Sway
    Of a standing body: four sines with periods from 1.7 to 11 s per axis, ``sway_m`` at most.
    Assumed, after the spectrum of quiet stance, which lies below 1 Hz.
Sleep
    From ``from_s`` on, cycles of ``cycle_min`` through the stages of `STAGES`. Breathing is slower,
    and most regular in deep sleep. ``turns_per_hour`` times, before ``from_s`` too, the body turns
    over, within 4 s, and moves by up to 20 cm: to a side in 54.7 %, the back in 37.9 %, the front
    in 7.4 % (Skarpsno et al., Nature and Science of Sleep 9 (2017) 267: 54.1, 37.5 and 7.3 % of the
    time; 1.6 shifts of position per hour). The shares of the stages and their rates are assumed.
What a radar sees
    With theta between the direction of the chest and the way to the radar, chest displacement and
    radar cross section are those of the front times `share_seen`, a parabola in cos(theta) through
    front, side and back: 1, 0.4, 0.25 of the displacement, and 1, 0.25, 2 of the cross section.
    A chest at rest moves by 3 to 5 mm forward and 1 to 2 mm to a side (De Groote et al., J. Appl.
    Physiol. 83 (1997) 1531). The cross section that moves, measured with CW radar at 2.4 GHz, is
    larger from the back and smaller from the side than from the front, and a prone body moves less
    than a supine one (Kiriazi et al., IEEE Sensors J. 12 (2012) 574; 0.33 m**2 supine, 2.9 m**2
    prone: the same, EMBC 2009; a half cylinder's side is 4 times smaller: the same, RWS 2011). The
    other numbers are assumed, and so is that a back moves in phase with the chest. A radar is taken
    to look down by 45 degrees at who lies, and horizontally at who does not.
"""

from __future__ import annotations

import functools
import hashlib
import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from emulator.chip.chip import NS_PER_S
from emulator.scene.motion import Degrees, Metres, Name
from emulator.scene.philox import WORDS_PER_BLOCK, Purpose, stream_of, uniforms
from emulator.scene.toml_files import Number, Table

_Seconds = Annotated[Number, Field(ge=0, le=86_400)]
_Size = Annotated[Number, Field(gt=0, le=1)]

_INSPIRATION, _EXPIRATION = 0.4, 0.4
_RAMP_S = 1.5
_WANDER_PERIODS_S = np.array([23.0, 41.0, 67.0])
_SWAY_PERIODS_S = np.array([1.7, 3.1, 6.3, 11.0])
_SWAY_SHARES = np.array([0.15, 0.25, 0.3, 0.3])
_TURN_SIZE_M, _TURN_TAKES_S = 0.2, 4.0
_SIDE_SHARE, _BACK_SHARE = 0.547, 0.379
_LOOKS_DOWN_RAD = math.radians(45)
CHEST_SHARES = (1.0, 0.4, 0.25)
"""Of the chest's displacement, seen from front, side and back."""
CROSS_SECTION_SHARES = (1.0, 0.25, 2.0)
"""Of the radar cross section, likewise."""


class _RandomStream(IntEnum):
    """What the random streams of a person are for."""

    RATE = 0
    APNOEA = 1
    SHIFTS = 2
    TURNS = 3
    SWAY = 4


class SleepDepth(IntEnum):
    """How deep a person sleeps; the numbers are ours."""

    AWAKE = 0
    LIGHT = 1
    DEEP = 2
    REM = 3


STAGES = (
    (SleepDepth.LIGHT, 0.45, 0.95, 0.6),
    (SleepDepth.DEEP, 0.25, 0.9, 0.2),
    (SleepDepth.LIGHT, 0.08, 0.95, 0.6),
    (SleepDepth.REM, 0.22, 1.0, 1.0),
)
"""Stage, share of the cycle, factor on the rate, factor on its wander."""


class ApnoeaSpec(Table):
    """Breathing stops for ``lasts_s`` once in every ``every_s``."""

    every_s: Annotated[Number, Field(ge=5, le=86_400)]
    lasts_s: Annotated[Number, Field(ge=2 * _RAMP_S, le=600)] = 15.0

    @model_validator(mode="after")
    def _ends_before_the_next(self) -> ApnoeaSpec:
        if self.lasts_s >= self.every_s:
            raise ValueError("lasts_s: must be less than every_s")
        return self


class ShiftsSpec(Table):
    """The body shifts now and then, as of somebody who sits: how often, how far, how quickly."""

    per_min: Annotated[Number, Field(gt=0, le=60)] = 1.0
    size_m: _Size = 0.1
    takes_s: Annotated[Number, Field(ge=0.1, le=60)] = 1.0


class SleepSpec(Table):
    """The person sleeps from ``from_s`` on: length of a cycle of stages, and how often it turns."""

    from_s: _Seconds = 0.0
    cycle_min: Annotated[Number, Field(ge=1, le=600)] = 90.0
    turns_per_hour: Annotated[Number, Field(ge=0, le=600)] = 1.6


class PersonSpec(Table):
    """One person, in the world frame.

    It is in the scene from ``enters_s`` to ``leaves_s`` (for ever if that is left out), and walks
    from the moment it enters. ``walk`` selects what happens at the last waypoint: ``once`` stays
    there, ``to_and_fro`` turns back, ``round`` goes on to the first one. One waypoint: it stands,
    sits or lies. ``rcs_m2`` is its radar cross section from the front. ``breath_amplitude_m`` is
    half of the chest's travel. The chest faces ``facing_deg``, counter-clockwise from x, and all
    radars if that is left out; of a lying person this is how it lies on a side. The reflection
    phase is fixed by the name.
    """

    name: Name
    waypoints_m: Annotated[tuple[tuple[Metres, Metres], ...], Field(min_length=1, max_length=1000)]
    speed_mps: Annotated[Number, Field(ge=1e-3, le=10)] = 1.0
    walk: Literal["once", "to_and_fro", "round"] = "once"
    enters_s: _Seconds = 0.0
    leaves_s: _Seconds | None = None
    rcs_m2: Annotated[Number, Field(gt=0, le=100)] = 1.0
    posture: Literal["upright", "supine", "prone", "side"] = "upright"
    facing_deg: Degrees | None = None
    breaths_per_min: Annotated[Number, Field(ge=0, le=60)] = 15.0
    breath_amplitude_m: Annotated[Number, Field(ge=0, le=0.05)] = 0.004
    breath_pattern: Literal["sine", "realistic"] = "sine"
    rate_wander: Annotated[Number, Field(ge=0, le=0.5)] = 0.0
    apnoea: ApnoeaSpec | None = None
    heartbeats_per_min: Annotated[Number, Field(ge=0, le=240)] = 70.0
    heart_amplitude_m: Annotated[Number, Field(ge=0, le=0.002)] = 0.0
    sway_m: Annotated[Number, Field(ge=0, le=0.1)] = 0.0
    shifts: ShiftsSpec | None = None
    sleep: SleepSpec | None = None

    @model_validator(mode="after")
    def _leaves_after_it_enters(self) -> PersonSpec:
        if self.leaves_s is not None and self.leaves_s <= self.enters_s:
            raise ValueError("leaves_s: must be later than enters_s")
        return self

    @model_validator(mode="after")
    def _lies_if_it_sleeps(self) -> PersonSpec:
        if self.posture == "upright":
            if self.sleep is not None:
                raise ValueError("posture: who sleeps must be supine, prone or side")
        elif len(self.waypoints_m) > 1 or self.sway_m:
            raise ValueError("posture: who lies has one waypoint and no sway_m")
        return self


# --- where it is


def positions_m(person: PersonSpec, t_ns: NDArray[np.int64], seed: int = 0) -> NDArray[np.float64]:
    """Return where a person is, shape (n, 2) [m], world frame, at scene times of shape (n,)."""
    stops = list(person.waypoints_m)
    if person.walk == "round":
        stops.append(stops[0])
    elif person.walk == "to_and_fro":
        stops.extend(reversed(stops[:-1]))
    path = np.array(stops, dtype=np.float64)
    steps = np.diff(path, axis=0)
    ends_m = np.concatenate([[0.0], np.cumsum(np.sqrt(steps[:, 0] ** 2 + steps[:, 1] ** 2))])
    length_m = float(ends_m[-1])
    walked_m = np.maximum(t_ns / 1e9 - person.enters_s, 0.0) * person.speed_mps
    if person.walk != "once" and length_m > 0:
        walked_m = np.fmod(walked_m, length_m)
    at_x = np.interp(walked_m, ends_m, path[:, 0])
    at_y = np.interp(walked_m, ends_m, path[:, 1])
    places_m = np.stack([at_x, at_y], axis=1)
    for moves in _body_motions(person, seed):
        places_m += moves.offsets_m(t_ns)
    if person.sway_m:
        places_m += person.sway_m * _sway(person, t_ns / 1e9, seed)
    return places_m


def present(person: PersonSpec, t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether a person is in the scene, shape (n,)."""
    t_s = t_ns / 1e9
    there: NDArray[np.bool_] = t_s >= person.enters_s
    return there if person.leaves_s is None else there & (t_s < person.leaves_s)


def moves(person: PersonSpec, t_ns: NDArray[np.int64], seed: int = 0) -> NDArray[np.bool_]:
    """Return whether a person walks, shifts or turns over, shape (n,); sway does not count."""
    length_m = float(sum(map(math.dist, person.waypoints_m, person.waypoints_m[1:])))
    t_s = t_ns / 1e9
    if length_m == 0:
        walks = np.zeros(len(t_ns), dtype=np.bool_)
    elif person.walk == "once":
        walks = t_s - person.enters_s < length_m / person.speed_mps
    else:
        walks = np.ones(len(t_ns), dtype=np.bool_)
    for motion in _body_motions(person, seed):
        walks = walks | (motion.progress(t_ns)[1] < 1)
    return walks & present(person, t_ns)


def sleep_stages(person: PersonSpec, t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the `SleepDepth` at scene times, shape (n,)."""
    if person.sleep is None:
        return np.full(len(t_ns), SleepDepth.AWAKE, dtype=np.int64)
    night = _hypnogram(person.sleep, float(t_ns.max(initial=0)) / 1e9)
    return night.stages[night.number(t_ns / 1e9)]


# --- breathing


def chest_displacement_m(
    person: PersonSpec, t_ns: NDArray[np.int64], seed: int = 0
) -> NDArray[np.float64]:
    """Return how far the chest is out, shape (n,) [m]; it is what a radar in front sees."""
    turns = np.fmod(_breaths(person, t_ns / 1e9, seed), 1.0)
    if person.breath_pattern == "sine":
        wave = np.sin(math.tau * turns)
    else:
        breathing_in = turns < _INSPIRATION
        done = np.where(breathing_in, turns / _INSPIRATION, (turns - _INSPIRATION) / _EXPIRATION)
        wave = np.cos(math.pi * np.minimum(done, 1.0)) * np.where(breathing_in, -1.0, 1.0)
    if person.apnoea is not None:
        since_s = _since_apnoea_s(person, person.apnoea, t_ns / 1e9, seed)
        until_s = person.apnoea.lasts_s - since_s
        rests = np.clip(np.minimum(since_s, until_s) / _RAMP_S, 0.0, 1.0)
        wave = (1 + wave) * (1 - rests * rests * (3 - 2 * rests)) - 1
    out_m = person.breath_amplitude_m * wave
    if person.heart_amplitude_m:
        beats = np.fmod(t_ns / 1e9 * (person.heartbeats_per_min / 60), 1.0)
        out_m = out_m + person.heart_amplitude_m * np.sin(math.tau * beats)
    return np.asarray(out_m, dtype=np.float64)


def breathing_rate_per_min(
    person: PersonSpec, t_ns: NDArray[np.int64], seed: int = 0
) -> NDArray[np.float64]:
    """Return breaths per minute, shape (n,).

    NaN where nobody breathes: absent, in apnoea, or a person without breaths.
    """
    t_s = t_ns / 1e9
    factor = np.ones(len(t_s))
    wander = np.full(len(t_s), person.rate_wander)
    if person.sleep is not None:
        night = _hypnogram(person.sleep, float(t_s.max(initial=0)))
        number = night.number(t_s)
        factor, wander = night.factors[number], person.rate_wander * night.wanders[number]
    if person.rate_wander:
        angle = math.tau * t_s[:, np.newaxis] / _WANDER_PERIODS_S
        factor = factor * (1 + wander * np.sin(angle + _rate_phases(person, seed)).mean(axis=1))
    return _where_breathing(person, person.breaths_per_min * factor, t_s, 0.0, seed)


def mean_breathing_rate_per_min(
    person: PersonSpec, t_ns: NDArray[np.int64], window_s: float, seed: int = 0
) -> NDArray[np.float64]:
    """Return breaths per minute over windows that end at scene times, shape (n,).

    NaN for a window in which the person is absent, in apnoea, or does not breathe, even partly.
    """
    t_s = t_ns / 1e9
    count = _breaths(person, t_s, seed) - _breaths(person, t_s - window_s, seed)
    return _where_breathing(person, count * (60 / window_s), t_s, window_s, seed)


def _where_breathing(
    person: PersonSpec,
    rate: NDArray[np.float64],
    t_s: NDArray[np.float64],
    back_s: float,
    seed: int,
) -> NDArray[np.float64]:
    there = (t_s - back_s >= person.enters_s) & (person.breaths_per_min > 0)
    if person.leaves_s is not None:
        there &= t_s < person.leaves_s
    if person.apnoea is not None:
        since_s = _since_apnoea_s(person, person.apnoea, t_s, seed)
        there &= since_s >= person.apnoea.lasts_s + back_s
    return np.where(there, rate, np.nan)


def _breaths(person: PersonSpec, t_s: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Return the breaths since scene time 0, the integral of the rate, shape (n,)."""
    per_s = person.breaths_per_min / 60
    if person.sleep is not None:
        night = _hypnogram(person.sleep, float(t_s.max(initial=0)))
        factors, wanders, number = night.factors, night.wanders, night.number(t_s)
        begins_s = np.concatenate([[0.0], night.edges_s])
        wandered_s = _wandered_s(person, begins_s, seed)
        ran_s = factors[:-1] * (np.diff(begins_s) + wanders[:-1] * np.diff(wandered_s))
        before_s = np.concatenate([[0.0], np.cumsum(ran_s)])[number]
        newest_s = _wandered_s(person, t_s, seed) - wandered_s[number]
        since_s = t_s - begins_s[number]
        ran: NDArray[np.float64] = before_s + factors[number] * (
            since_s + wanders[number] * newest_s
        )
        return per_s * ran
    if person.rate_wander:
        return per_s * (t_s + _wandered_s(person, t_s, seed))
    return t_s * per_s


def _wandered_s(person: PersonSpec, t_s: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Return the integral of the rate's relative wander from scene time 0, shape (n,) [s]."""
    if not person.rate_wander:
        return np.zeros(len(t_s))
    phases = _rate_phases(person, seed)
    angle = math.tau * t_s[:, np.newaxis] / _WANDER_PERIODS_S + phases
    grown_s = (np.cos(phases) - np.cos(angle)) * (_WANDER_PERIODS_S / math.tau)
    return np.asarray(person.rate_wander * grown_s.mean(axis=1), dtype=np.float64)


def _rate_phases(person: PersonSpec, seed: int) -> NDArray[np.float64]:
    return _phases_rad(person.name, _RandomStream.RATE, len(_WANDER_PERIODS_S), seed)


def _since_apnoea_s(
    person: PersonSpec, apnoea: ApnoeaSpec, t_s: NDArray[np.float64], seed: int
) -> NDArray[np.float64]:
    """Return the time since the newest apnoea began, shape (n,) [s]; infinite before the first."""
    first = max(int(t_s.min(initial=0) // apnoea.every_s) - 1, 0)
    count = max(int(t_s.max(initial=0) // apnoea.every_s) - first + 1, 1)
    drawn = _drawn(person.name, _RandomStream.APNOEA, count * WORDS_PER_BLOCK, seed, first)
    within_s = drawn[::WORDS_PER_BLOCK] * (apnoea.every_s - apnoea.lasts_s)
    begins_s = np.arange(first, first + count) * apnoea.every_s + within_s
    number = np.searchsorted(begins_s, t_s, side="right") - 1
    return np.where(number >= 0, t_s - begins_s[np.maximum(number, 0)], np.inf)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Hypnogram:
    """Stages of sleep and when they change.

    Attributes
    ----------
    edges_s
        Shape (k,): when they change [s].
    stages, factors, wanders
        Shape (k + 1,): stage, and factors on rate and wander, from before the first change.
    """

    edges_s: NDArray[np.float64]
    stages: NDArray[np.int64]
    factors: NDArray[np.float64]
    wanders: NDArray[np.float64]

    def number(self, t_s: NDArray[np.float64]) -> NDArray[np.int64]:
        return np.searchsorted(self.edges_s, t_s, side="right")


def _hypnogram(sleep: SleepSpec, until_s: float) -> _Hypnogram:
    cycle_s = 60 * sleep.cycle_min
    return _cycles(sleep, max(math.ceil((until_s - sleep.from_s) / cycle_s), 1))


@functools.lru_cache(maxsize=64)
def _cycles(sleep: SleepSpec, count: int) -> _Hypnogram:
    shares = np.cumsum([0.0, *(share for _, share, _, _ in STAGES)])[:-1]
    begins = np.arange(count)[:, np.newaxis] + shares
    stages, factors, wanders = (
        np.concatenate([[first], np.tile([row[column] for row in STAGES], count)])
        for first, column in ((int(SleepDepth.AWAKE), 0), (1.0, 2), (1.0, 3))
    )
    edges_s = sleep.from_s + 60 * sleep.cycle_min * begins.ravel()
    return _Hypnogram(edges_s=edges_s, stages=stages, factors=factors, wanders=wanders)


# --- body motion


class BodyMotion:
    """Shifts of the body, or turns in sleep, at random times.

    Events come one by one: the next begins an exponential time after the last has ended.
    """

    def __init__(
        self, stream: int, seed: int, *, mean_s: float, takes_s: float, size_m: float
    ) -> None:
        self._stream, self._seed = stream, seed
        self._mean_s, self._takes_ns = mean_s, round(takes_s * NS_PER_S)
        self._size_m = size_m
        # begins, per event a number in [0, 1), and places; replaced as a whole when more are drawn
        self._events = (np.empty(0, dtype=np.int64), np.empty(0), np.zeros((1, 2)))

    def _until(
        self, t_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        begins_ns, drawn, places_m = self._events
        last_ns = int(t_ns.max(initial=0))
        while len(begins_ns) == 0 or begins_ns[-1] <= last_ns:
            count = max(len(begins_ns), 64)
            words = uniforms(
                WORDS_PER_BLOCK * count,
                seed=self._seed,
                stream=self._stream,
                block=len(begins_ns),
            ).reshape(count, WORDS_PER_BLOCK)
            # whole milliseconds: a logarithm's last bit must not matter
            waits_ns = np.rint(-1e3 * self._mean_s * np.log1p(-words[:, 0])).astype(np.int64)
            gaps_ns = 1_000_000 * waits_ns + self._takes_ns
            before_ns = int(begins_ns[-1]) if len(begins_ns) else -self._takes_ns
            radius_m = 0.5 * self._size_m * np.sqrt(words[:, 2])
            angle = math.tau * words[:, 3]
            places = np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle)], axis=1)
            begins_ns = np.concatenate([begins_ns, before_ns + np.cumsum(gaps_ns)])
            drawn = np.concatenate([drawn, words[:, 1]])
            places_m = np.concatenate([places_m, places])
            self._events = begins_ns, drawn, places_m
        return self._events

    def progress(self, t_ns: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the number of the newest event, from 1, and how much of it is done, 0 ... 1.

        Shape (n,) each; before the first event 0 and 1.
        """
        begins_ns, _, _ = self._until(t_ns)
        number = np.searchsorted(begins_ns, t_ns, side="right")
        since_ns = t_ns - begins_ns[np.maximum(number - 1, 0)]
        done = np.where(number > 0, np.minimum(since_ns / self._takes_ns, 1.0), 1.0)
        return number, done

    def between(self, states: NDArray[np.float64], t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return states on the smooth way from each event's to the next one's, shape (n, m).

        ``states``, shape (events + 1, m), begin with that before the first event.
        """
        number, done = self.progress(t_ns)
        share = (done * done * (3 - 2 * done))[:, np.newaxis]
        before, after = states[np.maximum(number - 1, 0)], states[number]
        return np.asarray(before + share * (after - before), dtype=np.float64)

    def drawn(self, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return a number in [0, 1) of each event up to the latest time at least."""
        return self._until(t_ns)[1]

    def offsets_m(self, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return how far the body is from where it was at first, shape (n, 2) [m]."""
        return self.between(self._until(t_ns)[2], t_ns)


@functools.lru_cache(maxsize=64)
def _body_motion(
    stream: int, seed: int, mean_s: float, takes_s: float, size_m: float
) -> BodyMotion:
    return BodyMotion(stream, seed, mean_s=mean_s, takes_s=takes_s, size_m=size_m)


def _shifts(person: PersonSpec, seed: int) -> BodyMotion | None:
    spec = person.shifts
    if spec is None:
        return None
    stream = _stream(person.name, _RandomStream.SHIFTS)
    return _body_motion(stream, seed, 60 / spec.per_min, spec.takes_s, spec.size_m)


def _turns(person: PersonSpec, seed: int) -> BodyMotion | None:
    spec = person.sleep
    if spec is None or not spec.turns_per_hour:
        return None
    stream = _stream(person.name, _RandomStream.TURNS)
    return _body_motion(stream, seed, 3600 / spec.turns_per_hour, _TURN_TAKES_S, _TURN_SIZE_M)


def _body_motions(person: PersonSpec, seed: int) -> list[BodyMotion]:
    return [each for each in (_shifts(person, seed), _turns(person, seed)) if each is not None]


def _sway(person: PersonSpec, t_s: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Return the sway along x and y in those of the largest, shape (n, 2)."""
    phases = _phases_rad(person.name, _RandomStream.SWAY, 2 * len(_SWAY_PERIODS_S), seed)
    angle = math.tau * t_s[:, np.newaxis, np.newaxis] / _SWAY_PERIODS_S + phases.reshape(2, -1)
    return np.asarray((_SWAY_SHARES * np.sin(angle)).sum(axis=2), dtype=np.float64)


@functools.cache
def _stream(name: str, part: _RandomStream) -> int:
    serial = int.from_bytes(hashlib.sha256(name.encode()).digest()[:5], "big")
    return stream_of(serial, Purpose.PERSON, part)


def _drawn(
    name: str, part: _RandomStream, count: int, seed: int, block: int = 0
) -> NDArray[np.float64]:
    return uniforms(count, seed=seed, stream=_stream(name, part), block=block)


@functools.lru_cache(maxsize=256)
def _phases_rad(name: str, part: _RandomStream, count: int, seed: int) -> NDArray[np.float64]:
    return math.tau * _drawn(name, part, count, seed)


# --- what a radar sees


def share_seen(
    shares: tuple[float, float, float], cos_angle: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the parabola in the cosine of an angle through shares at 0, 90 and 180 degrees.

    >>> share_seen((1.0, 0.4, 0.25), np.array([1.0, 0.0, -1.0])).tolist()
    [1.0, 0.4, 0.25]
    """
    front, side, back = shares
    curved = (front + back) / 2 - side
    share: NDArray[np.float64] = side + cos_angle * ((front - back) / 2 + curved * cos_angle)
    return share


def facing_cosines(
    person: PersonSpec,
    t_ns: NDArray[np.int64],
    way_m: NDArray[np.float64],
    seed: int = 0,
) -> NDArray[np.float64] | None:
    """Return cosines of the angle between the chest's direction and the way to a radar.

    ``way_m`` leads from the person to the radar, shape (n, 2), world frame. None for a person that
    faces all radars.
    """
    if person.posture == "upright" and person.facing_deg is None:
        return None
    ahead = np.ones(len(t_ns))
    if person.facing_deg is not None:
        distance_m = np.sqrt(way_m[:, 0] ** 2 + way_m[:, 1] ** 2)
        facing_rad = math.radians(person.facing_deg)
        along_m = way_m[:, 0] * math.cos(facing_rad) + way_m[:, 1] * math.sin(facing_rad)
        ahead = along_m / np.maximum(distance_m, 1e-9)
    if person.posture == "upright":
        return ahead
    lies = np.array(
        [{"supine": (0.0, 1.0), "prone": (0.0, -1.0), "side": (1.0, 0.0)}[person.posture]]
    )
    turns = _turns(person, seed)
    if turns is None or person.sleep is None:
        aside, up = lies.T
    else:
        drawn = turns.drawn(t_ns)
        first, second = _SIDE_SHARE / 2, _SIDE_SHARE
        sides = np.where(drawn < first, 1.0, np.where(drawn < second, -1.0, 0.0))
        ups = np.where(drawn < second, 0.0, np.where(drawn < second + _BACK_SHARE, 1.0, -1.0))
        states = np.concatenate([lies, np.stack([sides, ups], axis=1)])
        aside, up = turns.between(states, t_ns).T
    cosine = aside * ahead * math.cos(_LOOKS_DOWN_RAD) + up * math.sin(_LOOKS_DOWN_RAD)
    return np.asarray(cosine, dtype=np.float64)
