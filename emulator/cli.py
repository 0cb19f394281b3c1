"""Command line ``xethru-emulator``: emulated X4M300s on pseudo-terminals.

Exit 0 after a clean stop by SIGINT, SIGTERM or SIGHUP, 1 when the thing failed, 2 for wrong usage.
One JSON line on stdout says that the ports are ready; everything else goes to stderr.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import re
import socket
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emulator.chip import Pace
from xethru_protocol.cli.version import add_version
from xethru_protocol.operating_system import (
    STDERR,
    STDOUT,
    StopFlag,
    StopRequestedError,
    each_line,
    flush_streams,
    json_text,
    one_line,
)
from xethru_protocol.optional_packages import what_is_missing
from xethru_protocol.validation import Parser, number, output, recording_at, shown

if TYPE_CHECKING:
    from emulator.faults.kind import KindOfFault

TIMEOUT_S = 10.0
_INTERRUPTED = 130
"""Exit code after SIGINT, as of a shell."""
MOST_BARE = 64
LAST_SERIAL = 10**12 - MOST_BARE
"""From which so many modules count on within 12 digits."""
LAST_PORT = 65535
_BAUD_RATES = 600, 10_000_000

_SERVE_HELP = """\
Each radar of the scene becomes a stock X4M300 on a pseudo-terminal, published as a link in the
link directory. One JSON line on stdout says that all ports are ready:

  {"ready":true,"scene_time_zero_ns":N,"odometry":"PATH or null",
   "control":"PATH","devices":[{"name":"...","path":"...","serial":"...","start_skew_ns":N,
                                "tcp":PORT or null,"uart":BOOL}]}

scene_time_zero_ns is the monotonic time of scene time 0; the odometry path is a unix socket that
gives every client the wheel odometry as TUM lines, the control path one for `xethru-emulator ctl`.
start_skew_ns is when, in scene time, the module takes its first frame, counter 1; radars are not
synchronised, and a host needs it where it cannot tell from when frames arrive.
Ctrl-C, SIGTERM or SIGHUP ends it: links, sockets and a directory of its own are removed, exit 0.

pace realtime: frames at their deadlines; a host that does not keep up loses frames as on the
real module. pace asap: as fast as the host reads, nothing is lost.

--tcp: each module on a TCP port, too, for one client at a time: a second one is hung up on, and so
is one that comes while a host has the module's pseudo-terminal open. While a client is connected,
the pseudo-terminal takes and sends nothing.

--link usb: bytes pass at once.
--link uart: ten bits per byte at the speed that the host sets its terminal to; a host at another
speed than the module's (115200 after power-up, then what SETBAUDRATE set) receives and sends
garbage.

--port-on-reset vanish: a reset takes the port away for two seconds, as USB does: whoever has it
open sees it hang up, its name is gone. rename: it returns as NAME-2, NAME-3 and so on; running
emulators' ports are found with `xethru list`.
"""

_PLAY_HELP = """\
Plays a recording at the port of an emulated X4M300, every message byte-exact: a directory of
ModuleConnector, a wire capture (.xtwire) or MCAP. Same ready line as serve. A session of
several radars gets a port for each, named as in the session; they loop in step.

