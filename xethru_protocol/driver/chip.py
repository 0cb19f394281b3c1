"""The radar chip of a module: its settings as attributes, and its registers.

::

    radar.x4.iterations = 8                      # X4M300
    print(radar.x4.frame_area_m)
    await radar.x4.iterations.set(8)             # AsyncX4M300
    print(await radar.x4.frame_area_m.get())
    chip_id = radar.registers.read("spi", 3)

A setting is one row of `X4` or `Postprocessing`.
"""

import operator
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, Generic, Literal, Self, TypeVar, overload

from xethru_protocol.driver import raw_mode
from xethru_protocol.driver.link import (
    SLOW_TIMEOUT_S,
    Awaited,
    Blocking,
    KindT,
    Link,
    Part,
    RawConfig,
    Steps,
    sends,
)
from xethru_protocol.validation import shown
from xethru_protocol.wire import messages as m
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import FramePostprocessing, X4Setting
from xethru_protocol.wire.errors import DeviceError, LocalProtocolError, RemoteProtocolError

V = TypeVar("V")
RegisterSpace = Literal["spi", "pif", "xif"]

REGISTER_SPACES: Final[dict[RegisterSpace, X4Setting]] = {
    "spi": X4Setting.SPIREGISTER,
    "pif": X4Setting.PIFREGISTER,
    "xif": X4Setting.XIFREGISTER,
}
# A longer burst fails, and no radar frame comes until the module is reset (Protocol reference 4.9).
_LONGEST_READ = 6143
_LONGEST_WRITE = 6142
_MOVES_BINS: Final = frozenset(
    {X4Setting.FRAMEAREA, X4Setting.FRAMEAREAOFFSET, X4Setting.DOWNCONVERSION}
)


class Setting(Generic[V]):
    """A value in the module: an attribute of a part, with an asyncio driver an `AsyncSetting`.

    ``of_answer`` makes the value of the module's answer.
    """

    name: str

    def __init__(self, of_answer: Callable[[Any], V], doc: str) -> None:
        self.of_answer = of_answer
        self.__doc__ = doc

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, part: None, owner: type) -> Self: ...
    @overload
    def __get__(self, part: Part[Blocking], owner: type) -> V: ...
    @overload
    def __get__(self, part: Part[Awaited], owner: type) -> "AsyncSetting[V]": ...
    def __get__(self, part: Part[Any] | None, owner: type) -> "Self | V | AsyncSetting[V]":
        if part is None:
            return self
        if part._driver._is_awaited:
            return AsyncSetting(part, self)
        value: V = part._driver._call(self.read)
        return value

    def __set__(self, part: Part[Blocking], value: V) -> None:
        if part._driver._is_awaited:
            raise AttributeError(f"this driver sets {self.name} by: await ... .{self.name}.set()")
        part._driver._call(self.write, value)

    def read(self, link: Link) -> Steps[V]:
        raise NotImplementedError

    def write(self, link: Link, value: V) -> Steps[None]:
        raise NotImplementedError


class AsyncSetting(Generic[V]):
    """A value in the module, read and set by coroutines."""

    __slots__ = ("_driver", "_setting")

    def __init__(self, part: Part[Awaited], setting: Setting[V]) -> None:
        self._driver = part._driver
        self._setting = setting

    async def get(self) -> V:
        value: V = await self._driver._call(self._setting.read)
        return value

    async def set(self, value: V) -> None:
        await self._driver._call(self._setting.write, value)


