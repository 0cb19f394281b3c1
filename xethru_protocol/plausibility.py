"""Whether a NoEscape header can be true, judged by the first bytes of its payload.

A NoEscape packet has no checksum, so a receiver that believes a damaged length field loses all
that follows. The judgement needs the length and at most the first 14 payload bytes, and is the
same for every receiver, so that it depends on nothing but the bytes (Protocol reference 1.3, 1.4).
"""

import struct
from enum import Enum

from xethru_protocol.codes import AppDataId, CommandCode, ElementType, ResponseCode

HEAD_BYTES = 14  # payload bytes needed to judge
MAX_LENGTH = 65535
_VENDOR_LIMIT = 7995  # what the module's own parser can receive
_COUNT = struct.Struct("<I")


class Direction(Enum):
    """Which way bytes travel; what a payload may be depends on it."""

    FROM_HOST = "from host"
    FROM_MODULE = "from module"


_KNOWN = {
    Direction.FROM_HOST: frozenset(int(code) for code in CommandCode),
    Direction.FROM_MODULE: frozenset(int(code) for code in ResponseCode),
}

_ELEMENT_BYTES: dict[int, int] = {
    ElementType.XTS_SPRD_BYTE: 1,
    ElementType.XTS_SPRD_INT: 4,
    ElementType.XTS_SPRD_FLOAT: 4,
    ElementType.XTS_SPRD_STRING: 1,
    ElementType.XTS_SPRD_USER: 1,
}
# Messages that end with their elements: bytes per element, by type.
_LISTS: dict[int, dict[int, int]] = {
    ResponseCode.XTS_SPR_DATA: _ELEMENT_BYTES,
    ResponseCode.XTS_SPR_HIL: _ELEMENT_BYTES | {ElementType.XTS_SPRD_NONE: 1},
}
# APPDATA with bulk content: (header bytes, offset of the bin count if within the head, bytes
# per bin). Pulse-Doppler and noise maps count their bins behind the head.
_APPDATA: dict[int, tuple[int, int | None, int]] = {
    AppDataId.XTS_ID_BASEBAND_IQ: (29, 9, 8),
    AppDataId.XTS_ID_BASEBAND_AMPLITUDE_PHASE: (29, 9, 8),
    AppDataId.XTS_ID_PULSEDOPPLER_FLOAT: (49, None, 4),
    AppDataId.XTS_ID_PULSEDOPPLER_BYTE: (57, None, 1),
    AppDataId.XTS_ID_NOISEMAP_FLOAT: (49, None, 4),
    AppDataId.XTS_ID_NOISEMAP_BYTE: (57, None, 1),
}


def plausible(  # noqa: PLR0911 - one return per kind of message
    length: int, head: bytes, direction: Direction
) -> bool:
    """Whether a NoEscape packet may announce ``length`` payload bytes starting with ``head``.

    Parameters
    ----------
    length
        The header's length field.
    head
        The payload's first ``min(length, HEAD_BYTES)`` bytes.
    direction
        Who sent it.

    >>> head = bytes.fromhex("A0 12 00 00 00 00 2A 00 00 00 01 00 00 00")
    >>> plausible(18, head, Direction.FROM_MODULE), plausible(19, head, Direction.FROM_MODULE)
    (True, False)
    """
    if not 1 <= length <= MAX_LENGTH or head[0] not in _KNOWN[direction]:
        return False
    if length < HEAD_BYTES:
        return True
    code = head[0]
    from_module = direction is Direction.FROM_MODULE
    if code in _LISTS and from_module:
        size = _LISTS[code].get(head[1])
        return size is not None and HEAD_BYTES + _count(head, 10) * size == length
    if code == ResponseCode.XTS_SPR_REPLY and from_module:
        size = _ELEMENT_BYTES.get(head[1])
        trailers = (0,) if head[1] == ElementType.XTS_SPRD_INT else (0, 1)  # may be left out
        return size is not None and length - HEAD_BYTES - _count(head, 10) * size in trailers
    if code == ResponseCode.XTS_SPR_APPDATA and from_module:
        layout = _APPDATA.get(_count(head, 1))
        if layout is None:
            return length <= _VENDOR_LIMIT
        header, count_at, size = layout
        if count_at is None:
            return length >= header and (length - header) % size == 0
        return header + _count(head, count_at) * size == length
    # The rest is a few bytes long and never sent this way by a real module or host.
    return length <= (HEAD_BYTES if from_module else _VENDOR_LIMIT)


def _count(head: bytes, offset: int) -> int:
    (count,) = _COUNT.unpack_from(head, offset)
    return int(count)
