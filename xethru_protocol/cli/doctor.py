"""``xethru doctor``: what is wrong with the ports of this machine, and what to do about it.

To add a check, add a function where its turn is: it returns what is wrong, None if nothing is. A
port that another program has open must not be touched, so whatever opens the port comes after the
checks that look for such programs.
"""

import os
import textwrap
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from xethru_protocol.cli.output import counted, print_json, print_line, profile_name
from xethru_protocol.cli.port_probe import (
    Check,
    Finding,
    Level,
    PortProbe,
    run_checks,
)
from xethru_protocol.operating_system import one_line
from xethru_protocol.transport import find_ports, is_private, run_directory
from xethru_protocol.wire.codes import POWER_UP_BAUD, PongCode, ProfileId, SensorMode
from xethru_protocol.wire.errors import XeThruError
from xethru_protocol.wire.messages import Ping
from xethru_protocol.wire.versions import FirmwareVersions, lacking


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """A computer: ports found, and the folder in which running emulators are registered."""

    ports: tuple[str, ...]
    run_directory: Path


MACHINE_CHECKS: list[Check[Machine]] = []
PORT_CHECKS: list[Check[PortProbe]] = []
_machine_check = partial(Check, MACHINE_CHECKS)
_port_check = partial(Check, PORT_CHECKS)
_ending_port_check = partial(Check, PORT_CHECKS, ends=True)
_local_port_check = partial(Check, PORT_CHECKS, ends=True, network=False)
_network_port_check = partial(Check, PORT_CHECKS, ends=True, network=True)

_FEW = 4
_POWER_CYCLE = "take the module's power away for some seconds"


@_machine_check(
    "modules found",
    looks_at="USB ids, and the run directory of emulators",
    remedy="plug one in, run xethru-emulator serve --bare, or name a port with --port",
)
def _no_module(machine: Machine) -> str | None:
    if machine.ports:
        return None
    return "no module was found: none on USB, no emulator is running"


@_machine_check(
    "run directory private",
    looks_at="owner and permissions of the run directory",
    remedy="if it is yours: chmod go-w {run_directory}; else set XDG_RUNTIME_DIR to a folder of "
    "your own, for emulators and for xethru",
)
def _not_private(machine: Machine) -> str | None:
    folder = machine.run_directory
    if is_private(folder) or not os.path.lexists(folder):
        return None
    return f"{folder} is not this user's alone: its list of emulators is ignored"


@_local_port_check(
    "link leads to a port",
    looks_at="what the path links to",
    remedy="start the emulator again, or remove the link: rm {path}",
)
def _stale_link(probe: PortProbe) -> str | None:
    if os.path.islink(probe.path) and not os.path.exists(probe.path):
        return f"it is a link to {probe.target}, which is gone: its emulator has died"
    return None


@_local_port_check(
    "port exists",
    looks_at="the path",
    remedy="plug the module in; 'xethru list' shows the ports there are",
)
def _missing(probe: PortProbe) -> str | None:
    return None if os.path.exists(probe.path) else "there is no such port"


@_local_port_check(
    "is a serial port",
    looks_at="what kind of file the path is, and its driver",
    remedy="name the module's port, such as /dev/ttyACM0; 'xethru list' shows them",
)
def _no_port(probe: PortProbe) -> str | None:
    return None if probe.is_serial_port else "it is not a serial port"


@_local_port_check(
    "group has rights",
    looks_at="permissions of the device",
    remedy="its group may not open it either: add a udev rule, or run sudo chmod 660 {target}",
)
def _no_rights_for_the_group(probe: PortProbe) -> str | None:
    joining_helps = os.stat(probe.path).st_mode & 0o060 == 0o060
    return None if joining_helps else _no_rights(probe)


@_local_port_check(
    "user has rights",
    looks_at="permissions of the device",
    remedy="join the group with sudo usermod -aG {group} {user}, then log in again",
)
def _no_rights(probe: PortProbe) -> str | None:
    if os.access(probe.path, os.R_OK | os.W_OK):
        return None
    return f"user {probe.user} may not open it; it belongs to group {probe.group}"


@_local_port_check(
    "no two readers",
    looks_at="open files of all programs (/proc)",
    remedy="end all of them but one",
)
def _shared(probe: PortProbe) -> str | None:
    if len(probe.users) < 2:
        return None
    names = " and ".join(probe.users[:_FEW])
    if len(probe.users) > _FEW:
        names += f" and {len(probe.users) - _FEW} more"
    return f"{names} have it open at once: each gets only a part of what the module sends"


@_local_port_check(
    "nobody else has it open",
    looks_at="open files of all programs (/proc)",
    remedy="end that program; the port was left alone, so nothing else is known",
)
def _in_use(probe: PortProbe) -> str | None:
    return f"{probe.users[0]} has it open" if probe.users else None


@_local_port_check(
    "can be opened",
    looks_at="the answer of the system",
    remedy="if a program of another user has it, sudo xethru doctor --port {path} names it",
)
def _cannot_open(probe: PortProbe) -> str | None:
    return probe.refusal