class X4Row(Setting[V]):
    """A setting of X4DRIVER SET and GET, within the limits of `x4.LIMITS` if it has any there."""

    def __init__(self, setting: X4Setting, of_answer: Callable[[Any], V], doc: str) -> None:
        limits = x4.LIMITS.get(setting)
        super().__init__(of_answer, f"{doc} {limits[0]} ... {limits[1]}." if limits else doc)
        self.setting = setting

    def read(self, link: Link) -> Steps[V]:
        return self.of_answer((yield from link.x4_get(self.setting)))

    def write(self, link: Link, value: V) -> Steps[None]:
        if self.setting is X4Setting.FRAMEBINCOUNT:
            raise LocalProtocolError(f"{self.name} follows from frame_area_m; set that")
        wanted = self._checked(value)
        if self.setting is X4Setting.FPS:
            moves = bool(x4.timer_rate(wanted))
            yield from (raw_mode.start(link, wanted) if moves else raw_mode.stop(link))
            return
        fps = None
        if isinstance(link.plan, raw_mode.RawPlan):  # refused before anything is sent
            fps, config = link.plan.fps, self._changed(link.plan.config, wanted)
            if fps is not None:
                raw_mode.check_start(link, config, fps)
        if fps is None:
            yield from self._change(link, wanted)
            return
        # else it is not known which settings the next frame has; a reconnect is to start them again
        yield from link.request(m.X4DriverSet(setting=X4Setting.FPS, value=0.0))
        try:
            yield from self._change(link, wanted)
        except (DeviceError, RemoteProtocolError):
            yield from raw_mode.run_at(link, fps)
            raise
        yield from raw_mode.run_at(link, fps)

    def _change(self, link: Link, wanted: Any) -> Steps[None]:  # noqa: ANN401 - as the wire has it
        yield from link.request(m.X4DriverSet(setting=self.setting, value=wanted))
        plan, geometry = link.plan, link.frames.geometry
        if isinstance(plan, raw_mode.RawPlan):
            config = self._changed(plan.config, wanted)
            link.plan = replace(plan, config=config)
            link.frames.lattice = config.lattice
        if self.setting in _MOVES_BINS and geometry is not None:
            baseband = geometry.downconversion
            if self.setting is X4Setting.DOWNCONVERSION:
                baseband = bool(wanted)
            link.frames.geometry = yield from raw_mode.read_geometry(link, baseband)

    def _changed(self, config: RawConfig, wanted: Any) -> RawConfig:  # noqa: ANN401 - likewise
        changed: dict[str, Any] = {self.name: self.of_answer(wanted)}
        return replace(config, **changed)

    def _checked(self, value: Any) -> Any:  # noqa: ANN401 - a user may give anything
        """Return what is sent for ``value``; `LocalProtocolError` if it cannot be."""
        try:
            if self.setting is X4Setting.FRAMEAREA:
                start_m, end_m = value
                value = float(start_m), float(end_m)
            elif self.setting in x4.LIMITS:
                value = operator.index(value)
            else:
                value = float(value)
        except (TypeError, ValueError, OverflowError):
            raise LocalProtocolError(f"{self.name} cannot be {value!r}: {self.__doc__}") from None
        x4.check_setting(self.setting, self.name, value)
        return value


class PostprocessingRow(Setting[int]):
    """A setting of frame post-processing."""

    def __init__(self, setting: FramePostprocessing, doc: str) -> None:
        super().__init__(int, doc)
        self.setting = setting

    def read(self, link: Link) -> Steps[int]:
        return self.of_answer((yield from _postprocessing(link, self.setting)))

    def write(self, link: Link, value: int) -> Steps[None]:
        yield from link.request(m.FramePostprocessingSet(setting=self.setting, value=value))


def _postprocessing(link: Link, setting: FramePostprocessing) -> Steps[float]:
    value: float = (yield from link.numbers(m.FramePostprocessingGet(setting=setting), 1))[0]
    return value


def _flag(answer: m.X4Value) -> bool:
    return answer == 1  # with any other value the firmware goes on as without


def _pair(answer: tuple[float, float]) -> tuple[float, float]:
    return answer


def _forget_raw_mode(link: Link) -> None:
    """Take note that the chip lost its settings."""
    if isinstance(link.plan, raw_mode.RawPlan):
        link.plan = None
    link.frames.geometry = None
    link.frames.lattice = None


