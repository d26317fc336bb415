"""Draws the learning curve of a training: loss and validation scores over the clouds seen, with the hours above.

python scripts/learning_curve.py runs/small [more runs] [--out docs/images/learning_curve.png] [--baseline scores.json]
--baseline is a file of `evaluate.py --method geometry --json`: its mIoU is drawn as a dashed line.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from jprimfit import settings
from jprimfit.training import writer

COLORS = ("#1f5fa8", "#c8553d", "#2e8b57", "#7a4fa3", "#b08900", "#555b66")
SHADE = 0.25  # of the raw loss behind its running mean
WINDOW = 25  # log lines in the running mean
PANELS = {"miou": ("mIoU, %", 100), "type_accuracy": ("right types, %", 100), "normal_deg": ("normals, degrees", 1)}


class Curve(NamedTuple):
    """What a run wrote about itself."""

    name: str
    train: dict[str, np.ndarray]  # "clouds", "hours", "total"
    validation: dict[str, np.ndarray]  # "clouds" and the scores of PANELS


def read(folder: Path) -> Curve:
    """The curve of a workdir; ValueError if there is none in it."""
    lines = writer.read(folder)
    train, validation = ([line for line in lines if line["kind"] == kind] for kind in ("train", "validation"))
    if not train or not (folder / "config.yaml").is_file():
        raise ValueError(f"{folder} holds no training: give a workdir with {writer.NAME} and config.yaml.")
    batch = int(settings.read_yaml(folder / "config.yaml")["train"]["batch_size"])
    clouds = _column(train, "step") * batch
    # The speed of a line counts everything since the line before, so the times add up.
    hours = np.cumsum(np.diff(clouds, prepend=0) / _column(train, "clouds_per_second")) / 3600
    scores = {name: _column(validation, name) for name in PANELS}
    return Curve(
        folder.name,
        {"clouds": clouds, "hours": hours, "total": _column(train, "total")},
        {"clouds": _column(validation, "step") * batch, **scores},
    )


def draw(curves: list[Curve], *, baseline: float | None) -> Any:
    """The figure: the loss, and a panel for each validation score."""
    figure, axes = plt.subplots(2, 2, figsize=(10, 6.4), sharex=True, layout="constrained")
    panels = axes.ravel().tolist()
    for curve, color in zip(curves, COLORS, strict=False):
        loss, clouds = curve.train["total"], curve.train["clouds"] / 1000
        panels[0].plot(clouds, loss, color=color, alpha=SHADE, linewidth=0.8)
        panels[0].plot(clouds, _running_mean(loss), color=color, linewidth=1.6, label=curve.name)
        for panel, (name, (_, factor)) in zip(panels[1:], PANELS.items(), strict=True):
            scores = curve.validation[name] * factor
            panel.plot(curve.validation["clouds"] / 1000, scores, "o-", color=color, markersize=3, linewidth=1.6)
            if len(scores):
                words = {"xytext": (-4, 6), "textcoords": "offset points", "color": color, "ha": "right", "fontsize": 9}
                panel.annotate(f"{scores[-1]:.1f}", (curve.validation["clouds"][-1] / 1000, scores[-1]), **words)
    if baseline is not None:
        panels[1].axhline(100 * baseline, color="#555b66", linestyle="--", linewidth=1)
        panels[1].text(0.01, 100 * baseline, "geometry alone", transform=panels[1].get_yaxis_transform(), va="bottom")
    panels[0].set_ylabel("training loss")
    panels[0].legend(frameon=False)
    for panel, (label, _) in zip(panels[1:], PANELS.values(), strict=True):
        panel.set_ylabel(f"validation: {label}")
    for panel in panels[2:]:
        panel.set_xlabel("clouds seen, thousands")
    for panel in panels[:2]:
        _hours_above(panel, curves[0])
    for panel in panels:
        panel.grid(color="#e3e6ea", linewidth=0.6)
        panel.spines[["right"]].set_visible(False)
        panel.margins(x=0.03, y=0.1)
    return figure


def _hours_above(panel: Axes, curve: Curve) -> None:
    """A second scale on top: hours of training of the first run."""
    clouds, hours = np.append(0, curve.train["clouds"] / 1000), np.append(0, curve.train["hours"])
    minutes = hours[-1] < 1.5
    times = hours * 60 if minutes else hours
    top = panel.secondary_xaxis(
        "top", functions=(lambda x: _straight(x, clouds, times), lambda t: _straight(t, times, clouds))
    )
    top.set_xlabel(f"{'minutes' if minutes else 'hours'} of training" + (f" ({curve.name})" if curve.name else ""))


def _straight(x: Any, source: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """The broken line through (source, goal), its ends prolonged: a scale must have no flat part."""
    x = np.asarray(x, float)
    slope = (goal[-1] - goal[0]) / max(source[-1] - source[0], 1e-12)
    inside = np.interp(x, source, goal)
    return inside + slope * (np.minimum(x - source[0], 0) + np.maximum(x - source[-1], 0))


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Mean of the values around each, at most WINDOW and a twentieth of all; of fewer at the ends."""
    ones = np.ones(min(WINDOW, max(1, len(values) // 20)))
    return np.convolve(np.nan_to_num(values), ones, "same") / np.convolve(np.isfinite(values), ones, "same").clip(1)


def _column(lines: list[dict[str, Any]], name: str) -> np.ndarray:
    return np.array([np.nan if line.get(name) is None else line[name] for line in lines], float)


def main() -> None:
    """Reads the runs and writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--out", type=Path, default=Path("docs/images/learning_curve.png"))
    parser.add_argument("--baseline", type=Path)
    arguments = parser.parse_args()
    baseline = None
    if arguments.baseline:
        baseline = json.loads(arguments.baseline.read_text(encoding="utf-8"))["mean"]["miou"]
    figure = draw([read(folder) for folder in arguments.runs], baseline=baseline)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.out, dpi=110)
    print(f"{arguments.out}: {arguments.out.stat().st_size // 1024} kB")


if __name__ == "__main__":
    main()
