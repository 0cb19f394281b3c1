"""The parts of a driver: what each call sends, by the golden vectors, and what it makes of answers.

The API of `xethru_protocol` itself: its names, lazily imported, and typed.
"""

import asyncio
import inspect
import math
import pydoc
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, assert_type

import numpy as np
import pytest

import xethru_protocol
from hil_tests.golden.builders import message_of
from hil_tests.golden.vectors import load
from hil_tests.unit.xethru_protocol.both_drivers import AsyncScripted, DriverOn, Scripted
from hil_tests.unit.xethru_protocol.emulated import Emulated, EmulatedModule
from hil_tests.unit.xethru_protocol.scripted import PlainModule, ScriptedTransport, frame, framed
from xethru_protocol import (
    X4M300,
    AsyncX4M300,
    Frame,
    FrameGeometry,
    NoiseMapControl,
    RawConfig,
)
from xethru_protocol.driver import board, chip
from xethru_protocol.driver.link import Part
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import (
    InjectMode,
    IoPinFeature,
    IoPinSetup,
    OutputFeature,
    ProfileId,
    SensorMode,
    X4Setting,
)
from xethru_protocol.wire.errors import (
    DeviceError,
    LocalProtocolError,
    RemoteProtocolError,
    ResponseTimeout,
    XeThruError,
)

VECTORS = {vector.name: vector for vector in load()}
USER = 0x80000000
OUTPUT = OutputFeature

