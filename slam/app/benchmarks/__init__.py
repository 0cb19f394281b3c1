"""The data sets of `uwb-slam benchmark NAME`: readers of public formats, and how they are judged.

Importing this package loads nothing heavy: the module of a data set is imported when it is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Benchmark:
    """What a data set shows in a line, and the module of this package that reads it.

    ``read_data_set(folder)`` of that module returns a `DataSet`.
    """

    help: str
    module: str


BENCHMARKS: Mapping[str, Benchmark] = {
    "mrclam": Benchmark(
        help="robots among 15 cylinders, range and bearing by camera (MRCLAM_Dataset folders)",
        module="mrclam",
    ),
    "victoria-park": Benchmark(
        help="a car among trees, range and bearing by laser (inputs, measurements, gps.dat)",
        module="victoria_park",
    ),
    "plaza": Benchmark(
        help="a robotic mower among four radio beacons, ranges only (*.pyfg)",
        module="pyfg",
    ),
    "uwb-indoor": Benchmark(
        help="a small robot among four UWB modules, ranges only (*_Input.txt, *_GT.txt)",
        module="librsf",
    ),
}
