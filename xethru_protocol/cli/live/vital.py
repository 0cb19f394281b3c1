"""``xethru vital``: breathing and presence, as a line or as JSON."""

from __future__ import annotations

from argparse import Namespace
from typing import Any

from xethru_protocol.cli.live.analysis import VitalAnswer, VitalSignsAnalysis
from xethru_protocol.cli.live.sources import open_source
from xethru_protocol.cli.output import print_json, print_line, print_text, rewriting
from xethru_protocol.operating_system import STDOUT

_EVERY_S = 1.0


def vital(arguments: Namespace) -> int:
    """Print an answer for every second of frames."""
    rewrites = STDOUT.is_terminal and not arguments.json
    with open_source(arguments) as source:
        signs = VitalSignsAnalysis(source, arguments.window)
        next_s = 0.0
        try:
            for frame in source.frames:
                signs.take(frame)
                if frame.t_s < next_s:
                    continue
                next_s += _EVERY_S
                answer = signs.answer()
                if arguments.json:
                    print_json(_as_json(answer))
                elif rewrites:
                    print_text(rewriting(_line(answer), STDOUT.stream))
                else:
                    print_line(_line(answer))
        finally:
            if rewrites:
                STDOUT.write_soon("\n")
    return 1 if source.faults else 0


def _line(answer: VitalAnswer) -> str:
    return f"{answer.t_s:7.1f} s  {answer.text}"


def _as_json(answer: VitalAnswer) -> dict[str, Any]:
    found, there = answer.breathing, answer.presence
    return {
        "t_s": round(answer.t_s, 3),
        "rate_bpm": found.rate_bpm if found else None,
        "confidence": found.confidence if found else None,
        "distance_m": found.range_m if found else there and there.range_m,
        "present": there and there.present,
        "moving": there and there.moving,
        "no_answer": answer.no_answer or None,
    }