# What a user writes, and the vector that goes over the line for it.
CALLS: dict[str, Callable[[X4M300], object]] = {
    "x4_init": lambda r: r.x4.init(),
    "doc_x4_set_fps_0": lambda r: setattr(r.x4, "fps", 0),
    "x4_set_pps_300": lambda r: setattr(r.x4, "pulses_per_step", 300),
    "x4_set_iterations_16": lambda r: setattr(r.x4, "iterations", 16),
    "x4_set_iterations_125_payload_escape": lambda r: setattr(r.x4, "iterations", 125),
    "x4_set_downconversion_1": lambda r: setattr(r.x4, "downconversion", True),
    "x4_set_frame_area_0.2_9.4": lambda r: setattr(r.x4, "frame_area_m", (0.2, 9.4)),
    "x4_set_dac_step_2_parser_form": lambda r: setattr(r.x4, "dac_step", 2),
    "x4_set_dac_min_949": lambda r: setattr(r.x4, "dac_min", 949),
    "x4_set_dac_max_1100": lambda r: setattr(r.x4, "dac_max", 1100),
    "x4_set_frame_area_offset_0.18": lambda r: setattr(r.x4, "offset_m", 0.18),
    "x4_set_enable_0": lambda r: r.x4.enable(False),
    "x4_set_tx_center_4": lambda r: setattr(r.x4, "tx_center_frequency", 4),
    "x4_set_tx_power_2": lambda r: setattr(r.x4, "tx_power", 2),
    "x4_set_prf_div_16": lambda r: setattr(r.x4, "prf_div", 16),
    "x4_get_fps": lambda r: r.x4.fps,
    "x4_get_pulsesperstep": lambda r: r.x4.pulses_per_step,
    "x4_get_iterations": lambda r: r.x4.iterations,
    "x4_get_downconversion": lambda r: r.x4.downconversion,
    "x4_get_framearea": lambda r: r.x4.frame_area_m,
    "x4_get_dacstep": lambda r: r.x4.dac_step,
    "x4_get_dacmin": lambda r: r.x4.dac_min,
    "x4_get_dacmax": lambda r: r.x4.dac_max,
    "x4_get_frameareaoffset": lambda r: r.x4.offset_m,
    "x4_get_txcenterfrequency": lambda r: r.x4.tx_center_frequency,
    "x4_get_txpower": lambda r: r.x4.tx_power,
    "x4_get_prfdiv": lambda r: r.x4.prf_div,
    "x4_get_framebincount": lambda r: r.x4.frame_bin_count,
    "x4_set_spi_register": lambda r: r.registers.write("spi", 4, 0xA5),
    "x4_set_pif_register_escaped": lambda r: r.registers.write("pif", 0x7E, 0x7F),
    "x4_set_xif_register": lambda r: r.registers.write("xif", 4, 0x0F),
    "x4_get_spi_register": lambda r: r.registers.read("spi", 2),
    "x4_get_pif_register": lambda r: r.registers.read("pif", 0x35),
    "x4_get_xif_register": lambda r: r.registers.read("xif", 3),
    "x4_write_to_spi_register": lambda r: r.registers.write_burst(0x13, b"\x01\x02\x03"),
    "x4_read_from_spi_register": lambda r: r.registers.read_burst(5, 12),
    "doc_iopin_setcontrol_io6_out": lambda r: r.pins.set_control(6, IoPinSetup.OUTPUT),
    "iopin_setcontrol_presence_pushpull": lambda r: r.pins.set_control(
        2, IoPinSetup.OUTPUT | IoPinSetup.PUSH_PULL, IoPinFeature.PRESENCE
    ),
    "iopin_getcontrol_1": lambda r: r.pins.control(1),
    "doc_iopin_setvalue_io6_high": lambda r: r.pins.write(6, True),
    "iopin_getvalue_6": lambda r: r.pins.read(6),
    "dir_system_test_x4_conn": lambda r: r.diagnostics.run_test(0x19),
    "debug_level_4": lambda r: r.diagnostics.set_debug_level(4),
    "dir_prepare_inject_frame": lambda r: r.diagnostics.prepare_injection(2, 3, InjectMode.LOOP),
    "dir_inject_frame": lambda r: r.diagnostics.inject_frame(7, [0.5, -0.25, 0.125, 1.0]),
    "postprocessing_set_phase_noise_correction_on_0.5": lambda r: (
        r.postprocessing.set_phase_noise_correction(True, 0.5)
    ),
    "postprocessing_get_phase_noise_correction": lambda r: (
        r.postprocessing.phase_noise_correction_distance()
    ),
    "postprocessing_set_normalisation_1": lambda r: setattr(r.postprocessing, "normalisation", 1),
    "postprocessing_get_normalisation": lambda r: r.postprocessing.normalisation,
    "postprocessing_set_decimation_factor_8": lambda r: setattr(
        r.postprocessing, "decimation_factor", 8
    ),
    "postprocessing_get_decimation_factor": lambda r: r.postprocessing.decimation_factor,
    "postprocessing_set_number_format_1": lambda r: setattr(r.postprocessing, "number_format", 1),
    "postprocessing_get_number_format": lambda r: r.postprocessing.number_format,
    "postprocessing_set_legacy_output_1": lambda r: setattr(r.postprocessing, "legacy_output", 1),
    "postprocessing_get_legacy_output": lambda r: r.postprocessing.legacy_output,
    "getmode": lambda r: r.mode(),
    "doc_setmode_manual": lambda r: r.set_mode(SensorMode.XTID_SM_MANUAL),
    "setmode_reg_cert_tx_only": lambda r: r.set_mode(SensorMode.XTID_SM_REG, 1),
    "loadapp_presence_2": lambda r: r.profile.load(),
    "loadapp_respiration_4": lambda r: r.profile.load(ProfileId.XTS_ID_APP_RESPIRATION_4),
    "dir_get_profile_id": lambda r: r.profile.profile_id(),
    "doc_noisemap_setcontrol_6": lambda r: r.profile.set_noise_map(NoiseMapControl(6)),
    "noisemap_getcontrol": lambda r: r.profile.noise_map(),
    "noisemap_store": lambda r: r.profile.store_noise_map(),
    "noisemap_delete": lambda r: r.profile.delete_noise_map(),
    "led_get": lambda r: r.profile.led(),
    "parameter_file_set": lambda r: r.profile.set_parameter_file("a.par", "x=1;"),
    "parameter_file_get": lambda r: r.profile.parameter_file("a.par"),
    "output_set_pulsedoppler_float_3": lambda r: r.profile.set_output(OUTPUT.PULSEDOPPLER_FLOAT, 3),
    "debug_output_set": lambda r: r.profile.set_debug_output(OUTPUT.BASEBAND_IQ),
    "debug_output_get": lambda r: r.profile.debug_output(OUTPUT.BASEBAND_IQ),
    "dir_search_file_type": lambda r: r.files.find(0x037DD98C),
    "dir_create_file": lambda r: r.files.create(USER, 1, 8),
    "dir_set_file_data": lambda r: r.files.write_part(USER, 1, 0, b"\x7d\x7e\x7f\x7c"),
    "dir_get_file_data": lambda r: r.files.read_part(USER, 1, 0, 4),
    "dir_delete_file": lambda r: r.files.delete(USER, 1),
}


@pytest.mark.parametrize("name", CALLS)
def test_each_call_sends_the_bytes_of_the_reference(loaded: Emulated, name: str) -> None:
    """Protocol reference 4; a file that the vectors open exists."""
    radar, _, _ = loaded
    if name in {"dir_set_file_data", "dir_get_file_data"}:
        radar.files.create(USER, 1, 8)
    sent: list[bytes] = []
    radar.raw_listener = lambda direction, data, t_ns: sent.append(data)
    with suppress(XeThruError):  # of what needs another mode: only what is sent counts
        CALLS[name](radar)
    assert VECTORS[name].wire in sent


