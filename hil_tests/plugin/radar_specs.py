"""The values of ``--radar``, as docs/testing.md lists them. Standard library only.

Radars of one emulated scene or recording are chosen by ``?radar=NAME``; at a port, ``?line=uart``
says that it is a UART although it looks like none.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Literal


class SpecError(ValueError):
    """A spec names no radar; the message is one line with what is allowed."""


class RadarKind(Enum):
    """How a radar is reached."""

    EMULATED = "emu"
    PORT = "port"
    SERIAL_NUMBER = "serial"
    NETWORK = "network"
    REPLAY = "replay"
    AUTO = "auto"
    OWN = "own"


_FIRMWARE = ("sensor", "xep")
_LINES = ("memory", "pty", "uart", "tcp")
_OPTIONS: dict[RadarKind, tuple[str, ...]] = {
    RadarKind.EMULATED: ("firmware", "fps", "has", "line", "radar", "seed"),
    RadarKind.PORT: ("fps", "has", "known_range", "line"),
    RadarKind.SERIAL_NUMBER: ("fps", "has", "known_range"),
    RadarKind.NETWORK: ("fps", "has", "known_range"),
    RadarKind.REPLAY: ("has", "radar"),
    RadarKind.AUTO: ("fps", "has"),
}
"""Of the built-in kinds; a hook reads what it likes of its own."""
DEFAULT_FPS = 17.0
_NETWORK_SCHEMES = ("tcp", "socket", "rfc2217")
_BUILT_IN_SCHEMES = (*_NETWORK_SCHEMES, "emu", "auto", "serial", "replay")


@dataclass(frozen=True, slots=True, kw_only=True)
class RadarArgument:
    """One radar to test.

    ``text`` is what the user wrote, ``target`` its scene, port, serial number, recording,
    address or, for a hook, all before the question mark, perhaps empty; ``options`` is what
    followed. Tests, reports and folders use ``name``, which is unique within a run.
    """

    text: str
    kind: RadarKind
    target: str
    options: Mapping[str, str] = field(default_factory=dict)
    name: str

    @property
    def emulated(self) -> bool:
        """Whether this program starts the radar itself; else other processes may want it, too."""
        return self.kind in {RadarKind.EMULATED, RadarKind.REPLAY}

    @property
    def shared_as(self) -> str:
        """What all specs of one radar have in common: the port's own path or the address."""
        if self.kind is RadarKind.PORT:
            return os.path.realpath(self.target)
        # an adapter is one by every scheme
        return self.target.partition("://")[2] if self.kind is RadarKind.NETWORK else self.target

    @property
    def line(self) -> str:
        """How an emulated radar is connected: memory, pty, uart or tcp."""
        return self.options.get("line", "memory")

    @property
    def firmware(self) -> Literal["sensor", "xep"]:
        return "xep" if self.options.get("firmware") == "xep" else "sensor"

    @property
    def seed(self) -> int:
        return int(self.options.get("seed", "0"))

    @property
    def fps(self) -> float:
        """Frame rate that tests should ask for [Hz]."""
        return float(self.options.get("fps", DEFAULT_FPS))

    @property
    def known_range_m(self) -> float | None:
        """Range of the reflector in front of a real module [m]; None if none is declared."""
        return float(self.options["known_range"]) if "known_range" in self.options else None

    @property
    def has(self) -> frozenset[str]:
        return frozenset(filter(None, self.options.get("has", "").split(",")))


def parse_specs(texts: Iterable[str]) -> tuple[RadarArgument, ...]:
    """Return the radars that specs name, with unique names; `SpecError` if one names no radar.

    >>> [spec.name for spec in parse_specs(["emu", "emu:lab?seed=3", "/dev/ttyACM0"])]
    ['emu', 'emu-lab', 'ttyACM0']
    """
    specs: list[RadarArgument] = []
    for text in texts:
        body, _, query = text.strip().partition("?")
        kind, target = _kind(body)
        options = _query(text, query, _OPTIONS.get(kind))
        _check(text, kind, options)
        taken = {other.name for other in specs}
        name = plain = _name(kind, target, options)
        number = 2
        while name in taken:
            # no dash: pytest joins the name and other parameters with that
            name, number = f"{plain}.{number}", number + 1
        specs.append(RadarArgument(text=text, kind=kind, target=target, options=options, name=name))
    return tuple(specs)


