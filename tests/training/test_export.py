"""What a training exports is what its network is evaluated with, and it tells how it was made, but not where."""

import jax
import numpy as np
import pytest

from jprimfit import settings
from jprimfit.networks import weights
from jprimfit.training import state
from jprimfit.training.config import from_mapping
from jprimfit.training.export import export


@pytest.fixture
def config(toy_mapping):
    """Settings of a run on a file somewhere."""
    toy_mapping["data"] |= {"file": "/home/someone/sets/parts.h5", "cache": "/home/someone/pools"}
    toy_mapping["optimizer"] |= {"ema": 0.9}
    return from_mapping(toy_mapping, source="test")


def state_of(config):
    generator = np.random.default_rng(0)
    shapes = weights.expected_shapes(config.model)
    arrays = {name: generator.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    return state.create(weights._nested(arrays), config=config.optimizer)._replace(step=np.int32(40))


def test_the_average_is_exported_where_one_is_kept(config, tmp_path):
    trained = state_of(config)
    assert trained.average is not None
    trained = trained._replace(average=jax.tree.map(lambda x: x + 1, trained.average))
    export(trained, config, tmp_path / "run" / "best")
    found = weights.load(tmp_path / "run")
    assert found.name == "run" and found.config == config.model
    jax.tree.map(np.testing.assert_array_equal, found.variables, trained.average)
    export(trained._replace(average=None), config, tmp_path / "plain")
    found = weights.load(tmp_path / "plain")
    assert found.name == "plain"
    jax.tree.map(np.testing.assert_array_equal, found.variables["params"], trained.params)


def test_it_tells_how_it_was_trained_but_no_place_of_a_file(config, tmp_path):
    export(state_of(config), config, tmp_path / "toy", info={"miou": 0.5})
    info = weights.load(tmp_path / "toy").info
    assert info["steps"] == 40 and info["miou"] == 0.5
    assert info["settings"]["optimizer"] == settings.to_mapping(config.optimizer)
    assert info["settings"]["data"]["file"] == "parts.h5" and "model" not in info["settings"]
    assert "someone" not in (tmp_path / "toy" / "weights.yaml").read_text()


def test_arrays_on_a_device_and_half_precision_will_do(config, tmp_path):
    on_device = jax.tree.map(jax.numpy.asarray, state_of(config))
    model = export(on_device, config, tmp_path / "toy", precision="float16")
    found = weights.load(tmp_path / "toy")
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=2**-11, atol=1e-7), found.variables, model.variables
    )


def test_weights_that_are_lost_are_not_exported(config, tmp_path):
    lost = state_of(config)._replace(average=None)
    lost = lost._replace(params=jax.tree.map(lambda x: x * np.nan, lost.params))
    with pytest.raises(ValueError, match="is not written, .* holds values that are not finite"):
        export(lost, config, tmp_path / "toy")
    assert not (tmp_path / "toy").exists()
