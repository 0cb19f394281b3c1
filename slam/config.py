"""Settings of SLAM and the presets that hold them.

Wherever the paper's text leaves a choice, or prints something an expert would do otherwise, the
choice is an option here. The default is what is printed. Lengths in metres, angles in radians
unless the name says degrees.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from xethru_protocol.validation import choices, problem_text, shown

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Origin(StrEnum):
    """Where a constant comes from."""

    DATA_SHEET = "data sheet"  # specification of the robot or of a radar
    MEASURED = "measured"  # on the emulator or on a recording; its sentence says on which
    QUANTILE = "quantile"  # follows from a probability
    BUDGET = "budget"  # limits time or memory, or how long something may take
    CHOSEN = "chosen"  # by looking at results of scenes


class FrontEnd(StrEnum):
    """How echoes are found in a frame."""

    PAPER = "paper"  # as printed: magnitude, smoothing, local maxima
    MATCHED_FILTER = "matched_filter"  # correlation with the pulse; ranges at the Cramer-Rao bound
    JOINT = "joint"  # the same, and pulses that overlap are fitted together


class BackgroundFilter(StrEnum):
    """What happens to samples before smoothing."""

    BELOW_MEAN_TO_ZERO = "below_mean_to_zero"  # as printed
    NONE = "none"  # the mean depends on the scene, and zeroing saves no work in an FIR


class PeakPosition(StrEnum):
    """Where between the samples a peak lies."""

    BIN = "bin"  # as printed: the sample of the local maximum
    PARABOLA = "parabola"  # vertex through the maximum and its neighbours


class BackEnd(StrEnum):
    """What makes pose and map of detections."""

    PAPER = "paper"  # as printed: fixes of pairs, DBSCAN, EKF SLAM
    ROBUST = "robust"  # ranges one by one, calibration states, relinearisation: slam/robust


class SampleTime(StrEnum):
    """From where the robot is taken to have looked when an echo was received."""

    NOMINAL = "nominal"  # as printed: all radars look from the pose of the collected state
    OWN = "own"  # each radar from the pose at the time of its own frame


class Pairing(StrEnum):
    """Which detections of two radars are combined into fixes."""

    ALL = "all"  # as printed: every one with every one, so K echoes give up to K^2 fixes
    ONE_TO_ONE = "one_to_one"  # each used once: most pairs, then least amplitude mismatch


class Evidence(StrEnum):
    """What a confirmed cluster sends to the filter."""

    CENTROID = "centroid"  # as printed: mean of the whole window, so a fix counts up to 15 times
    SINGLE_USE = "single_use"  # mean of the current pose's own fixes; the window only confirms


class Emission(StrEnum):
    """Which clusters of a window become observations of the current pose."""

    HOLDING_CURRENT_POSE = "holding_current_pose"  # as drawn in the paper's DBSCAN figure
    EVERY_CLUSTER = "every_cluster"  # for windows that do not overlap (stride = size)


class ClusterCount(StrEnum):
    """What min_observations counts."""

    FIXES = "fixes"  # as printed: every observation, several of one pose too
    DISTINCT_POSES = "distinct_poses"  # one look cannot confirm itself


class EndOfRun(StrEnum):
    """What happens to the poses still in the window when the run ends."""

    DROP = "drop"  # as printed: Algorithm 1 stops with the teleoperation
    FLUSH = "flush"  # they are estimated with what the window holds


class MotionNoise(StrEnum):
    """How the uncertainty of one motion is made up."""

    PER_STEP_WORLD = "per_step_world"  # as printed: R per step, in world axes
    PROPORTIONAL = "proportional"  # grows with distance and turn, in the robot's axes


class GateRule(StrEnum):
    """What the number ``gate`` means.

    The paper prints "Mahalanobis distance threshold" and no formula. The default compares the
    squared distance, as the authors' later code does, and the algorithm with unknown
    correspondences in Probabilistic Robotics (Thrun et al., table 10.2), which the paper follows.
    """

    MAHALANOBIS_SQ = "mahalanobis_sq"  # alpha bounds the squared distance
    MAHALANOBIS = "mahalanobis"  # to the letter: alpha bounds the distance itself
    CHI_SQUARE = "chi_square"  # probability that a true match passes


class Assignment(StrEnum):
    """How observations of one pose are matched to landmarks."""

    NEAREST_NEIGHBOUR = "nearest_neighbour"  # as printed: one after the other, each its nearest
    ONE_TO_ONE = "one_to_one"  # all together, no landmark twice, least total distance


TEXT_ALLOWED = "text allowed"
"""Validation context of settings that come as text, from a command line."""


class _ConfigTable(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    @field_validator("*", mode="before")
    @classmethod
    def _as_written(cls, value: object, info: ValidationInfo) -> object:
        """Reject what Python would read as a number: true, false, quoted text in a file."""
        assert info.field_name is not None
        kind = cls.model_fields[info.field_name].annotation
        if kind is bool and not isinstance(value, bool) and info.context != TEXT_ALLOWED:
            raise ValueError("must be true or false, without quotes")
        if isinstance(value, bool) and kind is not bool:
            raise ValueError("must be a number or a name, not true or false")
        is_number = kind in (int, float)
        if is_number and isinstance(value, str) and info.context != TEXT_ALLOWED:
            raise ValueError("must be a number, not text; write it without quotes")
        return value


class DetectionConfig(_ConfigTable):
    """Denoising and peak search in one frame (paper, section Signal Processing).

    The range limits and ``front_end`` hold for every front end, the rest for the paper's.
    """

    front_end: FrontEnd = FrontEnd.PAPER
    background: BackgroundFilter = BackgroundFilter.BELOW_MEAN_TO_ZERO
    smoothing_length_bins: Annotated[int, Field(ge=3)] = 15
    smoothing_order: Annotated[int, Field(ge=0)] = 5
    min_peak_height: Positive = 5.5e-3
    min_peak_prominence: Positive = 3e-3
    min_peak_width_bins: NonNegative = 0.0
    peak_position: PeakPosition = PeakPosition.BIN
    min_range_m: NonNegative = 0.2
    max_range_m: Positive = 1.5

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.smoothing_length_bins % 2 == 0:
            raise ValueError("smoothing_length_bins must be odd")
        if self.smoothing_order >= self.smoothing_length_bins:
            raise ValueError("smoothing_order must be less than smoothing_length_bins")
        if self.min_range_m >= self.max_range_m:
            raise ValueError("min_range_m must be less than max_range_m")
        return self


class MatchedFilterConfig(_ConfigTable):
    """The front ends that know the pulse: ``matched_filter`` and ``joint``."""

    carrier_hz: Positive = 7.29e9
    bandwidth_hz: Positive = 1.4e9
    # How many peaks a frame of noise alone gives on average; sets the threshold.
    false_alarms_per_frame: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    # Standard deviation of the noise per RF sample; 0 estimates it in every frame.
    noise_sigma: NonNegative = 0.0
    # Unexplained over expected energy from which ``joint`` looks for several pulses.
    max_single_misfit: Positive = 4.0
    # Relative error of the pulse: root of the energy of its difference from the real pulse, as a
    # share of the pulse's energy; 0.07 for a width 10 % off. A difference of this size is not a
    # second echo, and near the peak not a misfit.
    model_error: NonNegative = 0.08


class TrilaterationConfig(_ConfigTable):
    """Which pairs of ranges become a fix (paper eq. 1 and 2)."""

    field_of_view_deg: Annotated[float, Field(gt=0, lt=180)] = 65.0
    pairing: Pairing = Pairing.ALL
    # As printed the stamps of a pair are not compared; infinity keeps that. A frame's stamp is its
    # own radar's, so the start skew of unsynchronised radars counts, too.
    max_stamp_difference_s: Annotated[float, Field(ge=0, allow_inf_nan=True)] = math.inf
    sample_time: SampleTime = SampleTime.NOMINAL

    @property
    def field_of_view_rad(self) -> float:
        return math.radians(self.field_of_view_deg)


class WindowConfig(_ConfigTable):
    """When a state is collected and how many make a window (Algorithm 1)."""

    min_distance_m: NonNegative = 5e-3
    min_turn_rad: NonNegative = 0.1
    size: Annotated[int, Field(ge=1)] = 15
    stride: Annotated[int, Field(ge=1)] = 1
    end_of_run: EndOfRun = EndOfRun.DROP


class ClusteringConfig(_ConfigTable):
    """Outlier filtering by DBSCAN over the window."""

    min_observations: Annotated[int, Field(ge=1)] = 9
    search_radius_m: Positive = 0.2
    count: ClusterCount = ClusterCount.FIXES
    emission: Emission = Emission.HOLDING_CURRENT_POSE
    evidence: Evidence = Evidence.CENTROID


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelNoise:
    """Errors of wheel odometry: three calibration errors and white noise.

    A step of true body increment (dx, dy) of length D and turn a is reported as
    ``(1 + s) (dx, dy) + white`` and ``(1 + w) a + kappa D + white``.
    """

    # White noise of a step, in proportion to the square root of its length
    along_m_per_sqrt_m: float = 2e-3
    across_m_per_sqrt_m: float = 6e-4
    heading_rad_per_sqrt_m: float = 4.2e-3
    heading_rad_per_rad: float = 0.01  # white noise of a turn, in proportion to its angle
    # Standard deviations of s (mean wheel radius), w (track width) and kappa (difference of the
    # radii) at the start
    scale_sigma: float = 0.007
    turn_scale_sigma: float = 0.007
    curvature_sigma_rad_per_m: float = 0.0042
    # How far each of the three wanders per square root of a metre travelled, as a share of its
    # standard deviation; a radian turned counts as ``walk_lever_m``. Zero: constants.
    walk_per_sqrt_m: float = 0.0
    walk_lever_m: float = 0.3  # see above
    # Smallest standard deviation of one step
    floor_m: float = 3e-6
    floor_rad: float = 1e-6

    def __post_init__(self) -> None:
        """Raise ValueError for a number that is not finite, or negative."""
        for name, value in asdict(self).items():
            if not 0.0 <= value < math.inf:
                raise ValueError(f"wheels: {name} is {value}; it must be finite, and not negative")

    @property
    def calibration_sigmas(self) -> tuple[float, float, float]:
        return (self.scale_sigma, self.turn_scale_sigma, self.curvature_sigma_rad_per_m)

    def step_variances(self, distance_m: float, turn_rad: float) -> tuple[float, float, float]:
        """Return the variances of one step: along [m^2], across [m^2], heading [rad^2]."""
        floor = self.floor_m**2
        heading = self.heading_rad_per_sqrt_m * math.sqrt(distance_m)
        heading += self.heading_rad_per_rad * abs(turn_rad)
        return (
            self.along_m_per_sqrt_m**2 * distance_m + floor,
            self.across_m_per_sqrt_m**2 * distance_m + floor,
            heading**2 + self.floor_rad**2,
        )

    def step_sigmas(self, steps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return standard deviations along [m], across [m] and of the turn [rad], shape (n, 3).

        ``steps`` (n, 3): ux [m], uy [m], ua [rad], body frame at the start of each. Here the floors
        are bounds; in ``step_variances`` their squares are added.
        """
        distance = np.sqrt(steps[:, 0] ** 2 + steps[:, 1] ** 2)
        root = np.sqrt(distance)
        turn = self.heading_rad_per_sqrt_m * root + self.heading_rad_per_rad * np.abs(steps[:, 2])
        return np.column_stack(
            [
                np.maximum(self.along_m_per_sqrt_m * root, self.floor_m),
                np.maximum(self.across_m_per_sqrt_m * root, self.floor_m),
                np.maximum(turn, self.floor_rad),
            ]
        )

    def walk_variance(self, distance_m: float, turn_rad: float) -> float:
        """Return what a step adds to the variance of a calibration error, as a share of it."""
        return self.walk_per_sqrt_m**2 * (distance_m + self.walk_lever_m * abs(turn_rad))


