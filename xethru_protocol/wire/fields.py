"""Kinds of wire fields: what ``KIND`` in ``Annotated[type, KIND]`` of a message may be.

A kind knows how one field is packed, unpacked and shown. The codec walks a message's fields in
order; the layouts themselves are in the rows. All numbers are little-endian, unpadded
(Protocol reference, head). A kind raises ``struct.error`` or ``ValueError`` when the bytes do not
fit; the codec turns that into `UnknownMessage`.

A `Count` lies on the wire only: a row declares it as ``ClassVar``, so that a message has the
list and not, beside it, a number that could contradict it.
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, Protocol, Self

import numpy as np
import numpy.typing as npt

# ruff: noqa: ANN401 - a kind handles whatever type its field has


FLOAT32 = np.dtype("<f4")
UINT32 = np.dtype("<u4")
INT16 = np.dtype("<i2")
# A message's fields by name; while unpacking, those before this one.
Fields = Mapping[str, Any]


class FieldKind(Protocol):
    """One way to put a field on the wire."""

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        """Bytes of ``value``; ``bulk``: the packet travels in NoEscape framing."""

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        """Value at ``start`` and the offset behind it."""

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        """JSON-able entries of a dump."""


def _plain(value: Any) -> Any:
    return value


def hexadecimal(value: int) -> str:
    """Show an id as eight hexadecimal digits."""
    return f"0x{value:08X}"


def short_hexadecimal(value: int) -> str:
    """Show an id without leading zeros."""
    return f"0x{value:X}"


def hex_bytes(value: bytes) -> str:
    """Show bytes as spaced upper-case hexadecimal."""
    return value.hex(" ").upper()


@dataclass(frozen=True, slots=True)
class Number:
    """One scalar: a ``struct`` code, how a dump shows it, and the least that is accepted.

    ``enum`` names the values that are documented; others are passed on all the same.
    """

    code: str
    label: str = ""
    shown: Callable[[Any], Any] = _plain
    order: str = "<"
    least: float | None = None
    enum: type[IntEnum] | None = None

    def of(self, enum: type[IntEnum]) -> Self:
        """Return this kind of number with names for its values."""
        return replace(self, enum=enum)

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        self._check(value)
        return struct.pack(self.order + self.code, value)

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        (value,) = struct.unpack_from(self.order + self.code, data, start)
        self._check(value)
        return value, start + struct.calcsize(self.order + self.code)

    def _check(self, value: Any) -> None:
        if self.least is not None and value < self.least:
            raise ValueError(f"{value} is less than {self.least}")

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        return {self.label or name: self.shown(value)}


U8 = Number("B")
U32 = Number("I")
F32 = Number("f")
ID32 = Number("I", shown=hexadecimal)


@dataclass(frozen=True, slots=True)
class Member:
    """A u32 that must be a member of ``enum``; shown by its name."""

    enum: type[IntEnum]
    label: str

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        return struct.pack("<I", self.enum(value))

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        (value,) = struct.unpack_from("<I", data, start)
        return self.enum(value), start + 4

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        return {self.label: self.enum(value).name}


@dataclass(frozen=True, slots=True)
class Spelling:
    """A code that belongs to the prefix and has several values for one and the same message.

    Must be a row's first field: the row is entered once per value. The value ``usual`` is not
    shown.
    """

    codes: tuple[int, ...]
    usual: int | None = None
    shown: Callable[[int], Any] = short_hexadecimal

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        if value not in self.codes:
            raise ValueError("this code is another message's")
        return bytes((value,))

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        return data[start], start + 1

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        """Show which code was used, unless it is the usual one."""
        return {} if value == self.usual else {name: self.shown(value)}


@dataclass(frozen=True, slots=True)
class OptionalByte:
    """A trailing u8 that may be absent (None)."""

    wanted: Callable[[Fields], bool] = lambda fields: True
    required: bool = False
    shown_if_absent: bool = False

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        if value is None and self.required and self.wanted(fields):
            raise ValueError("the address is missing")
        return b"" if value is None else bytes((value,))

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        if not self.wanted(fields):
            return None, start
        if start < len(data):
            return data[start], start + 1
        if self.required:
            raise ValueError("the address is missing")
        return None, start

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        return {} if value is None and not self.shown_if_absent else {name: value}


@dataclass(frozen=True, slots=True)
class ByDiscriminator:
    """A value whose struct layout depends on an earlier field.

    ``layouts[id]`` is ``(codes, names)``: one scalar, or a tuple of several. ``short`` lists
    ids whose single value may also travel in one byte; which form was used is kept in the
    field ``width_field`` (None: the normal form), so that a decoded message encodes to the
    bytes it came from.
    """

    field: str
    layouts: Mapping[int, tuple[str, tuple[str, ...]]]
    short: frozenset[int] = frozenset()
    width_field: str = ""

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        key = fields[self.field]
        if key not in self.layouts:
            raise ValueError("this setting cannot be set")
        codes, names = self.layouts[key]
        if key in self.short and fields[self.width_field] == 1:
            codes = "B"
        return struct.pack("<" + codes, *(value if len(names) > 1 else (value,)))

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        key = fields[self.field]
        codes, names = self.layouts[key]
        if key in self.short and fields[self.width_field] == 1:
            codes = "B"
        values = struct.unpack_from("<" + codes, data, start)
        return (values if len(names) > 1 else values[0]), start + struct.calcsize("<" + codes)

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        names = self.layouts[fields[self.field]][1]
        return dict(zip(names, value if len(names) > 1 else (value,), strict=True))


@dataclass(frozen=True, slots=True)
class ShortForm:
    """Pseudo field, no bytes: 1 if the value that follows travels in one byte, else None."""

    field: str
    short: frozenset[int]

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        if value not in (None, 1):
            raise ValueError("a value is one byte wide or as the firmware parses it (None)")
        return b""

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        """Determine the form by the bytes that are left."""
        return (1 if fields[self.field] in self.short and len(data) - start == 1 else None), start

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        """Nothing: the value itself is shown."""
        return {}


@dataclass(frozen=True, slots=True)
class Elements:
    """Element list of REPLY and DATA: ``[u32 count] elements [trailer]``.

    The count is absent when it is 0, except in NoEscape framing. REPLYs other than INT end with
    a trailer byte; it is optional on receipt (Protocol reference 5.2, 6).
    """

    code: str  # struct code of one element; "a" float32 array, "s" text, "c" raw bytes
    size: int
    label: str
    trailer: int | None = None
    count_label: str = ""  # the name under which a dump shows the count
    trailer_shown: bool = False

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        body = self._bytes(value)
        count = b"" if not body and not bulk else struct.pack("<I", len(body) // self.size)
        return count + body + (b"" if self.trailer is None else bytes((self.trailer,)))

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        """Unpack the elements; a missing count or trailer is accepted."""
        rest = len(data) - start
        if rest <= (0 if self.trailer is None else 1):
            return self._value(b""), len(data)
        (count,) = struct.unpack_from("<I", data, start)
        begin = start + 4
        end = begin + count * self.size
        if end > len(data):
            raise ValueError(f"{count} elements announced, fewer present")
        return self._value(data[begin:end]), end

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        shown: dict[str, Any] = {}
        if self.count_label:
            shown[self.count_label] = len(self._bytes(value)) // self.size
        if isinstance(value, bytes):
            shown[self.label] = list(value) if self.trailer_shown else hex_bytes(value)
        elif isinstance(value, str):
            shown[self.label] = value
        elif isinstance(value, np.ndarray):
            shown[self.label] = value.tolist()
        else:
            shown[self.label] = [item.item() if hasattr(item, "item") else item for item in value]
        if self.trailer_shown:
            shown["trailer"] = self.trailer
        return shown

    def _bytes(self, value: Any) -> bytes:
        if self.code == "a":
            return np.ascontiguousarray(value, dtype=FLOAT32).tobytes()
        if self.code == "s":
            return str(value).encode("latin-1")
        if self.code == "c":
            return bytes(value)
        return struct.pack(f"<{len(value)}{self.code}", *value)

    def _value(self, body: bytes) -> Any:
        if self.code == "a":
            return np.frombuffer(body, dtype=FLOAT32)
        if self.code == "s":
            return body.decode("latin-1")  # every byte is a character: no wire text can fail
        if self.code == "c":
            return body
        return struct.unpack(f"<{len(body) // self.size}{self.code}", body)


@dataclass(frozen=True, slots=True)
class Bins:
    """An array with one value per bin; the bin count is the field ``count_field``.

    ``dtype`` is that of a value; behind the ``last`` array of a message no byte may follow.
    """

    count_field: str
    label: str = ""
    dtype: np.dtype[Any] = FLOAT32
    last: bool = False

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        array: npt.NDArray[Any] = np.ascontiguousarray(value, dtype=self.dtype)
        if array.shape != (fields[self.count_field],):
            raise ValueError(f"{array.shape} values for {fields[self.count_field]} bins")
        return array.tobytes()

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        """Unpack the array, as a view on its own copy of the bytes."""
        end = start + self.dtype.itemsize * fields[self.count_field]
        if end > len(data) or (self.last and end < len(data)):
            raise ValueError("the bins are not as many as announced")
        return np.frombuffer(data[start:end], dtype=self.dtype), end

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        return {self.label or name: value.tolist()}


@dataclass(frozen=True, slots=True)
class RestBytes:
    """All bytes that are left."""

    shown: Callable[[bytes], Any] = hex_bytes
    label: str = ""
    empty_shown: bool = True

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        return bytes(value)

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        return data[start:], len(data)

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        return {self.label or name: self.shown(value)} if value or self.empty_shown else {}


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
        return struct.pack("<I", self._count(fields))

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        (count,) = struct.unpack_from("<I", data, start)
        return count, start + 4

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
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
        return struct.pack(f"<{len(value)}f", *value)

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        size = fields[self.count] * self.per
        return struct.unpack_from(f"<{size}f", data, start), start + 4 * size

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
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
        end = start + fields[self.count]
        if end > len(data):
            raise ValueError("fewer bytes than announced")
        return data[start:end], end

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        return {self.label or name: self.shown(value)}


@dataclass(frozen=True, slots=True)
class Text:
    """A NUL-terminated text, one byte per character; the field ``count`` includes the NUL.

    The NUL is not part of the value; a text that comes without one is accepted.
    """

    count: str
    label: str = ""

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        return text_bytes(value)

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        end = start + fields[self.count]
        if end > len(data):
            raise ValueError("a shorter text than announced")
        return data[start:end].removesuffix(b"\x00").decode("latin-1"), end

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        text = value.decode("latin-1") if isinstance(value, bytes) else value
        return {self.label or name: text}


@dataclass(frozen=True, slots=True)
class TypedElements:
    """An element list whose type an earlier field gives."""

    field: str
    types: Mapping[int, Elements]

    def pack(self, value: Any, fields: Fields, bulk: bool) -> bytes:
        return self._elements(fields).pack(value, fields, bulk)

    def unpack(self, data: bytes, start: int, fields: Fields) -> tuple[Any, int]:
        return self._elements(fields).unpack(data, start, fields)

    def show(self, name: str, value: Any, fields: Fields) -> dict[str, Any]:
        return self._elements(fields).show(name, value, fields)

    def _elements(self, fields: Fields) -> Elements:
        elements = self.types.get(fields[self.field])
        if elements is None:
            raise ValueError("there is no such element type")
        return elements
