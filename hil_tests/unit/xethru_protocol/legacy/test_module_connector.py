"""ModuleConnector, its interfaces and recordings by the vendor's names."""

import gc
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil_tests.architecture.test_moduleconnector import HEADERS, rows
from hil_tests.paths import FIXTURES
from hil_tests.patience import wait_until
from hil_tests.unit.xethru_protocol.pty_module import PtyModule
from hil_tests.unit.xethru_protocol.scripted import PlainModule
from xethru_protocol import legacy
from xethru_protocol.legacy import data, module_connector, recordings
from xethru_protocol.legacy.data import MISSING
from xethru_protocol.legacy.module_connector import STREAMS, ModuleConnector, create_mc
from xethru_protocol.recordings import Split, read_recording
from xethru_protocol.transport import open_line
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import encode
from xethru_protocol.wire.codes import X4Setting

EVERY_KIND = FIXTURES / "recordings/every_kind/xethru_recording_meta.dat"
SINGLE = FIXTURES / "recordings/single/xethru_recording_meta.dat"
CLASSES = {
    "ModuleConnector, auto": (ModuleConnector, module_connector),
    "X4M300, X4M200, X4M210": (module_connector.X4M300Interface, module_connector.X4M200Interface),
    "XEP": (module_connector.XEP,),
    "Bootloader": (legacy.Bootloader, legacy),
    "DataRecorder, RecordingOptions, PreferredSplitSize": (
        legacy.DataRecorder,
        legacy.RecordingOptions,
        legacy.PreferredSplitSize,
    ),
    "DataReader, DataRecord": (legacy.DataReader, legacy.DataRecord, legacy),
    "DataPlayer": (legacy.DataPlayer,),
}
# Methods of C++ that the vendor's Python package does not have.
NOT_IN_PYTHON = {"log", "get_fb_data_recorder", "get_radar_engine", "get_laptop_presence_app"}


def test_every_method_of_the_table_exists() -> None:
    """Each row of `docs/moduleconnector.md` is a method here, or `MISSING` says what to do."""
    checked = 0
    for row in rows():
        for name in row.theirs if row.section in CLASSES else ():
            if name not in NOT_IN_PYTHON:
                assert any(hasattr(owner, name) for owner in CLASSES[row.section]), name
                checked += 1
    assert checked > 200


def test_every_class_and_method_of_data_exists() -> None:
    made = {name: cls() for name, cls in data.CLASSES.items()}
    known = {*made, *(name for one in made.values() for name in dir(one))}
    (section,) = {HEADERS["Data"]}
    named = {name for row in rows() if row.section == section for name in row.theirs}
    assert named - known == set()


def test_what_is_missing_says_what_there_is_instead() -> None:
    connector, recorder, x4 = ModuleConnector(), legacy.DataRecorder(), legacy.registers.X4(None)
    calls: dict[str, Callable[[], object]] = {
        "DataReader.open with a depth": lambda: legacy.DataReader().open(str(SINGLE), 1),
        "DataPlayer with a depth": lambda: legacy.DataPlayer(str(SINGLE), 0),
        "DataRecorder.process of a text file": lambda: recorder.process(1 << 2, b""),
    }
    for call, instead in MISSING.items():
        owner, _, name = call.partition(".")
        part = x4 if owner == "X4" else connector
        ask = calls.get(call, lambda part=part, name=name: getattr(part, name)())
        with pytest.raises(NotImplementedError, match=re.escape(call)) as error:
            ask()
        assert instead in str(error.value)


def test_numbers_are_those_of_the_vendors_headers() -> None:
    folder = os.environ.get("XETHRU_MODULECONNECTOR")
    if not folder:
        pytest.skip("XETHRU_MODULECONNECTOR does not name the folder of its headers")
    text = Path(folder, "xtid.h").read_text()
    defined = re.findall(r"^#define (XT\w+)\s+\(?([\w<]+)\)?", text, re.MULTILINE)
    assert len(defined) > 100
    numbers = data.numbers()
    for name, value in defined:
        left, _, right = value.partition("<<")
        assert numbers[name] == int(left, 0) << int(right or 0), name
    bits = re.findall(r"(\w+)\s+= 1 << (\d+),", Path(folder, "datatypes.h").read_text())
    assert bits
    for name, bit in bits:
        assert getattr(legacy.DataType, name) == 1 << int(bit), name


