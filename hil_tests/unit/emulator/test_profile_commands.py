"""Profile settings, noise maps and output control. Protocol reference 4.4 to 4.7, 8.2, 11, 16."""

import math

import numpy as np
import pytest

from emulator.chip import Pace
from emulator.module.settings import DeviceOptions
from emulator.x4m300 import Device, radar_device
from hil_tests.unit.emulator.doubles import IDENTITY, BareHost, RampSource
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import OutputFeature, ProfileId, SensorMode

SECOND = 1_000_000_000
STOP = m.SetMode(mode=SensorMode.XTID_SM_STOP)
LOAD = m.LoadApp(profile_id=0x014D4AB8)
LOAD_RESPIRATION_2 = m.LoadApp(profile_id=ProfileId.XTS_ID_APP_RESPIRATION_2)
LOAD_RESPIRATION_3 = m.LoadApp(profile_id=ProfileId.XTS_ID_APP_RESPIRATION_3)
IQ, AP = OutputFeature.BASEBAND_IQ, OutputFeature.BASEBAND_AMPLITUDE_PHASE
PD_FLOAT, PD_BYTE = OutputFeature.PULSEDOPPLER_FLOAT, OutputFeature.PULSEDOPPLER_BYTE


def device(options: DeviceOptions | None = None) -> Device:
    return radar_device(IDENTITY, RampSource(), Pace.ASAP, options=options)


def loaded(options: DeviceOptions | None = None) -> BareHost:
    host = BareHost(device(options))
    host.command(STOP, LOAD)
    return host


def zone(host: BareHost) -> tuple[float, ...]:
    reply = host.ask(m.GetDetectionZone())
    assert isinstance(reply, m.ReplyFloat)
    assert reply.content_id == 0x96A10A1C
    return reply.values


def f32(value: float) -> float:
    return float(np.float32(value))


# 9.4, column of baseband areas with offset 0.18: 0.18 m + k * 1.5e8 / 2.916e9, outward.
ZONES = [
    ((0.4, 9.4), (0.385761, 9.439260)),
    ((0.4, 5.0), (0.385761, 5.015391)),
    ((1.0, 1.2), (0.951605, 1.208807)),
]


@pytest.mark.parametrize(("asked", "actual"), ZONES)
def test_a_zone_is_snapped_outward(asked: tuple[float, float], actual: tuple[float, float]) -> None:
    host = loaded()
    assert host.ask(m.SetDetectionZone(start_m=asked[0], end_m=asked[1])) == m.Ack()
    assert zone(host) == pytest.approx(actual, abs=1e-6)
    read = zone(host)
    assert host.ask(m.SetDetectionZone(start_m=read[0], end_m=read[1])) == m.Ack()
    assert zone(host) == read, "what was read may be written"


# 4.4: start >= 0.40, end <= 9.40, size 0.20...9.00
BAD_ZONES = [(0.3, 5.0), (0.4, 9.5), (2.0, 2.1), (5.0, 4.0), (math.nan, 4.0), (0.4, math.inf)]


@pytest.mark.parametrize(("start_m", "end_m"), BAD_ZONES)
def test_a_bad_zone_is_refused_and_changes_nothing(start_m: float, end_m: float) -> None:
    host = loaded()
    before = zone(host)
    assert host.ask(m.SetDetectionZone(start_m=start_m, end_m=end_m)) == m.Error(code=0x21)
    assert zone(host) == before


def test_a_bad_value_is_clamped_if_the_option_says_so() -> None:
    host = loaded(DeviceOptions(bad_value="clamp"))
    assert host.ask(m.SetDetectionZone(start_m=0.0, end_m=20.0)) == m.Ack()
    assert zone(host) == pytest.approx((0.385761, 9.439260), abs=1e-6)
    assert host.ask(m.SetSensitivity(sensitivity=12)) == m.Ack()
    assert host.ask(m.GetSensitivity()) == m.ReplyInt(content_id=0x10A5112B, values=(9,))


