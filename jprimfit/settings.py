"""Settings: YAML on one side, nested frozen dataclasses on the other, strict in between.

A section is a dataclass, a key is one of its fields, and the dotted name of a key leads to it from the root
(`optimizer.learning_rate`). Every value is brought to the annotated type or refused by a ValueError of one sentence
that names the key, what stands there, what is expected and where it was read. Known types: bool, int, float, str,
Literal, tuple[...], None beside any of them, and dataclasses of these.
"""

import difflib
import math
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml

Config = TypeVar("Config")


def read_yaml(path: Path | str) -> dict[str, Any]:
    """The mapping that a YAML file holds; an empty file is an empty mapping.

    ValueError where the file is not UTF-8, is no YAML, is no mapping of names, or names a key twice.
    """
    path = Path(path)
    try:
        mapping = yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeys)
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not a text file; expected settings in YAML.") from None
    except yaml.YAMLError as error:
        raise ValueError(f"{path} cannot be read as YAML: {_first_problem(error)}.") from None
    return _section({} if mapping is None else mapping, key="", source=str(path))


def with_overrides(mapping: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """The mapping with `section.key=value` replaced or added, in order; a value is read as YAML."""
    result = _copy(mapping)
    for override in overrides:
        key, equals, text = override.partition("=")
        *sections, name = key.strip().split(".")
        if not equals or not all([*sections, name]):
            raise ValueError(f"{override!r} is no setting; expected section.key=value such as train.steps=1000.")
        try:
            value = yaml.load(text, Loader=_UniqueKeys)
        except yaml.YAMLError as error:
            raise ValueError(f"the value of {override!r} cannot be read as YAML: {_first_problem(error)}.") from None
        place = result
        for depth, section in enumerate(sections):
            if place.get(section) is None:
                place[section] = {}
            place = place[section]
            if not isinstance(place, dict):
                inside = ".".join(sections[: depth + 1])
                raise ValueError(f"{override!r} cannot be set: {inside} is {place!r}, not a section.")
        place[name] = value
    return result


def from_mapping(cls: type[Config], mapping: Mapping[str, Any], *, source: Path | str) -> Config:
    """The settings of class cls that a mapping holds; what is absent keeps its default. `source` names the origin.

    ValueError for an unknown key, a missing key without default, a value of another type, and whatever the class
    itself refuses.
    """
    return _build(cls, mapping, key="", source=str(source), root=cls)


def to_mapping(config: Any) -> dict[str, Any]:
    """The settings as nested dicts of what YAML and JSON know, all keys included; from_mapping reads them back."""
    return {field.name: _plain(getattr(config, field.name)) for field in fields(config)}


def differences(first: Any, second: Any) -> list[str]:
    """The dotted keys in which two configurations (settings or mappings of them) differ, in the order of the first."""
    one, other = (_flat(to_mapping(config) if is_dataclass(config) else config) for config in (first, second))
    return [key for key in {**one, **other} if key not in one or key not in other or one[key] != other[key]]


class _UniqueKeys(yaml.SafeLoader):
    """PyYAML takes the last of two values with one key in silence; a setting that is given twice is a mistake."""


def _construct_mapping(loader: _UniqueKeys, node: yaml.MappingNode) -> dict[Any, Any]:
    """A mapping without merge keys whose keys differ."""
    mapping = {}
    for key_node, value_node in node.value:
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, str):
            raise yaml.constructor.ConstructorError(None, None, f"the key {key!r} is no name", key_node.start_mark)
        if key in mapping:
            raise yaml.constructor.ConstructorError(None, None, f"the key {key!r} stands twice", key_node.start_mark)
        mapping[key] = loader.construct_object(value_node, deep=True)
    return mapping


_UniqueKeys.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _construct_mapping)


def _first_problem(error: yaml.YAMLError) -> str:
    problem, mark = getattr(error, "problem", None), getattr(error, "problem_mark", None)
    where = f" in line {mark.line + 1}" if mark else ""
    return f"{problem or str(error).splitlines()[0]}{where}"


def _build(cls: Any, mapping: Any, *, key: str, source: str, root: type) -> Any:
    """One section and, by _coerce, the sections within it."""
    hints = typing.get_type_hints(cls)
    known = [field.name for field in fields(cls) if field.init]
    mapping = _section({} if mapping is None else mapping, key=key, source=source)
    for name in mapping:
        if name not in known:
            raise ValueError(f"unknown key {_join(key, name)!r} in {source}{_suggestion(key, name, known, root)}")
    values = {}
    for field in fields(cls):
        hint, place = hints[field.name], _join(key, field.name)
        if field.name in mapping:
            values[field.name] = _coerce(hint, mapping[field.name], key=place, source=source, root=root)
        elif field.init and field.default is MISSING and field.default_factory is MISSING:
            if not is_dataclass(hint):
                raise ValueError(f"{source} lacks the key {place!r}: give it {_article(_expected(hint))}.")
            values[field.name] = _build(hint, {}, key=place, source=source, root=root)
    try:
        return cls(**values)
    except ValueError as error:
        sentence = str(error) if key == "" else f"{key}: {error}"
        raise ValueError(f"{source}: {sentence}") from None


