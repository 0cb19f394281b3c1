"""What a data file of each kind holds, by the golden vectors and by hand.

Binary records are the vectors' payloads without their leading codes (Protocol reference 12); text
lines, name and bit of a kind are written here by hand.
"""

import re
import struct
from dataclasses import replace
from datetime import timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

from hil_tests.golden.vectors import load
from hil_tests.paths import FIXTURES
from hil_tests.unit.xethru_protocol.recordings.messages import write_again, write_recording
from xethru_protocol.recordings import RecordingWriter, read_recording
from xethru_protocol.recordings.vendor.layouts import KINDS
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import decode_response

VECTORS = {vector.name: vector for vector in load()}
STAMP = "1970-01-01T00:00:01.002+00:00;"
TIME_NS = 1_002_000_000

BINARY = [
    ("data_float_rf_3bins", "datafloat", 10, 2),
    ("data_float_zero_bins", "datafloat", 10, 2),
    ("data_byte", "databyte", 11, 2),
    ("appdata_baseband_ap_2bins", "baseband_ap", 0, 5),
    ("appdata_baseband_iq_2bins", "baseband_iq", 1, 5),
    ("appdata_pulsedoppler_float", "pulsedoppler_float", 6, 5),
    ("appdata_pulsedoppler_byte", "pulsedoppler_byte", 7, 5),
    ("appdata_noisemap_float", "noisemap_float", 8, 5),
    ("appdata_noisemap_byte", "noisemap_byte", 9, 5),
    ("appdata_radar_rf_2bins", "radar_rf", 19, 5),
    ("appdata_radar_rf_normalized_2bins", "radar_rf_normalized", 20, 5),
    ("appdata_radar_baseband_float_2bins", "radar_baseband_float", 21, 5),
    ("appdata_radar_baseband_q15_4bins", "radar_baseband_q15", 22, 5),
]
TEXT = [
    ("appdata_presence_single", "presence_single", 12, "1234;1;2.35;0;7"),
    (
        "appdata_presence_movinglist",
        "presence_movinglist",
        13,
        "1235;1;2;1;[10,20];[30,40];[1.5];[-3];[0.25]",
    ),
    ("appdata_presence_movinglist_empty", "presence_movinglist", 13, "1236;2;0;0;[];[];[];[];[]"),
    ("appdata_sleep", "sleep", 2, "11;0;14.5;1.25;8;3;4"),
    ("data_string", "datastring", 5, "0;0;hello"),
    ("appdata_respiration_detectionlist", "respiration_detectionlist", 14, "15;1;[1.5];[-2];[0]"),
    ("appdata_respiration_movinglist", "respiration_movinglist", 15, "14;2;[1,2];[3,4]"),
    ("appdata_vital_signs", "vitalsigns", 16, "12;7;15;1.5;0.5;60;1.5;0.75;1;2;1;2"),
    ("appdata_sleep_stage", "sleepstage", 17, "13;2;0"),
    (
        "appdata_respiration_normalizedmovementlist",
        "respiration_normalizedmovementlist",
        18,
        "16;0.4;0.0514403;2;[1,2];[3,4]",
    ),
]


def message_of(name: str) -> m.Response:
    payload = VECTORS[name].payload
    assert payload is not None
    return decode_response(payload)


def written(message: m.Response, folder: Path, kind: str, bit: int, suffix: str) -> bytes:
    """Content of the one data file, after a look at the meta file and at what is read back."""
    write_recording(folder, [(message, TIME_NS)])
    meta = (folder / "xethru_recording_meta.dat").read_bytes()
    assert struct.unpack_from("<I", meta, 0x25) == (1 << bit,)
    assert list(read_recording(folder)) == [(message, TIME_NS)]
    return (folder / f"xethru_{kind}_19700101_000001{suffix}").read_bytes()


@pytest.mark.parametrize(("name", "kind", "bit", "codes"), BINARY)
def test_a_record_is_the_payload_without_its_codes(
    name: str, kind: str, bit: int, codes: int, tmp_path: Path
) -> None:
    payload = VECTORS[name].payload
    assert payload is not None
    assert written(message_of(name), tmp_path / "r", kind, bit, ".dat") == payload[codes:]


@pytest.mark.parametrize(("name", "kind", "bit", "cells"), TEXT)
def test_a_line_is_the_time_and_the_fields(
    name: str, kind: str, bit: int, cells: str, tmp_path: Path
) -> None:
    content = written(message_of(name), tmp_path / "r", kind, bit, ".csv").decode()
    header, line = content.splitlines()
    assert line == STAMP + cells
    assert header.startswith("TimeStamp;")
    assert header.count(";") == line.count(";")


def test_respiration_is_stored_without_its_counter(tmp_path: Path) -> None:
    """As the vendor's recorder does: see `test_every_kind_is_read_as_it_was_sent`."""
    message = message_of("appdata_respiration")
    assert isinstance(message, m.RespStatus)
    write_recording(tmp_path, [(message, TIME_NS)])
    file = tmp_path / "xethru_respiration_19700101_000001.csv"
    assert file.read_text().splitlines()[1] == STAMP + "0;15;1.25;2.5;9"
    assert list(read_recording(tmp_path)) == [(replace(message, counter=0), TIME_NS)]


