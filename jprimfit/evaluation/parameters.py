"""How well the parameters of known surfaces come back from noisy points: the paper's Tables 2-5, and beyond.

Every cell is a patch, a noise level, a number of points, and as many independent data sets as asked for; a data set is
drawn from (seed, cell, number) alone, so the result does not depend on how many processes share the work. No normals
are given. The error of a data set is the sum of the absolute errors of the listed parameters, as in the paper.
"""

import itertools
import math
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from jprimfit.evaluation import bounds, patches
from jprimfit.evaluation.patches import Patch
from jprimfit.fitting.info import sq_distance, step_between
from jprimfit.fitting.single import fit_primitive
from jprimfit.io.text_table import text_table

# The rows "absolute error" of the paper's Tables 2-5, at 5, 10 and 15 % (Entropy 2024, 26(9), 717); of the cylinder
# without its position along the axis, which no point of the surface tells.
PAPER = {
    "plane": (0.005656, 0.017210, 0.092869),
    "sphere": (0.011698, 0.153006, 0.257090),
    "cylinder": (0.014381, 0.131642, 0.155114),
    "cone": (0.034604, 0.094964, 0.198668),
}
NUM_POINTS = 60_000
OUTLIERS = 0.05  # of the points, even in the box of the patch enlarged by half
CHUNK = 10  # data sets that a worker takes at a time
SEED = 20_240_717
CONFIDENCE = 0.95


class Cell(NamedTuple):
    """What is drawn, and which block of the table it stands in."""

    block: str  # "whole", "part", "few points", "coverage"
    patch: Patch
    noise: float  # standard deviation over patch.unit
    num_points: int
    outliers: float = 0.0


class Outcome(NamedTuple):
    """One data set: what came back, against the truth."""

    ok: bool
    errors: Float[np.ndarray, " f"]  # signed, of the listed parameters
    step: Float[np.ndarray, " p"]  # from the truth to the answer, in the coordinates of Info about the patch's mean
    sq_distance: float  # of the truth from the answer in its own covariance: chi-squared with p degrees if that holds
    sigma: float  # found over true
    seconds: float


def cells(*, coverage: bool = True) -> list[Cell]:
    """All cells in the order of the table."""
    levels = (0.05, 0.10, 0.15)
    found = [Cell("whole", patch, noise, NUM_POINTS) for patch in patches.WHOLE for noise in (0.0, *levels)]
    found += [Cell("part", patch, noise, NUM_POINTS) for patch in patches.PARTIAL for noise in levels]
    found += [Cell("few points", patch, 0.05, count) for patch in patches.WHOLE for count in (100, 300, 1_000)]
    found += [Cell("few points", patch, 0.05, 1_000, OUTLIERS) for patch in patches.WHOLE]
    if coverage:
        pairs = zip(patches.WHOLE, patches.QUARTERS, strict=True)
        for patch, noise, count in itertools.product(itertools.chain(*pairs), (0.01, 0.05), (1_000, 10_000)):
            found.append(Cell("coverage", patch, noise, count))
    return found


def count_of(cell: Cell, num_datasets: int) -> int:
    """How many data sets a cell takes: at most 10 without noise, twice the number for a frequency of coverage."""
    if cell.noise == 0.0:
        return min(num_datasets, 10)
    return 2 * num_datasets if cell.block == "coverage" else num_datasets


def run(
    chosen: list[Cell],
    num_datasets: int,
    *,
    workers: int | None = None,
    initializer: Callable[[], object] | None = None,
    progress: Callable[[int], object] | None = None,
) -> list[dict[str, Any]]:
    """The summary of every cell, in order, the data sets shared among processes (one per core if workers is None).

    initializer: what every process calls first. progress: called with the number of data sets that were finished.
    """
    counts = [count_of(cell, num_datasets) for cell in chosen]
    tasks = [
        (number, first, min(CHUNK, count - first))
        for number, count in enumerate(counts)
        for first in range(0, count, CHUNK)
    ]
    outcomes: list[list[Outcome]] = [[] for _ in chosen]
    with ProcessPoolExecutor(workers or os.cpu_count(), get_context("spawn"), initializer=initializer) as pool:
        jobs = [pool.submit(_outcomes, chosen[number], number, first, count) for number, first, count in tasks]
        for (number, _, count), job in zip(tasks, jobs, strict=True):
            outcomes[number] += job.result()
            if progress:
                progress(count)
    return [summary(cell, found) for cell, found in zip(chosen, outcomes, strict=True)]


