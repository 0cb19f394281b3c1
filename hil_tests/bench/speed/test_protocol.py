"""Speed of receiver, encoder and lattice check: ``make bench``. Bars: design, quality bars.

Numbers are reported, never asserted: a timed test fails for the wrong reasons.
"""

import ctypes
import os
import shutil
import statistics
import subprocess
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from xethru_protocol.driver.frames import Lattice
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NEED_DATA, Framing

FRAMES = 2000
CHUNK = 65536


def quantised_noise() -> NDArray[np.float32]:
    """Quantised noise at the vendor's working point, shape (200, 1431)."""
    counters = np.random.default_rng(0).integers(0, 729_600, (200, 1431))
    return counters.astype(np.float32) * np.float32(2.03450526e-07) - np.float32(0.07421875)


def stream_of_frames(framing: Framing) -> bytes:
    samples = quantised_noise()
    module = Connection(Role.MODULE)
    return b"".join(
        module.send(m.DataFloat(info=k, values=samples[k]), framing) for k in range(200)
    ) * (FRAMES // 200)


def decode(chunks: Iterable[bytes]) -> int:
    connection = Connection(Role.HOST)
    events = 0
    for chunk in chunks:
        connection.receive_data(chunk)
        while connection.next_event() is not NEED_DATA:
            events += 1
    return events


def in_chunks(stream: bytes) -> list[bytes]:
    return [stream[begin : begin + CHUNK] for begin in range(0, len(stream), CHUNK)]


@pytest.mark.parametrize("framing", Framing)
def test_decode_1431_float_frames(benchmark: Any, framing: Framing) -> None:  # noqa: ANN401 - the plugin has no types
    chunks = in_chunks(stream_of_frames(framing))
    assert benchmark(decode, chunks) == FRAMES
    benchmark.extra_info["frames"] = FRAMES


ESCAPES = {
    "doubled starts": b"\x7d",
    "escaped starts": b"\x7f\x7d",
    "starts and escaped starts": b"\x7d\x7f\x7d\x7f\x7d",
    "bad packets of escaped starts": b"\x7d" + b"\x7f\x7d" * 2000 + b"\x01\x7e",
    "escaped starts without end": b"\x7d" + b"\x7f\x7d" * 9000 + b"\x01",
    "escaped packets": b"\x7d" + b"\x7f\x7f" * 7998 + b"\x7f\x7d\x7e",
}


@pytest.mark.parametrize("name", ESCAPES)
@pytest.mark.benchmark(group="1 MB of escapes (bar: 200 ms)")
def test_decode_pathological_escapes(benchmark: Any, name: str) -> None:  # noqa: ANN401 - the plugin has no types
    pattern = ESCAPES[name]
    chunks = in_chunks((pattern * (1_000_000 // len(pattern) + 1))[:1_000_000])
    benchmark(decode, chunks)


VENDOR_FOLDER = "XETHRU_VENDOR_MCP"
"""Names the folder of the vendor's C sources, ``src/mcp`` of MCP Wrapper 1.3.1."""
_HARNESS = """
#include "protocol.h"
#include "protocol_host_parser.h"
#include <stdlib.h>
static HostParser parser;
static unsigned long frames;
static void on_frame(FloatData data, void *user) { (void)user; frames += data.length == 1431; }
static void on_packet(void *user, const unsigned char *bytes, unsigned int length)
{ parse(&parser, bytes, length, user); }
static void on_error(void *user, unsigned int code) { (void)user; (void)code; }
unsigned long decode(const unsigned char *data, unsigned long size, unsigned int chunk)
{
    static unsigned char buffer[65536];
    void *memory = malloc(getInstanceSize());
    init_host_parser(&parser);
    parser.data_float = on_frame;
    frames = 0;
    xtProtocol *line =
        createApplicationProtocol(on_packet, on_error, 0, memory, buffer, sizeof buffer);
    for (unsigned long at = 0; at < size; at += chunk)
        parseData(line, data + at, size - at < chunk ? size - at : chunk);
    free(memory);
    return frames;
}
"""


@pytest.fixture(scope="module")
def vendor_decode(tmp_path_factory: pytest.TempPathFactory) -> Callable[[bytes], int]:
    """Build the vendor's parser outside the tree; return what counts the frames of a stream."""
    folder = os.environ.get(VENDOR_FOLDER)
    if not folder:
        pytest.skip(f"{VENDOR_FOLDER} does not name a folder of the vendor's C parser")
    sources = [Path(folder) / name for name in ("protocol.c", "protocol_host_parser.c")]
    missing = [os.fspath(source) for source in sources if not source.is_file()]
    if missing:
        pytest.skip(f"{VENDOR_FOLDER}: no such file: {', '.join(missing)}")
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler (cc, gcc)")
    place = tmp_path_factory.mktemp("vendor")
    harness, library = place / "harness.c", place / "parser.so"
    harness.write_text(_HARNESS)
    options = ["-O2", "-w", "-shared", "-fPIC", "-I", folder, "-o", os.fspath(library)]
    command = [compiler, *options, *map(os.fspath, (harness, *sources))]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    if built.returncode:
        pytest.skip(f"the vendor's C parser was not compiled: {built.stderr.strip()[-300:]}")
    run = ctypes.CDLL(os.fspath(library)).decode
    run.argtypes = [ctypes.c_char_p, ctypes.c_ulong, ctypes.c_uint]
    run.restype = ctypes.c_ulong
    return lambda stream: int(run(stream, len(stream), CHUNK))


@pytest.mark.parametrize("framing", Framing)
def test_decode_beside_the_vendors_parser(
    benchmark: Any,  # noqa: ANN401 - the plugin has no types
    framing: Framing,
    vendor_decode: Callable[[bytes], int],
) -> None:
    """Bar: twice the frames of the vendor's parser (-O2), both on one core, taking turns."""
    stream = stream_of_frames(framing)
    chunks = in_chunks(stream)
    vendor_s: list[float] = []

    def vendors_turn() -> tuple[tuple[list[bytes]], dict[str, object]]:
        began_s = time.perf_counter()
        assert vendor_decode(stream) == FRAMES
        vendor_s.append(time.perf_counter() - began_s)
        return (chunks,), {}

    assert benchmark.pedantic(decode, setup=vendors_turn, rounds=25) == FRAMES
    benchmark.extra_info["frames"] = FRAMES
    benchmark.extra_info["ratio"] = statistics.median(vendor_s) / benchmark.stats.stats.median
    benchmark.extra_info["beside"] = "the vendor's C parser"


@pytest.mark.parametrize("framing", Framing)
def test_encode_1431_float_frames(benchmark: Any, framing: Framing) -> None:  # noqa: ANN401 - the plugin has no types
    """What an emulated module does with each frame."""
    module = Connection(Role.MODULE)
    frames = [m.DataFloat(info=k, values=values) for k, values in enumerate(quantised_noise())]

    def encode() -> int:
        return sum(len(module.send(frame, framing)) for frame in frames)

    assert benchmark(encode) >= 200 * 5747
    benchmark.extra_info["frames"] = 200


def test_lattice_of_1431_float_frames(benchmark: Any) -> None:  # noqa: ANN401 - the plugin has no types
    """What a driver may spend on each frame to see that no sample was damaged."""
    lattice = Lattice.of(
        iterations=16,
        pulses_per_step=300,
        dac_min=949,
        dac_max=1100,
        dac_step=0,
        downconversion=False,
        tx_center_frequency=3,
    )
    samples = quantised_noise()
    assert benchmark(lambda: sum(lattice.off_lattice(values) for values in samples)) == 0
    benchmark.extra_info["frames"] = 200


def test_encode_commands(benchmark: Any) -> None:  # noqa: ANN401 - the plugin has no types
    host = Connection(Role.HOST)
    command = m.X4DriverSet(setting=X4Setting.FRAMEAREA, value=(0.2, 9.4))
    assert benchmark(host.send, command)
