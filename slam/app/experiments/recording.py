"""A real recording of a standing module beside emulated frames of an equivalent scene.

Light, so that ``--help`` is; the work is in ``slow_time``, ``recorded_room`` and
``recording_picture``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from slam.app.arguments import count, seed
from slam.app.stop import StopFlag

NAME = "recording"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the recording, the first seed and the number of emulated runs."""
    parser.add_argument(
        "--recording",
        type=Path,
        required=True,
        metavar="DIR",
        help="recording of a standing module's baseband frames, in any format `xethru dump` reads",
    )
    parser.add_argument("--radar", metavar="NAME", help="which radar of a recording of several")
    parser.add_argument(
        "--seed", type=seed, default=0, help="seed of the run drawn in full (default: %(default)s)"
    )
    parser.add_argument(
        "--runs",
        type=count,
        default=20,
        help="emulated runs, with seeds from there on (default: %(default)s)",
    )


def run(arguments: argparse.Namespace, stop: StopFlag) -> None:
    """Emulate the recording's scene through a module and its driver, and compare the spectra."""
    # heavy, see module text
    from slam.app.experiments.recorded_room import emulate, equivalent_scene, read_slow_time
    from slam.app.experiments.recording_picture import draw_recording
    from slam.app.experiments.results import print_table, write_json
    from slam.app.experiments.slow_time import TITLES, spread_of

    recorded = read_slow_time(arguments.recording, arguments.radar)
    scene = equivalent_scene(recorded)
    emulated = []
    for one in range(arguments.seed, arguments.seed + arguments.runs):
        stop.check()
        emulated.append(emulate(scene, recorded, one))
    figures = recorded.numbers()
    quiet = recorded.quietest().numbers()
    spread = {name: spread_of([run.numbers()[name] for run in emulated]) for name in TITLES}
    write_json(
        arguments.out / f"{NAME}.json",
        {
            "recording": str(arguments.recording),
            "frames": len(recorded.iq),
            "rate_hz": recorded.rate_hz,
            "seed": arguments.seed,
            "runs": arguments.runs,
            "recorded": dict(figures),
            "recorded_quietest": dict(quiet),
            "emulated": {
                name: {"p10": low, "median": middle, "p90": high}
                for name, (low, middle, high) in spread.items()
            },
        },
    )
    draw_recording(arguments.out / f"{NAME}.png", recorded, emulated)
    print_table(
        f"{len(recorded.iq)} recorded frames at {recorded.rate_hz:.2f} Hz, and {arguments.runs} "
        f"emulated runs of as many, seeds from {arguments.seed}",
        ("", "recorded", "emulated: median", "10 ... 90 %", "recorded, quietest 128"),
        [
            (
                title,
                _three_digits(figures[name]),
                _three_digits(spread[name][1]),
                f"{_three_digits(spread[name][0])} ... {_three_digits(spread[name][2])}",
                _three_digits(quiet[name]),
            )
            for name, title in TITLES.items()
        ],
    )


def _three_digits(value: float) -> str:
    return f"{value:.3f}" if value >= 0.1 else f"{value:.2e}"
