"""What a host asks of a module in raw radar mode, and what a module tells about itself."""

from dataclasses import dataclass

from xethru_protocol import x4
from xethru_protocol.codes import X4Setting
from xethru_protocol.errors import LocalProtocolError
from xethru_protocol.lattice import Lattice
from xethru_protocol.messages import X4Value


@dataclass(frozen=True, slots=True, kw_only=True)
class RawConfig:
    """Settings of raw radar mode; the defaults are the vendor's working point.

    ``frame_area_m`` and ``offset_m`` are module metres. ``dac_step`` 0 ... 3 means steps of
    1, 2, 4, 8 levels; ``prf_div`` divides the 243 MHz clock (16: the one regulators allow).
    Numbers the chip would cut to other ones raise `LocalProtocolError`. Protocol reference 4.9,
    9.3.
    """

    frame_area_m: tuple[float, float] = (0.2, 9.4)
    offset_m: float = x4.DEFAULT_OFFSET_M
    downconversion: bool = False
    iterations: int = 16
    pulses_per_step: int = 300
    dac_min: int = 949
    dac_max: int = 1100
    dac_step: int = 0
    prf_div: int = x4.DEFAULT_PRF_DIV
    tx_power: int = 2
    tx_center_frequency: int = 3

    def __post_init__(self) -> None:
        """Check what the module does not: it keeps the low bits of any number."""
        for name, value, smallest, largest in (
            ("iterations", self.iterations, 1, 255),
            ("pulses_per_step", self.pulses_per_step, 1, 65535),
            ("dac_step", self.dac_step, 0, 3),
            ("prf_div", self.prf_div, 4, 255),
        ):
            if not smallest <= value <= largest:
                raise LocalProtocolError(f"{name} must be {smallest} ... {largest}, not {value}")

    def settings(self) -> tuple[tuple[X4Setting, X4Value], ...]:
        """X4 settings in the order in which the vendor's recipe sends them, and two more."""
        return (
            (X4Setting.DACMIN, self.dac_min),
            (X4Setting.DACMAX, self.dac_max),
            (X4Setting.DACSTEP, self.dac_step),
            (X4Setting.ITERATIONS, self.iterations),
            (X4Setting.PULSESPERSTEP, self.pulses_per_step),
            (X4Setting.PRFDIV, self.prf_div),
            (X4Setting.TXCENTERFREQUENCY, self.tx_center_frequency),
            (X4Setting.TXPOWER, self.tx_power),
            (X4Setting.DOWNCONVERSION, int(self.downconversion)),
            (X4Setting.FRAMEAREAOFFSET, self.offset_m),
            (X4Setting.FRAMEAREA, self.frame_area_m),
        )

    def check_area(self) -> None:
        """Raise `LocalProtocolError` if a module would make no bin of the frame area."""
        area = x4.frame_area(*self.frame_area_m, self.offset_m, self.downconversion)
        if area.n_bins <= 0:
            start_m, end_m = self.frame_area_m
            nearest_m = self.offset_m - x4.COARSE_STEP_M + area.bin_length_m
            longest_m = area.requested_end_m - area.requested_start_m
            cut = (
                f", of which the module keeps {longest_m:.4f} m,"
                if end_m - start_m > longest_m
                else ""
            )
            raise LocalProtocolError(
                f"frame area {start_m:g} ... {end_m:g} m{cut} has no bins; what is kept must be at "
                f"least {area.bin_length_m:.4f} m long and end behind {nearest_m:.4f} m"
            )

    @property
    def fps_max(self) -> float:
        """Highest frame rate [Hz] these settings allow, with the recommended 5 % reserve."""
        return x4.fps_max(
            iterations=self.iterations,
            pulses_per_step=self.pulses_per_step,
            dac_min=self.dac_min,
            dac_max=self.dac_max,
            dac_step=self.dac_step,
            prf_div=self.prf_div,
        )

    @property
    def lattice(self) -> Lattice | None:
        """Samples these settings can give; None where that is not known."""
        try:
            return Lattice.of(
                iterations=self.iterations,
                pulses_per_step=self.pulses_per_step,
                dac_min=self.dac_min,
                dac_max=self.dac_max,
                dac_step=self.dac_step,
                downconversion=self.downconversion,
                tx_center_frequency=self.tx_center_frequency,
            )
        except LocalProtocolError:
            return None


@dataclass(frozen=True, slots=True, kw_only=True)
class ModuleInfo:
    """What a module tells about itself; None where it refuses to. Protocol reference 4.10."""

    item_number: str | None
    order_code: str | None
    firmware_id: str | None
    version: str | None
    build: str | None
    application_id_list: str | None
    serial_number: str | None
    version_list: str | None
    system_core_id: str | None
    bootloader: str | None
    mode: str | None
