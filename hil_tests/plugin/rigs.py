"""The modules of a rig file, found by their own serial numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from xethru_protocol.driver import X4M300

__all__ = ["matched"]


def matched(path: Path, drivers: Mapping[str, X4M300]) -> Mapping[str, X4M300]:
    """Return the drivers under the names of a rig file; the test fails if they are not its modules.

    Parameters
    ----------
    path
        Rig file of `uwb-slam calibrate --rig`: one ``[[radars]]`` table with name and serial each.
    drivers
        The radars there are, by the names of their specs.
    """
    from slam.app.errors import AppError
    from slam.app.rig_file import load_rig

    try:
        wanted = {radar.serial: radar.name for radar in load_rig(path).radars}
    except AppError as error:
        pytest.fail(str(error), pytrace=False)
    there = {name: driver.info().serial_number or "none told" for name, driver in drivers.items()}
    missing = {serial: name for serial, name in wanted.items() if serial not in there.values()}
    if missing:
        lost = ", ".join(f"{name} ({serial})" for serial, name in missing.items())
        others = ", ".join(f"{serial} at {name}" for name, serial in there.items())
        pytest.fail(f"{path}: missing {lost}; there are {others}", pytrace=False)
    strangers = [f"{serial} at {name}" for name, serial in there.items() if serial not in wanted]
    if strangers:
        pytest.fail(f"{path}: not of this rig: {', '.join(strangers)}", pytrace=False)
    return {wanted[serial]: drivers[name] for name, serial in there.items()}
