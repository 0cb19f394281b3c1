"""The binary data files of ModuleConnector: one row per data type.

A data file holds records without separators: a message's payload without its leading codes
(Protocol reference 12). Data type bits: [OBS] seen in recordings of known content; [HDR] taken
from the public header of the vendor's library, no sample at hand. File names: [FMT] Protocol
reference 12, [OBS] seen. The kinds that are text stand in ``csv_kinds``.
"""

from dataclasses import dataclass

import numpy as np

from xethru_protocol.codes import AppDataId, ElementType, ResponseCode


@dataclass(frozen=True, slots=True)
class Layout:
    """One kind of binary data file.

    Attributes
    ----------
    file_prefix
        What its file names begin with; a local time stamp and ``.dat`` follow.
    data_type
        Its bit in the meta file.
    prefix
        What the payload has and the record has not.
    header
        Fields before the elements, as a packed numpy type.
    count
        Name of the header field that counts the elements.
    columns
        Values per element: 2 where all of one column come before all of the other.
    values
        numpy type of one value.
    """

    file_prefix: str
    data_type: int
    prefix: bytes
    header: np.dtype[np.void]
    count: str
    columns: int
    values: str

    @property
    def element_bytes(self) -> int:
        """Bytes per element."""
        return self.columns * np.dtype(self.values).itemsize

    def record_size(self, header: bytes) -> int:
        """Bytes of the record that begins with ``header``."""
        count = int(np.frombuffer(header, self.header, 1)[self.count][0])
        return self.header.itemsize + count * self.element_bytes


def _appdata(content: AppDataId) -> bytes:
    return bytes((ResponseCode.XTS_SPR_APPDATA, *content.to_bytes(4, "little")))


_DATA_HEADER = np.dtype([("content_id", "<u4"), ("info", "<u4"), ("length", "<u4")])
_BASEBAND_HEADER = np.dtype(
    [
        ("counter", "<u4"),
        ("num_bins", "<u4"),
        ("bin_length_m", "<f4"),
        ("sampling_frequency_hz", "<f4"),
        ("carrier_frequency_hz", "<f4"),
        ("range_offset_m", "<f4"),
    ]
)
_MATRIX_HEAD = [
    ("counter", "<u4"),
    ("matrix_counter", "<u4"),
    ("range_idx", "<u4"),
    ("range_bins", "<u4"),
    ("frequency_count", "<u4"),
    ("pulsedoppler_instance", "<u4"),
]
_MATRIX_TAIL = [
    ("fps", "<f4"),
    ("fps_decimated", "<f4"),
    ("frequency_start", "<f4"),
    ("frequency_step", "<f4"),
    ("range_m", "<f4"),
]
_FLOAT_MATRIX = np.dtype(_MATRIX_HEAD + _MATRIX_TAIL)
_BYTE_MATRIX = np.dtype(
    [*_MATRIX_HEAD, ("byte_step_start", "<f4"), ("byte_step_size", "<f4"), *_MATRIX_TAIL]
)
_DATA = ResponseCode.XTS_SPR_DATA

LAYOUTS = (
    Layout(  # bit [OBS], name [FMT]
        "xethru_baseband_ap_",
        1 << 0,
        _appdata(AppDataId.XTS_ID_BASEBAND_AMPLITUDE_PHASE),
        _BASEBAND_HEADER,
        "num_bins",
        2,
        "<f4",
    ),
    Layout(  # bit, name and records [OBS]
        "xethru_baseband_iq_",
        1 << 1,
        _appdata(AppDataId.XTS_ID_BASEBAND_IQ),
        _BASEBAND_HEADER,
        "num_bins",
        2,
        "<f4",
    ),
    Layout(  # bit [OBS], name [FMT]
        "xethru_pulsedoppler_float_",
        1 << 6,
        _appdata(AppDataId.XTS_ID_PULSEDOPPLER_FLOAT),
        _FLOAT_MATRIX,
        "frequency_count",
        1,
        "<f4",
    ),
    Layout(  # bit [OBS], name [FMT]
        "xethru_pulsedoppler_byte_",
        1 << 7,
        _appdata(AppDataId.XTS_ID_PULSEDOPPLER_BYTE),
        _BYTE_MATRIX,
        "frequency_count",
        1,
        "u1",
    ),
    Layout(  # bit [HDR], name [FMT] (its ending inferred from pulse-Doppler)
        "xethru_noisemap_float_",
        1 << 8,
        _appdata(AppDataId.XTS_ID_NOISEMAP_FLOAT),
        _FLOAT_MATRIX,
        "frequency_count",
        1,
        "<f4",
    ),
    Layout(  # bit [HDR], name [FMT] (its ending inferred from pulse-Doppler)
        "xethru_noisemap_byte_",
        1 << 9,
        _appdata(AppDataId.XTS_ID_NOISEMAP_BYTE),
        _BYTE_MATRIX,
        "frequency_count",
        1,
        "u1",
    ),
    Layout(  # bit, name and records [OBS]
        "xethru_datafloat_",
        1 << 10,
        bytes((_DATA, ElementType.XTS_SPRD_FLOAT)),
        _DATA_HEADER,
        "length",
        1,
        "<f4",
    ),
    Layout(  # bit [HDR], name [FMT]
        "xethru_databyte_",
        1 << 11,
        bytes((_DATA, ElementType.XTS_SPRD_BYTE)),
        _DATA_HEADER,
        "length",
        1,
        "u1",
    ),
)

BY_PREFIX = {layout.prefix: layout for layout in LAYOUTS}
"""Layout of a payload by its first two or five bytes."""


def layout_of(payload: bytes) -> Layout | None:
    """Return the layout of a payload in NoEscape form; None if it is no bulk message."""
    layout = BY_PREFIX.get(payload[:2]) or BY_PREFIX.get(payload[:5])
    if layout is None:
        return None
    start = len(layout.prefix)
    header = payload[start : start + layout.header.itemsize]
    if len(header) < layout.header.itemsize or layout.record_size(header) != len(payload) - start:
        return None
    return layout
