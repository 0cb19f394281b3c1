"""All radars of one emulator with their faults: what serves them needs this and no more."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path

from emulator.control import Control
from emulator.control_socket import ControlSocket
from emulator.faults.faulty_device import FaultyDevice, wrap
from emulator.faults.inner_device import InnerDevice
from emulator.faults.plan import FaultPlan, FaultPlanError
from emulator.faults.truth import TruthLog
from emulator.link import LinkError
from emulator.player import PlayStream

__all__ = ["FaultBench"]


class FaultBench:
    """Wraps radars, writes one truth log, offers one control socket.

    Parameters
    ----------
    plan
        None: no faults until somebody asks for some.
    truth
        File of the truth log, made anew; None: kept in memory only.
    cleanup
        Closes what was opened.
    zero_ns
        Device time from which the scenario counts.

    Raises
    ------
    LinkError
        When the truth log cannot be written.
    """

    def __init__(
        self,
        plan: FaultPlan | None,
        truth: Path | None,
        cleanup: contextlib.ExitStack,
        *,
        zero_ns: int,
    ) -> None:
        self._plan = FaultPlan() if plan is None else plan
        self._zero_ns = zero_ns
        self._cleanup = cleanup
        self.devices: dict[str, FaultyDevice] = {}
        self.truth = TruthLog()
        if truth is not None:
            try:
                # by lines: whoever follows the file sees a fault when it is injected
                stream = cleanup.enter_context(truth.open("w", buffering=1, encoding="utf-8"))
            except OSError as error:
                raise LinkError(f"{truth}: cannot write the truth log: {error.strerror}") from error
            self.truth = TruthLog(stream.write)

    def wrap(self, device: InnerDevice, name: str) -> FaultyDevice:
        """Return a device with the faults of the plan."""
        faulty = wrap(device, name, self._plan, self.truth, zero_ns=self._zero_ns)
        self.devices[name] = faulty
        return faulty

    def check_names(self) -> None:
        """Raise `FaultPlanError` if the plan names a radar that is not there."""
        for index, spec in enumerate(self._plan.fault):
            for name in spec.radar:
                if name not in self.devices:
                    raise FaultPlanError(
                        f"fault[{index}].radar: no radar is called {name!r}; "
                        f"there are {', '.join(self.devices)}"
                    )

    def control(self, path: Path, players: Mapping[str, PlayStream] | None = None) -> ControlSocket:
        """Open the control socket; `LinkError` if it cannot be had."""
        offered = ControlSocket(path, Control(self.devices, players))
        self._cleanup.callback(offered.close)
        return offered
