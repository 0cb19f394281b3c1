"""Kinds of wire fields whose length another field counts.

A `Count` lies on the wire only: a row declares it as ``ClassVar``, so that a message has the
list and not, beside it, a number that could contradict it. Kinds in general: ``wire``.
"""
# ruff: noqa: ANN401 - a kind handles whatever type its field has

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from xethru_protocol.wire import Elements, Fields, hex_bytes


def text_bytes(value: str | bytes) -> bytes:
    """Bytes of a text as it travels: one per character, and a terminating NUL."""
    return (value if isinstance(value, bytes) else value.encode("latin-1")) + b"\x00"


def text_size(value: str | bytes) -> int:
    """Bytes that a text takes, its NUL included."""
    return len(text_bytes(value))


@dataclass(frozen=True, slots=True)
class Count:
    """A u32 that counts the entries of the lists ``of``, which are equally long.

    ``per`` entries count as one; ``label`` is its name in a dump, none if it is not shown.
    """

    of: tuple[str, ...]
    label: str = ""
    per: int = 1
    size: Callable[[Any], int] = len

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        """Pack the count; ``ValueError`` if the lists differ in length."""
        return struct.pack("<I", self._count(fields))

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        """Unpack the count."""
        (count,) = struct.unpack_from("<I", data, start)
        return count, start + 4

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        """Show the count, where the vectors do."""
        return {self.label: self._count(fields)} if self.label else {}

    def _count(self, fields: Fields) -> int:
        entries, *others = (self.size(fields[name]) for name in self.of)
        if any(other != entries for other in others) or entries % self.per:
            raise ValueError(f"{' and '.join(self.of)} must have one length, of whole entries")
        return entries // self.per


@dataclass(frozen=True, slots=True)
class Floats:
    """``per`` float32 values for each entry that the field ``count`` announces."""

    count: str
    label: str = ""
    per: int = 1
    empty_shown: bool = False

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        """Pack the values."""
        return struct.pack(f"<{len(value)}f", *value)

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        """Unpack the values; ``struct.error`` if there are fewer than announced."""
        size = fields[self.count] * self.per
        return struct.unpack_from(f"<{size}f", data, start), start + 4 * size

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        """Show the values; an empty list is not shown."""
        return {self.label or name: list(value)} if value or self.empty_shown else {}


@dataclass(frozen=True, slots=True)
class Block:
    """As many bytes as the field ``count`` announces."""

    count: str
    label: str = ""
    shown: Callable[[bytes], Any] = hex_bytes

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        """Pack the bytes; ``ValueError`` if the message itself counts them otherwise."""
        if fields.get(self.count, len(value)) != len(value):
            raise ValueError(f"{len(value)} bytes, but {self.count} is {fields[self.count]}")
        return bytes(value)

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        """Unpack the bytes; ``ValueError`` if there are fewer than announced."""
        end = start + fields[self.count]
        if end > len(data):
            raise ValueError("fewer bytes than announced")
        return data[start:end], end

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        """Show the bytes."""
        return {self.label or name: self.shown(value)}


@dataclass(frozen=True, slots=True)
class Text:
    """A NUL-terminated text, one byte per character; the field ``count`` includes the NUL.

    The NUL is no part of the value; a text that comes without one is accepted.
    """

    count: str
    label: str = ""

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        """Pack the text and its NUL."""
        return text_bytes(value)

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        """Unpack the text; ``ValueError`` if it is shorter than announced."""
        end = start + fields[self.count]
        if end > len(data):
            raise ValueError("a shorter text than announced")
        return data[start:end].removesuffix(b"\x00").decode("latin-1"), end

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        """Show the text."""
        text = value.decode("latin-1") if isinstance(value, bytes) else value
        return {self.label or name: text}


@dataclass(frozen=True, slots=True)
class TypedElements:
    """An element list whose type an earlier field tells."""

    field: str
    types: Mapping[int, Elements]

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        """Pack as that type's list; ``ValueError`` if there is no such type."""
        return self._elements(fields).pack(value, fields, bulk)

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        """Unpack that type's list."""
        return self._elements(fields).unpack(data, start, fields)

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        """Show that type's list."""
        return self._elements(fields).show(name, value, fields)

    def _elements(self, fields: Fields) -> Elements:
        elements = self.types.get(fields[self.field])
        if elements is None:
            raise ValueError("there is no such element type")
        return elements
