"""The unix socket of live control: one JSON object per line in, one per line out.

| verb | keys | does |
|---|---|---|
| state | | what every radar does: port, faults, playback, and where its stream begins |
| fault add | fault, radar | arms a fault, written as in a scenario file |
| fault list | radar | armed faults, and how often each was injected |
| fault clear | id, radar | disarms one, or all |
| unplug | radar, seconds | takes the port away, for good or for a while |
| plug | radar | gives it back; the module starts anew |
| reset | radar | restarts the module, as by its watchdog |
| pause, resume | radar | of a playback |
| rate | value, radar | multiple of real time; 0: as fast as the port takes it |
| seek | seconds, radar | time of the recording |
| loop | value, radar | true or false |
| people | seconds, radar | what is true of the people of a scene, at a scene time or now |

``stream`` in the state is the newest stream of radar frames: its number from 0 (INIT, a reset and
a power cut end a stream) and the scene time of its frame with counter 1, without the radar's start
skew; null before the first, and where the module is real or a recording.

``people`` answers ``t_s``, the scene time, and for each person `emulator.echo.people.PersonTruth`
with null for NaN: ``breaths_per_min`` now, ``mean_breaths_per_min`` of the last minute,
``distance_m`` and ``towards_m`` by radar. Now is the wall clock's, which at ``--pace asap`` is not
the time of the frames.

Without ``radar`` all are meant. The answer is ``{"ok":true,...}``, or
``{"ok":false,"error":"..."}`` with the remedy.
"""

from __future__ import annotations

import json
import math
import selectors
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.chip.chip import NS_PER_S
from emulator.echo.people import PersonTruth
from emulator.faults.faulty_device import FaultyDevice
from emulator.faults.plan import FaultPlanError, parse_fault
from emulator.playback import PlayStream
from emulator.ports.sockets import SocketClient, SocketService
from emulator.scene.people import SleepDepth
from emulator.x4m300 import Device

MOST_CLIENTS = 16
LONGEST_LINE = 65_536
"""Bytes; a client that sends more without a line end is hung up on."""
MOST_UNREAD = 1 << 20
"""Bytes of answers that wait for a client; then it is hung up on."""
_READ = 65_536
_LONGEST_S = 86_400.0 * 365
_LATEST_TRUTH_S = 86_400.0 * 7
_KEYS = ("verb", "radar", "fault", "id", "seconds", "value")


People = Callable[[NDArray[np.int64]], Sequence[PersonTruth]]
"""Returns the truth about the people of a scene at scene times, shape (n,), ns."""


class _RefusedError(Exception):
    """What was asked cannot be done; the message is the answer."""


