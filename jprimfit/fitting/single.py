"""One segment, one primitive, as well as the points allow: `jprimfit.fit_primitive`.

A start (closed form from the normals, or a search without them) is polished by least squares on a sample, then the
corrected equations of `primitives/estimation.py` are solved on all points (written out for the host in `planes.py`,
`spheres.py` and `axial.py`, without compiling), and for a cone seen all round the likelihood
(`full_cone.py`). All of it in float64, on points that were shifted to their mean and divided by their size first.
n points, p unknowns of the kind.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jprimfit.fitting import associations, axial, full_cone, kinds, planes, segments, spheres, starts
from jprimfit.fitting.info import STEP_UNITS, Info, reported, semidefinite
from jprimfit.fitting.segments import Segment
from jprimfit.geometry.linalg import frame_of
from jprimfit.primitives.estimation import Estimate
from jprimfit.primitives.table import KINDS, MODULES
from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

METHODS = ("best", "unbiased", "least-squares", *associations.METHODS)
SAMPLE = 1_024  # points of the search for a start
NOISY = 0.05  # sizes of the segment: noise beyond which several starts may be tried
MANY = 4_096  # points on which that is decided, and they are
SETTLED = 0.98  # of its noise: no other start leads to less
MAX_BLOB = 0.35  # noise over the distance from the center or axis that a surface seen from all sides may have
MIN_PADDED = 256
OUTLIER = 3.5  # distances beyond so many standard deviations (from the median) are left out of a robust fit
ROUNDS = 3  # of a robust fit's choice of points
NORMAL_SHARE = 0.6745  # the median of |x| for a normal x of standard deviation 1


def fit_primitive(
    kind: str, points: Any, weights: Any = None, normals: Any = None, *, method: str = "best", robust: bool = False
) -> tuple[Primitive, Info]:
    """The plane, sphere, cylinder or cone through the points of one segment, without bias from their noise.

    Args:
        kind: "plane", "sphere", "cylinder" or "cone".
        points: (n, 3), any unit and position; computed in float64.
        weights: (n,), >= 0, how much each point counts; all alike if not given.
        normals: (n, 3), of any length and sign. They only give the start of a cylinder or cone, which is searched for
            without them.
        method: "best" is "unbiased" and, for a cone that was seen evenly all round, the likelihood of that; "unbiased"
            asks nothing of where the surface was seen. "least-squares" of the distances is biased by noise on curved
            surfaces (+sigma^2 / r on a whole sphere); inspectors know it as Gaussian. For planes, spheres and
            cylinders there are "minimum-zone" (least largest distance; Chebyshev), and for spheres and cylinders
            "maximum-inscribed" and "minimum-circumscribed": a few extreme points decide, weights above 0 count alike.
        robust: leave out points that lie off the surface by more than the noise explains (scale from the median).

    Returns:
        (primitive, info), float64 in the unit and frame of the points; a cylinder's center is the axis point nearest
        their mean.

    Raises:
        ValueError: one sentence, where the arguments are no segment. A segment that does not determine the primitive
            is no error: info.ok is False.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown kind of primitive {kind!r}: expected one of {', '.join(KINDS)}.")
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}: expected one of {', '.join(METHODS)}.")
    associations.refuse(method, kind)
    given = segments.segment(points, weights, normals)
    with jax.enable_x64(True):
        found = _found(kind, given, method, robust) if given.size else None
        return _in_input_frame(found or _undetermined(kind, given, method), given)


def _found(kind: str, given: Segment, method: str, robust: bool) -> tuple[Primitive, Info] | None:
    """The answer at unit scale; None where not even a start was found."""
    if kind == "plane" and method in ("best", "unbiased"):
        return _flat(given, robust)
    start = _start(kind, given)
    for _ in range(ROUNDS if robust else 0):
        if start is None:
            break
        given = _near(start, given)
        start = _start(kind, given, start)
    if start is None:
        return None
    if method in associations.METHODS:
        association = associations.associate(method, start, given.local[given.weights > 0])
        nothing = np.full((MODULES[kind].NUM_FREEDOM,) * 2, np.inf)
        return _answer(association.primitive, given, association.ok, None, nothing, association.num_iterations, method)
    if method == "least-squares":
        primitive, ok, covariance = _on_padded(_least_squares, start, given)
        return _answer(primitive, given, ok, None, covariance, starts.NUM_STEPS, method)
    solved = _solve(start, given.local, given.weights)
    if not (bool(solved.ok) and _is_plain(solved, given)):
        solved = _of_several(kind, start, given)
    cone = _as_float64(solved.primitive)
    if isinstance(cone, Cone) and method == "best" and bool(solved.ok) and np.ptp(given.weights) == 0.0:
        likely = full_cone.fit(cone, np.asarray(frame_of(jnp.asarray(cone.axis))), float(solved.sigma), given.local)
        if likely:
            steps, covariance = solved.num_iterations, _in_own_frame(likely)
            return _answer(likely.cone, given, True, likely.sigma, covariance, steps, "likelihood")
    solved = _module(start).with_doubt(solved, given.local, given.weights)
    return _answer(
        solved.primitive, given, solved.ok, solved.sigma, solved.covariance, solved.num_iterations, "unbiased"
    )


