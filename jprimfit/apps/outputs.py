"""The files of one answer: made in a folder beside the target, moved there when all are complete.

A new target appears by one rename. In a folder that exists every file is replaced by a rename of its own, scene.json
last; files of an earlier answer that the new one lacks are removed, files of others are left alone.
"""

import contextlib
import os
import shutil
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jprimfit.scene import Scene

NAMES = (
    *("segments.ply", "deviations.ply", "features.csv", "surfaces.mtl", "surfaces.obj", "surfaces.step", "report.png"),
    *("scene.npz", "scene.json"),
)
FULL_COLOR = 3.0  # deviation of full colour in deviations.ply, in root mean squares of all deviations
MAX_NAMES = 5


def write_outputs(scene: "Scene", folder: Path, *, title: str = "") -> list[str]:
    """Writes the answer into `folder`, whole or not at all; says what a file had to leave out."""
    from jprimfit.cad import step
    from jprimfit.io import obj, palette, ply, report
    from jprimfit.io.feature_table import write_features
    from jprimfit.primitives.table import KINDS

    kinds = [primitive.kind for primitive in scene.primitives]
    type_ids = np.array([*(KINDS.index(kind) for kind in kinds), -1], np.int32)  # label -1 takes the last
    patches = scene.patches
    shown = [i for i, surface in enumerate(patches) if len(surface.faces)]
    names, colors = scene.names(), palette.colors(len(kinds))
    with staged(folder) as place:
        scene.save(place / "scene.json")
        point_colors = palette.colors_of_labels(scene.labels)
        ply.write_segments(
            place / "segments.ply", scene.points, scene.normals, point_colors, scene.labels, type_ids[scene.labels]
        )
        _write_deviations(place / "deviations.ply", scene)
        write_features(place / "features.csv", names, scene.primitives, scene.features, scene.surface_of)
        obj.write_surfaces(
            place / "surfaces.obj", [names[i] for i in shown], [patches[i] for i in shown], colors[shown]
        )
        report.write_report(place / "report.png", scene.points, scene.labels, kinds, patches, title=title)
        left_out = step.write_step(place / "surfaces.step", scene.primitives, patches) if step.available() else []
    lost = {
        "surfaces.obj": ("too few points to trim it to", [i for i in range(len(names)) if i not in shown]),
        "surfaces.step": ("no valid face came of it", [i for i in left_out if i in shown]),
    }
    return [_note(file, why, [names[i] for i in which]) for file, (why, which) in lost.items() if which]


def _write_deviations(path: Path, scene: "Scene") -> None:
    from jprimfit.io import palette, ply

    deviations = scene.signed_distances
    known = deviations[np.isfinite(deviations)]
    scale = FULL_COLOR * float(np.sqrt(np.mean(known**2))) if len(known) else 0.0
    colors = palette.colors_of_deviations(deviations, scale=scale)
    ply.write_deviations(path, scene.points, colors, deviations, scene.labels, scale=scale)


def _note(file: str, why: str, names: Sequence[str]) -> str:
    more = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    return f"{file} lacks {', '.join(names[:MAX_NAMES])}{more} ({why})"


def check_target(folder: Path) -> None:
    """ValueError of one sentence if `folder` can certainly not be written, so that nobody waits for a fit in vain."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--out {folder} is a file: give a folder.")
    existing = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        raise ValueError(f"--out {folder} cannot be written ({existing} does not allow it): give another folder.")


@contextlib.contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """An empty folder whose files become those of `folder` when the block ends well; otherwise nothing has happened."""
    folder = folder.absolute()
    missing = [parent for parent in folder.parents if not parent.exists()]
    folder.parent.mkdir(parents=True, exist_ok=True)
    place = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.partial")
    try:
        place.mkdir()
        yield place
        _publish(place, folder)
    except BaseException:
        shutil.rmtree(place, ignore_errors=True)
        with contextlib.suppress(OSError):  # one that is no longer empty stays
            for parent in missing:
                parent.rmdir()
        raise


def _publish(place: Path, folder: Path) -> None:
    if not folder.exists():
        os.rename(place, folder)
        return
    made = [name for name in NAMES if (place / name).exists()]
    for name in made:
        os.replace(place / name, folder / name)
    for name in set(NAMES) - set(made):
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(place)