class Control:
    """Carries out what is asked."""

    def __init__(
        self,
        devices: Mapping[str, FaultyDevice],
        players: Mapping[str, PlayStream] | None = None,
        people: People | None = None,
        zero_ns: int = 0,
    ) -> None:
        self._devices = devices
        self._players = {} if players is None else players
        self._people = people
        self._zero_ns = zero_ns

    def answer(self, line: bytes, now_ns: int) -> bytes:
        """Return the answer to a line, with its line end; never raises."""
        try:
            answer = {"ok": True, **self._carry_out(line, now_ns)}
        except (_RefusedError, FaultPlanError, ValueError) as error:
            answer = {"ok": False, "error": " ".join(str(error).split())}
        return json.dumps(answer, separators=(",", ":")).encode() + b"\n"

    def _carry_out(self, line: bytes, now_ns: int) -> dict[str, Any]:
        try:
            asked = json.loads(line)
        except (ValueError, RecursionError):
            asked = None
        if not isinstance(asked, dict):
            raise _RefusedError("a line must be one JSON object")
        for key in asked:
            if key not in _KEYS:
                raise _RefusedError(f"{key}: unknown key; allowed are {', '.join(_KEYS)}")
        verb = VERBS.get(str(asked.get("verb")))
        if verb is None:
            raise _RefusedError(f"verb: must be one of {', '.join(VERBS)}")
        return verb(self, asked, now_ns) or {}

    def _named(self, asked: Mapping[str, Any]) -> list[FaultyDevice]:
        name = asked.get("radar")
        if name is None:
            return list(self._devices.values())
        if not isinstance(name, str) or name not in self._devices:
            raise _RefusedError(f"radar: must be one of {', '.join(self._devices)}")
        return [self._devices[name]]

    def _played(self, asked: Mapping[str, Any]) -> list[PlayStream]:
        names = [device.name for device in self._named(asked)]
        players = [self._players[name] for name in names if name in self._players]
        if not players:
            raise _RefusedError("nothing is played here; this verb is for `xethru-emulator play`")
        return players

    # --- verbs ----------------------------------------------------------------------------------

    def _state(self, asked: Mapping[str, Any], now_ns: int) -> dict[str, Any]:
        radars = {}
        for device in self._named(asked):
            player = self._players.get(device.name)
            radars[device.name] = {
                "present": device.port_present(now_ns),
                "faults": _faults(device),
                "injected": device.injected,
                "playback": None if player is None else player.state(now_ns),
                "stream": _stream(device),
            }
        return {"t_ns": now_ns, "radars": radars}

    def _truth(self, asked: Mapping[str, Any], now_ns: int) -> dict[str, Any]:
        if self._people is None:
            raise _RefusedError("there is no scene here; this verb is for `xethru-emulator serve`")
        t_ns = now_ns - self._zero_ns
        if asked.get("seconds") is not None:
            t_ns = round(_number(asked, "seconds", _LATEST_TRUTH_S) * NS_PER_S)
        people = self._people(np.array([t_ns], dtype=np.int64))
        wanted = [device.name for device in self._named(asked)]
        columns = [(number, name) for number, name in enumerate(self._devices) if name in wanted]
        return {"t_s": t_ns / NS_PER_S, "people": [_person(one, columns) for one in people]}

    def _fault_add(self, asked: Mapping[str, Any], now_ns: int) -> dict[str, Any]:
        spec = parse_fault(asked.get("fault"))
        chosen = [
            device for device in self._named(asked) if not spec.radar or device.name in spec.radar
        ]
        if not chosen:
            raise _RefusedError(f"fault.radar: must be some of {', '.join(self._devices)}")
        return {"ids": {device.name: device.add(spec) for device in chosen}}

    def _fault_list(self, asked: Mapping[str, Any], now_ns: int) -> dict[str, Any]:
        return {"faults": {device.name: _faults(device) for device in self._named(asked)}}

    def _fault_clear(self, asked: Mapping[str, Any], now_ns: int) -> dict[str, Any]:
        number = asked.get("id")
        if number is not None and (not isinstance(number, int) or isinstance(number, bool)):
            raise _RefusedError("id: must be the number that `fault add` gave")
        cleared = sum(device.clear(number) for device in self._named(asked))
        if number is not None and not cleared:
            raise _RefusedError(f"id: no armed fault has number {number}")
        return {"cleared": cleared}

    def _unplug(self, asked: Mapping[str, Any], now_ns: int) -> None:
        seconds = None if asked.get("seconds") is None else _number(asked, "seconds", _LONGEST_S)
        for device in self._named(asked):
            device.unplug(now_ns, None if seconds is None else round(seconds * NS_PER_S))

    def _plug(self, asked: Mapping[str, Any], now_ns: int) -> None:
        for device in self._named(asked):
            device.plug(now_ns)

    def _reset(self, asked: Mapping[str, Any], now_ns: int) -> None:
        for device in self._named(asked):
            device.restart(now_ns)

    def _pause(self, asked: Mapping[str, Any], now_ns: int) -> None:
        for player in self._played(asked):
            player.pause(now_ns)

    def _resume(self, asked: Mapping[str, Any], now_ns: int) -> None:
        for player in self._played(asked):
            player.resume(now_ns)

    def _rate(self, asked: Mapping[str, Any], now_ns: int) -> None:
        rate = _number(asked, "value", 1e9)
        for player in self._played(asked):
            player.set_rate(rate, now_ns)

    def _seek(self, asked: Mapping[str, Any], now_ns: int) -> None:
        position_ns = round(_number(asked, "seconds", _LONGEST_S) * NS_PER_S)
        for player in self._played(asked):
            player.seek(position_ns, now_ns)

    def _loop(self, asked: Mapping[str, Any], now_ns: int) -> None:
        value = asked.get("value")
        if not isinstance(value, bool):
            raise _RefusedError("value: must be true or false")
        for player in self._played(asked):
            player.set_loop(value, now_ns)


