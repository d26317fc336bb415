"""Makes the scan that `jprimfit demo` shows: a flange bracket in millimetres, seen by a scanner from above.

Writes jprimfit/assets/demo.ply and jprimfit/assets/demo_truth.json. The part is a boolean of solids in manifold3d; each
triangle of the result knows the solid it came from, hence the plane, sphere, cylinder or cone it stands for. Points are
drawn by area, moved onto that exact surface, kept with the chance that the views of a scanner on a turntable give them
(the underside on the table and the depths of the holes stay empty), blurred by isotropic noise and put in some pose.
Own arithmetic throughout, nothing of jprimfit: the truth must not depend on the code that it judges.

    python scripts/make_demo_scan.py        # same versions of numpy and manifold3d: the same bytes
"""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from manifold3d import CrossSection, Manifold

SEED = 20240822
NUM_POINTS = 24_000
NUM_CANDIDATES = 60_000
NUM_BLOCKERS = 1_500_000
PIXEL = 0.5  # mm of the depth buffer: holds about fifteen blockers
NOISE = 0.03  # mm per coordinate: a good structured-light scanner at this size of part
NUM_SEGMENTS = 128  # of a full circle: at radius 36 the triangles lie 0.01 mm off the surface; points are moved onto it
ELEVATIONS = {35.0: 8, 60.0: 8, 80.0: 4}  # degrees above the table: views evenly around the part
ASSETS = Path(__file__).resolve().parent.parent / "jprimfit" / "assets"


class Face(NamedTuple):
    """One surface in the frame of the part, where every axis of revolution is parallel to z."""

    kind: str
    normal: tuple = (0.0, 0.0, 1.0)  # plane: normal·x = offset
    offset: float = 0.0
    center: tuple = (0.0, 0.0, 0.0)  # sphere: centre; cylinder: a point of the axis; cone: apex
    radius: float = 0.0  # sphere, cylinder
    slope: float = 0.0  # cone: radius gained per unit of z from the apex, negative for an apex on top

    def project(self, points):
        """Points (n, 3) moved onto the surface; on a cone along the radius, which is as exact and nearly as near."""
        if self.kind == "plane":
            normal = np.asarray(self.normal)
            return points - (points @ normal - self.offset)[:, None] * normal
        rays = points - self.center
        if self.kind != "sphere":
            rays[:, 2] = 0.0
        radius = np.abs(self.slope * (points[:, 2] - self.center[2])) if self.kind == "cone" else self.radius
        length = np.maximum(np.linalg.norm(rays, axis=1), 1e-9)  # corners of a plane may lie on the axis of its solid
        moved = self.center + rays * (radius / length)[:, None]
        if self.kind != "sphere":
            moved[:, 2] = points[:, 2]
        return moved


def box(low, high):
    """An axis-aligned box and its six planes."""
    solid = Manifold.cube(tuple(np.subtract(high, low))).translate(tuple(low))
    return solid, [Face("plane", tuple(np.eye(3)[i]), float(side[i])) for side in (low, high) for i in range(3)]


def turned(x, y, profile):
    """A solid of revolution about the vertical line through (x, y), from a closed polygon of (radius, z)."""
    solid = Manifold.revolve(CrossSection([np.asarray(profile, float)]), NUM_SEGMENTS).translate((x, y, 0.0))
    faces = []
    for (r0, z0), (r1, z1) in zip(profile, profile[1:] + profile[:1], strict=True):
        if z0 == z1:
            faces.append(Face("plane", offset=float(z0)))
        elif r0 == r1 and r0 > 0:
            faces.append(Face("cylinder", center=(x, y, 0.0), radius=float(r0)))
        elif r0 != r1:
            slope = (r1 - r0) / (z1 - z0)
            faces.append(Face("cone", center=(x, y, z0 - r0 / slope), slope=slope))
    return solid, faces


def ball(center, radius):
    """A full ball."""
    return Manifold.sphere(radius, NUM_SEGMENTS).translate(center), [Face("sphere", center=center, radius=radius)]


