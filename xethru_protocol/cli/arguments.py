"""Arguments of ``xethru``. Importing this loads nothing that a command needs."""

import argparse
import math
from argparse import ArgumentTypeError
from collections.abc import Callable, Sequence
from typing import TypeAlias

_LONGEST_S = 1e9  # 30 years


def frame_rate(text: str) -> float:
    """Read frames per second."""
    value = _number(text)
    if not 0 < value < 65536:
        raise ArgumentTypeError(f"{text!r} must be a number between 0 and 65536")
    return value


def seconds(text: str) -> float:
    """Read a time span [s]."""
    value = _number(text)
    if not 0 < value <= _LONGEST_S:
        raise ArgumentTypeError(f"{text!r} must be seconds, more than 0")
    return value


def metres(text: str) -> float:
    """Read a distance [m], a hundred times what any radar sees."""
    value = _number(text)
    if not -1000 <= value <= 1000:
        raise ArgumentTypeError(f"{text!r} must be metres between -1000 and 1000")
    return value


def not_empty(text: str) -> str:
    """Read a name."""
    if not text:
        raise ArgumentTypeError("an empty name is none")
    return text


def text(text: str) -> str:
    """Read a text."""
    try:
        text.encode()
    except UnicodeEncodeError:  # bytes that the shell passed on
        raise ArgumentTypeError("this is no text in UTF-8") from None
    return text


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan  # in no range: the caller says what is allowed


def at_least_one(text: str) -> int:
    """Read a count."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise ArgumentTypeError(f"{text!r} must be a whole number from 1 on")
    return value


def baud_rate(text: str) -> int:
    """Read a rate that a module could be set to (Protocol reference 4.10)."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if not 600 <= value <= 10_000_000:
        raise ArgumentTypeError(f"{text!r} must be a whole number from 600 to 10000000")
    return value


