"""What a training carries from step to step, and how one update changes it.

The random keys are no part of it: they follow from the seed, the step and the row of the batch.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from jprimfit.training import schedule
from jprimfit.training.config import OptimizerConfig


class TrainState(NamedTuple):
    """Everything that a resumed run needs; a pytree of arrays, the same on every device."""

    step: Int[Any, ""]  # int32, updates made
    params: Any
    batch_stats: Any  # running means and variances of BatchNorm; {} where there is none
    optimizer: Any  # the moments of Adam
    average: Any = None  # moving average of {"params", "batch_stats"}; None where optimizer.ema is 0


def create(variables: Any, *, config: OptimizerConfig) -> TrainState:
    """The state before the first step, as host arrays, from the initial variables of a network."""
    variables = jax.tree.map(np.asarray, dict(variables))
    params, batch_stats = variables["params"], variables.get("batch_stats", {})
    average = {"params": params, "batch_stats": batch_stats} if config.ema else None
    moments = jax.tree.map(np.asarray, transformation(config).init(params))
    return TrainState(np.zeros((), np.int32), params, batch_stats, moments, average)


def variables(state: TrainState) -> dict[str, Any]:
    """What the network is evaluated and exported with."""
    if state.average is not None:
        return state.average
    return {"params": state.params, "batch_stats": state.batch_stats}


def transformation(config: OptimizerConfig) -> optax.GradientTransformation:
    """From gradients to updates of a learning rate of 1, not yet negated."""
    adam = optax.scale_by_adam(b1=config.beta1, b2=config.beta2, eps=config.epsilon)
    return adam if config.clip_norm is None else optax.chain(optax.clip_by_global_norm(config.clip_norm), adam)


def rate(step: Int[Array, ""], *, config: OptimizerConfig, batch_size: int, num_steps: int) -> Float[Array, ""]:
    """The learning rate of the update after `step` updates."""
    if config.schedule == "cosine":
        value = schedule.cosine(step, learning_rate=config.learning_rate, num_steps=num_steps)
    else:
        value = schedule.staircase(
            step,
            learning_rate=config.learning_rate,
            decay_factor=config.decay_factor,
            decay_every=config.decay_every,
            samples_per_step=batch_size if config.decay_unit == "samples" else 1,
        )
    return value * schedule.warm_up(step, num_steps=round(config.warmup * num_steps))


def update(
    state: TrainState, gradients: Any, batch_stats: Any, learning_rate: Float[Array, ""], *, config: OptimizerConfig
) -> TrainState:
    """The state after one step down the gradients."""
    steps, moments = transformation(config).update(gradients, state.optimizer, state.params)
    params = jax.tree.map(lambda p, s: p - learning_rate.astype(p.dtype) * s, state.params, steps)
    average = state.average
    if average is not None:
        # Young averages forget faster, or the initial weights would stay in them for 1 / (1 - decay) steps.
        age = state.step.astype(jnp.float32)
        decay = jnp.minimum(config.ema, (1 + age) / (10 + age))
        new = {"params": params, "batch_stats": batch_stats}
        average = jax.tree.map(lambda a, x: a + (1 - decay).astype(a.dtype) * (x - a), average, new)
    return TrainState(state.step + 1, params, batch_stats, moments, average)
