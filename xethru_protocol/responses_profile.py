"""Rows of the message table: APPDATA of profiles, in Normal framing.

Names in dumps are those of the golden vectors. Section numbers refer to the Protocol reference.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from xethru_protocol import wire, wire_lists
from xethru_protocol.codes import AppDataId
from xethru_protocol.responses_bulk import appdata
from xethru_protocol.table import Response, response

_DISTANCE = wire.Number("f", "distance")
_Floats = tuple[float, ...]


@response(*appdata(AppDataId.XTS_ID_PRESENCE_SINGLE), name="PRESENCE_SINGLE")
@dataclass(frozen=True, slots=True, kw_only=True)
class PresenceSingle(Response):
    """One person, once a second: `PresenceState`, `PresenceDirection`, quality 0 ... 10. 7.3."""

    counter: Annotated[int, wire.U32]
    state: Annotated[int, wire.Number("I", "presence_state")]
    distance_m: Annotated[float, _DISTANCE]
    direction: Annotated[int, wire.U8]
    signal_quality: Annotated[int, wire.U32]


@response(*appdata(AppDataId.XTS_ID_PRESENCE_MOVINGLIST), name="PRESENCE_MOVINGLIST")
@dataclass(frozen=True, slots=True, kw_only=True)
class PresenceMovingList(Response):
    """Movement by range and detections, once a second. 7.3.

    ``movement_slow`` and ``movement_fast``, 0 ... 100, are equally long; the first entry is the
    average of the list. The three ``detection`` lists are equally long: distance [m], radar cross
    section [dB(m^2)] and velocity, of which released firmware computes the first only.
    """

    counter: Annotated[int, wire.U32]
    state: Annotated[int, wire.Number("I", "presence_state")]
    interval_count: ClassVar[
        Annotated[int, wire_lists.Count(("movement_slow", "movement_fast"), "interval_count")]
    ]
    detection_count: ClassVar[
        Annotated[
            int,
            wire_lists.Count(
                ("detection_distance_m", "detection_rcs", "detection_velocity"), "detection_count"
            ),
        ]
    ]
    movement_slow: Annotated[_Floats, wire_lists.Floats("interval_count")]
    movement_fast: Annotated[_Floats, wire_lists.Floats("interval_count")]
    detection_distance_m: Annotated[
        _Floats, wire_lists.Floats("detection_count", "detection_distance")
    ]
    detection_rcs: Annotated[_Floats, wire_lists.Floats("detection_count")]
    detection_velocity: Annotated[_Floats, wire_lists.Floats("detection_count")]


@response(*appdata(AppDataId.XTS_ID_RESP_STATUS), name="RESP_STATUS")
@dataclass(frozen=True, slots=True, kw_only=True)
class RespStatus(Response):
    """Breathing: `RespirationState`, breaths per minute, movement [mm], quality. 7.4."""

    counter: Annotated[int, wire.U32]
    state: Annotated[int, wire.U32]
    rpm: Annotated[int, wire.U32]
    distance_m: Annotated[float, _DISTANCE]
    movement_mm: Annotated[float, wire.F32]
    signal_quality: Annotated[int, wire.U32]


@response(*appdata(AppDataId.XTS_ID_SLEEP_STATUS), name="SLEEP_STATUS")
@dataclass(frozen=True, slots=True, kw_only=True)
class SleepStatus(Response):
    """Sleep: `RespirationState`, breaths per minute, quality, slow and fast movement. 7.4."""

    counter: Annotated[int, wire.U32]
    state: Annotated[int, wire.U32]
    rpm: Annotated[float, wire.F32]
    distance_m: Annotated[float, _DISTANCE]
    signal_quality: Annotated[int, wire.U32]
    movement_slow: Annotated[float, wire.F32]
    movement_fast: Annotated[float, wire.F32]


@response(*appdata(AppDataId.XTS_ID_VITAL_SIGNS), name="VITAL_SIGNS")
@dataclass(frozen=True, slots=True, kw_only=True)
class VitalSigns(Response):
    """Rates of breath and heartbeat, with distances [m] and confidences. 7.4."""

    counter: Annotated[int, wire.U32]
    state: Annotated[int, wire.U32]
    respiration_rate: Annotated[float, wire.F32]
    respiration_distance_m: Annotated[float, wire.Number("f", "respiration_distance")]
    respiration_confidence: Annotated[float, wire.F32]
    heart_rate: Annotated[float, wire.F32]
    heart_distance_m: Annotated[float, wire.Number("f", "heart_distance")]
    heart_confidence: Annotated[float, wire.F32]
    normalized_movement_slow: Annotated[float, wire.F32]
    normalized_movement_fast: Annotated[float, wire.F32]
    normalized_movement_start_m: Annotated[float, wire.Number("f", "normalized_movement_start")]
    normalized_movement_end_m: Annotated[float, wire.Number("f", "normalized_movement_end")]


@response(*appdata(AppDataId.XTS_ID_SLEEPSTAGE), name="SLEEPSTAGE")
@dataclass(frozen=True, slots=True, kw_only=True)
class SleepStage(Response):
    """Stage of sleep. 7.4."""

    counter: Annotated[int, wire.U32]
    stage: Annotated[int, wire.U32]


@response(*appdata(AppDataId.XTS_ID_RESPIRATION_MOVINGLIST), name="RESPIRATION_MOVINGLIST")
@dataclass(frozen=True, slots=True, kw_only=True)
class RespirationMovingList(Response):
    """Movement by range, slow and fast; the two lists are equally long. 7.4."""

    counter: Annotated[int, wire.U32]
    interval_count: ClassVar[
        Annotated[int, wire_lists.Count(("movement_slow", "movement_fast"), "interval_count")]
    ]
    movement_slow: Annotated[_Floats, wire_lists.Floats("interval_count")]
    movement_fast: Annotated[_Floats, wire_lists.Floats("interval_count")]


@response(*appdata(AppDataId.XTS_ID_RESPIRATION_DETECTIONLIST), name="RESPIRATION_DETECTIONLIST")
@dataclass(frozen=True, slots=True, kw_only=True)
class RespirationDetectionList(Response):
    """Detections: distances [m], cross sections, velocities; equally long lists. 7.4."""

    counter: Annotated[int, wire.U32]
    detection_count: ClassVar[
        Annotated[
            int,
            wire_lists.Count(
                ("detection_distance_m", "detection_rcs", "detection_velocity"), "detection_count"
            ),
        ]
    ]
    detection_distance_m: Annotated[
        _Floats, wire_lists.Floats("detection_count", "detection_distance")
    ]
    detection_rcs: Annotated[_Floats, wire_lists.Floats("detection_count")]
    detection_velocity: Annotated[_Floats, wire_lists.Floats("detection_count")]


@response(
    *appdata(AppDataId.XTS_ID_RESPIRATION_NORMALIZEDMOVEMENTLIST),
    name="RESPIRATION_NORMALIZEDMOVEMENTLIST",
)
@dataclass(frozen=True, slots=True, kw_only=True)
class RespirationNormalizedMovementList(Response):
    """Normalised movement per bin from ``start_m`` on, slow and fast, equally long. 7.4."""

    counter: Annotated[int, wire.U32]
    start_m: Annotated[float, wire.Number("f", "start")]
    bin_length_m: Annotated[float, wire.Number("f", "bin_length")]
    count: ClassVar[Annotated[int, wire_lists.Count(("movement_slow", "movement_fast"), "count")]]
    movement_slow: Annotated[_Floats, wire_lists.Floats("count", "slow")]
    movement_fast: Annotated[_Floats, wire_lists.Floats("count", "fast")]


@response(*appdata(AppDataId.XTS_ID_PROFILE_PARAMETERFILE), name="PROFILE_PARAMETERFILE")
@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterFile(Response):
    """A profile's parameter file; the terminating NULs are taken off. 7.6."""

    name_length: ClassVar[Annotated[int, wire_lists.Count(("name",), size=wire_lists.text_size)]]
    data_length: ClassVar[Annotated[int, wire_lists.Count(("data",), size=wire_lists.text_size)]]
    name: Annotated[str | bytes, wire_lists.Text("name_length", "filename")]
    data: Annotated[str | bytes, wire_lists.Text("data_length")]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Opaque(Response):
    """A message whose layout is not known, kept whole. 7.4, 7.5."""

    data: Annotated[bytes, wire.RestBytes()]