def test_register_fields_lie_in_their_registers() -> None:
    """The chip's identity and the transmitter's power, of Protocol reference 9.7 and 4.9."""
    for name, field in legacy.registers.FIELDS.items():
        assert 0 <= field.low <= field.high <= 7, name
        assert 0 <= field.address <= 127, name


class Registers:
    """PIF registers that an X4 of the extras reads and writes."""

    def __init__(self, **of_address: int) -> None:
        self.pif = {int(name[1:]): value for name, value in of_address.items()}
        self.x4driver_get_pif_register = self.pif.__getitem__
        self.x4driver_set_pif_register = self.pif.__setitem__


@pytest.mark.parametrize("before", [0x00, 0x9F, 0xFF, 0x8A])
@pytest.mark.parametrize("power", range(4))
def test_a_register_field_is_written_and_its_neighbours_stay(before: int, power: int) -> None:
    """Field tx_power is bits 6 and 5 of register 117."""
    registers = Registers(_117=before)
    x4 = legacy.registers.X4(registers)
    assert x4.tx_power == before >> 5 & 3
    x4.tx_power = power
    assert registers.pif == {117: before & 0x9F | power << 5}


# --- at a port ----------------------------------------------------------------------------------


def test_frames_wait_until_they_are_read(module: PtyModule) -> None:
    with create_mc(module.path) as mc:
        xep = mc.get_xep()
        assert xep.peek_message_data_float() == 0
        xep.x4driver_set_fps(17.0)
        wait_until(lambda: xep.peek_message_data_float() >= 3)
        frames = [xep.read_message_data_float() for _ in range(3)]
        xep.x4driver_set_fps(0)
    assert [frame.info for frame in frames] == [0, 1, 2]
    assert [np.array(frame.data).tolist() for frame in frames[1:]] == [[1.0] * 1431, [2.0] * 1431]
    assert frames[2].get_data().dtype == np.float32
    assert frames[2].data.size() == 1431


def test_two_modules_at_once(module: PtyModule) -> None:
    with PtyModule() as other:
        connectors = [ModuleConnector(one.path) for one in (module, other)]
        interfaces = [connector.get_xep() for connector in connectors]
        for xep in interfaces:
            xep.x4driver_set_fps(20)
        for xep in interfaces:
            assert [xep.read_message_data_float().info for _ in range(5)] == [0, 1, 2, 3, 4]
        for connector in connectors:
            connector.close()


def test_closing_twice_does_nothing_and_later_calls_say_so(module: PtyModule) -> None:
    connector = ModuleConnector(module.path)
    xep = connector.get_xep()
    connector.close()
    connector.close()
    for call in (xep.ping, xep.read_message_data_float):
        with pytest.raises(RuntimeError, match="was closed"):
            call()
    connector.open(module.path)
    assert connector.get_xep().ping() == 0xAAEEAEEA
    connector.close()


def test_a_dropped_connector_releases_its_port_but_an_interface_keeps_it(
    module: PtyModule,
) -> None:
    connector = ModuleConnector(module.path)
    xep = connector.get_xep()
    del connector
    gc.collect()
    assert xep.ping() == 0xAAEEAEEA
    del xep
    gc.collect()
    open_line(module.path).close()


def test_an_interface_outlives_its_block_until_the_port_is_opened_again(
    module: PtyModule,
) -> None:
    with create_mc(module.path) as mc:
        xep = mc.get_xep()
    assert xep.ping() == 0xAAEEAEEA
    with create_mc(module.path) as mc:
        assert mc.get_xep().ping() == 0xAAEEAEEA
    with pytest.raises(RuntimeError, match="was closed"):
        xep.ping()


