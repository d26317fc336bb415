"""`jprimfit demo`: the main job on the bundled scan, and the truth that its points were made from beside the answer.

Truth and answer are paired kind by kind so that the sum of their discrepancies is least (linear assignment).
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

EXAMPLES = """examples:
  jprimfit demo                     files in out/demo
  jprimfit demo --out somewhere
"""
# Direction in radians, position and size in parts of the scan: what lies further from a true surface is another one.
MAX_COST = 0.05
MAX_NAMES = 12
ASSETS = Path(__file__).resolve().parent.parent / "assets"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options to a parser."""
    parser.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="default: out/demo")


def run(arguments: argparse.Namespace) -> int:
    """Fits the bundled scan, prints its primitives and how far each lies from the truth."""
    from jprimfit.apps import fit
    from jprimfit.apps.outputs import check_target

    check_target(arguments.out)
    options = argparse.Namespace(model="default", seed=0, filter="auto", smooth="off", narrowed={})
    outcome = fit.fit_file(ASSETS / "demo.ply", arguments.out, options, say=fit._progress)
    print(fit.answer_text(outcome))
    print("\ntruth and answer; the last column says how far they are apart\n")
    print(truth_text(read_truth(ASSETS / "demo_truth.json"), outcome.scene))
    print(f"\nthe picture: {arguments.out / 'report.png'}")
    return 0


def read_truth(path: Path) -> list[Any]:
    """The primitives in the truth file, float64."""
    import numpy as np

    from jprimfit.scene import CLASSES

    entries = json.loads(path.read_text(encoding="utf-8"))["primitives"]
    classes = [CLASSES[entry["kind"]] for entry in entries]
    return [c(*(np.array(e[name], np.float64) for name in c._fields)) for c, e in zip(classes, entries, strict=True)]


def truth_text(truth: Sequence[Any], scene: Any) -> str:
    """Two lines per true primitive: its parameters, and those of the answer with the difference."""
    import numpy as np

    from jprimfit.io.text_table import describe, length_formatter, text_table

    length = length_formatter(scene.extent())
    pairs = match(truth, scene.primitives, center=np.nanmean(scene.points, axis=0), extent=scene.extent())
    rows = []
    for i, primitive in enumerate(truth):
        rows.append([primitive.kind, "truth", *describe(primitive, length), ""])
        if i not in pairs:
            rows.append(["", "not found", "", "", "", ""])
            continue
        label, difference = pairs[i]
        rows.append(
            ["", f"#{label}", *describe(scene.primitives[label], length), _apart(primitive, difference, length)]
        )
    surface_of = scene.surface_of.tolist()
    partners = {surface_of[label]: label for label, _ in pairs.values()}
    used = {label for label, _ in pairs.values()}
    extra = [
        name + (f" (on the surface of #{partners[surface_of[i]]})" if surface_of[i] in partners else "")
        for i, name in enumerate(scene.names())
        if i not in used
    ]
    table = text_table(["kind", "", "size", "axis or normal", "position", "apart"], rows)
    more = f" and {len(extra) - MAX_NAMES} more" if len(extra) > MAX_NAMES else ""
    return table + (f"\n\nfound besides: {', '.join(extra[:MAX_NAMES])}{more}" if extra else "")


def match(truth: Sequence[Any], found: Sequence[Any], *, center: Any, extent: float) -> dict[int, tuple[int, Any]]:
    """For each row of truth that has a partner in found: the partner's row and their Discrepancy, as floats.

    Offsets of planes are compared at `center`: far from the scan a small angle would look like a large shift.
    """
    import numpy as np
    from scipy.optimize import linear_sum_assignment

    pairs = {}
    for kind in ("plane", "sphere", "cylinder", "cone"):
        rows = [i for i, p in enumerate(truth) if p.kind == kind]
        columns = [j for j, p in enumerate(found) if p.kind == kind]
        apart = _discrepancies([truth[i] for i in rows], [found[j] for j in columns], np.asarray(center))
        length = 1.0 if kind == "cone" else extent  # a cone's size is an angle
        cost = np.array([[d.direction + d.position / extent + d.size / length for d in row] for row in apart])
        if cost.size:
            for i, j in zip(*linear_sum_assignment(np.minimum(cost, 2 * MAX_COST)), strict=True):
                if cost[i, j] < MAX_COST:
                    pairs[rows[i]] = (columns[j], apart[i][j])
    return pairs


def _discrepancies(truth: Sequence[Any], found: Sequence[Any], center: Any) -> list[list[Any]]:
    """A row per true primitive, a Discrepancy of floats per found one of the same kind; center becomes the origin."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jprimfit.primitives import table
    from jprimfit.types import Discrepancy

    if not truth or not found:
        return []

    def apart(a: Any, b: Any) -> Any:
        a, b = (table.transform(p, jnp.eye(3), -jnp.asarray(center), jnp.ones(())) for p in (a, b))
        return table.of(a).discrepancy(a, b)

    with jax.enable_x64(True):
        stacks = [type(p[0])(*(jnp.asarray(np.stack(x)) for x in zip(*p, strict=True))) for p in (truth, found)]
        every = jax.jit(jax.vmap(jax.vmap(apart, in_axes=(None, 0)), in_axes=(0, None)))(*stacks)
        values = np.stack([np.asarray(x) for x in every], axis=-1)
    return [[Discrepancy._make(map(float, pair)) for pair in row] for row in values]


def _apart(primitive: Any, difference: Any, length: Any) -> str:
    import numpy as np

    parts = [] if primitive.kind == "sphere" else [f"{np.degrees(float(difference.direction)):.3f} deg"]
    parts.append(f"position {length(difference.position)}")
    if primitive.kind == "cone":
        parts.append(f"half-angle {np.degrees(float(difference.size)):.3f} deg")
    elif primitive.kind != "plane":
        parts.append(f"radius {length(difference.size)}")
    return ", ".join(parts)
