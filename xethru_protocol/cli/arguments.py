"""The commands of ``xethru`` and their options. Loads nothing heavy, for a quick ``--help``."""

import argparse
import math
import re
from argparse import ArgumentTypeError
from collections.abc import Sequence
from typing import TYPE_CHECKING

from xethru_protocol.cli.version import add_version
from xethru_protocol.validation import Parser, number, output, recording_at, shown
from xethru_protocol.wire.codes import POWER_UP_BAUD

if TYPE_CHECKING:
    from xethru_protocol.driver.link import RawConfig


_LONGEST_S = 1e9  # 30 years
_FRAME_AREA_M = (0.2, 9.4)


def not_empty(text: str) -> str:
    if not text:
        raise ArgumentTypeError("must not be empty")
    return text


def recording(text: str) -> str:
    return recording_at(not_empty(text))


def utf8_text(text: str) -> str:
    try:
        text.encode()
    except UnicodeEncodeError:  # bytes that the shell passed on
        raise ArgumentTypeError("this is not text in UTF-8") from None
    return text


def wire_file(text: str) -> str:
    output(".xtwire", what="a wire capture, --out MCAP")(not_empty(text))
    return text


def recording_file(text: str) -> str:
    if text.endswith(".xtwire"):
        raise ArgumentTypeError(f"a wire capture is written by --wire {text}")
    output(".mcap", what="MCAP or a directory in the vendor's format")(not_empty(text))
    return text


frame_rate = number(float, lambda value: 0 < value < 65536, "a number between 0 and 65536")
seconds = number(float, lambda value: 0 < value <= _LONGEST_S, "seconds, more than 0")
# a hundred times what any radar sees
metres = number(float, lambda value: -1000 <= value <= 1000, "metres between -1000 and 1000")
sensitivity = number(int, lambda value: 0 <= value <= 9, "a whole number from 0 to 9")
at_least_one = number(int, lambda value: value >= 1, "a whole number from 1 on")
tcp_port = number(int, lambda value: 0 <= value < 65536, "a whole number from 0 to 65535")
playback_rate = number(float, lambda value: 0 <= value < math.inf, "a number from 0 on")
window = number(float, lambda value: 20 <= value <= 600, "seconds, from 20 to 600")
# rates that a module could be set to (Protocol reference 4.10)
baud_rate = number(
    int, lambda value: 600 <= value <= 10_000_000, "a whole number from 600 to 10000000"
)


