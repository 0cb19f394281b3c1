"""Faults of the device itself: its port, restarts and identity; and of its time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from emulator.chip.chip import NS_PER_S
from emulator.faults.kind import (
    NO_TIME_IN_FRAMES,
    NS_PER_MS,
    SEEN_IN_TIMES,
    Action,
    Catalogued,
    Context,
    Layer,
    Parameters,
    Piece,
    Pieces,
    Restart,
    SendToModule,
    Target,
    Unplug,
    changed_frame,
    response_bytes,
)
from emulator.scene.philox import Rng
from emulator.scene.toml_files import SerialNumber
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

of_moment = Catalogued(Layer.DEVICE, Target.MOMENT)
of_reply = Catalogued(Layer.DEVICE, Target.REPLY)
of_frame = Catalogued(Layer.DEVICE, Target.FRAME)
of_time = Catalogued(Layer.TIME, Target.PACKET)

_NS_PER_US = 1_000


class _Away(Parameters):
    away_s: float = Field(1.0, ge=0.01, le=86_400, description="how long it is away, s")


class _MidFrame(_Away):
    part: float = Field(0.5, gt=0, lt=1, description="part of the frame that is sent")


class _Loop(Parameters):
    restarts: int = Field(3, ge=1, le=100, description="how many in a row")
    period_s: float = Field(4.0, ge=3, le=3600, description="from one to the next, s")


class _Version(Parameters):
    version: str = Field("0.0.1", max_length=60, description="version that it reports")


class _Serial(Parameters):
    serial: SerialNumber = Field("000000000001", description="serial number that it reports")


class _ReportedProfile(Parameters):
    profile: int = Field(0, ge=0, le=2**31 - 1, description="profile id that it reports")


class _Drift(Parameters):
    bins: int = Field(4, ge=-200, le=200, description="bins by which echoes end up off")
    seconds: float = Field(10.0, gt=0, le=86_400, description="time that takes, s")


class _Offset(Parameters):
    offset_ms: float = Field(20.0, ge=0, le=60_000, description="how late, ms")


class _Ppm(Parameters):
    ppm: float = Field(50.0, gt=0, le=100_000, description="how slow the clock is, ppm")


class _Walk(Parameters):
    sigma_us: float = Field(200.0, gt=0, le=100_000, description="one step, us")


class _Poll(Parameters):
    period_ms: float = Field(16.0, gt=0, le=1000, description="from poll to poll, ms")


class _SilenceLength(Parameters):
    seconds: float = Field(0.0, ge=0, le=86_400, description="how long, s; 0: for ever")


def _info_reply(item: InfoItem, text: str, context: Context) -> Pieces:
    command = context.command
    if not isinstance(command, SystemGetInfo) or command.item != item:
        return None
    content_id = DirCode.XTS_SDC_SYSTEM_GET_INFO
    return [Piece(response_bytes(ReplyString(content_id=content_id, info=item, text=text)))]


@of_moment("1 reconnect", _Away)
def unplug(wanted: _Away, rng: Rng) -> Sequence[Action]:
    """The port vanishes and comes back; the module restarts by that."""
    return [Unplug(round(wanted.away_s * NS_PER_S))]


@of_moment("1 reconnect", _MidFrame)
def disconnect_mid_frame(wanted: _MidFrame, rng: Rng) -> Sequence[Action]:
    """The port vanishes in the middle of a frame and comes back."""
    return [Unplug(round(wanted.away_s * NS_PER_S), part_of_frame=wanted.part)]


@of_moment("1 reboot, and ResponseTimeout where frames were waited for")
def watchdog_reboot(wanted: Parameters, rng: Rng) -> Sequence[Action]:
    """The module restarts by itself and counts it towards safe mode; its port stays."""
    return [Restart()]


@of_moment("restarts reboots", _Loop)
def brown_out(wanted: _Loop, rng: Rng) -> Sequence[Action]:
    """The module restarts several times in a row; ten faults in a row start safe mode."""
    period_ns = round(wanted.period_s * NS_PER_S)
    return [
        Restart(delay_ns=index * period_ns, reason="brown-out") for index in range(wanted.restarts)
    ]


@of_reply("1 warning where raw radar mode is set up", lasting=True)
def safe_mode(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """The module answers PING as one in safe mode from now on."""
    if not isinstance(context.command, Ping):
        return None
    return [Piece(response_bytes(Pong(value=PongCode.XTS_SPRP_SAFEMODE)))]


@of_reply("another profile id", _ReportedProfile, lasting=True)
def wrong_profile(packet: bytes, wanted: _ReportedProfile, rng: Rng, context: Context) -> Pieces:
    """The module reports another profile than the one that is loaded, from now on."""
    if not isinstance(context.command, GetProfileId):
        return None
    return [Piece(response_bytes(ReplyInt(values=(wanted.profile,))))]


@of_reply("another version", _Version, lasting=True)
def wrong_version(packet: bytes, wanted: _Version, rng: Rng, context: Context) -> Pieces:
    """The module reports another firmware version, from now on."""
    return _info_reply(InfoItem.XTID_SSIC_VERSION, wanted.version, context)


@of_reply("another serial number", _Serial, lasting=True)
def duplicate_serial(packet: bytes, wanted: _Serial, rng: Rng, context: Context) -> Pieces:
    """The module reports another module's serial number, from now on."""
    return _info_reply(InfoItem.XTID_SSIC_SERIALNUMBER, wanted.serial, context)


