"""``xethru list``, ``ping``, ``info``, ``reset``, ``flash`` and ``stream``."""

import time
from argparse import Namespace
from dataclasses import asdict
from typing import Any

import numpy as np

from xethru_protocol.cli.arguments import raw_config
from xethru_protocol.cli.output import (
    Progress,
    bytes_text,
    counted,
    frame_timeout_s,
    let_send,
    module_at,
    print_json,
    print_line,
    print_text,
    print_warnings,
    rewriting,
    set_up,
    warn,
)
from xethru_protocol.driver.firmware import UNFINISHED, FirmwareImage
from xethru_protocol.driver.frames import Frame
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.operating_system import STDOUT
from xethru_protocol.transport import find_ports
from xethru_protocol.wire.codes import PongCode
from xethru_protocol.wire.errors import XeThruError
from xethru_protocol.wire.messages import X4Value

_STATE = {
    PongCode.XTS_SPRP_READY: "ready",
    PongCode.XTS_SPRP_NOTREADY: "not ready",
    PongCode.XTS_SPRP_SAFEMODE: "safe mode",
}


def list_modules(arguments: Namespace) -> int:
    ports = find_ports()
    if arguments.json:
        print_json({"ports": [asdict(port) for port in ports]})
    elif not ports:
        print_line("no module found: none on USB, no emulator running")
    else:
        width = max(len(port.path) for port in ports)
        for port in ports:
            serial = f", serial {port.serial}" if port.serial else ""
            print_line(f"{port.path:<{width}}  {port.description}{serial}")
    return 0


def ping(arguments: Namespace) -> int:
    port = arguments.port
    with module_at(port, arguments.baudrate) as module:
        began_ns = time.monotonic_ns()
        state = _STATE[module.ping()]
        round_trip_ms = (time.monotonic_ns() - began_ns) * 1e-6
    if arguments.json:
        print_json({"port": port, "state": state, "round_trip_ms": round_trip_ms})
    else:
        print_line(f"{port}: {state} ({round_trip_ms:.1f} ms)")
    return 0


def info(arguments: Namespace) -> int:
    port = arguments.port
    with module_at(port, arguments.baudrate) as module:
        state = _STATE[module.ping()]
        about = {"port": port, "state": state, **asdict(module.info())}
        chip = {setting.name: value for setting, value in module.x4.settings().items()}
    if arguments.json:
        print_json({**about, "x4": chip})
        return 0
    for name, value in about.items():
        print_line(f"{name.replace('_', ' '):<20} {'-' if value is None else value}")
    for setting, number in chip.items():
        print_line(f"X4 {setting:<17} {setting_text(number)}")
    return 0


def setting_text(value: X4Value | None) -> str:
    """Write a setting for people; its lengths [m] and rates [Hz] to four decimals."""
    if isinstance(value, tuple):
        return " ... ".join(map(setting_text, value))
    if isinstance(value, float):
        return np.format_float_positional(round(value, 4) + 0.0, trim="-")
    return "-" if value is None else str(value)


def reset(arguments: Namespace) -> int:
    port = arguments.port
    with module_at(port, arguments.baudrate) as module:
        module.reset()
    if arguments.json:
        print_json({"port": port, "reset": True})
    else:
        print_line(f"{port}: restarting; a USB port vanishes for some seconds")
    return 0


def flash(arguments: Namespace) -> int:
    """Write an image; only with ``--yes`` is anything sent."""
    port = arguments.port
    image = FirmwareImage.load(arguments.image)
    size = f"{counted(image.pages, 'page')}, {bytes_text(len(image.data))}"
    if not arguments.yes:
        arguments.refuse(
            f"this replaces the firmware of the module at {port} with {arguments.image} ({size}, "
            f"checksum {image.checksum:08X}); nothing was sent. Add --yes if that is what you want"
        )
    progress = Progress("xethru flash")

    def note(done: int, total: int) -> None:
        progress.show(f"{done} of {total} pages")

    with module_at(port, arguments.baudrate) as module:
        try:
            module.firmware.write(image, note)
        except BaseException as error:
            if progress.state and not isinstance(error, XeThruError):
                progress.finish()
                warn(f"xethru flash: stopped after {progress.state}; {UNFINISHED}")
            raise
        finally:
            progress.finish()
        about = module.info()
    written = {"pages": image.pages, "bytes": len(image.data), "checksum": f"{image.checksum:08X}"}
    if arguments.json:
        now = {"firmware_id": about.firmware_id, "version": about.version}
        print_json({"port": module.port, **written, **now})
    else:
        name = " ".join(filter(None, (about.firmware_id, about.version))) or "no name"
        print_line(
            f"{module.port}: wrote and verified {size}, checksum {image.checksum:08X}; "
            f"the module reports {name}"
        )
    return 0


_REFRESH_NS = 200_000_000


def stream(arguments: Namespace) -> int:
    """Print frames until ``--count``, a signal, or the reader's end; the module is stopped then."""
    config = raw_config(arguments)
    with module_at(arguments.port, arguments.baudrate) as radar:
        set_up(radar, config)
        rate = let_send(radar, config, arguments.fps)
        print_warnings(radar)
        as_json = arguments.json or arguments.samples or not STDOUT.is_terminal
        live = None if as_json else _Live(radar)
        try:
            for frame in radar.frames(arguments.count, timeout_s=frame_timeout_s(rate)):
                if live is None:
                    print_json(_as_json(frame, arguments.samples))
                else:
                    live.show(frame)
        finally:
            if live is not None:
                live.finish()
    return 0


def _as_json(frame: Frame, with_samples: bool) -> dict[str, Any]:
    shown: dict[str, Any] = {
        "counter": frame.counter,
        "t_ns": frame.arrival_ns,
        "bins": frame.geometry.n_bins,
        "range_start_m": frame.geometry.range_start_m,
        "bin_length_m": frame.geometry.bin_length_m,
    }
    if with_samples and frame.geometry.downconversion:
        shown |= {"i": frame.samples.real.tolist(), "q": frame.samples.imag.tolist()}
    elif with_samples:
        shown["samples"] = frame.samples.tolist()
    return shown


class _Live:
    def __init__(self, radar: X4M300) -> None:
        self._radar = radar
        self._shown_ns = 0
        self._frames = 0
        self._newest: Frame | None = None
        self._began_ns = 0  # arrival of the first

    def show(self, frame: Frame) -> None:
        now_ns = time.monotonic_ns()
        self._began_ns = self._began_ns or now_ns
        self._frames += 1
        self._newest = frame
        if now_ns - self._shown_ns >= _REFRESH_NS:
            self._shown_ns = now_ns
            self._write(frame, now_ns)

    def finish(self) -> None:
        if self._newest is not None:
            self._write(self._newest, time.monotonic_ns())
        warn("")

    def _write(self, frame: Frame, now_ns: int) -> None:
        geometry = frame.geometry
        strongest = int(np.argmax(np.abs(frame.samples)))
        span_s = (now_ns - self._began_ns) * 1e-9
        rate = f"{(self._frames - 1) / span_s:.1f}" if self._frames > 1 else "-"
        line = (
            f"{counted(self._frames, 'frame')}, {rate}/s, {geometry.n_bins} bins, "
            f"strongest at {frame.ranges_m[strongest]:.3f} m, "
            f"{self._radar.frames_lost} lost"
        )
        print_text(rewriting(line, STDOUT.stream))