class MotionConfig(_ConfigTable):
    """Motion uncertainty R of the paper, and the coefficients of its proportional alternative."""

    noise: MotionNoise = MotionNoise.PER_STEP_WORLD
    sigma_xy_m: NonNegative = 1e-4
    sigma_heading_rad: NonNegative = 0.02
    along_m_per_sqrt_m: NonNegative = 2e-3
    across_m_per_sqrt_m: NonNegative = 6e-4
    heading_rad_per_sqrt_m: NonNegative = 4.2e-3
    heading_rad_per_rad: NonNegative = 0.01

    @property
    def wheels(self) -> WheelNoise:
        """Return the white noise of ``proportional``, without floors."""
        return WheelNoise(
            along_m_per_sqrt_m=self.along_m_per_sqrt_m,
            across_m_per_sqrt_m=self.across_m_per_sqrt_m,
            heading_rad_per_sqrt_m=self.heading_rad_per_sqrt_m,
            heading_rad_per_rad=self.heading_rad_per_rad,
            floor_m=0.0,
            floor_rad=0.0,
        )


class ObservationConfig(_ConfigTable):
    """Observation uncertainty Q of the paper."""

    sigma_range_m: Positive = 0.15
    sigma_bearing_rad: Positive = 1.0


class AssociationConfig(_ConfigTable):
    """When an observation belongs to a known landmark (alpha of the paper)."""

    gate_rule: GateRule = GateRule.MAHALANOBIS_SQ
    gate: Positive = 0.6
    assignment: Assignment = Assignment.NEAREST_NEIGHBOUR

    @model_validator(mode="after")
    def _probability(self) -> Self:
        if self.gate_rule is GateRule.CHI_SQUARE and self.gate >= 1:
            raise ValueError("gate must be a probability below 1 under gate_rule chi_square")
        return self

    @property
    def gate_threshold(self) -> float:
        """Return the bound on the squared Mahalanobis distance of a match (2 dof).

        >>> round(AssociationConfig(gate_rule=GateRule.CHI_SQUARE, gate=0.99).gate_threshold, 2)
        9.21
        """
        if self.gate_rule is GateRule.MAHALANOBIS_SQ:
            return self.gate
        if self.gate_rule is GateRule.MAHALANOBIS:
            return self.gate**2
        # With two degrees of freedom the chi-square quantile has a closed form.
        return -2.0 * math.log1p(-self.gate)


