"""Settings of a module and its profile: firmware options, baud rates, messages, limits.

Source: protocol reference, the rows marked [INF], 4.3 to 4.7, 4.10, 8.3, 8.5, chapters 10 and 15,
and 11, row 5.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
)

from emulator.chip.chip import Refusal
from xethru_protocol.validation import choices
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import (
    ErrorCode,
    LedMode,
    MatrixControl,
    NoiseMapControl,
    OutputControl,
    OutputFeature,
    ProfileId,
    TxCenterFrequency,
)
from xethru_protocol.wire.versions import FIRMWARE_NAMES, firmware_named

ModelName = Literal["x4m300", "x4m200"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ProductModel:
    """A product.

    Attributes
    ----------
    profiles
        What LOADAPP accepts (4.3); the first one runs as shipped (8.2).
    output
        The message that is on as shipped (15, question 3).
    output_while_running
        Whether it takes OUTPUT control of profile messages after RUN. Of an X4M200 the vendor's
        example X4M200_sleep_record.py and public scripts expect it.
    """

    order_code: str
    profiles: tuple[ProfileId, ...]
    output: OutputFeature
    output_while_running: bool = False


MODELS: dict[ModelName, ProductModel] = {
    "x4m300": ProductModel(
        order_code="X4M300",
        profiles=(ProfileId.XTS_ID_APP_PRESENCE_2,),
        output=OutputFeature.PRESENCE_SINGLE,
    ),
    "x4m200": ProductModel(
        order_code="X4M200",
        profiles=(ProfileId.XTS_ID_APP_RESPIRATION_2, ProfileId.XTS_ID_APP_RESPIRATION_3),
        output=OutputFeature.RESP_STATUS,
        output_while_running=True,
    ),
}
RESPIRATION_PROFILES = frozenset(MODELS["x4m200"].profiles)
"""Profiles whose messages are those of the respiration family; all others report presence."""
STOCK_MODEL: ModelName = "x4m300"
"""Where neither the scene nor the user names one."""
BAD_VALUE = BUSY_PROFILE = ErrorCode.XTS_SPRE_COMMAND_FAILED
"""Assumed: ERROR of a profile setting out of its range, and of one in RUN, IDLE or MANUAL (8.3; 15,
question 1)."""
RUN_WITHOUT_PROFILE = ErrorCode.XTS_SPRE_APP_INVALID
"""Assumed: ERROR of RUN and IDLE without a loaded profile (8.3)."""
BASEBAND_SAMPLING_HZ = 2.916e9
"""Sampling-frequency field of baseband messages (15, question 9)."""
BITS_PER_BYTE = 10
"""Start, eight data bits, stop."""
_FALLING = b"\x01\x00"
_LEVELS = tuple(bytes((0, *(byte >> bit & 1 for bit in range(8)), 1)) for byte in range(256))

_BASEBAND = frozenset({OutputFeature.BASEBAND_IQ, OutputFeature.BASEBAND_AMPLITUDE_PHASE})
_RIVALS: dict[int, OutputFeature] = {
    OutputFeature.PULSEDOPPLER_FLOAT: OutputFeature.PULSEDOPPLER_BYTE,
    OutputFeature.PULSEDOPPLER_BYTE: OutputFeature.PULSEDOPPLER_FLOAT,
    OutputFeature.NOISEMAP_FLOAT: OutputFeature.NOISEMAP_BYTE,
    OutputFeature.NOISEMAP_BYTE: OutputFeature.NOISEMAP_FLOAT,
}
"""Messages of the same matrices; an instance is sent as one of them."""
VOLATILE: frozenset[int] = frozenset(_RIVALS) | _BASEBAND
"""Messages that are off after every reset."""
_SWITCH = OutputControl.ON | OutputControl.DEBUG_ROUTING
_INSTANCES = MatrixControl.SLOW | MatrixControl.FAST

ZONE_LIMITS_M = (0.40, 9.40)
"""Smallest start and largest end of a detection zone, module metres."""
SMALLEST_ZONE_M = 0.20
MAX_SENSITIVITY = 9
_NOISE_MAP_BITS = (
    NoiseMapControl.NO_DEFAULT | NoiseMapControl.ADAPTIVE | NoiseMapControl.IGNORE_STORED
)
_GRID_TOLERANCE = 1e-3
"""Part of a grid step: float32 values that were read back are on the grid."""


def _known_firmware(name: str) -> str:
    firmware_named(name)
    return name


class DeviceOptions(BaseModel):
    """How one emulated module behaves where modules differ, or sources disagree."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    firmware: Annotated[str, AfterValidator(_known_firmware)] = "sensor"
    """"sensor": a stock X4M300. "xep": the bare base firmware, which has no profiles and no modes.
    The newest of each; "sensor-1.5.10" or "xep-3.3.0" plays that version, as far as its place in
    the table of versions says (17)."""
    model: ModelName = STOCK_MODEL
    """Product: with the presence profile, or with the respiration profile."""
    after_damage: Literal["answer", "error"] = "answer"
    """What the first command after a wrong checksum gets: what it asks for, or ERROR 1 without
    being carried out. The firmware's source has no such error. Public logs of a real X4M03 show it:
    of 55 sessions that found such an error in what the line still held, and asked for no mode, 42
    report ERROR 1 to X4 INIT, their first command; whether the module saw damage they do not
    tell."""
    port_on_reset: Literal["stay", "vanish"] = "stay"
    """Whether a reset keeps the port ("stay") or takes it away until the USB is back ("vanish")."""
    bad_value: Literal["refuse", "clamp"] = "refuse"
    """What a profile setting out of its range gets (15, question 1): an ERROR, or the nearest value
    is taken."""
    matrix_messages: Literal["whole", "halves"] = "whole"
    """Whether a range bin of a pulse-Doppler matrix or noise map comes in one message (7.2), or in
    two, of the negative and of the other frequencies, as two of the vendor's Python examples put
    them together."""
    storage_bytes: int = 0x48000
    """Size of the file storage: 0x48000, or 0x18000 with the small microcontroller (4.11)."""
    board_offset_m: float = x4.DEFAULT_OFFSET_M
    """FRAMEAREAOFFSET stored on the board, which INIT restores [module metres] (9.3). The echoes
    stay where they are: another value moves their ranges."""

    @property
    def product(self) -> ProductModel:
        return MODELS[self.model]