def test_unplugging_ends_a_read_that_waits() -> None:
    with PtyModule(PlainModule(instead={m.ModReset(): [b""]})) as module:
        connector = ModuleConnector(module.path)
        xep = connector.get_xep()
        errors: list[str] = []

        def read() -> None:
            with pytest.raises(RuntimeError) as error:
                xep.read_message_data_float()
            errors.append(str(error.value))

        thread = threading.Thread(target=read)
        thread.start()
        with pytest.raises(RuntimeError, match="module_reset"):
            xep.module_reset()
        thread.join()
        assert "was disconnected; plug the module in again" in errors[0]
        assert errors[0].startswith("read_message_data_float")
        with pytest.raises(RuntimeError, match="was disconnected"):
            xep.ping()
        connector.close()


def test_a_refusal_is_a_runtime_error_that_names_the_call() -> None:
    refuses = PlainModule(instead={m.LoadApp: [m.Error(code=0x20)]})
    with PtyModule(refuses) as module, create_mc(module.path) as mc:
        x4m300 = mc.get_x4m300()
        with pytest.raises(RuntimeError, match="load_profile: the module refused") as error:
            x4m300.load_profile(1)
        assert error.value.__suppress_context__
        with pytest.raises(TypeError, match=r"load_profile\(\): missing a required argument"):
            x4m300.load_profile()


def test_commands_are_the_vendors_own(module: PtyModule) -> None:
    """One command of the script is one on the wire; a mode is sent as one byte (4.2).

    The driver asks once for the version, before a command that not all firmware has.
    """
    with create_mc(module.path) as mc:
        xep, app = mc.get_xep(), mc.get_x4m300()
        xep.x4driver_set_iterations(8)
        xep.x4driver_set_frame_area(0.5, 5)
        app.set_sensor_mode(0x12, 0)
        xep.delete_file(-0x80000000, 5)  # a type as a signed number
    area = next(one for one in module.received if getattr(one, "setting", None) == 0x14)
    assert module.received[0] == m.X4DriverSet(setting=X4Setting.ITERATIONS, value=8)
    assert area == m.X4DriverSet(setting=X4Setting.FRAMEAREA, value=(0.5, 5.0))
    assert m.SetMode(mode=0x12) in module.received
    assert m.DeleteFile(file_type=0x80000000, identifier=5) in module.received
    assert sum(not isinstance(one, m.SystemGetInfo) for one in module.received) == 4


@pytest.mark.parametrize(
    "content",
    [b"\x7c" * 4, b"ab" + b"\x7c" * 300 + b"c", bytes(255) + b"\x7c" * 6, b"\x7d\x7c\x7c\x7c"],
)
def test_file_data_that_a_module_would_misread_are_sent_in_pieces(content: bytes) -> None:
    """No packet has four 7C, in its payload or with its checksum. Protocol reference 1.2."""
    with PtyModule() as module, create_mc(module.path) as mc:
        mc.get_xep().set_file_data(0x80000000, 5, 100, content)
        sent = [each for each in module.received if isinstance(each, m.SetFileData)]
    written = bytearray(len(content))
    for piece in sent:
        written[piece.offset - 100 : piece.offset - 100 + len(piece.data)] = piece.data
        assert b"\x7c" * 4 not in encode(piece)
    assert bytes(written) == content
    assert sum(len(piece.data) for piece in sent) == len(content)


@pytest.mark.parametrize("answered", [b"", bytes(300)], ids=["nothing", "too much"])
def test_file_data_that_do_not_come_end_with_an_error(answered: bytes) -> None:
    plain = PlainModule(instead={m.GetFileData: [m.ReplyByte(values=answered)]})
    with (
        PtyModule(plain) as module,
        create_mc(module.path) as mc,
        pytest.raises(RuntimeError, match=f"sent {len(answered)} bytes from 7 on, not 256"),
    ):
        mc.get_xep().get_file_data(0x80000000, 5, 7, 1000)


