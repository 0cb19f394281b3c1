"""`xethru-emulator` as a process of its own, for tests that go through real ports."""

import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from emulator import running
from hil_tests.patience import patient_ns, seconds
from xethru_protocol.driver.radar import X4M300

END_LIMIT_S = seconds(10)


@dataclass(frozen=True, slots=True, kw_only=True)
class Served:
    process: subprocess.Popen[str]
    names: tuple[str, ...]
    paths: tuple[str, ...]
    serials: tuple[str, ...]
    odometry: str | None
    scene_time_zero_ns: int
    control: str | None
    tcp_ports: tuple[int | None, ...]

    def end(self, number: signal.Signals = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        return self.process.wait(END_LIMIT_S)


def open_radar(path: str, reconnect_s: float = 0.0) -> X4M300:
    """Return a driver on a port, which waits for answers as long as a busy machine takes."""
    return X4M300.open(path, clock=patient_ns, reconnect_s=reconnect_s)


@contextmanager
def emulator(*arguments: str | Path) -> Iterator[Served]:
    """Run ``xethru-emulator`` until the block ends; stderr goes to the test's."""
    with running(*arguments) as (process, ready):
        assert ready["ready"] is True
        devices = ready["devices"]
        yield Served(
            process=process,
            names=tuple(device["name"] for device in devices),
            paths=tuple(device["path"] for device in devices),
            serials=tuple(device["serial"] for device in devices),
            odometry=ready["odometry"],
            scene_time_zero_ns=ready["scene_time_zero_ns"],
            control=ready["control"],
            tcp_ports=tuple(device["tcp"] for device in devices),
        )