# --- options as text


class OptionText(NamedTuple):
    """A field of `DeviceOptions` in words; ``allowed`` are its values."""

    name: str
    default: str
    allowed: str
    meaning: str


def option_texts() -> list[OptionText]:
    return [
        OptionText(
            name=name,
            default=str(field.default),
            allowed=_allowed(_OPTION_TYPES[name]),
            meaning=" ".join((field.description or "").split()),
        )
        for name, field in DeviceOptions.model_fields.items()
    ]


def option_of(text: str) -> tuple[str, object]:
    """Return name and value of an option ``name=value``; ValueError, one line, if unknown.

    Examples
    --------
    >>> option_of("bad_value=clamp")
    ('bad_value', 'clamp')
    >>> option_of("storage_bytes=0x18000")
    ('storage_bytes', 98304)
    >>> option_of("bad_value=ignore")
    Traceback (most recent call last):
    ValueError: bad_value=ignore: must be refuse or clamp
    """
    name, equals, value = text.partition("=")
    kind = _OPTION_TYPES.get(name)
    if kind is None:
        raise ValueError(f"no option is called {name}; {choices(name, _OPTION_TYPES)}")
    try:
        if not equals:
            raise ValueError
        return name, _value_of(kind, value)
    except ValueError:
        shown = f"{name}={value}" if equals else f"{name}: no value"
        raise ValueError(f"{shown}: must be {_allowed(kind)}") from None


def _value_of(kind: Any, text: str) -> object:  # noqa: ANN401 - a type, or a form of typing
    if get_origin(kind) is Literal:
        if text not in get_args(kind):
            raise ValueError
        return text
    number = int(text, 0) if kind is int else float(text)
    if not (math.isfinite(number) and (number >= 0 or kind is float)) or abs(number) > 2**63:
        raise ValueError
    return number


def _allowed(kind: Any) -> str:  # noqa: ANN401 - a type, or a form of typing
    if get_origin(kind) is Literal:
        return " or ".join(get_args(kind))
    return "a whole number >= 0" if kind is int else "a number"


_OPTION_TYPES: dict[str, Any] = {
    name: field.annotation for name, field in DeviceOptions.model_fields.items()
} | {"firmware": Literal.__getitem__(FIRMWARE_NAMES)}


# --- bits on the serial line