def _flat(given: Segment, robust: bool) -> tuple[Primitive, Info]:
    for _ in range(ROUNDS if robust else 0):
        given = _near(planes.fit(given.local, given.weights).primitive, given)
    found = planes.fit(given.local, given.weights)
    covariance = semidefinite(found.covariance)
    return found.primitive, Info(found.ok, found.sigma, found.rms, covariance, given.anchor, 0, "unbiased")


def _in_own_frame(likely: full_cone.FullCone) -> Float[np.ndarray, "6 6"]:
    """The covariance with tilts and shifts along linalg.frame_of(axis), which may be far from the frame it came in."""
    across = np.asarray(frame_of(jnp.asarray(likely.cone.axis)))[:2] @ likely.frame[:2].T
    turn = np.eye(6)
    turn[:2, :2] = turn[2:4, 2:4] = across
    return turn @ likely.covariance @ turn.T


def _answer(
    primitive: Primitive, given: Segment, ok: Any, sigma: Any, covariance: Any, num_iterations: Any, method: str
) -> tuple[Primitive, Info]:
    rms = spheres.rms(primitive, given) if isinstance(primitive, Sphere) else float(_on_padded(_rms, primitive, given))
    covariance = semidefinite(np.asarray(covariance))
    return _as_float64(primitive), Info(
        bool(ok), rms if sigma is None else float(sigma), rms, covariance, given.anchor, int(num_iterations), method
    )


def _undetermined(kind: str, given: Segment, method: str) -> tuple[Primitive, Info]:
    """Some primitive of the kind at the points, when they have no weight, coincide or leave every start infinite."""
    axis, zero = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    primitive: Primitive = {
        "plane": Plane(axis, np.float64(0.0)),
        "sphere": Sphere(zero, np.float64(1.0)),
        "cylinder": Cylinder(axis, zero, np.float64(1.0)),
        "cone": Cone(axis, -axis, np.float64(np.pi / 4)),
    }[kind]
    covariance = np.full((MODULES[kind].NUM_FREEDOM,) * 2, np.inf)
    return primitive, Info(False, 0.0, 0.0, covariance, given.anchor, 0, method)


def _in_input_frame(found: tuple[Primitive, Info], given: Segment) -> tuple[Primitive, Info]:
    primitive, info = found
    size = given.size or 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        told = reported(primitive, info.covariance)
        units = size ** np.asarray(STEP_UNITS[primitive.kind], float)
        covariance = np.nan_to_num(units[:, None] * told * units[None, :], nan=np.inf, posinf=np.inf)
    info = info._replace(sigma=size * info.sigma, rms=size * info.rms, covariance=covariance)
    return kinds.move(primitive, given.anchor, size), info


