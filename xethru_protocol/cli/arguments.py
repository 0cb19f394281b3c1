"""Arguments of ``xethru``. Importing this loads nothing that a command needs."""

import argparse
import math
from collections.abc import Callable, Sequence

_FROM = ("auto", "host", "module")


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line; exits with 2 on wrong usage.

    The result's ``run(arguments)`` carries the command out and returns the exit code.
    """
    parser = argparse.ArgumentParser(
        prog="xethru", description="Talk to XeThru X4M300 radar modules, real or emulated."
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    one = _command(commands, "list", "find modules: USB and running emulators", _list)
    _add_json(one)
    for name, text, run in (
        ("ping", "ask a module for a sign of life", _ping),
        ("info", "print what a module tells about itself", _info),
        ("reset", "restart a module", _reset),
    ):
        one = _command(commands, name, text, run)
        _add_port(one)
        _add_json(one)

    one = _command(
        commands,
        "stream",
        "read radar frames",
        _stream,
        "On a terminal: a live summary; else one JSON object per frame. The module is stopped "
        "at the end, however it comes.",
    )
    _add_port(one)
    _add_json(one)
    one.add_argument(
        "--frame-area",
        nargs=2,
        type=_metres,
        default=(0.2, 9.4),
        metavar=("START", "END"),
        help="range to read, in module metres (default 0.2 9.4)",
    )
    one.add_argument("--fps", type=_frame_rate, default=17.0, help="frames per second (default 17)")
    one.add_argument(
        "--baseband", action="store_true", help="complex baseband bins instead of RF bins"
    )
    one.add_argument("--count", type=_at_least_one, help="stop after COUNT frames")
    one.add_argument("--samples", action="store_true", help="print the samples, too")

    one = _command(
        commands,
        "decode",
        "turn bytes into messages",
        _decode,
        "One JSON object per packet: framing, payload_hex, message, fields; or fault, offset. "
        "Some payloads mean one thing from the host and another from the module. By default "
        "the structure decides: NoEscape packets are the module's; otherwise the reading that "
        "explains every byte wins; 01 with a value that modules answer is PONG, else PING.",
    )
    one.add_argument("file", nargs="?", metavar="FILE", help="default: standard input")
    one.add_argument(
        "--hex",
        action="store_true",
        help="FILE is text, each line the hexadecimal bytes of a stream of its own",
    )
    one.add_argument(
        "--from", dest="sender", choices=_FROM, default="auto", help="who sent the bytes"
    )

    arguments = parser.parse_args(argv)
    if arguments.command == "stream" and arguments.frame_area[0] >= arguments.frame_area[1]:
        parser.error("argument --frame-area: START must be smaller than END")
    return arguments


def _command(
    commands: "argparse._SubParsersAction[argparse.ArgumentParser]",
    name: str,
    text: str,
    run: Callable[[argparse.Namespace], int],
    details: str = "",
) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name, help=text, description=f"{text[0].upper()}{text[1:]}. {details}"
    )
    parser.set_defaults(run=run)
    return parser


def _add_port(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--port", required=True, help="serial port, for example /dev/ttyACM0")


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")


def _frame_rate(text: str) -> float:
    value = _number(text)
    if not 0 < value < 65536:
        raise argparse.ArgumentTypeError(f"{text!r} must be a number between 0 and 65536")
    return value


def _metres(text: str) -> float:
    value = _number(text)
    if not -1000 <= value <= 1000:
        raise argparse.ArgumentTypeError(f"{text!r} must be metres between -1000 and 1000")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan  # in no range: the caller says what is allowed


def _at_least_one(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} must be a whole number from 1 on")
    return value


# Each command imports its own module: --help and the other commands stay fast.


def _list(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.module import list_modules

    return list_modules(as_json=arguments.json)


def _ping(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.module import ping

    return ping(arguments.port, as_json=arguments.json)


def _info(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.module import info

    return info(arguments.port, as_json=arguments.json)


def _reset(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.module import reset

    return reset(arguments.port, as_json=arguments.json)


def _stream(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.stream import stream
    from xethru_protocol.raw_config import RawConfig

    return stream(
        arguments.port,
        RawConfig(frame_area_m=tuple(arguments.frame_area), downconversion=arguments.baseband),
        fps=arguments.fps,
        count=arguments.count,
        with_samples=arguments.samples,
        as_json=arguments.json,
    )


def _decode(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.decode import decode

    return decode(arguments.file, is_hex=arguments.hex, sender=arguments.sender)
