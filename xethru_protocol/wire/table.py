"""What a row of the message table is, and the decorators that enter one.

A row is a class under a decorator that names the bytes its payload begins with and makes it a
frozen dataclass; ``Annotated`` fields give their place on the wire. Encoder, decoder, CLI dump and
test strategy follow from the row. A field under ``ClassVar`` exists on the wire only: a count that
follows from the lists it counts. A command's row names its reply by its base, ``Command[Reply]``;
that is what `X4M300.request` returns. The rows are in ``messages``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from types import UnionType
from typing import (
    Any,
    ClassVar,
    Generic,
    TypeVar,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from xethru_protocol.wire import fields
from xethru_protocol.wire.codes import ErrorCode


class Message:
    """Anything the wire can carry, in either direction."""

    __slots__ = ()


class Response(Message):
    """A message from the module."""

    __slots__ = ()


ReplyT = TypeVar("ReplyT", bound=Response, covariant=True)


class Command(Message, Generic[ReplyT]):
    """A message to the module, with the type of the answer that means success."""

    __slots__ = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class UnknownMessage(Command[Response], Response):
    """A payload that no row describes, or that is shorter than its row.

    ``code`` is its first byte (-1 if there is none), ``payload`` all of it.
    """

    code: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Row:
    """What a decorator recorded about one message type."""

    name: str
    prefix: bytes
    kinds: tuple[tuple[str, fields.FieldKind], ...]  # in the order of the wire
    fields: tuple[str, ...]  # those of them that are fields of the message
    wire_only: frozenset[str]  # the others
    bulk: bool  # a real module sends it in NoEscape framing
    replies: tuple[type[Response], ...]
    content_id: Callable[[Any], int] | None  # content id the reply must carry
    errors: type[IntEnum]  # what the codes of an ERROR to this command mean
    derived: Callable[[Any], dict[str, Any]]  # dump entries computed from the message

    @property
    def opcodes(self) -> frozenset[int]:
        """First bytes that its payloads may have."""
        if self.prefix:
            return frozenset(self.prefix[:1])
        first = self.kinds[0][1]
        return frozenset(first.codes if isinstance(first, fields.Spelling) else ())


class Prefixes:
    """Message types by the bytes their payloads begin with.

    ``lengths`` holds those of the prefixes with one first byte, the longest first.
    """

    def __init__(self) -> None:
        self.types: dict[bytes, type[Message]] = {}
        self.lengths: dict[int, tuple[int, ...]] = {}

    def enter(self, prefix: bytes, cls: type[Message]) -> None:
        """Add a message type; ``ValueError`` if the prefix is another's."""
        if prefix in self.types:
            raise ValueError(f"{prefix.hex(' ')} is {self.types[prefix].__name__} already")
        self.types[prefix] = cls
        lengths = {len(prefix), *self.lengths.get(prefix[0], ())}
        self.lengths[prefix[0]] = tuple(sorted(lengths, reverse=True))


ROWS: dict[type[Message], Row] = {}
COMMANDS = Prefixes()
RESPONSES = Prefixes()
MessageT = TypeVar("MessageT", bound=Message)


@dataclass_transform(kw_only_default=True, frozen_default=True)
def command(
    *prefix: int,
    name: str,
    reply_content_id: Callable[[Any], int] | None = None,
    errors: type[IntEnum] = ErrorCode,
    derived: Callable[[Any], dict[str, Any]] | None = None,
) -> Callable[[type[MessageT]], type[MessageT]]:
    """Enter a command into the table; ``prefix`` is the payload's first byte or bytes."""

    def enter(cls: type[MessageT]) -> type[MessageT]:
        (answer,) = get_args(cls.__orig_bases__[0])  # type: ignore[attr-defined] # set for every generic base
        replies = get_args(answer) if isinstance(answer, UnionType) else (answer,)
        return _enter(
            COMMANDS, cls, bytes(prefix), name, derived, replies, reply_content_id, errors
        )

    return enter


@dataclass_transform(kw_only_default=True, frozen_default=True)
def response(
    *prefix: int,
    name: str,
    bulk: bool = False,
    derived: Callable[[Any], dict[str, Any]] | None = None,
) -> Callable[[type[MessageT]], type[MessageT]]:
    """Enter a response into the table; ``bulk`` ones travel in NoEscape framing (1.3)."""

    def enter(cls: type[MessageT]) -> type[MessageT]:
        return _enter(RESPONSES, cls, bytes(prefix), name, derived, bulk=bulk)

    return enter


def id32(number: int) -> tuple[int, ...]:
    return tuple(number.to_bytes(4, "little"))


def _enter(  # noqa: PLR0917 - the two decorators above are its only callers
    prefixes: Prefixes,
    cls: type[MessageT],
    prefix: bytes,
    name: str,
    derived: Callable[[Any], dict[str, Any]] | None,
    replies: tuple[type[Response], ...] = (),
    content_id: Callable[[Any], int] | None = None,
    errors: type[IntEnum] = ErrorCode,
    bulk: bool = False,
) -> type[MessageT]:
    compares_itself = cls.__eq__ is not object.__eq__
    cls = dataclass(frozen=True, slots=True, kw_only=True, eq=not compares_itself)(cls)
    hints = get_type_hints(cls, include_extras=True)
    wire_only = frozenset(field for field, hint in hints.items() if get_origin(hint) is ClassVar)
    kinds = tuple(
        (field, get_args(get_args(hint)[0] if field in wire_only else hint)[1])
        for field, hint in hints.items()
    )
    own = tuple(field for field in hints if field not in wire_only)
    first = kinds[0][1] if kinds else None
    spellings = first.codes if isinstance(first, fields.Spelling) else None
    for code in [b""] if spellings is None else [bytes((code,)) for code in spellings]:
        prefixes.enter(prefix + code, cls)
    ROWS[cls] = Row(
        name, prefix, kinds, own, wire_only, bulk, replies, content_id, errors, derived or _nothing
    )
    return cls


def _nothing(message: Message) -> dict[str, Any]:
    return {}
