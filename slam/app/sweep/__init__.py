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
    """The stress of a run; random choices depend on the run's seed alone.

    SLAM knows nothing of the stress; frames carry the time at which they were really taken. The
    only stress that enters behind the front end are outliers: no reflector gives such echoes.
    """

    help: str
    outlier_share: float = 0.0  # of the detections: uniform between the front end's limits
    dropped_share: float = 0.0  # of the frames, each lost by itself
    start_skews_ms: tuple[float, ...] = ()  # how late each radar samples
    # random walk of the wheels' errors over the run, in their own standard deviations
    walk_sigmas: float = 0.0
    silent_share: float = 0.0  # of the run, in one piece that begins between 15 and 75 % of it
    dead_radars: frozenset[int] = frozenset()  # indices of radars that never send a frame
    offset_sigma_m: float = 0.0  # of every radar's own constant range error
    carried_at: float = 0.0  # part of the drive at which the robot is picked up
    carried_skips: float = 0.0  # part of its course that it misses


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
