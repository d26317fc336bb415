"""One step of training as one device sees it, and the answer of the network that validation looks at.

The network is a function of one cloud; here it is vmapped over the clouds of a batch under the axis name "cloud",
and "device" is the axis of training/parallel. Every random number follows from the number of the cloud in the whole
run (step * batch size + row), never from the device it is worked on. Letters: b clouds (of this device).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Int

from jprimfit import settings
from jprimfit.data.examples import Example, Scan
from jprimfit.geometry.hierarchy import from_index_sets
from jprimfit.networks import weights
from jprimfit.objectives import memberships
from jprimfit.objectives.losses import losses
from jprimfit.training import state as states
from jprimfit.training.config import Config
from jprimfit.training.inputs import network_inputs
from jprimfit.training.parallel import AXIS
from jprimfit.training.state import TrainState
from jprimfit.types import Prediction

CLOUD = "cloud"


class Batch(NamedTuple):
    """Clouds and their rows in the batch of all devices."""

    example: Example | Scan  # with a leading axis b
    row: Int[Any, "b"]  # int32


def initial_variables(segmenter: nn.Module, example: Example | Scan, *, config: Config) -> Any:
    """The variables before training, from the seed; example is one cloud and gives the shapes."""

    @jax.jit
    def initialise(key, example):
        inputs = network_inputs(example, model=config.model)
        return segmenter.init({"params": key}, *inputs, train=False, segments=_segments(example, config))

    return initialise(jax.random.key(config.seed), example)


def start_model(config: Config) -> weights.Model | None:
    """The model of train.start_from, None where a run begins with new variables.

    ValueError where there is no such model or it has other settings.
    """
    if config.train.start_from is None:
        return None
    model = weights.load(config.train.start_from)
    keys = settings.differences(model.config, config.model)
    if keys:
        raise ValueError(
            f"train.start_from = {config.train.start_from} is a network with other settings of "
            f"{', '.join(f'model.{key}' for key in keys)}: set them alike, or begin anew."
        )
    return model


def train_step(segmenter: nn.Module, *, config: Config, num_steps: int) -> Callable[..., tuple[TrainState, dict]]:
    """The function (state, batch) -> (state, metrics) of one device, for training/parallel.

    The metrics are means over the whole batch: the terms of the loss, "total", the length of the gradient, the
    learning rate, and whether all of these are finite. Where they are not and the settings let such a step be skipped,
    only the number of the step changes.
    """

    def step(state: TrainState, batch: Batch) -> tuple[TrainState, dict]:
        slopes, batch_stats, terms = gradients(segmenter, state, batch, config=config)
        learning_rate = states.rate(
            state.step, config=config.optimizer, batch_size=config.train.batch_size, num_steps=num_steps
        )
        length = optax.global_norm(slopes)
        finite = jnp.isfinite(terms["total"]) & jnp.isfinite(length)
        metrics = {**terms, "gradient_norm": length, "learning_rate": learning_rate, "finite": finite}
        with jax.named_scope("update"):
            updated = states.update(state, slopes, batch_stats, learning_rate, config=config.optimizer)
            if config.optimizer.skip_non_finite:
                kept = jax.tree.map(lambda new, old: jnp.where(finite, new, old), updated, state)
                updated = kept._replace(step=updated.step)
        return updated, metrics

    return step


def gradients(segmenter: nn.Module, state: TrainState, batch: Batch, *, config: Config) -> tuple[Any, Any, dict]:
    """Gradients of the mean loss over the whole batch, its BatchNorm statistics and the mean of every term.

    To be called where the axis "device" exists; the three are the same on every device. With train.accumulate the share
    of this device is worked on in that many parts, and BatchNorm normalises each part by its own statistics.
    """
    number = state.step.astype(jnp.uint32) * config.train.batch_size + batch.row.astype(jnp.uint32)
    keys = jax.vmap(lambda n: jax.random.fold_in(jax.random.key(config.seed + 1), n))(number)

    def of_part(batch_stats, part):
        def mean_loss(params):
            def one(example, key):
                variables = {"params": params, "batch_stats": batch_stats}
                return _loss(segmenter, variables, example, key, config=config)

            terms, changed = jax.vmap(one, axis_name=CLOUD, out_axes=(0, None))(*part)
            terms = jax.tree.map(jnp.mean, terms)
            return terms["total"], (changed, terms)

        slopes, (changed, terms) = jax.grad(mean_loss, has_aux=True)(state.params)
        return changed, (slopes, terms)

    share, parts = (batch.example, keys), config.train.accumulate
    if parts == 1:
        batch_stats, (slopes, terms) = of_part(state.batch_stats, share)
    else:
        share = jax.tree.map(lambda x: x.reshape(parts, len(x) // parts, *x.shape[1:]), share)
        batch_stats, each = lax.scan(of_part, state.batch_stats, share)
        slopes, terms = jax.tree.map(lambda x: jnp.mean(x, axis=0), each)
    return lax.pmean(slopes, AXIS), batch_stats, lax.pmean(terms, AXIS)


def predict(segmenter: nn.Module, variables: Any, example: Example) -> Prediction:
    """What the network says of one cloud at its queries, outside training; per-point types only."""
    hierarchy = from_index_sets(example.points, example.sets, example.mask)
    inputs = (example.points, hierarchy, example.local_normals, example.curvature, example.query)
    return segmenter.apply(variables, *inputs, train=False)  # pyright: ignore[reportReturnType]


def _loss(
    segmenter: nn.Module, variables: Any, example: Example | Scan, key: Any, *, config: Config
) -> tuple[dict, Any]:
    """The terms of one cloud, and the statistics of the batch it is part of."""
    with jax.named_scope("inputs"):
        inputs = network_inputs(example, model=config.model)
    prediction, changed = segmenter.apply(
        variables,
        *inputs,
        train=True,
        segments=_segments(example, config),
        rngs={"dropout": key},
        mutable=["batch_stats"],
    )
    seen = example.points[example.query.astype(jnp.int32)]
    with jax.named_scope("losses"):
        terms = losses(prediction, example.truth, seen, config.loss)
    return terms, changed.get("batch_stats", {})


def _segments(example: Example | Scan, config: Config) -> Any:
    """While it learns, a classifier of whole segments is asked for the true ones."""
    if config.model.types != "pooled":
        return None
    return memberships.of_truth(example.truth, dtype=example.points.dtype)
