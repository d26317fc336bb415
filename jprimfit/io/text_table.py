"""Tables for people: aligned text, angles in degrees.

Lengths are shown with the digits that the size of the scan makes meaningful, in the unit of the scan.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Int

from jprimfit.types import Cone, Cylinder, Feature, Plane, Primitive, Sphere

# Digits of a length, counted from the longest side of the scan: a 123.456 mm part is shown to the micrometre.
NUM_DIGITS = 6


def text_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns two blanks apart, numbers to the right, words to the left, a rule under the header."""
    columns = list(zip(header, *rows, strict=True))
    widths = [max(len(cell) for cell in column) for column in columns]
    to_right = [all(cell[:1] in "0123456789-+.(" or not cell for cell in column[1:]) for column in columns]
    lines = []
    for row in (header, ["-" * width for width in widths], *rows):
        cells = zip(row, widths, to_right, strict=True)
        lines.append("  ".join(c.rjust(w) if right else c.ljust(w) for c, w, right in cells).rstrip())
    return "\n".join(lines)


def length_formatter(extent: float, num_digits: int = NUM_DIGITS) -> Callable[[Any], str]:
    """Writes lengths of a scan whose longest side is `extent`; a scan below 1e-4 units gets exponents."""
    if not 0 < extent < np.inf:
        return lambda value: f"{float(value):.6g}"
    decimals = num_digits - 1 - int(np.floor(np.log10(extent)))
    if decimals > 9:
        return lambda value: f"{float(value):.{num_digits - 1}e}"
    return lambda value: _unsigned_zero(f"{float(value):.{max(decimals, 0)}f}")


def _unsigned_zero(number: str) -> str:
    """The number without the sign of a zero that it was rounded to."""
    return number if number.strip("-0.") else number.lstrip("-")


def describe(primitive: Primitive, length: Callable[[Any], str]) -> tuple[str, str, str]:
    """Size, direction and position of a primitive in words and numbers."""

    def vector(value: Any) -> str:
        return "(" + ", ".join(length(x) for x in np.asarray(value)) + ")"

    def direction(value: Any) -> str:
        return "(" + ", ".join(_unsigned_zero(f"{float(x):.4f}") for x in np.asarray(value)) + ")"

    p: Any = primitive
    if p.kind == "plane":
        return "", direction(p.normal), f"offset {length(p.offset)}"
    if p.kind == "cone":
        return f"half-angle {np.degrees(float(p.half_angle)):.3f} deg", direction(p.axis), f"apex {vector(p.apex)}"
    size = f"r = {length(p.radius)}, d = {length(2 * p.radius)}"
    return size, direction(p.axis) if p.kind == "cylinder" else "", f"center {vector(p.center)}"


def primitives_table(
    primitives: Sequence[Primitive],
    features: Sequence[Feature],
    surface_of: Int[np.ndarray, "p"],
    *,
    extent: float,
    max_rows: int | None = None,
) -> str:
    """One line per primitive, at most for the `max_rows` largest, then what speaks against relying on some of them.

    "size" is a diameter or a cone's half-angle with its standard error, "extent" length x width of a plane and length
    of a cylinder or cone, "position" types.Feature.position. An asterisk at the number points to the lines below.
    """
    length, coarse = length_formatter(extent), length_formatter(extent, NUM_DIGITS - 1)
    direction, place = _vector_formatter(lambda x: f"{x:.3f}"), _vector_formatter(coarse)
    surfaces = surface_of.tolist()
    largest = np.sort(np.argsort([-f.num_points for f in features], kind="stable")[:max_rows])
    rows, notes = [], []
    for i in map(int, largest):
        primitive, feature = primitives[i], features[i]
        first = surfaces.index(surfaces[i])
        doubts = [f"on the surface of #{first}"] * (first != i) + [feature.warning] * bool(feature.warning)
        notes += [f"* {i} {primitive.kind}: {'; '.join(doubts)}"] * bool(doubts)
        axis = primitive.normal if isinstance(primitive, Plane) else getattr(primitive, "axis", None)
        reach = [coarse(side) for side in (feature.length, feature.width) if side is not None]
        rows.append(
            [
                f"{i}{'*' if doubts else ' '}",
                called(primitive, feature),
                f"{feature.num_points:,}",
                _size(primitive, feature, length),
                " x ".join(reach),
                "" if axis is None else direction(axis),
                place(feature.position),
                length(feature.rms) if np.isfinite(feature.rms) else "-",
            ]
        )
    if not rows:
        return "no primitives found"
    header = ["#", "kind", "points", "size", "extent", "axis or normal", "position", "rms"]
    left_out = len(primitives) - len(rows)
    more = [f"and {left_out} smaller ones"] if left_out else []
    return "\n".join([text_table(header, rows), *more, *([""] if notes else []), *notes])


def called(primitive: Primitive, feature: Feature) -> str:
    """The kind, and for surfaces that curve whether they are a hole or a boss, where that is known."""
    return primitive.kind + {True: " hole", False: " boss", None: ""}[feature.is_hole]


def _size(primitive: Primitive, feature: Feature, length: Callable[[Any], str]) -> str:
    """A diameter or half-angle and its standard error."""
    errors = feature.standard_errors or {}
    if isinstance(primitive, Sphere | Cylinder):
        diameter, error = 2 * float(primitive.radius), 2 * errors.get("radius", np.inf)
        return f"d {length(diameter)} {_plus_minus(error, diameter, length)}"
    if isinstance(primitive, Cone):
        angle, error = np.degrees([float(primitive.half_angle), errors.get("half_angle", np.inf)])
        return f"{angle:.2f} {_plus_minus(error, angle, lambda x: f'{x:.2f}')} deg"
    return ""


def _plus_minus(error: float, value: float, form: Callable[[Any], str]) -> str:
    """A standard error as it stands behind a value; a question mark where it is not known or larger than that."""
    return f"+-{form(error)}" if error < value else "+-?"


def _vector_formatter(form: Callable[[Any], str]) -> Callable[[Any], str]:
    """Writes three numbers with blanks between them."""
    return lambda values: " ".join(_unsigned_zero(form(float(x))) for x in np.asarray(values))
