"""The sub-commands ``faults`` and ``ctl``: what can go wrong on demand, and doing it live."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emulator.faults.kind import Kind

__all__ = ["COMMANDS", "add_commands", "add_proxy", "run"]

COMMANDS = ("faults", "ctl")
TIMEOUT_S = 10.0
_INTERRUPTED = 130
"""Exit code after SIGINT, as of a shell."""

_PROXY_HELP = (
    "A pseudo-terminal that leads to a real module: the same ready line as serve, the same faults. "
    "While no fault is armed no byte is changed. Ends with exit 1 when the module's port vanishes."
)
_CTL_HELP = """\
Controls a running emulator: SOCKET is the "control" of its ready line, or one of its ports.

  state                          what every radar does
  fault add KIND [KEY=VALUE...]  arm a fault; keys as in a scenario file, or parameters of the kind
  fault list                     armed faults, and how often each was injected
  fault clear [ID]               disarm one, or all
  unplug [SECONDS] | plug        take the port away, give it back
  reset                          restart the module, as by its watchdog
  pause | resume | rate R | seek SECONDS | loop on|off | filter [KIND...]   of a playback

Prints the answer as one JSON line. Exit 1 when the emulator refuses. For example:

  xethru-emulator ctl SOCKET fault add bad_checksum count=3
  xethru-emulator ctl SOCKET fault add missing_frames every=50 count=0 frames=2