class X4(Part[KindT]):
    """The radar chip: each setting is an attribute.

    With an `X4M300`, ``radar.x4.iterations = 8`` sets one, ``radar.x4.iterations`` asks the module;
    with an `AsyncX4M300`, ``await radar.x4.iterations.set(8)`` and ``.get()`` do. A value outside
    the limits raises `LocalProtocolError`, a refusal of the module `DeviceError`. Frames that come
    are stopped for the change and started again. After a reconnect the driver sets all of them
    again if `configure_raw` or `start` was called before. Protocol reference 4.9, 9.3 to 9.7.
    """

    __slots__ = ()

    fps = X4Row(
        X4Setting.FPS,
        float,
        "Frames per second [Hz]; 0 stops. The timer takes whole numbers up to 65535. Read below "
        "35, it is the rate at which the chip really runs.",
    )
    frame_area_m = X4Row(
        X4Setting.FRAMEAREA,
        _pair,
        "Start and end of the frame, a tuple [module metres]; the end not before the start. Read, "
        "it is as the module quantised it: RF ends one bin behind the last, baseband at the last.",
    )
    offset_m = X4Row(
        X4Setting.FRAMEAREAOFFSET,
        float,
        "Range of the antenna in the chip's own count (vendor: frame area offset) [m]. The module "
        "has it from its calibration; another value moves every range.",
    )
    downconversion = X4Row(
        X4Setting.DOWNCONVERSION,
        _flag,
        "Whether frames are complex baseband of 51.4 mm bins, not RF of 6.43 mm bins.",
    )
    iterations = X4Row(
        X4Setting.ITERATIONS,
        int,
        "How often the sweep of the sampler's threshold is repeated in a frame; a multiple of 4 "
        "is best. More: less noise, a lower highest frame rate.",
    )
    pulses_per_step = X4Row(
        X4Setting.PULSESPERSTEP,
        int,
        "Pulses per step of the threshold. More: less noise, a lower highest frame rate.",
    )
    dac_min = X4Row(X4Setting.DACMIN, int, "Lowest threshold of the sweep, in DAC levels.")
    dac_max = X4Row(X4Setting.DACMAX, int, "Highest threshold of the sweep, in DAC levels.")
    dac_step = X4Row(
        X4Setting.DACSTEP, int, "Step of the sweep: 0, 1, 2, 3 are 1, 2, 4, 8 DAC levels."
    )
    tx_power = X4Row(X4Setting.TXPOWER, int, "Transmitter power, a `TxPower`: off, low ... high.")
    tx_center_frequency = X4Row(
        X4Setting.TXCENTERFREQUENCY,
        int,
        "Band, a `TxCenterFrequency`: 3 is 7.29 GHz, 4 is 8.748 GHz.",
    )
    prf_div = X4Row(
        X4Setting.PRFDIV,
        int,
        "Divider of the 243 MHz clock that makes the pulse repetition frequency; 16, 15.1875 MHz, "
        "is the one that regulators allow.",
    )
    frame_bin_count = X4Row(
        X4Setting.FRAMEBINCOUNT,
        int,
        "Bins of a frame, complex ones in baseband; cannot be set.",
    )

    @sends
    def init(link: Link) -> Steps[None]:
        """Restart the chip with its default settings; frames stop, and count from 1 again."""
        yield from link.request(m.X4DriverInit(), SLOW_TIMEOUT_S)
        _forget_raw_mode(link)

    @sends
    def enable(link: Link, on: bool = True) -> Steps[None]:
        """Switch the chip on or off; after off, `init` brings it back. It cannot be read."""
        yield from link.request(m.X4DriverSet(setting=X4Setting.ENABLE, value=int(on)))
        if not on:
            _forget_raw_mode(link)

    @sends
    def settings(link: Link) -> Steps[dict[X4Setting, m.X4Value | None]]:
        """Read every setting that has a getter; None where the module refuses."""
        values: dict[X4Setting, m.X4Value | None] = {}
        for setting in X4Setting:
            if setting not in m.REGISTERS | {X4Setting.ENABLE}:  # which have no getter
                try:
                    values[setting] = yield from link.x4_get(setting)
                except DeviceError:
                    values[setting] = None
        return values


