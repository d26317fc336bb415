"""A pipeline that answers at once, so that the commands around it can be tested."""

import numpy as np
import pytest

import jprimfit
from jprimfit.scene import Scene
from jprimfit.types import Plane, Sphere


@pytest.fixture
def light(monkeypatch):
    """Replaces the picture by a few bytes and leaves STEP out: seconds that tests of other things need not spend."""

    def report(path, points, labels, kinds, patches, *, title=None):
        assert len(kinds) == len(patches) and len(points) == len(labels)
        path.write_bytes(b"PNG")

    monkeypatch.setattr("jprimfit.io.report.write_report", report)
    monkeypatch.setattr("jprimfit.cad.step.available", lambda: False)


@pytest.fixture
def quick(monkeypatch, light):
    """Replaces pipeline.fit by one that knows a plane and a sphere; gives the list of its calls."""
    calls = []

    def fit(points, normals=None, **settings):
        calls.append({"points": points, "normals": normals, **settings})
        usable = jprimfit.checks.usable_rows(points, normals)
        labels = np.full(len(points), -1, np.int32)
        labels[usable.rows] = np.arange(len(usable.rows)) % 2
        if "progress" in settings:
            settings["progress"]("growing", 0, 2)
            settings["progress"]("growing", 1, 2)
        return Scene(
            points=np.asarray(points, np.float64),
            labels=labels,
            primitives=(Plane(np.array([0.0, 0, 1]), np.float64(0)), Sphere(np.zeros(3), np.float64(1))),
            surface_of=np.array([0, 1], np.int32),
            normals=np.tile([0.0, 0, 1], (len(points), 1)),
            distances=np.where(labels >= 0, 0.25, np.nan),
            noise=0.25,
        )

    monkeypatch.setattr("jprimfit.pipeline.fit", fit)
    return calls