# --- X4 settings --------------------------------------------------------------------------------

BEYOND = {
    "iterations": (0, 256),
    "pulses_per_step": (0, 65536),
    "dac_min": (-1, 2048),
    "dac_max": (-1, 2048),
    "dac_step": (-1, 4),
    "tx_power": (-1, 4),
    "tx_center_frequency": (2, 5),
    "prf_div": (3, 256),
    "downconversion": (2,),
}


@pytest.mark.parametrize("name", BEYOND)
def test_values_beyond_the_limits_are_not_sent(raw: Scripted, name: str) -> None:
    """Protocol reference 4.9."""
    radar, line = raw
    line.received.clear()
    for value in BEYOND[name]:
        with pytest.raises(LocalProtocolError, match=rf"^{name} must be .*, not {value}$"):
            setattr(radar.x4, name, value)
    with pytest.raises(LocalProtocolError, match=f"{name} cannot be 'much'"):
        setattr(radar.x4, name, "much")
    assert line.received == []


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_only_finite_numbers_are_sent(raw: Scripted, value: float) -> None:
    radar, line = raw
    line.received.clear()
    for name in ("fps", "offset_m"):
        with pytest.raises(LocalProtocolError, match=f"^{name} must be finite, not {value}$"):
            setattr(radar.x4, name, value)
    with pytest.raises(LocalProtocolError, match=r"^frame_area_m must be finite, not "):
        radar.x4.frame_area_m = (value, value)
    with pytest.raises(LocalProtocolError, match=f"^a frame rate must be finite, not {value}$"):
        radar.start(value)
    assert line.received == []


def test_numbers_beyond_float32_are_not_sent(raw: Scripted) -> None:
    """They neither raise an error of Python nor a warning of numpy."""
    radar, line = raw
    line.received.clear()
    for name in ("fps", "offset_m"):
        with pytest.raises(LocalProtocolError, match=f"^{name} cannot be"):
            setattr(radar.x4, name, 10**400)
    with pytest.raises(LocalProtocolError, match=r"1e\+39 frames/s cannot be"):
        radar.x4.fps = 1e39
    assert line.received == []


def test_a_frame_area_has_two_ends_in_order(raw: Scripted) -> None:
    radar, _ = raw
    with pytest.raises(LocalProtocolError):
        radar.x4.frame_area_m = (5.0, 0.4)
    with pytest.raises(LocalProtocolError, match="frame_area_m cannot be 5"):
        radar.x4.frame_area_m = 5  # type: ignore[assignment] # the mistake
    with pytest.raises(LocalProtocolError, match="follows from frame_area_m"):
        radar.x4.frame_bin_count = 7


def test_an_attribute_that_is_no_setting_is_an_error() -> None:
    line = ScriptedTransport(PlainModule())
    with pytest.raises(AttributeError, match="iteration"):
        X4M300(line).x4.iteration = 8  # type: ignore[attr-defined] # the mistake


def test_settings_read_back_in_their_own_types(emulated: Emulated) -> None:
    radar, _, _ = emulated
    radar.x4.init()
    # after INIT: Protocol reference 9.3
    assert (radar.x4.iterations, radar.x4.pulses_per_step, radar.x4.fps) == (8, 10, 0.0)
    assert radar.x4.downconversion is False
    assert (radar.x4.dac_min, radar.x4.dac_max, radar.x4.dac_step) == (0, 2047, 0)
    assert (radar.x4.tx_power, radar.x4.tx_center_frequency, radar.x4.prf_div) == (2, 3, 16)
    assert radar.x4.offset_m == np.float32(0.18)
    assert radar.x4.frame_bin_count == 1467
    radar.x4.iterations *= 2
    assert radar.x4.iterations == 16


def test_a_changed_setting_is_one_of_the_frames_that_come(emulated: Emulated) -> None:
    """Bins, quantisation and what a reconnect restores follow; Protocol reference 9.4, 9.7."""
    radar, _, _ = emulated
    radar.configure_raw()
    radar.x4.frame_area_m = (0.4, 5.0)
    assert radar.geometry is not None
    assert radar.geometry.n_bins == 716
    radar.x4.downconversion = True
    assert (radar.geometry.n_bins, radar.geometry.downconversion) == (91, True)
    radar.x4.iterations = 64
    plan = radar._link.plan
    assert getattr(plan, "config", None) == RawConfig(
        frame_area_m=(0.4, 5.0), downconversion=True, iterations=64
    )
    assert radar._link.frames.lattice == RawConfig(iterations=64, downconversion=True).lattice
    assert radar.warnings == []