def received_bytes(data: bytes, sent_baud: int, read_baud: int) -> bytes:
    """Return what arrives of bytes sent one right after the other; nothing at a rate of 0.

    Eight data bits, least significant first, no parity; an idle line is high. The receiver waits
    for a falling edge, looks in the middle of its own bit time whether the line is still low, else
    it was not a start bit; then it takes eight bits, each in its middle, and the stop bit, which it
    does not judge, as a terminal in raw mode does not. Then it waits for the line to be high and to
    fall again.

    Examples
    --------
    At half the rate, bits 3, 5 and 7 of the line are data bits 0 to 2 of 00, then comes its stop
    bit and the idle line.

    >>> received_bytes(bytes([0x00]), 115200, 57600).hex()
    'f8'
    """
    if sent_baud == read_baud:
        return data
    if sent_baud <= 0 or read_baud <= 0:
        return b""
    # an edge lies at the beginning of a sent bit: the samples' places behind it are always the same
    middles = [(2 * bit + 1) * sent_baud // (2 * read_baud) for bit in range(BITS_PER_BYTE)]
    data_bits = itemgetter(*middles[1:9])
    start, stop = middles[0], middles[9]
    levels = b"".join(map(_LEVELS.__getitem__, data))  # one per bit time of the sender
    line = b"\x01" + levels + b"\x01" * (stop + 2)
    received = bytearray()
    at = line.find(_FALLING)
    while at >= 0:
        edge = at + 1
        if line[edge + start]:
            at = line.find(_FALLING, edge)
            continue
        bits = data_bits(line[edge : edge + stop + 1])
        received.append(sum(level << place for place, level in enumerate(bits)))
        at = line.find(_FALLING, edge + stop)
    return bytes(received)


# --- messages that are on


def set_output(outputs: Mapping[int, int], feature: int, control: int) -> dict[int, int]:
    """Return the table after one message was switched.

    Examples
    --------
    >>> set_output({0x0C: 1}, 0x0D, 1)
    {13: 1}
    >>> set_output({0x10: 3}, 0x11, 2)
    {16: 1, 17: 2}
    """
    changed = dict(outputs)
    if feature in _BASEBAND:
        for excluded in _BASEBAND:  # switching either off switches both off
            changed.pop(excluded, None)
        _keep(changed, feature, control & _SWITCH, control & OutputControl.ON)
    elif feature in _RIVALS:
        fast = MatrixControl.FAST if MatrixControl(control).fast else MatrixControl(0)
        instances = int(control & MatrixControl.SLOW | fast)
        rival = _RIVALS[feature]
        left = changed.get(rival, 0) & ~instances
        _keep(changed, rival, left, left & _INSTANCES)
        _keep(changed, feature, instances | control & MatrixControl.DEBUG_ROUTING, instances)
    else:
        _keep(changed, feature, control & _SWITCH, control & OutputControl.ON)
    return changed


def _without_volatile(outputs: Mapping[int, int]) -> dict[int, int]:
    return {feature: bits for feature, bits in outputs.items() if feature not in VOLATILE}


def _keep(table: dict[int, int], feature: int, bits: int, on: int) -> None:
    table.pop(feature, None)
    if on:
        table[int(feature)] = int(bits)


# --- the profile


def snapped_zone(start_m: float, end_m: float) -> tuple[float, float]:
    """Return a zone widened to the grid of the baseband bins, module metres.

    Examples
    --------
    >>> [round(limit_m, 6) for limit_m in snapped_zone(0.4, 5.0)]
    [0.385761, 5.015391]
    """
    step_m, origin_m = x4.BASEBAND_BIN_M, x4.DEFAULT_OFFSET_M
    first = math.floor((start_m - origin_m) / step_m + _GRID_TOLERANCE)
    last = math.ceil((end_m - origin_m) / step_m - _GRID_TOLERANCE)
    return origin_m + first * step_m, origin_m + last * step_m


def _table_of_pairs(content: object) -> object:
    """Return a table of a list of pairs; anything else as it is, to be refused."""
    try:
        return dict(content) if isinstance(content, list) else content
    except (TypeError, ValueError):
        return content


U32 = Annotated[int, Field(ge=0, lt=1 << 32)]
ZoneLimit = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
Outputs = Annotated[
    dict[U32, U32],
    BeforeValidator(_table_of_pairs),
    PlainSerializer(lambda table: list(table.items()), when_used="json"),
]
"""Control bits by message id, in documents a list of pairs; what is off is absent."""


class ProfileSettings(BaseModel):
    """What one profile is set to, in the module and in its flash; as shipped unless changed.

    Attributes
    ----------
    zone_m
        Actual detection zone, start and end, on the grid [module metres].
    noise_map_interval_min
        Interval at which the noise map is stored, 0 for never [min].
    """

    model_config = ConfigDict(extra="forbid")

    profile_id: U32 = int(ProfileId.XTS_ID_APP_PRESENCE_2)
    zone_m: tuple[ZoneLimit, ZoneLimit] = snapped_zone(*ZONE_LIMITS_M)
    sensitivity: int = Field(5, ge=0, le=MAX_SENSITIVITY)
    tx_center_frequency: int = Field(int(TxCenterFrequency.LOW_BAND), ge=3, le=4)
    led: int = Field(int(LedMode.FULL), ge=0, le=2)
    noise_map_control: int = Field(int(_NOISE_MAP_BITS), ge=0, le=7)
    noise_map_interval_min: int = Field(0, ge=0, lt=1 << 31)
    outputs: Outputs = {int(OutputFeature.PRESENCE_SINGLE): 1}
    debug_outputs: Outputs = {}

    @classmethod
    def shipped(cls, profile_id: int, options: DeviceOptions) -> ProfileSettings:
        # the vendor's example X4M200_sleep_record.py reads sleep messages without switching them on
        sleep = profile_id == ProfileId.XTS_ID_APP_RESPIRATION_3
        outputs = {options.product.output, *([OutputFeature.SLEEP_STATUS] if sleep else [])}
        return cls(profile_id=profile_id, outputs={int(output): 1 for output in outputs})

    def after_reset(self) -> ProfileSettings:
        """Return a copy without the messages that a reset switches off."""
        kept = {
            "outputs": _without_volatile(self.outputs),
            "debug_outputs": _without_volatile(self.debug_outputs),
        }
        return self.model_copy(update=kept)

    def set_zone(self, start_m: float, end_m: float, options: DeviceOptions) -> None:
        """Choose the zone; what was read back of a zone may be written again."""
        if not (math.isfinite(start_m) and math.isfinite(end_m)):
            raise Refusal(BAD_VALUE)
        lowest_m, highest_m = snapped_zone(*ZONE_LIMITS_M)
        tolerance_m = _GRID_TOLERANCE * x4.BASEBAND_BIN_M
        if abs(start_m - lowest_m) < tolerance_m:
            start_m = ZONE_LIMITS_M[0]
        if abs(end_m - highest_m) < tolerance_m:
            end_m = ZONE_LIMITS_M[1]
        start_m = _checked(start_m, *ZONE_LIMITS_M, options)
        end_m = _checked(end_m, *ZONE_LIMITS_M, options)
        if options.bad_value == "clamp":
            end_m = max(end_m, start_m)
            start_m = min(start_m, ZONE_LIMITS_M[1] - SMALLEST_ZONE_M)
            end_m = max(end_m, start_m + SMALLEST_ZONE_M)
        elif not SMALLEST_ZONE_M - tolerance_m <= end_m - start_m:
            raise Refusal(BAD_VALUE)
        self.zone_m = snapped_zone(start_m, end_m)

    def set_sensitivity(self, value: int, options: DeviceOptions) -> None:
        self.sensitivity = int(_checked(value, 0, MAX_SENSITIVITY, options))

    def set_band(self, value: int, options: DeviceOptions) -> None:
        lowest, highest = TxCenterFrequency.LOW_BAND, TxCenterFrequency.HIGH_BAND
        self.tx_center_frequency = int(_checked(value, lowest, highest, options))

    def set_led(self, value: int, options: DeviceOptions) -> None:
        self.led = int(_checked(value, LedMode.OFF, LedMode.FULL, options))

    def set_noise_map_control(self, control: int) -> None:
        """Choose where the noise map comes from; unknown bits are not kept."""
        self.noise_map_control = int(control & _NOISE_MAP_BITS)

    def set_output(self, feature: int, control: int) -> None:
        """Switch a message, and with it those it excludes."""
        self.outputs = set_output(self.outputs, feature, control)

    def set_debug_output(self, feature: int, control: int) -> None:
        self.debug_outputs = set_output(self.debug_outputs, feature, control)


def _checked(value: float, lowest: float, highest: float, options: DeviceOptions) -> float:
    """Return a value within limits; one outside is clamped or refused, as the options say.

    Limits are met in float32: 9.4 arrives as 9.3999996185.
    """
    tolerance = 1e-6 * max(abs(highest), 1.0)
    inside = lowest - tolerance <= value <= highest + tolerance
    if not inside and options.bad_value != "clamp":
        raise Refusal(BAD_VALUE)
    return min(max(value, lowest), highest)
