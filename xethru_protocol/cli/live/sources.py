"""Where the frames of a live command come from: a module, or a recording at its own pace."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xethru_protocol.cli.arguments import raw_config
from xethru_protocol.cli.output import (
    CommandFailed,
    frame_rate,
    frame_timeout_s,
    let_send,
    module_at,
    print_warnings,
    set_up,
    warn,
    warn_of,
)
from xethru_protocol.driver.frames import Samples
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.recordings.loading import RadarArrays, load
from xethru_protocol.recordings.recorded_messages import NO_TIME_NS, RecordingFault
from xethru_protocol.validation import shown
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.x4 import CARRIER_HZ, real_frame_rate

_BLOCK_FRAMES = 64


class TimedFrame(NamedTuple):
    """One frame: its time since the first one, and RF or complex baseband, shape (n_bins,)."""

    t_s: float
    samples: Samples


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSource:
    """Frames of one radar.

    Attributes
    ----------
    name
        Port or path, for people.
    ranges_m
        Where the bins lie, shape (n_bins,), as the module counts ranges.
    is_iq
        Whether frames are complex baseband, else RF.
    frame_rate_hz
        Frames per second, of the radar's own time.
    tx_center_frequency
        Setting of the transmitter, 3 or 4.
    frames
        The frames, in order. A module begins to send with the first that is asked for.
    lost
        Returns how many frames did not arrive, or held NaN or infinities and were left out.
    faults
        What of a recording could not be read, when its frames have been taken.
    """

    name: str
    ranges_m: NDArray[np.float64]
    is_iq: bool
    frame_rate_hz: float
    tx_center_frequency: int
    frames: Iterable[TimedFrame]
    lost: Callable[[], int] = lambda: 0
    faults: Sequence[RecordingFault] = ()

    @property
    def carrier_hz(self) -> float:
        """Centre frequency of the pulse, of which Doppler and displacement are measured."""
        return CARRIER_HZ[self.tx_center_frequency]


@contextmanager
def open_source(arguments: Namespace) -> Iterator[FrameSource]:
    """Open what the command line names; the module is stopped and closed when the block ends."""
    if arguments.recording is None and arguments.port is None:
        arguments.refuse("name a recording, or the --port of a module")
    if arguments.recording is not None and arguments.port is not None:
        arguments.refuse(f"--port {arguments.port} or {arguments.recording}, not both")
    if arguments.recording is not None and arguments.attach:
        arguments.refuse("--attach is for the --port of a module")
    if arguments.port is not None and (arguments.radar is not None or arguments.rate != 1):
        arguments.refuse("--radar and --rate are for a recording")
    if arguments.recording is not None:
        source = _recorded(arguments)
        yield source
        warn_of(arguments.command, source.faults)
        return
    config = raw_config(arguments)
    with module_at(arguments.port, arguments.baudrate) as radar:
        geometry = set_up(radar, config)
        wanted_hz = None if config is None else frame_rate(radar, arguments.fps)
        rate_hz = radar.description["rate_hz"] if wanted_hz is None else real_frame_rate(wanted_hz)
        frames = _Finite(_streamed(radar, config, wanted_hz, arguments.count))
        yield FrameSource(
            name=arguments.port,
            ranges_m=geometry.ranges_m,
            is_iq=geometry.downconversion,
            frame_rate_hz=rate_hz,
            tx_center_frequency=radar.description["settings"][X4Setting.TXCENTERFREQUENCY.name],
            frames=frames,
            lost=lambda: radar.frames_lost + frames.n_left_out,
        )


class _Finite:
    """Frames without those that hold NaN or infinities, of which no spectrum can be made."""

    def __init__(self, frames: Iterator[TimedFrame]) -> None:
        self._frames = frames
        self.n_left_out = 0

    def __iter__(self) -> Iterator[TimedFrame]:
        for frame in self._frames:
            if np.isfinite(frame.samples).all():
                yield frame
            else:
                self.n_left_out += 1


def _streamed(
    radar: X4M300, config: RawConfig | None, wanted_hz: float | None, count: int | None
) -> Iterator[TimedFrame]:
    """Yield frames as they come; their times follow from the chip's counter."""
    rate_hz = let_send(radar, config, wanted_hz)
    print_warnings(radar)
    steps, before = 0, None
    for frame in radar.frames(count, timeout_s=frame_timeout_s(rate_hz)):
        if before is not None:
            follows = frame.stream == before.stream and frame.counter > before.counter
            steps += frame.counter - before.counter if follows else 1
        before = frame
        yield TimedFrame(steps / rate_hz, frame.samples)


