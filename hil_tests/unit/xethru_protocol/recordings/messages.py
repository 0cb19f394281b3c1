"""What tests of recordings share: small messages, the vendor's recordings, and reading them."""

import json
from collections.abc import Iterable
from datetime import UTC
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pytest

from hil_tests.paths import FIXTURES
from xethru_protocol.cli import main
from xethru_protocol.recordings import (
    RecordingFault,
    RecordingWriter,
    WireCapture,
    WriterOptions,
    read_recording,
    recording_facts,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.connection import Connection, Role

RECORDINGS = FIXTURES / "recordings"
META = "xethru_recording_meta.dat"
MS = 1_000_000  # ns


def frame(counter: int, n_bins: int = 3) -> m.DataFloat:
    return m.DataFloat(info=counter, values=np.arange(n_bins, dtype=np.float32) + counter)


def presence(counter: int) -> m.PresenceSingle:
    return m.PresenceSingle(counter=counter, state=1, distance_m=1.5, direction=2, signal_quality=7)


def write_recording(
    path: Path, timed: Iterable[tuple[m.Response, int | None]], **options: Unpack[WriterOptions]
) -> None:
    """Write messages, each of which must be stored, as a directory of ModuleConnector."""
    in_utc: WriterOptions = {"timezone": UTC, **options}
    with RecordingWriter(path, **in_utc) as writer:
        for message, t_ns in timed:
            assert t_ns is not None
            assert writer.write(message, t_ns)


def write_again(source: Path, target: Path, **options: Unpack[WriterOptions]) -> None:
    """Write a recording of the vendor's from what is read; they were made where UTC is."""
    facts = recording_facts(source)
    as_before: WriterOptions = {
        "session_id": facts.session_id,
        "profile_id": facts.profile_id,
        "parameter_file": facts.parameter_file,
        "user_header": facts.user_header,
        "timezone": UTC,
        **options,
    }
    writer = RecordingWriter(target, **as_before)
    for message, t_ns in read_recording(source):
        assert t_ns is not None
        assert writer.write(message, t_ns)
    writer.close(stopped_ns=facts.stopped_ns, closed_ns=facts.closed_ns)


def write_capture(path: Path, timed: Iterable[tuple[m.Response, int | None]]) -> None:
    """Write messages of a module as bytes of a port."""
    module = Connection(Role.MODULE)
    with WireCapture(path) as capture:
        for message, t_ns in timed:
            capture.write("rx", module.send(message), t_ns)


def xethru(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Return what a command prints, which must succeed and warn of nothing."""
    assert main([str(argument) for argument in arguments]) == 0
    printed, errors = capsys.readouterr()
    assert errors == ""
    return printed


def dumped(capsys: pytest.CaptureFixture[str], path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in xethru(capsys, "dump", path, "--json").splitlines()]


def counters(path: Path) -> list[int]:
    """Return the counters of the radar frames in a recording."""
    messages = [message for message, _ in read_recording(path)]
    return [message.info for message in messages if isinstance(message, m.DataFloat)]


def read_with_faults(
    path: Path,
) -> tuple[list[tuple[m.Response, int | None]], list[RecordingFault]]:
    faults: list[RecordingFault] = []
    return list(read_recording(path, faults.append)), faults
