"""The attribute meta of a TraceParts instance: a flat dict kept as a pickle or as text, read without running anything.

A pickle is a program for a stack machine. parse walks its operations with pickletools, which only splits the bytes,
and carries out those that build plain values; the only calls it knows are NumPy's scalar and dtype and the codec of
Python 2 bytes, and it answers them itself. So nothing is imported or called, and the length of the text bounds work
and memory. dump writes the protocol 2 pickle that the published readers (Python 3.6) load.
Source: the opcodes documented in CPython's pickletools; the layout in SPFN's and CPFN's loaders.
"""

import ast
import pickle
import pickletools
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

Value = str | int | float | bool | None
_MAX_BYTES = 8 << 10  # a flat dict of nine short values takes about 300
_SCALAR, _DTYPE, _ENCODE = object(), object(), object()
_GLOBALS = {
    "numpy.core.multiarray scalar": _SCALAR,
    "numpy._core.multiarray scalar": _SCALAR,
    "numpy dtype": _DTYPE,
    "_codecs encode": _ENCODE,
}
_PLAIN = {
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE"),
    *("BINBYTES", "SHORT_BINBYTES"),
}
_CONSTANTS: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_DICT": dict,
    "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple,
}
_MARK = object()


def parse(raw: bytes | str | float, *, source: str) -> dict[str, Value]:
    """The dict behind a pickle (bytes) or a Python literal (text), its plain values only.

    ValueError, one sentence that begins with source, for whatever is too long, asks for anything but plain values, or
    is no dict with text keys. Lists, dicts and giant integers are left out, as readers ignore keys they do not know.
    """
    if not isinstance(raw, bytes | str):
        raise ValueError(f"{source} cannot be used: its meta is a number, expected a dict as pickle or text.")
    if len(raw) > _MAX_BYTES:
        raise ValueError(f"{source} cannot be used: its meta has {len(raw)} bytes, more than {_MAX_BYTES}.")
    try:
        found = ast.literal_eval(raw) if isinstance(raw, str) else _Machine().run(raw)
    # A crafted text can raise nearly anything: SyntaxError, RecursionError, MemoryError, KeyError, OverflowError ...
    except Exception as error:
        words = "its meta is no plain dict of texts and numbers, which alone are read; write it again as a plain dict"
        raise ValueError(f"{source} cannot be used: {words}.") from error
    if not isinstance(found, dict) or not all(isinstance(key, str) for key in found):
        raise ValueError(
            f"{source} cannot be used: its meta is a {type(found).__name__}, expected a dict with text keys."
        )
    return {key: value for key, value in found.items() if _is_plain(value)}


def dump(values: Mapping[str, Value]) -> bytes:
    """The pickle, of protocol 2, of a flat dict."""
    return pickle.dumps(dict(values), protocol=2)


class _DtypeName:
    """A NumPy type that a pickle has named, and its byte order."""

    def __init__(self, name: str):
        self.name, self.order = name, "="

    def scalar(self, raw: Any) -> Any:
        """The Python number in raw."""
        if not re.fullmatch(r"[<>=|]?[biuf][1248]", self.order + self.name):
            raise pickle.UnpicklingError("no plain number")
        (number,) = np.frombuffer(raw, self.order + self.name).tolist()
        return number


class _Machine:
    """Stack and memo of one pickle."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self, raw: bytes) -> Any:
        for operation, argument, _ in pickletools.genops(raw):
            if operation.name == "STOP":
                return self.stack.pop()
            self.step(operation.name, argument)
        raise pickle.UnpicklingError("no end")

    def step(self, name: str, argument: Any) -> None:
        stack = self.stack
        if name in _PLAIN:
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name]())
        elif name == "MARK":
            stack.append(_MARK)
        elif name in ("BINPUT", "LONG_BINPUT", "PUT"):
            self.memo[int(argument)] = stack[-1]
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET", "GET"):
            stack.append(self.memo[int(argument)])
        elif name in ("SETITEM", "SETITEMS", "DICT"):
            items = [stack.pop(-2), stack.pop()] if name == "SETITEM" else self.pop_to_mark()
            # Keys are texts: the hash of a nest of tuples that share their members would take for ever.
            pairs = {_of(key, str): value for key, value in zip(items[::2], items[1::2], strict=True)}
            if name == "DICT":
                stack.append(pairs)
            else:
                _of(stack[-1], dict).update(pairs)
        elif name in ("APPEND", "APPENDS"):
            items = [stack.pop()] if name == "APPEND" else self.pop_to_mark()
            _of(stack[-1], list).extend(items)
        elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
            size = int(name[-1])
            stack[-size:] = [tuple(stack[-size:])]
        elif name in ("TUPLE", "LIST"):
            items = self.pop_to_mark()
            stack.append(tuple(items) if name == "TUPLE" else items)
        elif name in ("GLOBAL", "STACK_GLOBAL"):
            words = argument if name == "GLOBAL" else " ".join([stack.pop(-2), stack.pop()])
            stack.append(_GLOBALS[words])
        elif name == "REDUCE":
            arguments = _of(stack.pop(), tuple)
            stack.append(_call(stack.pop(), arguments))
        elif name == "BUILD":
            state = _of(stack.pop(), tuple)
            _of(stack[-1], _DtypeName).order = _of(state[1], str)
        elif name not in ("PROTO", "FRAME"):
            raise pickle.UnpicklingError(f"operation {name}")

    def pop_to_mark(self) -> list[Any]:
        """Everything above the topmost mark, which is dropped."""
        place = len(self.stack) - 1
        while self.stack[place] is not _MARK:
            place -= 1
            if place < 0:
                raise pickle.UnpicklingError("no mark")
        items = self.stack[place + 1 :]
        del self.stack[place:]
        return items


def _call(function: Any, arguments: tuple[Any, ...]) -> Any:
    if function is _DTYPE:
        return _DtypeName(_of(arguments[0], str))
    if function is _SCALAR:
        dtype, raw = arguments
        return _of(dtype, _DtypeName).scalar(raw)
    if function is _ENCODE and arguments[1] == "latin1":
        return _of(arguments[0], str).encode("latin1")
    raise pickle.UnpicklingError("a call")


def _is_plain(value: Any) -> bool:
    return isinstance(value, str | float | None) or (isinstance(value, int) and abs(value) < 2**64)


def _of(value: Any, kind: Any) -> Any:
    if not isinstance(value, kind):
        raise pickle.UnpicklingError(f"{type(value).__name__} for {kind.__name__}")
    return value