_FROM = ("auto", "host", "module")
_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line; exits with 2 on wrong usage.

    The result's ``run(arguments)`` carries the command out and returns the exit code.
    """
    parser = argparse.ArgumentParser(
        prog="xethru", description="Talk to XeThru X4M300 radar modules, real or emulated."
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    for add in (
        _add_list,
        _add_doctor,
        _add_questions,
        _add_stream,
        _add_record,
        _add_dump,
        _add_convert,
        _add_decode,
    ):
        add(commands)
    arguments = parser.parse_args(argv)
    area = getattr(arguments, "frame_area", None)
    if area is not None and area[0] >= area[1]:
        arguments.refuse("argument --frame-area: START must be smaller than END")
    if arguments.command == "record":
        if arguments.out is None and arguments.wire is None:
            arguments.refuse("--out DIR is missing, or --wire FILE, or both")
        if arguments.out == arguments.wire:
            arguments.refuse("--out and --wire must not be the same")
    return arguments


# --- the commands ---------------------------------------------------------------------------


def _add_list(commands: _Commands) -> None:
    one = _command(commands, "list", "find modules: USB and running emulators", _list)
    _add_json(one)


def _add_doctor(commands: _Commands) -> None:
    one = _command(
        commands,
        "doctor",
        "find out what is wrong, and what to do about it",
        _doctor,
        "Examines every port that 'xethru list' shows, or those named by --port. A port that "
        "another program has open is left alone. Exit 0 if all is well, 1 if there is a fault.",
    )
    one.add_argument(
        "--port",
        type=not_empty,
        action="append",
        default=[],
        help="examine this port; may be given several times (default: all that are found)",
    )
    _add_json(one)


def _add_questions(commands: _Commands) -> None:
    for name, text, run in (
        ("ping", "ask a module for a sign of life", _ping),
        ("info", "print what a module tells about itself", _info),
        ("reset", "restart a module", _reset),
    ):
        one = _command(commands, name, text, run)
        _add_port(one)
        _add_json(one)


def _add_stream(commands: _Commands) -> None:
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
    _add_raw_settings(one)
    one.add_argument("--count", type=at_least_one, help="stop after COUNT frames")
    one.add_argument("--samples", action="store_true", help="print the samples, too")


def _add_record(commands: _Commands) -> None:
    one = _command(
        commands,
        "record",
        "write what a module sends to files",
        _record,
        "Ends at --count or --duration, by Ctrl-C, or when the module is unplugged or the disk "
        "is full; what came until then is kept and complete. Progress goes to stderr, a summary "
        "to stdout.",
    )
    _add_port(one)
    one.add_argument(
        "--out",
        type=not_empty,
        metavar="DIR",
        help="directory for a recording in the vendor's format (ModuleConnector)",
    )
    one.add_argument(
        "--wire",
        type=not_empty,
        metavar="FILE",
        help="also, or only, write all bytes of both directions here",
    )
    one.add_argument(
        "--profile",
        choices=("raw", "presence", "none"),
        default="raw",
        help="raw: radar frames (default); presence: the X4M300's own profile; none: only listen "
        "to what the module is sending, and send it nothing",
    )
    _add_raw_settings(one)
    one.add_argument("--count", type=at_least_one, help="stop after COUNT messages")
    one.add_argument(
        "--duration", type=seconds, metavar="S", help="stop after S seconds of recording"
    )
    one.add_argument(
        "--session-id",
        type=text,
        default="",
        metavar="TEXT",
        help="name kept in the recording",
    )
    _add_force(one, "replace a recording that is there already")
    _add_json(one)


def _add_dump(commands: _Commands) -> None:
    one = _command(
        commands,
        "dump",
        "print a recording",
        _dump,
        "Reads the vendor's recordings (the directory, or one of its files), wire captures, "
        ".mcap and .npz. Prints a summary and one line per message; with --json one object per "
        "message, as decode does, with its time t_ns. Exit 1 if a part could not be read.",
    )
    one.add_argument(
        "file", type=not_empty, metavar="FILE", help="file or directory of a recording"
    )
    one.add_argument("--samples", action="store_true", help="print arrays whole")
    _add_radar(one)
    _add_json(one)


def _add_convert(commands: _Commands) -> None:
    one = _command(
        commands,
        "convert",
        "turn a recording into another format",
        _convert,
        "The name of TARGET says which: .mcap, .npz, .xtwire (a wire capture); a name without "
        "suffix is a directory in the vendor's format.",
    )
    one.add_argument(
        "source",
        type=not_empty,
        metavar="SOURCE",
        help="any recording that 'xethru dump' reads",
    )
    one.add_argument("target", type=not_empty, metavar="TARGET", help="file or directory to write")
    _add_radar(one)
    _add_force(one, "replace TARGET if it exists")
    _add_json(one)


def _add_radar(one: argparse.ArgumentParser) -> None:
    one.add_argument(
        "--radar",
        type=not_empty,
        metavar="NAME",
        help="which radar of a session that holds several",
    )


def _add_decode(commands: _Commands) -> None:
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
    one.add_argument(
        "file", type=not_empty, nargs="?", metavar="FILE", help="- or none: standard input"
    )
    one.add_argument(
        "--hex",
        action="store_true",
        help="FILE is text, each line the hexadecimal bytes of a stream of its own",
    )
    one.add_argument(
        "--from", dest="sender", choices=_FROM, default="auto", help="who sent the bytes"
    )
    one.add_argument(
        "--statistics",
        action="store_true",
        help="at the end, write totals to standard error as one JSON object",
    )


# --- their parts ------------------------------------------------------------------------------


def _command(
    commands: _Commands,
    name: str,
    text: str,
    run: Callable[[argparse.Namespace], int],
    details: str = "",
) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name, help=text, description=f"{text[0].upper()}{text[1:]}. {details}"
    )
    parser.set_defaults(run=run, refuse=parser.error)
    return parser


def _add_port(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--port",
        type=not_empty,
        required=True,
        help="serial port, for example /dev/ttyACM0",
    )
    parser.add_argument(
        "--baudrate",
        type=baud_rate,
        default=115200,
        metavar="RATE",
        help="of a module on a UART (default 115200); without meaning on USB and for emulators",
    )


def _add_raw_settings(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("raw radar frames")
    group.add_argument(
        "--frame-area",
        nargs=2,
        type=metres,
        default=(0.2, 9.4),
        metavar=("START", "END"),
        help="range to read, in module metres (default 0.2 9.4)",
    )
    group.add_argument(
        "--fps", type=frame_rate, default=17.0, help="frames per second (default 17)"
    )
    group.add_argument(
        "--baseband", action="store_true", help="complex baseband bins instead of RF bins"
    )


def _add_force(parser: argparse.ArgumentParser, text: str) -> None:
    parser.add_argument("--force", action="store_true", help=text)


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")


# Each command imports its own module: --help and the other commands stay fast.


def _list(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.module import list_modules

    return list_modules(as_json=arguments.json)


def _doctor(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.doctor import doctor

    return doctor(arguments.port, as_json=arguments.json)


def _ping(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.module import ping

    return ping(arguments.port, arguments.baudrate, as_json=arguments.json)


def _info(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.module import info

    return info(arguments.port, arguments.baudrate, as_json=arguments.json)


def _reset(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.module import reset

    return reset(arguments.port, arguments.baudrate, as_json=arguments.json)


def _stream(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.module import stream
    from xethru_protocol.driver.link import RawConfig

    return stream(
        arguments.port,
        arguments.baudrate,
        RawConfig(frame_area_m=tuple(arguments.frame_area), downconversion=arguments.baseband),
        fps=arguments.fps,
        count=arguments.count,
        with_samples=arguments.samples,
        as_json=arguments.json,
    )


def _record(arguments: argparse.Namespace) -> int:
    from pathlib import Path

    from xethru_protocol.cli.record import Targets, record, recording_mode
    from xethru_protocol.driver.link import RawConfig

    config = RawConfig(frame_area_m=tuple(arguments.frame_area), downconversion=arguments.baseband)
    mode = recording_mode(arguments.profile, config, arguments.fps)
    targets = Targets(
        directory=Path(arguments.out) if arguments.out else None,
        wire=Path(arguments.wire) if arguments.wire else None,
        session_id=arguments.session_id,
        profile_id=mode.profile_id,
        port=arguments.port,
    )
    return record(
        arguments.port,
        arguments.baudrate,
        mode,
        targets,
        count=arguments.count,
        duration_s=arguments.duration,
        replace=arguments.force,
        as_json=arguments.json,
    )


def _dump(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.recordings import dump

    return dump(
        arguments.file,
        with_samples=arguments.samples,
        as_json=arguments.json,
        radar=arguments.radar,
    )


def _convert(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.recordings import convert

    return convert(
        arguments.source,
        arguments.target,
        replace=arguments.force,
        as_json=arguments.json,
        radar=arguments.radar,
    )


def _decode(arguments: argparse.Namespace) -> int:
    from xethru_protocol.cli.recordings import decode

    return decode(
        None if arguments.file == "-" else arguments.file,
        is_hex=arguments.hex,
        sender=arguments.sender,
        with_statistics=arguments.statistics,
    )
