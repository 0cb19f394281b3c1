"""``xethru stream``: frames as JSON lines, or a live summary on a terminal."""

import sys
import time
from typing import Any

import numpy as np

from xethru_protocol.cli.output import is_terminal, print_json, print_text, warn
from xethru_protocol.cli.progress import counted, rewriting
from xethru_protocol.cli.session import module_at, say_warnings
from xethru_protocol.driver import X4M300, Frame, RawConfig

_REFRESH_NS = 200_000_000


def stream(
    port: str,
    baudrate: int,
    config: RawConfig,
    *,
    fps: float,
    count: int | None,
    with_samples: bool,
    as_json: bool,
) -> int:
    """Print frames until ``count``, a signal, or the reader's end; the module is stopped then."""
    with module_at(port, baudrate) as radar:
        radar.configure_raw(config)
        rate = radar.start(fps)
        say_warnings(radar)
        live = None if as_json or with_samples or not is_terminal(sys.stdout) else _Live(radar)
        try:
            for frame in radar.frames(count, timeout_s=max(2.0, 3.0 / rate)):
                if live is None:
                    print_json(_as_json(frame, with_samples))
                else:
                    live.show(frame)
        finally:
            if live is not None:
                live.finish()
    return 0


def _as_json(frame: Frame, with_samples: bool) -> dict[str, Any]:
    shown: dict[str, Any] = {
        "counter": frame.counter,
        "t_ns": frame.arrival_ns,
        "bins": frame.geometry.n_bins,
        "range_start_m": frame.geometry.range_start_m,
        "bin_length_m": frame.geometry.bin_length_m,
    }
    if with_samples and frame.geometry.downconversion:
        shown |= {"i": frame.samples.real.tolist(), "q": frame.samples.imag.tolist()}
    elif with_samples:
        shown["samples"] = frame.samples.tolist()
    return shown


class _Live:
    """One line that is rewritten."""

    def __init__(self, radar: X4M300) -> None:
        self._radar = radar
        self._shown_ns = 0
        self._frames = 0
        self._newest: Frame | None = None
        self._began_ns = 0  # arrival of the first

    def show(self, frame: Frame) -> None:
        """Count a frame, and say so a few times a second."""
        if self._newest is None:
            self._began_ns = time.monotonic_ns()
        self._frames += 1
        self._newest = frame
        now_ns = time.monotonic_ns()
        if now_ns - self._shown_ns >= _REFRESH_NS:
            self._shown_ns = now_ns
            self._write(frame, now_ns)

    def finish(self) -> None:
        """Bring the line up to date and leave it."""
        if self._newest is not None:
            self._write(self._newest, time.monotonic_ns())
        warn("")

    def _write(self, frame: Frame, now_ns: int) -> None:
        geometry = frame.geometry
        strongest = int(np.argmax(np.abs(frame.samples)))
        span_s = (now_ns - self._began_ns) * 1e-9
        rate = f"{(self._frames - 1) / span_s:.1f}" if self._frames > 1 else "-"
        line = (
            f"{counted(self._frames, 'frame')}, {rate}/s, {geometry.n_bins} bins, "
            f"strongest at {geometry.range_start_m + strongest * geometry.bin_length_m:.3f} m, "
            f"{self._radar.frames_lost} lost"
        )
        print_text(rewriting(line, sys.stdout))