"""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the sub-commands to a parser."""
    faults = commands.add_parser(
        "faults",
        help="list the kinds of faults",
        description="Lists the kinds of faults with their parameters; of one KIND all about it, "
        "with an example for a scenario file, which `serve --faults FILE` takes.",
    )
    faults.add_argument("kind", nargs="?", metavar="KIND", help="only this one")
    faults.add_argument("--json", action="store_true", help="as JSON")

    ctl = commands.add_parser(
        "ctl",
        help="control a running emulator",
        description=_CTL_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    ctl.add_argument("socket", type=Path, metavar="SOCKET|PORT", help="control socket, or a port")
    ctl.add_argument("words", nargs="+", metavar="VERB", help="what to do, see above")
    ctl.add_argument("--radar", metavar="NAME", help="which radar; all if left out")
    ctl.set_defaults(usage_error=ctl.error)


def add_proxy(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
) -> argparse.ArgumentParser:
    """Add the sub-command ``proxy``, and return its parser."""
    proxy = commands.add_parser(
        "proxy", help="put faults on the line of a real module", description=_PROXY_HELP
    )
    proxy.add_argument("--port", type=Path, required=True, metavar="P", help="port of the module")
    proxy.add_argument(
        "--baud", type=int, default=115_200, metavar="B", help="of a UART (default 115200)"
    )
    proxy.add_argument(
        "--faults", metavar="FILE", help="fault scenario: a .toml file, or a shipped one by name"
    )
    proxy.add_argument(
        "--truth", type=Path, metavar="FILE", help="gets a JSON line for every injected fault"
    )
    proxy.add_argument(
        "--wire",
        type=Path,
        metavar="FILE",
        help="new .xtwire file: all that passes the module's port",
    )
    return proxy


def run(arguments: argparse.Namespace) -> int:
    """Run one of them; return the exit code."""
    try:
        return _list(arguments) if arguments.command == "faults" else _control(arguments)
    except KeyboardInterrupt:
        return _INTERRUPTED
    except BrokenPipeError:  # whoever read our output has enough
        _forget_output()
        return 0
    except OSError as error:
        _forget_output()
        return _failed(f"stdout: cannot write: {error.strerror}")


# --- faults -------------------------------------------------------------------------------------


def _list(arguments: argparse.Namespace) -> int:
    from emulator.faults.catalogue import KINDS, described

    kinds = list(KINDS.values())
    if arguments.kind is not None:
        kinds = [kind for kind in kinds if kind.name == arguments.kind]
        if not kinds:
            remedy = "`xethru-emulator faults` lists them"
            return _failed(f"no kind of fault is called {arguments.kind!r}; {remedy}", exit_code=2)
    if arguments.json:
        _print(json.dumps([described(kind) for kind in kinds], indent=2))
        return 0
    for kind in kinds:
        _print(_text(kind, full=arguments.kind is not None))
    return 0


def _text(kind: Kind, *, full: bool) -> str:
    from emulator.faults.catalogue import described

    said = described(kind)
    parameters = ", ".join(
        name if parameter["default"] is None else f"{name}={parameter['default']}"
        for name, parameter in said["parameters"].items()
    )
    if not full:
        defaults = f"  [{parameters}]" if parameters else ""
        return f"{kind.layer.value:11} {kind.name:24} {kind.summary}{defaults}"
    lines = [f"{kind.name} ({kind.layer.value} layer)", kind.summary, ""]
    lines += [f"acts on:            {kind.target.value}", f"the driver counts:  {kind.counted}"]
    lines += [f"hidden:             {kind.hidden}"] if kind.hidden else []
    for name, parameter in said["parameters"].items():
        limits = ", ".join(
            f"{key.replace('_', ' ')} {value}"
            for key, value in parameter.items()
            if key not in ("default", "meaning")
        )
        default = "" if parameter["default"] is None else f" = {parameter['default']}"
        lines.append(f"  {name}{default}: {parameter['meaning']} ({limits})")
    return "\n".join([*lines, "", said["example"]])


# --- ctl ----------------------------------------------------------------------------------------


def _control(arguments: argparse.Namespace) -> int:
    try:
        request = request_of(arguments.words)
    except ValueError as error:
        arguments.usage_error(str(error))
    if arguments.radar is not None:
        request["radar"] = arguments.radar
    path = _socket_of(arguments.socket)
    try:
        answer = _ask(path, request)
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        return _failed(f"{path}: no emulator answers: {reason}")
    try:
        said = json.loads(answer)
        refused = None if said["ok"] else str(said["error"])
    except (ValueError, KeyError, TypeError):
        return _failed(f"{path}: what answers there is no emulator")
    if refused is not None:
        return _failed(refused)
    _print(answer.decode().rstrip("\n"))
    return 0


def request_of(words: Sequence[str]) -> dict[str, Any]:  # noqa: PLR0911 - one return per form
    """Return what words of a command line ask for; ValueError if they ask for nothing known.

    >>> request_of(["fault", "add", "stall", "seconds=2", "count=3"])["fault"]
    {'kind': 'stall', 'count': 3, 'parameters': {'seconds': 2}}
    >>> request_of(["seek", "1.5"])
    {'verb': 'seek', 'seconds': 1.5}
    """
    match list(words):
        case ["state" | "plug" | "reset" | "pause" | "resume" | "unplug" as verb]:
            return {"verb": verb}
        case ["unplug", seconds]:
            return {"verb": "unplug", "seconds": _number(seconds)}
        case ["fault", "list"]:
            return {"verb": "fault list"}
        case ["fault", "clear"]:
            return {"verb": "fault clear"}
        case ["fault", "clear", number]:
            return {"verb": "fault clear", "id": _value(number)}
        case ["fault", "add", kind, *keys]:
            return {"verb": "fault add", "fault": _fault(kind, keys)}
        case ["rate", rate]:
            return {"verb": "rate", "value": _number(rate)}
        case ["seek", seconds]:
            return {"verb": "seek", "seconds": _number(seconds)}
        case ["loop", "on" | "off" as loop]:
            return {"verb": "loop", "value": loop == "on"}
        case ["filter", *names]:
            return {"verb": "filter", "kinds": names or None}
    raise ValueError(f"{' '.join(words)}: nothing known; see --help")


def _fault(kind: str, keys: Sequence[str]) -> dict[str, Any]:
    from emulator.faults.plan import FaultSpec

    fault: dict[str, Any] = {"kind": kind}
    parameters: dict[str, Any] = {}
    for key in keys:
        name, equals, value = key.partition("=")
        if not equals:
            raise ValueError(f"{key}: must be KEY=VALUE")
        (fault if name in FaultSpec.model_fields else parameters)[name] = _value(value)
    return {**fault, "parameters": parameters}


def _value(text: str) -> Any:  # noqa: ANN401 - whatever the text stands for
    try:
        return json.loads(text)
    except ValueError:
        return text


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{text} is not a number") from None


def _socket_of(path: Path) -> Path:
    """Return the control socket of the emulator that has a port; a socket is itself."""
    from xethru_protocol.ports import run_directory

    with contextlib.suppress(OSError):  # a path that cannot be, too long for one; connecting tells
        if path.is_socket():
            return path
    for entry in sorted(run_directory().glob("*.json")):
        try:
            word = json.loads(entry.read_text())
            ports = [Path(device["path"]) for device in word["devices"]]
            control = word["control"]
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            continue  # not an emulator's word, or one that is just being written
        if path.absolute() in ports and isinstance(control, str):
            return Path(control)
    return path


def _ask(path: Path, request: dict[str, Any]) -> bytes:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(TIMEOUT_S)
        connection.connect(str(path))
        connection.sendall(json.dumps(request).encode() + b"\n")
        answer = b""
        while not answer.endswith(b"\n"):
            data = connection.recv(65_536)
            if not data:
                raise ConnectionResetError("it hung up")
            answer += data
    return answer


def _print(text: str) -> None:
    if sys.stdout is not None:
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()  # what fails shall fail here, not when the interpreter ends


def _forget_output() -> None:
    """Keep the interpreter from trying to write again what could not be written."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _failed(text: str, *, exit_code: int = 1) -> int:
    if sys.stderr is not None:
        sys.stderr.write(f"xethru-emulator: {text}\n")
    return exit_code