def test_zone_limits_and_defaults() -> None:
    host = loaded()
    limits = host.ask(m.GetDetectionZoneLimits())
    step = 1.5e8 / 2.916e9
    expected = (f32(0.4), f32(9.4), f32(step))
    assert limits == m.ReplyFloat(content_id=0x96A10A1D, values=expected)
    assert host.ask(m.GetSensitivity()) == m.ReplyInt(content_id=0x10A5112B, values=(5,))
    assert host.ask(m.GetTxCenterFrequency()) == m.ReplyInt(content_id=0x71AF2A2B, values=(3,))
    assert host.ask(m.AppGetLedControl()) == led(2)
    assert host.ask(m.NoiseMapGetControl()) == m.ReplyInt(content_id=0x11, values=(7,))


def led(mode: int) -> m.ReplyByte:
    return m.ReplyByte(content_id=0x71AF2A2C, values=bytes((mode,)))


SETS: list[tuple[m.Command[m.Ack], m.Command[m.Response], m.Response]] = [
    (
        m.SetTxCenterFrequency(tx_center_frequency=4),
        m.GetTxCenterFrequency(),
        m.ReplyInt(content_id=0x71AF2A2B, values=(4,)),
    ),
    (m.AppSetLedControl(mode=1, intensity=50), m.AppGetLedControl(), led(1)),
    (m.SetLedControl(mode=0), m.AppGetLedControl(), led(0)),
    (
        m.NoiseMapSetControl(control=3),
        m.NoiseMapGetControl(),
        m.ReplyInt(content_id=0x11, values=(3,)),
    ),
    (
        m.NoiseMapSetPeriodicStore(interval_min=60),
        m.NoiseMapGetPeriodicStore(),
        m.ReplyInt(content_id=0x13, values=(60, 0)),
    ),
]


@pytest.mark.parametrize(("set_it", "get_it", "reply"), SETS, ids=lambda c: type(c).__name__)
def test_a_setting_is_read_back_and_a_factory_preset_undoes_it(
    set_it: m.Command[m.Ack], get_it: m.Command[m.Response], reply: m.Response
) -> None:
    host = loaded()
    before = host.ask(get_it)
    assert before != reply
    assert host.ask(set_it) == m.Ack()
    assert host.ask(get_it) == reply
    assert host.ask(m.FactoryPreset()) == m.Ack()
    assert host.ask(get_it) == before


@pytest.mark.parametrize(
    "command",
    [
        m.SetSensitivity(sensitivity=10),
        m.SetTxCenterFrequency(tx_center_frequency=5),
        m.AppSetLedControl(mode=3),
    ],
)
def test_values_out_of_range_are_refused(command: m.Command[m.Ack]) -> None:
    assert loaded().ask(command) == m.Error(code=0x21)


def test_gets_without_a_profile() -> None:
    """4.4: sensitivity and band ERROR 1, several others no reply at all."""
    host = BareHost(device())
    assert host.ask(STOP) == m.Ack()
    assert host.ask(m.GetSensitivity()) == m.Error(code=1)
    assert host.ask(m.GetTxCenterFrequency()) == m.Error(code=1)
    host.send(m.GetDetectionZone())
    assert host.hear() == []


def outputs(host: BareHost) -> dict[int, int]:
    replies = {feature: host.ask(m.OutputGetControl(feature=feature)) for feature in OutputFeature}
    controls = {}
    for feature, reply in replies.items():
        assert isinstance(reply, m.ReplyInt)
        assert reply.content_id == 0
        controls[int(feature)] = reply.values[0]
    return {feature: bits for feature, bits in controls.items() if bits}


# 4.7 and row 5 of 11: what is switched, one after the other, and what is on then
SWITCHES: list[tuple[list[tuple[int, int]], dict[int, int]]] = [
    ([(IQ, 1)], {IQ: 1}),
    ([(IQ, 1), (AP, 1)], {AP: 1}),
    ([(AP, 1), (IQ, 1)], {IQ: 1}),
    ([(IQ, 1), (AP, 0)], {}),
    ([(PD_FLOAT, 3), (PD_BYTE, 1)], {PD_FLOAT: 2, PD_BYTE: 1}),
    ([(PD_FLOAT, 3), (PD_BYTE, 3)], {PD_BYTE: 3}),
    ([(PD_BYTE, 2), (PD_FLOAT, 2)], {PD_FLOAT: 2}),
    ([(PD_FLOAT, 3), (PD_BYTE, 0)], {PD_FLOAT: 3}),
    ([(PD_FLOAT, 4)], {PD_FLOAT: 2}),
    ([(0x12, 1), (0x10, 2)], {0x12: 1, 0x10: 2}),
    ([(0x12, 1), (0x13, 1)], {0x13: 1}),
]