@pytest.mark.parametrize("text", ["a;b\n\\n\rü\x85;", "two\n\nlines\n", "\n", "TimeStamp;\nx", ""])
def test_text_with_separators_and_line_ends_is_stored_as_it_is(text: str, tmp_path: Path) -> None:
    message = m.DataString(content_id=1, info=2, text=text)
    timed = [(message, TIME_NS), (message, TIME_NS + 1_000_000)]
    write_recording(tmp_path, timed)
    content = (tmp_path / "xethru_datastring_19700101_000001.csv").read_bytes().decode("latin-1")
    titles = "TimeStamp;ContentId;Info;Message\n"
    assert content == f"{titles}{STAMP}1;2;{text}\n{STAMP.replace('002', '003')}1;2;{text}\n"
    assert list(read_recording(tmp_path)) == timed


# The vendor's recorder was given these vectors, in this order and with range_idx 0 in the four
# matrices, and then a text of its own.
SENT = [
    *("data_float_rf_3bins", "data_string", "data_byte", "appdata_baseband_iq_2bins"),
    *("appdata_baseband_ap_2bins", "appdata_pulsedoppler_float", "appdata_pulsedoppler_byte"),
    *("appdata_noisemap_float", "appdata_noisemap_byte", "appdata_presence_single"),
    *("appdata_presence_movinglist", "appdata_respiration", "appdata_sleep"),
    *("appdata_vital_signs", "appdata_sleep_stage", "appdata_respiration_movinglist"),
    *("appdata_respiration_detectionlist", "appdata_respiration_normalizedmovementlist"),
    *("appdata_radar_rf_2bins", "appdata_radar_rf_normalized_2bins"),
    *("appdata_radar_baseband_float_2bins", "appdata_radar_baseband_q15_4bins"),
]
EVERY_KIND = FIXTURES / "recordings" / "every_kind"


def sent() -> list[m.Response]:
    messages = [message_of(name) for name in SENT]
    for at, message in enumerate(messages):
        if isinstance(message, m.RespStatus):
            messages[at] = replace(message, counter=0)  # not stored
        if isinstance(
            message,
            m.PulseDopplerFloat | m.PulseDopplerByte | m.NoiseMapFloat | m.NoiseMapByte,
        ):
            messages[at] = replace(message, range_idx=0)
    return [*messages, m.DataString(content_id=0, info=7, text="two;cells\nand \\lines\n")]


def test_every_kind_is_read_as_it_was_sent() -> None:
    found = list(read_recording(EVERY_KIND))
    assert [message for message, _ in found] == sent()
    assert len({type(message) for message, _ in found}) == len(KINDS)


def test_every_kind_is_written_as_the_vendor_does(tmp_path: Path) -> None:
    """Text stamps, and times of titles in the index, may differ by 1 ms.

    The vendor's recorder reads the clock more than once for a message.
    """
    write_again(EVERY_KIND, tmp_path / "r")
    for theirs in EVERY_KIND.iterdir():
        ours = tmp_path / "r" / theirs.name
        if theirs.suffix == ".csv":
            stamp = rb"(\n\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d\d)\d"
            assert re.sub(stamp, rb"\1", ours.read_bytes()) == re.sub(
                stamp, rb"\1", theirs.read_bytes()
            )
        elif theirs.name == "xethru_recording_meta.dat":
            assert_same_meta(ours.read_bytes(), theirs.read_bytes())
        else:
            assert ours.read_bytes() == theirs.read_bytes(), theirs.name


def assert_same_meta(ours: bytes, theirs: bytes) -> None:
    """Compare all but times; the id has its length at 0x55, the index its end at 0x1D."""
    begin = 0x59 + int.from_bytes(theirs[0x55:0x59], "little")
    end = int.from_bytes(theirs[0x1D:0x25], "little")
    entry = np.dtype([("ms", "<i4"), ("rest", "V29")])
    one, other = (np.frombuffer(meta[begin:end], entry) for meta in (ours, theirs))
    assert (ours[:begin], ours[end:]) == (theirs[:begin], theirs[end:])
    assert one["rest"].tobytes() == other["rest"].tobytes()
    assert np.abs(one["ms"] - other["ms"]).max() <= 1


def test_digits_beyond_six_are_written_where_the_bits_need_them(tmp_path: Path) -> None:
    message = m.PresenceSingle(
        counter=0, state=0, distance_m=1.0000001192092896, direction=0, signal_quality=0
    )
    content = written(message, tmp_path / "r", "presence_single", 12, ".csv").decode()
    assert content.splitlines()[1] == STAMP + "0;0;1.0000001;0;0"


def test_stamps_are_in_the_zone_of_the_recorder(tmp_path: Path) -> None:
    message = message_of("appdata_presence_single")
    zone = timezone(timedelta(hours=2))
    with RecordingWriter(tmp_path / "r", timezone=zone) as writer:
        writer.write(message, TIME_NS)
    file = tmp_path / "r" / "xethru_presence_single_19700101_020001.csv"
    assert "1970-01-01T02:00:01.002+02:00;1234;" in file.read_text()
    (tmp_path / "r" / "xethru_recording_meta.dat").unlink()
    assert list(read_recording(tmp_path / "r")) == [(message, TIME_NS)]