def summary(cell: Cell, outcomes: list[Outcome]) -> dict[str, Any]:
    """Figures of a cell: errors against the bounds and the paper, bias in standard deviations, coverage, time.

    Over the data sets that were ok: "mean" and "sd" of the summed absolute error; "bias", the largest over the unknowns
    of |mean step| over the standard deviation of a single step; "coverage", the share of those whose 95 % joint region
    holds the truth.
    """
    good = [outcome for outcome in outcomes if outcome.ok]
    sigma = cell.noise * cell.patch.unit
    row: dict[str, Any] = {
        "block": cell.block,
        "patch": cell.patch.name,
        "noise": cell.noise,
        "num_points": cell.num_points,
        "outliers": cell.outliers,
        "num_datasets": len(outcomes),
        "ok": len(good) / len(outcomes),
        "seconds": float(np.median([outcome.seconds for outcome in outcomes])),
    }
    if not good:
        return row
    totals = np.array([np.abs(outcome.errors).sum() for outcome in good])
    steps = np.stack([outcome.step for outcome in good])
    conditional = bounds.mean_absolute_error(cell.patch, bounds.conditional(cell.patch, sigma, cell.num_points))
    limit = stats.chi2.ppf(CONFIDENCE, steps.shape[1])
    row |= {
        "mean": float(totals.mean()),
        "sd": float(totals.std(ddof=1)) if len(good) > 1 else float("nan"),
        "parameters": [float(value) for value in np.mean([outcome.errors for outcome in good], axis=0)],
        "parameters_sd": [float(value) for value in np.std([outcome.errors for outcome in good], axis=0)],
        "conditional": conditional,
        "ratio": float(totals.mean()) / conditional if sigma else float("nan"),
        "full_density": float("nan"),
        "bias": float(np.max(np.abs(steps.mean(axis=0)) / steps.std(axis=0))) if sigma and len(good) > 1 else 0.0,
        "coverage": float(np.mean([outcome.sq_distance <= limit for outcome in good])),
        "sigma_found": float(np.mean([outcome.sigma for outcome in good])),
    }
    if cell.block in ("whole", "part") and sigma:
        density = bounds.full_density(cell.patch, sigma, cell.num_points)
        row["full_density"] = float("nan") if density is None else bounds.mean_absolute_error(cell.patch, density)
    if cell.block == "whole" and sigma:
        row["paper"] = PAPER[cell.patch.truth.kind][(0.05, 0.10, 0.15).index(cell.noise)]
    return row


def text(rows: list[dict[str, Any]]) -> str:
    """The rows as tables, one per block."""
    blocks = []
    for block, title in TITLES.items():
        lines = [_line(row) for row in rows if row["block"] == block]
        if lines:
            blocks.append(f"{title}\n\n{text_table(COLUMNS, lines)}")
    return "\n\n".join(blocks)


TITLES = {
    "whole": "whole surfaces, as in the paper's Tables 2-5",
    "part": "parts of surfaces",
    "few points": "few points, and 5 % outliers (robust)",
    "coverage": "how often the 95 % joint region holds the truth",
}
COLUMNS = [
    "patch", "noise", "points", "error", "± sd", "paper", "conditional", "ratio", "density", "ratio", "bias/sd",
    "in region", "ok", "s",
]  # fmt: skip


def _line(row: dict[str, Any]) -> list[str]:
    def cell(name: str, pattern: str = "{:.5f}") -> str:
        value = row.get(name, float("nan"))
        return pattern.format(value) if math.isfinite(value) else "-"

    exact = row["noise"] == 0.0
    by_density = row.get("mean", float("nan")) / row.get("full_density", float("nan"))
    points = f"{row['num_points']:,}" + (f" + {100 * row['outliers']:.0f} %" if row["outliers"] else "")
    return [
        row["patch"],
        f"{100 * row['noise']:.0f} %",
        points,
        cell("mean", "{:.1e}" if exact else "{:.5f}"),
        cell("sd", "{:.1e}" if exact else "{:.5f}"),
        cell("paper"),
        "-" if exact else cell("conditional"),
        cell("ratio", "{:.3f}"),
        cell("full_density"),
        f"{by_density:.3f}" if math.isfinite(by_density) else "-",
        "-" if exact else cell("bias", "{:.2f}"),
        "-" if exact else cell("coverage", "{:.3f}"),
        cell("ok", "{:.3f}"),
        cell("seconds", "{:.3f}"),
    ]


def _outcomes(cell: Cell, number: int, first: int, count: int) -> list[Outcome]:
    return list(_drawn(cell, number, range(first, first + count)))


def _drawn(cell: Cell, number: int, datasets: range) -> Iterator[Outcome]:
    truth = cell.patch.truth
    # Steps are told about one place: the mean of noisy points goes along with the errors.
    middle = cell.patch.draw(np.random.default_rng(0), NUM_POINTS).mean(axis=0)
    for dataset in datasets:
        generator = np.random.default_rng([SEED, number, dataset])
        points = cell.patch.draw(generator, cell.num_points)
        points = points + cell.noise * cell.patch.unit * generator.normal(size=points.shape)
        num_outliers = round(cell.outliers * cell.num_points)
        if num_outliers:
            low, high = points.min(axis=0), points.max(axis=0)
            points[:num_outliers] = (low + high) / 2 + 1.5 * (high - low) * (generator.random((num_outliers, 3)) - 0.5)
        start = time.perf_counter()
        found, info = fit_primitive(truth.kind, points, robust=num_outliers > 0)
        seconds = time.perf_counter() - start
        step = step_between(truth, found, middle)
        away = sq_distance(found, info, truth) if cell.noise > 0.0 and info.ok else 0.0
        errors = patches.fields(found, truth) - patches.fields(truth, truth)
        noise = cell.noise * cell.patch.unit
        yield Outcome(info.ok, errors, step, away, info.sigma / noise if noise else 0.0, seconds)
