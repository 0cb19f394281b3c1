"""The message table as plain data, from which every exported file is written."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum

from xethru_protocol.wire import fields
from xethru_protocol.wire import messages as messages  # importing them enters all table
from xethru_protocol.wire.table import ROWS, Command, Message, Row

TYPES = {"B": "u1", "I": "u4", "i": "s4", "f": "f4", "a": "f4", "c": "bytes", "s": "text"}
TYPES |= {"H": "u2be"}
DTYPES = {fields.FLOAT32: "f4", fields.UINT32: "u4", fields.INT16: "s2"}
SIZES = {"u1": 1, "u2be": 2, "s2": 2, "u4": 4, "s4": 4, "f4": 4, "bytes": 1, "text": 1}

EnumType = type[IntEnum]


@dataclass(frozen=True, slots=True, kw_only=True)
class PayloadField:
    """One field of a payload.

    ``type`` is a key of `SIZES`, or ``cases`` if the field ``on`` decides what follows. ``count``
    names the field that counts the values, ``"*"`` all that are left, none for a single value;
    ``per`` values count as one. A field is there if more than ``beyond`` bytes are left. A
    ``short`` number travels in one byte if only one is left. ``skip`` bytes follow.
    """

    name: str
    type: str
    count: str = ""
    per: int = 1
    beyond: int = -1
    short: bool = False
    skip: int = 0
    enum: EnumType | None = None
    on: str = ""
    cases: tuple[tuple[int, tuple["PayloadField", ...]], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class PayloadLayout:
    """One message: the byte strings that its payload may begin with, then its fields."""

    name: str
    from_host: bool
    prefixes: tuple[bytes, ...]
    fields: tuple[PayloadField, ...]
    replies: tuple[str, ...]
    text: str  # the first sentence about it

    @property
    def id(self) -> str:
        """The name in lower case, of letters, digits and ``_``, as identifiers need it."""
        words = "".join(c if c.isalnum() else " " for c in self.name.lower()).split()
        return "_".join((*words, "command") if self.name == "HIL" and self.from_host else words)


def layouts() -> tuple[PayloadLayout, ...]:
    """Return all messages, in the order of the table."""
    return tuple(_layout(cls, row) for cls, row in ROWS.items())


def _layout(cls: type[Message], row: Row) -> PayloadLayout:
    kinds = row.kinds
    prefixes: tuple[bytes, ...] = (row.prefix,)
    if kinds and isinstance(kinds[0][1], fields.Spelling):
        prefixes = tuple(row.prefix + bytes((code,)) for code in kinds[0][1].codes)
        kinds = kinds[1:]
    labels = {name: getattr(kind, "label", "") or name for name, kind in kinds}
    found = (field for name, kind in kinds for field in _fields(name, kind, labels))
    return PayloadLayout(
        name=row.name,
        from_host=issubclass(cls, Command),
        prefixes=prefixes,
        fields=tuple(found),
        replies=tuple(ROWS[reply].name for reply in row.replies if reply in ROWS),
        text=(cls.__doc__ or "").partition("\n")[0],
    )


def _fields(name: str, kind: fields.FieldKind, labels: dict[str, str]) -> Iterator[PayloadField]:  # noqa: PLR0912 - one case per kind
    label = labels[name]
    match kind:
        case fields.Number():
            skip = kind.code.count("x")
            yield PayloadField(name=label, type=TYPES[kind.code[0]], skip=skip, enum=kind.enum)
        case fields.Member():
            yield PayloadField(name=label, type="u4", enum=kind.enum)
        case fields.Count():
            yield PayloadField(name=label, type="u4")
        case fields.OptionalByte():
            yield PayloadField(name=label, type="u1", beyond=0)
        case fields.Bins():
            yield PayloadField(name=label, type=DTYPES[kind.dtype], count=labels[kind.count_field])
        case fields.Floats():
            yield PayloadField(name=label, type="f4", count=labels[kind.count], per=kind.per)
        case fields.Block():
            yield PayloadField(name=label, type="bytes", count=labels[kind.count])
        case fields.Text():
            yield PayloadField(name=label, type="text", count=labels[kind.count])
        case fields.RestBytes():
            yield PayloadField(name=label, type="bytes", count="*")
        case fields.Elements():
            yield from _elements(kind)
        case fields.TypedElements():
            lists = tuple((code, tuple(_elements(one))) for code, one in kind.types.items())
            yield PayloadField(name=name, type="cases", on=labels[kind.field], cases=lists)
        case fields.ByDiscriminator():
            values = tuple(
                (code, tuple(_scalars(codes, names, code in kind.short)))
                for code, (codes, names) in kind.layouts.items()
            )
            yield PayloadField(name=name, type="cases", on=labels[kind.field], cases=values)
        case fields.ShortForm():
            pass
        case _:
            raise TypeError(f"{name}: {type(kind).__name__} cannot be exported")


def _elements(kind: fields.Elements) -> Iterator[PayloadField]:
    count = kind.count_label or "count"
    trailer = kind.trailer is not None
    yield PayloadField(name=count, type="u4", beyond=int(trailer))
    yield PayloadField(name=kind.label, type=TYPES[kind.code], count=count)
    if trailer:
        yield PayloadField(name="trailer", type="u1", beyond=0)


def _scalars(codes: str, names: tuple[str, ...], short: bool) -> Iterator[PayloadField]:
    for code, name in zip(codes, names, strict=True):
        yield replace(PayloadField(name=name, type=TYPES[code]), short=short)