class RobustConfig(_ConfigTable):
    """The radars as the robust back end models them; limits of range are those of ``detection``."""

    field_of_view_deg: Annotated[float, Field(gt=0, lt=180), Origin.DATA_SHEET] = 65.0
    """Full opening angle within which the front end finds what is there: 65 degrees are the two-way
    width at -3 dB."""
    range_sigma_m: Annotated[Positive, Origin.CHOSEN] = 5e-3
    """How sure a prediction must be for a single range to continue a track, and the standard
    deviation of every range of a front end that predicts none."""
    range_floor_m: Annotated[NonNegative, Origin.CHOSEN] = 0.0
    """What the front end's own deviation leaves out (the shape of targets), added in squares."""
    association_doubt_m: Annotated[NonNegative, Origin.CHOSEN] = 0.0
    """Added, in squares, where it is decided whose a range is: a neighbour's echo may shift it.
    Ranges that new landmarks are fitted to keep it."""
    huber_sigmas: Annotated[float, Field(gt=0), Origin.QUANTILE] = math.inf
    """Innovations of more standard deviations weigh less: of normal errors, one in 22."""
    max_misfit: Annotated[Positive, Origin.CHOSEN] = 1.5
    """Largest misfit of an echo, if the front end reports it: one that a single pulse does not
    explain is of several targets, and lies between them."""
    max_predicted_sigma_m: Annotated[Positive, Origin.CHOSEN] = 8e-3
    """Largest standard deviation of a range, if the front end reports it."""
    offset_sigma_m: Annotated[NonNegative, Origin.CHOSEN] = 0.0
    """Standard deviation of each radar's unknown constant range offset."""
    detection_probability: Annotated[float, Field(gt=0, lt=1), Origin.CHOSEN] = 0.95
    """Probability that a target in view gives a range that is used."""
    mount_sigma_m: Annotated[NonNegative, Origin.CHOSEN] = 0.0
    """Standard deviation of an antenna's position along each axis; 0: it is that of the rig."""
    radius_sigma_m: Annotated[NonNegative, Origin.CHOSEN] = 0.0
    """Standard deviation of a target's radius; 0: targets are points."""
    range_variance_share: Annotated[Positive, Origin.CHOSEN] = 1.0
    """Factor on the variance of a range where many are averaged, until the ranges of the run show
    that it is larger: those of one passage err alike."""
    false_ranges_per_frame: Annotated[Positive, Origin.CHOSEN] = 0.05
    """Ranges of nothing that stands there, per radar and frame."""
    wheel_walk_per_sqrt_m: Annotated[NonNegative, Origin.CHOSEN] = 0.0
    """How far the wheels' calibration wanders per root of a metre, in its standard deviations."""
    patches: bool = True
    """Whether points and walls of coherent images (`slam.imaging`) are detections beside single
    ranges, where frames come in and this project's front end takes them. Then they alone begin
    landmarks and walls."""

    @property
    def field_of_view_rad(self) -> float:
        return math.radians(self.field_of_view_deg)