def test_a_setting_changed_while_frames_come_stops_them_for_it(emulated: Emulated) -> None:
    """Protocol reference 4.9: frame length and values change with the next frame."""
    radar, _, module = emulated
    radar.configure_raw()
    radar.start(17)
    module.received.clear()
    radar.x4.iterations = 8
    asked = [c for c in module.received if isinstance(c, m.X4DriverSet)]
    assert [(c.setting, c.value) for c in asked] == [
        (X4Setting.FPS, 0.0),
        (X4Setting.ITERATIONS, 8),
        (X4Setting.FPS, 17.0),
    ]
    plan = radar._link.plan
    assert getattr(plan, "fps", None) == 17.0


@pytest.mark.parametrize(
    ("answer", "error"),
    [(m.Error(code=1), DeviceError), (m.ReplyInt(content_id=0, values=(1,)), RemoteProtocolError)],
)
def test_frames_go_on_after_a_setting_that_the_module_refuses(
    raw: Scripted, answer: m.Message, error: type[XeThruError]
) -> None:
    radar, line = raw
    plain = line.answer

    def refusing(command: m.Message) -> Sequence[m.Message | bytes]:
        if isinstance(command, m.X4DriverSet) and command.setting is X4Setting.DACMIN:
            return [answer]
        return plain(command)

    line.answer = refusing
    radar.start(17)
    with pytest.raises(error):
        radar.x4.dac_min = 950
    assert getattr(radar._link.plan, "fps", None) == 17.0
    assert line.received[-2] == m.X4DriverSet(setting=X4Setting.FPS, value=17.0)


def test_start_takes_the_settings_that_it_finds(emulated: Emulated) -> None:
    """Without `configure_raw`, as the vendor's examples set up a radar one value at a time."""
    radar, line, _ = emulated
    radar.set_mode(SensorMode.XTID_SM_MANUAL)
    radar.x4.init()
    radar.x4.iterations = 16
    radar.x4.pulses_per_step = 300
    radar.x4.dac_min = 949
    radar.x4.dac_max = 1100
    radar.x4.frame_area_m = (0.4, 5.0)
    before = radar.geometry
    radar.x4.fps = 17
    after = radar.geometry
    assert before is None
    assert after is not None
    assert after.n_bins == 716
    assert radar._link.frames.lattice == RawConfig().lattice
    line.say(frame(1, 716))
    assert radar.read_frame().samples.shape == (716,)


def test_a_downconversion_other_than_one_is_that_of_rf_frames(emulated: Emulated) -> None:
    """Another program may have set it: the firmware compares with 1."""
    radar, line, module = emulated
    radar.set_mode(SensorMode.XTID_SM_MANUAL)
    radar.x4.init()
    module(m.X4DriverSet(setting=X4Setting.DOWNCONVERSION, value=2))
    assert radar.x4.downconversion is False
    radar.start(17)
    line.say(frame(1, 1467))
    assert radar.read_frame().samples.dtype == np.float32


@pytest.mark.parametrize("downconversion", [0, 1])
@pytest.mark.parametrize("start_m", [math.nan, math.inf])
def test_start_refuses_bins_that_are_nowhere(
    emulated: Emulated, start_m: float, downconversion: int
) -> None:
    radar, _, module = emulated
    radar.set_mode(SensorMode.XTID_SM_MANUAL)
    module(m.X4DriverSet(setting=X4Setting.DOWNCONVERSION, value=downconversion))
    module(m.X4DriverSet(setting=X4Setting.FRAMEAREA, value=(start_m, math.inf)))
    with pytest.raises(RemoteProtocolError, match="reads back frame area"):
        radar.start(17)
    assert radar.x4.fps == 0


@pytest.mark.parametrize(("stopped", "mode"), [(True, "STOP"), (False, "RUN")])
def test_start_in_another_mode_says_what_to_call(
    driver_on: DriverOn, stopped: bool, mode: str
) -> None:
    """Protocol reference 8.3: X4 settings are taken, but frames come in MANUAL only."""
    module = EmulatedModule(stopped=stopped)
    radar, _ = driver_on(module)
    with pytest.raises(LocalProtocolError, match=rf"mode {mode}.*; call configure_raw\(\) first"):
        radar.start(17)
    assert not any(isinstance(command, m.X4DriverSet) for command in module.received)