@response(*appdata(AppDataId.XTS_ID_RESP_STATUS_EXT), name="RESP_STATUS_EXT")
@dataclass(frozen=True, slots=True, kw_only=True)
class RespStatusExt(_Opaque):
    """Extended breathing state; layout unknown. 7.4."""


@response(*appdata(AppDataId.XTS_ID_RADAR_RF), name="RADAR_RF")
@dataclass(frozen=True, slots=True, kw_only=True)
class RadarRf(_Opaque):
    """RF frame of newer firmware; order of its fields on the wire unproven. 7.5."""


@response(*appdata(AppDataId.XTS_ID_RADAR_RF_NORMALIZED), name="RADAR_RF_NORMALIZED")
@dataclass(frozen=True, slots=True, kw_only=True)
class RadarRfNormalized(_Opaque):
    """RF frame of newer firmware, as float; layout unproven. 7.5."""


@response(*appdata(AppDataId.XTS_ID_RADAR_BASEBAND_FLOAT), name="RADAR_BASEBAND_FLOAT")
@dataclass(frozen=True, slots=True, kw_only=True)
class RadarBasebandFloat(_Opaque):
    """Baseband frame of newer firmware, as float; layout unproven. 7.5."""


@response(*appdata(AppDataId.XTS_ID_RADAR_BASEBAND_Q15), name="RADAR_BASEBAND_Q15")
@dataclass(frozen=True, slots=True, kw_only=True)
class RadarBasebandQ15(_Opaque):
    """Baseband frame of newer firmware, as Q15; layout unproven. 7.5."""


@response(*appdata(AppDataId.XTS_ID_PRESENCE_STATUS), name="PRESENCE_STATUS")
@dataclass(frozen=True, slots=True, kw_only=True)
class PresenceStatus(_Opaque):
    """Legacy message; layout unknown. 7.5."""


@response(*appdata(AppDataId.XTS_ID_DECIM_STATUS), name="DECIM_STATUS")
@dataclass(frozen=True, slots=True, kw_only=True)
class DecimStatus(_Opaque):
    """Legacy message; layout unknown. 7.5."""
