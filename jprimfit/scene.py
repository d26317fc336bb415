"""Scene: the answer of `fit`, everything in the unit and frame of the input, and its files.

labels[i] is the primitive that explains point i, -1 for none; primitives that lie on one geometric surface share a
number in surface_of. On disk a scene is `scene.json` (versioned; docs/scene.md, assets/scene.schema.json) and an .npz
of its arrays beside it, tied together by a checksum. Float64 parameters survive save and load exactly.
"""

import hashlib
import io
import json
import os
import re
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int, Int32

from jprimfit import __version__
from jprimfit.io.files import replacing
from jprimfit.io.numpy_files import npz_bytes
from jprimfit.io.text_table import primitives_table
from jprimfit.types import Cone, Cylinder, Feature, Plane, Primitive, Sphere

if TYPE_CHECKING:  # with scipy, which a stored answer is opened without
    from jprimfit.cad.patches import Patch

FORMAT = "jprimfit scene"
VERSION = 1
CLASSES: dict[str, type] = {c.kind: c for c in (Plane, Sphere, Cylinder, Cone)}
ARRAYS = {"points": np.float64, "labels": np.int32, "normals": np.float64, "distances": np.float64}


@dataclass(frozen=True, eq=False)
class Scene:
    """What `fit` found in n points: p primitives, and for every point which of them it lies on."""

    points: Float[np.ndarray, "n 3"]  # float64, all points of the input in its order
    labels: Int32[np.ndarray, "n"]  # row of primitives, -1 = explained by none
    primitives: tuple[Primitive, ...]  # p of them, parameters float64 NumPy
    surface_of: Int32[np.ndarray, "p"]  # primitives on one geometric surface share a number
    normals: Float[np.ndarray, "n 3"]  # unit, sign free; NaN where a point was unusable
    distances: Float[np.ndarray, "n"]  # >= 0, to the primitive of the label; NaN where it is -1
    noise: float = float("nan")  # estimated sigma of the points about their surfaces, in the unit of the input
    report: dict[str, Any] = field(default_factory=dict)  # what was removed, timings, settings: values JSON can hold

    def counts(self) -> Int32[np.ndarray, "p"]:
        """Points per primitive."""
        used = self.labels[self.labels >= 0]
        return np.bincount(used, minlength=len(self.primitives)).astype(np.int32)

    def names(self) -> tuple[str, ...]:
        """The name of each primitive in pictures, surfaces.obj and the table: kind and label, like 'cylinder_3'."""
        return tuple(f"{primitive.kind}_{i}" for i, primitive in enumerate(self.primitives))

    def rms_distances(self) -> Float[np.ndarray, "p"]:
        """Root of the mean squared distance of each primitive's points; NaN where it has none."""
        used = self.labels >= 0
        total = np.bincount(self.labels[used], self.distances[used] ** 2, minlength=len(self.primitives))
        count = self.counts()
        return np.sqrt(np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0))

    @cached_property
    def signed_distances(self) -> Float[np.ndarray, "n"]:
        """Length from its primitive to each point, NaN where the label is -1.

        Positive outside a sphere, cylinder or cone, and on the side of a plane that its normal points to. The sign says
        nothing of the material: a point that stands out of the wall of a hole, into the hole, is negative.
        """
        from jprimfit.cad import charts

        signed = np.full(len(self.points), np.nan)
        for primitive, rows in zip(self.primitives, self.rows_of, strict=True):
            signed[rows] = charts.signed_distances(primitive, self.points[rows])
        return signed

    @cached_property
    def rows_of(self) -> tuple[Int[np.ndarray, "_"], ...]:
        """For each primitive the rows of its points, ascending."""
        order = np.argsort(self.labels, kind="stable")
        bounds = np.searchsorted(self.labels[order], np.arange(len(self.primitives) + 1))
        return tuple(order[start:end] for start, end in pairwise(bounds))

    @cached_property
    def patches(self) -> "tuple[Patch, ...]":
        """Each primitive trimmed to its points, as a triangle mesh; computed when first asked for."""
        from jprimfit.cad.patches import of_faces

        return of_faces(self.primitives, self.points, self.labels)

    @cached_property
    def features(self) -> tuple[Feature, ...]:
        """What a drawing says of each primitive: extents, hole or boss, deviations, uncertainties (types.Feature).

        standard_errors are one standard deviation, from the scatter of the points: "direction" (radians, of normal or
        axis), "offset" of a plane at the middle of its points, "position" (of the center, across the axis for a
        cylinder; of a cone's apex), "radius", "half_angle"; inf where the points do not tell. Computed when first
        asked for.
        """
        from jprimfit.cad.features import features

        return features(self.primitives, self.points, self.rows_of, self.patches)

    def extent(self) -> float:
        """Longest side of the axis-aligned box around the finite points; 0 if there are none."""
        finite = self.points[np.all(np.isfinite(self.points), axis=1)]
        return float(np.max(finite.max(axis=0) - finite.min(axis=0))) if len(finite) else 0.0

    def table(self, *, max_rows: int | None = None) -> str:
        """The primitives as text, the largest if a number is given; lengths in the input's unit, angles in degrees."""
        return primitives_table(
            self.primitives, self.features, self.surface_of, extent=self.extent(), max_rows=max_rows
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes `path` (scene.json) and the .npz beside it, each whole; a stop between the two shows on loading."""
        path = Path(path)
        arrays_path = path.with_suffix(".npz")
        if arrays_path == path:
            raise ValueError(f"{path} is the name of the arrays' file: give a name that ends in .json.")
        data = npz_bytes({name: np.asarray(getattr(self, name), dtype) for name, dtype in ARRAYS.items()})
        document = _document(self, arrays_path.name, hashlib.sha256(data).hexdigest())
        text = json.dumps(document, indent=1, allow_nan=False)
        # Vectors on one line; only JSON's own layout has a line break behind a bracket, strings have none.
        text = re.sub(r"\[\n([^][{}\"]*)\]", lambda match: "[" + " ".join(match[1].split()) + "]", text)
        with replacing(arrays_path) as file:
            file.write(data)
        with replacing(path) as file:
            file.write(text.encode("utf-8"))

    @staticmethod
    def load(path: str | os.PathLike[str]) -> "Scene":
        """The scene that `save` wrote to `path`; ValueError of one sentence if it is another file or damaged."""
        path = Path(path)
        document = _read_document(path)
        arrays = _read_arrays(path, document)
        try:
            return _scene(document, arrays)
        except Exception as error:  # a document edited by hand may lack or distort anything
            reason = f"missing {error}" if isinstance(error, KeyError) else " ".join(str(error).split()).rstrip(".")
            raise ValueError(f"{path} is a damaged jprimfit scene ({reason[:120]}): run jprimfit fit again.") from None


def _document(scene: Scene, arrays_name: str, checksum: str) -> dict[str, Any]:
    counts, rms = scene.counts(), scene.rms_distances()
    primitives = []
    for i, primitive in enumerate(scene.primitives):
        parameters = {name: _plain(value) for name, value in primitive._asdict().items()}
        measured = {"num_points": int(counts[i]), "rms_distance": _plain(rms[i])}
        feature = _feature(scene.features[i])
        primitives.append(
            {"kind": primitive.kind, **parameters, "surface": int(scene.surface_of[i]), **measured, "feature": feature}
        )
    return {
        "format": FORMAT,
        "version": VERSION,
        "generator": f"jprimfit {__version__}",
        "num_points": len(scene.points),
        "noise": _plain(scene.noise),
        "primitives": primitives,
        "report": _plain(scene.report),
        "arrays": {"file": arrays_name, "sha256": checksum},
    }


def _feature(feature: Feature) -> dict[str, Any]:
    """The fields of a feature that its kind has, and those that are given beside it left out."""
    loops = [
        {"corners": _plain(loop.corners)} if loop.radius is None else {"center": loop.center, "radius": loop.radius}
        for loop in feature.outline
    ]
    entry = {k: v for k, v in feature._asdict().items() if v is not None and k not in ("num_points", "rms", "outline")}
    return _plain({**entry, "outline": loops} if loops else entry)


def _plain(value: Any) -> Any:
    """The value in JSON's own types: NumPy and JAX numbers and arrays become lists, what is not finite becomes null."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if hasattr(value, "__array__"):
        return _plain(np.asarray(value).tolist())
    return str(value)


def _read_document(path: Path) -> dict[str, Any]:
    advice = "give the scene.json that jprimfit fit wrote"
    if path.is_dir():
        raise ValueError(f"{path} is a folder: {advice}.")
    try:
        document = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist: {advice}.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read as JSON ({type(error).__name__}): {advice}.") from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f"{path} is JSON but no jprimfit scene: {advice}.")
    if document.get("version") != VERSION:
        found = str(document.get("version"))[:20]
        raise ValueError(
            f"{path} is a scene of version {found}, this jprimfit reads version {VERSION}: "
            "install the jprimfit that wrote it, or run jprimfit fit again."
        )
    return document


def _read_arrays(path: Path, document: dict[str, Any]) -> dict[str, np.ndarray]:
    entry = document.get("arrays")
    entry = entry if isinstance(entry, dict) else {}
    # The name alone, never a path: a scene must not make us open files elsewhere. Renamed together, both follow path.
    candidates = [path.with_name(Path(str(entry.get("file", ""))).name or path.name), path.with_suffix(".npz")]
    arrays_path = next((p for p in candidates if p.suffix == ".npz" and p.is_file()), None)
    if arrays_path is None:
        raise ValueError(f"{path} has lost its arrays, {candidates[-1].name}: put that file beside it.")
    data = arrays_path.read_bytes()
    if hashlib.sha256(data).hexdigest() != entry.get("sha256"):
        raise ValueError(f"{arrays_path} does not belong to {path.name} or is damaged: run jprimfit fit again.")
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            return {name: archive[name] for name in ARRAYS}
    except Exception as error:  # zipfile and NumPy raise many kinds
        raise ValueError(
            f"{arrays_path} is no scene archive ({type(error).__name__}): run jprimfit fit again."
        ) from None


def _scene(document: dict[str, Any], arrays: dict[str, np.ndarray]) -> Scene:
    num_points = len(arrays["points"])
    shapes = {
        "points": (num_points, 3),
        "normals": (num_points, 3),
        "labels": (num_points,),
        "distances": (num_points,),
    }
    for name, shape in shapes.items():
        if arrays[name].shape != shape or arrays[name].dtype != ARRAYS[name]:
            raise ValueError(f"{name} has shape {arrays[name].shape} and type {arrays[name].dtype}")
    primitives = tuple(_primitive(entry) for entry in document["primitives"])
    labels = arrays["labels"]
    if num_points and not (-1 <= labels.min() and labels.max() < len(primitives)):
        raise ValueError(f"a label is outside -1 to {len(primitives) - 1}")
    noise = document["noise"]
    return Scene(
        **arrays,
        primitives=primitives,
        surface_of=np.array([int(entry["surface"]) for entry in document["primitives"]], np.int32),
        noise=float("nan") if noise is None else float(noise),
        report=dict(document["report"]),
    )


def _primitive(entry: dict[str, Any]) -> Primitive:
    if entry["kind"] not in CLASSES:
        raise ValueError(f"a primitive of kind '{entry['kind']}'")
    made = CLASSES[entry["kind"]]
    values = {}
    for name in made._fields:
        value = np.array(entry[name], np.float64)
        shape = (3,) if name in ("normal", "axis", "center", "apex") else ()
        if value.shape != shape:
            raise ValueError(f"{name} of a {entry['kind']} has shape {value.shape}")
        values[name] = value if shape else value[()]
    return made(**values)