def prism(profile, y0, y1):
    """A vertical plate between y0 and y1 whose outline is a polygon of (x, z), counter-clockwise."""
    solid = Manifold.extrude(CrossSection([np.asarray(profile, float)]), y1 - y0)
    solid = solid.rotate((90.0, 0.0, 0.0)).translate((0.0, y1, 0.0))
    faces = [Face("plane", (0.0, 1.0, 0.0), y0), Face("plane", (0.0, 1.0, 0.0), y1)]
    for start, end in zip(profile, profile[1:] + profile[:1], strict=True):
        along = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
        normal = (along[1], 0.0, -along[0])
        faces.append(Face("plane", normal, float(normal[0] * start[0] + normal[2] * start[1])))
    return solid, faces


def part():
    """The flange bracket, and a dictionary from the number of each solid used to its faces."""
    faces = {}

    def original(solid_and_faces):
        solid = solid_and_faces[0].as_original()
        faces[solid.original_id()] = solid_and_faces[1]
        return solid

    rise = 24 / 22  # of the rib, from (-18, 12) to (4, 36)
    added = [
        original(prism([(-60, 0), (16, 0), (16, 12), (-55, 12), (-60, 7)], -30.0, 30.0)),  # base plate, bevelled
        original(turned(22, 0, [(0, 0), (36, 0), (36, 12), (0, 12)])),  # flange
        original(turned(22, 0, [(0, 6), (20, 6), (20, 38), (16, 42), (0, 42)])),  # boss with a chamfer
        original(prism([(-18 - 2 / rise, 10), (6, 10), (6, 12 + 24 * rise)], -4.0, 4.0)),  # rib
        original(turned(-24, 17, [(0, 6), (13.5, 6), (5.25, 28), (0, 28)])),  # tapered post
        original(ball((-24.0, 17.0, 34.0), 10.0)),  # ball end
    ]
    removed = [
        original(turned(22, 0, [(0, -5), (9, -5), (9, 30), (13, 30), (13, 50), (0, 50)])),  # stepped bore
        original(turned(-24, -17, [(0, 6), (9.5, 6), (9.5, 20), (0, 20)])),  # blind pocket
        original(turned(-46, -17, [(0, -5), (5, -5), (5, 7), (11, 13), (0, 13)])),  # countersunk holes
        original(turned(-46, 17, [(0, -5), (5, -5), (5, 7), (11, 13), (0, 13)])),
    ]
    solid = added[0]
    for other in added[1:]:
        solid = solid + other
    for other in removed:
        solid = solid - other
    return solid, faces


def faces_of_triangles(solid, faces):
    """Corners (t, 3, 3) of the triangles, the faces in use, and which of them each triangle stands for (t,)."""
    mesh = solid.to_mesh64()
    corners = np.asarray(mesh.vert_properties)[:, :3][np.asarray(mesh.tri_verts)]
    runs = np.asarray(mesh.run_index) // 3
    used, face_index = [], np.zeros(len(corners), int)
    for run, number in enumerate(mesh.run_original_id):
        rows = slice(runs[run], runs[run + 1])
        inside = corners[rows].reshape(-1, 3)
        offsets = np.stack([np.linalg.norm(f.project(inside) - inside, axis=1) for f in faces[number]])
        farthest = offsets.reshape(len(faces[number]), -1, 3).max(2)  # a face is that of all three corners
        if farthest.size and farthest.min(0).max() > 0.05:
            raise RuntimeError("a triangle lies on no surface of the solid it came from")
        for row, best in enumerate(farthest.argmin(0)):
            face = faces[number][best]
            if face not in used:
                used.append(face)
            face_index[runs[run] + row] = used.index(face)
    return corners, used, face_index


def drawn(corners, num_points, random):
    """Points (n, 3) on the triangles by area, and the triangle of each (n,)."""
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    triangle = random.choice(len(corners), num_points, p=area / area.sum())
    a, b = np.sort(random.random((2, num_points)), axis=0)
    weights = np.stack([a, b - a, 1 - b], axis=1)
    return np.einsum("nc,ncd->nd", weights, corners[triangle]), triangle


def pixel_of(points, view):
    """The pixel (n,) of each point in an image of 1024 x 1024 seen along view (3,), which is not vertical."""
    across = np.array([-view[1], view[0], 0.0]) / np.hypot(view[0], view[1])
    image = np.stack([points @ across, points @ np.cross(view, across)], axis=1)
    return (np.floor(image / PIXEL).astype(int) + 512) @ np.array([1024, 1])


