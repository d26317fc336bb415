"""features.csv: one row per primitive, for a spreadsheet or an inspection report.

Comma-separated values as RFC 4180 has them: a header, CRLF, quotes where a field needs them; numbers with a point and
all their digits. Lengths in the unit of the scan, which the file cannot know, angles in degrees. What a kind does not
have, or the points do not tell, is empty.
"""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from jprimfit.io.files import replacing
from jprimfit.types import Feature, Plane, Primitive, Sphere

AXES = ("x", "y", "z")
SIDES = {True: "hole", False: "boss", None: ""}


def write_features(
    path: str | Path,
    names: Sequence[str],
    primitives: Sequence[Primitive],
    features: Sequence[Feature],
    surface_of: Int[np.ndarray, "p"],
) -> None:
    """Writes features.csv; docs/scene.md lists its columns."""
    rows = [_row(*each) for each in zip(names, primitives, features, surface_of.tolist(), strict=True)]
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(COLUMNS))
    writer.writeheader()
    writer.writerows(rows)
    with replacing(path) as file:
        file.write(text.getvalue().encode("utf-8"))


def _row(name: str, primitive: Primitive, feature: Feature, surface: int) -> dict[str, str]:
    errors = feature.standard_errors or {}
    direction = primitive.normal if isinstance(primitive, Plane) else getattr(primitive, "axis", None)
    radius = getattr(primitive, "radius", None)
    half_angle = getattr(primitive, "half_angle", None)
    start, end = feature.end_radii or (None, None)
    values: dict[str, Any] = {
        "name": name,
        "kind": primitive.kind,
        "side": SIDES[feature.is_hole],
        "surface": surface,
        "points": feature.num_points,
        "diameter [unit]": None if radius is None else 2 * radius,
        "diameter +- [unit]": 2 * errors["radius"] if "radius" in errors else None,
        "half-angle [deg]": _degrees(half_angle),
        "half-angle +- [deg]": _degrees(errors.get("half_angle")),
        "length [unit]": feature.length,
        "width [unit]": feature.width,
        "start radius [unit]": start,
        "end radius [unit]": end,
        "arc [deg]": _degrees(feature.arc),
        "sphere seen [%]": None if feature.solid_angle is None else 100 * feature.solid_angle / (4 * np.pi),
        "area [unit^2]": feature.area,
        **{f"position {axis} [unit]": value for axis, value in zip(AXES, feature.position, strict=True)},
        "position +- [unit]": errors.get("offset", errors.get("position")),
        **{f"direction {axis}": None if direction is None else direction[i] for i, axis in enumerate(AXES)},
        "direction +- [deg]": None if isinstance(primitive, Sphere) else _degrees(errors.get("direction")),
        "rms [unit]": feature.rms,
        "largest deviation [unit]": feature.largest_deviation,
        "warning": feature.warning,
    }
    return {column: _text(value) for column, value in values.items()}


def _degrees(angle: Any) -> float | None:
    return None if angle is None else float(np.degrees(angle))


def _text(value: Any) -> str:
    """The value with all its digits; empty where there is none or it is not finite."""
    if value is None or isinstance(value, str | int):
        return "" if value is None else str(value)
    return repr(float(value)) if np.isfinite(value) else ""


COLUMNS = tuple(
    _row("", Plane(np.zeros(3), np.float64(0)), Feature(0, 0.0, 0.0, np.zeros(3), 0.0), 0)
)  # the header, also of a file without rows
