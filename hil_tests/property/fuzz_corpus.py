"""Nasty streams, each a file of ``fixtures/fuzz``: what once broke a receiver, or well might.

``python -m hil_tests.property.fuzz_corpus`` writes the files. They are committed because a
generator that changes would silently test something else.
"""

import struct
from pathlib import Path

from hil_tests.paths import FIXTURES
from xethru_protocol.wire.framing import encode_no_escape, encode_normal

FOLDER = FIXTURES / "fuzz"

_ACK = bytes.fromhex("7D 10 6D 7E")
_PONG = bytes.fromhex("7D 01 EA AE EE AA 7C 7E")


def _frame(counter: int, samples: bytes) -> bytes:
    header = b"\xa0\x12" + bytes(4) + struct.pack("<II", counter, len(samples) // 4)
    return encode_no_escape(header + samples)


_SAMPLES = bytes(range(0x70, 0x90)) * 4
_ESCAPED = bytes.fromhex("7D 7E 7F") * 40


def _header_lie(length: int) -> bytes:
    lie = bytearray(_frame(1, _SAMPLES))
    lie[4:8] = length.to_bytes(4, "little")
    return bytes(lie)


STREAMS: dict[str, bytes] = {
    "nested_false_starts": b"\x7d\x00" * 9 + b"\x7d" + _frame(0, _SAMPLES) + _ACK,
    "false_start_in_header": _frame(0, _SAMPLES)[:6] + _frame(1, _SAMPLES) + _ACK,
    "header_lies": b"".join(
        _header_lie(n) + _ACK for n in (0, 1, 13, 14, 141, 143, 65535, 65536, 0x7C7C7C7C, 2**32 - 1)
    ),
    "count_lies": b"".join(
        _frame(0, _SAMPLES)[:19] + struct.pack("<I", n) + _SAMPLES + _PONG
        for n in (0, 31, 33, 2**30 + 32, 2**32 - 1)
    ),
    "escapes": b"".join(encode_normal(b"\xb0" + _ESCAPED[k:]) for k in range(9)) + _ACK,
    "escaped_checksums": b"".join(encode_normal(bytes((0xB0, k))) for k in range(256)),
    "escape_runs": b"".join(b"\x7d\x10" + b"\x7f" * k + b"\x7e" + _ACK for k in range(9)),
    "escape_then_cut": b"".join(b"\x7d\x10\x7f" + _ACK for _ in range(3)) + b"\x7d\x10\x7f",
    "runs_of_7c": b"".join(b"\x7c" * n + _frame(n, _SAMPLES[:8]) for n in range(14)) + _ACK,
    "long_run_of_7c": b"\x7c" * 3000 + _ACK + b"\x7c" * 7,
    "bulk_start_inside_normal": encode_normal(b"\xb0" + b"\x7c" * 4 + bytes(9)) + _ACK,
    "bulk_packet_inside_normal": encode_normal(b"\xb0" + _frame(0, _SAMPLES)) + _ACK,
    "bulk_packet_inside_bad_normal": b"\x7d\xb0" + _frame(0, b"\0" * 8) + b"\x00\x7e" + _ACK,
    "normal_packet_inside_bulk": _frame(0, _ACK * 3) + _ACK,
    "deprecated_fast_mode": b"\x51\x20\x00\x00\x00" + _ACK + encode_normal(b"\x51" + bytes(7)),
    "doubled_start_and_end": b"\x7d\x7d\x7d" + _ACK + b"\x7e\x7e" + _ACK[:-1] + b"\x7e\x7e",
    "empty_packets": b"\x7d\x7e" * 3 + b"\x7d\x7d\x7e" + b"\x7d\x7f\x7d\x7e" + _ACK,
    "missing_ends": _ACK[:-1] * 5 + _ACK,
    "missing_starts": _ACK[1:] * 5 + _ACK,
    "wrong_checksums": b"\x7d\x10\x6c\x7e" * 5 + _PONG,
    "bad_packet_full_of_escaped_starts": b"\x7d" + b"\x7f\x7d\x10" * 40 + b"\x7e" + _ACK,
    "longest_normal": encode_normal(bytes(7998)) + _ACK,
    "longer_than_any_normal": b"\x7d" + bytes(7999) + b"\x7f\x7d\x7e" + _ACK,
    "start_without_end": b"\x7d" + bytes(16_100) + _ACK,
    "cut_in_bulk": _frame(0, _SAMPLES) + _frame(1, _SAMPLES)[:40],
    "cut_in_bulk_header": _frame(0, _SAMPLES) + _frame(1, _SAMPLES)[:7],
    "cut_in_bulk_start": _ACK + b"\x7c\x7c\x7c",
    "cut_behind_packet_that_lies_inside": b"\x7d" + _frame(0, b"\0" * 12),
    "line_noise": bytes(pow(7, k, 65537) & 0xFF for k in range(4000)) + _ACK,
    "baud_garbage": bytes([0x00, 0x80, 0xFE, 0xFC, 0x7C, 0x7E, 0x7D, 0x3F]) * 60 + _ACK,
}


def corpus() -> list[Path]:
    return sorted(FOLDER.glob("*.bin"))


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, stream in STREAMS.items():
        (FOLDER / f"{name}.bin").write_bytes(stream)
