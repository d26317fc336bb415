"""Event files are those of TensorBoard: its own bytes, the published check values, and a reader of the format."""

import struct

import numpy as np
import pytest

from jprimfit.training import events

# tensorboard 2.21.0: RecordWriter.write(Event(wall_time=1700000000.5, step=300, summary=Summary(value=[
#     Summary.Value(tag="train/total", simple_value=0.25), Summary.Value(tag="b", simple_value=-3)])))
GOLDEN = bytes.fromhex(
    "2c00000000000000f4aecc450900002040fc54d94110ac022a1e0a120a0b747261696e2f746f74616c"
    "150000803e0a080a016215000040c02228fda6"
)


def test_the_bytes_are_those_of_tensorboard():
    assert events.scalars_event(300, {"train/total": 0.25, "b": -3.0}, seconds=1700000000.5) == GOLDEN


@pytest.mark.parametrize(
    ("content", "crc"),
    [  # RFC 3720, B.4
        (b"\x00" * 32, 0x8A9136AA),
        (b"\xff" * 32, 0x62A8AB43),
        (bytes(range(32)), 0x46DD794E),
        (bytes(range(31, -1, -1)), 0x113FDB5C),
    ],
)
def test_crc_of_the_published_examples(content, crc):
    masked = struct.unpack("<I", events._masked_crc(content))[0]
    turned = (masked - 0xA282EAD8) & 0xFFFFFFFF
    assert (turned << 15 | turned >> 17) & 0xFFFFFFFF == crc


def read_varint(content, place):
    number = shift = 0
    while True:
        number |= (content[place] & 127) << shift
        shift, place = shift + 7, place + 1
        if content[place - 1] < 128:
            return number, place


def read_message(content):
    """(field, value) pairs of a message."""
    place, pairs = 0, []
    while place < len(content):
        key, place = read_varint(content, place)
        if key & 7 == 0:
            value, place = read_varint(content, place)
        elif key & 7 == 1:
            value, place = struct.unpack_from("<d", content, place)[0], place + 8
        elif key & 7 == 5:
            value, place = struct.unpack_from("<f", content, place)[0], place + 4
        else:
            size, place = read_varint(content, place)
            value, place = content[place : place + size], place + size
        pairs.append((key >> 3, value))
    return pairs


@pytest.mark.parametrize("step", [0, 1, 127, 128, 300, 70_000, 2**40])
def test_what_is_written_is_read(step):
    scalars = {"train/total": 0.1, "a" * 200: float("nan"), "ü": -1e30}
    record = events.scalars_event(step, scalars, seconds=12.5)
    size = struct.unpack_from("<Q", record)[0]
    assert len(record) == size + 16
    found = dict(read_message(record[12 : 12 + size]))
    assert found[1] == 12.5 and found[2] == step
    values = [dict(read_message(value)) for _, value in read_message(found[5])]
    assert [value[1].decode() for value in values] == list(scalars)
    np.testing.assert_array_equal([value[2] for value in values], np.float32(list(scalars.values())))
    head = events.first_event(seconds=12.5)
    assert dict(read_message(head[12:-4])) == {1: 12.5, 2: 0, 3: b"brain.Event:2"}
