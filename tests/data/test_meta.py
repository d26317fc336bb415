import os
import pickle
import pickletools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jprimfit.data import meta

PLAIN = {
    "type": "plane",
    "text": "-1.5e-3",
    "größe": 2.5,
    "n": 7,
    "big": 2**40,
    "none": None,
    "yes": True,
    "negative": -3,
}


@pytest.mark.parametrize("protocol", range(6))
def test_pickles_of_every_protocol(protocol):
    numbers = {
        "f8": np.float64(3.25),
        "f4": np.float32(-2),
        "i8": np.int64(-3),
        "u1": np.uint8(200),
        "b": np.bool_(True),
    }
    raw = pickle.dumps(PLAIN | numbers | {"list": [1, (2,)], "dict": {"a": 1}}, protocol=protocol)
    found = meta.parse(raw, source="FILE")
    assert found == PLAIN | {"f8": 3.25, "f4": -2.0, "i8": -3, "u1": 200, "b": True}
    assert all(type(value) in (str, int, float, bool, type(None)) for value in found.values())


def test_pickles_of_python_2_and_old_numpy():
    # What Python 2.7 writes for {"type": "cone", "n": numpy.float64(1.5)} in protocol 2, with NumPy's old module name.
    raw = (
        b"\x80\x02}q\x00(U\x04typeq\x01U\x04coneq\x02U\x01nq\x03cnumpy.core.multiarray\nscalar\nq\x04cnumpy\ndtype\nq\x05"
        b"U\x02f8q\x06K\x00K\x01\x87q\x07Rq\x08(K\x03U\x01<q\tNNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tq\nbC\x08"
        b"\x00\x00\x00\x00\x00\x00\xf8?\x86q\x0bRq\x0cu."
    )
    assert meta.parse(raw, source="FILE") == {"type": "cone", "n": 1.5}
    assert meta.parse(b"(dp0\nS'type'\np1\nS'plane'\np2\ns.", source="FILE") == {"type": "plane"}


def test_text_is_a_literal():
    assert meta.parse(str(PLAIN), source="FILE") == PLAIN


def test_dump_is_what_the_old_readers_load():
    raw = meta.dump({"type": "plane", "axis_x": "0.5"})
    assert pickle.loads(raw) == {"type": "plane", "axis_x": "0.5"}
    operations = [(operation.name, argument) for operation, argument, _ in pickletools.genops(raw)]
    assert operations[0] == ("PROTO", 2)
    assert not {"GLOBAL", "STACK_GLOBAL", "REDUCE"} & {name for name, _ in operations}
    assert meta.parse(raw, source="FILE") == pickle.loads(raw)


class _Runs:
    """A pickle that calls a function when it is loaded."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


_NESTED = b"\x80\x02" + b"(" * 2000 + b"l" * 2000 + b"."
_SHARED = b"\x80\x02)q\x00" + b"".join(b"h\x00h\x00\x86q\x00" for _ in range(700))  # a tuple of 2 ** 700 leaves
BAD = {
    "system": pickle.dumps({"type": _Runs(os.system, "exit 1")}, protocol=2),
    "eval": pickle.dumps(_Runs(eval, "1"), protocol=0),
    "getattr": pickle.dumps({"a": _Runs(getattr, "", "join")}, protocol=4),
    "object": pickle.dumps({"a": np.zeros(3)}, protocol=2),
    "object scalar": pickle.dumps({"a": np.datetime64(1, "s")}, protocol=2),
    "complex": pickle.dumps({"a": np.complex128(1j)}, protocol=2),
    "inner import": b"\x80\x02cnumpy.core.multiarray\n_reconstruct\n.",
    "scalar of a list": b"\x80\x02cnumpy.core.multiarray\nscalar\n(]K\x00tR.",
    "dtype of records": b"\x80\x02cnumpy.core.multiarray\nscalar\n(cnumpy\ndtype\n(U\x05f8,f8tRC\x10"
    + bytes(16)
    + b"tR.",
    "persistent": b"\x80\x02K\x00Q.",
    "new object": b"\x80\x02cnumpy\ndtype\n)\x81.",
    "nested": _NESTED,
    "shared key": _SHARED + b"}h\x00K\x01s.",
    "large memo": b"\x80\x02}r\xff\xff\xff\xff(K\x01K\x02u.",
    "large bytes": b"\x80\x05\x96\xff\xff\xff\xff\xff\xff\xff\x7f.",
    "truncated": pickle.dumps(PLAIN, protocol=2)[:-5],
    "empty stack": b"\x80\x02.",
    "no mark": b"\x80\x02K\x01u.",
    "empty": b"",
    "a list": pickle.dumps([1], protocol=2),
    "integer keys": pickle.dumps({1: 2}, protocol=2),
    "long": pickle.dumps({"a": "b" * 10000}, protocol=2),
    "call": "__import__('os').system('exit 1')",
    "power": "{'a': 9**9**9}",
    "deep": "[" * 3000 + "]" * 3000,
    "minus": "-" * 8000 + "1",
    "text list": "[1]",
    "text keys": "{1: 2}",
    "no text": "",
    "null": "\0",
    "long text": "{'a': '" + "b" * 10000 + "'}",
}


@pytest.mark.parametrize("raw", [*BAD.values(), 3.0], ids=[*BAD.keys(), "number"])
def test_anything_else_is_refused_and_nothing_runs(monkeypatch, raw):
    monkeypatch.setattr(os, "system", lambda command: pytest.fail("something ran"))
    with pytest.raises(ValueError) as caught:
        meta.parse(raw, source="FILE")
    assert str(caught.value).startswith("FILE cannot be used: its meta") and str(caught.value).endswith(".")


def test_values_that_are_not_plain_are_left_out():
    assert meta.parse(_SHARED + b"}U\x01ah\x00sU\x01bK\x05s.", source="FILE") == {"b": 5}
    assert meta.parse(pickle.dumps({"giant": 10**5000, "n": 1}, protocol=2), source="FILE") == {"n": 1}
    assert meta.parse("{'a': 1j, 'b': {1, 2}, 'c': b'x', 'n': 1}", source="FILE") == {"n": 1}


@settings(max_examples=300, deadline=None, derandomize=True)
@given(place=st.integers(0, 10**6), byte=st.integers(0, 255))
def test_damaged_pickles(place, byte):
    raw = bytearray(pickle.dumps(PLAIN | {"f8": np.float64(3.25)}, protocol=2))
    raw[place % len(raw)] = byte
    try:
        found = meta.parse(bytes(raw), source="FILE")
    except ValueError as error:
        assert str(error).startswith("FILE cannot be used: its meta")
    else:
        assert isinstance(found, dict)
