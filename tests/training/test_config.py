"""Settings of a training: the shipped files load, and what may change when a run is resumed."""

import math
from pathlib import Path

import pytest

from jprimfit import settings
from jprimfit.networks.weights import expected_shapes
from jprimfit.training.config import OptimizerConfig, TrainConfig, forbidden_changes, from_mapping, num_steps, read

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = sorted((ROOT / "configs").glob("*.yaml"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_file_says_what_it_is_for_and_loads(path):
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# Aim: ") and "\n# Command: " in text
    assert f"python train.py --config configs/{path.name}" in text
    config = read(path)
    assert config.validation.split == "val" and config.data.split == "train"
    assert config.validation.max_instances == config.data.max_instances
    assert from_mapping(settings.to_mapping(config), source="itself") == config


def test_the_paper_is_trained_as_it_says():
    config = read(ROOT / "configs" / "paper.yaml")
    assert config.model.hierarchy.num_points == (1024, 256, 64, 36)
    assert config.model.hierarchy.encoder_neighbors == (32,) * 4
    assert (config.train.batch_size, config.train.epochs) == (32, 300)
    assert (config.train.validate_every, config.train.checkpoint_every) == (2000, 500)
    assert num_steps(config.train, 13_831) == 129_666
    assert all(getattr(config.loss, name) == 1 for name in ("miou", "normal", "type", "parameter", "residue", "total"))
    assert config.loss.orthogonality == 0.1


def test_steps_win_over_epochs():
    assert num_steps(TrainConfig(batch_size=32, steps=7, epochs=300.0), 100) == 7
    assert num_steps(TrainConfig(batch_size=32, epochs=0.5), 100) == 2
    with pytest.raises(ValueError, match="steps is None; expected given, or epochs"):
        TrainConfig()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"data": {"num_points": 96, "num_query": 0}}, "data.file is ''; expected the path of a dataset"),
        ({"data": {"file": "x.h5"}}, "data.num_points is 8192; expected 96, as model.num_points says"),
        ({"loss": {"residue": 1}}, "data.num_samples is 0; expected above 0 for loss.residue"),
        ({"validation": {"num_points": 100}}, "validation.num_points is 100; expected 96"),
        ({"optimiser": {"learning_rate": 1}}, "unknown key 'optimiser' in c.yaml, did you mean 'optimizer'"),
        ({"optimizer": {"learning_rate": -1}}, "optimizer: learning_rate is -1.0; expected above 0"),
        ({"train": {"steps": 3, "batch_size": 0}}, "train: batch_size is 0; expected 1 or more"),
    ],
)
def test_what_does_not_fit_together_is_refused(toy_mapping, change, sentence):
    with pytest.raises(ValueError) as caught:
        from_mapping({**toy_mapping, **change}, source="c.yaml")
    assert sentence in str(caught.value) and "c.yaml" in str(caught.value)


def test_more_instances_than_slots_are_refused(toy_mapping):
    toy_mapping["model"]["num_slots"] = 3
    with pytest.raises(ValueError, match="data.max_instances is 4; expected at most model.num_slots = 3"):
        from_mapping(toy_mapping, source="c.yaml")


def test_only_what_no_parameter_depends_on_may_change(toy_mapping):
    def config(**optimizer):
        return from_mapping({**toy_mapping, "optimizer": optimizer}, source="c.yaml")

    def changed(before, **train):
        mapping = settings.to_mapping(before)
        mapping["train"] |= train
        return from_mapping(mapping, source="c.yaml")

    before = config()
    free = {
        "time_limit_minutes": 3,
        "log_every": 7,
        "parallel": "shard_map",
        "checkpoint_every": 9,
        "tensorboard": True,
    }
    assert forbidden_changes(before, changed(before, **free)) == []
    assert forbidden_changes(before, changed(before, steps=80)) == []
    assert forbidden_changes(before, changed(before, batch_size=4)) == ["train.batch_size"]
    assert forbidden_changes(before, config(learning_rate=1)) == ["optimizer.learning_rate"]
    for optimizer in ({"schedule": "cosine"}, {"warmup": 0.1}):
        before = config(**optimizer)
        assert forbidden_changes(before, changed(before, steps=80)) == ["train.steps"]


def test_defaults_are_the_papers():
    config = OptimizerConfig()
    assert (config.learning_rate, config.decay_factor, config.decay_every) == (0.001, 0.7, 200_000)
    assert (config.schedule, config.decay_unit) == ("staircase", "samples")


@pytest.mark.parametrize(("name", "most"), [("small", 2.8e6), ("tiny", 1e6), ("paper", 2e7), ("spfn", 2e6)])
def test_networks_have_the_size_they_are_meant_to(name, most):
    shapes = expected_shapes(read(ROOT / "configs" / f"{name}.yaml").model)
    count = sum(math.prod(shape) for key, shape in shapes.items() if key.startswith("params"))
    assert most / 5 < count <= most
