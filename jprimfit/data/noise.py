"""Measurement errors: what a scanner does to the points of a surface.

Two kinds, named as everywhere: "uniform" is SPFN's, along the normal within [-amount, amount] (Table 1 of the paper has
0.01 in the normalised frame); "gaussian" is isotropic with sigma = amount. Lengths in the unit of the points.
"""

import numpy as np
from jaxtyping import Float, Num

NOISE_KINDS = ("uniform", "gaussian")


def perturb(
    generator: np.random.Generator,
    points: Num[np.ndarray, "n 3"],
    normals: Num[np.ndarray, "n 3"],
    *,
    kind: str,
    amount: float,
) -> Float[np.ndarray, "n 3"]:
    """The points with independent errors, float64.

    Args:
        generator: consumed: a uniform draw takes n numbers from it, a Gaussian one 3 n.
        points: clean.
        normals: unit, of either sign; only "uniform" looks at them.
        kind: "uniform" or "gaussian".
        amount: half-width or standard deviation, a length of the points, at least 0.

    Raises:
        ValueError: an unknown kind, or an amount that is negative or not finite.
    """
    if not 0.0 <= amount < np.inf:
        raise ValueError(f"The amount of noise is {amount}, expected a finite length of at least 0.")
    points = np.asarray(points, np.float64)
    if kind == "uniform":
        return points + generator.uniform(-amount, amount, len(points))[:, None] * normals
    if kind == "gaussian":
        return points + amount * generator.standard_normal(points.shape)
    raise ValueError(f"The kind of noise is {kind!r}, expected one of {', '.join(NOISE_KINDS)}.")


def sigma_of_percent(points: Num[np.ndarray, "n 3"], percent: float) -> float:
    """The standard deviation that is `percent` per cent of the diagonal of the points' axis-aligned box (`--noise`)."""
    if not 0.0 <= percent < np.inf:
        raise ValueError(f"The noise is {percent} per cent, expected a finite number of at least 0.")
    return percent / 100.0 * float(np.sqrt(np.sum(np.square(np.ptp(np.asarray(points, np.float64), axis=0)))))
