"""Where the clouds of a run come from: the pool or stream it learns from, and the fixed pool it is validated on."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax

from jprimfit.data.examples import Example
from jprimfit.data.loader import Loader, LoaderConfig
from jprimfit.data.stream import Stream
from jprimfit.training import parallel
from jprimfit.training.config import Config

AHEAD = 3  # batches that a stream has room for


class Sources(NamedTuple):
    """What a run draws from; close the training's when it is over."""

    training: Loader | Stream
    validation: Loader

    @property
    def num_clouds(self) -> int:
        """Clouds of an epoch."""
        return self.training.num_clouds


def open_sources(config: Config) -> Sources:
    """Opens both, and builds pools that are missing: the process that writes first, the others after it."""
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

    validation = loader(config.validation)
    if config.data.feed == "pool":
        return Sources(loader(config.data), validation)
    rows = parallel.share(config.train.batch_size)
    num_slots = AHEAD * max(1, rows.stop - rows.start)
    return Sources(Stream(config.data, seed=config.seed, num_slots=num_slots), validation)
