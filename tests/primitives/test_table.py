"""The protocol that all kinds share, one test each over the table: recovery, geometry, derivatives, degeneracy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jprimfit.geometry import rigid
from jprimfit.primitives import table
from jprimfit.solvers.least_squares import minimise
from jprimfit.types import Cone, Cylinder, Plane, Sphere

NUM_POINTS = 64
EXTENT = 1.5
PROTOCOL = (
    "KIND NUM_FREEDOM STEP_UNITS fit signed_distance distance normal project sample transform discrepancy retract "
    "canonical quadric instruments sound"
).split()

each_kind = pytest.mark.parametrize("kind", table.KINDS)
each_dtype = pytest.mark.parametrize("dtype", ["float32", "float64"])


def upright(kind, dtype):
    """One of each kind, of size about one, before it is posed."""

    def array(*values):
        return jnp.array(values, dtype)

    return {
        "plane": lambda: Plane(array(0, 0, 1), array(0.3)[0]),
        "sphere": lambda: Sphere(array(0.1, -0.2, 0.3), array(0.7)[0]),
        "cylinder": lambda: Cylinder(array(0, 0, 1), array(0.2, 0.1, 0), array(0.5)[0]),
        "cone": lambda: Cone(array(0, 0, 1), array(0.1, 0.2, -0.3), array(0.5)[0]),
    }[kind]()


@functools.partial(jax.jit, static_argnums=(1, 2))
def posed(key, kind, dtype):
    """A primitive in a random pose, points on it and their normals."""
    rotation_key, shift_key, scale_key, sample_key = jax.random.split(key, 4)
    module = table.of(kind)
    rotation = rigid.random_rotation(rotation_key, dtype=dtype)
    shift = jax.random.normal(shift_key, (3,), dtype)
    scale = jax.random.uniform(scale_key, (), dtype, minval=0.5, maxval=2)
    primitive = module.transform(upright(kind, dtype), rotation, shift, scale)
    points = module.sample(sample_key, primitive, num_points=NUM_POINTS, extent=EXTENT)
    return primitive, points, module.normal(primitive, points)


@functools.cache
def compiled(kind, name):
    return jax.jit(getattr(table.of(kind), name))


def noisy(kind, dtype, sigma, seed=0):
    """Points and normals off the surface by Gaussian noise, and uneven weights."""
    primitive, points, normals = posed(jax.random.key(seed), kind, dtype)
    rng = np.random.default_rng(seed)
    points = np.asarray(points) + sigma * rng.normal(size=points.shape)
    normals = np.asarray(normals) + sigma * rng.normal(size=normals.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights = rng.uniform(0.2, 1, NUM_POINTS)
    return primitive, *(jnp.asarray(a, dtype) for a in (points, weights, normals))


def free_points(dtype):
    return jnp.asarray(np.random.default_rng(7).normal(size=(NUM_POINTS, 3)) * 1.5, dtype)


def assert_close(a, b, atol):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, atol=atol, rtol=0)


def finite(tree):
    return all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tree))


def test_table_is_in_the_order_of_the_type_ids():
    assert list(table.MODULES) == list(table.KINDS) == sorted(table.TYPE_ID, key=table.TYPE_ID.__getitem__)
    assert [table.TYPE_ID[kind] for kind in table.KINDS] == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="unknown kind of primitive 'torus': expected one of plane, sphere"):
        table.of("torus")


@each_kind
def test_modules_offer_the_same_names(kind):
    module = table.of(kind)
    assert module.KIND == kind
    assert [name for name in PROTOCOL if not hasattr(module, name)] == []
    assert table.of(upright(kind, "float32")) is module


@each_kind
def test_dispatch_asks_the_module(kind):
    primitive, points, _ = posed(jax.random.key(0), kind, "float32")
    pose = (jnp.eye(3), jnp.ones(3), 2.0)
    names = ("signed_distance", "distance", "normal", "project")

    @jax.jit
    def dispatched(primitive):
        return [getattr(table, name)(primitive, points) for name in names], table.transform(primitive, *pose)

    answers, moved = dispatched(primitive)
    for name, answer in zip(names, answers, strict=True):
        np.testing.assert_allclose(answer, compiled(kind, name)(primitive, points), atol=1e-6)
    assert_close(moved, compiled(kind, "transform")(primitive, *pose), 1e-6)


@each_dtype
@each_kind
def test_fit_recovers_the_parameters(x64, tolerance, kind, dtype):
    fit, discrepancy, signed = (compiled(kind, name) for name in ("fit", "discrepancy", "signed_distance"))
    for key in jax.random.split(jax.random.key(1), 8):
        primitive, points, normals = posed(key, kind, dtype)
        found = fit(points, jnp.ones(NUM_POINTS, dtype), normals)
        error = discrepancy(primitive, found.primitive)
        assert found.ok
        assert_close(error, jax.tree.map(jnp.zeros_like, error), tolerance[dtype])
        np.testing.assert_allclose(signed(found.primitive, points), 0, atol=tolerance[dtype])
        assert all(leaf.dtype == dtype for leaf in jax.tree.leaves(found.primitive))


@each_kind
def test_samples_lie_on_the_surface_and_the_normal_is_unit_there(x64, tolerance, kind):
    primitive, points, normals = posed(jax.random.key(2), kind, "float64")
    np.testing.assert_allclose(compiled(kind, "distance")(primitive, points), 0, atol=tolerance["float64"])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=tolerance["float64"])


@each_kind
def test_project_is_the_nearest_point(x64, tolerance, kind):
    primitive, on_surface, _ = posed(jax.random.key(3), kind, "float64")
    points = free_points("float64")
    feet = compiled(kind, "project")(primitive, points)
    distance = np.asarray(compiled(kind, "distance")(primitive, points))
    np.testing.assert_allclose(np.linalg.norm(points - feet, axis=1), distance, atol=tolerance["float64"])
    np.testing.assert_allclose(compiled(kind, "distance")(primitive, feet), 0, atol=tolerance["float64"])
    np.testing.assert_allclose(compiled(kind, "project")(primitive, feet), feet, atol=tolerance["float64"])
    gaps = np.linalg.norm(np.asarray(points)[:, None] - np.asarray(on_surface)[None], axis=-1)
    assert np.all(gaps >= distance[:, None] - tolerance["float64"])


@each_kind
def test_normal_is_the_gradient_of_signed_distance(x64, tolerance, kind):
    primitive, _, _ = posed(jax.random.key(3), kind, "float64")
    points = free_points("float64")
    signed = compiled(kind, "signed_distance")
    eps = 1e-6
    steps = eps * np.eye(3)
    numeric = np.stack([(signed(primitive, points + s[None]) - signed(primitive, points - s[None])) for s in steps], -1)
    normals = np.asarray(compiled(kind, "normal")(primitive, points))
    np.testing.assert_allclose(numeric / (2 * eps), normals, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=tolerance["float64"])
    feet = points - np.asarray(signed(primitive, points))[:, None] * normals
    np.testing.assert_allclose(compiled(kind, "project")(primitive, points), feet, atol=tolerance["float64"])


@each_kind
def test_transform_commutes_with_distance_and_fit(x64, tolerance, kind):
    primitive, points, weights, normals = noisy(kind, "float64", 0.02)
    rotation = rigid.random_rotation(jax.random.key(5), dtype=jnp.float64)
    pose = (rotation, jnp.array([30.0, -20.0, 5.0]), jnp.array(0.01))
    moved_points, moved_normals = rigid.apply(points, *pose), rigid.apply(normals, rotation, jnp.zeros(3))
    transform, fit = compiled(kind, "transform"), compiled(kind, "fit")
    distance = compiled(kind, "distance")
    moved = transform(primitive, *pose)
    np.testing.assert_allclose(distance(moved, moved_points), 0.01 * distance(primitive, points), atol=1e-10)
    here, there = fit(points, weights, normals), fit(moved_points, weights, moved_normals)
    assert_close(transform(here.primitive, *pose), there.primitive, tolerance["float64"])
    assert here.ok and there.ok


@each_kind
def test_jit_plain_and_vmap_of_one_agree(kind, tolerance):
    _, points, weights, normals = noisy(kind, "float32", 0.02)
    plain = table.of(kind).fit(points, weights, normals)
    assert_close(compiled(kind, "fit")(points, weights, normals), plain, tolerance["float32"])
    batch = jax.jit(jax.vmap(table.of(kind).fit))(points[None], weights[None], normals[None])
    assert_close(jax.tree.map(lambda leaf: leaf[0], batch), plain, tolerance["float32"])


@each_kind
def test_weights_select_and_order_does_not_matter(kind, tolerance):
    _, points, weights, normals = (np.asarray(a) if hasattr(a, "dtype") else a for a in noisy(kind, "float32", 0.02))
    fit = compiled(kind, "fit")
    kept = np.arange(NUM_POINTS) < 48
    weights = np.where(kept, weights, 0)

    def refit(rows, row_normals, row_weights=weights):
        return fit(*(jnp.asarray(a) for a in (rows, row_weights, row_normals)))

    reference = refit(points, normals)
    wild = np.where(kept[:, None], points, 1e4 * points + 50)
    turned = np.where(kept[:, None], normals, np.roll(normals, 1, axis=1))
    assert_close(refit(wild, turned), reference, 0)
    order = np.random.default_rng(1).permutation(NUM_POINTS)
    assert_close(refit(points[order], normals[order], weights[order]), reference, tolerance["float32"])
    assert_close(refit(points, normals, 1e-3 * weights), reference, tolerance["float32"])
    assert_close(fit(*(jnp.asarray(a[:48]) for a in (points, weights, normals))), reference, tolerance["float32"])


@functools.cache
def probed(kind):
    """A smooth function of the fit that no sign of an axis and no gauge can change."""

    @jax.jit
    def loss(points, weights, normals):
        probes = jnp.array([[1, 2, 3], [-1, 0.5, 1], [0.3, -2, -1]], points.dtype)
        fit = table.of(kind).fit(points, weights, normals)
        return jnp.sum(table.of(kind).signed_distance(fit.primitive, probes) ** 2)

    return loss


@functools.cache
def probed_gradient(kind):
    return jax.jit(jax.value_and_grad(probed(kind), argnums=(0, 1, 2)))


@each_kind
def test_gradients_of_the_fit_agree_with_finite_differences(x64, kind):
    _, *inputs = noisy(kind, "float64", 0.05)
    loss = probed(kind)

    @jax.jit  # one compilation for the value and both modes, where check_grads would need four
    def value_and_slopes(tangents, eps):
        shifted = [x + eps * t for x, t in zip(inputs, tangents, strict=True)]
        value, forward = jax.jvp(loss, shifted, tangents)
        gradient = jax.grad(loss, argnums=(0, 1, 2))(*shifted)
        return value, forward, sum(jnp.vdot(g, t) for g, t in zip(gradient, tangents, strict=True))

    rng, eps = np.random.default_rng(3), 1e-6
    for _ in range(3):
        tangents = [jnp.asarray(rng.normal(size=x.shape)) for x in inputs]
        _, forward, reverse = value_and_slopes(tangents, 0.0)
        numeric = (value_and_slopes(tangents, eps)[0] - value_and_slopes(tangents, -eps)[0]) / (2 * eps)
        np.testing.assert_allclose([forward, reverse], [numeric, numeric], atol=1e-5, rtol=1e-5)
        np.testing.assert_allclose(forward, reverse, atol=1e-10, rtol=1e-10)


def degenerate(case):
    """Points, weights and normals of 48 rows, whose symmetry is exact in floating point."""
    rng = np.random.default_rng(0)
    random_directions = rng.normal(size=(48, 3))
    random_directions /= np.linalg.norm(random_directions, axis=1, keepdims=True)
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), -1).reshape(8, 3)
    orders = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]]
    sphere = np.concatenate([signs * np.array([2.0, 3.0, 6.0])[order] / 7 for order in orders])
    corner = rng.integers(1, 64, (12, 2)) / 64
    quarter = np.concatenate([corner, corner[:, ::-1] * np.array([1, -1])])
    plate = np.concatenate([quarter, -quarter])
    plate = np.concatenate([plate, np.zeros((48, 1))], axis=1)
    up = np.broadcast_to([0.0, 0.0, 1.0], (48, 3))
    line = np.linspace(-1, 1, 48)[:, None] * np.array([0.0, 0.0, 1.0])
    spokes = random_directions * np.array([1, 1, 0])
    spokes /= np.linalg.norm(spokes, axis=1, keepdims=True)
    ones = np.ones(48)
    return {
        "square plate": (plate, ones, up),
        "full sphere": (sphere, ones, sphere),
        "no weight": (random_directions, 0 * ones, random_directions),
        "equal points": (0 * plate + np.array([0.1, 20.3, 3.7]), ones, random_directions),
        "line": (line, ones, spokes),
        "one point": (random_directions, np.eye(48)[0], random_directions),
    }[case]


DETERMINED = {"square plate": "plane", "full sphere": "sphere"}


@pytest.mark.parametrize("case", ["square plate", "full sphere", "no weight", "equal points", "line", "one point"])
@each_kind
def test_degenerate_input_is_finite_with_finite_gradients_and_not_ok(kind, case):
    arguments = [jnp.asarray(a, jnp.float32) for a in degenerate(case)]
    fit = compiled(kind, "fit")(*arguments)
    assert finite(fit) and finite(probed_gradient(kind)(*arguments))
    assert bool(fit.ok) == (DETERMINED.get(case) == kind)


@each_kind
def test_retract_is_a_minimal_chart(x64, tolerance, kind):
    module = table.of(kind)
    primitive, points, _ = posed(jax.random.key(4), kind, "float64")

    @jax.jit
    def displaced(step):
        return module.signed_distance(module.retract(primitive, step), points)

    zero = jnp.zeros(module.NUM_FREEDOM)
    assert_close(module.retract(primitive, zero), primitive, tolerance["float64"])
    singular_values = np.linalg.svd(jax.jit(jax.jacfwd(displaced))(zero), compute_uv=False)
    assert singular_values.shape == (module.NUM_FREEDOM,) and singular_values[-1] > 0.1
    check_grads(displaced, (zero,), order=2, modes=["fwd"], eps=1e-5, atol=1e-5, rtol=1e-5)


@functools.cache
def refined(kind):
    module = table.of(kind)

    @jax.jit
    def refine(start, points, weights):
        return minimise(
            lambda primitive: module.signed_distance(primitive, points),
            start,
            weights,
            retract_fn=module.retract,
            num_freedom=module.NUM_FREEDOM,
            num_steps=15,
        )

    return refine


@each_dtype
@each_kind
def test_least_squares_converges_from_a_perturbed_start(x64, tolerance, kind, dtype):
    module = table.of(kind)
    primitive, points, _ = posed(jax.random.key(4), kind, dtype)
    step = 0.1 * np.random.default_rng(0).normal(size=module.NUM_FREEDOM)
    start = compiled(kind, "retract")(primitive, jnp.asarray(step, dtype))
    solution = refined(kind)(start, points, jnp.ones(NUM_POINTS, dtype))
    discrepancy = compiled(kind, "discrepancy")(primitive, solution.state)
    assert_close(discrepancy, jax.tree.map(jnp.zeros_like, discrepancy), tolerance[dtype])
    assert solution.ok


@each_kind
def test_least_squares_minimises_the_weighted_distances(x64, kind):
    module = table.of(kind)
    _, points, weights, normals = noisy(kind, "float64", 0.03)
    start = compiled(kind, "fit")(points, weights, normals).primitive
    solution = refined(kind)(start, points, weights)

    @jax.jit
    def cost(step):
        return jnp.sum(weights * module.signed_distance(module.retract(solution.state, step), points) ** 2) / 2

    zero = jnp.zeros(module.NUM_FREEDOM)
    assert solution.ok
    np.testing.assert_allclose(cost(zero), solution.cost, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.grad(cost))(zero), 0, atol=1e-7)
    assert np.all(np.linalg.eigvalsh(jax.jit(jax.hessian(cost))(zero)) > 0)


@each_kind
def test_canonical_keeps_the_surface_and_forgets_the_gauge(x64, tolerance, kind):
    module = table.of(kind)
    primitive, _, _ = posed(jax.random.key(6), kind, "float64")
    other = {
        "plane": lambda p: Plane(-p.normal, -p.offset),
        "sphere": lambda p: p,
        "cylinder": lambda p: Cylinder(-p.axis, p.center + 3 * p.axis, p.radius),
        "cone": lambda p: p,
    }[kind](primitive)
    anchor = jnp.array([0.3, -0.4, 2.0])
    once, other_once = compiled(kind, "canonical")(primitive, anchor), compiled(kind, "canonical")(other, anchor)
    assert_close(once, other_once, tolerance["float64"])
    points = free_points("float64")
    distance = compiled(kind, "distance")
    np.testing.assert_allclose(distance(once, points), distance(other, points), atol=tolerance["float64"])
    discrepancy = module.discrepancy(once, other)
    np.testing.assert_allclose(jnp.stack(discrepancy), 0, atol=tolerance["float64"])


NEAR_A_JUMP = np.array([[0.5, 0.5 - 1e-9, 1.0], [0.5, 0.5 + 1e-9, 1.0]]) / np.sqrt(1.5)


@pytest.mark.parametrize(
    "kind,sign", [("plane", 1), ("plane", -1), ("cylinder", 1), ("cylinder", -1), ("cone", 1), ("sphere", 1)]
)
def test_a_covariance_follows_its_axis_into_another_frame(x64, kind, sign):
    # One surface under two names: its axis turned round, or moved by nothing across a jump of frame_of.
    old, new = (
        {
            "plane": Plane(axis, turn * jnp.array(0.3)),
            "sphere": Sphere(jnp.array([0.3, 0.1, 0.2]), jnp.array(1.5)),
            "cylinder": Cylinder(axis, jnp.array([0.3, -0.1, 0.2]), jnp.array(0.7)),
            "cone": Cone(axis, -2 * axis, jnp.array(0.4)),
        }[kind]
        for axis, turn in ((jnp.asarray(NEAR_A_JUMP[0]), 1), (sign * jnp.asarray(NEAR_A_JUMP[1]), sign))
    )
    rng, module = np.random.default_rng(0), table.MODULES[kind]
    half, points = rng.normal(size=(module.NUM_FREEDOM,) * 2), jnp.asarray(rng.normal(size=(7, 3)))
    covariance = jnp.asarray(half @ half.T)

    def of_distances(primitive, covariance):
        at = jnp.zeros(module.NUM_FREEDOM)
        slope = jax.jacfwd(lambda step: module.distance(module.retract(primitive, step), points))(at)
        return slope @ covariance @ slope.T

    found = of_distances(new, table.in_frame_of(new, old, covariance))
    np.testing.assert_allclose(found, of_distances(old, covariance), atol=1e-6)
