"""What a row of the message table can say, and how wrong messages and codes are named."""

from dataclasses import replace
from enum import IntEnum
from typing import Annotated, Any

import numpy as np
import pytest

from hil_tests.golden.builders import message_of
from hil_tests.golden.test_protocol_vectors import KNOWN
from hil_tests.golden.vectors import Vector
from xethru_protocol.wire import fields
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import (
    decode_command,
    decode_response,
    describe,
    encode,
    message_type,
)
from xethru_protocol.wire.codes import (
    ErrorCode,
    FileError,
    IoPinError,
    MatrixControl,
    X4Error,
    error_name,
)
from xethru_protocol.wire.errors import LocalProtocolError
from xethru_protocol.wire.table import ROWS, Command, Prefixes, command

# Every row of 5.1 as (code, name by space); "" where the reference has no meaning.
PROTOCOL, X4, FILES, PINS = ErrorCode, X4Error, FileError, IoPinError


@pytest.mark.parametrize(
    ("code", "space", "name"),
    [
        (1, PROTOCOL, "NOT_RECOGNIZED"),
        (1, X4, "X4 GENERAL_FAILURE"),
        (1, FILES, "file INVALID_PARAMETER"),
        (1, PINS, "IOPIN WRONG_PIN"),
        (3, PROTOCOL, "BUSY"),
        (3, FILES, "file ALREADY_EXISTS"),
        (3, PINS, "IOPIN INTERRUPT_NOT_AVAILABLE"),
        (4, PROTOCOL, "X4 REGISTER_TIMEOUT or file BUSY"),
        (4, FILES, "file BUSY"),
        (5, PINS, ""),
        (14, FILES, "file NOT_SUPPORTED"),
        (15, FILES, ""),
        (17, PROTOCOL, "X4 FRAME_AREA_END_OUT_OF_SCOPE"),
        (17, FILES, ""),
        (0x21, PROTOCOL, "COMMAND_FAILED"),
        (0x21, FILES, "file OUT_OF_RANGE"),
        (0x22, X4, "RESTARTING"),
        (999, X4, "X4 HAL_ERROR"),
        (0xFFFFFFFF, X4, "X4 UNINITIALIZED (-1)"),
        (0xFFFFFFFF, FILES, ""),
        (100, PROTOCOL, ""),
    ],
)
def test_an_errors_name_depends_on_the_command_that_failed(
    code: int, space: type[IntEnum], name: str
) -> None:
    assert error_name(code, space) == name


@pytest.mark.parametrize(
    ("cls", "space"),
    [
        (m.X4DriverSet, X4),
        (m.X4DriverInit, X4),
        (m.X4DriverReadI2c, X4),
        (m.OpenFile, FILES),
        (m.FormatFilesystem, FILES),
        (m.IoPinSetValue, PINS),
        (m.IoPinGetControl, PINS),
        (m.SetMode, PROTOCOL),
        (m.OutputSetControl, PROTOCOL),
    ],
)
def test_a_commands_row_names_its_errors(
    cls: type[Command[m.Response]], space: type[IntEnum]
) -> None:
    assert ROWS[cls].errors is space


@pytest.mark.parametrize(
    "vector",
    [v for v in KNOWN if v.message.startswith("REPLY") and v.decoded["trailer"] is not None],
    ids=lambda v: v.name,
)
def test_replies_are_read_without_their_trailer(vector: Vector) -> None:
    """5.2: accept with or without trailer."""
    assert vector.payload is not None
    whole, cut = decode_response(vector.payload), decode_response(vector.payload[:-1])
    if isinstance(whole, m.ReplyNone):
        assert cut == m.ReplyNone(content_id=whole.content_id, info=whole.info, trailer=None)
    elif "nan" in vector.name:  # which equals nothing
        assert str(cut) == str(whole)
    else:
        assert cut == whole


