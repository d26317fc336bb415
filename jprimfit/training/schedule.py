"""Learning rates as functions of the step alone, so that a resumed run takes the rates of an undisturbed one.

step counts updates already made; a sample is one cloud of a batch, so `samples = step * batch_size`. The staircase is
SPFN's (L. Li et al., CVPR 2019), the cosine that of I. Loshchilov and F. Hutter (2017).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def staircase(
    step: Int[Array, ""], *, learning_rate: float, decay_factor: float, decay_every: int, samples_per_step: int
) -> Float[Array, ""]:
    """learning_rate * decay_factor ^ floor(step * samples_per_step / decay_every); 1 sample per step counts steps.

    Exact in int32 up to 2^31 steps: the product is never formed.
    """
    # floor(step * s / d) from step = a d + b is a s + floor(b s / d), and b s stays small.
    whole, rest = step // decay_every, step % decay_every
    count = whole * samples_per_step + rest * samples_per_step // decay_every
    return jnp.float32(learning_rate) * jnp.float32(decay_factor) ** count.astype(jnp.float32)


def cosine(step: Int[Array, ""], *, learning_rate: float, num_steps: int) -> Float[Array, ""]:
    """learning_rate * (1 + cos(pi * step / num_steps)) / 2: it falls to 0 at num_steps and stays there."""
    share = jnp.minimum(step.astype(jnp.float32) / num_steps, 1)
    return jnp.float32(learning_rate) * (1 + jnp.cos(jnp.pi * share)) / 2


def warm_up(step: Int[Array, ""], *, num_steps: int) -> Float[Array, ""]:
    """A factor that rises linearly from 1 / num_steps at step 0 to 1; 1 throughout where num_steps is 0."""
    return jnp.minimum((step.astype(jnp.float32) + 1) / max(num_steps, 1), 1)
