"""One colour per primitive, the same in segments.ply, surfaces.obj and the report; and colours of deviations.

Colour i never depends on how many there are. Hues follow the golden angle, so that successive colours are far apart;
lightness cycles through three values, so that near hues still differ. Source: B. Ottosson 2020, the OKLCH colour space.
"""

import numpy as np
from jaxtyping import Float, Int, UInt8

GREY = (150, 150, 150)
LIGHTNESS = (0.70, 0.55, 0.82)
# After 21 steps of the golden angle the hue is 8 degrees from the first, at the same lightness: shifted then.
ROUND = 21
SHIFTS = (0.0, -0.08, 0.07)
CHROMA = 0.14
FIRST_HUE = 4.4  # radians; a blue
# Of the largest deviations: a red and a blue of one lightness.
RED_HUE, BLUE_HUE = 0.45, 4.55
FULL_LIGHTNESS, FULL_CHROMA = 0.52, 0.19


def colors(num: int) -> UInt8[np.ndarray, "num 3"]:
    """The first `num` colours, red green blue 0-255."""
    i = np.arange(num)
    hue = FIRST_HUE + i * np.pi * (3 - np.sqrt(5))
    lightness = np.array(LIGHTNESS)[i % len(LIGHTNESS)] + np.array(SHIFTS)[i // ROUND % len(SHIFTS)]
    return _srgb(lightness, CHROMA * np.cos(hue), CHROMA * np.sin(hue))


def colors_of_labels(labels: Int[np.ndarray, "n"]) -> UInt8[np.ndarray, "n 3"]:
    """The colour of each label; GREY for -1."""
    table = np.concatenate([np.array([GREY], np.uint8), colors(int(labels.max(initial=-1)) + 1)])
    return table[labels + 1]


def colors_of_deviations(deviations: Float[np.ndarray, "n"], *, scale: float) -> UInt8[np.ndarray, "n 3"]:
    """Blue at -scale and below, white at 0, red at scale and above, even to the eye between; GREY where not finite."""
    known = np.isfinite(deviations)
    share = np.clip(np.where(known, deviations, 0.0) / scale, -1, 1) if scale > 0 else np.zeros(len(deviations))
    strength = np.abs(share)
    hue = np.where(share > 0, RED_HUE, BLUE_HUE)
    chroma = FULL_CHROMA * strength
    found = _srgb(1 - (1 - FULL_LIGHTNESS) * strength, chroma * np.cos(hue), chroma * np.sin(hue))
    found[~known] = GREY
    return found


def _srgb(
    lightness: Float[np.ndarray, "n"], a: Float[np.ndarray, "n"], b: Float[np.ndarray, "n"]
) -> UInt8[np.ndarray, "n 3"]:
    """OKLab to sRGB, clipped to what a screen shows."""
    long = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3
    medium = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3
    short = (lightness - 0.0894841775 * a - 1.2914855480 * b) ** 3
    red = 4.0767416621 * long - 3.3077115913 * medium + 0.2309699292 * short
    green = -1.2684380046 * long + 2.6097574011 * medium - 0.3413193965 * short
    blue = -0.0041960863 * long - 0.7034186147 * medium + 1.7076147010 * short
    linear = np.clip(np.stack([red, green, blue], axis=1), 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(encoded * 255).astype(np.uint8)
