"""The data sets of `uwb-slam benchmark NAME`: readers of public formats, and how they are judged.

Importing this package loads nothing heavy: the module of a data set is imported when it is read.
"""

from __future__ import annotations

from collections.abc import Mapping

BENCHMARKS: Mapping[str, str] = {
    "mrclam": "robots among 15 cylinders, range and bearing by camera (MRCLAM_Dataset folders)",
    "victoria-park": "a car among trees, range and bearing by laser (inputs, measurements, "
    "gps.dat)",
    "plaza": "a robotic mower among four radio beacons, ranges only (*.pyfg)",
    "uwb-indoor": "a small robot among four UWB modules, ranges only (*_Input.txt, *_GT.txt)",
}
"""What each data set shows. Its module in this package, whose name has an underscore in place of a
hyphen, has a function ``read_data_set(folder)`` that returns a `DataSet`."""

IMAGE_BENCHMARKS: Mapping[str, str] = {
    "p440": "a PulsON 440 radar on a rail before corner reflectors, for images (p440_*.npz)",
}
"""The same of data for images; the module has a function ``run_trials``."""