@of_moment("ResponseTimeout where frames were waited for; the mode reads STOP")
def mode_lost(wanted: Parameters, rng: Rng) -> Sequence[Action]:
    """The module falls back to STOP by itself."""
    return [SendToModule(SetMode(mode=SensorMode.XTID_SM_STOP))]


@of_moment("ResponseTimeout where frames were waited for; the rate reads 0")
def stream_stopped(wanted: Parameters, rng: Rng) -> Sequence[Action]:
    """The module sets its frame rate to 0 by itself, as the transmitter guard does."""
    return [SendToModule(X4DriverSet(setting=X4Setting.FPS, value=0.0))]


@of_frame(
    "nothing",
    _Drift,
    lasting=True,
    hidden="Whole bins of true samples: only the scene shows that they are wrong.",
)
def range_offset_drift(packet: bytes, wanted: _Drift, rng: Rng, context: Context) -> Pieces:
    """Echoes wander in range, as with temperature."""
    passed_s = (context.now_ns - context.since_ns) / NS_PER_S
    shift = round(wanted.bins * min(passed_s / wanted.seconds, 1.0))
    # what moves in at an end is not known: the end bin again
    return changed_frame(
        packet,
        lambda samples: samples[np.clip(np.arange(samples.size) - shift, 0, samples.size - 1)],
    )


@of_time(SEEN_IN_TIMES, _Offset, lasting=True, hidden=NO_TIME_IN_FRAMES)
def start_offset(packet: bytes, wanted: _Offset, rng: Rng, context: Context) -> Pieces:
    """Everything comes later by the same time."""
    return [Piece(packet, delay_ns=round(wanted.offset_ms * NS_PER_MS))]


@of_time(SEEN_IN_TIMES, _Ppm, lasting=True, hidden=NO_TIME_IN_FRAMES)
def clock_drift(packet: bytes, wanted: _Ppm, rng: Rng, context: Context) -> Pieces:
    """The module's clock is slow."""
    delay_ns = round((context.now_ns - context.since_ns) * wanted.ppm * 1e-6)
    return [Piece(packet, delay_ns=delay_ns)]


@of_time(SEEN_IN_TIMES, _Walk, lasting=True, hidden=NO_TIME_IN_FRAMES)
def jitter(packet: bytes, wanted: _Walk, rng: Rng, context: Context) -> Pieces:
    """Delays wander at random."""
    # reflected at 0: nothing can be early
    return [Piece(packet, delay_ns=round(abs(rng.walk(wanted.sigma_us)) * _NS_PER_US))]


@of_time(SEEN_IN_TIMES, _Poll, lasting=True, hidden=NO_TIME_IN_FRAMES)
def usb_latency(packet: bytes, wanted: _Poll, rng: Rng, context: Context) -> Pieces:
    """The host polls now and then: packets come in batches, at multiples of a period."""
    period_ns = round(wanted.period_ms * NS_PER_MS)
    return [Piece(packet, delay_ns=(context.since_ns - context.now_ns) % period_ns)]


@of_time(
    "ResponseTimeout where something was waited for; afterwards the frames lost meanwhile",
    _SilenceLength,
    lasting=True,
    again="ends",
)
def silent(packet: bytes, wanted: _SilenceLength, rng: Rng, context: Context) -> Pieces:
    """Nothing comes from the module, though its port is there."""
    end_ns = context.since_ns + round(wanted.seconds * NS_PER_S)
    return [] if not wanted.seconds or context.now_ns < end_ns else [Piece(packet)]