@pytest.mark.parametrize(
    ("call", "command", "answer", "says"),
    [
        ("get_detection_zone", m.GetDetectionZone, m.ReplyFloat(values=(0.4,)), "1 values, not 2"),
        (
            "get_detection_zone_limits",
            m.GetDetectionZoneLimits,
            m.ReplyFloat(values=()),
            "0 values, not 3",
        ),
        (
            "get_periodic_noisemap_store",
            m.NoiseMapGetPeriodicStore,
            m.ReplyInt(values=()),
            "0 values, not 1",
        ),
    ],
)
def test_an_answer_with_too_few_values_ends_with_an_error(
    call: str, command: type[m.Message], answer: m.Response, says: str
) -> None:
    plain = PlainModule(instead={command: [answer]})
    with (
        PtyModule(plain) as module,
        create_mc(module.path) as mc,
        pytest.raises(RuntimeError, match=f"answers {command.__name__} with {says}"),
    ):
        getattr(mc.get_x4m300(), call)()


def test_auto_finds_emulated_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert [port for port in legacy.auto() if "ttyACM" not in port and "ttyUSB" not in port] == []
    with pytest.raises(IndexError, match="xethru list"):
        legacy.auto_open(ix=99)


# --- recordings ---------------------------------------------------------------------------------


@pytest.mark.parametrize("stream", STREAMS)
def test_every_message_is_read_under_the_vendors_names(stream: str) -> None:
    kind, _ = STREAMS[stream]
    wanted = next((one for one, _ in read_recording(EVERY_KIND) if type(one) is kind), None)
    assert wanted is not None
    player = legacy.DataPlayer(str(EVERY_KIND))
    connector = ModuleConnector(player)
    interface = next(
        one
        for one in (connector.get_xep(), connector.get_x4m300(), connector.get_x4m200())
        if hasattr(one, f"read_message_{stream}")
    )
    player.set_playback_rate(1e6)
    player.play()
    found = getattr(interface, f"read_message_{stream}")()
    counter = getattr(found, "frame_counter", getattr(found, "counter", None))
    assert counter == getattr(wanted, "counter", None)
    for name in type(found)._lists:
        ours = getattr(wanted, type(found)._fields[name])
        assert np.array_equal(getattr(found, name), list(ours)), name
    connector.close()


def test_playing_ends_and_says_so() -> None:
    player = legacy.DataPlayer(str(SINGLE), -1)
    connector = ModuleConnector(player)
    x4m300 = connector.get_x4m300()
    player.set_playback_rate(1e6)
    player.play()
    total = sum(isinstance(one, m.PresenceSingle) for one, _ in read_recording(SINGLE))
    read = [x4m300.read_message_presence_single() for _ in range(total)]
    assert len(read) == total > 1
    with pytest.raises(RuntimeError, match="the recording has ended"):
        x4m300.read_message_presence_single()
    with pytest.raises(RuntimeError, match="answers no commands"):
        x4m300.get_sensitivity()
    assert player.get_state() == player.StoppedState


def test_playing_in_a_loop_with_a_filter() -> None:
    player = legacy.DataPlayer(str(EVERY_KIND), -1)
    connector = ModuleConnector(player)
    player.set_filter(legacy.DataType.SleepDataType)
    player.set_loop_mode_enabled(True)
    player.set_playback_rate(1e6)
    player.play()
    x4m200 = connector.get_x4m200()
    total = sum(isinstance(one, m.SleepStatus) for one, _ in read_recording(EVERY_KIND))
    first = [x4m200.read_message_respiration_sleep().frame_counter for _ in range(total)]
    assert [x4m200.read_message_respiration_sleep().frame_counter for _ in range(total)] == first
    assert x4m200.peek_message_vital_signs() == 0
    player.pause()
    position = player.get_position()
    assert 0 <= position <= player.get_duration()
    assert player.get_position() == position
    assert (player.set_position(-1), player.set_position(0)) == (1, 0)
    player.stop()
    assert player.get_position() == 0
    connector.close()


def test_a_missing_recording_is_a_runtime_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RuntimeError, match="nowhere"):
        legacy.DataPlayer("nowhere/xethru_recording_meta.dat")
    assert legacy.DataReader().open("nowhere/xethru_recording_meta.dat") == 1
    assert "nowhere" in capsys.readouterr().err


