"""``xethru dump``: the messages of a recording, for people or as JSON."""

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

from xethru_protocol.cli.faults import warn_of
from xethru_protocol.cli.output import one_line, print_json, print_line
from xethru_protocol.cli.profiles import profile_name
from xethru_protocol.cli.progress import bytes_text, counted
from xethru_protocol.codec import describe, encode
from xethru_protocol.messages import Response, UnknownMessage
from xethru_protocol.packets import Framing
from xethru_protocol.recordings import (
    RecordingFault,
    RecordingSummary,
    describe_recording,
    read_recording,
)
from xethru_protocol.table import ROWS
from xethru_protocol.wire import hex_bytes

_FEW = 3  # elements of an array that are shown
_LONGEST_TEXT = 60


def dump(file: str, *, with_samples: bool, as_json: bool, radar: str | None) -> int:
    """Print every message of a recording; 1 if a part could not be read."""
    faults: list[RecordingFault] = []
    if as_json:
        for message, t_ns in read_recording(file, faults.append, radar=radar):
            print_json(_as_json(message, t_ns))
    else:
        summary = describe_recording(file, radar=radar)
        for line in _head(summary):
            print_line(line)
        for message, t_ns in read_recording(file, faults.append, radar=radar):
            time = _since(t_ns, summary.start_ns)
            print_line(f"{time}  {message_line(message, with_samples=with_samples)}")
    warn_of("dump", faults)
    return 1 if faults else 0


def message_line(message: Response, *, with_samples: bool) -> str:
    """One line about a message: its name and fields, long ones cut unless asked for.

    >>> from xethru_protocol.messages import DataFloat
    >>> import numpy as np
    >>> message = DataFloat(info=7, values=np.arange(5, dtype=np.float32) / 3)
    >>> message_line(message, with_samples=False)
    'DATA FLOAT content_id=0 info=7 length=5 data=[0, 0.333333, 0.666667, ... 5 in all]'
    """
    name, shown = describe(message)
    parts = (f"{key}={_text(value, with_samples)}" for key, value in shown.items())
    return " ".join([name, *parts])


def _as_json(message: Response, t_ns: int | None) -> dict[str, Any]:
    bulk = not isinstance(message, UnknownMessage) and ROWS[type(message)].bulk
    name, shown = describe(message)
    return {
        "framing": (Framing.NO_ESCAPE if bulk else Framing.NORMAL).value,
        "payload_hex": hex_bytes(encode(message, bulk=bulk)),
        "message": name,
        "fields": shown,
        "t_ns": t_ns,
    }


def _head(summary: RecordingSummary) -> Iterator[str]:
    total = sum(summary.messages.values())
    yield (
        f"{one_line(str(summary.path))}: {summary.format} recording, {counted(total, 'message')}, "
        f"{bytes_text(summary.size_bytes)}"
    )
    for name, count in sorted(summary.messages.items()):
        yield f"  {count} {name}"
    if summary.start_ns is not None and summary.duration_ns is not None:
        start = datetime.fromtimestamp(summary.start_ns // 10**9, UTC)
        ms = summary.start_ns % 10**9 // 10**6
        yield f"  from {start:%Y-%m-%d %H:%M:%S}.{ms:03d} UTC, {summary.duration_ns * 1e-9:.3f} s"
    else:
        yield "  times are not known"
    if summary.session_id:
        yield f"  session {one_line(summary.session_id)}"
    if summary.profile_id:
        yield f"  profile {profile_name(summary.profile_id)}"
    if summary.parameter_file is not None:
        yield f"  parameter file {one_line(summary.parameter_file)}"
    yield ""


def _since(t_ns: int | None, start_ns: int | None) -> str:
    if t_ns is None or start_ns is None:
        return f"{'-':>12}"
    return f"{(t_ns - start_ns) * 1e-9:12.6f}"


def _text(value: Any, whole: bool) -> str:  # noqa: ANN401 - any JSON value
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        shown = [_text(item, whole) for item in (value if whole else value[:_FEW])]
        if len(shown) < len(value):
            shown.append(f"... {len(value)} in all")
        return f"[{', '.join(shown)}]"
    if isinstance(value, dict):
        return " ".join(f"{key}={_text(item, whole)}" for key, item in value.items())
    text = one_line(str(value))
    return text if whole or len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."
