"""From the state of a training to a model that others can load: networks/weights writes it, this says what goes in."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from jprimfit import settings
from jprimfit.networks import weights
from jprimfit.training.config import Config
from jprimfit.training.state import TrainState, variables


def export(
    state: TrainState,
    config: Config,
    folder: str | os.PathLike[str],
    *,
    info: Mapping[str, Any] | None = None,
    precision: Literal["float32", "float16"] = "float32",
) -> weights.Model:
    """Writes weights.npz and weights.yaml into the folder: averaged weights, or the plain ones where none are kept.

    The YAML tells the steps made, all settings of the training (of data files the name, not the place) and what info
    adds: text, numbers, lists and mappings of them. The model's name is that of the workdir. ValueError where weights
    are not finite.
    """
    folder = Path(folder)
    told = settings.to_mapping(config)
    del told["model"]  # stands in the YAML as the config of the network
    for section in ("data", "validation"):
        told[section] |= {key: Path(told[section][key]).name for key in ("file", "cache")}
    arrays = jax.tree.map(np.asarray, variables(state))
    start = told["train"]["start_from"]
    told["train"]["start_from"] = start and _name(Path(start))
    about = {"steps": int(state.step), "settings": told, **(info or {})}
    model = weights.Model(config.model, arrays, _name(folder), about)
    weights.save(folder / "weights", model, precision=precision)
    return model


def _name(folder: Path) -> str:
    """Of the workdir, also where a model in it is meant."""
    place = folder.resolve()
    return place.parent.name if place.name in ("best", "last") else place.name
