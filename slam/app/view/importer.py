"""The command `rerun-importer-xethru`: vendor recordings and wire captures in the Rerun viewer.

Rerun calls every executable of that prefix on PATH with each file that its user opens, and reads
what it draws from its standard output. Exit code 66 means "not mine", so nothing heavy is imported
before that is known.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slam.app.errors import EXIT_USAGE
from slam.live.errors import EXIT_FAILED, AppError
from xethru_protocol.operating_system import (
    STDERR,
    STDOUT,
    flush_streams,
    one_line,
    open_closed_streams,
)
from xethru_protocol.recordings import RecordingError
from xethru_protocol.recordings.formats import recording_format
from xethru_protocol.recordings.vendor.layouts import META_NAME
from xethru_protocol.recordings.wire_capture import SUFFIX, read_note

INCOMPATIBLE = 66
"""Exit code by which Rerun learns that a file is for other importers."""


def main(argv: Sequence[str] | None = None) -> int:
    """Draw a recording on standard output as Rerun asks for it; return the exit code."""
    open_closed_streams()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    options = _parser().parse_known_args(argv)[0]
    path = Path(options.path)
    if not _is_ours(path):
        return INCOMPATIBLE
    if STDOUT.is_terminal:
        return _end(
            "the drawing is for the Rerun viewer, not for a terminal; "
            f"open the recording with it: rerun {path}",
            EXIT_USAGE,
        )
    try:
        if path.suffix == SUFFIX:
            read_note(path)  # says what is wrong with a head that is not one
        # Rerun takes half a second to load
        from slam.app.view.raw_recording import draw

        with np.errstate(all="ignore"):  # samples of a damaged recording may be anything
            faults = draw(
                path,
                recording_id=options.recording_id,
                application_id=options.application_id,
                entity_path_prefix=options.entity_path_prefix,
            )
    except (RecordingError, AppError) as error:
        return _end(str(error), EXIT_FAILED)
    if faults.first is not None:
        more = f", and {faults.costly - 1} more, see its log" if faults.costly > 1 else ""
        return _end(f"{path}: damaged; {faults.first}{more}", EXIT_FAILED)
    return 0


def _end(text: str, code: int) -> int:
    """Print why the command fails; return its exit code."""
    STDERR.write_soon(f"rerun-importer-xethru: {one_line(text)}\n")
    flush_streams()
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rerun-importer-xethru",
        description="Draws a recording of ModuleConnector or a wire capture (.xtwire) for the "
        "Rerun viewer, which calls this by itself when such a file is opened: rerun FILE.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "path", help="a recording's folder, its meta file, a data file, or *.xtwire"
    )
    parser.add_argument("--application-id", default="xethru-hil", help="recommended by the viewer")
    parser.add_argument("--recording-id", help="recommended by the viewer")
    parser.add_argument("--entity-path-prefix", default="", help="what all entities are put under")
    ignored = parser.add_argument_group("accepted, without effect: a recording has its own times")
    for flag in ("--static", "--timeless"):
        ignored.add_argument(flag, action="store_true", help=argparse.SUPPRESS)
    for name in ("--opened-application-id", "--opened-recording-id", "--time", "--sequence"):
        ignored.add_argument(name, action="append", help=argparse.SUPPRESS)
    for name in ("--time_sequence", "--time_duration_nanos", "--time_timestamp_nanos"):
        ignored.add_argument(name, action="append", help=argparse.SUPPRESS)
    return parser


def _is_ours(path: Path) -> bool:
    """Return whether a path is a recording that no importer of Rerun's own reads."""
    if path.suffix == SUFFIX and path.is_file():
        return True  # if its head is damaged, it is for us to say so
    try:
        if path.is_dir():
            return any(path.glob("xethru_*")) or (path / META_NAME).exists()
        return recording_format(path) in {"vendor", "wire"}
    except (RecordingError, OSError):
        return False


if __name__ == "__main__":
    sys.exit(main())
