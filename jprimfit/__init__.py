"""jprimfit: from a scanned point cloud of a mechanical part to planes, spheres, cylinders and cones.

`scene = jprimfit.fit(points)` does the main job; `jprimfit.Scene.load(path)` reads its saved answer. Names are loaded
when first used, so that `import jprimfit` costs nothing.
"""

from importlib import import_module
from os import PathLike
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from jprimfit.fitting.single import fit_primitive
    from jprimfit.networks.weights import Model
    from jprimfit.pipeline import fit
    from jprimfit.scene import Scene
    from jprimfit.types import Cone, Cylinder, Plane, Sphere

__all__ = ["Cone", "Cylinder", "Plane", "Scene", "Sphere", "fit", "fit_primitive", "load_model"]

_HOMES = {
    "fit": "jprimfit.pipeline",
    "fit_primitive": "jprimfit.fitting.single",
    "Scene": "jprimfit.scene",
    **dict.fromkeys(("Plane", "Sphere", "Cylinder", "Cone"), "jprimfit.types"),
}


def load_model(name_or_dir: "str | PathLike[str]") -> "Model":
    """The network of that name ("default" is shipped), in that folder or of that path without suffix, checked.

    A folder may be the workdir of a training. ValueError of one sentence if there is none or it is damaged.
    """
    return import_module("jprimfit.networks.weights").load(name_or_dir)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'jprimfit' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
