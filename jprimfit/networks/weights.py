"""A shipped model: NAME.npz with its arrays and NAME.yaml with all that is said of it.

The YAML holds the format's version, the settings of the network, how it was trained, and of every array its type, shape
and SHA-256. Arrays have the names of their places in the variables of the network, "params/head/kernel". In float16,
weights are rounded to nearest on saving and are float32 again once loaded; `rounding` says by how much at most. Running
statistics stay float32. Nothing is ever unpickled, and equal models have equal bytes.
"""

import functools
import hashlib
import io
import json
import math
import os
import re
import uuid
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from jprimfit import __version__
from jprimfit.geometry.hierarchy import build
from jprimfit.networks.segmenter import Segmenter, SegmenterConfig
from jprimfit.settings import from_mapping, read_yaml, to_mapping

FORMAT = "jprimfit-weights"
VERSION = 1
ASSETS = Path(__file__).resolve().parent.parent / "assets"
SHIPPED = ("default", "spfn")
EXPORTED = ("weights", "best/weights", "last/weights")  # where a training leaves models in its workdir, the best first
MAX_YAML = 1 << 18  # bytes
MAX_DEPTH = 32  # of sections in it
MAX_NUMBERS = 1 << 28  # of one model: ten times the paper's network and more
MAX_HEADER = 1 << 10  # bytes of an array's header
_OPENING = (
    yaml.BlockMappingStartToken,
    yaml.BlockSequenceStartToken,
    yaml.FlowMappingStartToken,
    yaml.FlowSequenceStartToken,
)
_CLOSING = (yaml.BlockEndToken, yaml.FlowMappingEndToken, yaml.FlowSequenceEndToken)
ZIP_DATE = (1980, 1, 1, 0, 0, 0)


class Model(NamedTuple):
    """A network ready for use: its settings and its variables."""

    config: SegmenterConfig
    variables: dict[str, Any]  # {"params": ..., "batch_stats": ...}, nested dicts of float32 NumPy arrays
    name: str
    info: dict[str, Any]  # how it was trained, what it scored: text, numbers and lists of them


class _Stored(NamedTuple):
    """What the YAML says of one array: `float32 64x32 <sha256>`, a number has shape `()`."""

    dtype: str
    shape: tuple[int, ...]
    sha256: str


