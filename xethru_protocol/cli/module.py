"""``xethru list``, ``ping``, ``info`` and ``reset``."""

import time
from dataclasses import asdict

from xethru_protocol.cli.output import print_json, print_line
from xethru_protocol.cli.session import module_at
from xethru_protocol.codes import PongCode
from xethru_protocol.messages import X4Value
from xethru_protocol.ports import find_ports

_STATE = {
    PongCode.XTS_SPRP_READY: "ready",
    PongCode.XTS_SPRP_NOTREADY: "not ready",
    PongCode.XTS_SPRP_SAFEMODE: "safe mode",
}


def list_modules(*, as_json: bool) -> int:
    """Print the ports that may be modules."""
    ports = find_ports()
    if as_json:
        print_json({"ports": [asdict(port) for port in ports]})
    elif not ports:
        print_line("no module found: none on USB, no emulator running")
    else:
        width = max(len(port.path) for port in ports)
        for port in ports:
            serial = f", serial {port.serial}" if port.serial else ""
            print_line(f"{port.path:<{width}}  {port.description}{serial}")
    return 0


def ping(port: str, baudrate: int, *, as_json: bool) -> int:
    """Print whether a module answers, and how fast."""
    with module_at(port, baudrate) as module:
        began_ns = time.monotonic_ns()
        state = _STATE[module.ping()]
        round_trip_ms = (time.monotonic_ns() - began_ns) * 1e-6
    if as_json:
        print_json({"port": port, "state": state, "round_trip_ms": round_trip_ms})
    else:
        print_line(f"{port}: {state} ({round_trip_ms:.1f} ms)")
    return 0


def info(port: str, baudrate: int, *, as_json: bool) -> int:
    """Print what a module tells about itself and its radar chip."""
    with module_at(port, baudrate) as module:
        state = _STATE[module.ping()]
        about = {"port": port, "state": state, **asdict(module.info())}
        chip = {setting.name: value for setting, value in module.x4_settings().items()}
    if as_json:
        print_json({**about, "x4": chip})
        return 0
    for name, value in about.items():
        print_line(f"{name.replace('_', ' '):<20} {'-' if value is None else value}")
    for setting, number in chip.items():
        print_line(f"X4 {setting:<17} {_number(number)}")
    return 0


def _number(value: X4Value | None) -> str:
    if isinstance(value, tuple):
        return " ... ".join(map(_number, value))
    if isinstance(value, float):
        return f"{value:.7g}"  # as far as float32 is exact
    return "-" if value is None else str(value)


def reset(port: str, baudrate: int, *, as_json: bool) -> int:
    """Restart a module; returns when it has agreed to."""
    with module_at(port, baudrate) as module:
        module.reset()
    if as_json:
        print_json({"port": port, "reset": True})
    else:
        print_line(f"{port}: restarting; a USB port vanishes for some seconds")
    return 0