_LIMIT = re.compile(r"(\d+(?:\.\d*)?)(records|kB|MB|GB|B|s|min|h)|daily@(\d{1,2})")
_UNITS = {"B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "s": 1, "min": 60, "h": 3600}


def split_limit(text: str) -> tuple[str, float]:
    """Return a limit of a data file or directory: field of `Split`, and its value.

    >>> split_limit("10MB"), split_limit("1.5h"), split_limit("500records"), split_limit("daily@14")
    (('bytes', 10000000), ('seconds', 5400.0), ('records', 500), ('daily_hour', 14))
    """
    found = _LIMIT.fullmatch(text)
    if found is None or (found[3] and int(found[3]) > 23) or (found[1] and not float(found[1])):
        raise ArgumentTypeError(
            f"{shown(text)} is not a limit: write 500records, 10MB (B, kB, MB, GB), "
            "600s (s, min, h) or daily@14 (an hour, 0 ... 23)"
        )
    number, unit, hour = found.groups()
    if hour:
        return "daily_hour", int(hour)
    if unit == "records":
        return "records", math.ceil(float(number))
    if unit in {"s", "min", "h"}:
        return "seconds", float(number) * _UNITS[unit]
    return "bytes", math.ceil(float(number) * _UNITS[unit])


def memory_limit(text: str) -> str:
    if not re.fullmatch(r"[1-9]\d*(MB|GB)", text):
        raise ArgumentTypeError(f"{shown(text)} must be like 500MB or 2GB")
    return text


_NAMED = re.compile(r"([A-Za-z]\w*)=(.+)")


def named_port(text: str) -> tuple[str, str]:
    """Return name and port of a module; the name is that of the port where none is given.

    >>> named_port("left=/dev/ttyACM0"), named_port("/dev/ttyACM0"), named_port("tcp://pi:5000")
    (('left', '/dev/ttyACM0'), ('ttyACM0', '/dev/ttyACM0'), ('pi_5000', 'tcp://pi:5000'))
    """
    if found := _NAMED.fullmatch(not_empty(text)):
        return found[1], found[2]
    return re.sub(r"\W", "_", text.rstrip("/").rpartition("/")[2]) or "module", text


def text_source(text: str) -> tuple[str, str, int]:
    """Return name, source and baud rate of a column of text.

    >>> text_source("belt=-"), text_source("ecg=/dev/ttyUSB1@9600")
    (('belt', '-', 115200), ('ecg', '/dev/ttyUSB1', 9600))
    """
    found = _NAMED.fullmatch(text)
    if found is None:
        raise ArgumentTypeError(
            f"{shown(text)} must be NAME=- for standard input, or NAME=PORT, NAME=PORT@BAUDRATE"
        )
    source, at, rate = found[2].rpartition("@")
    if at and rate.isdecimal():
        return found[1], source, int(baud_rate(rate))
    return found[1], found[2], POWER_UP_BAUD


def base_name(text: str) -> tuple[str, str]:
    kind, equals, name = text.partition("=")
    if not (kind and equals and re.fullmatch(r"[\w.+-]+", name)):
        raise ArgumentTypeError(
            f"{shown(text)} must be KIND=NAME, such as datafloat=lab, the name of letters, digits "
            "and _"
        )
    return kind, name


def _add_command(
    commands: "argparse._SubParsersAction[argparse.ArgumentParser]",
    name: str,
    text: str,
    run: str,
    details: str = "",
) -> argparse.ArgumentParser:
    """Add a command; ``run`` is the function that carries it out, as ``file:function``."""
    parser = commands.add_parser(
        name, help=text, description=f"{text[0].upper()}{text[1:]}. {details}"
    )
    parser.set_defaults(run=run, refuse=parser.error)
    return parser


_PORT_HELP = "serial port, for example /dev/ttyACM0, or tcp://HOST:PORT, rfc2217://HOST:PORT"


def _add_port(parser: argparse.ArgumentParser, *, required: bool = True) -> None:
    parser.add_argument("--port", type=not_empty, required=required, help=_PORT_HELP)
    _add_baudrate(parser)


def _add_baudrate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--baudrate",
        type=baud_rate,
        default=POWER_UP_BAUD,
        metavar="RATE",
        help="of a module on a UART (default 115200); without meaning on USB, at tcp:// and for "
        "emulators",
    )


