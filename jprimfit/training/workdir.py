"""The folder of one run: whose it is, what may be resumed in it, and where an old run goes.

config.yaml    all settings of the run          metrics.jsonl   what was measured, a line each
checkpoints/   to resume from                   best/, last/    exported models: weights.npz and weights.yaml
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import yaml

from jprimfit import settings
from jprimfit.io.files import only_here, replacing
from jprimfit.networks import weights
from jprimfit.training.config import Config, forbidden_changes

SETTINGS = "config.yaml"
LOCK = ".lock"
BEST, LAST = "best", "last"


@contextlib.contextmanager
def prepared(folder: Path, config: Config, *, fresh: bool) -> Iterator[None]:
    """The folder made ready for a run with these settings, which it keeps as config.yaml, and locked.

    An old run is left for resuming, unless `fresh`, which renames its folder to `<folder>.1`, `.2`, ... ValueError
    where another training is in the folder, where the old run had other settings (see config.forbidden_changes),
    where the folder is none of ours, or where it would be renamed and holds the model of train.start_from.
    """
    if fresh and folder.exists() and any(path.name != LOCK for path in folder.iterdir()):
        _refuse_own_model(folder, config.train.start_from)
        with locked(folder):
            pass
        folder.rename(_free_name(folder))
    with locked(folder):
        _keep_settings(folder, config)
        yield


def locked(folder: Path) -> contextlib.AbstractContextManager[None]:
    """Keeps other trainings out of the folder, which is made where it is missing; ValueError where one is in it."""
    folder.mkdir(parents=True, exist_ok=True)
    return only_here(folder / LOCK, f"{folder} is in use by another training: wait for it, or give another --workdir.")


def _refuse_own_model(folder: Path, start_from: str | None) -> None:
    if start_from is None or start_from in weights.SHIPPED:
        return
    if Path(start_from).resolve().is_relative_to(folder.resolve()):
        raise ValueError(
            f"train.start_from = {start_from} lies in {folder}, which --fresh would rename: give another --workdir."
        )


def _keep_settings(folder: Path, config: Config) -> None:
    record = folder / SETTINGS
    if record.exists():
        keys = forbidden_changes(settings.read_yaml(record), config)
        if keys:
            raise ValueError(
                f"{folder} holds a run with other settings of {', '.join(keys)}: set them as they were, give another "
                "--workdir, or --fresh to put the old run aside."
            )
    elif any(path.name != LOCK for path in folder.iterdir()):
        raise ValueError(f"{folder} holds files, but no {SETTINGS} of a run: give an empty or a new --workdir.")
    with replacing(record) as file:
        file.write(yaml.safe_dump(settings.to_mapping(config), sort_keys=False).encode())


def _free_name(folder: Path) -> Path:
    number = 1
    while os.path.lexists(folder.with_name(f"{folder.name}.{number}")):
        number += 1
    return folder.with_name(f"{folder.name}.{number}")