def test_init_forgets_what_was_configured(raw: Scripted) -> None:
    radar, _ = raw
    radar.x4.init()
    assert radar.geometry is None
    assert radar._link.plan is None


def test_help_of_a_setting_has_units_and_limits() -> None:
    assert (chip.X4.iterations.__doc__ or "").endswith("1 ... 255.")
    rows = [row for row in vars(chip.X4).values() if isinstance(row, chip.X4Row)]
    shown = pydoc.plain(pydoc.render_doc(chip.X4))
    for row in rows:
        assert f" |  {row.name}\n |      {(row.__doc__ or '')[:20]}" in shown
    known = {row.setting for row in rows}
    elsewhere = {  # a method, and `registers`
        *(X4Setting.ENABLE, X4Setting.SPIREGISTER),
        *(X4Setting.PIFREGISTER, X4Setting.XIFREGISTER),
    }
    assert known == set(X4Setting) - elsewhere


def test_type_checkers_know_every_setting() -> None:
    """Mypy judges this test."""

    async def asked(radar: AsyncX4M300) -> None:
        assert_type(radar.x4.iterations, chip.AsyncSetting[int])
        assert_type(await radar.x4.frame_area_m.get(), tuple[float, float])
        assert_type(await radar.postprocessing.number_format.get(), int)
        await radar.x4.fps.set(17)
        radar.x4.iterations = 8  # type: ignore[arg-type] # it must be awaited
        assert_type(await radar.profile.set_zone(0.4, 5.0), tuple[float, float])
        assert_type(await radar.read_frame(timeout_s=1.0), Frame)
        asyncio.create_task(radar.start(17.0))  # noqa: RUF006 - it never runs

    def ask(radar: X4M300) -> None:
        assert_type(radar.x4.iterations, int)
        assert_type(radar.x4.fps, float)
        assert_type(radar.x4.downconversion, bool)
        assert_type(radar.x4.frame_area_m, tuple[float, float])
        assert_type(radar.read_message(m.DataString), m.DataString)
        radar.x4.iterations = "8"  # type: ignore[assignment] # the mistake
        assert_type(radar.profile.set_zone(0.4, 5.0), tuple[float, float])
        assert_type(radar.read_frame(timeout_s=1.0), Frame)
        radar.start("17")  # type: ignore[arg-type] # the mistake

    assert asked.__name__ + ask.__name__  # neither is carried out


def test_a_setting_of_the_asyncio_driver_is_not_assigned() -> None:
    line = ScriptedTransport(PlainModule())
    radar = AsyncX4M300(AsyncScripted(line))
    with pytest.raises(AttributeError, match=r"iterations by: await .*iterations.set\(\)"):
        radar.x4.iterations = 8  # type: ignore[arg-type] # the mistake
    assert line.received == []


@pytest.mark.parametrize("driver", [X4M300, AsyncX4M300])
def test_help_names_every_method_and_part(driver: type) -> None:
    """The text of the class is the manual's first page; private names are not shown."""
    shown = pydoc.plain(pydoc.render_doc(driver))
    assert not re.search(r"^ \|  _[a-z]", shown, re.MULTILINE)
    manual = inspect.getdoc(X4M300) or ""
    for name, _ in inspect.getmembers(X4M300, callable):
        assert name.startswith("_") or f"`{name}`" in manual, name
    made = X4M300(ScriptedTransport(PlainModule()))
    for name, part in vars(made).items():
        if isinstance(part, Part):
            assert f"\n- ``{name}``: " in manual, name


def test_help_of_the_chip_of_a_driver_asks_the_module_nothing() -> None:
    line = ScriptedTransport(PlainModule())
    shown = pydoc.plain(pydoc.render_doc(X4M300(line).x4))
    assert "iterations\n" in shown
    assert line.received == []


# --- registers, pins, diagnostics, post-processing -----------------------------------------------


