"""The message table: what a row is, and the decorators that enter one.

A row is a frozen dataclass under a decorator that names the bytes its payload begins with;
``Annotated`` fields say how they lie on the wire. Encoder, decoder, CLI dump and test strategy
follow from the row. A command's row names its reply by its base, ``Command[Reply]``; that is
what `X4M300.request` returns. The rows stand in ``responses`` and ``commands``.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import UnionType
from typing import Any, Generic, TypeVar, get_args, get_type_hints

from xethru_protocol import wire


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
    kinds: tuple[tuple[str, wire.Kind], ...]
    bulk: bool  # a real module sends it in NoEscape framing
    replies: tuple[type[Response], ...]
    content_id: Callable[[Any], int] | None  # content id the reply must carry
    derived: Mapping[str, Callable[[Any], Any]]  # dump entries computed from the message


ROWS: dict[type[Message], Row] = {}
COMMANDS: dict[bytes, type[Message]] = {}
RESPONSES: dict[bytes, type[Message]] = {}
MessageT = TypeVar("MessageT", bound=Message)


def command(
    *prefix: int,
    name: str,
    reply_content_id: Callable[[Any], int] | None = None,
    derived: Mapping[str, Callable[[Any], Any]] | None = None,
) -> Callable[[type[MessageT]], type[MessageT]]:
    """Enter a command into the table; ``prefix`` is the payload's first byte or bytes."""

    def enter(cls: type[MessageT]) -> type[MessageT]:
        (answer,) = get_args(cls.__orig_bases__[0])  # type: ignore[attr-defined] # set for every generic base
        replies = get_args(answer) if isinstance(answer, UnionType) else (answer,)
        return _enter(COMMANDS, cls, bytes(prefix), name, False, replies, reply_content_id, derived)

    return enter


def response(
    *prefix: int,
    name: str,
    bulk: bool = False,
    derived: Mapping[str, Callable[[Any], Any]] | None = None,
) -> Callable[[type[MessageT]], type[MessageT]]:
    """Enter a response into the table; ``bulk`` ones travel in NoEscape framing (1.3)."""

    def enter(cls: type[MessageT]) -> type[MessageT]:
        return _enter(RESPONSES, cls, bytes(prefix), name, bulk, (), None, derived)

    return enter


def _enter(  # noqa: PLR0917 - the two decorators above are its only callers
    table: dict[bytes, type[Message]],
    cls: type[MessageT],
    prefix: bytes,
    name: str,
    bulk: bool,
    replies: tuple[type[Response], ...],
    content_id: Callable[[Any], int] | None,
    derived: Mapping[str, Callable[[Any], Any]] | None,
) -> type[MessageT]:
    hints = get_type_hints(cls, include_extras=True)
    kinds = tuple((field, get_args(hint)[1]) for field, hint in hints.items())
    ROWS[cls] = Row(name, prefix, kinds, bulk, replies, content_id, derived or {})
    table[prefix] = cls
    return cls
