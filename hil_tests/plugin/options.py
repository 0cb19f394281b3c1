"""The plugin's options; the command line wins over the environment, that over the ini file."""

from __future__ import annotations

import os
import re
import tomllib
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import pytest

from hil_tests.plugin.power import PowerCommand, PowerError
from hil_tests.plugin.radar_specs import RadarArgument, RadarKind, SpecError, parse_specs

ENVIRONMENT = "XETHRU_RADARS"
INI = "xethru_radars"
WORKER_KEY = "xethru_radars"
RIG_ENVIRONMENT, RIG_INI = "XETHRU_RIG", "xethru_rig"
POWER_ENVIRONMENT, POWER_INI = "XETHRU_POWER_CMD", "xethru_power_cmd"
_SECTION = re.compile(
    r"^\[(?:pytest|tool:pytest|tool\.pytest(?:\.ini_options)?)\](.*?)(?=^\[|\Z)",
    re.MULTILINE | re.DOTALL,
)
"""What pytest itself reads of its configuration file; other tools' keys may be called anything."""
_CLOSE = 0.85  # a letter or two of a dozen; xethru_pages is no misspelling of xethru_radars


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """Radars and paths of the session; the other options are read where they are used.

    ``chosen`` is false if the radars are the default, one `emu`.
    """

    specs: tuple[RadarArgument, ...]
    chosen: bool
    rig: Path | None
    power: PowerCommand | None
    cassette: Path | None
    artifacts: Path
    json: Path | None


CHOICES: pytest.StashKey[Choices] = pytest.StashKey()


def add_options(parser: pytest.Parser) -> None:
    group = parser.getgroup("xethru-hil", "radars under test (xethru-hil)")
    group.addoption(
        "--radar",
        action="append",
        metavar="SPEC",
        help="radar to test, repeatable: emu[:SCENE][?seed=S&fps=F&line=pty&firmware=xep], "
        "/dev/ttyACM0, serial=NUMBER, auto, tcp://HOST:PORT, rfc2217://HOST:PORT, replay:RECORDING "
        f"(environment {ENVIRONMENT}, ini {INI}; default emu)",
    )
    group.addoption(
        "--rig",
        metavar="FILE",
        help="rig file: names the modules of radar_rig by serial number; alone, those are tested "
        f"(environment {RIG_ENVIRONMENT}, ini {RIG_INI})",
    )
    group.addoption(
        "--hil-power-cmd",
        metavar="CMD",
        help="command that switches the power of real radars, such as 'uhubctl -l 1-1 -p 2 -a "
        "{action}'; {action} is off, then on, {port} the port, {serial} the serial number; without "
        f"{{action}} it runs once (environment {POWER_ENVIRONMENT}, ini {POWER_INI})",
    )
    for name, text in (
        ("--hil-strict", "a missing capability fails a test instead of skipping it"),
        ("--hil-slow", "also run tests that take long on a radar in real time"),
        ("--allow-flash", "let tests write the flash of real modules"),
        ("--allow-factory-reset", "let tests set real modules to their factory settings"),
        ("--hil-diff", "compare every answer with the emulator's"),
    ):
        group.addoption(name, action="store_true", help=text)
    group.addoption(
        "--hil-cassette",
        metavar="FILE",
        help="with --hil-diff: write the answers as a conformance cassette",
    )
    group.addoption(
        "--hil-artifacts",
        metavar="DIR",
        default="hil-artifacts",
        help="folder for wire, log, scene, seeds and view of a test (default %(default)s)",
    )
    group.addoption(
        "--hil-keep",
        choices=["failed", "all", "none"],
        default="failed",
        help="of which tests these are kept (default failed)",
    )
    group.addoption("--hil-json", metavar="FILE", help="write what ran where and what was measured")
    parser.addini(INI, f"radars to test, as --radar; {ENVIRONMENT} and --radar win", "linelist")
    parser.addini(
        POWER_INI, f"power command, as --hil-power-cmd; {POWER_ENVIRONMENT} and that one win"
    )
    parser.addini(RIG_INI, f"rig file, as --rig; {RIG_ENVIRONMENT} and --rig win")


