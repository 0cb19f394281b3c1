"""The paper's raw capture: what tests of echoes set a chip to, and vary."""

from emulator.chip.chip import CaptureSettings

__all__ = ["PAPER"]

PAPER = CaptureSettings(
    first_sample_m=0.19929,
    n_samples=1431,
    iterations=16,
    pulses_per_step=300,
    dac_min=949,
    dac_max=1100,
    dac_step=0,
    tx_power=2,
    tx_center_frequency=3,
)
