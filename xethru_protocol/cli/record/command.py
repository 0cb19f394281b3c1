"""The command ``xethru record``.

Whatever ends it, the recording is closed and complete: a signal only asks for the end, so that
none comes while a record is half written; a second one insists.
"""

from argparse import Namespace
from contextlib import suppress
from pathlib import Path

from xethru_protocol.cli.arguments import raw_config
from xethru_protocol.cli.output import CommandFailed, print_json, print_line, warn
from xethru_protocol.cli.record.modes import Listen, RawFrames, profile_of
from xethru_protocol.cli.record.output_files import writer_options
from xethru_protocol.cli.record.session import Session
from xethru_protocol.operating_system import StopFlag

_MOST_MODULES = 8


def record(arguments: Namespace) -> int:
    """Record until ``--count``, ``--duration``, a signal, unplugging or a full disk."""
    config = raw_config(arguments)
    if arguments.out is None and arguments.wire is None:
        arguments.refuse("--out DIR is missing, or --wire FILE, or both")
    if arguments.out == arguments.wire:
        arguments.refuse("--out and --wire must not be the same")
    if config is None and arguments.profile != "raw":
        arguments.refuse("--attach takes radar frames: leave --profile out")
    mode = Listen()
    profile = profile_of(arguments)
    if arguments.profile == "raw":
        mode = RawFrames(config=config, fps=arguments.fps)
    elif profile is not None:
        mode = profile
    is_mcap = arguments.out is not None and Path(arguments.out).suffix == ".mcap"
    if is_mcap:
        _check_sources(arguments)
    elif len(arguments.ports) > 1 or arguments.text:
        arguments.refuse("several --port, and --text, need one file for all: --out FILE.mcap")
    options = writer_options(arguments, has_directory=arguments.out is not None and not is_mcap)
    session = Session(arguments, mode, None if is_mcap else options)
    stop = StopFlag("previous")
    session.record(stop)
    if stop.received is None:
        return _print_end(session, arguments, is_stopped=False)
    with suppress(CommandFailed, BrokenPipeError):  # the terminal may have closed
        _print_end(session, arguments, is_stopped=True)
    return 128 + stop.received


def _print_end(session: Session, arguments: Namespace, *, is_stopped: bool) -> int:
    """Print what was recorded; CommandFailed if not all could be, and no signal was the reason."""
    failure = session.failure
    if arguments.json:
        print_json(session.summary() | {"ended_by": "failure" if failure else session.ended_by})
    elif failure is None and not session.is_empty:
        print_line(f"{session.targets}: {session.numbers()}")
    elif failure is None:
        warn("xethru record: nothing came, so nothing was written")
    if failure is not None:
        text = str(failure) if session.is_empty else f"{failure}; {session.kept()}"
        if not is_stopped:
            raise CommandFailed(text)
        warn(f"xethru record: {text}")
    return 1 if any(source.failure for source in session.sources) else 0


def _check_sources(arguments: Namespace) -> None:
    """End the program if several sources make no sense together."""
    ports = [port for _, port in arguments.ports]
    sources = [source for _, source, _ in arguments.text]
    if len(ports) > _MOST_MODULES:
        arguments.refuse(f"at most {_MOST_MODULES} modules are recorded together")
    if arguments.wire is not None:
        arguments.refuse("--wire is for one module, with --out DIR or alone")
    for what, given in (
        ("port", ports + [source for source in sources if source != "-"]),
        ("module", [name for name, _ in arguments.ports]),
        ("--text", [name for name, _, _ in arguments.text]),
    ):
        twice = sorted({each for each in given if given.count(each) > 1})
        if twice:
            remedy = "; name them: --port NAME=PORT" if what == "module" else ""
            arguments.refuse(f"{what} {twice[0]} is given twice{remedy}")
    if sources.count("-") > 1:
        arguments.refuse("only one --text can be standard input")
