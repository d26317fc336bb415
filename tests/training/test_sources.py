"""The clouds of a run: two pools, and every validation cloud once."""

import jax
import numpy as np

from jprimfit.data.examples import Example
from jprimfit.training import sources
from jprimfit.training.config import from_mapping


class Opened:
    """A loader that only says what it was opened with."""

    def __init__(self, config, spec, neighborhoods, *, seed, progress):
        self.config, self.spec, self.neighborhoods, self.seed = config, spec, neighborhoods, seed
        self.num_clouds = 5


def test_both_pools_are_made_for_the_network(toy_mapping, monkeypatch):
    monkeypatch.setattr("jprimfit.training.sources.Loader", Opened)
    toy_mapping["validation"] = {"num_clouds": 3}
    config = from_mapping(toy_mapping, source="c.yaml")
    opened = sources.open_sources(config)
    for loader, split, num_clouds in ((opened.training, "train", 0), (opened.validation, "val", 3)):
        assert (loader.spec, loader.neighborhoods) == (config.model.hierarchy, (8,))
        assert (loader.config.split, loader.config.num_clouds, loader.config.file) == (split, num_clouds, "toy.h5")
        assert loader.seed == config.seed
    assert opened.num_clouds == 5


def test_every_validation_cloud_comes_once(toy_loader, toy_batch):
    parts = list(sources.validation_batches(toy_loader, 3))
    assert [len(part.points) for part in parts] == [3, 3, 2] and all(isinstance(part, Example) for part in parts)
    together = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    jax.tree.map(np.testing.assert_array_equal, together, toy_batch)