@_network_port_check(
    "can be reached",
    looks_at="the answer of the network",
    remedy="check host and port number; tcp:// passes bytes as they are, rfc2217:// sets the rate",
)
def _cannot_reach(probe: PortProbe) -> str | None:
    return probe.refusal


@_network_port_check(
    "stays reachable",
    looks_at="the line while PING is sent",
    remedy="end what else is connected: an adapter has one client at a time; else check its cable",
)
def _hung_up(probe: PortProbe) -> str | None:
    return "the other side hung up while the module was checked" if probe.contact.gone else None


@_local_port_check(
    "stays connected",
    looks_at="the line while PING is sent",
    remedy="check plug and cable; a module that has just restarted needs ten seconds",
)
def _gone(probe: PortProbe) -> str | None:
    return "it went away while the module was checked" if probe.contact.gone else None


@_ending_port_check(
    "not in the bootloader",
    looks_at="the answer to a command only the bootloader knows",
    remedy=f"{_POWER_CYCLE}; if it stays there, an update was not finished: "
    "xethru flash IMAGE --port {path} writes its firmware anew",
)
def _bootloader(probe: PortProbe) -> str | None:
    if not probe.contact.bootloader:
        return None
    return "the module is in its bootloader; more than 15 faults in a row bring it there, too"


@_ending_port_check(
    "speaks XeThru",
    looks_at="what comes after PING",
    remedy="is it another device? If it is a module, " + _POWER_CYCLE,
)
def _no_packets(probe: PortProbe) -> str | None:
    contact = probe.contact
    if contact.pong is None and contact.damaged and not contact.talks:
        return "it sends bytes, but no XeThru packets, and answers at none of the known rates"
    return None


@_ending_port_check(
    "listens",
    looks_at="what comes after PING",
    remedy="if frames fill a UART (115200 baud carry 2 a second of 1431 bins), stop what asks for "
    f"them and wait half a minute; else check the line from host to module, or {_POWER_CYCLE}",
)
def _no_answer(probe: PortProbe) -> str | None:
    contact = probe.contact
    if contact.pong is None and contact.talks:
        return "the module sends messages, but does not answer"
    return None


@_ending_port_check(
    "answers",
    looks_at="the answer to PING, at all rates on a UART",
    remedy="is a module there, and powered? One that has just restarted needs ten seconds; "
    f"if it stays silent, {_POWER_CYCLE}",
)
def _silent(probe: PortProbe) -> str | None:
    return "nothing answers" if probe.contact.pong is None else None


@_ending_port_check(
    "no echo",
    looks_at="the answer to PING",
    remedy="connect the port to a module",
)
def _echo(probe: PortProbe) -> str | None:
    if probe.contact.pong == Ping().seed:
        return "it sends back what it gets, like a cable whose ends are joined"
    return None


@_ending_port_check(
    "is a module",
    looks_at="the answer to PING",
    remedy="is it another device? 'xethru list' shows the ports there are",
)
def _unknown_device(probe: PortProbe) -> str | None:
    pong = probe.contact.pong
    if pong in set(PongCode):
        return None
    return f"it answers PING with 0x{pong:08X}, as no XeThru module does"


@_port_check(
    "usual baud rate",
    looks_at="the rate at which PING was answered",
    remedy=f"{_POWER_CYCLE} (the rate is not stored), or give "
    "--baudrate {contact.baudrate} to the other commands",
)
def _other_rate(probe: PortProbe) -> str | None:
    rate = probe.contact.baudrate
    if rate == POWER_UP_BAUD:
        return None
    return f"it answers at {rate} baud, not at {POWER_UP_BAUD}"


@_ending_port_check(
    "ready",
    looks_at="the answer to PING",
    remedy="wait ten seconds; if this stays, xethru reset --port {path}",
)
def _not_ready(probe: PortProbe) -> str | None:
    if probe.contact.pong == PongCode.XTS_SPRP_NOTREADY:
        return "the module reports that it is not ready yet"
    return None


@_ending_port_check(
    "not in safe mode",
    looks_at="the answer to PING",
    remedy=f"xethru reset --port {{path}}, or {_POWER_CYCLE}",
)
def _safe_mode(probe: PortProbe) -> str | None:
    if probe.contact.pong == PongCode.XTS_SPRP_SAFEMODE:
        return "it is in safe mode: ten faults in a row made it start without its profiles"
    return None


@_port_check(
    "is an X4M300",
    looks_at="order code and firmware id",
    remedy="raw frames work alike; presence needs an X4M300 with its sensor firmware",
    level=Level.NOTE,
)
def _other_product(probe: PortProbe) -> str | None:
    if probe.is_bare_xep:
        name = probe.info.firmware_id or "XEP"
        return f"bare {name} firmware, as on an X4M03 or X4M05: raw frames, no profiles"
    code = probe.info.order_code
    return None if code == "X4M300" else f"it is an {code}, not an X4M300"


