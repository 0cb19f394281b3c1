"""A recording of a standing X4 module, and the scene whose emulated frames are like it.

The anchors are read off one recording of the vendor's (X4, 54 baseband bins, 17 frames/s, 2017):
of its ten farthest bins, 1.4e-4 per component with an autocorrelation of 0.98 at one frame, so that
2.1e-5 are new with every frame; of its strongest reflector, a phase that wanders by 0.032 rad, of
which 0.0056 rad are new with every frame.

What one recording cannot tell:

* The working point. 17 frames/s and 54 bins fit the vendor's example settings, 16 iterations x 300
  pulses per step, which are assumed here; the samples lie on no lattice that would show it.
* What is the module and what is the room. In its quietest 7 s the floor of all bins from the 18th
  on is 6e-6, three times below the anchor, and the phase wanders by 0.0014 rad; later somebody
  moves close by. The anchors are what the whole recording shows: upper bounds on the module.
* Whether the phase is common to all echoes, as a jitter's is: the strongest echo's fluctuation is
  nearly as large in amplitude as in phase, which says that a part of it is other echoes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from emulator.device import radar_device
from emulator.downconversion import CHANNELS, LEAD_SAMPLES, TAP_COUNT
from emulator.echo import SPEED_OF_LIGHT_MPS, echo_source
from emulator.identity import Identity
from emulator.loopback import LoopbackTransport
from emulator.pace import Pace
from emulator.pulse import CARRIER_CYCLES_PER_SAMPLE, SIGMA_S
from emulator.scene import Scene
from emulator.scene_tables import ClutterSpec, JitterSpec, NoiseSpec, RadarSpec, TargetSpec
from slam.app.errors import AppError
from slam.app.experiments.slow_time import FAR_BINS, SEGMENT, SlowTime
from xethru_protocol.driver import X4M300, RawConfig
from xethru_protocol.messages import BasebandIq
from xethru_protocol.recordings import RecordingError, read_recording
from xethru_protocol.x4 import MODULE_SPEED_MPS, SAMPLING_RATE_HZ, real_frame_rate

NOISE = NoiseSpec(rf_sigma=6.4e-5, iterations=16, pulses_per_step=300)
"""1.5e-5 per baseband component (1 / 4.18 of RF), at an assumed working point.

The flat part of the far bins' spectrum. The rest of the 2.1e-5 is the fast end of the clutter: with
2.1e-5 of white noise beside the clutter, 2.4e-5 would be new with every frame.
"""
CLUTTER = ClutterSpec(sigma=2.25e-4, correlation_s=4.8)
"""1.58e-4 per baseband component (0.70 of RF). In 30 s, the mean taken off, 1.4e-4 of it show."""
JITTER = JitterSpec(white_rad=0.0056, slow_rad=0.032, slow_correlation_s=4.0)

_SERIAL = "201709131504"


def read_slow_time(path: Path, radar: str | None = None) -> SlowTime:
    """Return the baseband frames of a recording; of several radars, the named one.

    Raises
    ------
    AppError
        There is no such recording, or it holds too few baseband frames of one shape; one line.
    """
    try:
        records = read_recording(path, radar=radar)
        found = [(one, t_ns) for one, t_ns in records if isinstance(one, BasebandIq)]
    except RecordingError as error:
        raise AppError(str(error)) from None
    n_bins = {message.num_bins for message, _ in found}
    times_ns = [t_ns for _, t_ns in found if t_ns is not None]
    if len(found) < 2 * SEGMENT or len(times_ns) < len(found):
        raise AppError(
            f"{path}: {len(times_ns)} baseband frames with times; at least {2 * SEGMENT} are needed"
        )
    if len(n_bins) != 1 or n_bins.pop() <= 2 * FAR_BINS:
        raise AppError(f"{path}: all frames must have the same number of bins, > {2 * FAR_BINS}")
    stamps_ns = np.array(times_ns, dtype=np.int64)
    half = len(stamps_ns) // 2
    # stamps are of arrival, some late: the median over long intervals does not mind
    period_s = float(np.median(stamps_ns[half:] - stamps_ns[:-half])) / half / 1e9
    if not 0 < period_s < 1:
        raise AppError(f"{path}: its time stamps do not tell a frame rate of 1 Hz or more")
    first = found[0][0]
    return SlowTime(
        iq=np.stack([one.i + 1j * one.q.astype(np.complex128) for one, _ in found]),
        rate_hz=1 / period_s,
        first_bin_m=first.range_offset_m,
        bin_length_m=first.bin_length_m,
    )


def equivalent_scene(recorded: SlowTime) -> Scene:
    """Return one reflector where the strongest bin is, as strong as that; and nothing else."""
    label_m = recorded.first_bin_m + recorded.strongest * recorded.bin_length_m
    range_m = label_m * SPEED_OF_LIGHT_MPS / MODULE_SPEED_MPS
    amplitude = float(recorded.amplitude[recorded.strongest]) / echo_gain()
    return Scene(
        name="static_reflector",
        environment="lab",
        description="One static reflector before a standing radar.",
        radars=(RadarSpec(name="radar", serial=_SERIAL, x_m=0.0, y_m=0.0, yaw_deg=0.0),),
        targets=(
            TargetSpec(
                name="reflector",
                kind="point",
                x_m=range_m,
                y_m=0.0,
                amplitude_1m=amplitude * range_m**2,
            ),
        ),
        noise=NOISE,
        clutter=CLUTTER,
        jitter=JITTER,
    )


def emulate(scene: Scene, like: SlowTime, seed: int) -> SlowTime:
    """Return as many frames of the same bins at the same rate from an emulated module in process.

    Raises
    ------
    AppError
        The chip has no frame area with these bins.
    """
    n_frames, n_bins = like.iq.shape
    last_bin_m = like.first_bin_m + (n_bins - 1) * like.bin_length_m
    margin_m = like.bin_length_m / 4  # the area is rounded outwards to whole bins
    device = radar_device(
        Identity(serial=scene.radars[0].serial), echo_source(scene, 0, seed), Pace.ASAP
    )
    transport = LoopbackTransport(device, name="in process")
    with X4M300(transport, clock=transport.clock_ns) as driver:
        geometry = driver.configure_raw(
            RawConfig(
                frame_area_m=(like.first_bin_m + margin_m, last_bin_m - margin_m),
                downconversion=True,
            )
        )
        if geometry.n_bins != n_bins:
            raise AppError(
                f"the emulated chip gives {geometry.n_bins} bins for {like.first_bin_m:.4f} ... "
                f"{last_bin_m:.4f} m, the recording has {n_bins}"
            )
        driver.start(float(round(like.rate_hz)))
        frames = [frame.samples.astype(np.complex128) for frame in driver.frames(n_frames)]
    return SlowTime(
        iq=np.stack(frames),
        rate_hz=real_frame_rate(round(like.rate_hz)),
        first_bin_m=geometry.range_start_m,
        bin_length_m=geometry.bin_length_m,
    )


def echo_gain() -> float:
    """Return the baseband amplitude of a pulse of RF amplitude 1 in the middle of a line."""
    taps = CHANNELS[3]
    at = np.arange(-LEAD_SAMPLES, TAP_COUNT - LEAD_SAMPLES)
    cycles, samples = CARRIER_CYCLES_PER_SAMPLE[3]
    pulse = np.exp(
        -0.5 * (at / (SIGMA_S * SAMPLING_RATE_HZ)) ** 2 + 2j * np.pi * cycles / samples * at
    )
    return float(abs(np.dot(taps.i_taps, pulse)) / taps.absolute_sum)
