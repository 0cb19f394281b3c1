"""The golden vectors.

``protocol_vectors.json`` holds the byte strings of the vendor's documents and parser,
``hand_vectors.json`` in the same form those assembled by hand, from the layouts of the Protocol
reference, for rows and codes that the former do not show.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from hil_tests.paths import FIXTURES

Fields = dict[str, Any]


# Entries of a vector that are not fields of its message.
ABOUT = {
    *("framing", "payload", "checksum", "checksum_printed", "checksum_computed", "message"),
    *("note", "kind", "expect", "length_field", "reserved", "first", "last", "total_bytes", "rule"),
}


@dataclass(frozen=True, slots=True)
class Vector:
    """One entry of ``fixtures/wire/*_vectors.json``."""

    name: str
    from_host: bool
    wire: bytes
    decoded: Fields
    valid: bool

    @property
    def message(self) -> str:
        """What the vector calls its message; empty for streams."""
        return str(self.decoded.get("message", ""))

    @property
    def is_stream(self) -> bool:
        """Whether the vector is about framing rather than one message."""
        return self.decoded["framing"] == "stream" or self.name.startswith("stream_")

    @property
    def payload(self) -> bytes | None:
        text = self.decoded.get("payload")
        return None if text is None else bytes.fromhex(text)


def load(file: str = "protocol_vectors.json") -> tuple[Vector, ...]:
    text = (FIXTURES / "wire" / file).read_text("utf-8")
    return tuple(
        Vector(
            entry["name"],
            entry["direction"] == "host->module",
            bytes.fromhex(entry["hex"]),
            entry["decoded"],
            entry["valid"],
        )
        for entry in json.loads(text)
    )


def load_hand_made() -> tuple[Vector, ...]:
    return load("hand_vectors.json")


def for_each(vectors: Sequence[Vector]) -> Callable[[Callable[[Vector], None]], Callable[[], None]]:
    """Make one test of a function of a vector; a failure names the vector."""

    def decorate(check: Callable[[Vector], None]) -> Callable[[], None]:
        def test_all() -> None:
            assert vectors
            for vector in vectors:
                try:
                    check(vector)
                except Exception as error:
                    error.add_note(f"with the vector {vector.name}")
                    raise

        return test_all

    return decorate
