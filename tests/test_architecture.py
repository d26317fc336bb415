"""The house stands: imports go down, files stay short, public names are explained, heavy libraries keep to one file."""

import ast
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FLOORS = [
    {"types", "programs", "cores"},
    {"geometry", "checks", "settings"},
    {"solvers", "networks"},
    {"primitives"},
    {"preprocessing", "fitting", "cad", "io"},
    {"objectives", "data", "scene", "pipeline"},
    {"training", "evaluation", "baselines"},
    {"apps"},
    {"__main__"},
]
FLOOR = {name: number for number, names in enumerate(FLOORS) for name in names}
IN_ONE_FILE = {"h5py", "orbax", "manifold3d", "CGAL", "viser"}
OWNERS = {"OCP": {"jprimfit/cad/step.py", "jprimfit/cad/step_reader.py"}}  # one writes, one reads
IN_FUNCTIONS_ONLY = {"trimesh", "manifold3d"}  # the rest must run where they are absent
MAX_LINES = 400
MAX_FUNCTION_LINES = 60
FORBIDDEN_FOR_FIT = {"orbax", "optax", "chex", "trimesh", "manifold3d"}
FIT_SECONDS = 4.0  # of processor time, from the start of Python until jprimfit.fit can be called


def imports(tree, inside):
    """Every (dotted module, line, whether in a function) that a file imports, inside = its own package as a tuple."""
    within = {n for f in ast.walk(tree) if isinstance(f, ast.FunctionDef | ast.Lambda) for n in ast.walk(f)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno, node in within
        elif isinstance(node, ast.ImportFrom):
            above = inside[: len(inside) - node.level + 1] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:  # `from jprimfit import scene` names a file, too
                yield f"{base}.{alias.name}", node.lineno, node in within


def room(parts):
    """The floor of a file, and the folder whose files may import each other: top-level files of a floor share one."""
    name = parts[0].removesuffix(".py")
    floor = FLOOR.get(name, -1)
    return floor, name if len(parts) > 1 else f"files of floor {floor}"


def violations(package):
    """One sentence per breach of the rules in the folder of a package called jprimfit."""
    homes = defaultdict(set)
    for path in sorted(package.rglob("*.py")):
        parts, text = path.relative_to(package).parts, path.read_text(encoding="utf-8")
        tree, where = ast.parse(text), path.relative_to(package.parent).as_posix()
        if parts == ("__init__.py",):
            continue  # the public face: lazily anything
        floor, folder = room(parts)
        if floor < 0:
            yield f"{where} stands on no floor"
            continue
        for module, line, in_function in imports(tree, ("jprimfit", *parts[:-1])):
            top, *rest = module.split(".")
            if top in IN_ONE_FILE:
                homes[top].add(where)
            if where not in OWNERS.get(top, {where}):
                yield f"{where}:{line} imports {module}, which is left to {', '.join(sorted(OWNERS[top]))}"
            if top in IN_FUNCTIONS_ONLY and not in_function:
                yield f"{where}:{line} imports {top} outside a function"
            if top == "jprimfit" and not (rest and rest[0].startswith("__")):  # any may read __version__
                target = rest[0] if rest and rest[0] in FLOOR else "apps"  # the public face is for the apps
                below, other = room((target, "") if (package / target).is_dir() else (target,))
                if below >= floor and other != folder:
                    yield f"{where}:{line} (floor {floor}) imports {module} (floor {below})"
        if (length := len(text.splitlines())) > MAX_LINES:
            yield f"{where} has {length} lines"
        yield from undocumented(tree, where, empty=not text.strip())
    for library, files in homes.items():
        if len(files) > 1:
            yield f"{library} is imported in {', '.join(sorted(files))}: one file should own it"


def undocumented(tree, where, *, empty):
    """Breaches within one file: no docstring on the file or a public name, functions that are too long."""
    if not empty and ast.get_docstring(tree) is None:
        yield f"{where} has no docstring"
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            start = node.body[0].end_lineno if ast.get_docstring(node) else node.lineno - 1  # docstrings are free
            length = (node.end_lineno or 0) - (start or 0)
            if length > MAX_FUNCTION_LINES:
                yield f"{where}: {node.name} has {length} lines"
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            inner = node.body if isinstance(node, ast.ClassDef) else []
            methods = [m for m in inner if isinstance(m, ast.FunctionDef) and not m.name.startswith("_")]
            yield from (f"{where}: {n.name} has no docstring" for n in [node, *methods] if not ast.get_docstring(n))


def test_the_package_keeps_its_rules():
    assert list(violations(ROOT / "jprimfit")) == []


@pytest.mark.parametrize(
    ("files", "breach"),
    [
        ({"geometry/a.py": "def f():\n    'Doc.'\n    from jprimfit.fitting import b"}, "imports jprimfit.fitting.b"),
        ({"cad/a.py": "import jprimfit.io.ply"}, "imports jprimfit.io.ply"),
        ({"data/a.py": "from jprimfit import scene"}, "imports jprimfit.scene"),
        ({"geometry/a.py": "from ..primitives import plane"}, "imports jprimfit.primitives.plane"),
        ({"geometry/a.py": "from jprimfit import fit"}, "imports jprimfit.fit"),
        ({"geometry/a.py": "x = 1\n" * 400}, "has 401 lines"),
        ({"geometry/a.py": "def f():\n" + "    x = 1\n" * 60}, "f has 61 lines"),
        ({"geometry/a.py": "def f():\n    return 1"}, "f has no docstring"),
        ({"geometry/a.py": "class C:\n    'Doc.'\n    def m(self):\n        return 1"}, "m has no docstring"),
        ({"data/a.py": "import h5py", "io/b.py": "import h5py"}, "one file should own it"),
        ({"cad/a.py": "import OCP.gp"}, "imports OCP.gp, which is left to"),
        ({"cad/a.py": "import trimesh"}, "imports trimesh outside a function"),
        ({"extra/a.py": ""}, "stands on no floor"),
    ],
)
def test_a_breach_is_found(tmp_path, files, breach):
    for name, text in files.items():
        path = tmp_path / "jprimfit" / name
        path.parent.mkdir(parents=True)
        path.write_text("'''Doc.'''\n" + text, encoding="utf-8")
    found = list(violations(tmp_path / "jprimfit"))
    assert len(found) == 1 + ("f has 61" in breach) and breach in found[0]


def test_what_is_allowed_passes(tmp_path):
    allowed = {
        "pipeline.py": "from jprimfit import scene\nfrom jprimfit.fitting import a",
        "scene.py": "def f():\n    'Doc.'\n    import trimesh",
        "fitting/a.py": "from jprimfit.fitting import b\nfrom .b import c\nfrom jprimfit.types import Plane",
        "__init__.py": "import jprimfit.apps.main",
    }
    for name, text in allowed.items():
        (tmp_path / "jprimfit" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "jprimfit" / name).write_text("'''Doc.'''\n" + text, encoding="utf-8")
    assert list(violations(tmp_path / "jprimfit")) == []


FIT = """
import sys, time, jprimfit, numpy as np
jprimfit.fit
print(time.process_time())
points = np.random.default_rng(0).uniform(-1, 1, (600, 3))
points[:300, 2], points[300:, 0] = 0, -1
assert len(jprimfit.fit(points).primitives) == 2
print(*{module.split(".")[0] for module in sys.modules})
"""


def test_fit_is_at_hand_soon_and_runs_without_the_training_libraries():
    cache = os.environ.get("JPRIMFIT_CACHE", str(ROOT / ".cache" / "jax"))  # as in conftest.py
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": cache}
    answer = subprocess.run([sys.executable, "-c", FIT], env=environment, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    seconds, *modules = answer.stdout.split()
    assert not FORBIDDEN_FOR_FIT & set(modules)
    assert float(seconds) < FIT_SECONDS
