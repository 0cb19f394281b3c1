"""The artefacts of a test that failed, one folder per test: wire, log, scene, seeds, view.

| file | what |
|---|---|
| `log.txt` | every packet both ways, decoded, and other bytes; why the test failed |
| `wire.mcap` | the bytes as they passed (`/radar/NAME/rx`, `/tx`), and the module's messages |
| `about.json` | test, radar, identity, seeds, versions, link statistics, measurements |
| `scene.toml` | the scene of an emulated radar, if it has one |
| `session.rrd` | frames, messages and measurements for Rerun |

`xethru dump wire.mcap` prints the module's messages.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import platform
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hil_tests.plugin.findings import Findings, Measurement
from hil_tests.plugin.radar_targets import WireBytes, WireTap
from hil_tests.plugin.session_radars import RadarUnderTest
from xethru_protocol.recordings.mcap import BYTE_ARRAY, SCHEMAS, McapWriter, pack_array
from xethru_protocol.recordings.wire_capture import Way
from xethru_protocol.wire.codec import describe, encode
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NEED_DATA, FramingFault
from xethru_protocol.wire.messages import BasebandIq, Command, DataFloat, Message

if TYPE_CHECKING:
    import rerun as rr

_SHOWN_BYTES = 64
_LONGEST_NAME = 150
_MOST_FRAMES = 512  # the last ones of each radar


def folder_name(nodeid: str, tries: int = 1) -> str:
    """Return the folder name of a test: its id, with ``-`` for special characters.

    From the second try of `--reruns` on the number of the try follows.

    >>> folder_name("hil_tests/device/test_raw.py::test_frames[emu-lab]")
    'hil_tests-device-test_raw.py-test_frames-emu-lab'
    >>> folder_name("test_raw.py::test_frames[emu]", 2)
    'test_raw.py-test_frames-emu-try2'
    """
    name = re.sub(r"[^0-9A-Za-z._]+", "-", nodeid).strip("-")[-_LONGEST_NAME:]
    return name if tries == 1 else f"{name}-try{tries}"


def write_bundle(folder: Path, findings: Findings, about: Mapping[str, Any]) -> None:
    """Write the folder of one test, replacing the files of an earlier run."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in ("log.txt", "wire.mcap", "about.json", "scene.toml", "session.rrd"):
        (folder / old).unlink(missing_ok=True)
    radars, measurements = findings.radars, findings.measurements
    failure = "\n\n".join(findings.failures) or "none"
    taps = {radar.spec.name: radar.tap for radar in radars}
    (folder / "log.txt").write_text(_log(radars, failure), "utf-8")
    (folder / "about.json").write_text(
        json.dumps(_about(radars, about, measurements), indent=2) + "\n", "utf-8"
    )
    for radar in radars:
        if radar.place.scene_text is not None:
            (folder / "scene.toml").write_text(radar.place.scene_text, "utf-8")
    _write_wire(folder / "wire.mcap", taps)
    with contextlib.suppress(ImportError):  # the rest of the bundle does without
        _write_rrd(folder / "session.rrd", taps, measurements, failure)


def _log(radars: Sequence[RadarUnderTest], failure: str) -> str:
    lines = []
    for radar in radars:
        tap = radar.tap
        lines.append(f"=== {radar.spec.name}: {radar.identity or 'never answered'}")
        lines.append(f"    {radar.place.description}; --radar '{radar.spec.text}'")
        if tap.forgotten_bytes:
            lines.append(f"    the first {tap.forgotten_bytes} bytes were not kept")
        for passed, events in decoded(tap):
            time_s = (passed.t_ns - tap.started_ns) * 1e-9
            shown = passed.data[:_SHOWN_BYTES].hex(" ").upper()
            more = len(passed.data) - _SHOWN_BYTES
            lines.append(
                f"{time_s:12.6f} s  {passed.way}  {shown}" + (f" ... +{more}" if more > 0 else "")
            )
            lines.extend(f"{'':20}{_event_text(event, passed.way)}" for event in events)
            if passed.way == "tx" and not any(isinstance(event, Command) for event in events):
                lines.append(f"{'':20}!! no command that the module can read ends here")
        for driver in radar.drivers:
            lines.extend(f"    driver's warning: {text}" for text in driver.warnings)
            lines.append(f"    link statistics: {json.dumps(driver.statistics.summary())}")
    return "\n".join([*lines, "", "=== failure", failure, ""])


def _event_text(event: Message | FramingFault, way: Way) -> str:
    if isinstance(event, FramingFault):
        who = "the module" if way == "tx" else "the driver"
        return f"!! {who} cannot read this: {event.kind.value}, byte {event.offset} of the line"
    if isinstance(event, DataFloat):
        return f"frame {event.info}: {event.values.size} values, content {event.content_id}"
    if isinstance(event, BasebandIq):
        return f"baseband frame {event.counter}: {event.num_bins} bins"
    name, fields = describe(event)
    return f"{name} {json.dumps(fields)}" if fields else name