def _add_raw_settings(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("raw radar frames")
    group.add_argument(
        "--frame-area",
        nargs=2,
        type=metres,
        metavar=("START", "END"),
        help="range to read, in module metres (default 0.2 9.4)",
    )
    group.add_argument(
        "--fps", type=frame_rate, help="frames per second (default 17; less if a UART carries less)"
    )
    group.add_argument(
        "--baseband", action="store_true", help="complex baseband bins instead of RF bins"
    )


def _add_attach(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--attach",
        action="store_true",
        help="take the frames that the module sends for another program, as beside 'xethru share', "
        "and change nothing",
    )


def raw_config(arguments: argparse.Namespace) -> "RawConfig | None":
    """Return the settings of raw radar frames, None for those that the module has (--attach).

    Ends the program on wrong usage.
    """
    if arguments.attach:
        refuse_raw_settings(arguments, "--attach changes nothing")
        return None
    from xethru_protocol.driver.link import RawConfig

    start_m, end_m = arguments.frame_area or _FRAME_AREA_M
    if start_m >= end_m:
        arguments.refuse("argument --frame-area: START must be smaller than END")
    return RawConfig(frame_area_m=(start_m, end_m), downconversion=arguments.baseband)


def refuse_raw_settings(arguments: argparse.Namespace, why: str) -> None:
    """End the program if settings of raw radar frames are given."""
    for option in ("frame_area", "fps", "baseband"):
        if getattr(arguments, option):
            arguments.refuse(f"{why}: leave --{option.replace('_', '-')} out")


def _add_recording_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("vendor's format", "options of ModuleConnector's recorder")
    group.add_argument(
        "--session-id",
        type=utf8_text,
        default="",
        metavar="TEXT",
        help="name kept in the recording (default: a random UUID)",
    )
    group.add_argument(
        "--new-directory",
        action="store_true",
        help="make a directory in DIR, xethru_recording_<local time>_<session id>",
    )
    for option, what in (("--split-files", "data file"), ("--split-directories", "directory")):
        group.add_argument(
            option,
            type=split_limit,
            action="append",
            default=[],
            metavar="LIMIT",
            help=f"begin a new {what} at 500records, 10MB, 600s (min, h) or daily@14 o'clock; may "
            "be given several times",
        )
    group.add_argument(
        "--basename",
        type=base_name,
        action="append",
        default=[],
        metavar="KIND=NAME",
        help="begin names of data files with NAME; KIND as in xethru_KIND_..., such as datafloat",
    )
    group.add_argument(
        "--user-header",
        type=utf8_text,
        default="",
        metavar="TEXT",
        help="put TEXT before the records of each data file",
    )
    group.add_argument(
        "--interval",
        type=seconds,
        metavar="S",
        help="leave messages out that come sooner than S seconds after the last one of their kind",
    )
    group.add_argument(
        "--flush-on-write",
        action="store_true",
        help="have each record on the disk before the next; slow",
    )


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")


def _add_frames(one: argparse.ArgumentParser) -> None:
    one.add_argument(
        "--frames",
        choices=("auto", "rf", "baseband"),
        default="auto",
        help="what radar frames hold, which most recordings do not say (default: from the "
        "module's answers if they are there, else by how smooth the values are over range)",
    )


def _add_radar(one: argparse.ArgumentParser) -> None:
    one.add_argument(
        "--radar",
        type=not_empty,
        metavar="NAME",
        help="which radar of a session that holds several",
    )


def _add_live_source(one: argparse.ArgumentParser) -> None:
    one.add_argument(
        "recording",
        type=recording,
        nargs="?",
        metavar="RECORDING",
        help="any recording with radar frames, else a module at --port; --frame-area, --fps and "
        "--baseband add what a recording does not say",
    )
    _add_port(one, required=False)
    one.add_argument(
        "--rate",
        type=playback_rate,
        default=1.0,
        metavar="R",
        help="play a recording at this multiple of real time; 0: as fast as it goes (default 1)",
    )
    _add_radar(one)
    _add_raw_settings(one)
    _add_attach(one)
    one.add_argument("--count", type=at_least_one, help="stop after COUNT frames")
    one.add_argument(
        "--window",
        type=window,
        default=60.0,
        metavar="S",
        help="seconds of frames in which a breathing rate is found, 20 to 600 (default 60)",
    )


_NO_MEDICAL_DEVICE = "Breathing is an estimate for experiments: this is not a medical device."


def _add_live(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    one = _add_command(
        commands,
        "view",
        "show what a radar sees, live or of a recording",
        "live.view:view",
        "Waterfall, newest frame, range-Doppler and breathing in a window of Rerun (the extra "
        "live), in a browser or as text. Ends when the viewer is closed or by Ctrl-C; the module "
        f"is stopped. {_NO_MEDICAL_DEVICE}",
    )
    _add_live_source(one)
    where = one.add_mutually_exclusive_group()
    where.add_argument(
        "--web", action="store_true", help="serve a page for a browser of this machine"
    )
    where.add_argument(
        "--terminal",
        action="store_true",
        help="draw with text, in place on a terminal, else a picture every 10 s; needs no extra. "
        "NO_COLOR=1 leaves colours out",
    )
    one.add_argument(
        "--clutter",
        choices=("none", "mean", "exponential", "svd"),
        default="mean",
        help="how what stands still is removed: not at all, by a running mean of 64 frames "
        "(default), by a high-pass with a time constant of 50 frames, or by singular values; "
        "the key c takes the next one",
    )
    one.add_argument(
        "--memory",
        type=memory_limit,
        default="1GB",
        metavar="SIZE",
        help="most memory of the viewer, such as 500MB (default 1GB)",
    )
    one = _add_command(
        commands,
        "vital",
        "show breathing and presence, live or of a recording",
        "live.vital:vital",
        "One line a second: breaths per minute, where, and how much of the movement is breathing "
        "(confidence, 0 to 1), or why there is no answer; on a terminal one line that is "
        f"rewritten. {_NO_MEDICAL_DEVICE}",
    )
    _add_live_source(one)
    _add_json(one)


def _add_share(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    one = _add_command(
        commands,
        "share",
        "give one module to several programs",
        "share:share",
        "Programs open it as tcp://HOST:PORT. All get every message and may ask; settings are "
        "changed by the first that does, until it leaves, and refused to others, which take its "
        "frames with --attach. One that is too slow loses whole messages, the others none. Ends by "
        "Ctrl-C, with exit code 0.",
    )
    _add_port(one)
    one.add_argument(
        "--tcp", type=tcp_port, required=True, metavar="PORT", help="where, 0: any that is free"
    )
    one.add_argument(
        "--host",
        type=not_empty,
        default="127.0.0.1",
        help="address to listen at (default 127.0.0.1, which only this machine reaches)",
    )
    _add_json(one)


def _add_flash(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    one = _add_command(
        commands,
        "flash",
        "write firmware into a module",
        "module:flash",
        "IMAGE is Intel hex, as the vendor's ..._4bl files, or the bytes from address 410000h on. "
        "The module restarts into its bootloader, which compares what was written with the image's "
        "checksum before it starts it. After an interruption the module stays in its bootloader; "
        "run the same command again, on the port where it is now. Progress goes to stderr.",
    )
    one.add_argument("image", type=not_empty, metavar="IMAGE", help="file with the firmware")
    _add_port(one)
    one.add_argument(
        "--yes", action="store_true", help="really replace the firmware; without it nothing is sent"
    )
    _add_json(one)


def _add_export(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    one = _add_command(
        commands,
        "export",
        "write the protocol for other tools",
        "recordings:export",
        "kaitai: a .ksy file for kaitai-struct-compiler. wireshark: a dissector in Lua for the "
        ".pcap files that 'xethru convert' writes.",
    )
    one.add_argument("tool", choices=("kaitai", "wireshark"), metavar="TOOL", help="%(choices)s")
    one.add_argument(
        "--out", type=not_empty, metavar="FILE", help="file to write (default: standard output)"
    )
    one.add_argument("--force", action="store_true", help="replace FILE if it exists")


def _add_legacy(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    one = _add_command(
        commands,
        "legacy",
        "run a Python script that was written for ModuleConnector",
        "legacy:legacy",
        "As 'python SCRIPT ARGS', but 'import pymoduleconnector' finds this project's driver. The "
        "module is left as the script leaves it. Exit code: the script's, 1 after an error, 130 "
        "after Ctrl-C.",
    )
    one.add_argument("script", type=not_empty, metavar="SCRIPT", help="file of the script")
    rest = one.add_argument(
        "arguments", nargs=argparse.REMAINDER, metavar="ARGS", help="arguments of the script"
    )
    rest.required = False  # there may be none; only Python from 3.12 on knows


def _add_simple(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    for name, about, run in (
        ("ping", "check whether a module answers", "module:ping"),
        ("info", "print what a module reports about itself", "module:info"),
        ("reset", "restart a module", "module:reset"),
    ):
        one = _add_command(commands, name, about, run)
        _add_port(one)
        _add_json(one)


def _add_record(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    one = _add_command(
        commands,
        "record",
        "write what a module sends to files",
        "record.command:record",
        "Ends at --count or --duration, by Ctrl-C, or when the module is unplugged or the disk "
        "is full; what came until then is kept and complete. Progress goes to stderr, a summary "
        "to stdout.",
    )
    one.add_argument(
        "--port",
        type=named_port,
        action="append",
        dest="ports",
        required=True,
        metavar="[NAME=]PORT",
        help=f"{_PORT_HELP}; with --out FILE.mcap up to 8 times, with names for the file (default: "
        "the port's)",
    )
    _add_baudrate(one)
    one.add_argument(
        "--out",
        type=recording_file,
        metavar="DIR|FILE.mcap",
        help="directory for a recording in the vendor's format (ModuleConnector), or one MCAP file "
        "for all modules and other sensors",
    )
    one.add_argument(
        "--text",
        type=text_source,
        action="append",
        default=[],
        metavar="NAME=SOURCE",
        help="with --out FILE.mcap: also record lines of text, such as of a breathing belt, each "
        "with its time; SOURCE is - for standard input or a serial port, PORT or PORT@BAUDRATE; "
        "may be given several times",
    )
    one.add_argument(
        "--wire",
        type=wire_file,
        metavar="FILE",
        help="also, or only, write all bytes of both directions here (.xtwire)",
    )
    one.add_argument(
        "--profile",
        choices=("raw", "presence", "respiration", "none"),
        default="raw",
        help="raw: radar frames (default); presence: the X4M300's own profile; respiration: that "
        "of an X4M200 or X4M210, with sleep; none: only listen to what the module is sending, and "
        "send it nothing",
    )
    _add_raw_settings(one)
    _add_attach(one)
    group = one.add_argument_group("presence and respiration")
    group.add_argument(
        "--output",
        type=not_empty,
        metavar="NAMES",
        help="what the profile sends, and nothing else (default: what it is set to), separated by "
        "commas: iq or ap, pulsedoppler, pulsedoppler-byte, noisemap, noisemap-byte; of presence "
        "single, movinglist; of respiration status, sleep, vitalsigns, movinglist, detectionlist, "
        "normalizedmovementlist",
    )
    group.add_argument(
        "--zone",
        nargs=2,
        type=metres,
        metavar=("START", "END"),
        help="detection zone in metres (default: what it is set to)",
    )
    group.add_argument(
        "--sensitivity", type=sensitivity, metavar="N", help="0 ... 9 (default: what it is set to)"
    )
    _add_recording_options(one)
    one.add_argument("--count", type=at_least_one, help="stop after COUNT messages")
    one.add_argument(
        "--duration", type=seconds, metavar="S", help="stop after S seconds of recording"
    )
    one.add_argument(
        "--force", action="store_true", help="replace a recording that is there already"
    )
    _add_json(one)


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line; exits with 2 on wrong usage.

    ``run`` of the result names the function that carries the command out, as ``file:function``;
    ``refuse(text)`` ends the program for wrong usage.
    """
    parser: argparse.ArgumentParser = Parser(
        prog="xethru", description="Talk to XeThru X4M300 radar modules, real or emulated."
    )
    add_version(parser)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    _add_json(
        _add_command(
            commands, "list", "find modules: USB and running emulators", "module:list_modules"
        )
    )
    one = _add_command(
        commands,
        "doctor",
        "find out what is wrong, and what to do about it",
        "doctor:doctor",
        "Examines every port that 'xethru list' shows, or those named by --port. A port that "
        "another program has open is left alone. Exit 0 if all is well, 1 if there is a fault.",
    )
    one.add_argument(
        "--port",
        type=not_empty,
        action="append",
        default=[],
        help="examine this port, also tcp:// or rfc2217://; may be given several times (default: "
        "all that are found)",
    )
    _add_json(one)
    _add_simple(commands)
    _add_flash(commands)
    one = _add_command(
        commands,
        "stream",
        "read radar frames",
        "module:stream",
        "On a terminal: a live summary; else one JSON object per frame. However it ends, the "
        "module is stopped.",
    )
    _add_port(one)
    _add_json(one)
    _add_raw_settings(one)
    _add_attach(one)
    one.add_argument("--count", type=at_least_one, help="stop after COUNT frames")
    one.add_argument("--samples", action="store_true", help="print the samples, too")
    _add_live(commands)
    _add_record(commands)
    _add_share(commands)
    one = _add_command(
        commands,
        "dump",
        "print a recording",
        "recordings:dump",
        "Reads the vendor's recordings (the directory, or one of its files), wire captures and "
        ".mcap. Prints a summary and one line per message; with --json one object per "
        "message, as decode does, with its time t_ns. Exit 1 if a part could not be read.",
    )
    one.add_argument(
        "file", type=recording, metavar="FILE", help="file or directory of a recording"
    )
    one.add_argument("--samples", action="store_true", help="print arrays whole")
    _add_frames(one)
    _add_radar(one)
    _add_json(one)

    one = _add_command(
        commands,
        "convert",
        "turn a recording into another format",
        "recordings:convert",
        "The name of TARGET says which: .mcap, .xtwire (a wire capture), .pcap (of a wire capture, "
        "for Wireshark); .csv, .mat (MATLAB) and .npz (numpy) for frames as arrays; a name without "
        "suffix is a directory in the vendor's format.",
    )
    one.add_argument(
        "source",
        type=recording,
        metavar="SOURCE",
        help="any recording that 'xethru dump' reads",
    )
    one.add_argument("target", type=not_empty, metavar="TARGET", help="file or directory to write")
    _add_radar(one)
    _add_frames(one)
    one.add_argument(
        "--frame-area",
        nargs=2,
        type=metres,
        metavar=("START", "END"),
        help="frame area as the module read it back, in module metres, for arrays of a recording "
        "that does not say it",
    )
    one.add_argument("--force", action="store_true", help="replace TARGET if it exists")
    _add_json(one)

    _add_export(commands)
    _add_legacy(commands)
    one = _add_command(
        commands,
        "decode",
        "turn bytes into messages",
        "recordings:decode",
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
        "--from",
        dest="sender",
        choices=("auto", "host", "module"),
        default="auto",
        help="who sent the bytes",
    )
    one.add_argument(
        "--statistics",
        action="store_true",
        help="at the end, write totals to standard error as one JSON object",
    )
    return parser.parse_args(argv)