def example(name: str) -> Any:  # noqa: ANN401 - rows differ in type
    """Return the message of the first vector of this name."""
    return next(message_of(vector) for vector in KNOWN if vector.message == name)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (
            replace(example("PRESENCE_MOVINGLIST"), movement_slow=(1.0, 2.0), movement_fast=()),
            "movement_slow and movement_fast must have one length",
        ),
        (m.InjectFrame(counter=1, values=(1.0, 2.0, 3.0)), "of whole entries"),
        (m.DeleteNoiseMap(sub_code=0x14), "another message's"),
        (m.LegacyDirCommand(sub_code=0x58), "another message's"),
        (m.SetParameterFile(name="\u20ac", data=""), "latin-1"),
        (m.HilReply(datatype=0x99, hil_command=0x10), "no such element type"),
        (m.BootloaderWritePage(page=0x10000, data=b""), "page=65536"),
        (
            replace(example("PULSEDOPPLER_BYTE"), frequency_count=3, levels=b"\x01"),
            "frequency_count is 3",
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_does_not_fit_the_wire_is_refused(message: m.Message, reason: str) -> None:
    with pytest.raises(LocalProtocolError, match=reason):
        encode(message)


RADAR_MESSAGES = [v for v in KNOWN if v.message.startswith("RADAR_")]


@pytest.mark.parametrize("vector", RADAR_MESSAGES, ids=lambda v: v.name)
def test_a_radar_message_has_as_many_bins_as_it_announces(vector: Vector) -> None:
    """7.5: the vendor's library does not check that; a driver must."""
    assert vector.payload is not None
    whole = vector.payload
    bins = vector.decoded["num_bins"]
    assert isinstance(decode_response(whole), m.RadarMessage)
    wrong = [
        *(
            whole[:9] + count.to_bytes(4, "little") + whole[13:]
            for count in (0, bins - 1, 2**32 - 1)
        ),
        whole + b"\x00",
        whole + bytes(8),
        whole[:-1],
        whole[:20],
    ]
    for payload in wrong:
        assert decode_response(payload) == m.UnknownMessage(code=0x50, payload=payload)


@pytest.mark.parametrize(
    ("name", "header", "per_bin", "shortest"),
    [
        ("RADAR_RF", 33, 4, 40),
        ("RADAR_RF_NORMALIZED", 33, 4, 40),
        ("RADAR_BASEBAND_FLOAT", 49, 8, 64),
        ("RADAR_BASEBAND_Q15", 53, 4, 64),
    ],
)
def test_radar_messages_that_the_vendors_library_drops_are_unknown(
    name: str, header: int, per_bin: int, shortest: int
) -> None:
    """7.5: the shortest payloads that it accepts, id and opcode included."""
    (vector,) = (v for v in RADAR_MESSAGES if v.message == name)
    assert vector.payload is not None
    for bins in range(6):
        payload = vector.payload[:9] + bins.to_bytes(4, "little") + vector.payload[13:header]
        payload += bytes(per_bin * bins)
        taken = isinstance(decode_response(payload), m.RadarMessage)
        assert taken is (len(payload) >= shortest)
    with pytest.raises(LocalProtocolError, match="num_bins"):
        encode(replace(example(name), num_bins=1))


def test_radar_messages_have_their_ranges_and_complex_samples() -> None:
    received: list[Any] = [
        decode_response(encode(example(f"RADAR_{name}")))
        for name in ("RF", "BASEBAND_FLOAT", "BASEBAND_Q15")
    ]
    rf, baseband, q15 = received
    assert rf.samples.tolist() == [364800, 364801]
    assert not rf.samples.flags.writeable
    assert rf.ranges_m == pytest.approx([0.18, 0.18643004])
    assert baseband.ranges_m == pytest.approx([0.18, 0.23144033])
    assert baseband.iq.tolist() == [1 + 3j, 2 + 4j]
    assert q15.iq.tolist() == [0.25 + 1.25j, -0.5 - 1.5j, 0.75 + 8191.75j, -1 - 8192j]
    assert q15.i.dtype == np.int16
    assert all(message.iq.dtype == np.complex64 for message in (baseband, q15))


def test_page_index_is_big_endian() -> None:
    """4.12: the one exception to little-endian."""
    assert encode(m.BootloaderWritePage(page=0x0102, data=b"\xff")).hex(" ") == "c0 10 01 02 00 ff"


def test_texts_are_terminated_once() -> None:
    payload = encode(m.GetParameterFile(name=b"a.par"))
    assert payload.endswith(b"\x06\x00\x00\x00a.par\x00")
    assert decode_command(payload) == m.GetParameterFile(name="a.par")
    unterminated = payload[:6] + b"\x05\x00\x00\x00a.par"
    assert decode_command(unterminated) == m.GetParameterFile(name="a.par")


def test_a_damaged_scale_of_levels_is_no_exception() -> None:
    """A NoEscape packet has no checksum: the steps may be any float."""
    infinite = bytes.fromhex("00 00 80 7F")
    payload = bytes.fromhex("50 11 00 00 00") + bytes(16) + b"\x02\x00\x00\x00" + bytes(4)
    payload += infinite * 2 + bytes(20) + b"\x00\xff"
    name, fields = describe(decode_response(payload))
    assert name == "PULSEDOPPLER_BYTE"
    assert [str(power) for power in fields["decompressed"]] == ["NaN", "Infinity"]


def test_either_numbering_switches_the_fast_matrix() -> None:
    """11 row 5."""
    assert MatrixControl(2).fast
    assert MatrixControl(4).fast
    assert not MatrixControl(1).fast
    assert not MatrixControl(0x80000001).fast


def test_no_two_rows_share_a_prefix() -> None:
    with pytest.raises(ValueError, match="22 is ModReset already"):

        @command(0x22, name="ANOTHER_RESET")
        class _AnotherReset(Command[m.Ack]):
            seed: Annotated[int, fields.U8]


def test_the_longest_prefix_wins() -> None:
    prefixes = Prefixes()
    prefixes.enter(b"\x10", m.Ack)
    prefixes.enter(b"\x10\x01\x02", m.Pong)
    prefixes.enter(b"\x10\x01", m.System)
    found = [
        message_type(prefixes, data)
        for data in (b"\x10\x01\x02\x03", b"\x10\x01", b"\x10\x02", b"")
    ]
    assert found == [m.Pong, m.System, m.Ack, None]


def test_the_bin_count_cannot_be_set() -> None:
    """4.9: the firmware answers ERROR 1, as to what it does not know."""
    payload = bytes.fromhex("50 10 26 00 00 00 01 00 00 00")
    assert decode_command(payload) == m.UnknownMessage(code=0x50, payload=payload)


@pytest.mark.parametrize("count", ["FF FF FF FF", "00 00 00 40", "03 00 00 00"])
def test_counts_beyond_the_payload_are_not_believed(count: str) -> None:
    """A damaged count must neither raise nor take memory."""
    for head in ("50 00 3B 0A 61 01 00 00 00", "90 75 01 00 00 00", "50 02 3B 0A 61 01 00 00 00"):
        payload = bytes.fromhex(f"{head} {count} 00 00 80 3F 00 00")
        decode = decode_command if head.startswith("90") else decode_response
        assert decode(payload) == m.UnknownMessage(code=payload[0], payload=payload)
