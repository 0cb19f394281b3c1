"""The vendor's examples, unchanged, on emulated modules: ``pytest --vendor-examples DIR``.

``DIR`` is a copy of ``pymoduleconnector/examples`` or of ``Latest_MC_examples/PYTHON``, or a folder
above both. The table of `docs/legacy.md` is `EXAMPLES`, as a test shows. Most examples never end by
themselves: they get Ctrl-C once they have printed what they are for.
"""

import importlib.util
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from emulator import emulated_port
from hil_tests.paths import REPOSITORY
from hil_tests.patience import wait_until
from hil_tests.unit.xethru_protocol.driver.test_driver_firmware import (
    DATA,
    PADDED,
    announced,
    hex_file,
)
from xethru_protocol.recordings import RecordingWriter, read_recording
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.table import Response

DOCUMENT = REPOSITORY / "docs" / "legacy.md"
X4M200 = ("--model", "x4m200")
FAST = ("--pace", "asap")


@dataclass(frozen=True, slots=True, kw_only=True)
class Example:
    """An example: its arguments after the name, what it must print, and how it ends.

    ``port``: how it gets the port; "" if it looks for one itself. ``shows`` is a regular
    expression. ``interrupted``: it goes on until Ctrl-C, and ends then with ``exit_code``.
    ``why_not`` is why it does not run.
    """

    name: str
    shows: str
    arguments: tuple[str, ...] = ()
    port: tuple[str, ...] = ("-d", "PORT")
    emulator: tuple[str, ...] = ()
    scene: str | None = None
    interrupted: bool = False
    exit_code: int = 0
    needs: tuple[str, ...] = ()
    why_not: str = ""
    thorough: bool = False


_PLOT = ("matplotlib", "numpy")
_X2 = "for modules with the X2 chip"
_DATES = "calls plot_date, which Matplotlib 3.11 does not have"
_HALVES = ("--option", "matrix_messages=halves")
EXAMPLES = (
    Example(
        name="X2M200_plot_respiration.py",
        shows=r"NotImplementedError: ModuleConnector\.get_x2m200",
        exit_code=1,
        needs=_PLOT,
        why_not=_X2,
    ),
    Example(
        name="X2M200_record.py",
        shows=r"NotImplementedError: ModuleConnector\.get_x2m200",
        exit_code=1,
        why_not=_X2,
    ),
    Example(
        name="X2M200_read_record.py",
        shows=r"read data of type: 4096, size: \d+[\s\S]*session id: \S",
        arguments=("-f", "RECORDING"),
        port=(),
    ),
    Example(
        name="X4M200_X4M300_manipulate_noisemap.py",
        shows=r"Getting a list of noisemaps",
        thorough=True,
    ),
    Example(
        name="X4M200_X4M300_printout_infromation.py",
        shows=r"Received pong: 0xaaeeaeea[\s\S]*fps returned:  20\.04",
    ),
    Example(
        name="X4M200_X4M300_printout_pulsedoppler_data.py",
        arguments=("-n", "2", "-m", "fast"),
        shows=r"Instance: fast \(\d+, \d+\)[\s\S]*Instance: fast",
        emulator=(*FAST, *_HALVES),
    ),
    Example(
        name="X4M200_sleep_record.py",
        shows=r"Frame: \d+ RPM: 0\.0",
        emulator=X4M200,
        interrupted=True,
        exit_code=130,
        needs=_PLOT,
    ),
    Example(
        name="X4M300_playback_recording.py",
        shows=r"received presence single data, frame counter: \d+",
        arguments=("-f", "RECORDING"),
        port=(),
        interrupted=True,
        exit_code=130,
    ),
    Example(
        name="X4M300_plot_movementlist.py",
        shows=r"Start streaming movinglist",
        needs=_PLOT,
        thorough=True,  # two minutes to start
    ),
    Example(
        name="X4M300_printout_presence_state.py",
        shows=r"Presence -> FrameCounter: \d+, State: ",
        arguments=("-n", "2"),
        scene="visitor",
    ),
    Example(name="XEP_X4M200_X4M300_access_registers.py", shows="TX power is now 1", port=()),
    Example(
        name="XEP_X4M200_X4M300_plot_record_playback_radar_raw_data.py",
        shows="",
        arguments=("-r",),
        needs=_PLOT,
    ),
    Example(
        name="x4m200_print_record_playback_RESP_SLEEP_message.py",
        shows=r"message_respiration_sleep: frame_counter: \d+ sensor_state: ",
        emulator=X4M200,
        interrupted=True,
        needs=_PLOT,
    ),
    Example(
        name="x4m300_print_record_playback_PRESENCE_message.py",
        shows=r"message_presence_single: frame_counter: \d+ presence_state: ",
        interrupted=True,
        needs=_PLOT,
    ),
    Example(
        name="x4m2x0_plot_sleep_csv_recording_file.py",
        shows="no attribute 'plot_date'",
        arguments=("--report", "SLEEP"),
        port=(),
        exit_code=1,
        needs=_PLOT,
        why_not=_DATES,
    ),
    Example(
        name="x4m2x0_plot_vitalsigns_csv_recording_file.py",
        shows="no attribute 'plot_date'",
        arguments=("--report", "VITALSIGNS"),
        port=(),
        exit_code=1,
        needs=_PLOT,
        why_not=_DATES,
    ),
    Example(
        name="xep_distance_demo_host.py",
        shows=r"read_message_data_string has waited 10 s",
        interrupted=True,
        exit_code=130,
        needs=(*_PLOT, "six"),
        why_not="needs a module with the firmware XEP Distance Demo, whose texts it waits for",
    ),
    Example(name="xep_sample_direct_path.py", shows="", port=(), needs=(*_PLOT, "scipy")),
    Example(name="xt_modules_access_registers.py", shows="TX power is now 1", port=()),
    Example(
        name="xt_modules_firmware_update.py",
        shows=r"done[\s\S]*Annapurna",
        arguments=("-f", "IMAGE"),
        needs=("intelhex",),
    ),
    Example(
        name="xt_modules_plot_record_playback_radar_raw_data_message_2D.py",
        shows=r"frameBinCount = 107",
        arguments=("-r",),
        needs=_PLOT,
    ),
    Example(
        name="xt_modules_plot_record_playback_radar_raw_data_message_3D.py",
        shows=r"Setting fps to 17",
        needs=(*_PLOT, "six"),
    ),
    Example(name="xt_modules_print_info.py", shows=r"OrderCode =  X4M300"),
    Example(name="xt_modules_record_playback_messages.py", shows="", port=()),
    Example(name="xt_modules_set_certification_mode.py", shows="Set Mode:0x1A"),
    Example(
        name="xt_sensors_plot_record_movinglist_message.py",
        shows="Start plot movinglist",
        scene="visitor",
        emulator=FAST,
        needs=_PLOT,
    ),
    Example(
        name="xt_sensors_plot_record_playback_baseband_IQ_AP_message.py",
        shows="Start plot radar baseband data",
        needs=_PLOT,
    ),
    Example(
        name="xt_sensors_print_record_PulseDoppler_Noisemap_message.py",
        shows=r"Instance: fast \(\d+, \d+\)[\s\S]*Instance: fast",
        arguments=("-n", "2", "-m", "fast"),
        emulator=(*FAST, *_HALVES),
        needs=_PLOT,
    ),
)


