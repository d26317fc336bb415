"""A small renderer in NumPy: points and triangles through a z-buffer, then shading of what each pixel shows.

Screen coordinates: x to the right, y down, in pixels, pixel (row i, column j) has its centre at (j + 0.5, i + 0.5).
The z-buffer holds one integer per pixel, depth in the high bits and the item (point or face) in the low ones, so
that "the nearest item" is a minimum. Shading happens once per visible pixel (deferred). Letters: n points, v
vertices, f faces, h x w pixels, p of them not background.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

EYE_DISTANCE = 4.0  # of the eye from the middle, in radii of the scene: a long lens
MARGIN = 0.04  # of the panel stays free on each side
DEPTH_BITS = 30
CHUNK = 1_000_000  # candidate pixels per pass of the triangle rasteriser
GRAIN = 1e-4  # of a triangle: what float32 may miss at shared edges
NOISE = 0.008  # depth steps up to this many radii cast no shadow
EMPTY = np.iinfo(np.int64).max
# Directions of the two lamps from the surface, in (right, up, towards the viewer), and what they and the sky add.
LAMPS = ((np.array([-0.35, 0.75, 0.55]), 0.38), (np.array([0.80, 0.10, 0.60]), 0.26))
AMBIENT = 0.48
SOFTNESS = 0.7  # power of the light: the eye, and the screen's transfer curve, see less contrast
SHINE = 0.10


class Camera(NamedTuple):
    """A perspective camera; rows of rotation are right, up and back (towards the viewer)."""

    rotation: Float[np.ndarray, "3 3"]
    center: Float[np.ndarray, "3"]  # in the middle of the scene
    radius: float  # of the scene about the centre
    zoom: float  # pixels per unit of slope
    offset: Float[np.ndarray, "2"]  # screen position of the optical axis, pixels
    shape: tuple[int, int]  # rows, columns


class Screen(NamedTuple):
    """Projected points."""

    position: Float[np.ndarray, "n 2"]  # pixels
    depth: Float[np.ndarray, "n"]  # distance from the eye along the optical axis


class Buffer(NamedTuple):
    """What each pixel shows."""

    item: Int[np.ndarray, "h w"]  # row of the point or face, -1 where there is none
    depth: Float[np.ndarray, "h w"]  # as Screen.depth, infinite where there is none


def camera(
    points: Float[np.ndarray, "n 3"],
    *,
    back: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
    shape: tuple[int, int],
) -> Camera:
    """The camera that looks against `back` and has all points in the picture, as large as the margin allows."""
    back = back / np.sqrt(back @ back)
    right = np.cross(up, back)
    right = right / np.sqrt(right @ right)
    rotation = np.stack([right, np.cross(back, right), back])
    local = np.einsum("nc,dc->nd", points, rotation)
    center = (local.min(axis=0) + local.max(axis=0)) / 2
    radius = float(np.sqrt(np.sum((local - center[None, :]) ** 2, axis=1).max())) or 1.0
    plain = Camera(rotation, rotation.T @ center, radius, 1.0, np.zeros(2), shape)
    slope = project(plain, points).position
    low, high = slope.min(axis=0), slope.max(axis=0)
    room = (1 - 2 * MARGIN) * np.array([shape[1], shape[0]])
    zoom = float(np.min(room / np.maximum(high - low, 1e-6)))
    middle = np.array([shape[1], shape[0]]) / 2
    return plain._replace(zoom=zoom, offset=middle - zoom * (low + high) / 2)


def project(view: Camera, points: Float[np.ndarray, "n 3"]) -> Screen:
    """Where points fall on the screen."""
    local = np.einsum("nc,dc->nd", points - view.center[None, :], view.rotation)
    depth = EYE_DISTANCE * view.radius - local[:, 2]
    slope = local[:, :2] / depth[:, None] * np.array([[1.0, -1.0]])
    return Screen(view.offset[None, :] + view.zoom * slope, depth)


def splat(view: Camera, screen: Screen, *, radius: float, cover: float = 0.0) -> Buffer:
    """Every point as a disc of `radius` pixels that faces the viewer; nearer discs hide farther ones.

    The discs are drawn half as large again and trimmed by as much where they end at something farther away: what
    shines through between them is hidden, silhouettes stay where they were.

    Args:
        view: the camera.
        screen: the points as it sees them.
        radius: of a disc, pixels.
        cover: as of `visible`, so that no back side is seen between the points of a front side.
    """
    rows, columns = view.shape
    shown = np.flatnonzero(visible(view, screen, cover=cover))
    cell = np.floor(screen.position[shown]).astype(np.int64)
    key = np.full(rows * columns, EMPTY)
    np.minimum.at(key, cell[:, 1] * columns + cell[:, 0], _keys(view, screen.depth[shown], shown))
    # The nearest of all discs over a pixel is the least key within a disc around it: a minimum filter.
    grown = _filtered(key.reshape(rows, columns), radius * 1.5, np.minimum)
    return _buffer(view, _filtered(grown, radius * 0.5, np.maximum))


def visible(view: Camera, screen: Screen, *, cover: float) -> Bool[np.ndarray, "n"]:
    """Which points are in the picture and not hidden.

    cover: length in the points' unit; where positive, a point hides all that lies within this of its line of sight
    and is much farther away.
    """
    rows, columns = view.shape
    cell = np.floor(screen.position).astype(np.int64)
    inside = (cell >= 0).all(axis=1) & (cell[:, 0] < columns) & (cell[:, 1] < rows)
    if cover > 0.0:
        inside[inside] = _in_front(view, cell[inside], screen.depth[inside], cover)
    return inside


def rasterize(view: Camera, screen: Screen, faces: Int[np.ndarray, "f 3"]) -> Buffer:
    """Triangles of projected vertices, both sides; each pixel takes the nearest triangle over its centre."""
    rows, columns = view.shape
    corner = screen.position[faces]
    a, b, c = (corner[:, i] for i in range(3))
    first = np.maximum(np.ceil(np.minimum(np.minimum(a, b), c) - 0.5), 0).astype(np.int32)
    last = np.minimum(np.floor(np.maximum(np.maximum(a, b), c) - 0.5), np.array([[columns - 1, rows - 1]])).astype(
        np.int32
    )
    width, height = np.maximum(last - first + 1, 0).T
    seen = np.flatnonzero(width * height)
    slopes = _slopes(corner[seen], first[seen] + 0.5, screen.depth[faces[seen]])
    width, first, count = width[seen], first[seen], (width * height)[seen]
    total = np.cumsum(count)
    key = np.full(rows * columns, EMPTY)
    start = 0
    while start < len(seen):
        end = max(int(np.searchsorted(total, total[start] - count[start] + CHUNK)), start + 1)
        owner = np.repeat(np.arange(start, end), count[start:end])
        place = np.arange(len(owner)) - (total[owner] - count[owner] - total[start] + count[start])
        y, x = np.divmod(place.astype(np.int32), width[owner])
        second, third, closeness = _at(slopes, owner, x, y)
        hit = np.flatnonzero((second >= -GRAIN) & (third >= -GRAIN) & (second + third <= 1 + GRAIN))
        owner = owner[hit]
        pixel = (first[owner, 1] + y[hit]).astype(np.int64) * columns + first[owner, 0] + x[hit]
        np.minimum.at(key, pixel, _keys(view, 1.0 / closeness[hit].astype(np.float64), seen[owner]))
        start = end
    return _buffer(view, key.reshape(rows, columns))


def interpolate(
    screen: Screen, faces: Int[np.ndarray, "f 3"], values: Float[np.ndarray, "v c"], seen: Buffer
) -> Float[np.ndarray, "p c"]:
    """Values of vertices at the p visible pixels of a rasterised mesh, in row-major order of the pixels."""
    y, x = np.nonzero(seen.item >= 0)
    shown, owner = np.unique(seen.item[y, x], return_inverse=True)
    face = faces[shown]
    slopes = _slopes(screen.position[face], np.full((len(face), 2), 0.5), screen.depth[face])
    second, third, _ = (weight[:, None] for weight in _at(slopes, owner, x, y))
    a, b, c = (values[face[:, i]].astype(np.float32)[owner] for i in range(3))
    return a + second * (b - a) + third * (c - a)


class Light(NamedTuple):
    """What the p visible pixels receive."""

    diffuse: Float[np.ndarray, "p"]  # multiplies the colour
    glint: Float[np.ndarray, "p"]  # is added to it


def light(view: Camera, seen: Buffer, normals: Float[np.ndarray, "p 3"]) -> Light:
    """Two-sided Lambert light on the p visible pixels, darker where the depth falls off behind an edge."""
    local = normals.astype(np.float32) @ view.rotation.T.astype(np.float32)
    length = np.sqrt(np.einsum("pd,pd->p", local, local))[:, None]
    local = local * (np.where(local[:, 2:] < 0, -1.0, 1.0).astype(np.float32) / np.maximum(length, 1e-12))
    diffuse = np.full(len(local), AMBIENT, np.float32)
    for direction, strength in LAMPS:
        diffuse += strength * np.maximum(_cosine(local, direction), 0.0)
    halfway = LAMPS[0][0] / np.sqrt(LAMPS[0][0] @ LAMPS[0][0]) + np.array([0.0, 0.0, 1.0])
    glint = np.maximum(_cosine(local, halfway), 0.0) ** 2
    glint = SHINE * np.square(np.square(glint * glint * glint))  # the 24th power; np.power takes 30 times longer
    shadow = eye_dome(view, seen).ravel()[np.flatnonzero(seen.item >= 0)]
    return Light(diffuse**SOFTNESS * shadow, glint * shadow)


def paint(
    seen: Buffer, lit: Light, colors: Float[np.ndarray, "p 3"], background: Float[np.ndarray, "3"], *, factor: int
) -> UInt8[np.ndarray, "rows columns 3"]:
    """The picture of the p visible pixels on a plain background, averaged over factor x factor pixels."""
    rows, columns = seen.item.shape
    image = np.empty((rows * columns, 3), np.float32)
    image[:] = background
    image[np.flatnonzero(seen.item >= 0)] = colors.astype(np.float32) * lit.diffuse[:, None] + lit.glint[:, None]
    image = np.minimum(image, 1.0).reshape(rows, columns, 3)
    parts = [image[i::factor, j::factor] for i in range(factor) for j in range(factor)]
    return np.round(sum(parts[1:], parts[0]) * (255 / factor**2)).astype(np.uint8)


def eye_dome(view: Camera, seen: Buffer, *, strength: float = 9.0) -> Float[np.ndarray, "h w"]:
    """How bright each pixel stays in the shadow of nearer neighbours, in (0, 1]; the background is 1.

    "Eye-dome lighting" of C. Boucheny (2009): only the depth is needed, so it makes bare points readable. Computed
    for every second pixel, and single points that hover before a surface cast no shadow.
    """
    visible = seen.item >= 0
    far = (EYE_DISTANCE + 2) * view.radius
    depth = np.where(visible, seen.depth, far)[::2, ::2].astype(np.float32) / np.float32(view.radius)
    blob = max(view.shape[0] // 130, 3)
    depth = ndimage.minimum_filter(ndimage.maximum_filter(depth, blob), blob)
    shadow = np.zeros(depth.shape, np.float32)
    steps = (1, max(view.shape[0] // 250, 2))
    for step in steps:
        for i, j in ((0, step), (step, 0), (0, -step), (-step, 0)):
            target, source = _overlap(i, j)
            shadow[target] += np.clip(depth[target] - depth[source] - NOISE, 0.0, 0.08)
    kept = np.exp(-strength / (2 * len(steps)) * shadow).repeat(2, axis=0).repeat(2, axis=1)
    return np.where(visible, kept[: view.shape[0], : view.shape[1]], 1.0)


def smooth_normals(seen: Buffer, normals: Float[np.ndarray, "p 3"], *, sigma: float) -> Float[np.ndarray, "p 3"]:
    """Normals of visible pixels (facing the viewer) averaged over their surroundings, to calm a noisy scan."""
    visible = seen.item >= 0
    planes = []
    for values in normals.T:
        plane = np.zeros(visible.shape, np.float32)
        plane[visible] = values
        planes.append(ndimage.gaussian_filter(plane, sigma)[visible])
    return np.stack(planes, axis=1)


def _cosine(unit: np.ndarray, direction: np.ndarray) -> np.ndarray:
    return unit @ (direction / np.sqrt(direction @ direction)).astype(np.float32)


def _in_front(view: Camera, cell: np.ndarray, depth: np.ndarray, cover: float) -> np.ndarray:
    """Which points (in pixels `cell`) are not hidden: on a coarse screen, in one of four quadrants nothing is nearer.

    A surface seen at a slant has nearer parts on one side only, whatever hides a point has them all around. After
    the sector test of R. Pintus, E. Gobbetti and M. Agus (2011), "Real-time rendering of massive unstructured raw point
    clouds using screen-space operators".
    """
    reach = view.zoom * cover / (EYE_DISTANCE * view.radius)
    grain = max(int(reach / 4), 1)
    size = int(np.ceil(reach / grain))
    coarse = tuple((cell // grain).T[::-1])
    nearest = np.full(-(-np.array(view.shape) // grain), np.inf)
    np.minimum.at(nearest, coarse, depth)
    visible = np.zeros(len(depth), bool)
    for down in (1, -1):
        for right in (1, -1):
            flipped = nearest[::down, ::right]
            for axis in (0, 1):
                # This origin makes the window end with the pixel itself.
                flipped = ndimage.minimum_filter1d(
                    flipped, size + 1, axis=axis, origin=size // 2, mode="constant", cval=np.inf
                )
            visible |= depth <= flipped[::down, ::right][coarse] + cover
    return visible


def _slopes(corner: np.ndarray, origin: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """(f, 3, 3) float32: value at origin, slope in x, slope in y of the weights of corners 1 and 2, and of 1 / depth.

    1 / depth, not depth, is linear on the screen. Triangles without area get weights of -1 everywhere.
    """
    (ax, ay), (bx, by), (cx, cy) = (corner[:, i].T for i in range(3))
    double_area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    flat = np.abs(double_area) < 1e-9
    scale = np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, double_area))
    slope = np.zeros((len(corner), 3, 3))
    slope[:, 0, 1:] = np.stack([(cy - ay) * scale, (ax - cx) * scale], axis=1)
    slope[:, 1, 1:] = np.stack([(ay - by) * scale, (bx - ax) * scale], axis=1)
    closeness = 1.0 / depth
    slope[:, 2, 1:] = slope[:, 0, 1:] * (closeness[:, 1:2] - closeness[:, :1])
    slope[:, 2, 1:] += slope[:, 1, 1:] * (closeness[:, 2:] - closeness[:, :1])
    slope[:, :, 0] = np.einsum("fks,fs->fk", slope[:, :, 1:], origin - corner[:, 0])
    slope[:, 2, 0] += closeness[:, 0]
    slope[flat, :2, 0] = -1.0
    return slope.astype(np.float32)


def _at(slopes: np.ndarray, owner: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
    """The three values of _slopes at pixels (x, y) from the origin of their owner."""
    x, y = x.astype(np.float32), y.astype(np.float32)
    own = slopes[owner]
    return tuple(own[:, i, 0] + own[:, i, 1] * x + own[:, i, 2] * y for i in range(3))


def _filtered(key: np.ndarray, radius: float, choose: np.ufunc) -> np.ndarray:
    """The least (np.minimum) or greatest (np.maximum) value within a disc around each pixel.

    A disc is a stack of rows; rows of growing half width are filtered once and shifted up and down to their places.
    """
    found, row, reach = key.copy(), key.copy(), int(np.floor(radius))
    half_width = np.floor(np.sqrt(np.maximum(radius**2 - np.arange(reach + 1) ** 2, 0))).astype(int)
    for width in range(reach + 1):
        for j in {-width, width} - {0}:
            target, source = _overlap(0, j)
            choose(row[target], key[source], out=row[target])
        for i in np.flatnonzero(half_width == width).tolist():
            for shift in {-i, i}:
                target, source = _overlap(shift, 0)
                choose(found[target], row[source], out=found[target])
    return found


def _overlap(i: int, j: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of the pixels that have a neighbour i rows down and j columns to the right, and of those neighbours."""
    here = tuple(slice(max(-s, 0), -s if s > 0 else None) for s in (i, j))
    there = tuple(slice(max(s, 0), s if s < 0 else None) for s in (i, j))
    return (here[0], here[1]), (there[0], there[1])


def _depth_range(view: Camera) -> tuple[float, float]:
    # A little more than the scene: patches may reach beyond the points that the camera was fitted to.
    return (EYE_DISTANCE - 2) * view.radius, 4 * view.radius


def _keys(view: Camera, depth: np.ndarray, item: np.ndarray) -> np.ndarray:
    nearest, span = _depth_range(view)
    level = np.clip((depth - nearest) / span, 0.0, 1.0) * (2**DEPTH_BITS - 1)
    return (level.astype(np.int64) << 32) | item


def _buffer(view: Camera, key: np.ndarray) -> Buffer:
    nearest, span = _depth_range(view)
    empty = key == EMPTY
    depth = nearest + span * (key >> 32) / (2**DEPTH_BITS - 1)
    return Buffer(np.where(empty, -1, key & 0xFFFFFFFF).astype(np.int32), np.where(empty, np.inf, depth))