VERBS: dict[str, Callable[[Control, Mapping[str, Any], int], dict[str, Any] | None]] = {
    "state": Control._state,
    "fault add": Control._fault_add,
    "fault list": Control._fault_list,
    "fault clear": Control._fault_clear,
    "unplug": Control._unplug,
    "plug": Control._plug,
    "reset": Control._reset,
    "pause": Control._pause,
    "resume": Control._resume,
    "rate": Control._rate,
    "seek": Control._seek,
    "loop": Control._loop,
    "people": Control._truth,
}


def _stream(device: FaultyDevice) -> dict[str, int] | None:
    begin = device.inner.stream_begin if isinstance(device.inner, Device) else None
    return None if begin is None else asdict(begin)


def _person(truth: PersonTruth, radars: Sequence[tuple[int, str]]) -> dict[str, Any]:
    """Return the first row of a truth as JSON; ``radars`` are columns and their names."""
    row = {
        key: None if math.isnan(value) else value
        for key, value in (
            ("breaths_per_min", float(truth.breaths_per_min[0])),
            ("mean_breaths_per_min", float(truth.mean_breaths_per_min[0])),
            ("chest_m", float(truth.chest_m[0])),
        )
    }
    return {
        "name": truth.name,
        "present": bool(truth.present[0]),
        "moves": bool(truth.moves[0]),
        "position_m": truth.position_m[0].tolist(),
        **row,
        "sleep_stage": SleepDepth(int(truth.sleep_stage[0])).name.lower(),
        "distance_m": {name: float(truth.distance_m[0, column]) for column, name in radars},
        "towards_m": {name: float(truth.towards_m[0, column]) for column, name in radars},
    }


def _faults(device: FaultyDevice) -> list[dict[str, Any]]:
    return [
        {
            "id": armed.number,
            "kind": armed.kind.name,
            "parameters": armed.parameters.model_dump(),
            "injected": armed.injected,
            "count": armed.spec.count,
        }
        for armed in device.armed
    ]


def _number(asked: Mapping[str, Any], key: str, most: float) -> float:
    value = asked.get(key)
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not 0 <= value <= most  # so not-a-number and infinity, too
    ):
        raise _RefusedError(f"{key}: must be a number from 0 to {most:g}")
    return float(value)


class ControlSocket(SocketService):
    """The socket on which `Control` answers lines; only its owner can connect."""

    def __init__(self, path: Path, control: Control) -> None:
        super().__init__(path, "control", most_clients=MOST_CLIENTS, private=True)
        self._control = control

    def _ready(self, client: SocketClient, events: int, now_ns: int) -> None:
        if events & selectors.EVENT_READ:
            self._read(client, now_ns)
        if client.unsent and not self._send(client):
            return
        if client.reads or client.unsent:
            self._watch(client)
        else:
            self._drop(client)

    def _read(self, client: SocketClient, now_ns: int) -> None:
        try:
            data = client.connection.recv(_READ)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        client.reads = bool(data)
        *lines, client.begun = (client.begun + data).split(b"\n")
        for line in lines:
            if line.strip():
                client.unsent += self._control.answer(line, now_ns)
        if len(client.begun) > LONGEST_LINE or len(client.unsent) > MOST_UNREAD:
            client.reads, client.unsent = False, b""
