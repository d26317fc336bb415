"""TensorBoard's event files, so far as scalars need them: written without TensorBoard, read by it.

A file is a run of records: length (8 bytes), masked CRC-32C of the length, the bytes, masked CRC-32C of the bytes, all
little endian. The bytes are a message Event of protocol buffers: field number << 3 | wire type, then the value (0
varint, 1 eight bytes, 2 length and bytes, 5 four bytes). Source: TensorFlow's record_writer.h, event.proto and
summary.proto.
"""

import struct
from collections.abc import Mapping

_POLYNOMIAL = 0x82F63B78  # CRC-32C, bits reversed


def first_event(*, seconds: float) -> bytes:
    """The record that every file opens with; seconds since 1970."""
    return _record(_event(seconds, 0, 3, b"brain.Event:2"))


def scalars_event(step: int, scalars: Mapping[str, float], *, seconds: float) -> bytes:
    """The record of some named values at one step."""
    values = (_text(1, tag.encode()) + b"\x15" + struct.pack("<f", value) for tag, value in scalars.items())
    return _record(_event(seconds, step, 5, b"".join(_text(1, value) for value in values)))


def _event(seconds: float, step: int, field: int, content: bytes) -> bytes:
    return b"\x09" + struct.pack("<d", seconds) + b"\x10" + _varint(step) + _text(field, content)


def _text(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _varint(number: int) -> bytes:
    """Seven bits per byte, lowest first; the highest bit says that more follow."""
    groups = []
    while number > 127:
        groups.append(number & 127 | 128)
        number >>= 7
    return bytes([*groups, number])


def _record(content: bytes) -> bytes:
    length = struct.pack("<Q", len(content))
    return length + _masked_crc(length) + content + _masked_crc(content)


def _table() -> list[int]:
    """CRC-32C of each single byte."""
    table = []
    for crc in range(256):
        for _ in range(8):
            crc = crc >> 1 ^ (_POLYNOMIAL if crc & 1 else 0)
        table.append(crc)
    return table


_TABLE = _table()


def _masked_crc(content: bytes) -> bytes:
    crc = 0xFFFFFFFF
    for byte in content:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 255]
    crc ^= 0xFFFFFFFF
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)