class SlamConfig(_ConfigTable):
    """All settings of one run of a pipeline."""

    detection: DetectionConfig = DetectionConfig()
    matched_filter: MatchedFilterConfig = MatchedFilterConfig()
    trilateration: TrilaterationConfig = TrilaterationConfig()
    window: WindowConfig = WindowConfig()
    clustering: ClusteringConfig = ClusteringConfig()
    motion: MotionConfig = MotionConfig()
    observation: ObservationConfig = ObservationConfig()
    association: AssociationConfig = AssociationConfig()
    robust: RobustConfig = RobustConfig()
    back_end: BackEnd = BackEnd.PAPER


UNUSED_PARTS: Mapping[BackEnd, tuple[str, ...]] = {
    BackEnd.PAPER: ("robust",),
    BackEnd.ROBUST: ("clustering", "motion", "observation", "association"),
}
"""Parts of a configuration that a back end does not read."""

# The top level of a preset file holds the values of this environment (paper, Table I).
BASE_ENVIRONMENT = "lab"


class ConfigError(ValueError):
    """A preset file or an override that cannot be used; one line with file, key and remedy."""


# Beside this package, in the repository and in the wheel alike: a folder named "fixtures" in the
# user's own project must not come first.
_SHIPPED_PRESETS = Path(__file__).parent.parent / "fixtures" / "presets"