def test_the_reader_has_sleep_data(tmp_path: Path) -> None:
    reader = legacy.DataReader()
    assert reader.open(str(EVERY_KIND)) == 0
    assert reader.set_filter(legacy.DataType.SleepDataType) == 0
    wanted = next(one for one, _ in read_recording(EVERY_KIND) if isinstance(one, m.SleepStatus))
    assert reader.peek_record().data == reader.read_record().data
    assert reader.seek_ms(0) == 0
    record = reader.read_record()
    assert (record.is_valid, record.data_type) == (True, 1 << 2)
    assert vars(record.to_sleep_data())["respiration_rate"] == wanted.rpm
    assert record.epoch >= reader.get_start_epoch()
    assert reader.get_data_types() & legacy.DataType.VitalSignsDataType
    reader.close()
    with pytest.raises(RuntimeError, match="open"):
        reader.at_end()


def test_a_recorder_that_a_script_forgets_leaves_a_whole_recording(
    module: PtyModule, tmp_path: Path
) -> None:
    connector = ModuleConnector(module.path)
    recorder = connector.get_data_recorder()
    began_ns = time.time_ns()
    assert recorder.start_recording(legacy.AllDataTypes, str(tmp_path)) == 0
    xep = connector.get_xep()
    xep.x4driver_set_fps(20)
    counters = [xep.read_message_data_float().info for _ in range(4)]
    del recorder, xep, connector
    gc.collect()
    (folder,) = tmp_path.iterdir()
    rows = [
        (one.info, t_ns) for one, t_ns in read_recording(folder) if isinstance(one, m.DataFloat)
    ]
    assert [counter for counter, _ in rows][: len(counters)] == counters
    # Unix time, in milliseconds
    times_ns = [t_ns for _, t_ns in rows if t_ns is not None]
    assert len(times_ns) == len(rows)
    assert began_ns - 10**6 <= times_ns[0] <= times_ns[-1] <= time.time_ns()


def test_recorder_reports_what_it_cannot_do(
    module: PtyModule, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with create_mc(module.path) as mc:
        recorder = mc.get_data_recorder()
        assert recorder.start_recording(legacy.DataType.FloatDataType, str(tmp_path)) == 0
        assert recorder.is_recording(legacy.DataType.FloatDataType)
        assert not recorder.is_recording(legacy.DataType.SleepDataType)
        assert recorder.start_recording(legacy.DataType.FloatDataType, str(tmp_path)) == 1
        assert "is being recorded already" in capsys.readouterr().err
        (tmp_path / "file").touch()
        texts: list[str] = []
        recorder.set_error_callback(texts.append)
        where = str(tmp_path / "file")
        assert recorder.start_recording(legacy.DataType.SleepDataType, where) == 1
        assert "file" in texts[0]


def test_options_are_those_of_the_writer() -> None:
    size = legacy.PreferredSplitSize()
    assert (size.get_type(), size.get_duration()) == (size.InvalidType, -1)
    size.set_byte_count(1000)
    options = legacy.RecordingOptions()
    options.set_file_split_size(size)
    options.set_data_rate_limit(500)
    options.set_user_header(data.Vector(b"lab"))
    copied = recordings.RecordingOptions(options).writer_options()
    assert copied["split"] == Split(bytes=1000)
    assert (copied["interval_s"], copied["user_header"]) == (0.5, b"lab")
    assert copied["split_directories"] is None


def test_nothing_is_taken_by_the_package_itself() -> None:
    """Only `xethru_protocol.legacy`, asked for by name, takes the vendor's."""
    program = (
        "import sys, xethru_protocol, xethru_protocol.cli.arguments, xethru_protocol.recordings\n"
        "assert not any(name.startswith('pymodule') for name in sys.modules)\n"
        "import xethru_protocol.legacy\n"
        "from pymoduleconnector.extras.auto import auto\n"
        "xethru_protocol.legacy.remove()\n"
        "assert not any(name.startswith('pymodule') for name in sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