@_port_check(
    "firmware",
    looks_at="the version list",
    remedy="write the newest firmware (1.6.8; bare XEP: 3.4.8) "
    "with xethru flash or the vendor's tool",
)
def _stale_firmware(probe: PortProbe) -> str | None:
    version = probe.info.version
    firmware = (
        FirmwareVersions(xep=version) if probe.is_bare_xep else FirmwareVersions(sensor=version)
    )
    if probe.info.version_list is not None:
        firmware = FirmwareVersions.of_list(probe.info.version_list)
    rows = lacking(firmware)
    faults = [f"{row.topic}: {row.before}" for row in rows if row.is_fault]
    absent = [row.topic for row in rows if row.commands]
    if not faults and not absent:
        return None
    parts = [f"has faults ({'; '.join(faults)})"] * bool(faults)
    parts += [f"lacks {'; '.join(absent)}"] * bool(absent)
    return f"{firmware.name} " + " and ".join(parts)


@_port_check(
    "right profile",
    looks_at="GET_PROFILEID",
    remedy="a program that wants presence must load PRESENCE_2; raw radar needs no profile",
)
def _wrong_profile(probe: PortProbe) -> str | None:
    if probe.info.order_code != "X4M300":  # another product has profiles of its own
        return None
    loaded = probe.profile_id
    if loaded is None or loaded in (ProfileId.XTS_ID_APP_NONE, ProfileId.XTS_ID_APP_PRESENCE_2):
        return None
    return f"profile {profile_name(loaded)} is loaded, not PRESENCE_2, the X4M300's own"


@_port_check(
    "transmitter on",
    looks_at="TXPOWER, if no profile runs",
    remedy="xethru reset --port {path}; check the antenna side if it happens again",
)
def _transmitter_off(probe: PortProbe) -> str | None:
    # asking the chip would disturb a running profile
    if probe.info.mode not in (None, SensorMode.XTID_SM_MANUAL.label) or probe.tx_power != 0:
        return None
    return "the transmitter is off; the module does that itself after 100 frames of zeros"


_WIDTH = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """What was found out about a port or the machine, ``about`` what it is as far as known."""

    subject: str
    about: str
    checks: tuple[Finding, ...]


def doctor(arguments: Namespace) -> int:
    """Check the named ports, or all that can be found and the machine; 1 if there is a fault."""
    reports = []
    for report in _reports(arguments.port):
        reports.append(report)
        if not arguments.json:  # at once: silent ports take seconds
            for line in _lines(report):
                print_line(line)
    faults = sum(f.level is Level.FAULT for report in reports for f in report.checks)
    if arguments.json:
        print_json({"ok": not faults, "reports": [asdict(report) for report in reports]})
    else:
        print_line("all is well" if not faults else counted(faults, "fault"))
    return 1 if faults else 0


def _reports(paths: Sequence[str]) -> Iterator[Report]:
    found = {port.path: port for port in find_ports()}
    for path in dict.fromkeys(paths or found):
        known = found.get(path)
        yield _check_port(path, known.description if known else "")
    if not paths:
        machine = Machine(ports=tuple(found), run_directory=run_directory())
        findings = tuple(run_checks(machine, MACHINE_CHECKS))
        yield Report(subject="this machine", about="", checks=findings)


def _check_port(path: str, description: str) -> Report:
    with closing(PortProbe(path)) as probe:
        checks = [row for row in PORT_CHECKS if row.network in (None, probe.is_network)]
        findings = tuple(run_checks(probe, checks))
        about = description
        if findings[-1].check == PORT_CHECKS[-1].name:  # it was asked about itself
            about = ", ".join(filter(None, (description, _introduction(probe))))
        return Report(subject=path, about=about, checks=findings)


def _introduction(probe: PortProbe) -> str:
    try:
        info, profile = probe.info, probe.profile_id
    except XeThruError:
        return ""
    parts = (
        info.order_code or info.firmware_id,
        f"serial {info.serial_number}" if info.serial_number else None,
        f"firmware {info.version}" if info.version else None,
        f"mode {info.mode}" if info.mode else None,
        f"profile {profile_name(profile)}" if profile else None,
    )
    return ", ".join(filter(None, parts))


def _lines(report: Report) -> Iterator[str]:
    yield f"{report.subject}{': ' if report.about else ''}{report.about}"
    well = sum(finding.level is Level.OK for finding in report.checks)
    if well:
        yield f"  ok     {counted(well, 'check')}"
    for finding in report.checks:
        if finding.level is not Level.OK:
            yield from _wrapped(f"  {finding.level:<6} ", one_line(finding.found))
            yield from _wrapped("      -> ", one_line(finding.remedy))
    yield ""


def _wrapped(label: str, text: str) -> list[str]:
    return textwrap.wrap(
        text,
        _WIDTH,
        initial_indent=label,
        subsequent_indent=" " * len(label),
        break_long_words=False,
        break_on_hyphens=False,
    )