Playing begins anew for every host that opens the port: at once when the host starts the radar
(FPS above 0, or SETMODE RUN), else half a second after it opened the port or sent its last
command. It ends when the last host closes the port. Nothing is dropped: a host that reads slowly
makes the recording wait. Meanwhile the module answers every command; FPS, mode and geometry
settings are acknowledged and change nothing about what is played; the number of bins reads back as
recorded. Recorded answers are left out. (Where the system cannot tell
who opens a port, a host's first command counts as opening it.)
"""
_PROXY_HELP = (
    "A pseudo-terminal that leads to a real module: the same ready line as serve, the same faults. "
    "While no fault is armed no byte is changed. Ends with exit 1 when the module's port vanishes."
)
_CTL_HELP = """\
Controls a running emulator: SOCKET is the "control" of its ready line, or one of its ports.
What it asks for is done to every radar, unless --radar names one.

  state                          what every radar does
  fault add KIND [KEY=VALUE...]  arm a fault; keys as in a scenario file, or parameters of the kind
  fault list                     armed faults, and how often each was injected
  fault clear [ID]               disarm one, or all
  unplug [SECONDS] | plug        take the port away, give it back
  reset                          restart the module, as by its watchdog
  people [SECONDS]               what is true of the scene's people, now or at a scene time
  pause | resume | rate R | seek SECONDS | loop on|off   of a playback

Prints the answer as one JSON line. Exit 1 when the emulator refuses. For example:

  xethru-emulator ctl SOCKET fault add bad_checksum count=3
  xethru-emulator ctl SOCKET fault add missing_frames every=50 count=0 frames=2
"""


# --- faults -------------------------------------------------------------------------------------


def _list(arguments: argparse.Namespace) -> int:
    from emulator.faults.kinds import KINDS
    from emulator.faults.plan import described

    kinds = list(KINDS.values())
    if arguments.kind is not None:
        kinds = [kind for kind in kinds if kind.name == arguments.kind]
        if not kinds:
            remedy = "`xethru-emulator faults` lists them"
            return _failed(
                f"no kind of fault is called {shown(arguments.kind)}; {remedy}", exit_code=2
            )
    if arguments.json:
        _print(json.dumps([described(kind) for kind in kinds], indent=2))
        return 0
    for kind in kinds:
        _print(_text(kind, full=arguments.kind is not None))
    return 0


def _text(kind: KindOfFault, *, full: bool) -> str:
    from emulator.faults.plan import described

    row = described(kind)
    parameters = ", ".join(
        name if parameter["default"] is None else f"{name}={parameter['default']}"
        for name, parameter in row["parameters"].items()
    )
    if not full:
        defaults = f"  [{parameters}]" if parameters else ""
        return f"{kind.layer.value:11} {kind.name:24} {kind.summary}{defaults}"
    lines = [f"{kind.name} ({kind.layer.value} layer)", kind.summary, ""]
    lines += [f"acts on:            {kind.target.value}", f"the driver counts:  {kind.counted}"]
    lines += [f"hidden:             {kind.hidden}"] if kind.hidden else []
    for name, parameter in row["parameters"].items():
        limits = ", ".join(
            f"{key.replace('_', ' ')} {value}"
            for key, value in parameter.items()
            if key not in ("default", "meaning")
        )
        default = "" if parameter["default"] is None else f" = {parameter['default']}"
        lines.append(f"  {name}{default}: {parameter['meaning']} ({limits})")
    return "\n".join([*lines, "", row["example"]])


# --- ctl ----------------------------------------------------------------------------------------


def _control(arguments: argparse.Namespace) -> int:
    try:
        request = request_of(arguments.words)
    except ValueError as error:
        arguments.usage_error(one_line(str(error)))
    if arguments.radar is not None:
        request["radar"] = arguments.radar
    path = socket_of(arguments.socket)
    try:
        answer = ask(path, request)
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        return _failed(f"{path}: no emulator answers: {reason}")
    try:
        reply = json.loads(answer)
        refused = None if reply["ok"] else str(reply["error"])
    except (ValueError, KeyError, TypeError):
        return _failed(f"{path}: what answers there is not an emulator")
    if refused is not None:
        return _failed(refused)
    _print(json_text(reply))
    return 0


def request_of(words: Sequence[str]) -> dict[str, Any]:  # noqa: PLR0911 - one return per form
    """Return the request of a command line's words; ValueError if there is no such request.

    >>> request_of(["fault", "add", "stall", "seconds=2", "count=3"])["fault"]
    {'kind': 'stall', 'parameters': {'seconds': 2}, 'count': 3}
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
        case ["people"]:
            return {"verb": "people"}
        case ["seek" | "people" as verb, seconds]:
            return {"verb": verb, "seconds": _number(seconds)}
        case ["loop", "on" | "off" as loop]:
            return {"verb": "loop", "value": loop == "on"}
    raise ValueError(f"{' '.join(words)!r} is not a request; see xethru-emulator ctl --help")


def _fault(kind: str, keys: Sequence[str]) -> dict[str, Any]:
    from emulator.faults.plan import fault_table

    values: dict[str, Any] = {}
    for key in keys:
        name, equals, value = key.partition("=")
        if not equals:
            raise ValueError(f"{key}: must be KEY=VALUE")
        values[name] = _value(value)
    return fault_table(kind, **values)


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


def socket_of(path: Path) -> Path:
    """Return the control socket of the emulator that has a port; a socket is itself."""
    from xethru_protocol.transport import announcements, run_directory

    with contextlib.suppress(OSError):  # too long, for example: connecting reports it
        if path.is_socket():
            return path
    for entry in announcements(run_directory()):
        try:
            announced = json.loads(entry.read_text())
            ports = [Path(device["path"]) for device in announced["devices"]]
            control = announced["control"]
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            continue  # no announcement, or one that is just being written
        if any(_is_same_port(path, port) for port in ports) and isinstance(control, str):
            return Path(control)
    return path


def _is_same_port(path: Path, port: Path) -> bool:
    """Whether two paths lead to one link, or to one terminal; a port may be unplugged."""

    def places(link: Path) -> set[str]:
        # Every link on the way: the last one goes when the port is unplugged, perhaps just now.
        found = set[str]()
        while (place := os.path.join(os.path.realpath(link.parent), link.name)) not in found:
            found.add(place)
            with contextlib.suppress(OSError):
                link = link.parent / os.readlink(place)
        return found

    return not places(path).isdisjoint(places(port))


def ask(path: Path, request: dict[str, Any]) -> bytes:
    """Send a request to the control socket of a running emulator; return its answer, JSON."""
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
    STDOUT.write(f"{each_line(text)}\n")


def _failed(text: str, *, exit_code: int = 1) -> int:
    STDERR.write_soon(f"xethru-emulator: {one_line(' '.join(text.split()))}\n")
    return exit_code


# --- options


def _options(arguments: argparse.Namespace) -> int:
    from emulator.module.settings import option_texts

    texts = option_texts()
    if arguments.json:
        _print(json.dumps([one._asdict() for one in texts], indent=2))
        return 0
    for one in texts:
        _print(f"{one.name}={one.default}\n    {one.meaning}\n    Values: {one.allowed}.")
    return 0


_AT_ONCE: dict[str, Callable[[argparse.Namespace], int]] = {
    "faults": _list,
    "options": _options,
    "ctl": _control,
}


def main(argv: Sequence[str] | None = None) -> int:
    try:
        with StopFlag("same") as stop:
            arguments = _parse(argv)
            if arguments.command not in _AT_ONCE:
                return _run(arguments, stop)
        # a signal ends these at once: there is nothing to clean up
        exit_code = _AT_ONCE[arguments.command](arguments)
        failure = STDOUT.failure
        if failure is None or isinstance(failure, BrokenPipeError):  # its reader has seen enough
            return exit_code
        return _failed(f"stdout: cannot write: {failure.strerror}")
    except ModuleNotFoundError as error:
        missing = what_is_missing(error, extra="emulator")
        if missing is None:
            raise
        return _failed(missing, exit_code=2)
    except KeyboardInterrupt:
        return _INTERRUPTED
    finally:
        flush_streams(wait=False)


def _run(arguments: argparse.Namespace, stop: StopFlag) -> int:
    with stop.leaving(0):  # the imports take most of a second
        # heavy, and only now: --help and usage errors answer at once
        from emulator.scene.scene import UnknownSceneError
        from emulator.serve_play_proxy import EXPECTED, play, proxy, serve
    start = {"serve": serve, "play": play, "proxy": proxy}
    try:
        start[arguments.command](arguments, stop, _warn)
    except EXPECTED as error:
        return _failed(str(error), exit_code=2 if isinstance(error, UnknownSceneError) else 1)
    except StopRequestedError:  # while a file of its input was waited for
        pass
    return 0


def _warn(text: str) -> None:
    _failed(f"warning: {text}")


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="xethru-emulator",
        description="Emulated X4M300 radars on pseudo-terminals. To begin: `xethru-emulator "
        "serve --bare` prints the path of a port; `xethru info --port PATH` asks what is there.",
    )
    add_version(parser)
    commands = parser.add_subparsers(dest="command", required=True)

    serve = commands.add_parser(
        "serve",
        help="emulate the radars of a scene",
        description=_SERVE_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    serve.add_argument(
        "scene",
        nargs="?",
        metavar="SCENE",
        help="name of a scene or a random room (pillars:3), or a .toml file",
    )
    serve.add_argument("--bare", action="store_true", help="stock modules in an empty room")
    serve.add_argument(
        "--count",
        type=_whole(1, MOST_BARE),
        metavar="N",
        help="with --bare: how many modules (default 1)",
    )
    serve.add_argument(
        "--seed",
        type=_whole(0, 2**63 - 1, "2**63 - 1"),
        default=0,
        metavar="S",
        help="of noise and odometry (default 0)",
    )
    serve.add_argument(
        "--pace",
        type=Pace,
        choices=list(Pace),
        default=Pace.REALTIME,
        metavar="{realtime,asap}",
        help="which clock drives the modules (default realtime)",
    )
    _add_product(serve)
    _add_link_dir(serve)
    _add_faults(serve)
    serve.add_argument(
        "--tcp",
        type=_whole(0, LAST_PORT),
        metavar="BASEPORT",
        help="a TCP port for each module, from this one on; 0: any that are free",
    )
    serve.add_argument(
        "--tcp-host",
        type=_host,
        metavar="HOST",
        help="address to listen at (default 127.0.0.1, which only this machine reaches)",
    )
    serve.add_argument(
        "--link",
        choices=["usb", "uart"],
        default="usb",
        help="what the modules are connected by (default usb)",
    )
    serve.add_argument(
        "--state-dir",
        type=Path,
        metavar="DIR",
        help="keep each module's settings, files and noise maps here (default: forget them)",
    )
    serve.add_argument(
        "--port-on-reset",
        choices=["stay", "vanish", "rename"],
        default="stay",
        help="what a reset does to the port (default stay)",
    )

    play = commands.add_parser(
        "play",
        help="play a recording at the port of an emulated module",
        description=_PLAY_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    play.add_argument(
        "recording",
        type=lambda text: Path(recording_at(text)),
        metavar="RECORDING",
        help="recording to play",
    )
    play.add_argument(
        "--rate",
        type=_rate,
        default=1.0,
        metavar="R",
        help="multiple of real time; 0: as fast as the port takes it (default 1)",
    )
    play.add_argument("--loop", action="store_true", help="begin again at the end")
    _add_link_dir(play)

    proxy = commands.add_parser(
        "proxy", help="put faults on the line of a real module", description=_PROXY_HELP
    )
    proxy.add_argument(
        "--port",
        required=True,
        metavar="P",
        help="port of the module: /dev/ttyACM0, tcp://HOST:PORT, rfc2217://HOST:PORT",
    )
    proxy.add_argument(
        "--baud",
        type=_whole(*_BAUD_RATES),
        default=115_200,
        metavar="B",
        help="of a UART (default 115200)",
    )
    _add_faults(proxy)
    proxy.add_argument(
        "--wire",
        type=output(".xtwire", what="a wire capture"),
        metavar="FILE",
        help="new .xtwire file: all that passes the module's port",
    )
    _add_link_dir(proxy)

    faults = commands.add_parser(
        "faults",
        help="list the kinds of faults",
        description="Lists the kinds of faults with their parameters; of one KIND all about it, "
        "with an example for a scenario file, which `serve --faults FILE` takes.",
    )
    faults.add_argument("kind", nargs="?", metavar="KIND", help="only this one")
    faults.add_argument("--json", action="store_true", help="as JSON")

    options = commands.add_parser(
        "options",
        help="list the options of `serve --option`",
        description="Lists the options that `serve --option NAME=VALUE` takes, with their "
        "defaults; numbers in parentheses are sections of the protocol reference.",
    )
    options.add_argument("--json", action="store_true", help="as JSON")

    ctl = commands.add_parser(
        "ctl",
        help="control a running emulator",
        description=_CTL_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    ctl.add_argument("socket", type=Path, metavar="SOCKET|PORT", help="control socket, or a port")
    ctl.add_argument("words", nargs="+", metavar="VERB", help="what to do, see above")
    ctl.add_argument("--radar", metavar="NAME", help="only this radar, as named in the ready line")
    ctl.set_defaults(usage_error=ctl.error)

    arguments = parser.parse_args(argv)
    if arguments.command == "serve":
        if arguments.bare == (arguments.scene is not None):
            serve.error("give either a SCENE or --bare")
        if arguments.count is not None and not arguments.bare:
            serve.error("--count needs --bare")
        if arguments.tcp_host is not None and arguments.tcp is None:
            serve.error("--tcp-host needs --tcp")
        arguments.tcp_host = arguments.tcp_host or "127.0.0.1"
        arguments.count = arguments.count or 1
    return arguments


def _add_product(serve: argparse.ArgumentParser) -> None:
    serve.add_argument(
        "--model",
        choices=["x4m300", "x4m200"],
        help="product: with the presence profile, or with the respiration profile (default: what "
        "the scene says of each module, else x4m300)",
    )
    serve.add_argument(
        "--serial",
        type=_serial,
        metavar="NUMBER",
        help="serial number of the first module, 12 digits; the others count on (default: those of "
        "the scene; with --bare those kept in --state-dir, else new ones)",
    )
    serve.add_argument(
        "--option",
        action="append",
        type=_option,
        default=[],
        metavar="NAME=VALUE",
        help="how the modules behave where the reference allows more than one answer; may be "
        "repeated; `xethru-emulator options` lists them",
    )
    serve.add_argument(
        "--firmware",
        type=_firmware,
        metavar="NAME",
        help="sensor (default) or xep, the newest of each, or a version: sensor-1.5.10, xep-3.3.0",
    )


def _add_link_dir(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--link-dir",
        type=Path,
        metavar="D",
        help="where the links appear (default: a fresh directory, named in the ready line)",
    )


def _add_faults(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--faults", metavar="FILE", help="fault scenario: a .toml file, or a shipped one by name"
    )
    parser.add_argument(
        "--truth",
        type=output(".json", ".jsonl", ".txt", ".log", what="lines of JSON"),
        metavar="FILE",
        help="gets a JSON line for every injected fault",
    )


def _whole(least: int, most: int, limit: str | None = None) -> Callable[[str], float]:
    """Return the type of an option that takes a whole number within limits."""
    allowed = f"a whole number in {least}...{limit or most}"
    return number(int, lambda value: least <= value <= most, allowed)


_rate = number(float, lambda value: 0 <= value < math.inf, "a finite number >= 0")


def _firmware(text: str) -> str:
    from xethru_protocol.wire.versions import firmware_named

    try:
        firmware_named(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def _option(text: str) -> tuple[str, object]:
    from emulator.module.settings import option_of

    try:
        return option_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _serial(text: str) -> int:
    if not re.fullmatch(r"[0-9]{12}", text) or int(text) > LAST_SERIAL:
        raise argparse.ArgumentTypeError(f"{shown(text)} must be 12 digits, {LAST_SERIAL} at most")
    return int(text)


def _host(text: str) -> str:
    if not text.strip():
        raise argparse.ArgumentTypeError("a name or address is missing")
    return text


if __name__ == "__main__":
    sys.exit(main())
