"""Faults of time, and of a radar within an array: late, drifting, silent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from emulator.faults.kind import (
    Action,
    Context,
    Kind,
    Layer,
    Parameters,
    Piece,
    Restart,
    SayToModule,
    Target,
    Unplug,
    frame_packet,
    frame_parts,
    response_bytes,
)
from emulator.scene.philox import Dice
from xethru_protocol.wire.codes import DirCode, InfoItem, PongCode, SensorMode, X4Setting
from xethru_protocol.wire.messages import (
    GetProfileId,
    Ping,
    Pong,
    ReplyInt,
    ReplyString,
    SetMode,
    SystemGetInfo,
    X4DriverSet,
)

_NS_PER_S = 1_000_000_000


class _Away(Parameters):
    away_s: Annotated[float, Field(ge=0.01, le=86_400, description="how long it is away, s")] = 1.0


class _MidFrame(_Away):
    part: Annotated[float, Field(gt=0, lt=1, description="part of the frame that is sent")] = 0.5


class _Loop(Parameters):
    restarts: Annotated[int, Field(ge=1, le=100, description="how many in a row")] = 3
    period_s: Annotated[float, Field(ge=3, le=3600, description="from one to the next, s")] = 4.0


class _Version(Parameters):
    version: Annotated[str, Field(max_length=60, description="version that it tells")] = "0.0.1"


class _Serial(Parameters):
    serial: Annotated[
        str, Field(pattern=r"^[0-9]{12}$", description="serial number that it tells")
    ] = "000000000001"


class _Profile(Parameters):
    profile: Annotated[int, Field(ge=0, le=2**31 - 1, description="profile id that it tells")] = 0


class _Drift(Parameters):
    bins: Annotated[int, Field(ge=-200, le=200, description="bins by which echoes end up off")] = 4
    seconds: Annotated[float, Field(gt=0, le=86_400, description="time that takes, s")] = 10.0


def _unplug(wanted: _Away, dice: Dice) -> Sequence[Action]:
    return [Unplug(round(wanted.away_s * _NS_PER_S))]


def _mid_frame(wanted: _MidFrame, dice: Dice) -> Sequence[Action]:
    return [Unplug(round(wanted.away_s * _NS_PER_S), part_of_frame=wanted.part)]


def _watchdog(wanted: Parameters, dice: Dice) -> Sequence[Action]:
    return [Restart()]


def _brown_out(wanted: _Loop, dice: Dice) -> Sequence[Action]:
    period_ns = round(wanted.period_s * _NS_PER_S)
    return [
        Restart(delay_ns=index * period_ns, reason="brown-out") for index in range(wanted.restarts)
    ]


def _mode_lost(wanted: Parameters, dice: Dice) -> Sequence[Action]:
    return [SayToModule(SetMode(mode=SensorMode.XTID_SM_STOP))]


def _stream_stopped(wanted: Parameters, dice: Dice) -> Sequence[Action]:
    return [SayToModule(X4DriverSet(setting=X4Setting.FPS, value=0.0))]


def _safe_mode(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    if not isinstance(context.command, Ping):
        return None
    return [Piece(response_bytes(Pong(value=PongCode.XTS_SPRP_SAFEMODE)))]


def _wrong_profile(
    packet: bytes, wanted: _Profile, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    if not isinstance(context.command, GetProfileId):
        return None
    return [Piece(response_bytes(ReplyInt(values=(wanted.profile,))))]


def _says(item: InfoItem, text: str, context: Context) -> Sequence[Piece] | None:
    command = context.command
    if not isinstance(command, SystemGetInfo) or command.item != item:
        return None
    content_id = DirCode.XTS_SDC_SYSTEM_GET_INFO
    return [Piece(response_bytes(ReplyString(content_id=content_id, info=item, text=text)))]


def _wrong_version(
    packet: bytes, wanted: _Version, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    return _says(InfoItem.XTID_SSIC_VERSION, wanted.version, context)


def _duplicate_serial(
    packet: bytes, wanted: _Serial, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    return _says(InfoItem.XTID_SSIC_SERIALNUMBER, wanted.serial, context)


def _offset_drift(
    packet: bytes, wanted: _Drift, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    parts = frame_parts(packet)
    if parts is None or parts.samples.size == 0:
        return None
    passed_s = (context.now_ns - context.since_ns) / _NS_PER_S
    shift = round(wanted.bins * min(passed_s / wanted.seconds, 1.0))
    # what moves in at an end is not known: the end bin again
    source = np.clip(np.arange(parts.samples.size) - shift, 0, parts.samples.size - 1)
    return [Piece(frame_packet(parts.counter, parts.samples[source]))]


def _row(  # noqa: PLR0917 - the columns of a table
    name: str,
    target: Target,
    summary: str,
    counted: str,
    effect: Callable[..., Sequence[Piece] | Sequence[Action] | None],
    parameters: type[Parameters] = Parameters,
    *,
    lasting: bool = False,
    hidden: str = "",
) -> Kind:
    return Kind(
        name=name,
        layer=Layer.DEVICE,
        target=target,
        summary=summary,
        counted=counted,
        effect=effect,  # type: ignore[arg-type]  # the target says which of the three it is
        parameters=parameters,
        lasting=lasting,
        hidden=hidden,
    )


KINDS = (
    _row(
        "unplug",
        Target.MOMENT,
        "The port vanishes and comes back; the module restarts by that.",
        "1 reconnect",
        _unplug,
        _Away,
    ),
    _row(
        "disconnect_mid_frame",
        Target.MOMENT,
        "The port vanishes in the middle of a frame and comes back.",
        "1 reconnect",
        _mid_frame,
        _MidFrame,
    ),
    _row(
        "watchdog_reboot",
        Target.MOMENT,
        "The module restarts by itself and counts it towards safe mode; its port stays.",
        "1 reboot, and ResponseTimeout where frames were waited for",
        _watchdog,
    ),
    _row(
        "brown_out",
        Target.MOMENT,
        "The module restarts several times in a row; ten faults in a row start safe mode.",
        "restarts reboots",
        _brown_out,
        _Loop,
    ),
    _row(
        "safe_mode",
        Target.REPLY,
        "The module answers PING as one in safe mode from now on.",
        "1 warning where raw radar mode is set up",
        _safe_mode,
        lasting=True,
    ),
    _row(
        "wrong_profile",
        Target.REPLY,
        "The module tells another profile than the one that is loaded, from now on.",
        "another profile id",
        _wrong_profile,
        _Profile,
        lasting=True,
    ),
    _row(
        "wrong_version",
        Target.REPLY,
        "The module tells another firmware version, from now on.",
        "another version",
        _wrong_version,
        _Version,
        lasting=True,
    ),
    _row(
        "duplicate_serial",
        Target.REPLY,
        "The module tells another module's serial number, from now on.",
        "another serial number",
        _duplicate_serial,
        _Serial,
        lasting=True,
    ),
    _row(
        "mode_lost",
        Target.MOMENT,
        "The module falls back to STOP by itself.",
        "ResponseTimeout where frames were waited for; the mode reads STOP",
        _mode_lost,
    ),
    _row(
        "stream_stopped",
        Target.MOMENT,
        "The module sets its frame rate to 0 by itself, as the transmitter guard does.",
        "ResponseTimeout where frames were waited for; the rate reads 0",
        _stream_stopped,
    ),
    _row(
        "range_offset_drift",
        Target.FRAME,
        "Echoes wander in range, as with temperature.",
        "nothing",
        _offset_drift,
        _Drift,
        lasting=True,
        hidden="Whole bins of true samples: only who knows the scene can tell.",
    ),
)


_NS_PER_MS = 1_000_000
_NS_PER_US = 1_000


class _Offset(Parameters):
    offset_ms: Annotated[float, Field(ge=0, le=60_000, description="how late, ms")] = 20.0


class _Ppm(Parameters):
    ppm: Annotated[float, Field(gt=0, le=100_000, description="how slow the clock is, ppm")] = 50.0


class _Walk(Parameters):
    sigma_us: Annotated[float, Field(gt=0, le=100_000, description="one step, us")] = 200.0


class _Poll(Parameters):
    period_ms: Annotated[float, Field(gt=0, le=1000, description="from poll to poll, ms")] = 16.0


class _Silence(Parameters):
    seconds: Annotated[float, Field(ge=0, le=86_400, description="how long, s; 0: for ever")] = 0.0


def _offset(packet: bytes, wanted: _Offset, dice: Dice, context: Context) -> Sequence[Piece]:
    return [Piece(packet, delay_ns=round(wanted.offset_ms * _NS_PER_MS))]


def _drift(packet: bytes, wanted: _Ppm, dice: Dice, context: Context) -> Sequence[Piece]:
    delay_ns = round((context.now_ns - context.since_ns) * wanted.ppm * 1e-6)
    return [Piece(packet, delay_ns=delay_ns)]


def _jitter(packet: bytes, wanted: _Walk, dice: Dice, context: Context) -> Sequence[Piece]:
    # reflected at 0: nothing can be early
    return [Piece(packet, delay_ns=round(abs(dice.walk(wanted.sigma_us)) * _NS_PER_US))]


def _latency(packet: bytes, wanted: _Poll, dice: Dice, context: Context) -> Sequence[Piece]:
    period_ns = round(wanted.period_ms * _NS_PER_MS)
    return [Piece(packet, delay_ns=(context.since_ns - context.now_ns) % period_ns)]


def _silent(packet: bytes, wanted: _Silence, dice: Dice, context: Context) -> Sequence[Piece]:
    end_ns = context.since_ns + round(wanted.seconds * _NS_PER_S)
    return [] if not wanted.seconds or context.now_ns < end_ns else [Piece(packet)]


def _time_row(  # noqa: PLR0917 - the columns of a table
    name: str,
    summary: str,
    counted: str,
    effect: Callable[..., Sequence[Piece]],
    parameters: type[Parameters],
    hidden: str = "",
) -> Kind:
    return Kind(
        name=name,
        layer=Layer.TIME,
        target=Target.PACKET,
        summary=summary,
        counted=counted,
        effect=effect,
        parameters=parameters,
        lasting=True,
        hidden=hidden,
    )


_ARRIVAL = "nothing; the arrival times show it"
_TIMING = "Frames carry no time; only their arrival shows it, to who looks at it."

TIME_KINDS = (
    _time_row(
        "start_offset",
        "Everything comes later by the same time.",
        _ARRIVAL,
        _offset,
        _Offset,
        _TIMING,
    ),
    _time_row(
        "clock_drift",
        "The module's clock is slow.",
        _ARRIVAL,
        _drift,
        _Ppm,
        _TIMING,
    ),
    _time_row(
        "jitter",
        "Delays wander at random.",
        _ARRIVAL,
        _jitter,
        _Walk,
        _TIMING,
    ),
    _time_row(
        "usb_latency",
        "The host polls now and then: packets come in batches, at multiples of a period.",
        _ARRIVAL,
        _latency,
        _Poll,
        _TIMING,
    ),
    _time_row(
        "silent",
        "Nothing comes from the module, though its port is there.",
        "ResponseTimeout where something was waited for; afterwards the frames lost meanwhile",
        _silent,
        _Silence,
    ),
)