def choose(config: pytest.Config) -> Choices:
    """Read and check the options; `pytest.UsageError` if they make no sense."""
    _check_names(config)
    rig = _setting(config, "rig", RIG_ENVIRONMENT, RIG_INI)
    power = _setting(config, "hil_power_cmd", POWER_ENVIRONMENT, POWER_INI)
    worker: dict[str, list[str]] = getattr(config, "workerinput", {})
    try:
        chosen = (
            worker.get(WORKER_KEY)  # found by the first process
            or config.getoption("radar")
            or os.environ.get(ENVIRONMENT, "").split()
            or config.getini(INI)
            or (_modules_of(Path(rig)) if rig else [])
        )
        specs = parse_specs(chosen or ["emu"])
        if not worker:
            specs = _found(specs)
            _check_workers(config, specs)
    except SpecError as error:
        raise pytest.UsageError(str(error)) from None
    cassette, report = config.getoption("hil_cassette"), config.getoption("hil_json")
    if cassette and not config.getoption("hil_diff"):
        raise pytest.UsageError("--hil-cassette needs --hil-diff")
    if report:
        _check_report(Path(config.invocation_params.dir, report))
    return Choices(
        specs=specs,
        chosen=bool(chosen),
        rig=Path(rig) if rig else None,
        power=_power_command(power) if power else None,
        cassette=Path(cassette) if cassette else None,
        artifacts=Path(config.invocation_params.dir, config.getoption("hil_artifacts")),
        json=Path(config.invocation_params.dir, report) if report else None,
    )


def _check_names(config: pytest.Config) -> None:
    """Reject misspelt keys and variables: the emulator would be tested in a radar's place."""
    file = config.inipath
    text = "" if file is None else file.read_text("utf-8", errors="replace")
    section = "".join(_SECTION.findall(text))
    keys = re.findall(r"^([\w-]+)\s*[=:]", section, re.MULTILINE)
    keys += [pair.partition("=")[0] for pair in config.getoption("override_ini") or ()]
    for key in keys:
        if (match := _meant(key, (INI, RIG_INI, POWER_INI))) is not None:
            try:
                config.getini(key)  # another plugin's
            except ValueError:
                raise pytest.UsageError(
                    f"{file or '-o'}: unknown key {key}; did you mean {match}?"
                ) from None
    for name in os.environ:
        if (match := _meant(name, (ENVIRONMENT, RIG_ENVIRONMENT, POWER_ENVIRONMENT))) is not None:
            raise pytest.UsageError(f"environment: unknown {name}; did you mean {match}?")


def _meant(name: str, known: tuple[str, ...]) -> str | None:
    """Return the name for which another one is a misspelling; None if it is right or none."""
    close = get_close_matches(name, known, n=1, cutoff=_CLOSE)
    return close[0] if close and name not in known else None


def _setting(config: pytest.Config, option: str, environment: str, ini: str) -> str:
    return str(config.getoption(option) or os.environ.get(environment) or config.getini(ini))


def _power_command(text: str) -> PowerCommand:
    try:
        return PowerCommand(text)
    except PowerError as error:
        raise pytest.UsageError(f"--hil-power-cmd {error}") from None


def _modules_of(rig: Path) -> list[str]:
    """Return specs of the modules of a rig file; `radar_rig` checks the rest of it."""
    try:
        radars = tomllib.loads(rig.read_text("utf-8"))["radars"]
        modules = [f"serial={radar['serial']}" for radar in radars]
    except OSError as error:
        raise SpecError(f"--rig {rig}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise SpecError(f"--rig {rig}: no rig file with serial numbers: {error!r}") from None
    if not modules:  # tests of the emulator in their place would pass
        raise SpecError(f"--rig {rig}: no rig file with serial numbers: it names no radar")
    return modules


def _check_report(report: Path) -> None:
    """Reject a path where no file can be, before tests run whose numbers would be lost."""
    wrong = report if report.is_dir() else next((p for p in report.parents if p.is_file()), None)
    if wrong is not None:
        raise pytest.UsageError(f"--hil-json {report}: {wrong} is there already; name a new file")


def _found(specs: tuple[RadarArgument, ...]) -> tuple[RadarArgument, ...]:
    """Replace `auto` by the ports where modules answer."""
    if not any(spec.kind is RadarKind.AUTO for spec in specs):
        return specs
    from hil_tests.plugin.radar_targets import ports_that_answer

    texts: list[str] = []
    for spec in specs:
        if spec.kind is not RadarKind.AUTO:
            texts.append(spec.text)
            continue
        paths = [path for path, _ in ports_that_answer()]
        if not paths:
            raise SpecError("--radar auto: no module answers; 'xethru doctor' says why")
        query = spec.text.partition("?")[2]
        texts.extend(f"{path}?{query}" if query else path for path in paths)
    return parse_specs(texts)


def _check_workers(config: pytest.Config, specs: tuple[RadarArgument, ...]) -> None:
    """Reject `--dist each` if all workers would test the same real radar."""
    if not config.pluginmanager.hasplugin("xdist"):
        return
    shared = next((spec for spec in specs if not spec.emulated), None)
    if shared is not None and config.getoption("dist", "no") == "each":
        raise SpecError(
            f"--radar {shared.text}: with --dist each all workers want this radar at once; "
            "leave that out: its tests go to one worker"
        )