def test_registers_keep_what_is_written(emulated: Emulated) -> None:
    """Protocol reference 4.9: chip ids in SPI 2 and 3; PIF 53 is the iterations."""
    radar, _, _ = emulated
    radar.x4.init()
    assert [radar.registers.read("spi", at) for at in (2, 3)] == [1, 2]
    radar.registers.write("pif", 53, 77)
    assert radar.registers.read("pif", 53) == 77
    assert len(radar.registers.read_burst(5, 12)) == 12


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda r: r.registers.read("tcp", 1), "registers lie in spi, pif, xif"),
        (lambda r: r.registers.read("pif", 256), "cannot carry address=256"),
        (lambda r: r.registers.write("pif", 1, -1), r"cannot carry value=\(1, -1\)"),
        (lambda r: r.registers.read_burst(5, 6144), "1 ... 6143 bytes, not 6144"),
        (lambda r: r.registers.read_burst(5, 0), "1 ... 6143 bytes, not 0"),
        (lambda r: r.registers.write_burst(5, bytes(6143)), "1 ... 6142 bytes, not 6143"),
        (lambda r: r.diagnostics.inject_frame(1, [0.0]), "two numbers per bin"),
    ],
)
def test_what_a_part_cannot_do_is_said_before_it_is_sent(
    raw: Scripted, ask: Callable[[X4M300], object], says: str
) -> None:
    radar, line = raw
    line.received.clear()
    with pytest.raises(LocalProtocolError, match=says.replace(".", r"\.")):
        ask(radar)
    assert line.received == []


def test_i2c_is_reached_where_the_firmware_has_it(driver_on: DriverOn) -> None:
    """Protocol reference 16."""
    reply = m.ReplyByte(content_id=0x27, values=b"\x01\x02")
    radar, line = driver_on(PlainModule(instead={m.X4DriverReadI2c: [reply]}))
    radar.registers.write_i2c(0x20, b"\xaa")
    assert radar.registers.read_i2c(2) == b"\x01\x02"
    assert line.received == [
        m.X4DriverWriteI2c(address=0x20, values=b"\xaa"),
        m.X4DriverReadI2c(length=2),
    ]


def test_pins_tell_what_they_do(emulated: Emulated) -> None:
    radar, _, _ = emulated
    radar.pins.set_control(6, IoPinSetup.OUTPUT | IoPinSetup.PUSH_PULL)
    assert radar.pins.control(6) == board.PinControl(
        setup=IoPinSetup.OUTPUT | IoPinSetup.PUSH_PULL, feature=IoPinFeature.PASSIVE
    )
    radar.pins.write(6, True)
    assert radar.pins.read(6) is True


def test_verdict_of_a_system_test_is_in_its_info(driver_on: DriverOn) -> None:
    """Protocol reference 4.10: code | passed << 8; certification reports 0 although it worked."""

    def module(command: m.Message) -> Sequence[m.Message | bytes]:
        if isinstance(command, m.SystemGetInfo):
            return [m.Error(code=1)]
        assert isinstance(command, m.SystemTest)
        replies: dict[int, m.Message] = {
            0x11: m.ReplyByte(content_id=0x5090, info=0x0111, values=bytes([1, *[0] * 255])),
            0x19: m.ReplyByte(content_id=0x5090, info=0x0019, values=bytes([0, 4, *[0] * 254])),
            0x1A: m.ReplyByte(content_id=0x5090, info=0x001A, values=bytes(256)),
            0x1F: m.Ack(),
            0x1C: m.ReplyByte(content_id=0x5090, info=0x0111, values=bytes(256)),
        }
        return [replies.get(command.code, m.Error(code=1))]

    radar, _ = driver_on(module)
    results = [radar.diagnostics.run_test(code) for code in (0x11, 0x19, 0x1A, 0x1F)]
    assert [result.passed for result in results] == [True, False, True, True]
    assert [len(result.data) for result in results] == [256, 256, 256, 0]
    with pytest.raises(DeviceError):
        radar.diagnostics.run_test(0x10)
    with pytest.raises(RemoteProtocolError, match="test 1Ch"):
        radar.diagnostics.run_test(0x1C)


def test_postprocessing_keeps_its_settings(emulated: Emulated) -> None:
    """Protocol reference 16."""
    radar, _, _ = emulated
    radar.postprocessing.normalisation = 1
    radar.postprocessing.decimation_factor = 70000
    radar.postprocessing.number_format = 2
    radar.postprocessing.legacy_output = 1
    assert radar.postprocessing.normalisation == 1
    assert radar.postprocessing.decimation_factor == 70000
    assert radar.postprocessing.number_format == 2
    assert radar.postprocessing.legacy_output == 1
    radar.postprocessing.set_phase_noise_correction(True, 0.5)
    assert radar.postprocessing.phase_noise_correction_distance() == 0.5


# --- profile, files, messages -------------------------------------------------------------------


def test_profile_keeps_parameter_file_store_interval_and_debug_outputs(loaded: Emulated) -> None:
    radar, _, _ = loaded
    radar.profile.set_parameter_file("a.par", "x=1;")
    assert radar.profile.parameter_file("a.par") == "x=1;"
    with pytest.raises(DeviceError):
        radar.profile.parameter_file("b.par")
    radar.profile.set_noise_map_interval(15)
    assert radar.profile.noise_map_interval() == 15
    radar.profile.set_debug_output(OutputFeature.BASEBAND_IQ)
    assert radar.profile.debug_output(OutputFeature.BASEBAND_IQ) == 1
    assert radar.profile.output(OutputFeature.BASEBAND_IQ) == 0


