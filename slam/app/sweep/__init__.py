"""`uwb-slam sweep`, and the stresses that its runs can go through.

Importing this package loads nothing heavy, since ``--help`` lists the stresses;
`slam.app.sweep.run` applies them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

CLEAN = "clean"

FAMILIES = (
    *("pillars", "office", "dense", "loop", "sparse", "people", "rig"),
    *("rack", "doors", "legs", "columns", "yard", "twins"),
)
"""Families of random rooms; `emulator.scene.rooms` would load NumPy."""

SceneKeys = Mapping[str, object]
"""Keys of a table of a scene, and their values."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stress:
    """The stress of a run; random choices depend on the run's seed alone.

    SLAM does not get these values. Frames have their true times, but for the errors of stamps in
    ``radars``. Outliers and the noise of ranges enter behind the front end: no reflector gives
    such echoes.
    """

    help: str
    outlier_share: float = 0.0  # of the detections: uniform between the front end's limits
    range_noise: float = 1.0  # standard deviation of ranges, over that which preset robust states
    dropped_share: float = 0.0  # of the frames, each lost by itself
    start_skews_ms: tuple[float, ...] = ()  # how late each radar samples
    # random walk of the wheels' errors over the run, in their own standard deviations
    walk_sigmas: float = 0.0
    silent_share: float = 0.0  # of the run, in one piece that begins between 15 and 75 % of it
    dead_radars: frozenset[int] = frozenset()  # indices of radars that never send a frame
    offset_sigma_m: float = 0.0  # of every radar's own constant range error
    # of every radar's true mount about that of the rig which SLAM gets, per axis and in yaw
    mount_sigma_m: float = 0.0
    mount_sigma_deg: float = 0.0
    # keys that replace those of every such table of the scene: of `RadarSpec`, `TargetSpec`,
    # `MultipathSpec` and `OdometrySpec` (`emulator.scene.scene`)
    radars: SceneKeys = field(default_factory=dict)
    targets: SceneKeys = field(default_factory=dict)
    multipath: SceneKeys = field(default_factory=dict)
    odometry: SceneKeys = field(default_factory=dict)
    like: str = ""  # the recording whose noise, leakage, jitter and pulses the modules have
    carried_at: float = 0.0  # part of the drive at which the robot is picked up
    carried_skips: float = 0.0  # part of its course that it misses


_SKEWS_MS = (0.0, 190.0, 100.0, 150.0)

# Strengths of model error, as in the project's laws (`emulator.echo.model_error`).
_OFFSET_SIGMA_M, _MOUNT_SIGMA_M, _MOUNT_SIGMA_DEG = 0.02, 0.005, 1.0
_SKEWED_PULSE: SceneKeys = {"pulse": {"width": 1.15, "skew": 0.15, "ringing": 0.15}}
_BURSTS: SceneKeys = {"bursts": {"echo_share": 0.15, "noise_share": 0.05}}
_STAMPS: SceneKeys = {"stamp_sigma_ms": 20.0}
_ROD_ROD: SceneKeys = {"target_pairs": 0.25}
_SLIP: SceneKeys = {"slips_per_s": 1 / 20, "slip_sigma_m": 0.015, "slip_sigma_deg": 2.0}
_LARGE_SLIP: SceneKeys = {"slips_per_s": 1 / 60, "slip_sigma_m": 0.06, "slip_sigma_deg": 8.0}

_RECORDED = {
    "x4m03_2025": "X4M03: noise, leakage, jitter, pulse",
    "x4_2017": "X4 of 2017",
    "bare_x4": "X4 without a housing",
}
"""`RECORDED` of `emulator.scene.scene`, which is too heavy to load here."""


def _wander(range_m: float) -> SceneKeys:
    return {"wander": {"range_m": range_m, "inside_m": 0.02, "fading": 0.4, "phase_rad": 1.0}}


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
    "offsets_20": Stress(
        help="each radar's ranges off by a constant, 20 mm standard deviation, uncalibrated",
        offset_sigma_m=_OFFSET_SIGMA_M,
    ),
    "carried": Stress(
        help="picked up and set down elsewhere on the course; the wheels do not see it",
        carried_at=0.4,
        carried_skips=0.15,
    ),
    "pulse_wide": Stress(
        help="all pulses a tenth wider than SLAM assumes", radars={"pulse": {"width": 1.1}}
    ),
    "pulse": Stress(help="pulses 1.15 times as wide, skewed and ringing", radars=_SKEWED_PULSE),
    "wander_3": Stress(
        help="a scattering centre 2 cm inside each target, whose range (3 mm), amplitude and phase "
        "change with aspect",
        targets=_wander(0.003),
    ),
    "wander_10": Stress(help="the same, the range by 10 mm", targets=_wander(0.01)),
    "rod_rod": Stress(help="echoes by way of two targets closer than 1 m", multipath=_ROD_ROD),
    "bursts": Stress(
        help="pulses and noise of other modules in a fifth of the frames", radars=_BURSTS
    ),
    "slip": Stress(help="wheels slip by 15 mm and 2 degrees, every 20 s", odometry=_SLIP),
    "slip_large": Stress(
        help="wheels slip by 6 cm and 8 degrees, once a minute", odometry=_LARGE_SLIP
    ),
    "noise_stated_low": Stress(
        help="ranges err four times as much as preset robust states", range_noise=4.0
    ),
    "mounts": Stress(
        help="each radar 5 mm per axis and 1 degree off its mount (standard deviations)",
        mount_sigma_m=_MOUNT_SIGMA_M,
        mount_sigma_deg=_MOUNT_SIGMA_DEG,
    ),
    "stamps": Stress(help="times of frames off by 20 ms (standard deviation)", radars=_STAMPS),
    "mismatch": Stress(
        help="pulse, wander_10, rod_rod, bursts, slip, mounts, stamps and offsets_20 together",
        radars={**_SKEWED_PULSE, **_BURSTS, **_STAMPS},
        targets=_wander(0.01),
        multipath=_ROD_ROD,
        odometry=_SLIP,
        mount_sigma_m=_MOUNT_SIGMA_M,
        mount_sigma_deg=_MOUNT_SIGMA_DEG,
        offset_sigma_m=_OFFSET_SIGMA_M,
    ),
    "pulse_x4m03_2025": Stress(
        help="the pulse of a recorded X4M03, and nothing else of it",
        radars={"pulse": {"like": "x4m03_2025"}},
    ),
    **{
        f"like_{name}": Stress(help=f"modules like a recorded {module}", like=name)
        for name, module in _RECORDED.items()
    },
}