def _kind(body: str) -> tuple[RadarKind, str]:  # noqa: PLR0911 - one return per kind
    scheme, colon, rest = body.partition(":")
    if scheme == "emu":
        return RadarKind.EMULATED, rest
    if body == "auto":
        return RadarKind.AUTO, ""
    if body.startswith("serial="):
        number = body.removeprefix("serial=")
        if not re.fullmatch(r"[0-9]{12}", number):
            raise SpecError(f"--radar {body}: a serial number has 12 digits, as on the label")
        return RadarKind.SERIAL_NUMBER, number
    if scheme in _NETWORK_SCHEMES and rest.startswith("//"):
        host, _, port = rest.removeprefix("//").rpartition(":")
        if not host or not re.fullmatch(r"[0-9]{1,5}", port) or not 0 < int(port) < 65536:
            raise SpecError(
                f"--radar {body}: must be {scheme}://HOST:PORT with a port of 1...65535"
            )
        return RadarKind.NETWORK, body
    if scheme == "replay" and colon:
        if not rest or not os.path.exists(rest):
            raise SpecError(f"--radar {body}: there is no recording {rest}")
        return RadarKind.REPLAY, rest
    if colon and re.fullmatch(r"[a-z][a-z0-9_]*", scheme):
        if scheme not in _BUILT_IN_SCHEMES:
            return RadarKind.OWN, body
    elif "/" in body or body.startswith("~") or os.path.exists(body):
        return RadarKind.PORT, str(Path(os.path.expanduser(body)))
    raise no_radar(body)


def no_radar(body: str) -> SpecError:
    return SpecError(
        f"--radar {body}: names no radar; allowed are emu[:SCENE], a port such as /dev/ttyACM0, "
        "serial=NUMBER, auto, tcp://HOST:PORT, rfc2217://HOST:PORT, replay:RECORDING, and what a "
        "hook pytest_xethru_radar_target adds"
    )


def _query(text: str, query: str, allowed: Sequence[str] | None) -> dict[str, str]:
    options: dict[str, str] = {}
    for part in filter(None, query.split("&")):
        key, equals, value = part.partition("=")
        if not key or not equals or not value or (allowed is not None and key not in allowed):
            raise SpecError(
                f"--radar {text}: {part!r} is not an option here; allowed are "
                + ", ".join(f"{name}=..." for name in allowed or ("NAME",))
            )
        options[key] = value
    return options


def _check(text: str, kind: RadarKind, options: Mapping[str, str]) -> None:
    line = options.get("line") if kind is not RadarKind.OWN else None
    lines = _LINES if kind is RadarKind.EMULATED else ("uart",)
    if line is not None and line not in lines:
        raise SpecError(f"--radar {text}: line={line}: must be {' or '.join(lines)}")
    firmware = options.get("firmware", "sensor")
    if firmware not in _FIRMWARE or (
        firmware == "xep" and options.get("line", "memory") != "memory"
    ):
        raise SpecError(
            f"--radar {text}: firmware={firmware}: must be sensor, or xep without line="
        )
    seed = options.get("seed", "0")
    if not re.fullmatch(r"[0-9]{1,19}", seed) or int(seed) >= 2**63:
        raise SpecError(f"--radar {text}: seed={seed}: must be a whole number of 0...2**63 - 1")
    if not 0 < _number(options.get("fps", str(DEFAULT_FPS))) < 65536:
        raise SpecError(f"--radar {text}: fps={options['fps']}: must be a rate of 1...65535 Hz")
    if kind is not RadarKind.OWN and not 0.4 <= _number(options.get("known_range", "1")) <= 9.0:
        raise SpecError(
            f"--radar {text}: known_range={options['known_range']}: must be 0.4...9 metres"
        )


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _name(kind: RadarKind, target: str, options: Mapping[str, str]) -> str:
    if kind is RadarKind.EMULATED:
        parts = ["emu", Path(target).stem, options.get("radar", "")]
        line = options.get("line", "memory")
        parts.append("" if line == "memory" else line)
        parts.append("xep" if options.get("firmware") == "xep" else "")
        return "-".join(filter(None, parts))
    if kind is RadarKind.SERIAL_NUMBER:
        return target
    if kind is RadarKind.AUTO:
        return "auto"
    if kind in {RadarKind.NETWORK, RadarKind.OWN}:
        return re.sub(r"[^0-9A-Za-z.]+", "-", target).strip("-")
    last = Path(target).name or target
    return f"replay-{Path(last).stem}" if kind is RadarKind.REPLAY else last
