"""What a data file of each kind holds, by the golden vectors and by hand.

Binary records are the vectors' payloads without their leading codes (Protocol reference 12); text
lines, name and bit of a kind are written here by hand.
"""

import struct
from datetime import UTC, timedelta, timezone
from pathlib import Path

import pytest

from hil_tests.golden.vectors import load
from xethru_protocol.recordings import RecordingWriter, read_recording
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
    ("appdata_respiration", "respiration", 3, "10;0;15;1.25;2.5;9"),
    ("data_string", "string", 5, "0;0;hello"),
    ("appdata_respiration_detectionlist", "respiration_detectionlist", 14, "15;1;[1.5];[-2];[0]"),
    ("appdata_respiration_movinglist", "respiration_movinglist", 15, "14;2;[1,2];[3,4]"),
    ("appdata_vital_signs", "vitalsigns", 16, "12;7;15;1.5;0.5;60;1.5;0.75;1;2;1;2"),
    ("appdata_sleep_stage", "sleepstage", 17, "13;2"),
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
    with RecordingWriter(folder, timezone=UTC) as writer:
        assert writer.write(message, TIME_NS)
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


def test_text_with_separators_stays_in_its_cell(tmp_path: Path) -> None:
    text = "a;b\n\\n\rü\x85;"
    message = m.DataString(content_id=1, info=2, text=text)
    content = written(message, tmp_path / "r", "string", 5, ".csv").decode("latin-1")
    assert content.count("\n") == 2
    assert content.split("\n")[1] == STAMP + "1;2;a\\x3bb\\n\\\\n\\rü\x85\\x3b"


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
