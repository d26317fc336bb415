import numpy as np
import pytest

from jprimfit.data import records
from jprimfit.types import Cone, Cylinder, Plane, Sphere


def test_pack_and_unpack_are_inverse(make_part, assert_equal):
    primitives = make_part(2).primitives
    table = records.pack(primitives)
    assert table.parameters.shape == (6, records.NUM_PARAMETERS)
    assert table.kind.tolist() == [0, 1, 2, 3, 0, 1]
    assert_equal(records.unpack(table), primitives)
    assert records.unpack(records.pack(())) == ()


def test_rows_are_as_documented():
    x, y, z = np.eye(3)
    table = records.pack((Plane(z, 5.0), Sphere(x, 2.0), Cylinder(y, x, 3.0), Cone(z, y, 0.5)))
    rows = [[0, 0, 1, 5, 0, 0, 0], [1, 0, 0, 2, 0, 0, 0], [0, 1, 0, 1, 0, 0, 3], [0, 0, 1, 0, 1, 0, 0.5]]
    np.testing.assert_array_equal(table.parameters, rows)


@pytest.mark.parametrize("bad", [Plane(np.zeros(2), 1.0), Sphere(np.zeros(3), np.zeros(2))])
def test_pack_refuses_what_is_no_primitive(bad):
    with pytest.raises(ValueError, match="expected a Plane, Sphere, Cylinder or Cone"):
        records.pack((bad,))


def _cloud(part, **fields):
    return part._replace(cloud=part.cloud._replace(**fields))


def _mesh(part, **fields):
    return part._replace(mesh=part.mesh._replace(**fields))


def _trims(part, **fields):
    return part._replace(trims=part.trims._replace(**fields))


def _spoiled(values, spoil):
    values = values.copy()
    values.flat[0] = spoil
    return values


_x = np.array([1.0, 0, 0])
BAD = {
    "name": (lambda p: p._replace(name="a\nb"), "its name is not a printable text"),
    "long family": (lambda p: p._replace(family="f" * 201), "its family is not a printable text of at most 200"),
    "no name": (lambda p: p._replace(name=""), "it has no name"),
    "split": (lambda p: p._replace(split="Train!"), "its split is not a lower-case word"),
    "seed": (lambda p: p._replace(seed=-2), "its seed"),
    "scale": (lambda p: p._replace(scale=0.0), "its scale is not positive"),
    "center": (lambda p: p._replace(center=(0.0, np.nan, 0.0)), "its center or scale is not finite"),
    "areas": (lambda p: p._replace(areas=p.areas[:-1]), "areas have shape"),
    "negative area": (lambda p: p._replace(areas=-p.areas), "an area is negative"),
    "no surface": (lambda p: p._replace(cloud=None, mesh=None, trims=None), "it has no surface"),
    "NaN parameter": (
        lambda p: p._replace(primitives=(Plane(_x, np.nan), *p.primitives[1:])),
        "instance 0 is not finite",
    ),
    "long normal": (lambda p: p._replace(primitives=(Plane(2 * _x, 1.0), *p.primitives[1:])), "not a unit vector"),
    "radius": (lambda p: p._replace(primitives=(Sphere(_x, 0.0), *p.primitives[1:])), "radius that is not positive"),
    "half-angle": (lambda p: p._replace(primitives=(Cone(_x, _x, 1.6), *p.primitives[1:])), "half-angle outside"),
    "points": (lambda p: _cloud(p, points=p.cloud.points[:, :2]), "points have shape"),
    "no points": (lambda p: _cloud(p, points=p.cloud.points[:0]), "none or too many"),
    "integer points": (lambda p: _cloud(p, points=p.cloud.points.astype(int)), "points are not floats"),
    "NaN point": (lambda p: _cloud(p, points=_spoiled(p.cloud.points, np.nan)), "points hold NaN or infinity"),
    "normal": (lambda p: _cloud(p, normals=2 * p.cloud.normals), "normals are not of length 1"),
    "label high": (lambda p: _cloud(p, labels=_spoiled(p.cloud.labels, len(p.primitives))), "labels run over"),
    "label low": (lambda p: _cloud(p, labels=_spoiled(p.cloud.labels, -2)), "labels run over"),
    "noisy": (lambda p: _cloud(p, noisy_points=p.cloud.points[1:]), "noisy points have shape"),
    "samples": (lambda p: _cloud(p, samples=p.cloud.samples[1:]), "samples have shape"),
    "sample normals alone": (lambda p: _cloud(p, samples=None), "sample normals have shape"),
    "face": (lambda p: _mesh(p, faces=_spoiled(p.mesh.faces, 11)), "faces run over"),
    "negative face": (lambda p: _mesh(p, faces=_spoiled(p.mesh.faces, -1)), "faces run over"),
    "mesh labels": (lambda p: _mesh(p, labels=p.mesh.labels[1:]), "mesh labels have shape"),
    "frame": (lambda p: _trims(p, frames=p.trims.frames * 1.01), "a frame is not orthonormal"),
    "huge frame": (lambda p: _trims(p, frames=p.trims.frames * 1e200), "a frame is not orthonormal"),
    "turned frame": (
        lambda p: _trims(p, frames=p.trims.frames[:, ::-1].copy()),
        "third row of a frame is not the normal",
    ),
    "outward": (lambda p: _trims(p, outward=p.trims.outward * np.int8(0)), "an outward sign is 0"),
    "loop order": (lambda p: _trims(p, loop_face=p.trims.loop_face[::-1].copy()), "not in the order of their faces"),
    "loop size": (lambda p: _trims(p, loop_size=_spoiled(p.trims.loop_size, 2)), "loop sizes run over"),
    "corners": (lambda p: _trims(p, corners=p.trims.corners[1:]), "corners have shape"),
}


@pytest.mark.parametrize(("spoil", "words"), BAD.values(), ids=BAD.keys())
def test_check_refuses_in_one_sentence(make_part, spoil, words):
    with pytest.raises(ValueError, match=words) as caught:
        records.check(spoil(make_part(1)), source="FILE")
    assert str(caught.value).startswith("FILE cannot be used: ") and str(caught.value).endswith(".")


def test_check_accepts_every_form_and_what_is_not_known(make_part):
    for form in ("cloud", "mesh", "trims"):
        records.check(make_part(3, forms=(form,), areas=None, family="", split="", seed=-1, unit=""), source="FILE")
    part = make_part(3, forms=("cloud",))
    bare = part.cloud._replace(noisy_points=None, samples=None, sample_normals=None)
    records.check(part._replace(cloud=bare), source="FILE")
    background = part._replace(
        primitives=(), areas=None, cloud=bare._replace(labels=np.full_like(bare.labels, records.BACKGROUND))
    )
    records.check(background, source="FILE")
