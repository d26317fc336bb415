"""All settings of one training, as configs/NAME.yaml holds them.

A step is one update of the parameters, an epoch as many clouds as the training set has.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from jprimfit import settings
from jprimfit.data.loader import LoaderConfig
from jprimfit.networks.segmenter import SegmenterConfig
from jprimfit.objectives.losses import LossConfig

# What a resumed run may change, because no parameter of the network depends on it.
FREE_TO_CHANGE = (
    "data.cache",
    "data.workers",
    "validation.cache",
    "validation.workers",
    "train.checkpoint_every",
    "train.devices",
    "train.log_every",
    "train.parallel",
    "train.tensorboard",
    "train.time_limit_minutes",
    "train.validate_every",
    "train.validation_batch_size",
)
LENGTH = ("train.steps", "train.epochs")


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam (D. Kingma and J. Ba, 2015) and its learning rate."""

    learning_rate: float = 0.001  # at its highest
    schedule: Literal["staircase", "cosine"] = "staircase"
    decay_factor: float = 0.7  # staircase: every decay_every units
    decay_every: int = 200_000
    decay_unit: Literal["samples", "steps"] = "samples"  # a sample is one cloud of a batch
    warmup: float = 0.0  # share of all steps in which the rate rises from 0, under both schedules
    clip_norm: float | None = None  # longest gradient, null = as it comes
    skip_non_finite: int = 0  # updates in a row left out for a loss or gradient that is not finite; one more stops
    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-8
    ema: float = 0.0  # decay of the moving average of the weights that validation and export use; 0 = the weights

    def __post_init__(self) -> None:
        _require(self.learning_rate > 0, "learning_rate", self.learning_rate, "above 0")
        _require(0 < self.decay_factor <= 1, "decay_factor", self.decay_factor, "above 0 and at most 1")
        _require(self.decay_every > 0, "decay_every", self.decay_every, "1 or more")
        _require(0 <= self.warmup < 1, "warmup", self.warmup, "a share from 0 to below 1")
        _require(self.clip_norm is None or self.clip_norm > 0, "clip_norm", self.clip_norm, "above 0 or null")
        _require(self.skip_non_finite >= 0, "skip_non_finite", self.skip_non_finite, "0 or more")
        _require(0 <= self.ema < 1, "ema", self.ema, "from 0 to below 1")


@dataclass(frozen=True)
class TrainConfig:
    """How long, on what, and what is written when."""

    batch_size: int = 32  # clouds, over all devices
    accumulate: int = 1  # parts of a device's share that are worked on one after the other, to need less memory
    steps: int | None = None  # of the whole run; wins over epochs where both are given
    epochs: float | None = None
    start_from: str | None = None  # name or folder of a model of the same architecture: its weights are the first ones
    validate_every: int = 2000  # steps; 0 = at the end only
    validation_batch_size: int = 8
    checkpoint_every: int = 500
    log_every: int = 50
    time_limit_minutes: float | None = None  # of one call; then saved, exported and ended
    parallel: Literal["pmap", "shard_map"] = "pmap"
    devices: int | None = None  # null = all
    tensorboard: bool = False

    def __post_init__(self) -> None:
        _require(self.batch_size > 0, "batch_size", self.batch_size, "1 or more")
        _require(self.accumulate > 0, "accumulate", self.accumulate, "1 or more")
        _require(self.steps is None or self.steps > 0, "steps", self.steps, "1 or more")
        _require(self.epochs is None or self.epochs > 0, "epochs", self.epochs, "above 0")
        _require(self.steps is not None or self.epochs is not None, "steps", self.steps, "given, or epochs")
        _require(self.validate_every >= 0, "validate_every", self.validate_every, "0 or more")
        _require(self.validation_batch_size > 0, "validation_batch_size", self.validation_batch_size, "1 or more")
        _require(self.checkpoint_every > 0, "checkpoint_every", self.checkpoint_every, "1 or more")
        _require(self.log_every > 0, "log_every", self.log_every, "1 or more")
        limit = self.time_limit_minutes
        _require(limit is None or limit > 0, "time_limit_minutes", limit, "above 0 or null")


@dataclass(frozen=True)
class Config:
    """One training; `train` has no default length, and `data` no default file."""

    data: LoaderConfig
    validation: LoaderConfig
    train: TrainConfig
    model: SegmenterConfig = field(default_factory=SegmenterConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    seed: int = 0  # of initial parameters, dropout, order and augmentation

    def __post_init__(self) -> None:
        for name, data in (("data", self.data), ("validation", self.validation)):
            _require(bool(data.file), f"{name}.file", repr(data.file), "the path of a dataset")
            expected = f"{self.model.num_points}, as model.num_points says"
            _require(data.num_points == self.model.num_points, f"{name}.num_points", data.num_points, expected)
        samples = self.data.num_samples
        _require(samples > 0 or not self.loss.residue, "data.num_samples", samples, "above 0 for loss.residue")
        slots, most = self.model.num_slots, self.data.max_instances
        _require(
            self.model.head != "slots" or slots >= most,
            "data.max_instances",
            most,
            f"at most model.num_slots = {slots}",
        )


def read(path: Path | str, overrides: Sequence[str] = ()) -> Config:
    """The settings of a file with `section.key=value` put over them; a ValueError says what is wrong in it."""
    return from_mapping(settings.with_overrides(settings.read_yaml(path), overrides), source=path)


def from_mapping(mapping: dict[str, Any], *, source: Path | str) -> Config:
    """The settings in a mapping. Section `validation` holds what differs from section `data`, and is split "val"."""
    data, validation = mapping.get("data"), mapping.get("validation") or {}
    if isinstance(data, dict) and isinstance(validation, dict):
        mapping = {**mapping, "validation": {**data, "split": "val", **validation}}
    return settings.from_mapping(Config, mapping, source=source)


def num_steps(config: TrainConfig, num_clouds: int) -> int:
    """Steps of the whole run over a training set of num_clouds clouds."""
    if config.steps is not None:
        return config.steps
    return max(1, math.ceil((config.epochs or 0) * num_clouds / config.batch_size))


def forbidden_changes(before: Config | dict[str, Any], after: Config) -> list[str]:
    """The dotted keys in which a run that is resumed with `after` differs from its beginning, and must not.

    Those of FREE_TO_CHANGE do not count. The length may change where the learning rate does not depend on it.
    """
    allowed = FREE_TO_CHANGE
    if after.optimizer.schedule == "staircase" and after.optimizer.warmup == 0:
        allowed += LENGTH
    mapping = settings.to_mapping(before) if isinstance(before, Config) else _completed(before)
    return [key for key in settings.differences(mapping, settings.to_mapping(after)) if key not in allowed]


def _completed(mapping: dict[str, Any]) -> dict[str, Any]:
    """The settings of an old run with the defaults of those that came later, where it can be read at all."""
    try:
        return settings.to_mapping(settings.from_mapping(Config, mapping, source="the old run"))
    except ValueError:
        return mapping


def _require(holds: bool, name: str, value: Any, expected: str) -> None:
    if not holds:
        raise ValueError(f"{name} is {value}; expected {expected}")
