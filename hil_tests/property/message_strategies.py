"""Hypothesis strategies for messages, built from the rows of the message table."""

from typing import Any

import numpy as np
from hypothesis import strategies as st

from xethru_protocol.wire import fields as wire_kinds
from xethru_protocol.wire.messages import REGISTERS, X4DriverGet
from xethru_protocol.wire.table import ROWS, Message

FLOATS = st.floats(width=32, allow_nan=False)
BYTES = st.binary(max_size=40)
TEXTS = BYTES.map(lambda raw: raw.decode("latin-1"))
SCALARS: dict[str, st.SearchStrategy[Any]] = {
    "B": st.integers(0, 0xFF),
    "Hx": st.integers(0, 0xFFFF),
    "I": st.integers(0, 0xFFFFFFFF),
    "i": st.integers(-(1 << 31), (1 << 31) - 1),
    "f": FLOATS,
}
# Fields that count the entries of a list and are, unlike a `Count`, fields of their message.
COUNTS = {"num_bins", "frequency_count"}


def messages(kinds: type[Message] | None = None) -> st.SearchStrategy[Any]:
    """Any message of the table (or of one base), built from its row."""
    rows = [cls for cls in ROWS if kinds is None or issubclass(cls, kinds)]
    return st.sampled_from(rows).flatmap(of_type)


@st.composite
def of_type(draw: st.DrawFn, cls: type[Message]) -> Any:  # noqa: ANN401 - any row
    row = ROWS[cls]
    sizes = {name: draw(st.integers(0, 9)) for name in sorted(row.wire_only)}
    fields: dict[str, Any] = {}
    for name, kind in row.kinds:
        if name in COUNTS:
            assert isinstance(kind, wire_kinds.Number)
            fields[name] = sizes[name] = draw(st.integers(int(kind.least or 0), 40))
        elif (choices := _choices(row.kinds, name)) is not None:
            fields[name] = draw(st.sampled_from(choices))
        elif name not in row.wire_only:
            fields[name] = draw(_field(kind, fields, sizes))
    if cls is X4DriverGet and fields["setting"] not in REGISTERS:
        fields["address"] = None
    return cls(**fields)


def _choices(kinds: tuple[tuple[str, wire_kinds.FieldKind], ...], name: str) -> list[int] | None:
    """Values that a later field's layout depends on; None if none does."""
    for _, kind in kinds:
        if isinstance(kind, wire_kinds.ByDiscriminator) and kind.field == name:
            return list(kind.layouts)
        if isinstance(kind, wire_kinds.TypedElements) and kind.field == name:
            return list(kind.types)
    return None


def _field(  # noqa: PLR0911, PLR0912 - one case per kind of field
    kind: wire_kinds.FieldKind, fields: dict[str, Any], sizes: dict[str, int]
) -> st.SearchStrategy[Any]:
    match kind:
        case wire_kinds.Number():
            return SCALARS[kind.code]
        case wire_kinds.Member(enum=enum):
            return st.sampled_from(list(enum))
        case wire_kinds.Spelling(codes=codes):
            return st.sampled_from(codes)
        case wire_kinds.OptionalByte(required=True):
            return SCALARS["B"]
        case wire_kinds.OptionalByte():
            return st.none() | SCALARS["B"]
        case wire_kinds.ShortForm(short=short, field=field):
            return st.sampled_from([None, 1] if fields[field] in short else [None])
        case wire_kinds.ByDiscriminator():
            return _discriminated(kind, fields)
        case wire_kinds.Bins(count_field=count, dtype=dtype):
            return array(sizes[count], dtype)
        case wire_kinds.Floats(count=count, per=per):
            size = sizes[count] * per
            return st.lists(FLOATS, min_size=size, max_size=size).map(tuple)
        case wire_kinds.Block(count=count):
            return st.binary(min_size=sizes[count], max_size=sizes[count])
        case wire_kinds.Text():
            return TEXTS
        case wire_kinds.RestBytes():
            return BYTES
        case wire_kinds.TypedElements(field=field, types=types):
            return _elements(types[fields[field]])
        case wire_kinds.Elements():
            return _elements(kind)
    raise AssertionError(f"no strategy for {kind}")


def _discriminated(
    kind: wire_kinds.ByDiscriminator, fields: dict[str, Any]
) -> st.SearchStrategy[Any]:
    codes, names = kind.layouts[fields[kind.field]]
    if fields.get(kind.width_field) == 1:
        codes = "B"
    scalars = [SCALARS[code] for code in codes]
    return st.tuples(*scalars) if len(names) > 1 else scalars[0]


def _elements(kind: wire_kinds.Elements) -> st.SearchStrategy[Any]:
    match kind.code:
        case "a":
            return st.integers(0, 40).flatmap(array)
        case "c":
            return BYTES
        case "s":
            return TEXTS
    return st.lists(SCALARS[kind.code], max_size=9).map(tuple)


def array(size: int, dtype: "np.dtype[Any]" = wire_kinds.FLOAT32) -> st.SearchStrategy[Any]:
    """Arrays among whose bytes 7C 7D 7E 7F are likely: they are what can go wrong."""
    byte = st.sampled_from([0, 1, 0x3F, 0x7C, 0x7D, 0x7E, 0x7F])
    size *= dtype.itemsize
    raw = st.lists(byte, min_size=size, max_size=size).map(bytes)
    return raw.map(lambda data: np.frombuffer(data, dtype=dtype))
