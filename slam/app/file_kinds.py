"""What a file is that was given in place of another: by its first bytes, in a few words."""

from __future__ import annotations

from pathlib import Path

_KINDS = {
    b"RRF": "a Rerun recording (.rrd), a view that other versions of Rerun may not open; the "
    "record of the run is the session.mcap beside it",
    b"#ROSBAG V2": "a bag of ROS 1; `uwb-slam convert` makes a session of it",
    b"#ROSBAG": "a bag of ROS 1 of an old version; `rosbag migrate` it first",
    b"SQLite format 3\0": "an SQLite file, like those in a rosbag2 folder; give that folder to "
    "`uwb-slam convert`",
    b"\x89XTWIRE": "a wire capture of one port; `xethru dump` reads it",
    b"MATLAB 5.0 MAT-file": "a MATLAB file; `uwb-slam convert` reads detections from it",
    b"\x89HDF": "an HDF5 file",
    b"PK\x03\x04": "a zip archive; unpack it first",
    b"\x1f\x8b": "a gzip file; unpack it first",
    b"\x28\xb5\x2f\xfd": "a zstd file; unpack it first",
}


def describe_kind(path: Path) -> str:
    r"""Return ``, it is ...`` for a file that is known by its first bytes, or what to give instead.

    >>> from tempfile import NamedTemporaryFile
    >>> with NamedTemporaryFile() as file:
    ...     _ = file.write(b"#ROSBAG V2.0\n")
    ...     file.flush()
    ...     describe_kind(Path(file.name))
    ', it is a bag of ROS 1; `uwb-slam convert` makes a session of it'
    """
    if path.is_dir():
        return " with a rosbag2 in it" if (path / "metadata.yaml").exists() else ""
    with path.open("rb") as stream:
        head = stream.read(32)
    for magic, words in _KINDS.items():
        if head.startswith(magic):
            return f", it is {words}"
    return "; give the session.mcap of a run"