@pytest.mark.parametrize(
    "reply",
    [
        m.ReplyString(content_id=0x32BA7623, text="x=1;"),
        m.ReplyByte(content_id=0x32BA7623, values=b"x=1;\x00"),
        m.ParameterFile(name="a.par", data="x=1;"),
    ],
)
def test_parameter_files_come_in_three_ways(driver_on: DriverOn, reply: m.Message) -> None:
    """Protocol reference 4.4."""
    profile_id = m.ReplyInt(values=(0x014D4AB8,))
    plain = PlainModule(instead={m.GetProfileId: [profile_id], m.GetParameterFile: [reply]})
    radar, _ = driver_on(plain)
    assert radar.profile.parameter_file("a.par") == "x=1;"


def test_parts_of_files_are_read_and_written(emulated: Emulated) -> None:
    radar, _, module = emulated
    radar.files.create(USER, 1, 600)
    radar.files.write_part(USER, 1, 100, bytes(range(200)) * 2)
    assert radar.files.read_part(USER, 1, 99, 3) == module.files[USER, 1][99:102]
    assert module.files[USER, 1][100:500] == bytes(range(200)) * 2
    assert radar.files.length(USER, 1) == 600
    assert not module.open
    with pytest.raises(DeviceError, match="OUT_OF_RANGE"):
        radar.files.write_part(USER, 1, 590, bytes(20))
    assert not module.open


def state(counter: int) -> m.PresenceSingle:
    return m.PresenceSingle(counter=counter, state=1, distance_m=1.0, direction=0, signal_quality=5)


def test_messages_of_one_kind_are_taken_and_the_others_stay(running: Emulated) -> None:
    radar, line, _ = running
    text = m.DataString(text="trace")
    line.say(state(1), text, state(2))
    assert radar.messages_waiting() == 3
    assert radar.messages_waiting(m.PresenceSingle) == 2
    assert radar.read_message(m.DataString) == text
    assert list(radar.messages(2)) == [state(1), state(2)]
    assert radar.messages_waiting() == 0
    line.say(text)
    with pytest.raises(ResponseTimeout, match="within 1 s"):
        radar.read_message(m.PresenceSingle, timeout_s=1.0)
    assert radar.messages_waiting(m.DataString) == 1


def test_radar_messages_of_newer_firmware_are_delivered_in_either_framing(raw: Scripted) -> None:
    """Protocol reference 7.5."""
    radar, line = raw
    sent = [v for v in load() if v.message.startswith("RADAR_")]
    assert len(sent) == 4
    radar.messages_waiting()
    for vector in sent:
        assert vector.payload is not None
        line.say(vector.wire, framed(vector.payload))
    assert radar.messages_waiting(m.RadarMessage) == 8
    for vector in sent:
        for _ in range(2):
            message = radar.read_message(m.RadarMessage)
            assert message == message_of(vector)
            assert message.counter == 1000
    assert radar.frames_discarded == 0


def test_radar_messages_are_named_where_frames_are_waited_for(raw: Scripted) -> None:
    radar, line = raw
    (vector,) = (v for v in load() if v.message == "RADAR_BASEBAND_Q15")
    line.say(vector.wire)
    with pytest.raises(ResponseTimeout, match="RADAR_BASEBAND_Q15 comes, which read_message"):
        radar.read_frame()


@pytest.mark.parametrize("kind", [m.DataFloat, m.BasebandIq])
def test_frames_are_no_messages(running: Emulated, kind: type[m.Response]) -> None:
    radar, line, _ = running
    for ask in (radar.read_message, radar.messages_waiting):
        with pytest.raises(LocalProtocolError, match=r"comes as frames: read_frame\(\)"):
            ask(kind)
    assert line.now_ns < 1e9


def test_restarts_are_among_the_messages(running: Emulated) -> None:
    radar, line, _ = running
    booting, ready = m.System(code=0x10), m.System(code=0x11)
    line.say(booting, state(1), ready)
    assert radar.messages_waiting(m.System) == 2
    assert [radar.read_message(m.System) for _ in range(2)] == [booting, ready]
    assert list(radar.messages(1)) == [state(1)]


