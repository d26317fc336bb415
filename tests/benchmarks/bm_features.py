"""How true features are: extents, areas, holes and bosses of generated parts, from true labels and true primitives.

python tests/benchmarks/bm_features.py DATASET.h5 [...] [--parts 100] [--points 65536] [--noise 0.0]
Noise is isotropic, in the normalised frame (longest side of the box = 2). Prints, for each extent, the share of
features within 1 % and the quantiles of the relative error, for features of at least --min-points points.
"""

import argparse
import sys
import time
from collections import defaultdict

import numpy as np

from jprimfit.cad import charts, extents, patches
from jprimfit.cad.features import features
from jprimfit.data import native, surfaces
from jprimfit.types import Cone, Plane, Sphere


def say(*words):
    """A line on the terminal."""
    sys.stdout.write(" ".join(map(str, words)) + "\n")


def true_extents(part):
    """The extents of each instance by the corners of its triangles, and whether it is a hole."""
    corners = part.mesh.vertices.astype(np.float64)[part.mesh.faces]
    for label, primitive in enumerate(part.primitives):
        mine = corners[part.mesh.labels == label]
        outwards = np.cross(mine[:, 1] - mine[:, 0], mine[:, 2] - mine[:, 0])
        side = np.sum(outwards * charts.normals(primitive, mine.mean(axis=1)))
        truth = {"area": float(part.areas[label]), "is_hole": bool(side < 0)}
        points = np.unique(mine.reshape(-1, 3), axis=0)
        if isinstance(primitive, Plane):
            box = extents._box(primitive, np.repeat(points, 40, axis=0), 0.0)  # so often that no end is extrapolated
            truth |= {"length": box["length"], "width": box["width"]}
        elif not isinstance(primitive, Sphere):
            origin = primitive.apex if isinstance(primitive, Cone) else primitive.center
            local = (points - origin) @ charts.frame(primitive.axis).T
            angles = np.arctan2(local[:, 1], local[:, 0])[np.hypot(local[:, 0], local[:, 1]) > 1e-6]
            turn = charts.angular_interval(angles, gap=2 * np.pi / 20)
            truth |= {"length": float(np.ptp(local[:, 2])), "arc": turn.width}
            if isinstance(primitive, Cone):
                radii = np.array([local[:, 2].min(), local[:, 2].max()]) * np.tan(primitive.half_angle)
                truth |= {"small_radius": radii[0], "large_radius": radii[1]}
        yield truth


def measured(feature):
    """A feature's fields under the names of true_extents."""
    found = {name: getattr(feature, name) for name in ("area", "length", "width", "arc", "is_hole")}
    if feature.end_radii:
        found |= {"small_radius": feature.end_radii[0], "large_radius": feature.end_radii[1]}
    return found


def compare(part, errors, sides, *, num_points, noise, min_points, show=0.05):
    """Adds one part's relative errors and sides; seconds for (patches, features)."""
    cloud = surfaces.draw(part, num_points=num_points, seed=1, num_samples=0)
    points = cloud.points + noise * np.random.default_rng(0).standard_normal(cloud.points.shape)
    rows_of = [np.flatnonzero(cloud.labels == i) for i in range(len(part.primitives))]
    begin = time.perf_counter()
    trimmed = patches.of_faces(part.primitives, points, cloud.labels)
    between = time.perf_counter()
    found = features(part.primitives, points, rows_of, trimmed)
    end = time.perf_counter()
    for i, (truth, feature) in enumerate(zip(true_extents(part), found, strict=True)):
        kind, values = part.primitives[i].kind, measured(feature)
        if kind != "plane":
            sides.append((truth["is_hole"], values["is_hole"], feature.num_points))
            if values["is_hole"] is not None and values["is_hole"] != truth["is_hole"]:
                say("wrong side", part.name, part.family, kind, feature.num_points)
        if feature.num_points < min_points:
            continue
        large = truth.get("large_radius")
        for name in set(truth) - {"is_hole"}:
            scale = large if name == "small_radius" else truth[name]
            error = (values[name] - truth[name]) / scale
            errors[kind, name].append(error)
            if abs(error) > show:
                say(
                    f"{part.name} {part.family} {kind}_{i} {name}: {values[name]:.4f}, true {truth[name]:.4f}",
                    feature.num_points,
                )
    return between - begin, end - between


def main():
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("datasets", nargs="+")
    parser.add_argument("--parts", type=int, default=100)
    parser.add_argument("--points", type=int, default=65_536)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--min-points", type=int, default=200)
    arguments = parser.parse_args()
    errors, sides, seconds = defaultdict(list), [], []
    for path in arguments.datasets:
        with native.Dataset(path) as dataset:
            rows = np.random.default_rng(0).choice(
                len(dataset.names), arguments.parts // len(arguments.datasets), False
            )
            for row in rows.tolist():
                settings = {
                    "num_points": arguments.points,
                    "noise": arguments.noise,
                    "min_points": arguments.min_points,
                }
                seconds.append(compare(dataset[row], errors, sides, **settings))
    say(f"{'extent':24} {'number':>6} {'within 1 %':>10} {'median':>8} {'5 %':>8} {'95 %':>8}")
    for (kind, name), values in sorted(errors.items()):
        v = np.array(values)
        quantiles = "".join(f" {100 * q:+7.2f}%" for q in np.quantile(v, [0.5, 0.05, 0.95]))
        say(f"{kind + ' ' + name:24} {len(v):6} {100 * np.mean(np.abs(v) < 0.01):9.1f}%{quantiles}")
    every = np.concatenate([np.array(values) for values in errors.values()])
    say(f"all extents: {100 * np.mean(np.abs(every) < 0.01):.1f} % of {len(every)} within 1 %")
    told = [(truth, found) for truth, found, _ in sides if found is not None]
    right = np.mean([truth == found for truth, found in told])
    say(f"sides: {100 * right:.2f} % right of {len(told)} told, {len(sides) - len(told)} not told")
    say("seconds per part, patches and features:", np.round(np.mean(seconds, axis=0), 3))


if __name__ == "__main__":
    main()
