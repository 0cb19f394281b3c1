"""`uwb-slam convert`: sessions from and to the files of others."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from slam.app import rosbag_layout as layout
from slam.app.errors import AppError, UsageError
from slam.app.rig_file import load_rig
from slam.app.rosbag_read import BagOptions, convert_bag
from slam.app.rosbag_write import write_bag
from slam.app.session_head import settings_text
from slam.app.session_reader import open_session
from slam.geometry import Rig
from slam.presets import ConfigError, load_preset
from slam.robust.parameters import WheelNoise

SESSION_SUFFIX = ".mcap"


@dataclass(frozen=True, slots=True, kw_only=True)
class ConvertOptions:
    """What the command line of `uwb-slam convert` says."""

    source: Path
    out: Path
    rig: Path | None
    area_m: tuple[float, float] | None
    truth_topic: str
    preset: str


def run_convert(options: ConvertOptions, check: Callable[[], None]) -> None:
    """Convert a session to a bag, or a bag to a session; the names say which.

    Raises
    ------
    AppError
        One line; what was begun is removed.
    """
    if options.out.exists():
        raise AppError(f"{options.out}: exists; choose another name")
    if options.source.suffix == SESSION_SUFFIX and options.out.suffix != SESSION_SUFFIX:
        _say(write_bag(open_session(options.source), options.out, check))
        return
    if options.out.suffix != SESSION_SUFFIX:
        raise UsageError(
            f"{options.out}: of a bag a session is made; give a name that ends in .mcap"
        )
    try:
        said, odd = convert_bag(options.source, options.out, _bag_options(options), check)
    except BaseException:
        options.out.unlink(missing_ok=True)
        raise
    for line in odd:
        print(f"uwb-slam: {options.source}: {line}", file=sys.stderr)  # noqa: T201 - a command line speaks
    _say(said)


def _bag_options(options: ConvertOptions) -> BagOptions:
    try:
        config = load_preset(options.preset)
    except ConfigError as error:
        raise UsageError(str(error)) from None
    return BagOptions(
        rig=layout.AUTHORS_RIG if options.rig is None else _rig(options.rig),
        area_m=options.area_m,
        truth_topic=options.truth_topic,
        preset=options.preset,
        config_json=settings_text(config),
        wheels=asdict(WheelNoise()),
    )


def _rig(path: Path) -> Rig:
    return load_rig(path).rig


def _say(line: str) -> None:
    print(line)  # noqa: T201 - the result
