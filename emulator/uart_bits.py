"""What a UART hears of bits that were sent at another rate than its own.

Line levels are bytes of 0 and 1, one per bit time of the sender; between characters, before the
first and after the last the line is high. Eight data bits, least significant first, no parity.
"""

from __future__ import annotations

from operator import itemgetter

__all__ = ["BITS_PER_BYTE", "line_levels", "sampled", "what_is_heard"]

BITS_PER_BYTE = 10
"""Start, eight data bits, stop."""
_FALLING = b"\x01\x00"
_CHARACTERS = tuple(bytes((0, *(byte >> bit & 1 for bit in range(8)), 1)) for byte in range(256))


def line_levels(data: bytes) -> bytes:
    """Return the levels of bytes sent one right after the other.

    Examples
    --------
    >>> line_levels(bytes([0x55])).hex(" ")
    '00 01 00 01 00 01 00 01 00 01'
    """
    return b"".join(map(_CHARACTERS.__getitem__, data))


def sampled(levels: bytes, sent_baud: int, read_baud: int) -> bytes:
    """Return the bytes a receiver makes of line levels.

    It waits for a falling edge, looks in the middle of its own bit time whether the line is still
    low, else it was no start bit; then it takes eight bits, each in its middle, and the stop bit,
    which it does not judge, as a terminal in raw mode does not. Then it waits for the line to be
    high and to fall again.

    Parameters
    ----------
    levels
        One per bit time of the sender.
    sent_baud, read_baud
        Rates of sender and receiver, bit/s.

    Examples
    --------
    At half the rate, bits 3, 5 and 7 of the line are data bits 0 to 2 of 00, then comes its stop
    bit and the idle line.

    >>> sampled(line_levels(bytes([0x00])), 115200, 57600).hex()
    'f8'
    """
    # an edge lies at the beginning of a sent bit: the samples' places behind it are always the same
    middles = [(2 * bit + 1) * sent_baud // (2 * read_baud) for bit in range(BITS_PER_BYTE)]
    data_bits = itemgetter(*middles[1:9])
    start, stop = middles[0], middles[9]
    line = b"\x01" + levels + b"\x01" * (stop + 2)
    heard = bytearray()
    at = line.find(_FALLING)
    while at >= 0:
        edge = at + 1
        if line[edge + start]:
            at = line.find(_FALLING, edge)
            continue
        bits = data_bits(line[edge : edge + stop + 1])
        heard.append(sum(level << place for place, level in enumerate(bits)))
        at = line.find(_FALLING, edge + stop)
    return bytes(heard)


def what_is_heard(data: bytes, sent_baud: int, read_baud: int) -> bytes:
    """Return what arrives of bytes sent one right after the other; nothing at a rate of 0."""
    if sent_baud == read_baud:
        return data
    if sent_baud <= 0 or read_baud <= 0:
        return b""
    return sampled(line_levels(data), sent_baud, read_baud)
