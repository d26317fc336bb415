"""Learning rates against their closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.training.schedule import cosine, staircase, warm_up


@pytest.mark.parametrize("samples", [1, 7, 32])
def test_the_staircase_falls_where_the_samples_pass_a_multiple(samples):
    steps = np.array([0, 1, 30, 31, 32, 33, 6249, 6250, 6251, 12499, 12500, 99_999, 100_000, 2**31 - 1])
    rates = jax.vmap(
        lambda step: staircase(
            step, learning_rate=1e-3, decay_factor=0.7, decay_every=200_000, samples_per_step=samples
        )
    )(jnp.asarray(steps, jnp.int32))
    expected = [1e-3 * 0.7 ** (int(step) * samples // 200_000) for step in steps]
    np.testing.assert_allclose(rates, expected, rtol=1e-5, atol=1e-38)


def test_the_paper_has_twenty_decays():
    # 13,831 clouds, 300 epochs, batch 32: 129,667 steps
    last = staircase(jnp.int32(129_666), learning_rate=1e-3, decay_factor=0.7, decay_every=200_000, samples_per_step=32)
    np.testing.assert_allclose(last, 1e-3 * 0.7**20, rtol=1e-5)


def test_the_cosine_falls_to_nothing_and_stays_there():
    steps = np.array([0, 25, 50, 75, 100, 150])
    rates = jax.vmap(lambda step: cosine(step, learning_rate=2.0, num_steps=100))(jnp.asarray(steps))
    np.testing.assert_allclose(rates, [2, 1 + np.sqrt(0.5), 1, 1 - np.sqrt(0.5), 0, 0], atol=1e-6)


def test_warming_up_is_linear():
    factors = jax.vmap(lambda step: warm_up(step, num_steps=4))(jnp.arange(6))
    np.testing.assert_allclose(factors, [0.25, 0.5, 0.75, 1, 1, 1])
    assert warm_up(jnp.int32(0), num_steps=0) == 1