def _coerce(hint: Any, value: Any, *, key: str, source: str, root: type) -> Any:
    """The value as what the annotation says, or a ValueError."""
    if is_dataclass(hint):
        return _build(hint, value, key=key, source=source, root=root)
    origin, options = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in options:
            return None
        rest = [option for option in options if option is not type(None)]
        if len(rest) == 1 and rest[0] not in (bool, int, float, str):
            return _coerce(rest[0], value, key=key, source=source, root=root)
        found = [_scalar(option, value) for option in rest]
        if any(item is not None for item in found):
            return next(item for item in found if item is not None)
    elif origin is tuple and isinstance(value, list | tuple):
        items = options[:1] * len(value) if options[-1:] == (Ellipsis,) else options
        if len(items) == len(value):
            pairs = zip(items, value, strict=True)
            return tuple(
                _coerce(item, part, key=f"{key}[{i}]", source=source, root=root) for i, (item, part) in enumerate(pairs)
            )
    elif origin is typing.Literal:
        # 1 == True, but a switch is no number.
        for option in options:
            if type(option) is type(value) and option == value:
                return option
        close = difflib.get_close_matches(str(value), [str(option) for option in options], n=1)
        hint_text = f"; did you mean {close[0]!r}?" if close else "."
        raise ValueError(f"{key} in {source} is {value!r}; expected {_expected(hint)}{hint_text}")
    else:
        found = _scalar(hint, value)
        if found is not None:
            return found
    raise ValueError(f"{key} in {source} is {value!r}; expected {_article(_expected(hint))}.")


def _scalar(hint: Any, value: Any) -> Any:
    """The value as bool, int, float or str, None where it is none; YAML reads 1e-3 as text, so text may be a number."""
    if hint in (bool, str):
        return value if isinstance(value, hint) else None
    if hint not in (int, float) or isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    if hint is int and isinstance(value, int):
        return value
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    if hint is int:
        return int(number) if number.is_integer() else None
    return None if math.isnan(number) else number


def _section(value: Any, *, key: str, source: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        name = f"{key} in {source}" if key else source
        raise ValueError(f"{name} is {value!r}; expected a section, that is lines of `key: value`.")
    return dict(value)


def _suggestion(key: str, name: str, known: list[str], root: type) -> str:
    """The nearest name in the section, else the place of that name elsewhere, else what there is."""
    close = difflib.get_close_matches(name, known, n=1)
    if close:
        return f", did you mean {_join(key, close[0])!r}?"
    elsewhere = [place for place in _keys(root, "") if place.rpartition(".")[2] == name]
    if elsewhere:
        return f", did you mean {elsewhere[0]!r}?"
    return f"; known are {', '.join(known)}."


def _keys(cls: type, key: str) -> list[str]:
    """The dotted names of everything in a class."""
    hints = typing.get_type_hints(cls)
    places = []
    for field in fields(cls):
        place = _join(key, field.name)
        places += [place, *(_keys(hints[field.name], place) if is_dataclass(hints[field.name]) else ())]
    return places


def _join(key: str, name: str) -> str:
    return f"{key}.{name}" if key else str(name)


def _expected(hint: Any) -> str:
    """An annotation in words."""
    origin, options = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join("null" if option is type(None) else _expected(option) for option in options)
    if origin is typing.Literal:
        return f"one of {', '.join(str(option) for option in options)}"
    if origin is tuple:
        if options[-1:] == (Ellipsis,):
            return f"list [...] in which each item is {_article(_expected(options[0]))}"
        return f"list [{', '.join(_expected(option) for option in options)}]"
    names = {bool: "bool (true or false)", int: "int", float: "float", str: "text"}
    return names.get(hint, getattr(hint, "__name__", str(hint)))


def _article(words: str) -> str:
    if words.startswith(("one of", "text")):
        return words
    return f"an {words}" if words.startswith("int") else f"a {words}"


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return to_mapping(value)
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def _copy(mapping: Mapping[str, Any]) -> dict[str, Any]:
    return {key: _copy(value) if isinstance(value, Mapping) else value for key, value in mapping.items()}


def _flat(mapping: Mapping[str, Any], key: str = "") -> dict[str, Any]:
    """Dotted keys and their values; an empty section is a value, so that its absence shows."""
    result = {}
    for name, value in mapping.items():
        inner = _flat(value, _join(key, name)) if isinstance(value, Mapping) and value else None
        result.update(inner if inner is not None else {_join(key, name): _plain(value)})
    return result