def _about(
    radars: Sequence[RadarUnderTest], about: Mapping[str, Any], measurements: Sequence[Measurement]
) -> dict[str, Any]:
    return {
        **about,
        "radars": [
            {
                "name": radar.spec.name,
                "spec": radar.spec.text,
                "reached": radar.place.description,
                "identity": radar.identity,
                "capabilities": sorted(radar.place.capabilities),
                "seed": radar.spec.seed if radar.spec.emulated else None,
                "started_unix_ns": radar.tap.started_unix_ns,
                "forgotten_bytes": radar.tap.forgotten_bytes,
                "statistics": [driver.statistics.summary() for driver in radar.drivers],
                "warnings": [text for driver in radar.drivers for text in driver.warnings],
            }
            for radar in radars
        ],
        "measurements": [measurement.as_json() for measurement in measurements],
        "versions": {
            "python": platform.python_version(),
            **{
                name: importlib.metadata.version(name)
                for name in ("xethru-hil", "pytest", "numpy", "pyserial")
            },
        },
    }


def decoded(tap: WireTap) -> Iterator[tuple[WireBytes, Sequence[Message | FramingFault]]]:
    """Yield each piece that passed with the messages and faults that it completed.

    Commands are read as the module reads them, answers as the driver does.
    """
    ends = {"tx": Connection(Role.MODULE), "rx": Connection(Role.HOST)}
    for passed in tap.passed:
        end = ends[passed.way]
        end.receive_data(passed.data)
        events: list[Message | FramingFault] = []
        while (event := end.next_event()) is not NEED_DATA:
            if isinstance(event, Message | FramingFault):
                events.append(event)
        yield passed, events


def _write_wire(path: Path, taps: Mapping[str, WireTap]) -> None:
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        schema = SCHEMAS[BYTE_ARRAY].encode()
        for name, tap in taps.items():
            channels = {
                topic: writer.add_channel(f"/radar/{name}/{topic}", BYTE_ARRAY, schema, {})
                for topic in ("rx", "tx", "payload")
            }
            for passed, events in decoded(tap):
                heard = [] if passed.way == "tx" else events
                payloads = [encode(one) for one in heard if isinstance(one, Message)]
                for topic, data in [(passed.way, passed.data), *(("payload", p) for p in payloads)]:
                    writer.add_message(
                        channel_id=channels[topic],
                        log_time=tap.started_unix_ns + passed.t_ns - tap.started_ns,
                        publish_time=passed.t_ns,
                        data=pack_array(BYTE_ARRAY, np.frombuffer(data, np.uint8)),
                    )
        writer.finish()


def _write_rrd(
    path: Path, taps: Mapping[str, WireTap], measurements: Sequence[Measurement], failure: str
) -> None:
    """Write the view for Rerun; times are those of the driver's clock."""
    import rerun as rr  # half a second
    import rerun.blueprint as rrb

    scans = [
        rrb.TensorView(name=name, origin=f"/radar/{name}/bscan", view_fit="fill") for name in taps
    ]
    blueprint = rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*scans) if scans else rrb.TextLogView(origin="/log"),
            rrb.TextLogView(name="messages", origin="/log"),
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="expanded", timeline="time"),
        auto_views=False,
    )
    recording = rr.RecordingStream("xethru_hil_test")
    recording.set_log_time_enabled(False)
    recording.save(path, default_blueprint=blueprint)
    with recording:  # what is logged behind the block would be lost
        for name, tap in taps.items():
            _log_wire(recording, name, tap)
        for measurement in measurements:
            recording.log(f"measurements/{measurement.name}", rr.Scalars([measurement.value]))
            recording.log("log/measurements", rr.TextLog(f"{measurement.name}: {measurement.text}"))
        recording.log("log/failure", rr.TextLog(failure, level=rr.TextLogLevel.ERROR))


def _log_wire(recording: rr.RecordingStream, name: str, tap: WireTap) -> None:
    import rerun as rr

    frames: list[DataFloat] = []
    for passed, events in decoded(tap):
        recording.set_time("time", duration=(passed.t_ns - tap.started_ns) * 1e-9)
        for event in events:
            if isinstance(event, DataFloat):
                frames.append(event)
                continue
            is_fault = isinstance(event, FramingFault)
            level = rr.TextLogLevel.ERROR if is_fault else rr.TextLogLevel.INFO
            text = _event_text(event, passed.way)[:500]
            recording.log(f"log/{name}/{passed.way}", rr.TextLog(text, level=level))
    if not frames:
        return
    shown = [frame.values for frame in frames if frame.values.size == frames[-1].values.size]
    block = np.stack(shown[-_MOST_FRAMES:])
    recording.log(
        f"radar/{name}/bscan", rr.Tensor(block, dim_names=("frame", "value")), static=True
    )
