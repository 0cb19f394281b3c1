"""The three ROS 2 messages a recording needs, in CDR, without a ROS installation.

Little-endian, each number aligned to its size counted from behind the four header bytes.
"""

import struct
from typing import Any

import numpy as np
import numpy.typing as npt

FLOAT_ARRAY = "std_msgs/msg/Float32MultiArray"
BYTE_ARRAY = "std_msgs/msg/UInt8MultiArray"
STRING = "std_msgs/msg/String"

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_U32 = struct.Struct("<I")
_LABEL = {FLOAT_ARRAY: "range_bin", BYTE_ARRAY: "byte"}
_RULE = "=" * 80
_ARRAY_PARTS = f"""\
{_RULE}
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
{_RULE}
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""
SCHEMAS = {
    FLOAT_ARRAY: f"std_msgs/MultiArrayLayout layout\nfloat32[] data\n{_ARRAY_PARTS}",
    BYTE_ARRAY: f"std_msgs/MultiArrayLayout layout\nuint8[] data\n{_ARRAY_PARTS}",
    STRING: "string data\n",
}
"""Definition of each message with all it refers to, as ``ros2msg`` text."""


def _text(text: str) -> bytes:
    data = text.encode() + b"\0"
    return _U32.pack(len(data)) + data


def _aligned(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def pack_string(text: str) -> bytes:
    """Bytes of a String."""
    return _LITTLE_ENDIAN + _text(text)


def pack_array(message_type: str, values: npt.NDArray[Any]) -> bytes:
    """Bytes of a one-dimensional array, shape (n,), float32 or uint8 as ``message_type`` says."""
    count = _U32.pack(len(values))
    dimension = _aligned(_U32.pack(1) + _text(_LABEL[message_type])) + count + count
    return _LITTLE_ENDIAN + dimension + _U32.pack(0) + count + values.tobytes()


def unpack_array(data: bytes, dtype: str) -> npt.NDArray[Any]:
    """Values of an array message, shape (n,), read-only.

    Raises
    ------
    ValueError, struct.error
        If the bytes are none.
    """
    if data[:4] != _LITTLE_ENDIAN:
        raise ValueError("the array is not little-endian CDR")
    body = data[4:]
    (dimensions,) = _U32.unpack_from(body, 0)
    position = 4
    for _ in range(dimensions):
        (length,) = _U32.unpack_from(body, position)
        position += 4 + length
        position += -position % 4 + 8
    (count,) = _U32.unpack_from(body, position + 4)
    return np.frombuffer(body, dtype, count, position + 8)


def unpack_string(data: bytes) -> str:
    """Text of a String message.

    Raises
    ------
    ValueError, struct.error
        If the bytes are none.
    """
    if data[:4] != _LITTLE_ENDIAN:
        raise ValueError("the text is not little-endian CDR")
    (length,) = _U32.unpack_from(data, 4)
    return data[8 : 8 + length].rstrip(b"\0").decode()
