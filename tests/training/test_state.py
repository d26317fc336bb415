"""One update against Adam written out."""

import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.training import state
from jprimfit.training.config import OptimizerConfig

GRADIENTS = [np.array([3.0, -4.0], np.float32), np.array([0.1, 0.2], np.float32)]


def run(config, gradients=GRADIENTS):
    now = state.create({"params": {"w": np.array([1.0, 2.0], np.float32)}}, config=config)
    for gradient in gradients:
        rate = state.rate(jnp.asarray(now.step), config=config, batch_size=1, num_steps=10)
        now = state.update(now, {"w": gradient}, {}, rate, config=config)
    return now


@pytest.mark.parametrize("clip", [None, 1.0])
def test_updates_are_adams(clip):
    config = OptimizerConfig(learning_rate=0.1, clip_norm=clip)
    w, m, v = np.array([1.0, 2.0]), np.zeros(2), np.zeros(2)
    for count, gradient in enumerate(GRADIENTS, start=1):
        if clip is not None:
            gradient = gradient * min(1, clip / np.linalg.norm(gradient))
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
        w = w - 0.1 * (m / (1 - 0.9**count)) / (np.sqrt(v / (1 - 0.999**count)) + 1e-8)
    end = run(config)
    assert end.step == 2
    np.testing.assert_allclose(end.params["w"], w, rtol=1e-5)


def test_the_average_follows_the_weights_faster_while_it_is_young():
    config = OptimizerConfig(learning_rate=0.1, ema=0.15)
    first, second = run(config, GRADIENTS[:1]), run(config)
    w0, w1, w2 = np.array([1.0, 2.0]), first.params["w"], second.params["w"]
    average = 0.1 * w0 + 0.9 * w1  # decay min(0.15, 1 / 10)
    np.testing.assert_allclose(state.variables(first)["params"]["w"], average, rtol=1e-5)
    average = 0.15 * average + 0.85 * w2  # decay min(0.15, 2 / 11)
    np.testing.assert_allclose(state.variables(second)["params"]["w"], average, rtol=1e-5)


def test_without_average_the_weights_themselves_are_used():
    end = run(OptimizerConfig())
    assert end.average is None and state.variables(end)["params"] is end.params


@pytest.mark.parametrize(
    ("config", "step", "expected"),
    [
        (OptimizerConfig(learning_rate=1.0), 200_000 // 32, 0.7),
        (OptimizerConfig(learning_rate=1.0), 200_000 // 32 - 1, 1.0),
        (OptimizerConfig(learning_rate=1.0, decay_unit="steps"), 200_000 // 32, 1.0),
        (OptimizerConfig(learning_rate=1.0, decay_unit="steps"), 200_000, 0.7),
        (OptimizerConfig(learning_rate=1.0, schedule="cosine"), 500, 0.5),
        (OptimizerConfig(learning_rate=1.0, schedule="cosine", warmup=0.1), 49, 0.5 * (1 + np.cos(0.049 * np.pi)) / 2),
        (OptimizerConfig(learning_rate=1.0, warmup=0.1), 0, 0.01),
    ],
)
def test_rates_follow_the_settings(config, step, expected):
    rate = state.rate(jnp.int32(step), config=config, batch_size=32, num_steps=1000)
    np.testing.assert_allclose(rate, expected, rtol=1e-5)