def _recorded(arguments: Namespace) -> FrameSource:
    path = arguments.recording
    faults: list[RecordingFault] = []
    recording = load(
        path,
        faults.append,
        area_m=arguments.frame_area,
        downconversion=True if arguments.baseband else None,
    )
    if arguments.radar is None and len(recording.radars) > 1:
        names = ", ".join(map(shown, recording.radars))
        raise CommandFailed(
            f"{path} holds several radars: {names}; choose one with --radar NAME, or see all of a "
            "session with 'uwb-slam view'"
        )
    radar = recording.radar if arguments.radar is None else recording.named(arguments.radar)
    if not radar.parts:
        raise CommandFailed(f"{path} holds no radar frames")
    frames = max(radar.parts, key=lambda part: part.n_frames)
    if frames.kind is None:
        raise CommandFailed(f"{path} does not say what its frames are; if baseband: --baseband")
    if frames.frames.inferred and frames.kind == "rf":
        warn(
            f"xethru {arguments.command}: frames are probably {frames.frames.about}, by how smooth "
            "they are (--baseband if not)"
        )
    rate_hz = arguments.fps or frames.frame_rate_hz
    if rate_hz is None:
        raise CommandFailed(f"{path} does not say its frame rate; add --fps F")
    if frames.ranges_m is None:
        raise CommandFailed(
            f"{path} does not say where its bins lie; add its --frame-area START END"
        )
    finite = _Finite(_all_frames(frames, rate_hz, with_times=arguments.fps is None))
    return FrameSource(
        name=path,
        ranges_m=frames.ranges_m,
        is_iq=frames.kind == "iq",
        frame_rate_hz=rate_hz,
        tx_center_frequency=_tx_center_frequency(path, frames),
        frames=_paced(islice(finite, arguments.count), arguments.rate),
        lost=lambda: finite.n_left_out,
        faults=faults,
    )


def _tx_center_frequency(path: str, frames: RadarArrays) -> int:
    """Return the setting of a recording; the default where the recording does not have it."""
    found = frames.settings.get(X4Setting.TXCENTERFREQUENCY.name)
    if found is None:
        return RawConfig().tx_center_frequency
    if found not in CARRIER_HZ:
        raise CommandFailed(
            f"{path} was recorded at TXCENTERFREQUENCY {found}, whose carrier is not known; "
            "record at 3 or 4"
        )
    return int(found)


def _all_frames(radar: RadarArrays, rate_hz: float, *, with_times: bool) -> Iterator[TimedFrame]:
    """Yield the frames of a recording; where their time is not known, at equal intervals."""
    steps, known_s, before_ns = -1, 0.0, NO_TIME_NS
    for block in radar.blocks(_BLOCK_FRAMES):
        frames = block.iq if block.kind == "iq" else block.rf
        assert frames is not None, "of this kind"
        times_ns = np.full(len(frames), NO_TIME_NS)
        if with_times and block.t_ns is not None:
            times_ns = block.t_ns
        for samples, t_ns in zip(frames, times_ns.tolist(), strict=True):
            if NO_TIME_NS in (t_ns, before_ns):
                steps += 1
            else:
                known_s += max((t_ns - before_ns) * 1e-9, 0.0)
            before_ns = t_ns
            yield TimedFrame(known_s + steps / rate_hz, samples)


def _paced(frames: Iterator[TimedFrame], rate: float) -> Iterator[TimedFrame]:
    """Yield frames when their time has come; at rate 0 at once."""
    began_s = time.monotonic()
    for frame in frames:
        if rate:
            time.sleep(max(began_s + frame.t_s / rate - time.monotonic(), 0.0))
        yield frame
