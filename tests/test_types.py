"""The shared values: trees of arrays for JAX, plain NumPy in an answer, and no JAX loaded to hold them."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit import Scene
from jprimfit.types import Cone, Cylinder, Discrepancy, Fit, Neighbors, Plane, Sphere

TYPES = (Neighbors, Plane, Sphere, Cylinder, Cone, Discrepancy)


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.__name__)
def test_annotations_say_shape_and_dtype_of_either_library(kind, xp):
    for name, annotation in kind.__annotations__.items():
        shape = tuple(2 if not axis.isdigit() else int(axis) for axis in annotation.dim_str.split())
        dtype = {"Bool": bool, "Int": "int32", "Float": "float32"}[annotation.__name__.split("[")[0]]
        assert isinstance(xp.ones(shape, dtype), annotation), name
        assert not isinstance(xp.ones((*shape, 1), dtype), annotation)
        assert not isinstance(xp.ones(shape, "complex64"), annotation)


def test_primitives_pass_through_jit_vmap_and_grad():
    def value(plane):
        return plane.normal @ plane.normal + plane.offset

    planes = Plane(jnp.eye(3), jnp.arange(3.0))
    np.testing.assert_array_equal(jax.jit(jax.vmap(value))(planes), [1, 2, 3])
    slopes = jax.vmap(jax.grad(value))(planes)
    assert type(slopes) is Plane
    np.testing.assert_array_equal(slopes.normal, 2 * np.eye(3))
    fit = jax.jit(lambda fit: fit)(Fit(Sphere(np.zeros(3, np.float32), np.float32(1)), np.bool_(True)))
    assert fit.primitive.kind == "sphere" and bool(fit.ok)


def test_a_stored_answer_opens_without_jax(tmp_path):
    z, labels = np.array([0.0, 0, 1]), np.zeros(4, np.int32)
    parts = (Plane(z, np.float64(2)), Cone(z, 0 * z, np.float64(0.5)))
    scene = Scene(np.ones((4, 3)), labels, parts, np.arange(2, dtype=np.int32), np.ones((4, 3)), np.zeros(4))
    scene.save(tmp_path / "scene.json")
    code = (
        "import sys\nfrom jprimfit import Scene\n"
        f"opened = Scene.load({str(tmp_path / 'scene.json')!r})\n"
        "print('jax' in sys.modules, 'scipy' in sys.modules)\n"
        "print(opened.table())\n"  # measures the faces, which takes scipy
        "print('jax' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert "cone" in done.stdout and (lines[0], lines[-1]) == ("False False", "False")
