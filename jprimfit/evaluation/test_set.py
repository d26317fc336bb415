"""The test set that everybody has: parts of families that no training sees, built from a seed on the user's machine.

Its file is named by a digest of its settings and of the code that makes it, so that a file of older code is never taken
for it.
"""

import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from jprimfit import data
from jprimfit.data.build import build, seeded_test_set

CONFIG = seeded_test_set(330)  # 30 parts of each of eleven families
_MAKERS = ("build.py", "families*.py", "instances.py", "records.py", "shapes.py", "solids.py")


def path_in(folder: Path) -> Path:
    """Where the test set lies in a folder; the file need not exist."""
    made_by = hashlib.sha256(json.dumps(asdict(CONFIG), sort_keys=True).encode())
    home = Path(data.__path__[0])
    for file in sorted(file for pattern in _MAKERS for file in home.glob(pattern)):
        made_by.update(file.read_bytes())
    return folder / f"test-{made_by.hexdigest()[:12]}.h5"


def build_in(folder: Path, *, progress: Callable[[int], object] | None = None) -> Path:
    """Builds the test set in a folder, with a process per core; progress(1) is called per part.

    ValueError where what builds solids is not installed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = path_in(folder)
    try:
        # In a folder of its own: another process may be building the same.
        with tempfile.TemporaryDirectory(dir=folder) as own:
            build(Path(own) / path.name, CONFIG, workers=os.cpu_count(), progress=progress)
            os.replace(Path(own) / path.name, path)
    except ImportError as error:
        raise ValueError(
            f"the test set is built with {error.name or error}, which is not installed: install it, or give a "
            "data set with --data FILE."
        ) from None
    return path
