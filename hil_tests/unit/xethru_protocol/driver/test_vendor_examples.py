"""What the vendor's Python examples do, by the driver's own methods, in virtual time.

`docs/moduleconnector.md` names the examples; numbers are those of the protocol reference.
"""

import numpy as np
import pytest

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.module.memory import Identity
from emulator.scene.scene import load_scene
from emulator.x4m300 import radar_device
from xethru_protocol import X4M300, NoiseMapControl, OutputFeature
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import FileType, PongCode, SensorMode

MAPS = (FileType.NOISEMAP_FAST, FileType.NOISEMAP_SLOW)


def line(pace: Pace) -> LoopbackTransport:
    source = echo_source(load_scene("visitor"), 0, seed=0)
    return LoopbackTransport(radar_device(Identity(serial="123456789012"), source, pace))


def test_manipulate_noisemap() -> None:
    """Protocol reference 4.6: 120 s to make a map, 20 s with a stored one; 8.3: STOP unloads."""
    transport = line(Pace.REALTIME)
    with X4M300(transport, clock=transport.clock_ns) as radar:

        def seconds_to_start() -> float:
            radar.profile.load()
            radar.profile.set_zone(1.0, 3.0)
            kept = (radar.profile.noise_map() | NoiseMapControl.NO_DEFAULT) & ~(
                NoiseMapControl.IGNORE_STORED
            )
            radar.profile.set_noise_map(kept)
            radar.profile.set_output(OutputFeature.PRESENCE_SINGLE)
            began_ns = transport.clock_ns()
            radar.profile.run()
            radar.profile.wait_until_initialized()
            return (transport.clock_ns() - began_ns) * 1e-9

        assert not any(radar.files.find(kind) for kind in MAPS)
        assert seconds_to_start() == pytest.approx(120, abs=2)
        radar.profile.store_noise_map()
        radar.read_message(m.PresenceSingle)
        radar.profile.stop()
        kept = {kind: radar.files.read(kind, 0) for kind in MAPS}
        assert all(kept.values())
        for kind, content in kept.items():
            radar.files.delete(kind, 0)
            radar.files.write(kind, 0, content)
        assert seconds_to_start() == pytest.approx(20, abs=2)


def test_printout_pulsedoppler_data() -> None:
    """Protocol reference 7.2: one message per range bin; a matrix ends with the last of them."""
    transport = line(Pace.REALTIME)
    with X4M300(transport, clock=transport.clock_ns) as radar:
        radar.profile.load()
        radar.profile.set_output(OutputFeature.PULSEDOPPLER_BYTE, 1)
        radar.profile.run()
        first = radar.read_message(m.PulseDopplerByte, timeout_s=30.0)
        while first.range_idx:
            first = radar.read_message(m.PulseDopplerByte)
        rest = [radar.read_message(m.PulseDopplerByte) for _ in range(2 * first.range_bins)]
        matrix = [one for one in (first, *rest) if one.matrix_counter == first.matrix_counter]
        assert {one.range_idx for one in matrix} == set(range(first.range_bins))
        assert np.diff([one.range_m for one in matrix]).max() == pytest.approx(0.05144, abs=1e-5)
        assert all(one.power.shape == (one.frequency_count,) for one in matrix)


def test_printout_information() -> None:
    """Protocol reference 9.4 (the area 2 ... 6 m of complex bins), 9.6 (20 is 20.044079)."""
    transport = line(Pace.ASAP)
    with X4M300(transport, clock=transport.clock_ns) as radar:
        radar.set_mode(SensorMode.XTID_SM_STOP)
        radar.set_mode(SensorMode.XTID_SM_MANUAL)
        assert radar.ping() is PongCode.XTS_SPRP_READY
        assert radar.info().serial_number == "123456789012"
        radar.x4.init()
        radar.x4.enable()
        radar.x4.iterations = 16
        radar.x4.pulses_per_step = 256
        radar.x4.dac_min = 949
        radar.x4.dac_max = 1100
        radar.x4.tx_power = 2
        radar.x4.downconversion = True
        radar.x4.offset_m = 0.18
        radar.x4.frame_area_m = (2, 6)
        radar.x4.tx_center_frequency = 3
        radar.x4.prf_div = 16
        radar.x4.fps = 20
        assert radar.x4.fps == np.float32(20.044079)
        start_m, end_m = radar.x4.frame_area_m
        # base 0.18 + 2 x 96 bins; then whole bins of 51.44 mm, outward
        base_m, bin_m = 0.18 + 2 * 96 * 1.5e8 / 23.328e9, 8 * 1.5e8 / 23.328e9
        assert start_m == pytest.approx(base_m + np.floor((2 - base_m) / bin_m) * bin_m, abs=1e-6)
        assert end_m == pytest.approx(base_m + np.ceil((6 - base_m) / bin_m) * bin_m, abs=1e-6)
        frame = radar.read_frame()
        radar.x4.fps = 0
        assert (frame.counter, frame.samples.dtype.name) == (1, "complex64")
        assert frame.ranges_m[-1] == pytest.approx(end_m, abs=1e-6)
        assert (radar.frames_discarded, radar.statistics.off_lattice_samples) == (0, 0)
        assert radar.warnings == []
        radar.reset()
