"""Scores of parts to means and standard errors, and these to tables.

A part's score is a mapping of numbers (METRICS and seconds; NaN where there was nothing to score) with a list
"instances" of one mapping per true instance (kind, share of the area, INSTANCE_METRICS). Fractions and degrees here,
per cent in what is printed. A mean over parts has the standard error of independent parts; one over instances that of
parts as clusters (ratio estimator, W. G. Cochran, Sampling Techniques, 1977), since the instances of a part share
their fate.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jprimfit.data.records import KINDS
from jprimfit.io.text_table import text_table

Score = Mapping[str, Any]
Summary = Mapping[str, Any]

# Of a part: column of the printed table, factor, digits.
METRICS = {
    "miou": ("mIoU %", 100.0, 1),
    "type_accuracy": ("type %", 100.0, 1),
    "normal_deg": ("normal deg", 1.0, 2),
    "axis_deg": ("axis deg", 1.0, 2),
    "residual": ("residual", 1.0, 4),
    "p_coverage": ("P cover %", 100.0, 1),
}
# Of an instance: what its mean is called. Columns as above.
INSTANCE_METRICS = {
    "iou": "miou",
    "type_right": "type_accuracy",
    "normal_deg": "normal_deg",
    "axis_deg": "axis_deg",
    "residual": "residual",
}
SMALL = 0.05  # share of the part's area below which an instance counts as small
GROUPS = {**{kind: f"{kind}s" for kind in KINDS}, "small": "under 5 % of the area", "large": "5 % and more"}


def summarise(parts: Sequence[Score]) -> dict[str, Any]:
    """Means and standard errors over parts, and over the instances of each kind and size.

    Returns {"mean": {name: value}, "standard_error": {name: value}, "groups": {group: instances}} with all numbers
    that parts carry; the instances of a group (the kinds, "small" and "large") are {"count", "mean", "standard_error"}.
    """
    names = [name for name, value in parts[0].items() if isinstance(value, int | float)]
    found = {name: _cluster_mean([np.array([part[name]], np.float64) for part in parts]) for name in names}
    return {
        "mean": {name: mean for name, (mean, _) in found.items()},
        "standard_error": {name: error for name, (_, error) in found.items()},
        "groups": {group: _group(parts, group) for group in GROUPS},
    }


def overall_text(summaries: Mapping[str, Summary]) -> str:
    """One line per method: the six metrics over parts with their standard errors, and seconds per part."""
    table = []
    for method, summary in summaries.items():
        cells = [_cell(summary, name, *METRICS[name][1:]) for name in METRICS]
        table.append([method, *cells, f"{summary['mean']['seconds']:.2f}"])
    return text_table(["method", *(column for column, *_ in METRICS.values()), "s/part"], table)


def groups_text(summaries: Mapping[str, Summary]) -> str:
    """One line per method and group of instances: what of the metrics an instance has, with its standard error."""
    names = list(INSTANCE_METRICS.values())
    table = []
    for method, summary in summaries.items():
        for group, words in GROUPS.items():
            found = summary["groups"][group]
            if found["count"]:
                cells = [_cell(found, name, *METRICS[name][1:]) for name in names]
                table.append([method, words, str(found["count"]), *cells])
    return text_table(["method", "instances", "number", *(METRICS[name][0] for name in names)], table)


def families_text(parts: Mapping[str, Sequence[Score]]) -> str:
    """One line per family of parts: mIoU and share of right kinds of every method; parts: the scores of each."""
    every = list(parts.values())
    families = list(dict.fromkeys(part["family"] for part in every[0]))
    table = []
    for family in families:
        chosen = [summarise([part for part in scores if part["family"] == family]) for scores in every]
        cells = [" / ".join(_cell(one, name, 100.0, 1) for name in ("miou", "type_accuracy")) for one in chosen]
        table.append([family, str(sum(part["family"] == family for part in every[0])), *cells])
    return text_table(["mIoU % / type %", "parts", *parts], table)


def without_nan(value: Any) -> Any:
    """The value with null for NaN and infinity, which JSON does not know."""
    if isinstance(value, Mapping):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _group(parts: Sequence[Score], group: str) -> dict[str, Any]:
    """The instances of one kind or size over all parts."""
    chosen = [[row for row in part["instances"] if _belongs(row, group)] for part in parts]
    clusters = {
        mean: [np.array([row[name] for row in instances], np.float64) for instances in chosen]
        for name, mean in INSTANCE_METRICS.items()
    }
    found = {name: _cluster_mean(values) for name, values in clusters.items()}
    return {
        "count": sum(map(len, chosen)),
        "mean": {name: mean for name, (mean, _) in found.items()},
        "standard_error": {name: error for name, (_, error) in found.items()},
    }


def _belongs(instance: Score, group: str) -> bool:
    if group in KINDS:
        return instance["kind"] == group
    return (instance["share"] < SMALL) == (group == "small")


def _cluster_mean(clusters: Sequence[np.ndarray]) -> tuple[float, float]:
    """Mean of all finite values in a sequence of clusters, and its standard error; NaN where there are too few."""
    finite = [values[np.isfinite(values)] for values in clusters]
    finite = [values for values in finite if values.size]
    count = sum(values.size for values in finite)
    if count == 0:
        return float("nan"), float("nan")
    mean = sum(float(values.sum()) for values in finite) / count
    if len(finite) < 2:
        return mean, float("nan")
    deviation = np.array([float((values - mean).sum()) for values in finite])
    return mean, float(np.sqrt(np.sum(deviation**2) * len(finite) / (len(finite) - 1)) / count)


def _cell(found: Summary, name: str, factor: float, digits: int) -> str:
    mean, error = found["mean"][name] * factor, found["standard_error"][name] * factor
    if not np.isfinite(mean):
        return "-"
    return f"{mean:.{digits}f}" + (f" ±{error:.{digits}f}" if np.isfinite(error) else "")