def save(
    stem: str | os.PathLike[str], model: Model, *, precision: Literal["float32", "float16"] = "float32"
) -> tuple[Path, Path]:
    """Writes stem.npz and stem.yaml, both or neither, and returns their paths.

    ValueError for values that are not finite or that float16 cannot hold.
    """
    arrays_path, yaml_path = _paths(Path(stem))
    arrays, rounding = _rounded(_flat(model.variables), precision, source=str(stem))
    document = {
        "format": FORMAT,
        "version": VERSION,
        "made_by": f"jprimfit {__version__}",
        "name": model.name,
        "precision": precision,
        "rounding": rounding,
        "config": to_mapping(model.config),
        "info": dict(model.info),
        "arrays": {name: _words(array) for name, array in arrays.items()},
    }
    arrays_text = {"arrays": document["arrays"], "sha256": _digest(document)}  # one line each
    text = yaml.safe_dump({**document, "arrays": None}, sort_keys=False, default_flow_style=None, width=120)
    text = text.removesuffix("arrays: null\n") + yaml.safe_dump(arrays_text, default_flow_style=False, width=1000)
    contents = {arrays_path: _npz(arrays), yaml_path: text.encode("utf-8")}
    arrays_path.parent.mkdir(parents=True, exist_ok=True)
    partial = {path: path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial") for path in contents}
    try:
        for path, content in contents.items():
            partial[path].write_bytes(content)
        for path in contents:
            os.replace(partial[path], path)
    finally:
        for path in partial.values():
            path.unlink(missing_ok=True)
    return arrays_path, yaml_path


def load(name_or_dir: str | os.PathLike[str]) -> Model:
    """The model of that name ("default", "spfn"), of that path without its suffix, or in that folder, checked.

    A folder is the workdir of a training or its folder of checkpoints, from which the exported model is taken, or any
    with one model in it. ValueError of one sentence for whatever is no name, absent, damaged, or made for another
    network.
    """
    if not isinstance(name_or_dir, str | os.PathLike) or not os.fspath(name_or_dir):
        raise ValueError(
            f"the model is {name_or_dir!r}, but a name or a path is expected: give {' or '.join(SHIPPED)}, or the "
            "workdir of a training."
        )
    stem = _stem(name_or_dir)
    arrays_path, yaml_path = _paths(stem)
    for path, other in ((arrays_path, yaml_path), (yaml_path, arrays_path)):
        if not path.is_file():
            raise ValueError(f"{other} lacks {path.name} beside it: a model is both files, copy them together.")
    document = _read_document(yaml_path)
    stored = {name: _parsed(name, words, yaml_path) for name, words in document["arrays"].items()}
    config = from_mapping(SegmenterConfig, document["config"], source=yaml_path)
    if os.fspath(name_or_dir) not in SHIPPED:  # those are checked by the tests, which saves a second here
        check_shapes(config, {name: item.shape for name, item in stored.items()}, source=yaml_path)
    arrays = _read_arrays(arrays_path, stored)
    return Model(config, _nested(arrays), document["name"], document["info"])


def check_shapes(config: SegmenterConfig, shapes: Mapping[str, tuple[int, ...]], *, source: Any) -> None:
    """ValueError that names the first array in which these shapes are not those of the network of that config."""
    try:
        expected = expected_shapes(config)
    except Exception as error:  # settings that contradict each other surface anywhere in the network
        _refuse(source, f"no network can be made of its config ({' '.join(str(error).split())[:200].rstrip('.')})")
    for name in dict.fromkeys((*expected, *shapes)):
        if name not in shapes:
            _refuse(source, f"it lacks {name}, which the network of its config has")
        if name not in expected:
            _refuse(source, f"it holds {name}, which the network of its config has not")
        if tuple(shapes[name]) != expected[name]:
            _refuse(
                source, f"{name} has shape {tuple(shapes[name])}, and {expected[name]} in the network of its config"
            )


@functools.lru_cache(maxsize=8)
def expected_shapes(config: SegmenterConfig) -> dict[str, tuple[int, ...]]:
    """The shape of every array of a network, by name; nothing is computed."""
    num_points, num_sizes = config.hierarchy.num_points[0], len(config.neighborhoods)
    points = jax.ShapeDtypeStruct((num_points, 3), jnp.float32)
    normals = jax.ShapeDtypeStruct((num_points, num_sizes, 3), jnp.float32)
    curvature = jax.ShapeDtypeStruct((num_points, num_sizes), jnp.float32)
    segments = jax.ShapeDtypeStruct((num_points, 1), jnp.float32) if config.types == "pooled" else None

    def initial(points: Any, normals: Any, curvature: Any, segments: Any) -> Any:
        hierarchy = build(points, spec=config.hierarchy)
        return Segmenter(config).init(jax.random.key(0), points, hierarchy, normals, curvature, segments=segments)

    tree = jax.eval_shape(initial, points, normals, curvature, segments)
    return {name: array.shape for name, array in _flat(tree).items()}


def _paths(stem: Path) -> tuple[Path, Path]:
    """Both files of a model; a dot in its name is no suffix."""
    return stem.with_name(stem.name + ".npz"), stem.with_name(stem.name + ".yaml")


def _stem(name_or_dir: str | os.PathLike[str]) -> Path:
    """Where the model lies, without suffix; one of its files exists there, or a ValueError says what is there."""
    text, path = os.fspath(name_or_dir), Path(name_or_dir)
    if text in SHIPPED:
        stem = ASSETS / text
        if not _exists(stem):
            raise ValueError(
                f"the model '{text}' is not shipped with jprimfit {__version__}: give the folder of a model, "
                "or fit without a network."
            )
        return stem
    if path.is_dir():
        return _stem_in(path)
    stem = path.with_suffix("") if path.suffix in (".npz", ".yaml") else path
    if not path.name or not _exists(stem):
        raise ValueError(
            f"'{text}' is no model: give {' or '.join(SHIPPED)}, the workdir of a training, or the path of a model's "
            "two files without .npz and .yaml."
        )
    return stem


def _stem_in(folder: Path) -> Path:
    """The exported model of a workdir, also from its folder of checkpoints; else the only model in the folder."""
    real = folder.resolve()
    in_checkpoints = [place for place in (real, real.parent) if place.name == "checkpoints"]
    workdir = in_checkpoints[0].parent if in_checkpoints else folder
    for name in EXPORTED:
        if _exists(workdir / name):
            return workdir / name
    if in_checkpoints or (folder / "checkpoints").is_dir():
        raise ValueError(f"{workdir} holds a training that has not exported a model yet: let it reach a validation.")
    stems = [path.with_name(path.stem) for path in sorted(folder.glob("*.yaml")) if path.with_suffix(".npz").is_file()]
    if len(stems) == 1:
        return stems[0]
    if stems:
        names = ", ".join(stem.name for stem in stems[:8])
        raise ValueError(
            f"{folder} holds {len(stems)} models ({names}): name the one you mean, {stems[0]} for example."
        )
    raise ValueError(f"{folder} holds no model: two files NAME.npz and NAME.yaml are expected there.")


def _exists(stem: Path) -> bool:
    return any(path.is_file() for path in _paths(stem))


def _refuse(source: Any, words: str) -> NoReturn:
    raise ValueError(f"{source} cannot be used, {words}: copy or export the model again.")


@contextmanager
def _refusing(source: Path) -> Iterator[None]:
    """Turns what a library raises about a damaged file into one sentence."""
    try:
        yield
    except Exception as error:  # a damaged file surfaces anywhere in zipfile, zlib, NumPy or YAML
        words = " ".join(str(error).split())
        if words.startswith(str(source)):  # a sentence of ours, or of settings
            raise ValueError(words) from None
        _refuse(source, f"it is damaged ({words.rstrip('.')[:200] or type(error).__name__})")


def _read_document(path: Path) -> dict[str, Any]:
    """The YAML of a model, its own checksum verified."""
    if path.stat().st_size > MAX_YAML:
        _refuse(path, f"it has {path.stat().st_size} bytes where a model's YAML has {MAX_YAML} at most")
    with _refusing(path):
        _refuse_depth(path)
        document = read_yaml(path)
        if document.get("format") != FORMAT:
            _refuse(path, f"it is no YAML of a jprimfit model (format: {document.get('format')!r})")
        if document.get("version") != VERSION:
            _refuse(path, f"its version is {document.get('version')!r} and this jprimfit reads {VERSION}")
        for key, kind in {"name": str, "config": dict, "info": dict, "arrays": dict, "sha256": str}.items():
            if not isinstance(document.get(key), kind):
                _refuse(path, f"it lacks the key {key!r} or has something else there")
        if document["sha256"] != _digest(document):
            _refuse(path, "it has changed since it was written")
    return document


def _refuse_depth(path: Path) -> None:
    """Stops at what keeps a YAML reader busy for ever: aliases of aliases, thousands of brackets."""
    depth = 0
    for token in yaml.scan(path.read_text(encoding="utf-8")):
        depth += isinstance(token, _OPENING) - isinstance(token, _CLOSING)
        if isinstance(token, yaml.AliasToken) or depth > MAX_DEPTH:
            _refuse(path, f"it has aliases or more than {MAX_DEPTH} levels, as no model's YAML has")


def _digest(document: Mapping[str, Any]) -> str:
    """SHA-256 of all but the field sha256."""
    fields = {name: value for name, value in document.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def _words(array: np.ndarray) -> str:
    shape = "x".join(str(size) for size in array.shape) or "()"
    return f"{array.dtype.name} {shape} {hashlib.sha256(array.tobytes()).hexdigest()}"


def _parsed(name: str, words: Any, path: Path) -> _Stored:
    match = re.fullmatch(r"(float32|float16) (\d{1,9}(?:x\d{1,9})*|\(\)) ([0-9a-f]{64})", str(words))
    if not match:
        _refuse(path, f"it says {str(words)[:80]!r} of {name}, expected type, shape and SHA-256")
    shape = () if match[2] == "()" else tuple(int(size) for size in match[2].split("x"))
    return _Stored(match[1], shape, match[3])


def _read_arrays(path: Path, stored: Mapping[str, _Stored]) -> dict[str, np.ndarray]:
    """All arrays as float32. Nothing is read or made that is larger than the YAML says."""
    if sum(math.prod(item.shape) for item in stored.values()) > MAX_NUMBERS:
        _refuse(path, f"more than {MAX_NUMBERS} numbers are announced for it")
    with _refusing(path), zipfile.ZipFile(path) as archive:
        members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
        for name in dict.fromkeys((*stored, *members)):
            if name not in members:
                _refuse(path, f"it lacks the array {name}")
            if name not in stored:
                _refuse(path, f"it holds {name[:80]!r}, of which its YAML says nothing")
        return {name: _read_array(archive, members[name], name, item, path) for name, item in stored.items()}


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str, item: _Stored, path: Path) -> np.ndarray:
    """One array, compared with what is said of it."""
    dtype = np.dtype(item.dtype).newbyteorder("<")
    num_bytes = math.prod(item.shape) * dtype.itemsize
    if member.file_size > num_bytes + MAX_HEADER:
        _refuse(path, f"{name} has {member.file_size} bytes where {num_bytes} are expected")
    file = io.BytesIO(archive.read(member))
    if np.lib.format.read_magic(file) != (1, 0):
        _refuse(path, f"{name} is no NPY of version 1.0")
    shape, fortran_order, found = np.lib.format.read_array_header_1_0(file)
    if found != dtype or fortran_order:
        _refuse(path, f"{name} holds {found} where {item.dtype} is expected")
    if shape != item.shape:
        _refuse(path, f"{name} has shape {shape} where {item.shape} is expected")
    content = file.read()
    if len(content) != num_bytes:
        _refuse(path, f"{name} has {len(content)} bytes of numbers where {num_bytes} are expected")
    if hashlib.sha256(content).hexdigest() != item.sha256:
        _refuse(path, f"{name} has other bits than were saved")
    array = np.frombuffer(content, dtype).reshape(shape).astype(np.float32)
    if not np.all(np.isfinite(array)):
        _refuse(path, f"{name} holds values that are not finite")
    return array


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    """The archive that numpy.load opens, without the time of day in it."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, array, version=(1, 0), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", ZIP_DATE), content.getvalue())
    return buffer.getvalue()


def _rounded(arrays: Mapping[str, Any], precision: str, *, source: str) -> tuple[dict[str, np.ndarray], float]:
    """The arrays as they are stored, and the largest change of any value."""
    stored, rounding = {}, 0.0
    for name, value in arrays.items():
        array = np.array(value, "<f4", order="C")
        if not np.all(np.isfinite(array)):
            raise ValueError(f"{source} is not written, {name} holds values that are not finite: export another step.")
        if precision == "float16" and name.startswith("params/"):
            if np.max(np.abs(array), initial=0) > np.finfo(np.float16).max:
                raise ValueError(f"{source} is not written, {name} is beyond float16: store it as float32.")
            half = array.astype("<f2")
            rounding = max(rounding, float(np.max(np.abs(half.astype(np.float32) - array), initial=0)))
            array = half
        stored[name] = array
    return stored, rounding


def _flat(tree: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    flat = {}
    for key, value in tree.items():
        flat.update(_flat(value, f"{above}{key}/") if isinstance(value, Mapping) else {f"{above}{key}": value})
    return flat


def _nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        *above, last = name.split("/")
        place = tree
        for key in above:
            place = place.setdefault(key, {})
        place[last] = value
    return tree
