"""Where the clouds of a run come from: the pool it learns from, and the fixed one it is validated on."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax

from jprimfit.data.examples import Example
from jprimfit.data.loader import Loader, LoaderConfig
from jprimfit.training import parallel
from jprimfit.training.config import Config


class Sources(NamedTuple):
    """The two loaders of a run."""

    training: Loader
    validation: Loader

    @property
    def num_clouds(self) -> int:
        """Clouds of an epoch."""
        return len(self.training.pool)


def open_sources(config: Config) -> Sources:
    """Opens both pools, and builds those that are missing: the process that writes first, the others after it."""
    if parallel.is_writer():
        sources = _open(config)
        parallel.agreed(True)
    else:
        parallel.agreed(True)
        sources = _open(config)
    return sources


def validation_batches(loader: Loader, batch_size: int) -> Iterator[Example]:
    """Every cloud of a pool once, as it is; the last batch is smaller."""
    for batch in loader.validation(batch_size):
        mask: Any = batch.mask
        yield batch.example if mask.all() else jax.tree.map(lambda x, m=mask: x[m], batch.example)


def _open(config: Config) -> Sources:
    def loader(data: LoaderConfig) -> Loader:
        model = config.model
        return Loader(data, model.hierarchy, model.neighborhoods, seed=config.seed, progress=parallel.is_writer())

    return Sources(loader(config.data), loader(config.validation))