REMOVED_KEYS: Mapping[str, str | float] = {
    "leakage.filter": "none",
    "leakage.max_range_m": 0.45,
    "leakage.memory_frames": 50.0,
    "matched_filter.static_range_m": 0.0,
    "robust.calibrated_offset_sigma_m": 0.0,
    "robust.misfit_share": 0.0,
    "robust.predicted_share": 1.0,
    "trilateration.bearing": "ranges",
}
"""Settings that no longer exist, with their defaults in the last version that had them."""
ADDED_KEYS: Mapping[str, bool] = {"robust.patches": False}
"""Keys that sessions lack which were recorded before, with what was then in effect."""
_LAST_VERSION_WITH_THEM = "0.1.0"


def load_preset(name: str, environment: str = BASE_ENVIRONMENT) -> SlamConfig:
    """Return the preset ``fixtures/presets/<name>.toml`` for one environment.

    Raises
    ------
    ConfigError
        Unknown preset or environment, unreadable file, unknown key or value out of range.
    """
    known = sorted(file.stem for file in _SHIPPED_PRESETS.glob("*.toml"))
    if name not in known:
        raise ConfigError(f"unknown preset {name}; {choices(name, known)}")
    file = _SHIPPED_PRESETS / f"{name}.toml"
    source = f"preset {name}.toml"
    try:
        tables = tomllib.loads(file.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: not TOML: {error}") from error
    return config_from_tables(tables, environment=environment, source=source)


def config_from_tables(
    tables: Mapping[str, Any], *, environment: str = BASE_ENVIRONMENT, source: str
) -> SlamConfig:
    """Return the configuration that the tables of a preset file describe.

    There is one table per part of SlamConfig, and ``environment.<name>`` with the values that
    differ there. Environment "lab" is the top level itself; any other must have its table, unless
    the file has none at all. The tables of all environments are checked. ``source`` names the
    tables in an error message.
    """
    base = {key: value for key, value in tables.items() if key != "environment"}
    overrides = _table(tables.get("environment", {}), "environment", source)
    if "environment" not in tables:
        return _validated(base, source)
    if environment != BASE_ENVIRONMENT and environment not in overrides:
        known = choices(environment, [BASE_ENVIRONMENT, *sorted(overrides)])
        raise ConfigError(f"{source}: no environment {environment}; {known}")
    configs = {BASE_ENVIRONMENT: _validated(base, source)}
    for name, values in overrides.items():
        key = f"environment.{name}"
        merged = dict(base)
        for part, changes in _table(values, key, source).items():
            general = merged.get(part, {})
            merged[part] = {**general, **_table(changes, f"{key}.{part}", source)}
        configs[name] = _validated(merged, f"{source}: {key}")
    return configs[environment]


def override(config: SlamConfig, settings: Mapping[str, object]) -> SlamConfig:
    """Return the configuration with dotted keys replaced; text is read as the key's type.

    >>> override(SlamConfig(), {"association.gate": "1.6"}).association.gate
    1.6
    """
    tables = config.model_dump()
    for key, value in settings.items():
        part, _, field = key.partition(".")
        if key in tables and not isinstance(tables[key], dict):
            tables[key] = value
            continue
        tables.setdefault(part, {})
        if not isinstance(tables[part], dict) or not part or not field:
            parts = ", ".join(SlamConfig.model_fields)
            raise ConfigError(f"setting {key}: write it as part.key; parts: {parts}")
        tables[part] = {**tables[part], field: value}
    return _validated(tables, "setting", context=TEXT_ALLOWED)


def without_removed_keys(tables: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return the tables of a configuration without the keys in `REMOVED_KEYS`.

    >>> without_removed_keys({"robust": {"calibrated_offset_sigma_m": 0.0}}, "old.toml")
    {'robust': {}}

    Raises
    ------
    ConfigError
        A removed key has another value than its default, so the run would not be the same.
    """
    kept = dict(tables)
    for removed, default in REMOVED_KEYS.items():
        part, _, field = removed.partition(".")
        table = kept.get(part)
        if not isinstance(table, dict):
            continue
        if not _is_same(table.get(field, default), default):
            raise ConfigError(
                f"{source}: {removed}: version {_LAST_VERSION_WITH_THEM} was the last with this "
                f"key; only its default {shown(default)} is still read, not {shown(table[field])}"
            )
        kept[part] = {key: value for key, value in table.items() if key != field}
        if not kept[part] and part not in SlamConfig.model_fields:
            del kept[part]
    return kept


def with_added_keys(tables: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of a recorded configuration with those of `ADDED_KEYS` that they lack.

    >>> with_added_keys({"robust": {"offset_sigma_m": 0.0}})
    {'robust': {'patches': False, 'offset_sigma_m': 0.0}}
    """
    full = dict(tables)
    for added, value in ADDED_KEYS.items():
        part, _, field = added.partition(".")
        table = full.get(part, {})
        if isinstance(table, Mapping):
            full[part] = {field: value, **table}
    return full


def _is_same(value: object, default: str | float) -> bool:
    if isinstance(value, bool):
        return False
    if isinstance(value, str) and isinstance(default, float):  # from a command line
        try:
            return float(value) == default
        except ValueError:
            return False
    return value == default


def _table(value: object, key: str, source: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{source}: {key}: must be a table, not {shown(value)}")
    return value


def _validated(tables: Mapping[str, Any], source: str, context: str | None = None) -> SlamConfig:
    tables = without_removed_keys(tables, source)
    try:
        return SlamConfig.model_validate(tables, context=context)
    except ValidationError as error:
        raise ConfigError(f"{source}: {problem_text(error.errors(), SlamConfig)}") from error
