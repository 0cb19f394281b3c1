"""MCAP files taken apart without our reader, and written again by mcap's own writer."""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

from xethru_protocol.recordings.mcap import CHUNK


def records_of(content: bytes | bytearray) -> Iterator[tuple[int, int]]:
    """Yield the kind and the place of each record that is not within a chunk."""
    at = 8
    while at + 9 <= len(content):
        yield content[at], at
        at += 9 + struct.unpack_from("<Q", content, at + 1)[0]


def chunks_of(content: bytes | bytearray) -> list[int]:
    return [at for kind, at in records_of(content) if kind == CHUNK]


def rewrite(
    source: Path,
    path: Path,
    change: Callable[[str, bytes], bytes | None],
    *,
    profile: str = "ros2",
    library: str = "xethru-hil",
    with_metadata: bool = True,
    finished: bool = True,
) -> None:
    """Write a file anew; ``change`` gets topic and data and returns new data, None to leave out."""
    with source.open("rb") as stream, path.open("wb") as target:
        reader, writer = make_reader(stream), Writer(target, chunk_size=50_000)
        writer.start(profile, library)
        for metadata in reader.iter_metadata() if with_metadata else ():
            writer.add_metadata(metadata.name, metadata.metadata)
        numbers: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            data = change(channel.topic, message.data)
            if data is None:
                continue
            if channel.id not in numbers:
                assert schema is not None
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
            writer.add_message(
                numbers[channel.id],
                message.log_time,
                data,
                message.publish_time,
                message.sequence,
            )
        if finished:
            writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates in part