def seen(points, normals, blockers):
    """The scanner's light on each point: cosines of incidence summed over the views that reach it.

    A view is a parallel projection with a depth buffer, filled by blockers (m, 3), dense points of the whole surface.
    """
    light = np.zeros(len(points))
    for elevation, count in ELEVATIONS.items():
        for turn in np.arange(count) * (2 * np.pi / count) + 0.2:
            up = np.radians(elevation)
            view = np.array([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)])
            nearest = np.full(1024 * 1024, -np.inf)
            np.maximum.at(nearest, pixel_of(blockers, view), blockers @ view)
            cosine = normals @ view
            slack = 0.2 + 1.5 * PIXEL / np.maximum(cosine, 0.1)  # the depth that one pixel of a tilted surface spans
            lit = points @ view > nearest[pixel_of(points, view)] - slack
            lit &= cosine > 0.15  # more grazing light comes back too weak
            light += np.where(lit, cosine, 0.0)
    return light


def scan(solid, faces, random):
    """Points (n, 3) on the exact surfaces as the scanner meets them, the faces, and the face of each point (n,)."""
    corners, used, face_index = faces_of_triangles(solid, faces)
    points, triangle = drawn(corners, NUM_CANDIDATES, random)
    labels = face_index[triangle]
    for index, face in enumerate(used):
        points[labels == index] = face.project(points[labels == index])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[triangle]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = seen(points, normals, drawn(corners, NUM_BLOCKERS, random)[0])
    chance = np.minimum(light, 4.0)  # a surface lit by many views is merged to an even density
    kept = random.choice(NUM_CANDIDATES, NUM_POINTS, replace=False, p=chance / chance.sum())
    return points[kept], used, labels[kept]


def rotation(random):
    """A rotation drawn uniformly, from a unit quaternion."""
    w, x, y, z = (q := random.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def truth(face, points, turn, shift):
    """The parameters of a face after x -> turn·x + shift, in the gauge of jprimfit/types.py; points are its own."""
    positive = lambda v: v * np.sign(v[np.argmax(np.abs(v))])  # noqa: E731
    center = turn @ np.asarray(face.center) + shift
    if face.kind == "plane":
        normal = turn @ np.asarray(face.normal)
        offset = face.offset + normal @ shift
        sign = np.sign(normal[np.argmax(np.abs(normal))])
        found = {"normal": sign * normal, "offset": sign * offset}
    elif face.kind == "sphere":
        found = {"center": center, "radius": face.radius}
    elif face.kind == "cylinder":
        axis = positive(turn[:, 2])
        found = {"axis": axis, "center": center + axis * (axis @ (points.mean(0) - center)), "radius": face.radius}
    else:
        half_angle = np.arctan(abs(face.slope))
        found = {"axis": turn[:, 2] * np.sign(face.slope), "apex": center, "half_angle": half_angle}
    return {"kind": face.kind, **{k: np.round(v, 9).tolist() for k, v in found.items()}, "num_points": len(points)}


def write_ply(path, points):
    """Points (n, 3) as a binary PLY of float32."""
    header = f"ply\nformat binary_little_endian 1.0\ncomment unit millimetre\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_bytes(header.encode("ascii") + points.astype("<f4").tobytes())


def main():
    """Writes both files and says what is in them."""
    random = np.random.default_rng(SEED)
    exact, faces, labels = scan(*part(), random)
    turn, shift = rotation(random), random.uniform(-300.0, 300.0, 3)
    points = exact @ turn.T + shift + random.normal(scale=NOISE, size=exact.shape)
    surfaces = [truth(f, points[labels == i], turn, shift) for i, f in enumerate(faces) if np.any(labels == i)]
    surfaces.sort(key=lambda surface: -surface["num_points"])
    ASSETS.mkdir(exist_ok=True)
    write_ply(ASSETS / "demo.ply", points)
    document = {"unit": "mm", "noise": NOISE, "primitives": surfaces}
    (ASSETS / "demo_truth.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    for surface in surfaces:
        print(*(f"{key} {value}" for key, value in surface.items()))


if __name__ == "__main__":
    main()