def _cases() -> Iterator[object]:
    for example in EXAMPLES:
        marks = [pytest.mark.thorough, pytest.mark.timeout(0)] if example.thorough else []
        yield pytest.param(example, id=example.name, marks=[*marks, pytest.mark.slow])


def _found(folder: str | None, example: Example) -> Path:
    if not folder:
        pytest.skip("--vendor-examples names no folder with the vendor's examples")
    path = next(iter(sorted(Path(folder).rglob(example.name))), None)
    if path is None:
        pytest.skip(f"there is no {example.name} in {folder}")
    for package in example.needs:
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"the example imports {package}, which is not installed")
    return path


@pytest.mark.parametrize("example", list(_cases()))
def test_example_runs_unchanged(
    example: Example,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = _found(request.config.getoption("--vendor-examples"), example)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # no emulator but this test's is found
    with emulated_port(example.scene, *example.emulator) as port:
        code, shown = _run(path, example, port, tmp_path)
    assert re.search(example.shows, shown), shown
    assert code == example.exit_code, shown


def _run(path: Path, example: Example, port: str, folder: Path) -> tuple[int, str]:
    places = {
        "PORT": port,
        "RECORDING": str(REPOSITORY / "fixtures/recordings/single/xethru_recording_meta.dat"),
        "IMAGE": str(_image(folder)),
        "SLEEP": str(_table(folder, m.SleepStatus)),
        "VITALSIGNS": str(_table(folder, m.VitalSigns)),
    }
    arguments = [places.get(one, one) for one in (*example.port, *example.arguments)]
    command = [sys.executable, "-P", "-m", "xethru_protocol.cli", "legacy", str(path), *arguments]
    environment = {**os.environ, "MPLBACKEND": "Agg", "PYTHONUNBUFFERED": "1"}
    out = folder / "shown.txt"
    with out.open("wb") as stream:
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=stream, stderr=subprocess.STDOUT
        )
        try:
            if example.interrupted:
                wait_until(
                    lambda: process.poll() is not None or re.search(example.shows, out.read_text())
                )
                process.send_signal(signal.SIGINT)
            code = process.wait()
        finally:
            process.kill()
            process.wait()
    return code, out.read_text()


def _image(folder: Path) -> Path:
    path = folder / "image.hex"
    path.write_bytes(hex_file(DATA, announced(sum(PADDED))))
    return path


def _table(folder: Path, kind: type[Response]) -> Path:
    """Return the file in which a recording has five messages of a kind, a second apart."""
    every_kind = REPOSITORY / "fixtures/recordings/every_kind"
    message = next(one for one, _ in read_recording(every_kind) if type(one) is kind)
    with RecordingWriter(folder / kind.__name__) as writer:
        for second in range(5):
            writer.write(message, second * 10**9)
    (path,) = (folder / kind.__name__).glob("*.csv")
    return path


def test_table_of_the_document_is_this_one() -> None:
    """A row for each example: its name, whether it runs, and why it does not."""
    rows = re.findall(r"^\| `(\w+\.py)` \| (yes|no) \|([^|]*)\|$", DOCUMENT.read_text(), re.M)
    runs = {name: runs == "yes" for name, runs, _ in rows}
    assert runs == {example.name: not example.why_not for example in EXAMPLES}
    notes = {name: note for name, _, note in rows}
    for example in EXAMPLES:
        assert example.why_not in notes[example.name]
        for package in set(example.needs) - {"numpy"}:
            assert package in notes[example.name], example.name