@pytest.mark.parametrize(("switched", "on"), SWITCHES)
def test_exclusion_of_outputs(switched: list[tuple[int, int]], on: dict[int, int]) -> None:
    host = loaded()
    assert outputs(host) == {0x723BFA1E: 1}, "as shipped"
    for feature, control in switched:
        assert host.ask(m.OutputSetControl(feature=feature, control=control)) == m.Ack()
    assert outputs(host) == {0x723BFA1E: 1} | on
    for feature, control in switched:
        assert host.ask(m.DebugOutputSetControl(feature=feature, control=control)) == m.Ack()
    reply = host.ask(m.DebugOutputGetControl(feature=0x723BFA1E))
    assert reply == m.ReplyInt(values=(0,)), "a table of its own"


def test_an_unknown_output_is_refused() -> None:
    host = loaded()
    assert host.ask(m.OutputSetControl(feature=0x99, control=1)) == m.Error(code=1)
    assert host.ask(m.OutputGetControl(feature=0x99)) == m.Error(code=1)


def test_a_running_profile_takes_baseband_output_only() -> None:
    command = m.OutputSetControl(feature=OutputFeature.PRESENCE_MOVINGLIST, control=1)
    host = BareHost(device())
    assert host.ask(m.OutputSetControl(feature=IQ, control=1)) == m.Ack()
    assert host.ask(command) == m.Error(code=0x21)
    host = BareHost(device(DeviceOptions(model="x4m200")))
    assert host.ask(command) == m.Ack()


def test_noise_maps_are_files() -> None:
    """4.6, 4.11: stored as slow and fast; a store takes its time; 15 and 16 delete."""
    host = loaded()
    found = m.ReplyInt(values=(0x037DD98C, 0x05F09BCA, 0x05F09BCB, 0, 0, 0))
    for sub_code in (0x15, 0x16):
        assert host.ask(m.StoreNoiseMap()) == m.Ack()
        assert host.ask(m.StoreNoiseMap()) == m.Error(code=3), "one is under way"
        assert host.ask(m.FindAllFiles()) == found
        host.command(m.LoadNoiseMap(), m.DeleteNoiseMap(sub_code=sub_code))
        assert host.ask(m.FindAllFiles()) == m.ReplyInt(values=(0x037DD98C, 0))
        host.now_ns += SECOND
    assert host.ask(m.DeleteNoiseMap()) == m.Ack(), "also if there is none"


def test_parameter_file() -> None:
    """4.4, 16."""
    host = loaded()
    assert host.ask(m.GetParameterFile(name="p.txt")) == m.Error(code=1)
    assert host.ask(m.SetParameterFile(name="p.txt", data="a=1")) == m.Ack()
    reply = host.ask(m.GetParameterFile(name="p.txt"))
    assert reply == m.ReplyString(content_id=0x32BA7623, text="a=1")
    assert host.ask(m.GetParameterFile(name="other")) == m.Error(code=1)
    assert host.ask(m.GetFileLength(file_type=0x037DD98C, identifier=0)) == m.ReplyInt(values=(3,))


def test_each_profile_has_its_own_settings() -> None:
    host = BareHost(device(DeviceOptions(model="x4m200")))
    host.command(STOP, LOAD_RESPIRATION_2, m.SetSensitivity(sensitivity=8), LOAD_RESPIRATION_3)
    assert host.ask(m.GetSensitivity()) == m.ReplyInt(content_id=0x10A5112B, values=(5,))
    assert host.ask(LOAD_RESPIRATION_2) == m.Ack()
    assert host.ask(m.GetSensitivity()) == m.ReplyInt(content_id=0x10A5112B, values=(8,))