def _solve(start: Primitive, points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"]) -> Estimate:
    """The corrected equations of a sphere, cylinder or cone."""
    return _module(start).estimate(start, points, weights)


def _module(primitive: Primitive) -> Any:
    """Where the equations of its kind are written out."""
    return spheres if isinstance(primitive, Sphere) else axial


def _near(primitive: Primitive, given: Segment) -> Segment:
    """The segment without weight on points that lie off the primitive by more than the noise explains."""
    distance = _on_padded(_distance, primitive, given)[: len(given.local)]
    scale = float(np.median(distance[given.weights > 0])) / NORMAL_SHARE
    return given._replace(weights=given.weights * (distance <= OUTLIER * scale))


def _on_padded(function: Any, primitive: Primitive, given: Segment) -> Any:
    """function(primitive, points, weights) with the segment padded to a power of two by points without weight."""
    size = max(MIN_PADDED, 1 << (len(given.local) - 1).bit_length())
    answer = function(primitive, _pad(given.local, size), _pad(given.weights, size))
    return jax.tree.map(np.asarray, answer)


def _pad(array: np.ndarray, size: int) -> np.ndarray:
    padded = np.zeros((size, *array.shape[1:]), array.dtype)
    padded[: len(array)] = array
    return padded


def _as_float64(primitive: Primitive) -> Primitive:
    return type(primitive)(*(np.asarray(field, np.float64) for field in primitive))


def _start(kind: str, given: Segment, start: Primitive | None = None) -> Primitive | None:
    """A primitive near the points by least squares on a sample of them, from the start if there is one."""
    rows = _some(given, SAMPLE)
    points, weights = _padded(given, rows, SAMPLE)
    if start is not None:
        polished, ok = _polish(start, points, weights)
        if bool(ok):
            return _as_float64(polished)
    if given.normals is not None:
        polished, ok = _from_normals(points, weights, _pad(segments.unit(given.normals[rows]), SAMPLE), kind=kind)
        if bool(ok):
            return _as_float64(polished)
    found = starts.search(points, weights, kind=kind)
    return _as_float64(jax.tree.map(lambda field: field[0], found.primitive)) if bool(found.ok[0]) else None


def _is_plain(solved: Estimate, given: Segment) -> bool:
    """Whether there can be no other solution: little noise, or a surface seen from all sides that is no blob of it."""
    primitive, sigma = _as_float64(solved.primitive), float(solved.sigma)
    if sigma < NOISY or isinstance(primitive, Plane):
        return True
    points = given.local[:: max(1, len(given.local) // MANY)]
    if isinstance(primitive, Sphere):
        offset = points - primitive.center
    else:
        offset = points - (primitive.apex if isinstance(primitive, Cone) else primitive.center)
        offset = offset - (offset @ primitive.axis)[:, None] * primitive.axis
    distance = np.sqrt(np.einsum("nc,nc->n", offset, offset))
    one_sided = np.linalg.norm((offset / np.maximum(distance, 1e-9)[:, None]).mean(axis=0)) > 0.5
    return not one_sided and sigma < MAX_BLOB * float(distance.mean())


def _of_several(kind: str, start: Primitive, given: Segment) -> Estimate:
    """Of the solutions from several starts the one that leaves the least noise: the equations have more than one."""
    few, many = _some(given, SAMPLE), _some(given, MANY)
    points, weights = given.local[many], given.weights[many]
    searched = starts.search(*_padded(given, few, SAMPLE), kind=kind).primitive
    guesses = [start, *_each(searched), *_each(_bent(start, *_padded(given, many, MANY)))]
    found = [_solve(guess, points, weights) for guess in guesses]
    found = [one for one in found if one.sigma > 0.0]
    best = min((one for one in found if one.ok), key=lambda one: float(one.sigma), default=None)
    solved = _solve(best.primitive if best else start, given.local, given.weights)
    # On some of the points one may not be settled that leaves less noise; on all of them it may be.
    if solved.ok and all(one.sigma > SETTLED * solved.sigma for one in found):
        return solved
    for guess in _each(_on_padded(_bent, solved.primitive, given)):
        other = _solve(guess, given.local, given.weights)
        if other.ok and 0.0 < other.sigma and (not solved.ok or other.sigma < solved.sigma):
            return other
    return solved


def _each(stack: Any) -> list[Primitive]:
    """The primitives of a stack, in float64."""
    return [_as_float64(jax.tree.map(lambda field, n=n: field[n], stack)) for n in range(len(stack[0]))]


def _some(given: Segment, most: int) -> Int[np.ndarray, " m"]:
    """At most so many rows of weight, spread evenly over the segment."""
    rows = np.flatnonzero(given.weights)
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)]


def _padded(given: Segment, rows: Int[np.ndarray, " m"], size: int) -> tuple[np.ndarray, np.ndarray]:
    """The points and weights of some rows, and points without weight up to the size; SAMPLE if those are enough."""
    size = SAMPLE if len(rows) <= SAMPLE else size
    return _pad(given.local[rows], size), _pad(given.weights[rows], size)


@partial(jax.jit, static_argnames="kind")
def _from_normals(points: Float[Array, "n 3"], weights: Float[Array, " n"], normals: Float[Array, "n 3"], *, kind: str):
    first = MODULES[kind].fit(points, weights, normals)
    polished = starts.polish(first.primitive, points, weights)
    return polished.primitive, first.ok & polished.ok


@jax.jit
def _polish(start: Any, points: Float[Array, "n 3"], weights: Float[Array, " n"]):
    polished = starts.polish(start, points, weights)
    return polished.primitive, polished.ok


@jax.jit
def _least_squares(start: Any, points: Float[Array, "n 3"], weights: Float[Array, " n"]):
    polished = starts.polish(start, points, weights)
    return polished.primitive, polished.ok, polished.covariance


@jax.jit
def _bent(like: Any, points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Any:
    return starts.bent(points, weights, kind=like.kind)


@jax.jit
def _rms(primitive: Any, points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Float[Array, ""]:
    distance = MODULES[primitive.kind].signed_distance(primitive, points)
    return jnp.sqrt(jnp.sum(weights * distance * distance) / jnp.sum(weights))


@jax.jit
def _distance(primitive: Any, points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Float[Array, " n"]:
    return MODULES[primitive.kind].distance(primitive, points)
