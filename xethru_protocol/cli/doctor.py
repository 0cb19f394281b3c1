"""``xethru doctor``: what is wrong with the ports of this machine, and what to do about it."""

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

from xethru_protocol.cli.examination import Finding, Level, examine
from xethru_protocol.cli.machine_checks import MACHINE_CHECKS, Machine
from xethru_protocol.cli.output import one_line, print_json, print_line
from xethru_protocol.cli.patient import Patient
from xethru_protocol.cli.port_checks import PORT_CHECKS
from xethru_protocol.cli.profiles import profile_name
from xethru_protocol.cli.progress import counted
from xethru_protocol.errors import XeThruError
from xethru_protocol.ports import find_ports, run_directory

_WIDTH = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """What was found out about one subject: a port, or the machine."""

    subject: str
    about: str  # what it is, as far as known
    findings: tuple[Finding, ...]


def doctor(paths: Sequence[str], *, as_json: bool) -> int:
    """Examine the named ports, or all that can be found and the machine; 1 if there is a fault."""
    reports = []
    for report in _reports(paths):
        reports.append(report)
        if not as_json:  # at once: silent ports take seconds
            for line in _lines(report):
                print_line(line)
    faults = sum(f.level is Level.FAULT for report in reports for f in report.findings)
    if as_json:
        print_json({"ok": not faults, "reports": [_as_json(report) for report in reports]})
    else:
        print_line("all is well" if not faults else counted(faults, "fault"))
    return 1 if faults else 0


def _reports(paths: Sequence[str]) -> Iterator[Report]:
    found = {port.path: port for port in find_ports()}
    for path in dict.fromkeys(paths or found):
        known = found.get(path)
        yield _examine_port(path, known.description if known else "")
    if not paths:
        machine = Machine(ports=tuple(found), run_directory=run_directory())
        findings = tuple(examine(machine, MACHINE_CHECKS))
        yield Report(subject="this machine", about="", findings=findings)


def _examine_port(path: str, description: str) -> Report:
    with closing(Patient(path)) as patient:
        findings = tuple(examine(patient, PORT_CHECKS))
        about = description
        if findings[-1].check == PORT_CHECKS[-1].name:  # it was asked about itself
            about = ", ".join(filter(None, (description, _introduction(patient))))
        return Report(subject=path, about=about, findings=findings)


def _introduction(patient: Patient) -> str:
    try:
        info = patient.info
    except XeThruError:
        return ""
    profile = patient.profile_id
    parts = (
        info.order_code or info.firmware_id,
        f"serial {info.serial_number}" if info.serial_number else None,
        f"firmware {info.version}" if info.version else None,
        f"mode {info.mode}" if info.mode else None,
        f"profile {profile_name(profile)}" if profile else None,
    )
    return ", ".join(filter(None, parts))


def _as_json(report: Report) -> dict[str, Any]:
    return {
        "subject": report.subject,
        "about": report.about,
        "checks": [
            {
                "check": finding.check,
                "level": finding.level.value,
                "looks_at": finding.looks_at,
                "found": finding.found,
                "remedy": finding.remedy,
            }
            for finding in report.findings
        ],
    }


def _lines(report: Report) -> Iterator[str]:
    yield f"{one_line(report.subject)}{': ' if report.about else ''}{report.about}"
    well = sum(finding.level is Level.OK for finding in report.findings)
    if well:
        yield f"  ok     {counted(well, 'check')}"
    for finding in report.findings:
        if finding.level is not Level.OK:
            yield from _wrapped(f"  {finding.level.value:<6} ", one_line(finding.found))
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
