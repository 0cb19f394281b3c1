"""The view of a failed test: frames as a B-scan, what was said, what was measured.

The only file of the plugin that knows Rerun; loaded when a bundle is written.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hil_tests.plugin.measurements import Measurement
from hil_tests.plugin.places import WireTap
from xethru_protocol.wire.codec import describe
from xethru_protocol.wire.framing import FramingFault
from xethru_protocol.wire.messages import DataFloat, Message

__all__ = ["write_rrd"]

_MOST_FRAMES = 512  # the last ones of each radar


def write_rrd(
    path: Path, taps: Mapping[str, WireTap], measurements: Sequence[Measurement], failure: str
) -> None:
    """Write the file; times are those of the driver's clock."""
    recording = rr.RecordingStream("xethru_hil_test")
    recording.set_log_time_enabled(False)
    recording.save(path, default_blueprint=_blueprint(list(taps)))
    with recording:  # what is logged behind the block would be lost
        for name, tap in taps.items():
            _log_wire(recording, name, tap)
        for measurement in measurements:
            recording.log(f"measurements/{measurement.name}", rr.Scalars([measurement.value]))
            recording.log("log/measurements", rr.TextLog(f"{measurement.name}: {measurement.text}"))
        recording.log("log/failure", rr.TextLog(failure, level=rr.TextLogLevel.ERROR))


def _blueprint(names: Sequence[str]) -> rrb.Blueprint:
    scans = [
        rrb.TensorView(name=name, origin=f"/radar/{name}/bscan", view_fit="fill") for name in names
    ]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*scans) if scans else rrb.TextLogView(origin="/log"),
            rrb.TextLogView(name="what was said", origin="/log"),
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="expanded", timeline="time"),
        auto_views=False,
    )


def _log_wire(recording: rr.RecordingStream, name: str, tap: WireTap) -> None:
    from hil_tests.plugin.bundle import decoded

    frames: list[DataFloat] = []
    for passed, events in decoded(tap):
        recording.set_time("time", duration=(passed.t_ns - tap.started_ns) * 1e-9)
        for event in events:
            if isinstance(event, DataFloat):
                frames.append(event)
            else:
                _log_event(recording, f"log/{name}/{passed.way}", event)
    if not frames:
        return
    shown = [frame.values for frame in frames if frame.values.size == frames[-1].values.size]
    block = np.stack(shown[-_MOST_FRAMES:])
    recording.log(
        f"radar/{name}/bscan", rr.Tensor(block, dim_names=("frame", "value")), static=True
    )


def _log_event(recording: rr.RecordingStream, path: str, event: Message | FramingFault) -> None:
    if isinstance(event, FramingFault):
        text, level = f"{event.kind.value} at byte {event.offset}", rr.TextLogLevel.ERROR
    else:
        message, fields = describe(event)
        text, level = f"{message} {json.dumps(fields)}"[:500], rr.TextLogLevel.INFO
    recording.log(path, rr.TextLog(text, level=level))