def test_frames_that_wait_are_counted_without_waiting(raw: Scripted) -> None:
    radar, line = raw
    assert radar.frames_waiting() == 0
    line.say(frame(1), frame(2))
    assert radar.frames_waiting() == 2
    radar.read_frame()
    assert radar.frames_waiting() == 1
    assert line.now_ns < 1e9


def test_mode_is_asked_for(driver_on: DriverOn) -> None:
    replies = [m.ReplyByte(values=b"\x13"), m.ReplyByte(values=b"\x77")]
    radar, _ = driver_on(lambda command: [replies.pop(0)])
    assert radar.mode() is SensorMode.XTID_SM_STOP
    with pytest.raises(RemoteProtocolError, match="mode 77"):
        radar.mode()


def test_mode_that_is_set_by_hand_is_left_at_the_end(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    with radar:
        radar.set_mode(SensorMode.XTID_SM_MANUAL)
        line.received.clear()
    assert line.received[-1] == m.SetMode(mode=SensorMode.XTID_SM_STOP)


# --- the API ------------------------------------------------------------------------------------


def test_the_package_has_the_names_of_a_first_program() -> None:
    for name in xethru_protocol.__all__:
        assert getattr(xethru_protocol, name).__name__ == name
        assert name in dir(xethru_protocol)
    assert {"X4M300", "AsyncX4M300", "RawConfig", "Frame", "XeThruError"} <= set(
        xethru_protocol.__all__
    )
    with pytest.raises(AttributeError, match="X4M400"):
        getattr(xethru_protocol, "X4M400")  # noqa: B009 - it does not exist


def test_importing_the_package_imports_nothing_of_it() -> None:
    program = (
        "import sys; import xethru_protocol; "
        "print([name for name in sys.modules if name == 'numpy' or 'xethru_protocol.' in name])"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("downconversion", [False, True])
def test_ranges_of_a_frame_are_those_of_its_bins(downconversion: bool) -> None:
    """Protocol reference 9.4: 0.2 ... 9.4 m, offset 0.18; RF ends one bin behind the last."""
    start_m, end_m, n_bins = (0.18, 9.439260, 181) if downconversion else (0.19929, 9.400679, 1431)
    geometry = FrameGeometry.from_read_back(
        area_m=(start_m, end_m), n_bins=n_bins, downconversion=downconversion
    )
    one = Frame(counter=1, samples=np.zeros(n_bins, np.float32), geometry=geometry, arrival_ns=0)
    assert one.ranges_m.shape == (n_bins,)
    assert one.ranges_m[0] == start_m
    step_m = 1.5e8 / 23.328e9 * (8 if downconversion else 1)
    assert np.diff(one.ranges_m) == pytest.approx(step_m, rel=1e-5)
    last_m = end_m if downconversion else end_m - step_m
    assert one.ranges_m[-1] == pytest.approx(last_m, abs=1e-6)


def public_methods(owner: object) -> dict[str, Callable[..., Any]]:
    cls = owner if isinstance(owner, type) else type(owner)
    names = [name for name in dir(cls) if not name.startswith("_")]
    return {name: getattr(owner, name) for name in names if inspect.isroutine(getattr(cls, name))}


def test_both_drivers_have_the_same_methods() -> None:
    blocking, awaited = public_methods(X4M300), public_methods(AsyncX4M300)
    assert blocking.keys() == awaited.keys()
    for name, method in blocking.items():
        one, other = inspect.signature(method), inspect.signature(awaited[name])
        assert list(one.parameters) == list(other.parameters), name


@pytest.mark.parametrize("driver", [X4M300, AsyncX4M300])
def test_methods_are_documented_as_they_are_called(
    driver: type[X4M300] | type[AsyncX4M300],
) -> None:
    radar: Any = driver(ScriptedTransport(PlainModule()))  # type: ignore[arg-type] # it only has a name
    parts = [part for part in vars(radar).values() if isinstance(part, Part) and part is not radar]
    assert len(parts) == 8
    for method in (each for part in parts for each in public_methods(part).values()):
        signature = inspect.signature(method)
        assert "link" not in signature.parameters, method
        assert "Generator" not in str(signature), method
        assert inspect.iscoroutinefunction(method) is (driver is AsyncX4M300), method
    assert str(inspect.signature(radar.profile.set_zone)) == (
        "(start_m: float, end_m: float) -> tuple[float, float]"
    )
    assert (radar.profile.set_zone.__doc__ or "").startswith("Choose the detection zone")
    for method in public_methods(driver).values():
        assert "link" not in inspect.signature(method).parameters, method
    assert str(inspect.signature(driver.start)) == "(self, fps: float) -> float"
    assert (inspect.getdoc(driver.start) or "").startswith("Start frames")