class Postprocessing(Part[KindT]):
    """What the module does to frames before it sends them; newer sensor firmware only.

    Others answer `DeviceError` 1. The meaning of the values is not documented beyond their names.
    Protocol reference 16.
    """

    __slots__ = ()

    normalisation = PostprocessingRow(
        FramePostprocessing.NORMALISATION, "Whether samples are normalised, a byte."
    )
    decimation_factor = PostprocessingRow(
        FramePostprocessing.DECIMATION_FACTOR, "Decimation of the frames in time."
    )
    number_format = PostprocessingRow(
        FramePostprocessing.NUMBER_FORMAT, "Format of the samples, a byte."
    )
    legacy_output = PostprocessingRow(
        FramePostprocessing.LEGACY_OUTPUT, "Whether frames come as DATA FLOAT, a byte."
    )

    @sends
    def set_phase_noise_correction(link: Link, on: bool, distance_m: float) -> Steps[None]:
        """Switch the correction of phase noise by the echo at a distance [m] on or off."""
        setting = FramePostprocessing.PHASE_NOISE_CORRECTION
        yield from link.request(
            m.FramePostprocessingSet(setting=setting, value=(int(on), float(distance_m)))
        )

    @sends
    def phase_noise_correction_distance(link: Link) -> Steps[float]:
        """Ask for the distance [m]; whether the correction is on cannot be asked."""
        return _postprocessing(link, FramePostprocessing.PHASE_NOISE_CORRECTION)


class Registers(Part[KindT]):
    """Registers of the radar chip. Protocol reference 4.9.

    The firmware does not notice what is written here: read back, settings, geometry and
    normalisation stay as they were, and a reconnect does not restore it.
    """

    __slots__ = ()

    @sends
    def read(link: Link, space: RegisterSpace, address: int) -> Steps[int]:
        """Read one register, 0 ... 255, of the space ``"spi"``, ``"pif"`` or ``"xif"``."""
        command = m.X4DriverGet(setting=_space(space), address=address)
        (value,) = yield from link.numbers(command, 1)
        return int(value)

    @sends
    def write(link: Link, space: RegisterSpace, address: int, value: int) -> Steps[None]:
        """Write one register, 0 ... 255."""
        yield from link.request(m.X4DriverSet(setting=_space(space), value=(address, value)))

    @sends
    def read_burst(link: Link, address: int, length: int) -> Steps[bytes]:
        """Read 1 ... 6143 bytes, all from the one SPI register, such as the frame FIFO's."""
        if not 1 <= length <= _LONGEST_READ:
            raise LocalProtocolError(f"a burst reads 1 ... {_LONGEST_READ} bytes, not {length}")
        command = m.X4DriverRead(address=address, length=length)
        return (yield from link.request(command)).values

    @sends
    def write_burst(link: Link, address: int, data: bytes) -> Steps[None]:
        """Write 1 ... 6142 bytes, all into the one SPI register."""
        if not 1 <= len(data) <= _LONGEST_WRITE:
            raise LocalProtocolError(
                f"a burst writes 1 ... {_LONGEST_WRITE} bytes, not {len(data)}"
            )
        command = m.X4DriverWrite(address=address, values=bytes(data))
        yield from link.request(command)

    @sends
    def read_i2c(link: Link, length: int) -> Steps[bytes]:
        """Read bytes from the module's I2C device; newer sensor firmware (16)."""
        return (yield from link.request(m.X4DriverReadI2c(length=length))).values

    @sends
    def write_i2c(link: Link, address: int, data: bytes) -> Steps[None]:
        """Write bytes to the I2C register ``address``; newer sensor firmware (16)."""
        command = m.X4DriverWriteI2c(address=address, values=bytes(data))
        yield from link.request(command)


def _space(name: RegisterSpace) -> X4Setting:
    if name not in REGISTER_SPACES:
        spaces = ", ".join(REGISTER_SPACES)
        raise LocalProtocolError(f"registers lie in {spaces}, not in {shown(name)}")
    return REGISTER_SPACES[name]
