"""What a host asks of a module in raw radar mode, and what a module tells about itself."""

from dataclasses import dataclass

from xethru_protocol import x4
from xethru_protocol.codes import X4Setting
from xethru_protocol.messages import X4Value


@dataclass(frozen=True, slots=True, kw_only=True)
class RawConfig:
    """Settings of raw radar mode; the defaults are the vendor's working point.

    ``frame_area_m`` and ``offset_m`` are module metres. Protocol reference 4.9, 9.3.
    """

    frame_area_m: tuple[float, float] = (0.2, 9.4)
    offset_m: float = x4.DEFAULT_OFFSET_M
    downconversion: bool = False
    iterations: int = 16
    pulses_per_step: int = 300
    dac_min: int = 949
    dac_max: int = 1100
    tx_power: int = 2
    tx_center_frequency: int = 3

    def settings(self) -> tuple[tuple[X4Setting, X4Value], ...]:
        """X4 settings in the order in which the vendor's recipe sends them."""
        return (
            (X4Setting.DACMIN, self.dac_min),
            (X4Setting.DACMAX, self.dac_max),
            (X4Setting.ITERATIONS, self.iterations),
            (X4Setting.PULSESPERSTEP, self.pulses_per_step),
            (X4Setting.TXCENTERFREQUENCY, self.tx_center_frequency),
            (X4Setting.TXPOWER, self.tx_power),
            (X4Setting.DOWNCONVERSION, int(self.downconversion)),
            (X4Setting.FRAMEAREAOFFSET, self.offset_m),
            (X4Setting.FRAMEAREA, self.frame_area_m),
        )

    @property
    def fps_max(self) -> float:
        """Highest frame rate [Hz] these settings allow, with the recommended 5 % reserve."""
        return x4.fps_max(
            iterations=self.iterations,
            pulses_per_step=self.pulses_per_step,
            dac_min=self.dac_min,
            dac_max=self.dac_max,
        )


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
