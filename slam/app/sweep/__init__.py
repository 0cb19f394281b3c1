"""`uwb-slam sweep`, and the stresses that its runs can go through.

Importing this package loads nothing heavy, since ``--help`` lists the stresses;
`slam.app.sweep.run` applies them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

CLEAN = "clean"


@dataclass(frozen=True, slots=True, kw_only=True)
class Stress:
    """What a run suffers; random choices depend on the run's seed alone.

    SLAM knows nothing of the stress; frames carry the time at which they were really taken.

    Attributes
    ----------
    outlier_share
        Of the detections, replaced by ranges that are uniform between the front end's limits. The
        only stress that enters behind the front end: no reflector gives such echoes.
    dropped_share
        Of the frames, each lost by itself.
    start_skews_ms
        How late each radar samples.
    walk_sigmas
        By how many of their own standard deviations the wheels' scale, turn scale and curvature
        walk at random over the run.
    silent_share
        Of the run, during which no radar sends anything, in one piece; it begins between 15 and
        75 % of the run.
    dead_radars
        Indices of radars that never send a frame.
    offset_sigma_m
        Standard deviation of every radar's own constant range error.
    carried_at, carried_skips
        Parts of the drive: where the robot is picked up, and how much of its course it misses.
    """

    help: str
    outlier_share: float = 0.0
    dropped_share: float = 0.0
    start_skews_ms: tuple[float, ...] = ()
    walk_sigmas: float = 0.0
    silent_share: float = 0.0
    dead_radars: frozenset[int] = frozenset()
    offset_sigma_m: float = 0.0
    carried_at: float = 0.0
    carried_skips: float = 0.0


_SKEWS_MS = (0.0, 190.0, 100.0, 150.0)

STRESSES: Mapping[str, Stress] = {
    CLEAN: Stress(help="nothing is wrong"),
    "outliers": Stress(
        help="a fifth of the detections replaced by random ranges", outlier_share=0.2
    ),
    "dropped": Stress(help="a tenth of the frames lost", dropped_share=0.1),
    "skew": Stress(help="radars sample up to 190 ms apart, stamped so", start_skews_ms=_SKEWS_MS),
    "walk": Stress(
        help="scale, turn scale and curvature of the wheels walk by one sigma over the run",
        walk_sigmas=1.0,
    ),
    "silent": Stress(help="no radar for a tenth of the run", silent_share=0.1),
    "all": Stress(
        help="outliers, dropped, skew, walk and silent together",
        outlier_share=0.2,
        dropped_share=0.1,
        start_skews_ms=_SKEWS_MS,
        walk_sigmas=1.0,
        silent_share=0.1,
    ),
    "dead": Stress(help="the first radar never sends a frame", dead_radars=frozenset({0})),
    "offsets": Stress(
        help="each radar's ranges off by a constant, 20 mm standard deviation, uncalibrated",
        offset_sigma_m=0.02,
    ),
    "carried": Stress(
        help="picked up and set down elsewhere on the course; the wheels do not see it",
        carried_at=0.4,
        carried_skips=0.15,
    ),
}
